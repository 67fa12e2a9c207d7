"""The decision: a pure function of frozen rows, one for each hypothesis, and of explicit costs.

A row says how likely its cause is to lead by the evidence, and what held-out data say of it: how much more of the gap it closes than a
re-fit within tolerance, how unsure that is, and how much it would close if it were true. What held-out data say is a likelihood ratio,
so that it can speak for a cause and against it: one that loses there, or that should gain and does not, is no longer likely, whatever
the evidence said; where what it should gain lies below the noise the ratio is one.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED

__all__ = ["Decision", "Row", "adds", "decide"]

#: share of what it should gain that a true cause gains on held-out data, and the deviation of that: no size is found exactly
GAINS, SPREAD = 0.75, 0.25
#: how often a cause that is not there gains nothing, where another is and where none is; else it gains a share
NOTHING, NOTHING_HEALTHY = 0.5, 0.9
#: share of the gap that one hypothesis may gain more than another by chance of how motions were cut, besides its standard error
CHANCE = 0.02
#: logarithm of the most that held-out data may speak for a cause: they cannot tell it from others that close as much
MOST = 3.0
#: what it costs to give a wrong name, to give none where there is one, to leave open what is known, and to name it as one of two
WRONG, MISSED, OPEN, EITHER = 1.0, 0.7, 0.7, 0.2
#: probability from which a further cause goes into the improved model
PRESENT = 0.5


@dataclass(frozen=True)
class Row:
    """One hypothesis.

    Attributes:
        causes: names, the one that is asked about last, or all together; empty for none. joints: of each cause, indices.
        probability: by the evidence: that it leads, or of a further cause that it is there; of none, that nothing leads.
        gain: share of the excess gap that it closes on held-out folds beyond what is closed without it; None where it was not fitted.
        error: standard error of that. expected: what it would be at best if the hypothesis were true.
    """

    causes: tuple[str, ...]
    joints: tuple[tuple[int, ...], ...] = ()
    probability: float = 0.0
    gain: float | None = None
    error: float = math.inf
    expected: float = 0.0

    @property
    def told(self) -> bool:
        """Whether held-out data can say anything of it."""
        return self.gain is not None and math.isfinite(self.error) and self.expected > 0

    @property
    def ratio(self) -> float:
        """Logarithm of how much likelier its gain is if it is true than if something else is."""
        return min(MOST, self._true - self._else(NOTHING)) if self.told else 0.0

    @property
    def ratio_of_none(self) -> float:
        """The same of there being nothing to gain."""
        return self._else(NOTHING_HEALTHY) - self._else(NOTHING) if self.told else 0.0

    @property
    def refuted(self) -> bool:
        """Whether held-out data speak strongly against it."""
        return self.ratio < -MOST

    @property
    def noise(self) -> float:
        """Deviation of the gain by chance."""
        return math.hypot(self.error, CHANCE)

    @property
    def _true(self) -> float:
        assert self.gain is not None
        mean, deviation = GAINS * self.expected, math.hypot(self.noise, SPREAD * self.expected)
        return float(norm.logpdf(min(self.gain, self.expected), mean, deviation))

    def _else(self, nothing: float) -> float:
        """Of another cause's being true, or of none: it gains nothing, or a share, the larger the seldomer (a falling line)."""
        share, noise = self._within / self.expected, self.noise / self.expected
        ends = np.array([-share, 1 - share]) / noise
        below, between = norm.cdf(ends), norm.pdf(ends)
        falling = 2 / self.expected * ((1 - share) * (below[1] - below[0]) - noise * (between[0] - between[1]))
        likely = (1 - nothing) * falling + nothing * norm.pdf(self._within, 0.0, self.noise)
        return math.log(max(float(likely), sys.float_info.min))

    @property
    def _within(self) -> float:
        """The gain, between none and all: who is wrong may lose as much as he likes."""
        assert self.gain is not None
        return min(max(self.gain, 0.0), self.expected)


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
    causes = [row for row in rows if row.causes]
    # Gains of causes go together: only the best of them says whether there was anything to gain.
    best = max((row for row in causes if row.told), key=lambda row: (row.gain or 0.0) / row.noise, default=none)
    weighed = [(row, row.probability * math.exp(row.ratio)) for row in causes]
    # What held-out data refute was evidence of something: that it is none of what is known.
    lost = math.fsum(max(0.0, row.probability - weight) for row, weight in weighed if row.refuted)
    weight_none, weight_outside = none.probability * math.exp(best.ratio_of_none), outside + lost
    whole = math.fsum([weight_none, weight_outside, *(weight for _, weight in weighed)])
    p_none, p_outside = weight_none / whole, weight_outside / whole
    # A cause by itself and the same with another beside it are one name.
    of_name: dict[str, list[tuple[Row, float]]] = {}
    for row, weight in weighed:
        of_name.setdefault(row.causes[0], []).append((row, weight / whole))
    named = sorted(
        ((max(same, key=lambda one: one[1])[0], math.fsum(p for _, p in same)) for same in of_name.values()),
        key=lambda one: -one[1],
    )
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


def adds(rows: Sequence[Row]) -> Row | None:
    """Of hypotheses with one cause more than is selected, the likeliest one whose last cause is likelier there than not."""

    def probability(row: Row) -> float:
        odds = row.probability / max(1 - row.probability, 1e-9)
        # It is there, or nothing of it is: no other cause has to make up for it.
        odds *= math.exp(row.ratio - row.ratio_of_none)
        return odds / (1 + odds)

    likeliest = max((row for row in rows if row.told), key=probability, default=None)
    return likeliest if likeliest is not None and probability(likeliest) > PRESENT else None
