"""States as a glyph, a word and a colour at once, so that each is understood without the other two."""

from __future__ import annotations

import locale
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from rich.text import Text

__all__ = ["BLUE", "MARKS", "Name", "StateMark", "can_unicode", "mark", "marked", "overflow", "plain", "spelled"]

Name = Literal["ok", "warn", "fail", "unsure", "wait", "todo", "stale", "info", "off", "on"]

#: Okabe–Ito: told apart by every kind of colour vision.
GREEN, ORANGE, VERMILION, BLUE, GREY = "#009E73", "#E69F00", "#D55E00", "#56B4E9", "#A8A8A8"


@dataclass(frozen=True)
class StateMark:
    """How one state looks.

    Attributes:
        glyph, ascii: one column each.
    """

    glyph: str
    ascii: str
    word: str
    colour: str


MARKS: Mapping[Name, StateMark] = {
    "ok": StateMark("✓", "+", "ok", GREEN),
    "warn": StateMark("▲", "!", "look", ORANGE),
    "fail": StateMark("✗", "x", "failed", VERMILION),
    "unsure": StateMark("?", "?", "unclear", ORANGE),
    "wait": StateMark("…", "~", "running", BLUE),
    "todo": StateMark("·", ".", "to do", GREY),
    "stale": StateMark("↻", "o", "redo", ORANGE),
    "info": StateMark("›", ">", "", BLUE),
    "off": StateMark("○", "-", "off", GREY),
    "on": StateMark("●", "*", "ON", ORANGE),
}


def can_unicode(environment: Mapping[str, str] = os.environ) -> bool:
    """Whether the terminal shows more than ASCII: its locale says UTF-8, and nobody has set OPENANT_ASCII."""
    if environment.get("OPENANT_ASCII"):
        return False
    return "utf" in locale.getpreferredencoding(False).lower()


_unicode = can_unicode()


def plain(on: bool | None = None) -> bool:
    """Whether only ASCII is to be drawn; with an argument, sets it."""
    global _unicode
    if on is not None:
        _unicode = not on
    return not _unicode


#: what stands in words and units → how it is spelled in ASCII
_SPELLED = str.maketrans({
    "→": "->", "…": "...", "°": " deg", "×": "x", "–": "-", "—": "-", "−": "-", "²": "2", "·": "*", "μ": "u", "µ": "u",
    "λ": "lambda", "τ": "tau", "±": "+-", "✓": "+", "✗": "x", "▲": "!", "“": '"', "”": '"', "’": "'", "Ω": "ohm",
})  # fmt: skip


def spelled(words: str) -> str:
    """Words as this terminal can show them."""
    return words if _unicode else words.replace("°C", "C").translate(_SPELLED).encode("ascii", "replace").decode()


def overflow() -> Literal["crop", "ellipsis"]:
    """How a line that is too long ends: the ellipsis is no ASCII."""
    return "ellipsis" if _unicode else "crop"


def mark(name: Name) -> str:
    """The glyph alone."""
    return MARKS[name].glyph if _unicode else MARKS[name].ascii


def marked(name: Name, words: str | None = None, width: int = 0) -> Text:
    """Glyph and word in the state's colour; `words` instead of the state's own."""
    entry = MARKS[name]
    text = f"{mark(name)} {entry.word if words is None else spelled(words)}"
    return Text(text.ljust(width), style=f"bold {entry.colour}" if name in ("fail", "on") else entry.colour)
