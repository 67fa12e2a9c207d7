"""Readings that a builder typed into a file: a CSV with an optional heading, empty lines and # comments."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

from openant_tools.errors import BadInput
from openant_tools.files import read_text

__all__ = ["reading_rows"]


def reading_rows(path: Path, columns: str) -> Iterator[tuple[str, list[str]]]:
    """Where each row stands, for messages, and its cells; `columns` says what the file should hold.

    Raises:
        BadInput: there is no such file, or it is not text.
    """
    try:
        text = read_text(path)
    except FileNotFoundError:
        raise BadInput("there is no such file", where=path) from None
    number = 0
    try:
        for number, row in enumerate(csv.reader(text.splitlines()), 1):
            cells = [cell.strip() for cell in row]
            if any(cells) and not cells[0].startswith("#"):
                yield f"{path}, line {number}", cells
    except csv.Error as error:
        raise BadInput(f"{error}", where=f"{path}, line {number + 1}", remedy=f"a CSV of {columns}") from None
