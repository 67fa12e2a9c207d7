"""The robot as it is now, a line a joint: how its servo is, angle, load or current, heat and supply. Of what is not of now
the last values stand there, dimmed, with how long ago that was. Torque is one for all: the line above every screen has it."""

from __future__ import annotations

import numpy as np
from rich.text import Text
from textual.reactive import reactive
from textual.widget import Widget

from openant_tools.numbers import number, percent
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.faults import condition
from openant_tools.tui.feeds import History
from openant_tools.tui.marks import MARKS, mark, plain, spelled

__all__ = ["JointTable"]


class JointTable(Widget):
    """One line for each joint of the robot, be it on the bus now or not; of servos that are no joints yet, one for each of them."""

    DEFAULT_CSS = "JointTable { height: 9; width: 53; }"

    chosen = reactive(JOINT_NAMES[0])

    def __init__(self, history: History, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._history = history
        self._shown = Text()

    def draw(self, history: History) -> None:
        """Show these rows, where they read any different."""
        self._history = history
        table = self._table()
        if table != self._shown:
            self._shown = table
            self.refresh()

    def watch_chosen(self) -> None:
        self.draw(self._history)

    def render(self) -> Text:
        return self._shown

    def _table(self) -> Text:
        head = f"{'joint':9}{'servo':15}{'angle':>8}{'load':>6}{'A':>6}{'C' if plain() else '°C':>4}{'V':>5}"
        text = Text(no_wrap=True).append(head, MARKS["todo"].colour)
        joints = self._history.joints
        for joint in JOINT_NAMES if set(joints) & set(JOINT_NAMES) or not joints else joints[: len(JOINT_NAMES)]:
            text.append("\n").append_text(self._joint(joint))
        return text

    def _joint(self, joint: str) -> Text:
        found = condition(self._history, joint)
        line = Text().append(f"{joint:8.8}", "bold reverse" if joint == self.chosen else "").append(" ")
        line.append(f"{mark(found.mark)} {spelled(found.since or found.word):13.13}", MARKS[found.mark].colour)
        angle, load, current, heat, supply = (
            self._history.last_known(f"{signal}.{joint}") for signal in ("pos", "load", "cur", "temp", "volt")
        )
        if not any(map(np.isfinite, (angle, load, current, heat, supply))):
            return line
        dimmed = "dim" if found.since and not plain() else ""
        line.append(f"{_shown(angle, 'rad', sign=True, decimals=1):>8}", dimmed or "bold")
        # Servos that measure no current say how hard they work as a share: each has its column.
        effort = f"{spelled(percent(load)) if np.isfinite(load) else '-':>6}{_shown(current, decimals=2):>6}"
        line.append(f"{effort}{_shown(heat, decimals=0):>4}{_shown(supply, decimals=1):>5}", dimmed)
        return line


def _shown(value: float, unit: str = "", *, sign: bool = False, decimals: int) -> str:
    return spelled(number(value, unit, sign=sign, decimals=decimals)).strip() if np.isfinite(value) else "-"
