"""Progress of one piece of work, on stderr."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from openant_tools.cli.log import aside, mention
from openant_tools.numbers import percent
from openant_tools.procedure.step import Answer, Event, Progress, Say
from openant_tools.workers import pass_on

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["BarFace", "progress_bar"]

#: lines that are said of one piece of work where there is no terminal
TOLD = 20


@contextlib.contextmanager
def progress_bar(
    words: str = "", *, remaining: bool = True, console: Console | None = None, lines: bool = False
) -> Iterator[Callable[[float, str], None]]:
    """A bar that goes when the block is left; yields what it is to be told: the share that is done, and words.

    Args:
        words: before anything is told.
        remaining: whether the time left is guessed.
        console: of other lines meanwhile.
        lines: whether a line is said for every twentieth where there is no terminal.
    """
    import rich.progress
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    said = -1
    columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
    if remaining:
        columns.append(TimeRemainingColumn())
    with rich.progress.Progress(*columns, console=console or aside(), transient=True) as bar:
        task = bar.add_task(words, total=1.0)

        def tell(share: float, words: str) -> None:
            nonlocal said
            if lines and not bar.console.is_terminal and int(share * TOLD) > said:
                said = int(share * TOLD)
                mention(f"{percent(share):>5}  {words}")
            bar.update(task, description=words, completed=share)
            pass_on(share, words)

        yield tell


@dataclass(frozen=True)
class BarFace:
    """Shows what asks nothing: its progress on a bar, its words above it.

    Attributes:
        tell: a `progress_bar`'s. console: the bar's.
    """

    tell: Callable[[float, str], None]
    console: Console

    def answer(self, event: Event) -> Answer:
        match event:
            case Progress(share, words):
                self.tell(share or 0.0, words)
            case Say(words):
                self.console.print(words, highlight=False, markup=False)
        return None
