"""Arena."""

from __future__ import annotations

from openant_tools.procedure.finding import Finding
from openant_tools.procedure.step import Bench, Procedure, Say


def arena(bench: Bench) -> Procedure:
    yield Say("todo")
    return Finding("arena", True, "todo", (), "", "openant calib arena")
