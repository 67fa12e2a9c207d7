"""What a report is made of: one class a kind of part, each of which writes itself as HTML, Markdown and JSON."""

from __future__ import annotations

import base64
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol
from urllib.parse import quote

from openant_tools.numbers import number
from openant_tools.report import plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = [
    "Code", "Details", "Figure", "Files", "KeyFigure", "KeyFigures", "Mark", "Part", "Picture", "SavePicture", "Table",
    "Text", "Tone", "VerdictLine",
]  # fmt: skip

#: What a value says: all is well, look here, this is bad, or nothing.
Tone = Literal["", "good", "warn", "bad"]

#: Stores a picture beside a Markdown report and returns the path to write: (name, PNG bytes) → relative path.
SavePicture = Callable[[str, bytes], str]

#: bytes of SVG; beyond it a picture of pixels is smaller and scrolls better
_LARGEST_SVG = 700_000

#: [words](address): on the web, in this page or beside it; no other scheme, so that text never becomes a script
_LINK = re.compile(r"\[([^\]]+)\]\((https?://[^\s)]+|[^\s:)]+)\)")


class Part(Protocol):
    """One part of a report."""

    def html(self, key: str) -> str:
        """As HTML; `key` is unique in the report, for ids."""

    def markdown(self, key: str, save: SavePicture) -> str:
        """As Markdown, pictures stored by `save`."""

    def json(self) -> dict[str, Any]:
        """As data."""


@dataclass(frozen=True)
class Mark:
    """A word or number in a table that says by its colour, and by a sign for those who see none, how it stands."""

    text: str
    tone: Tone = ""


@dataclass(frozen=True)
class VerdictLine:
    """The sentence that a report is opened for."""

    text: str
    tone: Tone = ""

    def html(self, key: str) -> str:
        return f'<p class="verdict {self.tone}">{_inline(self.text)}</p>'

    def markdown(self, key: str, save: SavePicture) -> str:
        return f"**{self.text}**"

    def json(self) -> dict[str, Any]:
        return {"kind": "verdict", **vars(self)}


@dataclass(frozen=True)
class Files:
    """Links to files, as seen from the folder in which the page lies; without a folder their names alone."""

    words: str
    paths: Sequence[str | Path]
    folder: Path | None = None

    def html(self, key: str) -> str:
        return f"<p>{escape(self.words)} " + ", ".join(map(self._link, self.paths)) + "</p>"

    def _link(self, path: str | Path) -> str:
        name = escape(Path(path).name)
        return (
            name
            if self.folder is None or not Path(path).exists()
            else f'<a href="{escape(self._address(path), quote=True)}">{name}</a>'
        )

    def markdown(self, key: str, save: SavePicture) -> str:
        names = ", ".join(f"[{Path(path).name}]({self._address(path)})" for path in self.paths)
        return f"{self.words} {names}"

    def json(self) -> dict[str, Any]:
        return {"kind": "files", "files": [str(path) for path in self.paths]}

    def _address(self, path: str | Path) -> str:
        return "./" + quote(Path(os.path.relpath(path, self.folder or Path())).as_posix())


@dataclass(frozen=True)
class Text:
    """Paragraphs, parted by empty lines; lines that start with `- ` are a list; `code`, **bold**, *em* and [links](url)."""

    text: str

    def html(self, key: str) -> str:
        out = []
        for block in re.split(r"\n\s*\n", self.text.strip()):
            lines = block.splitlines()
            first = next((k for k, line in enumerate(lines) if line.lstrip().startswith("- ")), len(lines))
            if first:
                out.append(f"<p>{_inline(' '.join(lines[:first]))}</p>")
            if first < len(lines):
                items = re.split(r"(?m)^\s*- ", "\n".join(lines[first:]))[1:]
                out.append("<ul>" + "".join(f"<li>{_inline(' '.join(item.split()))}</li>" for item in items) + "</ul>")
        return "\n".join(out)

    def markdown(self, key: str, save: SavePicture) -> str:
        return self.text.strip()

    def json(self) -> dict[str, Any]:
        return {"kind": "text", "text": self.text.strip()}


@dataclass(frozen=True)
class Code:
    """Commands or file content, to be copied."""

    text: str

    def html(self, key: str) -> str:
        return f"<pre><code>{escape(self.text.strip())}</code></pre>"

    def markdown(self, key: str, save: SavePicture) -> str:
        return f"```\n{self.text.strip()}\n```"

    def json(self) -> dict[str, Any]:
        return {"kind": "code", "text": self.text.strip()}


