"""The robot as it is now, a line a joint: how its servo is, angle, torque, load, heat and supply."""

from __future__ import annotations

import math

import numpy as np
from rich.text import Text
from textual.reactive import reactive
from textual.widget import Widget

from openant_tools.numbers import number, percent
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.faults import Condition, condition
from openant_tools.tui.feeds import History
from openant_tools.tui.marks import MARKS, Name, mark, plain, spelled

__all__ = ["JointTable"]


class JointTable(Widget):
    """One line for each joint of the robot, be it on the bus now or not."""

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
        head = f"{'joint':9}{'servo':11}{'angle':>8}{'torque':>7}{'load':>8}{'C' if plain() else '°C':>4}{'V':>5}"
        text = Text(no_wrap=True).append(head, MARKS["todo"].colour)
        for joint in JOINT_NAMES:
            text.append("\n").append_text(self._joint(joint))
        return text

    def _joint(self, joint: str) -> Text:
        here = joint in self._history.joints and len(self._history.rows) > 0
        found = condition(self._history, joint) if here else Condition("todo", "no data")
        line = Text().append(f"{joint:8}", "bold reverse" if joint == self.chosen else "").append(" ")
        line.append(f"{mark(found.mark)} {found.word:9.9}", MARKS[found.mark].colour)
        if not here:
            return line
        known = self._history.last_known
        angle, amperes, share = (known(f"{signal}.{joint}") for signal in ("pos", "cur", "load"))
        on = self._history.newest("torque") > 0
        line.append(f"{_shown(angle, 'rad', sign=True, decimals=1):>8}", "bold")
        state: Name = "on" if on else "off"
        line.append(f"{mark(state)} {MARKS[state].word}".rjust(7), MARKS[state].colour)
        # Amperes always: what stands below each other is read in one unit.
        current = f"{_shown(amperes, decimals=2)} A" if math.isfinite(amperes) else "-"
        line.append(f"{percent(share) if math.isfinite(share) else current:>8}")
        line.append(f"{_shown(known(f'temp.{joint}'), decimals=0):>4}{_shown(known(f'volt.{joint}'), decimals=1):>5}")
        return line


def _shown(value: float, unit: str = "", *, sign: bool = False, decimals: int) -> str:
    return spelled(number(value, unit, sign=sign, decimals=decimals)).strip() if np.isfinite(value) else "-"
