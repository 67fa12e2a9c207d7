"""Help on the widget that has the focus, and a question with a few answers."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Markdown, OptionList, Static

from openant_tools.tui.choices import Choices
from openant_tools.tui.prose import Prose

__all__ = ["Help", "Question"]


#: pages that lie beside a program in its sources; an installed one has none
DOCS = Path(__file__).parents[2] / "docs"


class Help(ModalScreen[None]):
    """A page of Markdown; any of the usual keys closes it. Its links open in here, those to the web in a browser.

    Args:
        doc: the page of docs/ that says more.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,enter", "dismiss", "Close", key_display="esc"),
        Binding("o", "open", "Open its page"),
    ]

    def __init__(self, words: str, doc: str = "") -> None:
        super().__init__()
        self._words, self._doc = words, doc

    def compose(self) -> ComposeResult:
        with VerticalScroll(id="help"):
            yield Prose(self._words)
            keys, name = "Esc closes this page, arrows move in it", f"docs/{self._doc}"
            if self._doc and (DOCS / self._doc).is_file():
                keys += f", o opens [@click=screen.open]{name}[/]"
            elif self._doc:
                keys += f"; more in {name}"
            yield Static(f"{keys}.", classes="note")

    def action_open(self) -> None:
        """Open the page that says more."""
        if self._doc:
            self._follow(self._doc)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        return bool(self._doc) if action == "open" else True

    def on_markdown_link_clicked(self, event: Markdown.LinkClicked) -> None:
        self._follow(event.href)

    def _follow(self, link: str) -> None:
        page = DOCS / link.partition("#")[0]
        if link.startswith(("http://", "https://")):
            self.app.open_url(link)
        elif page.suffix == ".md" and page.is_file():
            self.app.push_screen(Help(page.read_text(encoding="utf-8")))
        elif not link.startswith("#"):
            self.notify(f"this program came without it: docs/{link}", severity="warning")


class Question(ModalScreen[int | None]):
    """Dismissed with the number of the choice, from 0; None for Escape."""

    HELP = """\
# A question

Arrow keys and `Enter` answer it; `Esc` leaves everything as it is.
"""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "dismiss(None)", "No")]

    def __init__(self, words: str, *choices: str) -> None:
        super().__init__()
        self._words, self._offered = words, choices

    def compose(self) -> ComposeResult:
        with Vertical(id="asked"):
            yield Static(self._words)
            yield Choices(*self._offered)

    def on_mount(self) -> None:
        self.query_one(Choices).highlighted = 0

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        if self.app.screen is self:  # a key that was pressed twice answers once
            self.dismiss(event.option_index)
