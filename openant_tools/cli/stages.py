"""What commands show that are made of stages: a line each on stderr, with a bar while it is done."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import TYPE_CHECKING

from openant_tools.cli.log import aside
from openant_tools.numbers import number

if TYPE_CHECKING:
    from openant_tools.bringup.stages import Stage, StagedFolder

__all__ = ["StageLines"]


class StageLines:
    """The lines of one command; left by an error, it says what the stage's command said last.

    Args:
        whole: where the stages are done.
        stages: as far as they are known, for the widths of columns.
    """

    def __init__(self, whole: StagedFolder, stages: Sequence[Stage]) -> None:

        self.console = aside(highlight=False)
        self.began = time.monotonic()
        self._whole = whole
        self._name = max(len(stage.name) for stage in stages)
        self._words = max(len(stage.words) for stage in stages) + 2

    def __enter__(self) -> StageLines:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        from rich.markup import escape

        from openant_tools.bringup.stages import StageFailed

        if isinstance(error, StageFailed):
            self.say(escape(error.said))
        elif isinstance(error, KeyboardInterrupt):
            self.say(f"stopped; the same command goes on from here (in {escape(str(self._whole.folder))})")

    def say(self, line: str) -> None:
        """A line of its own, with Rich's markup."""
        self.console.print(line, soft_wrap=True)

    def do(self, stage: Stage, place: int, count: int) -> None:
        """Do a stage, or say that it stands.

        Args:
            place, count: the how manieth of how many it is.

        Raises:
            StageFailed, KeyboardInterrupt: as `StagedFolder.run`.
        """
        line = self._line(stage.name, stage.words, place, count)
        if self._whole.stands(stage):
            self.say(f"{line} stands already")
            return
        with self._timed(line) as tell:
            self._whole.run(stage, tell)

    @contextlib.contextmanager
    def step(self, name: str, words: str, place: int, count: int) -> Iterator[None]:
        """A step that is no command: its line, and how long it took."""
        with self._timed(self._line(name, words, place, count)):
            yield

    def _line(self, name: str, words: str, place: int, count: int) -> str:
        from rich.markup import escape

        return f"[bold]{place:{len(str(count))}}/{count} {name:{self._name}}[/bold] {escape(words):{self._words}}"

    @contextlib.contextmanager
    def _timed(self, line: str) -> Iterator[Callable[[float, str], None]]:
        since = time.monotonic()
        with _bar(self, line) as tell:
            yield tell
        self.say(f"{line} [green]done[/green], {number(time.monotonic() - since, 's', decimals=0)}")


@contextlib.contextmanager
def _bar(lines: StageLines, line: str) -> Iterator[Callable[[float, str], None]]:
    """A stage's line with a bar of its own below, which goes when the stage is done; yields what is told how far it is."""
    from rich.console import Group
    from rich.live import Live
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.text import Text

    columns = (TextColumn("   "), BarColumn(28), TimeElapsedColumn(), TextColumn("{task.description}"))
    bar = Progress(*columns, console=lines.console)
    task = bar.add_task("", total=1.0)
    with Live(Group(Text.from_markup(line), bar), console=lines.console, transient=True):
        yield lambda share, words: bar.update(task, completed=share, description=escape(words))
