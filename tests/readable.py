"""What no text for people may hold, whatever made it."""

from __future__ import annotations

import re

__all__ = ["unreadable"]

_ODD = re.compile(
    r"\d ?rad\b"  # angles in files' units
    r"|[\[{(]['\"][\w. -]*['\"]\s*[,:\])}]|\[-?\d+(\.\d+)?[,\]]"  # dictionaries and lists of Python
    r"|\b(None|nan)\b"
)
_DECIMAL = re.compile(r"(?<![\w.])\d+\.\d+(?![\w.]*\d)")
#: digits that count, at most: more are no measurement's
DIGITS = 5


def unreadable(text: str) -> list[str]:
    """Angles in rad, lists or dictionaries as Python prints them, nothing as a number, and decimals with too many digits."""
    long = [one for one in _DECIMAL.findall(text) if len(one.replace(".", "").lstrip("0")) > DIGITS]
    return [found[0] for found in _ODD.finditer(text)] + long
