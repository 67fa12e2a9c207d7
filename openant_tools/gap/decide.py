"""The decision: a pure function of frozen rows, one for each hypothesis, and of explicit costs.

A row says how likely its causes are to lead by the evidence, and what held-out data say of them: how far they lower the error beyond a
re-fit within tolerance, in units of how unsure that is, and how far they should lower it if they were true. A cause cannot lead that
held-out data contradict, nor one that should show a gain there and shows none; where what it should gain lies below the noise,
they are no evidence either way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED

__all__ = ["Decision", "Row", "decide"]

#: standard errors that count as evidence: of a loss against a cause, of a gain that it should show
AGAINST, EXPECTED = 2.0, 4.0
#: share of the foretold gain that has to be seen
SEEN = 0.15
#: what it costs to give a wrong name, to give none where there is one, to leave open what is known, and to name it as one of two
WRONG, MISSED, OPEN, EITHER = 1.0, 0.7, 0.35, 0.2


@dataclass(frozen=True)
class Row:
    """One hypothesis.

    Attributes:
        causes: names; empty for none. joints: of each cause, indices.
        probability: that the first of them leads, by the evidence; of none, that nothing does.
        gain: share of the excess gap that goes beyond what a re-fit takes, on held-out folds; None where it was not fitted.
        error: standard error of that. foretold: what it would be if the hypothesis were true and of the size that was fitted.
    """

    causes: tuple[str, ...]
    joints: tuple[tuple[int, ...], ...] = ()
    probability: float = 0.0
    gain: float | None = None
    error: float = math.inf
    foretold: float = 0.0

    @property
    def told(self) -> bool:
        """Whether held-out data can say anything of it."""
        return self.gain is not None and self.foretold > EXPECTED * self.error

    @property
    def contradicted(self) -> bool:
        """Whether they speak against it."""
        if self.gain is None:
            return False
        if self.gain < -AGAINST * self.error:
            return True
        return self.told and self.gain + AGAINST * self.error < SEEN * self.foretold


@dataclass(frozen=True)
class Decision:
    """What is said.

    Attributes:
        verdict: a cause, or NONE, AMBIGUOUS, UNEXPLAINED. confidence: that it is right.
        selected: rows that go into an improved model. alike: of an ambiguous verdict, sets that cannot be told apart.
    """

    verdict: str
    confidence: float
    selected: tuple[Row, ...] = ()
    alike: tuple[tuple[str, ...], ...] = ()


def decide(rows: Sequence[Row], outside: float) -> Decision:
    """The verdict that costs least.

    Args:
        rows: the hypotheses, one of them without causes. outside: probability of something that no catalogue has.
    """
    none = next(row for row in rows if not row.causes)
    causes = sorted((row for row in rows if row.causes), key=lambda row: -row.probability)
    possible = [row for row in causes if not row.contradicted]
    # What held-out data refute was evidence of something: that it is none of what is known.
    refuted = sum(row.probability for row in causes if row.contradicted)
    whole = none.probability + outside + refuted + sum(row.probability for row in possible)
    p_none, p_outside = none.probability / whole, (outside + refuted) / whole
    named = [(row, row.probability / whole) for row in possible]
    costs = {NONE: MISSED * (1 - p_none), UNEXPLAINED: OPEN * (1 - p_outside - p_none) + WRONG * p_none}
    if named:
        costs[named[0][0].causes[0]] = WRONG * (1 - named[0][1])
    if len(named) > 1:
        costs[AMBIGUOUS] = EITHER * (named[0][1] + named[1][1]) + WRONG * (1 - named[0][1] - named[1][1])
    verdict = min(costs, key=lambda name: costs[name])
    if verdict == NONE:
        return Decision(NONE, p_none)
    if verdict == UNEXPLAINED:
        return Decision(UNEXPLAINED, p_outside)
    if verdict == AMBIGUOUS:
        alike = tuple(row.causes[0] for row, _ in named[:2])
        return Decision(AMBIGUOUS, named[0][1] + named[1][1], (), (alike,))
    return Decision(verdict, named[0][1], (named[0][0],))
