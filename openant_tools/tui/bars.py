"""Live values as bars, one line a joint."""

from __future__ import annotations

import math

from rich.text import Text

from openant_tools.numbers import number, readable
from openant_tools.procedure.step import Live
from openant_tools.tui.marks import BLUE, plain, spelled

__all__ = ["bars"]


def bars(live: Live, width: int) -> Text:
    """The values of a procedure's `Live`, each on its own scale where one is given, in lines of `width` columns."""
    text = Text(no_wrap=True, overflow="ellipsis")
    if live.words:
        text.append(f"{spelled(live.words)}\n")
    longest = max((len(mark) for mark in live.marks.values()), default=0)
    across = max(8, width - 42 - longest)
    full, empty, here = ("=", "-", "|") if plain() else ("━", "─", "●")
    for joint, value in live.values.items():
        low, high = live.low.get(joint), live.high.get(joint)
        shown = number(value, live.unit, sign=True, decimals=1 if live.unit in ("rad", "rad/s") else 3)
        text.append(f"{joint:9}{spelled(shown):>12} ", "bold")
        if low is not None and high is not None and math.isfinite(value) and high > low:
            at = min(max(round((value - low) / (high - low) * (across - 1)), 0), across - 1)
            text.append(f"{spelled(_end(low, live.unit)):>7} ")
            text.append(full * at + here + empty * (across - 1 - at), BLUE)
            text.append(f" {spelled(_end(high, live.unit)):>6}")
        text.append(f" {spelled(live.marks.get(joint, ''))}\n")
    text.rstrip()
    return text


def _end(value: float, unit: str) -> str:
    """An end of a bar, without its unit."""
    factor, read = readable(value, unit)
    return number(factor * value, sign=True, decimals=0 if read in ("°", "°/s") else 2)