@dataclass(frozen=True)
class KeyFigure:
    """One number that a reader should take away.

    Attributes:
        label: what it is.
        value: with its unit, as it should be read.
        note: what it is compared with, or what it decides.
        tone: how it stands.
    """

    label: str
    value: str
    note: str = ""
    tone: Tone = ""


@dataclass(frozen=True)
class KeyFigures:
    """A row of key figures."""

    figures: Sequence[KeyFigure]

    def html(self, key: str) -> str:
        boxes = []
        for figure in self.figures:
            note = f"<span class=note>{_inline(figure.note)}</span>" if figure.note else ""
            value, interval, rest = figure.value.partition(" (")
            small = f" <small>{escape((interval + rest).strip())}</small>" if interval else ""
            value = f"<b>{escape(value)}{small}</b>"
            boxes.append(f'<div class="key {figure.tone}"><span>{escape(figure.label)}</span>{value}{note}</div>')
        return f"<div class=keys>{''.join(boxes)}</div>"

    def markdown(self, key: str, save: SavePicture) -> str:
        return "\n".join(
            f"- {figure.label}: **{figure.value}**" + (f" ({figure.note})" if figure.note else "")
            for figure in self.figures
        )

    def json(self) -> dict[str, Any]:
        return {"kind": "key_figures", "figures": [vars(figure) for figure in self.figures]}


