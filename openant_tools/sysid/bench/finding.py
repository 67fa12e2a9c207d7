"""What a bench procedure leaves behind: evidence with units and sources, a verdict, and what to do next."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from openant_tools.files import write_text
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import RobotFolder

__all__ = ["SCHEMA", "Evidence", "Finding", "keep"]

SCHEMA = "openant.finding/1"


@dataclass(frozen=True)
class Evidence:
    """One number that a finding rests on.

    Attributes:
        value: in `unit`; None where the data do not give it.
        low, high: its 95 % interval where there is one.
        source: the instrument, register, file or formula that it came from.
    """

    name: str
    value: float | None
    unit: str
    source: str
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Finding:
    """The result of one step.

    Attributes:
        step: which procedure, as in the name of its file in `findings/`.
        ok: whether it says yes.
        what: one sentence.
        evidence: the numbers.
        next_action: what the builder should do now; empty where there is nothing to do.
        command: the command that made it.
        parameters: name → value with interval, as in fit.json, so that `openant sysid compare` reads both.
        data: the readings and tables themselves, as JSON has them.
        date: UTC.
    """

    step: str
    ok: bool
    what: str
    evidence: tuple[Evidence, ...]
    next_action: str
    command: str
    parameters: tuple[Evidence, ...] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    date: datetime.datetime = field(default_factory=lambda: datetime.datetime.now(datetime.UTC).replace(microsecond=0))

    def as_json(self) -> dict[str, Any]:
        """As it stands in `findings/`."""
        return {
            "schema": SCHEMA,
            "step": self.step,
            "date": self.date.isoformat().replace("+00:00", "Z"),
            "command": self.command,
            "ok": self.ok,
            "what": self.what,
            "next_action": self.next_action,
            "evidence": [vars(evidence) for evidence in self.evidence],
            "parameters": {
                p.name: {
                    "value": p.value,
                    "low": p.low,
                    "high": p.high,
                    "verdict": "measured",
                    "unit": p.unit,
                    "source": p.source,
                }
                for p in self.parameters
            },
            "data": dict(self.data),
        }


def keep(finding: Finding, folder: RobotFolder, recording: str | None = None) -> Path:
    """Write a finding into a robot's `findings/` and its parameters, below `bench`, into `robot.toml`; returns the file.

    They stand apart from what `openant sysid fit` puts below `identified`: the calibrated model holds the latter, and two
    estimators that disagree are to be seen side by side.
    """
    stamp = finding.date.strftime("%Y%m%dT%H%M%SZ")
    path = folder.findings / f"{finding.step}-{stamp}.json"
    write_text(path, json.dumps(finding.as_json(), indent=1, ensure_ascii=False) + "\n")
    values: dict[str, Any] = {}
    provenance: dict[str, Provenance] = {}
    for p in finding.parameters:
        if p.value is None:
            continue
        name = f"bench.{p.name}"
        values[name] = _short(p.value)
        provenance[name] = Provenance(
            "measured",
            finding.command,
            recording or folder.relative(path),
            finding.date,
            None if p.low is None else _short(p.low),
            None if p.high is None else _short(p.high),
        )
    if values:
        folder.update(values, provenance=provenance)
    return path


def _short(value: float) -> float:
    return float(f"{value:.6g}")
