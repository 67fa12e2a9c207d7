"""The robot's recordings; any of them can be played again on every screen."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import ClassVar

from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.widgets import Input, OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.errors import OpenAntError, system_faults
from openant_tools.numbers import number
from openant_tools.robot.folder import RobotFolder
from openant_tools.tui.choices import Choices
from openant_tools.tui.feeds import ReplayFeed
from openant_tools.tui.page import Page

__all__ = ["RecordingsScreen", "runs_of", "when"]

SUFFIXES = (".mcap", ".parquet", ".csv")


def runs_of(folder: RobotFolder | None) -> dict[Path, str]:
    """All that was recorded of a robot, newest first, by what it is called: a policy's after the run that trained it."""
    if folder is None:
        return {}
    found = {path: path.name for path in folder.recordings.rglob("*")}
    found |= {path: f"{path.parts[-3]}/{path.name}" for path in folder.runs.glob("*/recordings/*")}
    made = {path: path.stat().st_mtime for path in found if path.suffix in SUFFIXES}
    return {path: found[path] for path in sorted(made, key=lambda path: made[path], reverse=True)}


def when(stamp: float) -> str:
    """A time in s since 1970 as people read it."""
    return f"{datetime.datetime.fromtimestamp(stamp, datetime.UTC):%d.%m.%Y %H:%M} UTC"


class RecordingsScreen(Page):
    """Choose a recording of the robot's, or name any other run."""

    TITLE = "Recordings"
    DOC = "recordings.md"
    HELP = """\
# Recordings

`Enter` plays a recording as if its robot were here: strips, map and every other screen show it, with the controls of
the replay in the line above the keys. `x` ends the replay.

In the field below, any other run can be named: a recording (`.mcap`) or a table (`.parquet`, `.csv`) of any software
that has the columns of docs/recordings.md.
"""
    BINDINGS: ClassVar[list[BindingType]] = [Binding("n", "name", "Name a file")]

    def body(self) -> ComposeResult:
        with Vertical():
            yield Choices(id="list")
            yield Input(placeholder="n: another run, such as ../logs/walk.parquet", id="path")
            yield Static(id="note", classes="note")

    def on_mount(self) -> None:
        super().on_mount()
        names = runs_of(self.session.folder)
        self._files = list(names)
        chooser = self.query_one("#list", Choices)
        for index, path in enumerate(self._files):
            stat = path.stat()
            size = (
                number(stat.st_size / 1e6, "MB")
                if stat.st_size >= 1e6
                else number(stat.st_size / 1e3, "kB", decimals=0)
            )
            chooser.add_option(Option(Text(f"{names[path]:40.40} {size:>10}  {when(stat.st_mtime)}"), id=str(index)))
        if self._files:
            chooser.highlighted = 0
        else:
            self.note("No recordings yet: `openant sysid record` and the steps of the walk make them.")
        chooser.focus()

    def action_name(self) -> None:
        self.query_one("#path", Input).focus()

    def note(self, words: str) -> None:
        self.query_one("#note", Static).update(words)

    def chosen(self, event: OptionList.OptionSelected) -> None:
        self.play(self._files[event.option_index])

    def on_input_submitted(self, event: Input.Submitted) -> None:
        if event.value.strip():
            self.play(Path(event.value.strip()).expanduser())

    def play(self, path: Path) -> None:
        """Read a run and show it on the live screen."""
        self.note(f"reading {path} ...")
        self._read(path)

    @work(thread=True, exclusive=True, group="read")
    def _read(self, path: Path) -> None:
        from openant_tools.recording.tables import read_run  # it loads pyarrow

        try:
            with system_faults(where=path, again="try again"):
                feed = ReplayFeed(read_run(path, need=("pos",)))
        except OpenAntError as error:
            self.app.call_from_thread(self.note, str(error))
        else:
            self.app.call_from_thread(self.ant.play, feed)
