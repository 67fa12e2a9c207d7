"""A report: title, sections and their parts, written as one HTML file that needs no network, as Markdown, as JSON."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from html import escape
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from openant_tools.files import json_text, write_bytes, write_text
from openant_tools.report.parts import Code, Details, Figure, KeyFigure, KeyFigures, Part, Picture, Table, Text

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["Report", "Section"]

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:">
<title>$title</title>
<style>
$style
</style>
</head>
<body>
<nav aria-label="Contents"><b>$title</b><ol>$contents</ol></nav>
<main>
<header><h1>$title</h1>$subtitle</header>
$sections
<footer>$footer</footer>
</main>
<script>
// On paper nothing can be unfolded, so everything is.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(d => d.open = true));
</script>
</body>
</html>
""")


@dataclass
class Section:
    """A heading and what stands under it."""

    title: str
    parts: list[Part] = field(default_factory=list)


class Report:
    """Builds a report part by part; every method returns the report, so that calls can be chained.

        Report("Fit of ant12", "stand protocol, 3 runs").section("Result").key_figures(
            KeyFigure("position gap", "0.021 rad", "0.083 before", "good")
        ).figure(figure, "Held-out run, measured and simulated").write(folder / "report.html")

    Args:
        title, subtitle: of the whole report.
        made_by: the command that made it, for the foot.
    """

    def __init__(self, title: str, subtitle: str = "", *, made_by: str = "") -> None:
        self.title = title
        self.subtitle = subtitle
        self.sections: list[Section] = []
        when = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
        self._footer = f"Made by openant-tools {version('openant-tools')} on {when}"
        if made_by:
            self._footer += f" with `{made_by}`"

    def section(self, title: str) -> Report:
        """Begin a section; what is added next belongs to it."""
        self.sections.append(Section(title))
        return self

    def add(self, *parts: Part) -> Report:
        """Add parts to the section begun last."""
        if not self.sections:
            self.sections.append(Section(""))
        self.sections[-1].parts.extend(parts)
        return self

    def text(self, text: str) -> Report:
        """Add paragraphs; see `Text`."""
        return self.add(Text(text))

    def code(self, text: str) -> Report:
        """Add commands or file content."""
        return self.add(Code(text))

    def key_figures(self, *figures: KeyFigure) -> Report:
        """Add a row of numbers to take away."""
        return self.add(KeyFigures(figures))

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[object]], caption: str = "") -> Report:
        """Add a table; see `Table`."""
        return self.add(Table(columns, rows, caption))

    def figure(self, figure: MatplotlibFigure, caption: str, alt: str = "") -> Report:
        """Add a plot; see `Figure`."""
        return self.add(Figure(figure, caption, alt))

    def picture(self, data: bytes | Path, caption: str, alt: str = "") -> Report:
        """Add a PNG or JPEG."""
        return self.add(Picture(data, caption, alt))

    def details(self, summary: str, *parts: Part) -> Report:
        """Add parts that stay folded until asked for."""
        return self.add(Details(summary, parts))

    def html(self) -> str:
        """The report as one HTML page with nothing outside it."""
        style = files("openant_tools.report").joinpath("style.css").read_text(encoding="utf-8")
        contents, sections = [], []
        for number, section in enumerate(self.sections, 1):
            anchor = f"s{number}-{re.sub(r'[^a-z0-9]+', '-', section.title.lower()).strip('-')}".rstrip("-")
            heading = ""
            if section.title:
                contents.append(f'<li><a href="#{anchor}">{escape(section.title)}</a></li>')
                heading = f"<h2>{escape(section.title)}</h2>"
            inside = "\n".join(part.html(f"f{number}-{k}") for k, part in enumerate(section.parts, 1))
            sections.append(f'<section id="{anchor}">{heading}\n{inside}\n</section>')
        return _PAGE.substitute(
            title=escape(self.title),
            subtitle=Text(self.subtitle).html("subtitle") if self.subtitle else "",
            style=style,
            contents="".join(contents),
            sections="\n".join(sections),
            footer=Text(self._footer).html("footer"),
        )

    def as_json(self) -> dict[str, Any]:
        """The content as data; figures by their captions."""
        return {
            "title": self.title,
            "subtitle": self.subtitle,
            "made": self._footer,
            "sections": [
                {"title": section.title, "parts": [part.json() for part in section.parts]} for section in self.sections
            ],
        }

    def write(self, path: str | Path) -> Path:
        """Write the HTML page to `path`, whole or not at all."""
        write_text(path, self.html())
        return Path(path)

    def write_markdown(self, path: str | Path) -> Path:
        """Write the Markdown to `path`, its pictures into a folder of the same name beside it."""
        path = Path(path)
        pictures = f"{path.stem}-figures"

        def save(name: str, data: bytes) -> str:
            write_bytes(path.parent / pictures / name, data)
            return f"{pictures}/{name}"

        write_text(path, self._markdown(save))
        return path

    def write_folder(self, folder: str | Path) -> Path:
        """Write report.html, report.md with figures/, and report.json into `folder`; returns the HTML's path."""
        folder = Path(folder)

        def save(name: str, data: bytes) -> str:
            write_bytes(folder / "figures" / name, data)
            return f"figures/{name}"

        write_text(folder / "report.md", self._markdown(save))
        write_text(folder / "report.json", json_text(self.as_json()))
        return self.write(folder / "report.html")

    def _markdown(self, save: Any) -> str:
        blocks = [f"# {self.title}"] + ([self.subtitle] if self.subtitle else [])
        for number, section in enumerate(self.sections, 1):
            if section.title:
                blocks.append(f"## {section.title}")
            blocks += [part.markdown(f"f{number}-{k}", save) for k, part in enumerate(section.parts, 1)]
        return "\n\n".join([*blocks, f"*{self._footer}*"]) + "\n"
