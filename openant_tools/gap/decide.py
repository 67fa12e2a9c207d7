"""The decision: a pure function of frozen rows, one for each hypothesis, of learned weights and of explicit costs.

A row says how likely its cause is to lead by the evidence, and what its fit says of it: how much less of the gap it leaves on held-out data
than a re-fit within tolerance does, how much less it should leave there, how evenly joints share it, and how much likelier it made what it was
fitted to. So data speak for a cause and against it: one that leaves more, or that should leave less and does not, is no longer likely,
whatever the evidence said. Where all that is known leaves much at one joint and little at the others, something else is at that joint.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED

__all__ = ["OUTSIDE", "WEIGHTS", "Decision", "Row", "adds", "chances", "decide", "weights", "worth_fitting"]

#: the weights by their names: of logarithms of probabilities by the evidence; of what held-out data say of a cause, of how much more its fit
#: had promised, of how much more evenly it leaves joints; of how much likelier it made what it was fitted to than any robot of one build; of
#: what innovations say of commands; of nothing and of something unknown by themselves, and of this by how unevenly joints are left
WEIGHTS = (
    "evidence", "support", "shortfall", "uneven", "beyond", "irregular", "none", "outside", "outside: uneven",
)  # fmt: skip
#: where they lie in this package
FILE = "decision.json"
#: of what no catalogue has, beside the names of causes
OUTSIDE = "outside"
#: least probability by the evidence that counts
LEAST = 1e-6
#: nats by which held-out data speak strongly against a cause
STRONGLY = 3.0
#: nats beyond which what was fitted says little more: no model of a real robot is true, and a wrong cause can be surer than any right one
SURE = 30.0
#: what it costs to give a wrong name, to say that nothing is wrong where something is, to leave open what is known (an open question is
#: better than a wrong all-clear), and to name it as one of two
WRONG, MISSED, OPEN, EITHER = 1.0, 0.8, 0.7, 0.2
#: probability from which a further cause goes into the improved model
PRESENT = 0.5


@dataclass(frozen=True)
class Row:
    """One hypothesis.

    Attributes:
        causes: names, the one that is asked about last; empty for none. joints: of each cause, indices.
        probability: by the evidence: that it leads, or of a further cause that it is there; of none, that nothing leads.
        support: logarithm of how much less it leaves of the gap on held-out folds, mean of them and summed over joints, than what it is compared
            with does (no further cause, or the others); None where it was not fitted, or where nothing that was recorded
            tells.
        foretold: what that would be if it were right. uneven: logarithm of how many times its sensors' errors the joint that it leaves worst
            keeps there, less that of the median joint.
        likelier: nats by which what it was fitted to is, its sizes and tolerances with it, than what it is compared with makes it.
            within: the same, with no more of its cause than robots of one build differ by.
        gain: share of the excess gap that it closes on held-out folds beyond what is closed without it, for the report.
        irregular: of a cause that acts at random times nats by which innovations are likelier than without it.
    """

    causes: tuple[str, ...]
    joints: tuple[tuple[int, ...], ...] = ()
    probability: float = 0.0
    support: float | None = None
    foretold: float = 0.0
    uneven: float | None = None
    likelier: float = 0.0
    within: float = 0.0
    gain: float | None = None
    irregular: float = 0.0

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
        selected: rows that go into an improved model, of an ambiguous verdict the likelier one. alike: then, sets that cannot be told
            apart.
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


def chances(rows: Sequence[Row], outside: float, weights: Mapping[str, float]) -> dict[str, float]:
    """NONE, OUTSIDE and the cause of each hypothesis of one at most → probability; they come to one."""
    uneven = min((row.uneven for row in rows if row.uneven is not None), default=0.0)
    logits = {OUTSIDE: weights["outside"] + weights["outside: uneven"] * uneven + weights["evidence"] * _log(outside)}
    none = next(row for row in rows if not row.causes)
    singles = [row for row in rows if len(row.causes) == 1]
    said = _fitted(singles, none.uneven or 0.0, weights)
    for row in (none, *singles):
        name, more = (row.causes[0], said.get(row.causes, 0.0)) if row.causes else (NONE, weights["none"])
        logits[name] = weights["evidence"] * _log(row.probability) + more
    # Sorted: sums of the same numbers are the same, in whatever order rows come.
    whole = float(np.logaddexp.reduce(sorted(logits.values())))
    return {name: math.exp(one - whole) for name, one in logits.items()}


def decide(rows: Sequence[Row], outside: float) -> Decision:
    """The verdict that costs least.

    Args:
        rows: the hypotheses, one of them without causes; of several causes, which were found to be there together, what they
            leave. outside: probability, by the evidence, of something that no catalogue has.
    """
    learned = weights()
    p = chances(rows, outside, learned)
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
        return Decision(AMBIGUOUS, either, p, (best,), (tuple(named[:2]),))
    return Decision(verdict, p[verdict], p, (best,))


def worth_fitting(probability: Mapping[str, float], likelier: Mapping[str, float]) -> list[str]:
    """Causes in the order in which they may come out, by the evidence (0…1) and by how much likelier (nats) their first steps make the data."""
    learned = weights()

    def worth(name: str) -> float:
        return learned["evidence"] * _log(probability[name]) + learned["beyond"] * _sure(max(likelier[name], 0.0))

    return sorted(likelier, key=worth, reverse=True)


def adds(rows: Sequence[Row], uneven: float) -> Row | None:
    """Of hypotheses with one cause more than is selected, the likeliest one whose last cause is likelier there than not.

    Args:
        uneven: as what is selected leaves it.
    """
    learned = weights()
    said = _fitted(rows, uneven, learned)

    def probability(row: Row) -> float:
        odds = _log(row.probability) - _log(1 - row.probability)
        return 1 / (1 + math.exp(-(learned["evidence"] * odds - learned["none"] + said[row.causes])))

    likeliest = max((row for row in rows if row.causes in said), key=probability, default=None)
    return likeliest if likeliest is not None and probability(likeliest) > PRESENT else None


def _sure(nats: float) -> float:
    return SURE * math.asinh(nats / SURE)


def _log(probability: float) -> float:
    return math.log(max(probability, LEAST))
