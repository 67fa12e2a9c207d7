"""Help on the widget that has the focus, and a question with a few answers."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import OptionList, Static

from openant_tools.tui.choices import Choices
from openant_tools.tui.prose import Prose

__all__ = ["Help", "Question"]


class Help(ModalScreen[None]):
    """A page of Markdown; any of the usual keys closes it."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,enter", "dismiss", "Close", key_display="esc")]

    def __init__(self, words: str) -> None:
        super().__init__()
        self._words = words

    def compose(self) -> ComposeResult:
        with VerticalScroll(id="help"):
            yield Prose(self._words)
            yield Static("Esc closes this page, arrows move in it.", classes="note")


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
