"""What a procedure leaves behind: evidence with units and sources, a verdict, and what to do next."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from openant_tools.files import write_text

if TYPE_CHECKING:  # a manual that lists the steps opens without NumPy
    from openant_tools.robot.config import Provenance
    from openant_tools.robot.folder import RobotFolder

__all__ = ["SCHEMA", "Evidence", "Finding", "keep", "latest"]

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
        problems: one line each for what is not as it should be, with the joint and what to do about it.
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
    problems: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """As it stands in `findings/`."""
        return {
            "schema": SCHEMA,
            "step": self.step,
            "date": self.date.isoformat().replace("+00:00", "Z"),
            "command": self.command,
            "ok": self.ok,
            "what": self.what,
            "problems": list(self.problems),
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

    @classmethod
    def of_json(cls, content: Mapping[str, Any]) -> Finding:
        """The inverse of `as_json`; raises KeyError, TypeError or ValueError on what it did not write."""
        return cls(
            step=str(content["step"]),
            ok=bool(content["ok"]),
            what=str(content["what"]),
            evidence=tuple(Evidence(**entry) for entry in content["evidence"]),
            next_action=str(content["next_action"]),
            command=str(content["command"]),
            parameters=tuple(
                Evidence(name, p["value"], p["unit"], p["source"], p["low"], p["high"])
                for name, p in content["parameters"].items()
            ),
            data=content["data"],
            date=datetime.datetime.fromisoformat(str(content["date"])),
            problems=tuple(content.get("problems", ())),
        )

    def as_markdown(self) -> str:
        """The same for people: the sentence, what is wrong, the numbers, what is next."""
        lines = [f"# {self.step}: {'✓ ok' if self.ok else '✗ not ok'}", "", self.what, ""]
        lines += [f"- {problem}" for problem in self.problems] + [""] * bool(self.problems)
        if self.evidence:
            lines += ["| what | value | interval | unit | source |", "|---|---|---|---|---|"]
            lines += [_row(evidence) for evidence in self.evidence] + [""]
        lines += [f"Next: {self.next_action}", ""] if self.next_action else []
        return "\n".join([*lines, f"{self.date:%Y-%m-%d %H:%M} UTC, `{self.command}`", ""])


def _row(evidence: Evidence) -> str:
    value = "–" if evidence.value is None else f"{evidence.value:.5g}"
    interval = "" if evidence.low is None or evidence.high is None else f"{evidence.low:.4g} … {evidence.high:.4g}"
    return f"| {evidence.name} | {value} | {interval} | {evidence.unit} | {evidence.source} |"


def latest(folder: RobotFolder, step: str) -> Finding | None:
    """The newest finding of a step in a robot's `findings/`, or None where it has not been done.

    A file that cannot be read counts as none: the step is then done again.
    """
    for path in sorted(folder.findings.glob(f"{step}-2*.json"), reverse=True):
        try:
            finding = Finding.of_json(json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
        if finding.step == step:
            return finding
    return None


def keep(finding: Finding, folder: RobotFolder, recording: str | None = None) -> Path:
    """Write a finding into a robot's `findings/`, as JSON and Markdown, and its parameters, below `bench`, into
    `robot.toml`; returns the JSON's path.

    They stand apart from what `openant sysid fit` puts below `identified`: the calibrated model holds the latter, and two
    estimators that disagree are to be seen side by side.
    """
    from openant_tools.robot.config import Provenance

    stamp = finding.date.strftime("%Y%m%dT%H%M%SZ")
    path = folder.findings / f"{finding.step}-{stamp}.json"
    write_text(path, json.dumps(finding.as_json(), indent=1, ensure_ascii=False) + "\n")
    write_text(path.with_suffix(".md"), finding.as_markdown())
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
