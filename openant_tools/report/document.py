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
from openant_tools.report.parts import (
    Code,
    Details,
    Figure,
    Files,
    KeyFigure,
    KeyFigures,
    Part,
    Picture,
    Table,
    Text,
    Tone,
    VerdictLine,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["Report", "ReportSummary", "Section"]

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
// On paper nothing can be unfolded, so everything is; and who follows a link to a folded section wants to read it.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(d => d.open = true));
const unfold = () => { const d = document.querySelector((location.hash || "#none") + " > details"); if (d) d.open = true; };
addEventListener("hashchange", unfold); unfold();
</script>
</body>
</html>
""")


@dataclass
class Section:
    """A heading and what stands under it.

    Attributes:
        open: unfolded from the first.
    """

    title: str
    open: bool = False
    parts: list[Part] = field(default_factory=list)


@dataclass(frozen=True)
class ReportSummary:
    """What a report's first screen says, always in this order.

    Attributes:
        verdict: one sentence. tone: how that stands.
        picture: the one picture that shows it; None where it cannot be drawn here.
        figures: the numbers to take away.
        means: what it means for the builder. then: what to do next. Both as `Text`.
    """

    verdict: str
    picture: Part | None
    means: str
    then: str
    tone: Tone = ""
    figures: Sequence[KeyFigure] = ()

    @property
    def parts(self) -> list[Part]:
        found = [VerdictLine(self.verdict, self.tone), self.picture, KeyFigures(self.figures) if self.figures else None]
        found += [Text(f"**What it means.** {self.means}") if self.means else None]
        found += [Text(f"**What to do next.** {self.then}") if self.then else None]
        return [part for part in found if part is not None]


class Report:
    """A report begins with its answer; what is added to it are details, folded section by section.

        Report("Fit of ant12", "stand protocol, 3 runs", ReportSummary(
            "The model leaves 12 % of the error.", Figure(figure, "Held-out run, measured and simulated"), "…", "…", "good"
        )).section("What was found").table(columns, rows).write(folder / "report.html")

    Args:
        title, subtitle: of the whole report.
        answer: its first screen.
        made_by: the command that made it, for the foot.
        recordings: what it was made from, linked there.
    """

    def __init__(
        self,
        title: str,
        subtitle: str,
        answer: ReportSummary,
        *,
        made_by: str = "",
        recordings: Sequence[str | Path] = (),
    ) -> None:
        self.title = title
        self.subtitle = subtitle
        self.answer = answer
        self.sections: list[Section] = []
        self.made_by = made_by
        self.recordings = tuple(recordings)

    def _foot(self, folder: Path | None) -> list[Part]:
        when = datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
        with_ = f" with `{self.made_by}`" if self.made_by else ""
        foot: list[Part] = [Text(f"Made by openant-tools {version('openant-tools')} on {when}{with_}")]
        return [Files("Made from", self.recordings, folder), *foot] if self.recordings else foot

    def section(self, title: str, *, open: bool = False) -> Report:
        """Begin a section, folded unless `open`; what is added next belongs to it."""
        self.sections.append(Section(title, open))
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

    def html(self, folder: Path | None = None) -> str:
        """The report as one HTML page with nothing outside it.

        Args:
            folder: where the page will lie, from which its recordings are linked.
        """
        style = files("openant_tools.report").joinpath("style.css").read_text(encoding="utf-8")
        contents, sections = [], [f'<section id="answer">{_inside(self.answer.parts, "f0")}</section>']
        for number, section in enumerate(self.sections, 1):
            anchor = f"s{number}-{re.sub(r'[^a-z0-9]+', '-', section.title.lower()).strip('-')}".rstrip("-")
            inside = _inside(section.parts, f"f{number}")
            if section.title:
                title = escape(section.title)
                contents.append(f'<li><a href="#{anchor}">{title}</a></li>')
                inside = f"<details{' open' if section.open else ''}><summary><h2>{title}</h2></summary>\n{inside}\n</details>"
            sections.append(f'<section id="{anchor}">{inside}</section>')
        return _PAGE.substitute(
            title=escape(self.title),
            subtitle=Text(self.subtitle).html("subtitle") if self.subtitle else "",
            style=style,
            contents="".join(contents),
            sections="\n".join(sections),
            footer=_inside(self._foot(folder), "foot"),
        )

    def as_json(self) -> dict[str, Any]:
        """The content as data; figures by their captions."""
        return {
            "title": self.title,
            "subtitle": self.subtitle,
            "verdict": self.answer.verdict,
            "made_by": self.made_by,
            "recordings": [str(path) for path in self.recordings],
            "answer": [part.json() for part in self.answer.parts],
            "sections": [
                {"title": section.title, "parts": [part.json() for part in section.parts]} for section in self.sections
            ],
        }

    def write(self, path: str | Path) -> Path:
        """Write the HTML page to `path`, whole or not at all."""
        write_text(path, self.html(Path(path).parent))
        return Path(path)

    def write_markdown(self, path: str | Path) -> Path:
        """Write the Markdown to `path`, its pictures into a folder of the same name beside it."""
        path = Path(path)
        write_text(path, self._markdown(path.parent, f"{path.stem}-figures"))
        return path

    def write_folder(self, folder: str | Path) -> Path:
        """Write report.html, report.md with figures/, and report.json into `folder`; returns the HTML's path."""
        folder = Path(folder)
        write_text(folder / "report.md", self._markdown(folder, "figures"))
        write_text(folder / "report.json", json_text(self.as_json()))
        return self.write(folder / "report.html")

    def _markdown(self, folder: Path, pictures: str) -> str:
        def save(name: str, data: bytes) -> str:
            write_bytes(folder / pictures / name, data)
            return f"{pictures}/{name}"

        blocks = [f"# {self.title}"] + ([self.subtitle] if self.subtitle else [])
        blocks += [part.markdown(f"f0-{k}", save) for k, part in enumerate(self.answer.parts, 1)]
        for number, section in enumerate(self.sections, 1):
            if section.title:
                blocks.append(f"## {section.title}")
            blocks += [part.markdown(f"f{number}-{k}", save) for k, part in enumerate(section.parts, 1)]
        blocks += [part.markdown("foot", save) for part in self._foot(folder)]
        return "\n\n".join(blocks) + "\n"


def _inside(parts: Sequence[Part], key: str) -> str:
    return "\n".join(part.html(f"{key}-{k}") for k, part in enumerate(parts, 1))
