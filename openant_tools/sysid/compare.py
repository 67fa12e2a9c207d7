"""Two identifications side by side: what changed by more than chance.

The difference of two independent estimates has the interval that follows from theirs by the method of variance estimates
recovery (Zou and Donner 2008, Statistics in Medicine 27): with d = b − a,

    low = d − √((b − b_low)² + (a_high − a)²),   high = d + √((b_high − b)² + (a − a_low)²),

which keeps what is lopsided about them. The probability of such a difference by chance comes from the side that faces zero,
as of a normal distribution. A robot has some fifty parameters, two or three of which differ "significantly" by chance: Holm's
step-down procedure holds the probability that *any* parameter is wrongly called changed at 5 %.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number
from openant_tools.sysid.intervals import TWO_SIDED_95
from openant_tools.sysid.kinds import said

__all__ = ["FAMILY_ERROR", "Change", "Comparison", "Estimate", "Snapshot", "chance", "compare", "holm"]

#: probability that anything at all is called changed where nothing has
FAMILY_ERROR = 0.05
#: verdicts of fit.json under which a value is no statement of the data
_SILENT = {
    "not in the data": "the data of {} do not determine it",
    "fell back": "in {} it fell back to the given model",
}

Status = Literal["changed", "same", "not comparable"]


@dataclass(frozen=True)
class Estimate:
    """One parameter of one snapshot: value and 95 % interval in `unit`, whose it is, and what the fit said of it."""

    value: float
    low: float | None
    high: float | None
    unit: str
    verdict: str = "measured"
    joints: tuple[str, ...] = ()
    date: datetime.datetime | None = None


@dataclass(frozen=True)
class Snapshot:
    """A robot as it was identified once.

    Attributes:
        name: for tables and plots.
        parameters: `kind.joint` → estimate.
        runs: the recordings it rests on, where they are known.
    """

    name: str
    parameters: Mapping[str, Estimate]
    runs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Change:
    """One parameter in both snapshots.

    Attributes:
        difference, low, high: b − a and its 95 % interval; NaN where not comparable.
        p: of such a difference by chance, this parameter alone; p_holm: among all that were compared.
        why: why it is not comparable, or what weakens the comparison.
    """

    name: str
    unit: str
    a: Estimate
    b: Estimate
    difference: float
    low: float
    high: float
    p: float
    p_holm: float
    status: Status
    why: str = ""

    @property
    def kind(self) -> str:
        return self.name.partition(".")[0]

    @property
    def joints(self) -> tuple[str, ...]:
        return self.b.joints or self.a.joints or tuple(filter(None, [self.name.partition(".")[2]]))


@dataclass(frozen=True)
class Comparison:
    """All parameters of two snapshots.

    Attributes:
        changes: what stands in both, in the order of the first.
        only_a, only_b: names that stand in one alone.
        notes: what a reader should know.
    """

    a: Snapshot
    b: Snapshot
    changes: tuple[Change, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def changed(self) -> tuple[Change, ...]:
        return tuple(change for change in self.changes if change.status == "changed")

    @property
    def compared(self) -> tuple[Change, ...]:
        return tuple(change for change in self.changes if change.status != "not comparable")

    @property
    def joints_changed(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(joint for change in self.changed for joint in change.joints))

    @property
    def sentence(self) -> str:
        """What to take away."""
        if not self.changed:
            return f"Nothing changed beyond chance, of {len(self.compared)} parameters compared."
        shown = ", ".join(f"{said(c.name)} ({_percent(c)})" for c in self.changed)
        where = f" at {', '.join(self.joints_changed)}" if self.joints_changed else ""
        return f"Changed beyond chance{where}: {shown}; {len(self.compared)} parameters were compared."

    def as_json(self) -> dict[str, Any]:
        """The comparison as data."""
        return {
            "schema": "openant.comparison/1",
            "a": self.a.name,
            "b": self.b.name,
            "what": self.sentence,
            "changed": [change.name for change in self.changed],
            "joints_changed": list(self.joints_changed),
            "family_error": FAMILY_ERROR,
            "multiple_comparisons": "Holm, over all parameters compared",
            "parameters": {
                change.name: {
                    "status": change.status,
                    "unit": change.unit,
                    "a": _as_json(change.a),
                    "b": _as_json(change.b),
                    "difference": _finite(change.difference),
                    "low": _finite(change.low),
                    "high": _finite(change.high),
                    "p": _finite(change.p),
                    "p_holm": _finite(change.p_holm),
                    "why": change.why,
                }
                for change in self.changes
            },
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
            "notes": list(self.notes),
        }


def _as_json(estimate: Estimate) -> dict[str, Any]:
    date = None if estimate.date is None else estimate.date.isoformat()
    return {
        "value": estimate.value, "low": estimate.low, "high": estimate.high, "verdict": estimate.verdict, "date": date,
    }  # fmt: skip


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _percent(change: Change) -> str:
    if not change.a.value:
        return number(change.difference, change.unit, sign=True)
    return number(change.difference / abs(change.a.value), "share", sign=True, decimals=0)


def compare(a: Snapshot, b: Snapshot) -> Comparison:
    """What differs between two snapshots.

    Raises:
        BadInput: they have no parameter in common.
    """
    in_a, in_b = _untied(a.parameters, b.parameters), _untied(b.parameters, a.parameters)
    common = [name for name in in_a if name in in_b]
    if not common:
        raise BadInput(
            f"{a.name} and {b.name} have no parameter in common",
            remedy="compare fits of the same joints and kinds of parameters",
        )
    raw = [_difference(name, in_a[name], in_b[name], a.name, b.name) for name in common]
    tested = [change for change in raw if change.status != "not comparable"]
    adjusted = dict(zip((change.name for change in tested), holm([change.p for change in tested]), strict=True))
    changes = tuple(_judged(change, adjusted.get(change.name)) for change in raw)
    return Comparison(
        a,
        b,
        changes,
        tuple(name for name in in_a if name not in in_b),
        tuple(name for name in in_b if name not in in_a),
        _notes(a, b, changes),
    )


def chance(p: float) -> str:
    """A probability of such a difference by chance, as it is read."""
    return "below 0.001" if p < 1e-3 else number(p, decimals=3)


def holm(p: Sequence[float]) -> list[float]:
    """Probabilities adjusted by Holm's step-down procedure, which asks nothing of how the tests hang together."""
    order = sorted(range(len(p)), key=lambda k: p[k])
    out = [1.0] * len(p)
    highest = 0.0
    for rank, k in enumerate(order):
        highest = max(highest, min(1.0, (len(p) - rank) * p[k]))
        out[k] = highest
    return out


