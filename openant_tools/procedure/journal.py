"""`journal.jsonl` of a robot's folder: every write to a servo's permanent memory, with what stood there before.

A line is on the disk before its write is sent, so that a kill at any moment leaves no change unrecorded; the last line
may then name a write that did not happen, which undoing finds out by reading.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from openant_tools.errors import BadInput
from openant_tools.files import parse_json
from openant_tools.lock import wait_for

__all__ = ["EepromWrite", "Journal", "JournalEntry"]


@dataclass(frozen=True)
class EepromWrite:
    """One change of a servo's permanent memory; counts.

    Attributes:
        id: under which the servo was spoken to, before the write.
        baud: at which rate, bit/s; None in the lines of older versions.
        confirmed: `old` was read twice, in two ways; False in the lines of older versions.
    """

    joint: str
    id: int
    register: str
    old: int
    new: int
    baud: int | None = None
    confirmed: bool = False

    @property
    def id_after(self) -> int:
        return self.new if self.register == "id" else self.id


@dataclass(frozen=True)
class JournalEntry:
    """One line of the journal.

    Attributes:
        number: its line, from 1.
        undoes: the number of the line that it takes back; None for a write of its own.
    """

    number: int
    time: str
    command: str
    write: EepromWrite
    undoes: int | None = None


class Journal:
    """The append-only file. It needs no closing."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, write: EepromWrite, command: str, undoes: int | None = None) -> None:
        """Add a line; on the disk when this returns. `command` is what writes it.

        Raises:
            OSError: the file cannot be written; nothing must then be written to the servo either.
        """
        line: dict[str, Any] = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "command": command}
        line |= asdict(write)
        if undoes is not None:
            line["undoes"] = undoes
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab+") as file:
            wait_for(file)  # until it is closed: two programs' lines follow each other
            # A line torn by a power cut is ended, so that it does not swallow this one.
            torn = file.seek(0, os.SEEK_END) > 0 and _last_byte(file) != b"\n"
            file.write((b"\n" if torn else b"") + json.dumps(line).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())

    def entries(self) -> list[JournalEntry]:
        """All lines in order; torn ones are left out.

        Raises:
            BadInput: a whole line is none of ours.
        """
        try:
            lines = self.path.read_bytes().split(b"\n")
        except FileNotFoundError:
            return []
        found = []
        for number, line in enumerate(lines, 1):
            try:
                content = parse_json(line, self.path)
            except BadInput:
                continue
            try:
                undoes = content.pop("undoes", None)
                entry = JournalEntry(
                    number, content.pop("time"), content.pop("command"), EepromWrite(**content), undoes
                )
            except (KeyError, TypeError, AttributeError):
                raise BadInput(
                    "is no line of the journal", where=f"{self.path}, line {number}", remedy="mend or remove the line"
                ) from None
            found.append(entry)
        return found

    def open_entries(self) -> list[JournalEntry]:
        """The writes that nothing has taken back yet, in order."""
        entries = self.entries()
        gone = {entry.undoes for entry in entries}
        return [entry for entry in entries if entry.undoes is None and entry.number not in gone]


def _last_byte(file: Any) -> bytes:
    file.seek(-1, os.SEEK_END)
    byte: bytes = file.read(1)
    return byte
