"""Strips: one line a joint with its state, its value, the last ten seconds of it, and how its servo fares."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from rich.segment import Segment
from rich.style import Style
from textual.binding import Binding, BindingType
from textual.geometry import Size
from textual.reactive import reactive
from textual.strip import Strip
from textual.widget import Widget

from openant_tools.numbers import number, readable, span
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.braille import trace
from openant_tools.tui.faults import condition
from openant_tools.tui.feeds import WINDOW_S, History
from openant_tools.tui.leg_map import JointChosen
from openant_tools.tui.marks import BLUE, MARKS, mark, plain, spelled

__all__ = ["SIGNALS", "JointStrips"]


@dataclass(frozen=True)
class Signal:
    """One thing that can be shown of every joint.

    Attributes:
        column: of the rows.
        low, high: what the strip spans at least.
        decimals: of the number beside it, which has a sign unless it cannot be negative.
    """

    title: str
    column: str
    unit: str
    low: float
    high: float
    decimals: int


SIGNALS: tuple[Signal, ...] = (
    Signal("angle", "pos", "°", -30.0, 30.0, 1),
    Signal("velocity", "vel", "°/s", -60.0, 60.0, 0),
    Signal("current", "cur", "A", -0.2, 0.2, 2),
    Signal("load", "load", "%", -20.0, 20.0, 0),
    Signal("duty", "pwm", "%", -20.0, 20.0, 0),
    Signal("supply", "volt", "V", 9.0, 13.0, 1),
    Signal("temperature", "temp", "°C", 20.0, 60.0, 0),
    Signal("round trip", "rtt", "ms", 0.0, 5.0, 2),
)
#: columns → factor from the row's unit to the one shown
_FACTOR: Mapping[str, float] = {"rtt": 1e3, "pwm": 100.0, "load": 100.0, "pos": math.degrees(1), "vel": math.degrees(1)}
#: columns of text before and after the trace
_BEFORE, _AFTER = 25, 17
#: of one joint: each line costs time ten times a second
MOST_LINES = 2
#: columns from one dot of the zero line to the next
ZERO_EVERY = 4


class JointStrips(Widget, can_focus=True):
    """Live or replayed strips of all joints."""

    HELP = """\
# Strips

One line a joint: how its servo is, the newest value, the last ten seconds, supply and temperature.
A gap in a trace is a time without an answer; nothing is drawn that was not measured. The dotted line is zero.

| key | |
|---|---|
| `←` `→` | another signal: angle, velocity, current, load, duty, supply, temperature, round trip |
| `↑` `↓` | choose a joint, here and on the map of the robot |

