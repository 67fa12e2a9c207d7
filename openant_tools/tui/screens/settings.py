"""The robot's folder, how the program looks, and what this machine has."""

from __future__ import annotations

import importlib.metadata
import locale
import os
import platform
import sys
from pathlib import Path

from rich.text import Text
from textual.app import ComposeResult
from textual.containers import VerticalScroll
from textual.widgets import Input, OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.errors import OpenAntError
from openant_tools.robot.kit import KITS
from openant_tools.tui.choices import Choices
from openant_tools.tui.marks import marked, plain
from openant_tools.tui.page import Page

__all__ = ["SettingsScreen"]


class SettingsScreen(Page):
    """Choose or make a robot's folder; colours; ASCII; facts for a report of a fault."""

    TITLE = "Setup"
    DOC = "robot-folder.md"
    HELP = """\
# Setup

**The robot's folder** holds everything about one robot: `robot.toml`, models, recordings, findings. Name one that is
there, or a new place, and press `Enter`; then choose below whether to open it or to make a new robot in it.

**ASCII** draws without Unicode, for terminals that cannot show it; `OPENANT_ASCII=1` does the same from the start, and
`NO_COLOR=1` leaves colours out. Every state is a glyph and a word besides its colour.
"""

    def body(self) -> ComposeResult:
        with VerticalScroll():
            yield Static("The robot's folder", classes="title")
            yield Input(str(self.session.path), id="path")
            yield Choices(
                Option("Open this folder", id="open"),
                *(Option(f"Make a new robot there: {kit.words}", id=name) for name, kit in KITS.items()),
                Option("Switch between Unicode and plain ASCII", id="ascii"),
                Option("Choose colours", id="theme"),
                id="choices",
            )
            yield Static(id="note")
            yield Static("This machine", classes="title")
            yield Static(_facts(), id="facts")

    def on_mount(self) -> None:
        super().on_mount()
        chooser = self.query_one("#choices", Choices)
        chooser.highlighted = 0
        chooser.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        self.query_one("#choices").focus()

    def chosen(self, event: OptionList.OptionSelected) -> None:
        path = Path(self.query_one("#path", Input).value.strip() or ".").expanduser()
        chosen = event.option_id
        note = self.query_one("#note", Static)
        if chosen == "ascii":
            plain(not plain())
            self.app.set_class(plain(), "-ascii")
            self.refresh(layout=True)
            self.draw()
        elif chosen == "theme":
            self.app.search_themes()
        else:
            try:
                if chosen == "open":
                    self.session.open(path)
                else:
                    self.session.create(path, str(chosen))
            except OpenAntError as error:
                note.update(marked("fail", str(error)))
                return
            found = self.session.folder is not None
            words = "this is the robot now" if found else "there is no robot.toml here yet: make a robot there"
            note.update(marked("ok" if found else "warn", f"{path.resolve()}: {words}"))
            self.draw()


def _facts() -> Text:
    names = ("openant-tools", "textual", "mujoco", "numpy", "pyserial")
    versions = ", ".join(f"{name} {_version(name)}" for name in names)
    terminal = ", ".join(f"{key}={os.environ.get(key, '')}" for key in ("TERM", "COLORTERM", "LANG"))
    return Text(
        f"{versions}\nPython {platform.python_version()} on {platform.platform(terse=True)}, {sys.executable}\n"
        f"{terminal}, encoding {locale.getpreferredencoding(False)}"
    )


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
