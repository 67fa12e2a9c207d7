"""How every number of screens, terminal and reports is printed: from its value, its interval and its unit.

Files hold SI units; people read angles in degrees, errors of position in milliradians, short times in milliseconds. A number
has no more digits than its interval deserves: the last one is that of the interval's half width (two of it where that begins
with 1 or 2). Without an interval it has three digits that count, and an angle no more than its encoder can tell.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

__all__ = [
    "UNKNOWN",
    "chosen",
    "column",
    "decimals_of",
    "exact",
    "is_error",
    "literal",
    "number",
    "percent",
    "readable",
    "span",
    "stored",
]

UNKNOWN = "unknown"
#: digits that count, of a number without an interval
DIGITS = 3
#: places after the point at most, without an interval: of degrees (an encoder's step is 0.09°), milliradians, shares
FINEST = {"°": 1, "mrad": 2, "%": 2}
#: unit of files → (the factor below 1 of it, and that unit): short times, small currents and distances
SMALL = {"s": (1e3, "ms"), "A": (1e3, "mA"), "m": (1e3, "mm")}
#: below how much of the unit the smaller one is read
SMALL_BELOW = {"s": 0.1, "A": 0.1, "m": 0.1}
#: words of an error of position in the name of a quantity
_ERROR = re.compile(r"\b(gap|floor|residual|error)", re.IGNORECASE)


def is_error(name: str) -> bool:
    """Whether a quantity of this name is an error of position, read in milliradians instead of degrees."""
    return bool(_ERROR.search(name))


def readable(value: float, unit: str, name: str = "") -> tuple[float, str]:
    """The factor by which numbers of a unit are multiplied to be read, and the unit then; `value` is a typical one.

    Args:
        unit: as files have it; `1` and nothing mean that there is none, `share` a share of 1.
        name: of the quantity, see `is_error`.
    """
    if unit == "rad":
        return (1e3, "mrad") if is_error(name) else (math.degrees(1), "°")
    if unit == "rad/s":
        return math.degrees(1), "°/s"
    if unit == "share":
        return 100.0, "%"
    if unit in SMALL and 0.0 < abs(value) < SMALL_BELOW[unit]:
        return SMALL[unit]
    return 1.0, "" if unit == "1" else unit


def decimals_of(value: float, half: float | None = None, unit: str = "") -> int:
    """Places after the point that a number deserves.

    Args:
        value: as it will be read. half: half the width of its interval, likewise.
        unit: as it will be read.
    """
    if half is not None and math.isfinite(half) and half > 0.0:
        place = math.floor(math.log10(half))
        return max(0, (1 if half / 10**place < 3 else 0) - place)
    if not math.isfinite(value) or value == 0.0 or (float(value).is_integer() and abs(value) >= 10 ** (DIGITS - 1)):
        return 0
    places = max(0, DIGITS - 1 - math.floor(math.log10(abs(value))))
    return min(places, FINEST.get(unit, 6))


def number(
    value: float | None,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    *,
    name: str = "",
    sign: bool = False,
    decimals: int | None = None,
) -> str:
    """A number with its unit, and its interval where it has one: `0.49 mrad`, `12.3° (11.9 to 12.8)`, `unknown`.

    Args:
        value, low, high: in `unit`, as files have it; an interval counts with both its ends.
        name: of the quantity, see `is_error`.
        sign: whether what is not negative has a plus.
        decimals: places after the point, of what stands in a column or changes many times a second; None: as it deserves.
    """
    if value is None or not math.isfinite(value):
        return UNKNOWN
    # Where it is nothing, its interval says how finely that is known.
    factor, unit = readable(value or high or 0.0, unit, name)
    shown, interval = factor * value, ""
    if low is not None and high is not None and math.isfinite(low) and math.isfinite(high):
        places = decimals_of(shown, 0.5 * factor * abs(high - low), unit) if decimals is None else decimals
        interval = f" ({_plain(factor * low, places)} to {_plain(factor * high, places)})"
    elif _whole(shown) and decimals is None:
        places = 0
    else:
        places = decimals_of(shown, None, unit) if decimals is None else decimals
    words = _plain(shown, places)
    plus = "+" if sign and not words.startswith("−") else ""
    return f"{plus}{words}{_joined(unit)}{interval}"


def column(values: Sequence[float | None], unit: str = "", *, name: str = "") -> list[str]:
    """Numbers that stand below each other: as many places after the point as the largest deserves, and one unit."""
    known = [value for value in values if value is not None and math.isfinite(value)]
    most = max(map(abs, known), default=0.0)
    factor, read = readable(most, unit, name)
    whole = all(_whole(factor * value) for value in known)
    places = 0 if whole else decimals_of(factor * most, None, read)
    # Each alone might choose another unit.
    return [
        UNKNOWN if v is None or not math.isfinite(v) else f"{_plain(factor * v, places)}{_joined(read)}" for v in values
    ]


def exact(value: float, unit: str = "") -> str:
    """A number that somebody chose, which has the digits that he gave it: `0.5 s`."""
    return literal(value).replace("-", "−") + _joined(unit)


def chosen(value: float, unit: str = "", *, name: str = "") -> str:
    """The same, of a limit that files have in another unit than people read: `0.5 %` for a share of 0.005."""
    factor, unit = readable(value, unit, name)
    text = _plain(factor * value, decimals_of(factor * value, None, unit))
    return (text.rstrip("0").rstrip(".") if "." in text else text) + _joined(unit)


def literal(value: float, digits: int = 6) -> str:
    """A number as one types it into a file or a command, `-0.785398`: in the unit of the file, by these digits at most."""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else f"{value:.{digits}g}"


def stored(value: float, digits: int = 6) -> float:
    """A number as files keep it: six digits are more than any interval leaves meaning to, and fit for reading."""
    return float(f"{value:.{digits}g}")


def span(low: float | None, high: float | None, unit: str = "", *, name: str = "", decimals: int | None = None) -> str:
    """Two ends of a range, `-45 to 45°`; arguments as those of `number`."""
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        return UNKNOWN
    factor, unit = readable(max(abs(low), abs(high)), unit, name)
    ends = [factor * low, factor * high]
    places = max(0 if _whole(end) else min(2, decimals_of(end, None, unit)) for end in ends)
    if places:  # a narrow range, such as that of an inertia, needs more
        places = max(places, min(decimals_of(ends[1], 0.5 * abs(ends[1] - ends[0])), FINEST.get(unit, 6)))
    if decimals is not None:
        places = decimals
    return f"{_plain(ends[0], places)} to {_plain(ends[1], places)}{_joined(unit)}"


def percent(share: float | None, *, decimals: int = 0) -> str:
    """A share as per cent, `45 %`; what is there and would be 0 is said to be below."""
    if share is None or not math.isfinite(share):
        return UNKNOWN
    least = 10.0**-decimals
    if 0.0 < 100 * share < 0.5 * least:
        return f"below {_plain(least, decimals)} %"
    return f"{_plain(100 * share, decimals)} %"


def _whole(value: float) -> bool:
    """Whether it has no fraction but for what a unit's factor rounds."""
    return math.isclose(value, round(value), rel_tol=1e-12)


def _plain(value: float, places: int) -> str:
    text = f"{value:.{places}f}"
    # Nothing is not less than nothing.
    return text.lstrip("-") if float(text) == 0.0 else text.replace("-", "−")


def _joined(unit: str) -> str:
    return unit if unit in ("", "°") else f" {unit}"
