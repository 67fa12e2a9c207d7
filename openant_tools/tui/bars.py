"""Values as bars: live ones, one line a joint; and what was found, against what is allowed."""

from __future__ import annotations

import math

from rich.text import Text

from openant_tools.numbers import number, readable
from openant_tools.procedure.finding import Evidence
from openant_tools.procedure.step import Live
from openant_tools.tui.marks import BLUE, GREEN, ORANGE, overflow, plain, spelled

__all__ = ["allowed_bar", "bars"]

#: of the width of an allowed range: what a bar shows beyond each of its ends
BEYOND = 0.4
#: unit → places after the point of what changes many times a second; of others three
DECIMALS = {"rad": 1, "rad/s": 1, "°C": 0}


def bars(live: Live, width: int) -> Text:
    """The values of a procedure's `Live`, each on its own scale where one is given, in lines of `width` columns.

    A bar begins at zero, where its scale has one.
    """
    text = Text(no_wrap=True, overflow=overflow())
    if live.words:
        text.append(f"{spelled(live.words)}\n")
    longest = max((len(mark) for mark in live.marks.values()), default=0)
    across = max(8, width - 42 - longest)
    full, empty, here, cross = ("=", "-", "|", "+") if plain() else ("━", "─", "●", "┼")
    for joint, value in live.values.items():
        low, high = live.low.get(joint), live.high.get(joint)
        # What cannot be negative has no sign either.
        signed = low is None or low < 0.0
        shown = number(value, live.unit, sign=signed, decimals=DECIMALS.get(live.unit, 3))
        text.append(f"{joint:9}{spelled(shown):>12} ", "bold")
        if low is not None and high is not None and math.isfinite(value) and high > low:
            at = min(max(round((value - low) / (high - low) * (across - 1)), 0), across - 1)
            text.append(f"{spelled(_end(low, live.unit, signed)):>7} ")
            zero = round(-low / (high - low) * (across - 1)) if low < 0.0 < high else None
            begin = zero or 0
            cells = [full if min(begin, at) <= k <= max(begin, at) else empty for k in range(across)]
            if zero is not None:
                cells[zero] = cross
            cells[at] = here
            text.append("".join(cells), BLUE)
            text.append(f" {spelled(_end(high, live.unit, signed)):>6}")
        text.append(f" {spelled(live.marks.get(joint, ''))}\n")
    text.rstrip()
    return text


def _end(value: float, unit: str, sign: bool) -> str:
    """An end of a bar, without its unit."""
    factor, read = readable(value, unit)
    return number(factor * value, sign=sign, decimals=0 if read in ("°", "°/s", "°C") else 2)


def allowed_bar(evidence: Evidence, width: int) -> Text:
    """Where a number lies: what is allowed is a thick line, what is beyond it a dotted one; blank where it is not known."""
    value, least, most = evidence.value, evidence.least, evidence.most
    if value is None or (least is None and most is None):
        return Text(" " * width)
    if least is None:
        least = min(0.0, float(most or 0.0))
        free = (least, most + BEYOND * (most - least or 1.0)) if most is not None else (least, least + 1.0)
    elif most is None:
        free = (least - BEYOND * (abs(least) or 1.0), max(value, least + 2 * (abs(least) or 1.0)))
    else:
        beyond = BEYOND * (most - least or 1.0)
        free = (least - beyond, most + beyond)

    def cell(number: float) -> int:
        return min(max(round((number - free[0]) / (free[1] - free[0]) * (width - 1)), 0), width - 1)

    within, outside, here = ("=", ".", "|") if plain() else ("━", "┄", "●")
    ends = cell(least), cell(most) if most is not None else width - 1
    drawn = [within if ends[0] <= k <= ends[1] else outside for k in range(width)]
    right = value >= least and (most is None or value <= most)
    # A number just outside is drawn outside.
    at = cell(value)
    if not right:
        at = min(at, max(ends[0] - 1, 0)) if value < least else max(at, min(ends[1] + 1, width - 1))
    text = Text("".join(drawn), GREEN if right else ORANGE)
    text = Text.assemble(text[:at], (here, f"bold {GREEN if right else ORANGE}"), text[at + 1 :])
    return text
