"""Progress of one piece of work, on stderr."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from openant_tools.workers import pass_on

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["progress_bar"]


@contextlib.contextmanager
def progress_bar(
    words: str = "", *, remaining: bool = True, console: Console | None = None
) -> Iterator[Callable[[str, float], None]]:
    """A bar that goes when the block is left; yields what it is to be told: words, and the share that is done.

    Args:
        words: before anything is told.
        remaining: whether the time left is guessed.
        console: of other lines meanwhile.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
    if remaining:
        columns.append(TimeRemainingColumn())
    with Progress(*columns, console=console or Console(stderr=True), transient=True) as bar:
        task = bar.add_task(words, total=1.0)

        def tell(words: str, share: float) -> None:
            bar.update(task, description=words, completed=share)
            pass_on(words, share)

        yield tell
