"""Where in a run someone or something had to help: what `interventions.csv` says."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from openant_tools.errors import BadInput
from openant_tools.files import read_text, reading

__all__ = ["Intervention", "read_interventions"]


@dataclass(frozen=True)
class Intervention:
    """One help.

    Attributes:
        step: environment steps so far.
        seconds: s, robot time so far.
        reason: in words.
    """

    step: int
    seconds: float
    reason: str


def read_interventions(folder: Path) -> list[Intervention]:
    """The interventions of a run, in order; none where nobody ever had to help.

    Raises:
        BadInput: a row is not what it should be.
    """
    path = folder / "interventions.csv"
    if not path.is_file():
        return []
    with reading(path, "it says nothing of interventions", "name the --out of `openant train`"):
        rows = list(csv.DictReader(io.StringIO(read_text(path))))
    found: list[Intervention] = []
    for number, row in enumerate(rows, start=2):
        try:
            if row["reason"] is None:
                raise ValueError("the row is cut")
            found.append(Intervention(int(row["step"]), float(row["seconds"]), row["reason"]))
        except (KeyError, TypeError, ValueError):
            if number == len(rows) + 1:
                break  # the last line of a run that was killed while writing it
            raise BadInput(f"row {number} is not step, seconds, reason", where=path, remedy="repair the row") from None
    return found
