"""The robot from above: where each joint is, which one is chosen, and what is wrong."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from rich.text import Text
from textual.binding import Binding, BindingType
from textual.message import Message
from textual.reactive import reactive
from textual.timer import Timer
from textual.widget import Widget

from openant_tools.numbers import number
from openant_tools.robot.joints import JOINT_NAMES, JOINTS, LEGS
from openant_tools.robot.mjcf import SEGMENT, TORSO_RADIUS
from openant_tools.tui.braille import canvas_lines
from openant_tools.tui.faults import Condition, condition
from openant_tools.tui.feeds import History
from openant_tools.tui.marks import MARKS, mark, plain, spelled

__all__ = ["JointChosen", "LegMap"]

Array = NDArray[np.float64]

#: m, along a leg that points out diagonally: torso's middle to hip, hip to knee, knee to foot
HIP_M = KNEE_M = SEGMENT * math.sqrt(2)
SHIN_M = 2 * KNEE_M
#: m, what the drawing spans ahead and to the side: all of a leg but one that is turned far
REACH_M = 0.27
#: rad, about half a dot at a foot: less is not drawn anew
SEEN_RAD = 0.02
#: s between two drawings: one costs half as much as all strips
REST_S = 0.25
#: dots drawn for one line of the drawing
_DOTS_A_LINE = 60


class JointChosen(Message):
    """The builder chose a joint on the map or among the strips."""

    def __init__(self, joint: str) -> None:
        super().__init__()
        self.joint = joint


class LegMap(Widget, can_focus=True):
    """A drawing of the robot as it stands now; arrows choose a joint.

    Args:
        captioned: whether a line below tells of the chosen joint.
    """

    HELP = """\
# The robot from above

Front is up. Each leg is drawn at the angles that were measured last: a hip turns its leg, a knee that bends shortens it.
At each hip and knee stands how that servo is: `✓` answers, `▲` lost an answer, `✗` is silent or reports an error,
`·` nothing is known. The chosen joint is inverted; below it stands its angle.