def _untied(own: Mapping[str, Estimate], other: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Parameters by name; one that is tied over joints here, and is not so there, stands for each of its joints."""
    out: dict[str, Estimate] = {}
    for name, estimate in own.items():
        kind, _, label = name.partition(".")
        if name in other or label in estimate.joints or not estimate.joints:
            out[name] = estimate
        else:
            out.update((f"{kind}.{joint}", estimate) for joint in estimate.joints)
    return out


def _difference(name: str, a: Estimate, b: Estimate, name_a: str, name_b: str) -> Change:
    nan = math.nan

    def refused(why: str) -> Change:
        return Change(name, b.unit, a, b, nan, nan, nan, nan, nan, "not comparable", why)

    for estimate, whose in ((a, name_a), (b, name_b)):
        if estimate.verdict in _SILENT:
            return refused(_SILENT[estimate.verdict].format(whose))
    if a.unit and b.unit and a.unit != b.unit:
        return refused(f"units differ: {a.unit} and {b.unit}")
    if a.date is not None and a.date == b.date and a.value == b.value:
        return refused("it was not measured anew in between")
    if a.low is None or a.high is None or b.low is None or b.high is None:
        return refused("one of them has no interval")
    difference = b.value - a.value
    # Negative where an estimate lies outside its own interval, which rounding can do: it has no side there.
    a_below, a_above = max(0.0, a.value - a.low), max(0.0, a.high - a.value)
    b_below, b_above = max(0.0, b.value - b.low), max(0.0, b.high - b.value)
    down, up = math.hypot(b_below, a_above), math.hypot(b_above, a_below)
    facing = down if difference > 0 else up
    if not facing > 0:
        facing = max(down, up)
    if not (facing > 0 and math.isfinite(facing)):
        return refused("their intervals are empty")
    p = math.erfc(TWO_SIDED_95 * abs(difference) / facing / math.sqrt(2))
    weak = [whose for estimate, whose in ((a, name_a), (b, name_b)) if estimate.verdict in ("weak", "tied")]
    why = (
        f"weak in {' and '.join(weak)}: it leans on its prior, so that a change shows smaller than it is"
        if weak
        else ""
    )
    unit = b.unit or a.unit
    return Change(name, unit, a, b, difference, difference - down, difference + up, p, nan, "same", why)


def _judged(change: Change, p_holm: float | None) -> Change:
    if p_holm is None:
        return change
    status: Status = "changed" if p_holm < FAMILY_ERROR else "same"
    return Change(
        change.name, change.unit, change.a, change.b, change.difference, change.low, change.high, change.p, p_holm, status,
        change.why,
    )  # fmt: skip


def _notes(a: Snapshot, b: Snapshot, changes: Sequence[Change]) -> tuple[str, ...]:
    notes = []
    shared = sorted(set(a.runs) & set(b.runs))
    if shared:
        notes.append(
            f"Both rest on {', '.join(shared)}: their errors are not independent, so that differences look surer or less sure "
            "than they are."
        )
    tempting = [said(c.name) for c in changes if c.status == "same" and c.p < FAMILY_ERROR]
    if tempting:
        notes.append(
            f"{', '.join(tempting)} would differ if looked at alone (p < {exact(FAMILY_ERROR)}); among so many parameters that is "
            "expected. Record again to decide."
        )
    if all(change.status == "not comparable" for change in changes):
        notes.append("Nothing could be compared: see why at each parameter.")
    return tuple(notes)
