"""Verdicts against answers: the table of the benchmark, with intervals, and everything that went wrong.

Only `read` opens the answers, and unless asked for less only once every robot has its verdict.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openant_tools.blind.answers import read_answers
from openant_tools.blind.by_command import as_named_here, label_of
from openant_tools.blind.draw import BATCH, BUS, ELSEWHERE, OUTSIDE, Answer
from openant_tools.blind.run import folders_of, verdict_path
from openant_tools.blind.sizes import KINDS
from openant_tools.errors import BadInput
from openant_tools.files import read_json, read_toml, reading
from openant_tools.numbers import number
from openant_tools.procedure.intervals import wilson

__all__ = ["Case", "Row", "Score", "read", "score"]

#: verdicts that give no name
UNNAMED = ("none", "unexplained", "ambiguous")
#: what joint positions do not show, so that no closure of their gap can be asked for
_OFF_POSITION = frozenset({"imu_misalignment", "imu_bias", "tracker_scale"})


@dataclass(frozen=True)
class Case:
    """One robot: what is true, and what was said."""

    robot: str
    answer: Answer
    said: Mapping[str, Any]

    @property
    def maker(self) -> str:
        """What its maker is called above its column."""
        here = {BATCH: "batch", BUS: "bus"}
        return here.get(self.answer.maker) or label_of(self.answer.maker)

    @property
    def verdict(self) -> str:
        return str(self.said.get("verdict"))

    @property
    def named(self) -> bool:
        """Whether it was given the name of an effect."""
        return self.verdict not in (*UNNAMED, "None")

    @property
    def order(self) -> list[str]:
        """Names as they were ranked, the verdict first where it is one."""
        first = [self.verdict] if self.named else []
        return list(dict.fromkeys(first + [str(one["effect"]) for one in self.said.get("effects", [])]))

    @property
    def true(self) -> tuple[str, ...]:
        return tuple(drawn.effect for drawn in self.answer.effects)

    @property
    def right(self) -> bool:
        """The right name first; `none` where nothing is wrong."""
        return self.verdict in self.true if self.true else self.verdict == "none"

    @property
    def right_or_class(self) -> bool:
        """Right, or ambiguous within a class that holds the truth."""
        sets = self.said.get("ambiguous_with", [])
        return self.right or (self.verdict == "ambiguous" and any(set(self.true) & set(one) for one in sets))

    @property
    def large(self) -> bool:
        return all(drawn.size != "small" for drawn in self.answer.effects)

    @property
    def seconds(self) -> float:
        return float(self.said.get("blind", {}).get("seconds", math.nan))


@dataclass(frozen=True)
class Row:
    """One line of the table: k of n, or a figure of n; what is asked for first and then."""

    words: str
    n: int
    k: int | None
    value: float | None
    first: float
    then: float
    fewer: bool = False
    unit: str = ""

    @property
    def figure(self) -> float | None:
        return self.value if self.k is None else self.k / self.n if self.n else None

    @property
    def reached(self) -> str:
        """Which of the two marks it reaches."""
        if self.figure is None:
            return "not measured"
        sign = -1 if self.fewer else 1
        for name, mark in (("then", self.then), ("first", self.first)):
            if sign * self.figure >= sign * mark - 1e-12:
                return name
        return "below"

    def as_json(self) -> dict[str, Any]:
        low, high = wilson(self.k, self.n) if self.k is not None else (None, None)
        return {
            "what": self.words, "n": self.n, "k": self.k, "value": self.figure, "low": low, "high": high,
            "first": self.first, "then": self.then, "reached": self.reached,
        }  # fmt: skip


@dataclass(frozen=True)
class Score:
    """What one set showed, or several together.

    Attributes:
        sets: the facts of each.
        makers: maker → the rows of its robots alone, the same of each.
        confusions: (truth, verdict) → how often, medium and large single effects, none and outside.
        reliability: (low, high, mean stated probability, present, count) of each bin.
        failures: in words, one a robot.
    """

    sets: tuple[Mapping[str, Any], ...]
    cases: tuple[Case, ...]
    makers: Mapping[str, tuple[Row, ...]]
    confusions: Mapping[tuple[str, str], int]
    reliability: tuple[tuple[float, float, float, float, int], ...]

    @property
    def failures(self) -> list[Case]:
        return [case for case in self.cases if not _good(case)]

    @property
    def missing(self) -> int:
        """Robots without a verdict, which were left out."""
        return self.robots - len(self.cases)

    @property
    def robots(self) -> int:
        """How many the sets have, judged or not, without those that their maker could not make."""
        counts = [int(facts.get("robots", 0)) - len(facts.get("left_out", [])) for facts in self.sets]
        return sum(counts) if all(counts) else len(self.cases)

    def as_json(self) -> dict[str, Any]:
        return {
            "schema": "openant.blind-score/1",
            "sets": [dict(facts) for facts in self.sets],
            "robots": len(self.cases),
            "missing": self.missing,
            "rows": [{"maker": maker, **row.as_json()} for maker, rows in self.makers.items() for row in rows],
            "confusions": [
                {"truth": truth, "verdict": verdict, "count": count}
                for (truth, verdict), count in sorted(self.confusions.items(), key=lambda item: -item[1])
            ],
            "reliability": [
                {"low": low, "high": high, "stated": stated, "present": present, "count": count}
                for low, high, stated, present, count in self.reliability
            ],
            "failures": [
                {"robot": case.robot, "truth": case.answer.as_table(), "verdict": case.verdict, "order": case.order[:3]}
                for case in self.failures
            ],
        }


def read(folder: Path, key: bytes | None, *, so_far: bool = False) -> tuple[dict[str, Any], list[Case]]:
    """The set's facts, and its robots with verdicts and answers; with `so_far` those alone that have a verdict.

    Raises:
        BadInput: no set, a robot without a verdict (with `so_far`: all of them), or answers that do not open.
    """
    robots = [path.name for path in folders_of(folder)]
    facts = read_toml(folder / "set.toml")
    missing = [name for name in robots if not verdict_path(folder, name).exists()]
    judged = [name for name in robots if name not in missing]
    if missing and not (so_far and judged):
        raise BadInput(
            f"{len(missing)} of {len(robots)} robots have no verdict yet", where=folder,
            remedy="`openant gap blind run` first: answers are opened when all verdicts are written",
        )  # fmt: skip
    answers = read_answers(folder, key, str(facts.get("commitment")))
    said = {name: read_json(verdict_path(folder, name)) for name in judged}
    return facts, [Case(name, as_named_here(answers[name], folder / name), said[name]) for name in judged]


def score(sets: Sequence[Mapping[str, Any]], cases: Sequence[Case]) -> Score:
    """The table, confusions and reliability of these robots; sets: the facts of those that they are from."""
    counted: Counter[tuple[str, str]] = Counter()
    with reading("verdicts", "they are not as they were written", "`openant gap blind run` the set anew"):
        for case in cases:
            if case.answer.group != "two" and case.large:
                counted[(case.answer.outside or case.answer.verdict, case.verdict)] += 1
        makers = {
            maker: tuple(_rows([case for case in cases if case.maker == maker]))
            for maker in dict.fromkeys(case.maker for case in cases)
        }
        return Score(tuple(sets), tuple(cases), makers, dict(counted), tuple(_reliability(cases)))


def _rows(cases: Sequence[Case]) -> list[Row]:
    single = [case for case in cases if case.answer.group == "single"]
    large, small = [case for case in single if case.large], [case for case in single if not case.large]
    joint = [case for case in large if case.answer.effects[0].family == "joint"]
    body = [case for case in large if case.answer.effects[0].family == "body"]
    alone = [case for case in joint if len(_joints(case)) == 1 and case.named]
    healthy = [case for case in cases if case.answer.group == "none"]
    outside = [case for case in cases if case.answer.group == "outside"]
    two = [case for case in cases if case.answer.group == "two"]
    ranked = [case for case in large if case.order[:1] == list(case.true)]

    def share(
        words: str, of: Sequence[Case], true: Callable[[Case], bool], first: float, then: float, **more: Any
    ) -> Row:
        return Row(words, len(of), sum(map(true, of)), None, first, then, **more)

    closed = sorted(value for case in large if case.right for value in _closed(case))
    sizes = [within for case in cases for within in _sizes(case)]
    times = [case.seconds for case in cases if math.isfinite(case.seconds)]
    return [
        share("right name first, medium and large, joint, servo, bus", joint, lambda c: c.right, 0.90, 0.98),
        share("right name first, medium and large, body, contact, environment", body, lambda c: c.right, 0.90, 0.95),
        share("right name among the first two, all medium and large", large, _among_two, 0.95, 0.99),
        share("small: right, ambiguous, or none near the tolerance", small, _fair_of_small, 0.80, 0.95),
        share("right joint, one joint at fault and a name given", alone, _right_joint, 0.95, 0.99),
        share("false alarms on robots without effect", healthy, lambda c: c.verdict != "none", 0.03, 0.01, fewer=True),
        share("outside the catalogue: not given a name", outside, lambda c: not c.named, 0.75, 0.85),
        share("right answers kept (not called unexplained)", ranked, lambda c: c.verdict != "unexplained", 0.92, 0.95),
        Row("excess gap closed on held-out runs, median, right name given", len(closed), None, _median(closed), 0.85, 0.95),
        Row("sizes of causes rightly named within their 95 % interval", len(sizes), sum(sizes), None, 0.90, 0.95),
        share("both of two effects found", two, lambda c: set(c.true) <= set(c.said.get("selected", [])), 0.65, 0.85),
        Row("time of one robot, its recordings never seen, median", len(times), None, _median(sorted(times)), 120, 60, True, "s"),
    ]  # fmt: skip


def _median(values: Sequence[float]) -> float | None:
    if not values:
        return None
    n = len(values)
    return (values[(n - 1) // 2] + values[n // 2]) / 2


def _sizes(case: Case) -> list[bool]:
    """Of each size of an effect that is there and was named, whether it lies where it is said to."""
    said = {one["effect"]: one.get("parameters", {}) for one in case.said["effects"]}
    return [
        span["low"] <= true <= (math.inf if span["high"] is None else span["high"])
        for effect in case.answer.effects
        if effect.effect in case.said.get("selected", [])
        for name, true in effect.parameters.items()
        if isinstance(true, int | float) and (span := said.get(effect.effect, {}).get(name)) and span["low"] is not None
    ]


def _joints(case: Case) -> tuple[str, ...]:
    joints = case.answer.effects[0].joints
    return () if isinstance(joints, str) else joints


def _among_two(case: Case) -> bool:
    return case.verdict != "none" and bool(set(case.true) & set(case.order[:2]))


def _fair_of_small(case: Case) -> bool:
    near = all(KINDS[name].near for name in case.true)
    return case.right_or_class or (near and case.verdict == "none")


def _right_joint(case: Case) -> bool:
    for one in case.said.get("effects", []):
        if one["effect"] == case.verdict:
            return list(one.get("joints", [])) == list(_joints(case))
    return False


def _closed(case: Case) -> list[float]:
    """1 − excess after / excess before on the held-out runs, where positions show the effect at all."""
    gap = case.said.get("gap", {})
    if set(case.true) & _OFF_POSITION or any(gap.get(name) is None for name in ("before", "after", "floor")):
        return []

    def beyond(name: str) -> float:
        return math.sqrt(max(0.0, float(gap[name]) ** 2 - float(gap["floor"]) ** 2))

    return [1 - beyond("after") / beyond("before")] if beyond("before") > 0 else []


def _reliability(cases: Sequence[Case], bins: int = 10) -> list[tuple[float, float, float, float, int]]:
    """Every effect of every diagnosis: how often what was stated with some probability was there."""
    stated: list[tuple[float, bool]] = []
    for case in cases:
        if case.answer.outside:
            continue
        best: dict[str, float] = {}
        for one in case.said.get("effects", []):
            name = str(one["effect"])
            best[name] = max(best.get(name, 0.0), float(one.get("probability") or 0.0))
        stated += [(p, name in case.true) for name, p in best.items()]
    out = []
    for k in range(bins):
        low, high = k / bins, (k + 1) / bins
        inside = [(p, true) for p, true in stated if low <= p < high or (k == bins - 1 and p == 1.0)]
        if inside:
            n = len(inside)
            out.append((low, high, sum(p for p, _ in inside) / n, sum(true for _, true in inside) / n, n))
    return out


def _good(case: Case) -> bool:
    match case.answer.group:
        case "outside":
            return not case.named
        case "two":
            return set(case.true) <= set(case.said.get("selected", []))
        case "single" if not case.large:
            return _fair_of_small(case)
        case _:
            return case.right


def truth_in_words(case: Case) -> str:
    """What is true of a robot, in a line."""
    if case.answer.outside:
        return f"{case.answer.outside} ({({**OUTSIDE, **ELSEWHERE})[case.answer.outside]})"
    words = []
    for drawn in case.answer.effects:
        where = drawn.joints if isinstance(drawn.joints, str) else ", ".join(drawn.joints)
        values = ", ".join(f"{name} {_short(value)}" for name, value in drawn.parameters.items())
        words.append(f"{drawn.size} {drawn.effect} at {where} ({values})")
    return "; ".join(words) or "none"


def _short(value: Any) -> str:
    return f"[{', '.join(map(number, value))}]" if isinstance(value, list) else number(value)
