"""A page of Markdown, rendered where the terminal can show it, else as it was written."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.containers import Vertical
from textual.widgets import Markdown, Static

from openant_tools.tui.marks import plain, spelled

__all__ = ["Prose"]


class Prose(Vertical):
    """Text that may be replaced by `show`."""

    DEFAULT_CSS = "Prose { height: auto; } Prose Static { height: auto; padding: 0 1; }"

    def __init__(self, words: str = "", *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._words = words

    def compose(self) -> ComposeResult:
        # Bullets and the rules of tables are drawn with signs that ASCII has not; Markdown reads well as it is.
        yield Static(spelled(self._words), markup=False) if plain() else Markdown(self._words, open_links=False)

    def show(self, words: str) -> None:
        self._words = words
        for page in self.query(Markdown):
            page.update(words)
        if not self.query(Markdown):
            self.query_one(Static).update(spelled(words))
