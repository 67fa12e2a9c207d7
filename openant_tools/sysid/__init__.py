"""System identification: excitation, fitting, verdicts, the calibrated MJCF.

As a library, for scripts and notebooks: load → check → fit → judge → report (docs/python.md).

    from openant_tools import sysid

    runs = [sysid.load("a.csv"), sysid.load("b.csv")]
    found = sysid.fit(runs, "arm.xml", hold_out=[sysid.load("c.csv")])
    print(sysid.summary(found))
    sysid.report(found, "fit")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from openant_tools.sysid.library import (
        BadInput,
        Finding,
        Gap,
        Identification,
        Judgement,
        Run,
        Value,
        check,
        fit,
        judge,
        load,
        report,
        summary,
    )

__all__ = [
    "BadInput", "Finding", "Gap", "Identification", "Judgement", "Run", "Value", "check", "fit", "judge", "load", "report",
    "summary",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    # Not before it is asked for: whoever wants one module of this room shall not wait for MuJoCo.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("openant_tools.sysid.library"), name)


def __dir__() -> list[str]:
    return list(__all__)
