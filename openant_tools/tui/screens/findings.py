"""Everything that was found out about this robot, newest first, and its passport."""

from __future__ import annotations

from pathlib import Path

from rich.text import Text
from textual.app import ComposeResult
from textual.containers import Horizontal, VerticalScroll
from textual.widgets import OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.bringup.walk import WALK
from openant_tools.errors import BadInput
from openant_tools.files import parse_json, read_text
from openant_tools.procedure.finding import Finding
from openant_tools.tui.choices import Choices
from openant_tools.tui.found import finding_lines
from openant_tools.tui.marks import MARKS, mark, marked
from openant_tools.tui.page import Page
from openant_tools.tui.prose import Prose

__all__ = ["FindingsScreen"]

#: columns of the list, and those that the chosen one does not have: its margins and a scroll bar
LIST, MARGINS = 25, 3

NONE_YET = (
    "Nothing found yet.\n\nEach step of the walk leaves a finding here: one sentence, the numbers it rests on, and what "
    "to do next. The same stands in the robot's folder as JSON and Markdown."
)


class FindingsScreen(Page):
    """The list on the left, the chosen one on the right."""

    TITLE = "Findings"
    DOC = "robot-folder.md"
    HELP = """\
# Findings and passport

A finding is one sentence, the numbers that it rests on with their units and sources, and the next action. They are
kept in the robot's `findings/`, one a run of a step. The passport is the page that gathers them.
"""

    #: the one that is laid out, where it is no page of prose
    _shown: Finding | None = None

    def body(self) -> ComposeResult:
        with Horizontal():
            yield Choices(id="list")
            with VerticalScroll(can_focus=True):
                yield Static(id="finding")
                yield Prose(id="passport")

    def on_mount(self) -> None:
        super().on_mount()
        self._files = self._find()
        chooser = self.query_one("#list", Choices)
        for number, path in enumerate(self._files):
            chooser.add_option(Option(_option(path), id=str(number)))
        if self._files:
            chooser.highlighted = 0
        else:
            self.query_one("#finding", Static).update(NONE_YET)
        chooser.focus()

    def _find(self) -> list[Path]:
        folder = self.session.folder
        if folder is None:
            return []
        passport = folder.passport.with_suffix(".md")
        # Of fits and comparisons their figures alone lie there: what people read of a finding lies beside it.
        read = [path for path in folder.findings.glob("*-2*.json") if path.with_suffix(".md").is_file()]
        found = sorted(read, key=lambda path: path.stem.rpartition("-")[2], reverse=True)
        if not passport.is_file():
            return found
        # The page says what each finding of its making said.
        return [passport, *(path for path in found if not path.name.startswith("passport-"))]

    def on_option_list_option_highlighted(self, event: OptionList.OptionHighlighted) -> None:
        path = self._files[event.option_index]
        prose, finding = self.query_one(Prose), self.query_one("#finding", Static)
        self._shown = None
        prose.display = path.suffix == ".md"
        finding.display = not prose.display
        try:
            content = read_text(path)
            if prose.display:
                prose.show(content)
            else:
                self._shown = Finding.of_json(parse_json(content, path))
                self._lay_out()
        except (OSError, BadInput, ValueError, KeyError, TypeError, AttributeError) as error:
            prose.display, finding.display = False, True
            finding.update(marked("fail", f"{path} cannot be read: {error}"))

    def on_resize(self) -> None:
        super().on_resize()
        self._lay_out()

    def _lay_out(self) -> None:
        """Show the chosen finding in the columns that there are."""
        if self._shown is not None:
            place = self.query_one("#finding", Static)
            beside = self.query_one("#list").outer_size.width or LIST
            place.update(_page(self._shown, self.size.width - beside - MARGINS))


def _page(finding: Finding, width: int) -> Text:
    head = Text(f"{_title(finding.step)}\n", style="bold")
    text = Text("\n").join([head, *finding_lines(finding, width)])
    where = ", on a virtual robot" if finding.virtual else ""
    return text.append(f"\n\n{finding.date:%Y-%m-%d %H:%M} UTC, {finding.command}{where}")


def _title(step: str) -> str:
    return WALK[step].title if step in WALK else step


def _option(path: Path) -> Text:
    if path.stem == "passport":
        return Text(f"{mark('info')} Passport", style="bold")
    step, _, stamp = path.stem.rpartition("-")
    day = f"{stamp[6:8]}.{stamp[4:6]}. {stamp[9:11]}:{stamp[11:13]}" if len(stamp) >= 13 else stamp
    return Text(_title(step)).append(f"\n{day}", MARKS["todo"].colour)
