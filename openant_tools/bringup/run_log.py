"""The log of a training run on a robot: what was said while nobody looked, with the time of day.

    log.csv     time, words: the time in UTC, to the millisecond; appended, through every resumption

What goes wrong with it stops nothing: the robot's words are for people, and what is learned from stands elsewhere.
"""

from __future__ import annotations

import contextlib
import csv
import io
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from openant_tools.files import read_text, reading

__all__ = ["LOG", "LogLine", "add_to_log", "read_log"]

LOG = "log.csv"


@dataclass(frozen=True)
class LogLine:
    """One line: s since 1970, and what was said."""

    at: float
    words: str


def add_to_log(run: Path, words: str) -> None:
    """Put a line at the end of a run's log, where there is such a folder, and as far as the disk takes it."""
    with contextlib.suppress(OSError), (run / LOG).open("a", encoding="utf-8", newline="") as stream:
        csv.writer(stream).writerow((datetime.now(UTC).isoformat(timespec="milliseconds"), " ".join(words.split())))


def read_log(run: Path) -> list[LogLine]:
    """A run's log, oldest first; none where nothing was ever said.

    Raises:
        BadInput: a row is not what it should be.
    """
    path = run / LOG
    if not path.is_file():
        return []
    with reading(path, "it is no log of a run", "name the --out of `openant train`"):
        rows = [row for row in csv.reader(io.StringIO(read_text(path))) if row]
        return [LogLine(datetime.fromisoformat(time).timestamp(), words) for time, words in rows]
