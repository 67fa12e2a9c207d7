"""A learning curve in characters, with axes: reward over steps, and what the paper reached."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from openant_tools.numbers import number
from openant_tools.tui.braille import trace
from openant_tools.tui.marks import BLUE, ORANGE, plain, spelled

__all__ = ["PAPER_CM_S", "curve_lines", "within_reach"]

Array = NDArray[np.float64]

#: agent → cm/s from which on it walks as the paper's did, and in whose words
PAPER_CM_S = {
    "sac": (13.0, "13 to 23 cm/s after 13 h in simulation"),
    "sarsa": (2.0, "2 to 4 cm/s within an hour on the robot"),
}
#: columns of the scale on the left
SCALE = 8
#: times the best that a level may be, to be drawn: beyond, the curve would be too flat to read
REACH = 3


def within_reach(reward: Array, level: float | None) -> bool:
    """Whether a level is drawn beside a curve in cm/s."""
    return level is not None and level <= REACH * _top(reward)


def _top(reward: Array) -> float:
    return max(1.0, 1.05 * float(reward.max()))


def curve_lines(step: Array, reward: Array, stop: float, level: float | None, width: int, height: int) -> list[Text]:
    """`height` lines of the curve and two of its axis.

    Args:
        step, reward: (n,) and cm/s. stop: where the axis ends. level: a dotted line, where the scale reaches it.
    """
    low, high = min(0.0, float(reward.min())), _top(reward)
    level = level if within_reach(reward, level) else None
    if level is not None:
        high = max(high, 1.1 * level)
    ascii_only = plain()
    wall, corner, floor, dots = ("|", "+", "-", ".") if ascii_only else ("│", "└", "─", "┄")
    across = max(width - SCALE - 1, 10)
    # A young curve has fewer points than the picture columns: lines lead from one to the next.
    between = np.union1d(step, np.linspace(step[0], step[-1], 2 * across))
    drawn = trace(between, np.interp(between, step, reward), 0.0, stop, low, high, across, height, plain=ascii_only)

    def row(value: float) -> int:
        return min(max(int((high - value) / (high - low) * height), 0), height - 1)

    names = {row(value): spelled(number(value, decimals=1)) for value in (low, 0.0, high)}
    lines = []
    for k, line in enumerate(drawn):
        text = Text(f"{names.get(k, ''):>{SCALE}}{wall}")
        at_level = level is not None and k == row(level)
        for character in line:
            if character == " " and at_level:
                text.append(dots, ORANGE)
            else:
                text.append(character, BLUE)
        lines.append(text)
    end = number(stop)
    lines.append(Text(f"{'cm/s':>{SCALE}}{corner}{floor * across}"))
    lines.append(Text(f"{'':{SCALE}} 0{'steps':^{max(across - 1 - len(end), 5)}}{end}"))
    return lines