@dataclass(frozen=True)
class Table:
    """A table; a column whose cells are all numbers is set to the right.

    Attributes:
        columns: headings, with the unit where there is one.
        rows: cells: text, a number (printed by `openant_tools.numbers`; write text for more digits), a `Mark` or None.
        caption: what it shows.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    caption: str = ""

    def html(self, key: str) -> str:
        right = [self._is_numeric(column) for column in range(len(self.columns))]
        shown = [_number if flag else _inline for flag in right]
        sides = [" class=num" if flag else "" for flag in right]
        head = "".join(f"<th{side}>{_inline(name)}</th>" for side, name in zip(sides, self.columns, strict=True))
        body = []
        for row in self.rows:
            cells = []
            for side, html, cell in zip(sides, shown, row, strict=True):
                if isinstance(cell, Mark):
                    cells.append(f'<td{side}><span class="mark {cell.tone}">{_inline(cell.text)}</span></td>')
                else:
                    cells.append(f"<td{side}>{html(_shown(cell))}</td>")
            body.append(f"<tr>{''.join(cells)}</tr>")
        # Outside of what is scrolled sideways, so that all of it is seen beside a wide table.
        caption = f'<p class=caption id="{key}-caption">{_inline(self.caption)}</p>' if self.caption else ""
        named = f' aria-labelledby="{key}-caption"' if self.caption else ""
        table = f"<table{named}><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"
        return f"{caption}<div class=scroll>{table}</div>"

    def markdown(self, key: str, save: SavePicture) -> str:
        lines = [
            "| " + " | ".join(map(_cell, self.columns)) + " |",
            "|" + "|".join("---:" if self._is_numeric(k) else "---" for k in range(len(self.columns))) + "|",
        ]
        lines += ["| " + " | ".join(_cell(_shown(cell)) for cell in row) + " |" for row in self.rows]
        return "\n".join(([self.caption, ""] if self.caption else []) + lines)

    def json(self) -> dict[str, Any]:
        rows = [[_data(cell) for cell in row] for row in self.rows]
        return {"kind": "table", "caption": self.caption, "columns": list(self.columns), "rows": rows}

    def _is_numeric(self, column: int) -> bool:
        cells = [_shown(row[column]).strip("±+−-–<>≤≥ %") for row in self.rows]
        numbers = [cell for cell in cells if cell]
        return bool(numbers) and all(cell[0].isdigit() for cell in numbers)


@dataclass(frozen=True)
class Figure:
    """A plot.

    Attributes:
        figure: a matplotlib figure, as `openant_tools.report.plots.figure` makes them.
        caption: what it shows and what to look for.
        alt: what a reader who cannot see it should know; default: the caption.
    """

    figure: MatplotlibFigure
    caption: str
    alt: str = ""

    def html(self, key: str) -> str:
        alt = escape(self.alt or self.caption, quote=True)
        svg = plots.as_svg(self.figure, key)
        if len(svg) <= _LARGEST_SVG:
            picture = svg.replace("<svg ", f'<svg role="img" aria-label="{alt}" ', 1)
        else:
            picture = f'<img class=paper alt="{alt}" src="{_data_url(plots.as_png(self.figure))}">'
        return f"<figure>{picture}<figcaption>{_inline(self.caption)}</figcaption></figure>"

    def markdown(self, key: str, save: SavePicture) -> str:
        path = save(f"{key}.png", plots.as_png(self.figure))
        return f"![{(self.alt or self.caption).replace(']', ')')}]({path})\n\n*{self.caption}*"

    def json(self) -> dict[str, Any]:
        return {"kind": "figure", "caption": self.caption}


@dataclass(frozen=True)
class Picture:
    """A photograph, a rendering or a short video: a PNG, JPEG or (animated) WebP file, or the bytes of one.

    Attributes:
        still: of a picture that moves, what is shown where motion is unwanted.
    """

    data: bytes | Path
    caption: str
    alt: str = ""
    still: bytes | Path | None = None

    def html(self, key: str) -> str:
        alt = escape(self.alt or self.caption, quote=True)
        picture = f'<img alt="{alt}" src="{_data_url(_bytes_of(self.data))}">'
        if self.still is not None:
            still = f'<source media="(prefers-reduced-motion: reduce)" srcset="{_data_url(_bytes_of(self.still))}">'
            picture = f"<picture>{still}{picture}</picture>"
        return f"<figure>{picture}<figcaption>{_inline(self.caption)}</figcaption></figure>"

    def markdown(self, key: str, save: SavePicture) -> str:
        data = _bytes_of(self.data)
        path = save(f"{key}.{_kind_of(data).replace('jpeg', 'jpg')}", data)
        return f"![{(self.alt or self.caption).replace(']', ')')}]({path})\n\n*{self.caption}*"

    def json(self) -> dict[str, Any]:
        return {"kind": "picture", "caption": self.caption}


@dataclass(frozen=True)
class Details:
    """Parts that stay folded until a reader asks for them."""

    summary: str
    parts: Sequence[Part]

    def html(self, key: str) -> str:
        inside = "\n".join(part.html(f"{key}-{k}") for k, part in enumerate(self.parts))
        return f"<details><summary>{_inline(self.summary)}</summary>{inside}</details>"

    def markdown(self, key: str, save: SavePicture) -> str:
        inside = (part.markdown(f"{key}-{k}", save) for k, part in enumerate(self.parts))
        return "\n\n".join([f"**{self.summary}**", *inside])

    def json(self) -> dict[str, Any]:
        return {"kind": "details", "summary": self.summary, "parts": [part.json() for part in self.parts]}


#: the blank between a number and its unit, where no line ends
_UNIT = re.compile(r"(?<=\d) (?=(?:%|°C|min|[mcµ]?[smAVW]|k?g|m?rad|k?Hz|K|h|N·m|cm/s)(?!\w))")
#: characters of a command that stays on one line; a browser breaks after each of its dashes
FEW, SHORT = 24, " class=short"


def _number(text: str) -> str:
    """A number as HTML: it is never broken, but its interval may go below it."""
    value, interval, rest = text.partition(" (")
    below = f" <span class=short>{_inline(interval.strip() + rest)}</span>" if interval else ""
    return f"<span class=short>{_inline(value)}</span>{below}"


def _inline(text: str) -> str:
    """Escaped text with `code`, **bold**, *em* and [links](url); code is left as it is inside."""
    out = []
    for k, piece in enumerate(re.split(r"`([^`]+)`", text)):
        safe = escape(_UNIT.sub("\u00a0", piece))
        if k % 2:
            out.append(f"<code{SHORT if len(piece) <= FEW else ''}>{safe}</code>")
            continue
        safe = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", safe)
        safe = re.sub(r"\*(\S(?:[^*]*[^*\s])?)\*", r"<em>\1</em>", safe)
        out.append(_LINK.sub(r'<a href="\2">\1</a>', safe))
    return "".join(out)


def _shown(cell: object) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, Mark):
        return cell.text
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float) or hasattr(cell, "dtype"):
        value = float(cell)  # type: ignore[arg-type]
        return number(value) if math.isfinite(value) else "–"
    return str(cell)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _data(cell: object) -> object:
    if isinstance(cell, Mark):
        return {"text": cell.text, "tone": cell.tone}
    if hasattr(cell, "item"):
        cell = cell.item()
    if isinstance(cell, float) and not math.isfinite(cell):
        return None
    return cell if isinstance(cell, bool | int | float | str | None) else str(cell)


def _bytes_of(picture: bytes | Path) -> bytes:
    return picture if isinstance(picture, bytes) else picture.read_bytes()


def _kind_of(data: bytes) -> str:
    if data[:2] == b"\xff\xd8":
        return "jpeg"
    return "webp" if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else "png"


def _data_url(data: bytes) -> str:
    return f"data:image/{_kind_of(data)};base64,{base64.b64encode(data).decode()}"
