"""What a procedure leaves behind: evidence with units and sources, a verdict, and what to do next.

A verdict needs figures. It has three states: yes, no with what is wrong, and "cannot judge" with why. None can be had
without its ground: a finding that would say yes beside a figure that is not known says that it cannot judge, and one that
says no without naming what is wrong cannot be built.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from openant_tools.errors import BadInput
from openant_tools.files import json_text, known, read_json, write_text
from openant_tools.numbers import chosen, number, span, stored
from openant_tools.procedure.unfinished import forget

if TYPE_CHECKING:  # a manual that lists the steps opens without NumPy
    from openant_tools.robot.config import Provenance
    from openant_tools.robot.folder import RobotFolder

__all__ = ["SCHEMA", "Evidence", "Finding", "Verdict", "keep", "latest", "together"]

SCHEMA = "openant.finding/1"
Verdict = Literal["ok", "not ok", "cannot judge"]


@dataclass(frozen=True)
class Evidence:
    """One number that a finding rests on.

    Attributes:
        value: in `unit`; None where the data do not give it, which NaN and infinity become.
        low, high: its 95 % interval where there is one.
        source: the instrument, register, file or formula that it came from.
        least, most: between which it is as it should be, in `unit`; None for an end that is free.
    """

    name: str
    value: float | None
    unit: str
    source: str
    low: float | None = None
    high: float | None = None
    least: float | None = None
    most: float | None = None

    def __post_init__(self) -> None:
        for name in ("value", "low", "high"):
            number = getattr(self, name)
            if number is not None and not math.isfinite(number):
                object.__setattr__(self, name, None)

    @property
    def words(self) -> str:
        """The number as it is read, with unit and interval."""
        return number(self.value, self.unit, self.low, self.high, name=self.name)

    @property
    def outside(self) -> bool:
        """Whether it is known, and not as it should be."""
        value = self.value
        return value is not None and not (
            (self.least is None or value >= self.least) and (self.most is None or value <= self.most)
        )

    @property
    def wanted(self) -> str:
        """Between what it is as it should be, in words; "" where nothing is asked of it."""
        ends = [
            f"at {word} {chosen(end, self.unit, name=self.name)}"
            for word, end in (("least", self.least), ("most", self.most))
            if end is not None
        ]
        return span(self.least, self.most, self.unit, name=self.name) if len(ends) == 2 else "".join(ends)


@dataclass(frozen=True)
class Finding:
    """The result of one step.

    Attributes:
        step: which procedure, as in the name of its file in `findings/`.
        ok: True: it says yes; False: no, and `problems` name what is wrong; None: it cannot judge, and `unsure` says why.
        what: one sentence.
        evidence: the numbers that the verdict rests on. With one of them unknown it cannot say yes: whatever `ok` was
            given, it cannot judge then. What the verdict does not rest on belongs into `data`.
        next_action: what the builder should do now; empty where there is nothing to do.
        command: the command that made it.
        parameters: name → value with interval, as in fit.json, so that `openant sysid compare` reads both.
        data: the readings and tables themselves, as JSON has them.
        date: UTC.
        problems: one line each for what is not as it should be, with the joint and what to do about it.
        unsure: one line each for what could not be judged, and why.
        virtual: whether it was found on a virtual robot: it says nothing of the real one.
        stands: whether what later steps take of it (values in robot.toml, recordings) was written and can be used, even
            where it cannot judge all of it.

    Raises:
        ValueError: it says no, or that it cannot judge, and lists nothing.
    """

    step: str
    ok: bool | None
    what: str
    evidence: tuple[Evidence, ...]
    next_action: str
    command: str
    parameters: tuple[Evidence, ...] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    date: datetime.datetime = field(default_factory=lambda: datetime.datetime.now(datetime.UTC).replace(microsecond=0))
    problems: tuple[str, ...] = ()
    unsure: tuple[str, ...] = ()
    virtual: bool = False
    stands: bool = False

    def __post_init__(self) -> None:
        unknown = tuple(f"{e.name} is not known ({e.source})" for e in self.evidence if e.value is None)
        if self.ok is not False and unknown:
            object.__setattr__(self, "unsure", tuple(dict.fromkeys((*self.unsure, *unknown))))
        if self.ok and self.unsure:
            object.__setattr__(self, "ok", None)
        if self.ok is False and not self.problems:
            if not (self.unsure or unknown):
                raise ValueError(f"the finding of {self.step} says no and names nothing that is wrong: {self.what}")
            object.__setattr__(self, "ok", None)
            object.__setattr__(self, "unsure", self.unsure or unknown)
        if self.ok is None and not self.unsure:
            raise ValueError(f"the finding of {self.step} cannot judge and does not say why: {self.what}")

    @property
    def verdict(self) -> Verdict:
        """The three states in words."""
        return "cannot judge" if self.ok is None else "ok" if self.ok else "not ok"

    @property
    def lines(self) -> tuple[str, ...]:
        """What is to be read below the sentence: why it cannot judge, and what is wrong, unless the sentence says it."""
        return tuple(words for words in (*self.unsure, *self.problems) if words != self.what)

    @property
    def serves(self) -> bool:
        """Whether the steps that need it can be done: it says yes, or what they need stands although it cannot judge."""
        return bool(self.ok) or (self.ok is None and self.stands)

    def as_json(self) -> dict[str, Any]:
        """As it stands in `findings/`."""
        return {
            "schema": SCHEMA,
            "step": self.step,
            "date": self.date.isoformat().replace("+00:00", "Z"),
            "command": self.command,
            "ok": self.ok,
            "verdict": self.verdict,
            "what": self.what,
            "unsure": list(self.unsure),
            "problems": list(self.problems),
            "next_action": self.next_action,
            "evidence": [_entry(evidence) for evidence in self.evidence],
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
            "data": known(self.data),
            "virtual": self.virtual,
            "stands": self.stands,
        }

    @classmethod
    def of_json(cls, content: Mapping[str, Any]) -> Finding:
        """The inverse of `as_json`; raises KeyError, TypeError or ValueError on what it did not write."""
        ok, problems = content["ok"], tuple(content.get("problems", ()))
        if ok is False and not problems:
            problems = (str(content["what"]),)  # as they were written before they had to name what is wrong
        return cls(
            step=str(content["step"]),
            ok=None if ok is None else bool(ok),
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
            problems=problems,
            unsure=tuple(content.get("unsure", ())),
            virtual=bool(content.get("virtual", False)),
            stands=bool(content.get("stands", False)),
        )

    def as_markdown(self) -> str:
        """The same for people: the sentence, what is wrong, the numbers, what is next."""
        lines = [f"# {self.step}: {_SIGNS[self.verdict]} {self.verdict}", "", self.what, ""]
        lines += [f"- {words}" for words in self.lines] + [""] * bool(self.lines)
        if self.evidence:
            lines += ["| what | value | source |", "|---|---|---|"]
            lines += [_row(evidence) for evidence in self.evidence] + [""]
        lines += [f"Next: {self.next_action}", ""] if self.next_action else []
        return "\n".join(
            [
                *lines,
                f"{self.date:%Y-%m-%d %H:%M} UTC, `{self.command}`{', on a virtual robot' if self.virtual else ''}",
                "",
            ]
        )


_SIGNS: Mapping[Verdict, str] = {"ok": "✓", "not ok": "✗", "cannot judge": "?"}


def together(*verdicts: bool | None) -> bool | None:
    """What several verdicts come to: no where one says no, else unsure where one is, else yes."""
    return False if False in verdicts else None if None in verdicts else True


def _row(evidence: Evidence) -> str:
    wanted = f"; as it should be: {evidence.wanted}" if evidence.wanted else ""
    return f"| {evidence.name} | {evidence.words} | {evidence.source}{wanted} |"


def _entry(evidence: Evidence) -> dict[str, Any]:
    """As JSON; without ends of a range that nothing is asked of."""
    return {name: value for name, value in vars(evidence).items() if value is not None or name not in ("least", "most")}


def latest(folder: RobotFolder, step: str, *, real: bool = False) -> Finding | None:
    """The newest finding of a step in a robot's `findings/`, or None where it has not been done.

    A file that cannot be read counts as none: the step is then done again.

    Args:
        real: whether what was found on a virtual robot is passed over.
    """
    for path in sorted(folder.findings.glob(f"{step}-2*.json"), reverse=True):
        try:
            finding = Finding.of_json(read_json(path))
        except (OSError, BadInput, ValueError, KeyError, TypeError, AttributeError):
            continue
        if finding.step == step and not (real and finding.virtual):
            return finding
    return None


def keep(finding: Finding, folder: RobotFolder, recording: str | None = None, *, virtual: bool = False) -> Path:
    """Write a finding into a robot's `findings/`, as JSON and Markdown, and its parameters, below `bench`, into
    `robot.toml`; returns the JSON's path.

    They stand apart from what `openant sysid fit` puts below `identified`: the calibrated model holds the latter, and two
    estimators that disagree are to be seen side by side.

    Raises:
        BadInput: another program works on the robot; it is named.
    """
    from openant_tools.robot.config import Provenance

    folder.refuse_if_held()
    finding = replace(finding, virtual=virtual)
    if finding.ok:
        forget(folder, finding.step, virtual=virtual)
    stamp = finding.date.strftime("%Y%m%dT%H%M%SZ")
    path = folder.findings / f"{finding.step}-{stamp}.json"
    write_text(path, json_text(finding.as_json()))
    write_text(path.with_suffix(".md"), finding.as_markdown())
    values: dict[str, Any] = {}
    provenance: dict[str, Provenance] = {}
    for p in finding.parameters:
        if p.value is None:
            continue
        name = f"bench.{p.name}"
        values[name] = stored(p.value)
        provenance[name] = Provenance(
            "measured",
            finding.command,
            recording or folder.relative(path),
            finding.date,
            None if p.low is None else stored(p.low),
            None if p.high is None else stored(p.high),
        )
    if values:
        folder.update(values, provenance=provenance)
    return path
