"""The decision: a pure function of frozen rows, one for each hypothesis, of learned weights and of explicit costs.

A row says how far the recording goes along what its cause does, and what its fit says of it: how much less of the gap it leaves on
held-out data than a re-fit within tolerance does, how much less it should leave there, how evenly joints share it, and how much likelier
it made what it was fitted to. So data speak for a cause and against it: one that leaves more, or that should leave less and does not, is no
longer likely, however well its template fits. Where all that is known leaves much at one joint and little at the others, something else is at
that joint.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np

from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED

__all__ = [
    "OUTSIDE", "PRESENT", "WEIGHTS", "Anomaly", "Decision", "Row", "chances", "decide", "led", "presence", "present", "weights",
    "worth_fitting",
]  # fmt: skip

#: the weights by their names: of how far a recording goes along a cause; of what held-out data say of it, of how much more its fit had
#: promised, of how much more evenly it leaves joints; of how much likelier it made what it was fitted to than any robot of one build; of
#: what innovations say of commands; of nothing and of something unknown by themselves, of these by how far the recording is from the model
#: and by how unevenly joints are left; of a further cause by itself, and of how far what others leave goes along it
WEIGHTS = (
    "fit", "support", "shortfall", "uneven", "beyond", "irregular", "none", "none: size", "outside", "outside: left",
    "outside: uneven", "beside", "beside: fit",
)  # fmt: skip
#: where they lie in this package
FILE = "decision.json"
#: of what no catalogue has, beside the names of causes
OUTSIDE = "outside"
#: nats by which held-out data speak strongly against a cause
STRONGLY = 3.0
#: nats beyond which what was fitted says little more: no model of a real robot is true, and a wrong cause can be surer than any right one
SURE = 30.0
#: times what healthy robots differ by beyond which a recording that differs more says no more of what it is
FARTHEST = 3.0
#: what it costs to give a wrong name, to say that nothing is wrong where something is, to leave open what is known (an open question is
#: better than a wrong all-clear), and to name it as one of two
WRONG, MISSED, OPEN, EITHER = 1.0, 0.8, 0.7, 0.2
#: probability from which a further cause goes into the improved model
PRESENT = 0.5


@dataclass(frozen=True)
class Anomaly:
    """How far a recording is from the model once tolerances have taken what they may: 1 where it differs as healthy robots do.

    Attributes:
        size: root mean square. left: the same without what its best cause explains.
    """

    size: float
    left: float


@dataclass(frozen=True)
class Row:
    """One hypothesis.

    Attributes:
        causes: names, the one that is asked about last; empty for none. joints: of each cause, indices.
        fit: deviations of healthy robots by which the recording, or what the others leave of it, goes along what the cause does.
        leads: whether it may be what leads the gap. told: whether what is asked about acts on what joints tell of their motion. expected: nats that its builder's word adds.
        support: logarithm of how much less it leaves of the gap on held-out folds, mean of them and summed over joints, than what it is compared
            with does (no further cause, or the others); None where it was not fitted, or where nothing that was recorded
            tells.
        foretold: what that would be if it were right. uneven: logarithm of how many times its sensors' errors the joint that it leaves worst
            keeps there, less that of the median joint.
        likelier: nats by which what it was fitted to is, its sizes and tolerances with it, than what it is compared with makes it.
            within: the same, with no more of its cause than robots of one build differ by.
        gain: share of the excess gap that it closes on held-out folds beyond what is closed without it, for the report.
        irregular: of a cause that acts at random times nats by which innovations are likelier than without it. explained: what its
            support would be if it did what they say of it.
    """

    causes: tuple[str, ...]
    joints: tuple[tuple[int, ...], ...] = ()
    fit: float = 0.0
    leads: bool = True
    told: bool = False
    expected: float = 0.0
    support: float | None = None
    foretold: float = 0.0
    uneven: float | None = None
    likelier: float = 0.0
    within: float = 0.0
    gain: float | None = None
    irregular: float = 0.0
    explained: float = 0.0

    def held_out(self, weights: Mapping[str, float]) -> float:
        """What held-out data say of it, in nats."""
        if self.support is None:
            return 0.0
        short = max(self.foretold - max(self.support, 0.0), 0.0)
        return weights["support"] * self.support - weights["shortfall"] * short

    @property
    def refuted(self) -> bool:
        """Whether held-out data speak strongly against it."""
        return self.held_out(weights()) < -STRONGLY


@dataclass(frozen=True)
class Decision:
    """What is said.

    Attributes:
        verdict: a cause, or NONE, AMBIGUOUS, UNEXPLAINED. confidence: that it is right. chances: of each cause, that it leads.
        selected: rows that go into an improved model, of an ambiguous verdict the likelier one, or the one that acts on the motion: a
            policy meets what is late in what it does as in what it sees, and every engine carries that. alike: then, sets that cannot be
            told apart.
    """

    verdict: str
    confidence: float
    chances: Mapping[str, float]
    selected: tuple[Row, ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()

    @property
    def likeliest(self) -> str:
        """The cause that likeliest leads, whatever is said."""
        return max(self.chances, key=lambda name: self.chances[name])

    @property
    def causes(self) -> tuple[str, ...]:
        """Those that are selected."""
        return tuple(name for row in self.selected for name in row.causes)


@cache
def weights() -> Mapping[str, float]:
    """Those that were learned (benchmarks/gap_training/decision.py)."""
    text = json.loads((files("openant_tools.gap") / FILE).read_text())
    return {name: float(text[name]) for name in WEIGHTS}


def _fitted(rows: Sequence[Row], uneven: float, weights: Mapping[str, float]) -> dict[tuple[str, ...], float]:
    """Of each hypothesis that was fitted, or asked of innovations, what that says of it, in nats; `uneven` is without their last causes.

    A little of any cause is in every robot: a hypothesis has to be likelier than what robots of one build come to by any of them.
    """
    usual = max([0.0, *(row.within for row in rows if row.support is not None)])
    out = {}
    for row in rows:
        if row.support is not None:
            evened = 0.0 if row.uneven is None else weights["uneven"] * (uneven - row.uneven)
            out[row.causes] = row.held_out(weights) + evened + weights["beyond"] * _sure(row.likelier - usual)
        elif row.irregular:
            out[row.causes] = weights["irregular"] * _sure(row.irregular)
    return out


def led(rows: Sequence[Row]) -> list[Row]:
    """The same rows, of which no cause of random times leads that accounts for less of the gap than another: it may be there beside that."""
    most = max((row.support for row in rows if row.leads and row.support is not None), default=0.0)
    return [replace(row, leads=row.leads and not (row.irregular and row.explained < most)) for row in rows]


def chances(rows: Sequence[Row], anomaly: Anomaly, weights: Mapping[str, float]) -> dict[str, float]:
    """NONE, OUTSIDE and the cause of each hypothesis of one at most → probability; they come to one."""
    uneven = min((row.uneven for row in rows if row.uneven is not None), default=0.0)
    logits = {
        OUTSIDE: weights["outside"]
        + weights["outside: left"] * _decades(anomaly.left)
        + weights["outside: uneven"] * uneven,
        NONE: weights["none"] - weights["none: size"] * _decades(anomaly.size),
    }
    none = next(row for row in rows if not row.causes)
    singles = [row for row in rows if len(row.causes) == 1 and row.leads]
    said = _fitted(singles, none.uneven or 0.0, weights)
    for row in singles:
        logits[row.causes[0]] = weights["fit"] * _along(row.fit) + row.expected + said.get(row.causes, 0.0)
    # Sorted: sums of the same numbers are the same, in whatever order rows come.
    whole = float(np.logaddexp.reduce(sorted(logits.values())))
    led = {name: math.exp(one - whole) for name, one in logits.items()}
    return {row.causes[0]: 0.0 for row in rows if len(row.causes) == 1} | led


def decide(rows: Sequence[Row], anomaly: Anomaly) -> Decision:
    """The verdict that costs least.

    Args:
        rows: the hypotheses, one of them without causes; of several causes, which were found to be there together, what they leave.
    """
    p = chances(rows, anomaly, weights())
    none, unknown = p.pop(NONE), p.pop(OUTSIDE)
    named = sorted(p, key=lambda name: (-p[name], name))
    costs = {NONE: MISSED * (1 - none), UNEXPLAINED: OPEN * (1 - unknown - none) + WRONG * none}
    if named:
        costs[named[0]] = WRONG * (1 - p[named[0]])
    if len(named) > 1:
        costs[AMBIGUOUS] = EITHER * (p[named[0]] + p[named[1]]) + WRONG * (1 - p[named[0]] - p[named[1]])
    verdict = min(costs, key=lambda name: costs[name])
    if verdict == NONE:
        return Decision(NONE, none, p)
    if verdict == UNEXPLAINED:
        return Decision(UNEXPLAINED, unknown, p)

    best = next(row for row in rows if row.causes == (named[0],))
    if verdict == AMBIGUOUS:
        either = p[named[0]] + p[named[1]]
        if any(set(named[:2]) <= set(row.causes) for row in rows):
            return Decision(named[0], either, p, (best,))
        other = next(row for row in rows if row.causes == (named[1],))
        if best.told and not other.told:
            best = other
        return Decision(AMBIGUOUS, either, p, (best,), (tuple(named[:2]),))
    return Decision(verdict, p[verdict], p, (best,))


def worth_fitting(fit: Mapping[str, float], likelier: Mapping[str, float]) -> list[str]:
    """Causes in the order in which they may come out, by how far the recording goes along them and by how much likelier (nats) their first
    steps make it."""
    learned = weights()

    def worth(name: str) -> float:
        return learned["fit"] * _along(fit[name]) + learned["beyond"] * _sure(max(likelier[name], 0.0))

    return sorted(likelier, key=worth, reverse=True)


def presence(fit: float, weights: Mapping[str, float], said: float = 0.0) -> float:
    """Probability that a cause is there beside others.

    Args:
        fit: deviations of healthy robots by which what these leave goes along what it does. said: nats, what its own fit says of it.
    """
    return 1 / (1 + math.exp(-(weights["beside"] + weights["beside: fit"] * _along(fit) + said)))


def present(rows: Sequence[Row], uneven: float, weights: Mapping[str, float]) -> dict[str, float]:
    """Of hypotheses with one cause more than is selected, that cause → probability that it is there, where data say anything of it.

    Args:
        uneven: as what is selected leaves it.
    """
    said = _fitted(rows, uneven, weights)
    return {row.causes[-1]: presence(row.fit, weights, said[row.causes]) for row in rows if row.causes in said}


def _sure(nats: float) -> float:
    return SURE * math.asinh(nats / SURE)


def _along(deviations: float) -> float:
    """nats by which what was recorded is likelier with a cause along which it goes so far."""
    return _sure(0.5 * deviations**2)


def _decades(size: float) -> float:
    return math.log10(min(max(size, 1 / FARTHEST), FARTHEST))