Arrow keys choose a joint, here and among the strips.
"""
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("left,up", "choose(-1)", "Joint", show=False),
        Binding("right,down", "choose(1)", "Joint", show=False),
    ]
    DEFAULT_CSS = "LegMap { width: 36; height: 13; min-height: 9; }"

    chosen = reactive(JOINT_NAMES[0])

    def __init__(self, history: History, *, id: str | None = None, captioned: bool = True) -> None:
        super().__init__(id=id)
        self._history = history
        self._captioned = captioned
        self._looks: tuple[tuple[int, Condition], ...] = ()
        self._shown: tuple[tuple[int, Condition], ...] = ()
        self._resting: Timer | None = None

    def draw(self, history: History) -> None:
        """Draw these rows, where they look any different."""
        self._history = history
        looks = tuple((round(self._angle(joint) / SEEN_RAD), self._condition(joint)) for joint in JOINT_NAMES)
        self._looks = looks
        if self._resting is None:
            self._catch_up()

    def _catch_up(self) -> None:
        """Show what changed since the last time, and rest for a while where something did."""
        self._resting = None
        if self._looks != self._shown:
            self._shown = self._looks
            self.refresh()
            self._resting = self.set_timer(REST_S, self._catch_up)

    def action_choose(self, by: int) -> None:
        names = JOINT_NAMES
        self.post_message(JointChosen(names[(names.index(self.chosen) + by) % len(names)]))

    def render(self) -> Text:
        width, height = self.size.width, self.size.height - int(self._captioned)
        if width < 12 or height < 5:
            return Text("")
        ascii_only = plain()
        across, down = (width, 5 * height) if ascii_only else (2 * width, 4 * height)
        # A cell is twice as high as wide.
        per_dot_x, per_dot_y = (1.0, 0.4) if ascii_only else (0.5, 0.5)
        scale = min(width / 2 - 1, height - 0.5) / REACH_M
        dots = np.zeros((down, across), bool)
        points: dict[str, tuple[int, int]] = {}
        feet: dict[str, tuple[int, int]] = {}

        def cell(x: float, y: float) -> tuple[float, float]:
            """(column, row) in half-height units of a place in m, x forward, y left."""
            return width / 2 - y * scale, height - x * scale

        def line(a: Array, b: Array) -> None:
            share = np.linspace(0, 1, _DOTS_A_LINE)[:, None]
            places = (1 - share) * np.array(cell(*a)) + share * np.array(cell(*b))
            columns = (places[:, 0] / per_dot_x).astype(int).clip(0, across - 1)
            rows = (places[:, 1] / per_dot_y).astype(int).clip(0, down - 1)
            dots[rows, columns] = True

        corners = [0.8 * TORSO_RADIUS * np.array([math.cos(a), math.sin(a)]) for a in np.linspace(0, 2 * math.pi, 9)]
        for a, b in pairwise(corners):
            line(a, b)
        for leg in LEGS:
            root = math.atan2(leg.y_sign, leg.x_sign)
            hip_rad, knee_rad = self._angle(f"hip_{leg.name}"), self._angle(f"knee_{leg.name}")
            hip = HIP_M * np.array([math.cos(root), math.sin(root)])
            out = np.array([math.cos(root + hip_rad), math.sin(root + hip_rad)])
            knee = hip + KNEE_M * out
            foot = knee + SHIN_M * math.cos(knee_rad) * out
            for a, b in ((hip * 0.7, hip), (hip, knee), (knee, foot)):
                line(a, b)
            for kind, place in (("hip", hip), ("knee", knee)):
                column, row = cell(*place)
                points[f"{kind}_{leg.name}"] = (int(column), int(row / 2))
            column, row = cell(*foot)
            feet[leg.name] = (int(column) + (1 if leg.y_sign < 0 else -3), int(row / 2))
        lines = [list(text) for text in canvas_lines(dots, plain=ascii_only)]
        return self._with_marks(lines, points, feet)

    def _angle(self, joint: str) -> float:
        """rad; of a servo without the other of its leg, which is in no leg yet, straight."""
        leg = joint.partition("_")[2]
        if not {f"hip_{leg}", f"knee_{leg}"} <= set(self._history.joints):
            return 0.0
        angle = self._history.last_known(f"pos.{joint}")
        return angle if np.isfinite(angle) else 0.0

    def _condition(self, joint: str) -> Condition:
        return condition(self._history, joint)

    def _with_marks(
        self, lines: list[list[str]], points: dict[str, tuple[int, int]], feet: dict[str, tuple[int, int]]
    ) -> Text:
        """The drawing with the joints' marks upon it, leg names at the feet, and a line on the chosen joint."""
        width = len(lines[0])
        styles: dict[tuple[int, int], str] = {}
        for joint, (column, row) in points.items():
            found = self._condition(joint)
            row, column = min(max(row, 0), len(lines) - 1), min(max(column, 1), width - 2)
            lines[row][column] = mark("off" if found.mark == "todo" else found.mark)
            style = f"bold {MARKS[found.mark].colour}"
            styles[row, column] = f"{style} reverse" if joint == self.chosen else style
        for name, (column, row) in feet.items():
            row, column = min(max(row, 0), len(lines) - 1), min(max(column, 0), width - 2)
            lines[row][column : column + 2] = list(name)
        names = [max(column, 0) for column, row in feet.values() if row <= 0]
        free = [at for at in range(width - 4) if all(at > name + 2 or at + 5 < name for name in names)]
        if free:
            at = min(free, key=lambda at: abs(at - (width - 5) // 2))
            lines[0][at : at + 5] = list("front")
        text = Text("\n".join("".join(cells) for cells in lines) + "\n", no_wrap=True)
        for (row, column), style in styles.items():
            text.stylize(style, row * (width + 1) + column, row * (width + 1) + column + 1)
        if not self._captioned:
            text.right_crop(1)
            return text
        found = self._condition(self.chosen)
        text.append(f"{self.chosen} ", "bold")
        text.append(f"{mark(found.mark)} {spelled(found.since or found.word)}", MARKS[found.mark].colour)
        if self.chosen in self._history.joints:
            angle = self._history.last_known(f"pos.{self.chosen}")
            if np.isfinite(angle):
                text.append(f"  {spelled(number(angle, 'rad', sign=True, decimals=1))}")
        else:
            text.append(f"  id {JOINTS[self.chosen].id}")
        return text
