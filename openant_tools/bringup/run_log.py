"""The log of a training run on a robot: what was said while nobody looked, with the time of day.

    log.csv     time, words: the time in UTC, to the millisecond; appended, through every resumption

What goes wrong with it stops nothing: the robot's words are for people, and what is learned from stands elsewhere.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from openant_tools.errors import BadInput
from openant_tools.files import read_text

__all__ = ["LOG", "LogLine", "add_to_log", "read_log", "whole_rows"]

LOG = "log.csv"

T = TypeVar("T")
Row = TypeVar("Row")


@dataclass(frozen=True)
class LogLine:
    """One line: s since 1970, and what was said."""

    at: float
    words: str


def add_to_log(run: Path, words: str) -> None:
    """Put a line at the end of a run's log, where there is such a folder, and as far as the disk takes it."""
    with contextlib.suppress(OSError), (run / LOG).open("a", encoding="utf-8", newline="") as stream:
        csv.writer(stream).writerow((datetime.now(UTC).isoformat(timespec="milliseconds"), " ".join(words.split())))


def read_log(run: Path) -> tuple[list[LogLine], str]:
    """A run's log, oldest first, none where nothing was ever said; and words on lines that are torn.

    Raises:
        BadInput: no line is what it should be.
    """

    def line(row: list[str]) -> LogLine:
        time, words = row
        return LogLine(datetime.fromisoformat(time).timestamp(), words)

    path = run / LOG
    if not path.is_file():
        return [], ""
    # Line by line, as it was written: a quote that was torn off ends there.
    return whole_rows(path, (row for text in read_text(path).splitlines() for row in csv.reader([text])), line)


def whole_rows(path: Path, rows: Iterable[Row], make: Callable[[Row], T]) -> tuple[list[T], str]:
    """What `make` makes of a file's rows; and words on those that it refuses: a power cut tears the row that is being written.

    Raises:
        BadInput: all of several rows are refused.
    """
    made, torn = list[T](), list[str]()
    for number, row in enumerate(rows, 1):
        try:
            made.append(make(row))
        except (KeyError, TypeError, ValueError):
            torn.append(str(number))
    if len(torn) > 1 and not made:
        raise BadInput("no row is what it should be", where=path, remedy="name the --out of `openant train`")
    return made, f"{path}: {'row' if len(torn) == 1 else 'rows'} {', '.join(torn)} torn, and left out" if torn else ""