All strips of a signal share one scale, which stands in the top line; it grows when a value leaves it.
"""
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("left", "signal(-1)", "Signal", key_display="left/right"),
        Binding("right", "signal(1)", "Signal", show=False),
        Binding("up", "choose(-1)", "Joint", show=False),
        Binding("down", "choose(1)", "Joint", key_display="up/down"),
    ]
    DEFAULT_CSS = "JointStrips { height: 1fr; min-height: 10; }"

    chosen = reactive(JOINT_NAMES[0])
    signal = reactive(0)

    def __init__(self, history: History, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._history = history
        self._lines: list[Strip] = []

    def draw(self, history: History) -> None:
        """Draw these rows; called ten times a second."""
        self._history = history
        self._redraw()
        self.refresh()

    def action_signal(self, by: int) -> None:
        self.signal = (self.signal + by) % len(SIGNALS)
        self.draw(self._history)

    def action_choose(self, by: int) -> None:
        joints = self._history.joints
        at = joints.index(self.chosen) if self.chosen in joints else 0
        self.post_message(JointChosen(joints[(at + by) % len(joints)]))

    def get_content_height(self, container: Size, viewport: Size, width: int) -> int:
        return 1 + len(self._history.joints)

    def watch_chosen(self) -> None:
        self._redraw()

    def on_resize(self) -> None:
        self._redraw()
        self.refresh()

    def render_line(self, y: int) -> Strip:
        return self._lines[y] if y < len(self._lines) else Strip.blank(self.size.width, self.rich_style)

    def _redraw(self) -> None:
        width, history = self.size.width, self._history
        if width < _BEFORE + 8:
            self._lines = []
            return
        after = _AFTER if width >= 70 else 0
        across = width - _BEFORE - after
        chosen = SIGNALS[self.signal]
        values = {joint: self._values(joint, chosen) for joint in history.joints}
        low, high = _scale(chosen, values)
        ascii_only = plain()
        height = max(1, min(MOST_LINES, (self.size.height - 2) // max(1, len(history.joints))))
        stop = float(history.t[-1]) if len(history.rows) else WINDOW_S
        grey = Style(color="#A8A8A8")
        unit = spelled(chosen.unit).strip()
        title = f"{chosen.title} {unit}"
        scale = f"{spelled(span(low, high, chosen.unit))}, {number(WINDOW_S)} s"
        head = f"{'joint':9}{'servo':9}{title}"
        room = width - len(head) - after - 1
        head += scale.rjust(room) if room > len(scale) else ""
        lines = [[Segment(head.ljust(width - after), grey)]]
        if after:
            lines[0].append(Segment(f"{'V':>7}{'C' if ascii_only else '°C':>5}{'ms':>5}", grey))
        for joint in history.joints:
            lines += self._joint(joint, chosen, values[joint], stop, low, high, across, height, after > 0)
        lines.append([Segment(self._body(width), grey)])
        ground = self.rich_style
        self._lines = [Strip(line).adjust_cell_length(width).apply_style(ground) for line in lines]

    def _joint(
        self,
        joint: str,
        chosen: Signal,
        values: np.ndarray,
        stop: float,
        low: float,
        high: float,
        across: int,
        height: int,
        after: bool,
    ) -> list[list[Segment]]:
        found = condition(self._history, joint)
        here = joint == self.chosen
        drawn = trace(
            self._history.t, values, stop - WINDOW_S, stop, low, high, across, height, plain=plain()
        )  # fmt: skip
        if low < 0.0 < high:  # where nothing was drawn a dotted line is zero
            at = min(int(high / (high - low) * height), height - 1)
            dot = "." if plain() else "┈"
            drawn[at] = "".join(dot if c == " " and k % ZERO_EVERY == 0 else c for k, c in enumerate(drawn[at]))
        name = Style(bold=here, reverse=here)
        state = Style(color=MARKS[found.mark].colour, bold=found.mark == "fail")
        newest = values[-1] if len(values) else np.nan
        shown = (
            spelled(number(float(newest), sign=chosen.low <= 0.0 and chosen.unit != "ms", decimals=chosen.decimals))
            if np.isfinite(newest)
            else "-"
        )
        blue = Style(color=BLUE)
        lines = [
            [
                Segment(f"{joint:8}", name),
                Segment(f" {mark(found.mark)} {found.word:7.7}", state),
                Segment(f"{shown:>6} "),
                Segment(drawn[0], blue),
            ]
        ]
        if after:
            newest_of = self._history.last_known
            lines[0].append(
                Segment(_after(newest_of(f"volt.{joint}"), newest_of(f"temp.{joint}"), newest_of(f"rtt.{joint}")))
            )
        lines += [[Segment(" " * _BEFORE), Segment(line, blue)] for line in drawn[1:]]
        return lines

    def _values(self, joint: str, chosen: Signal) -> np.ndarray:
        return self._history.column(f"{chosen.column}.{joint}") * _FACTOR.get(chosen.column, 1.0)

    def _body(self, width: int) -> str:
        """One line on the torso: turn rate, specific force, place; empty where nobody measures them."""
        newest = self._history.last_known
        groups = (("gyro", "xyz", "rad/s", 0), ("acc", "xyz", "m/s²", 1), ("base", "xy", "m", 2))
        words = []
        for name, axes, unit, decimals in groups:
            values = [newest(f"{name}.{axis}") for axis in axes]
            if all(np.isfinite(values)):
                factor, read = readable(1.0, unit)
                row = " ".join(spelled(number(factor * value, sign=True, decimals=decimals)) for value in values)
                words.append(f"{name} {row} {spelled(read)}")
        return "   ".join(words)[:width].ljust(width)


def _scale(chosen: Signal, values: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """What all strips span: the signal's own range, and what goes beyond it."""
    known = [column[np.isfinite(column)] for column in values.values()]
    low = min([chosen.low, *(float(column.min()) for column in known if len(column))])
    high = max([chosen.high, *(float(column.max()) for column in known if len(column))])
    return low, high


def _after(volts: float, celsius: float, rtt_s: float) -> str:
    return "".join(
        (number(value, decimals=decimals) if np.isfinite(value) else "").rjust(width)
        for value, decimals, width in ((volts, 1, 7), (celsius, 0, 5), (1e3 * rtt_s, 1, 5))
    )
