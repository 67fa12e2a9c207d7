"""Fits of hypotheses to runs, within tolerance: all of them side by side, and without each part that is held out."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.descent import LEAST_GAIN, Descent
from openant_tools.gap.features import Floats
from openant_tools.gap.hypothesis import Hypothesis, Part, Refit, refit_at, sized, sizes, without_last
from openant_tools.gap.prediction import Predictions
from openant_tools.gap.solver import Solver
from openant_tools.model.plant import Setup

__all__ = ["Fit", "Fits"]

Array = NDArray[np.float64]

#: how often slopes are followed at most
ITERATIONS = 30
#: and where a cause is held to what robots of one build differ by, from where it was best
LOOKS = 3
#: times a size by templates that are tried to begin from; steps in which tolerances are moved to each, and that tell which causes are worth
#: following to their end
SIZES, FIRST_STEPS = (0.5, 1.0, 2.0), 2
#: times the size by first steps from which a cause is followed as well
LARGER = 3.0
#: how often slopes of tolerances are measured, each time where those before lead no farther
MEASURED = 3
#: hypotheses, those that leave least, that go on by slopes which are measured where they have come to
FINISHED = 3


@dataclass(frozen=True)
class Fit:
    """One hypothesis, fitted.

    Attributes:
        whole: to all runs to train on. folds: without each group that is held out.
        std: of the coordinates of its causes, in order: by curvature with errors as large as the fit leaves them, or by how much folds
            differ (jackknife), whichever is more.
        likelihood: the logarithm of how likely all is that it was fitted to, where errors of each channel in each run have a size of
            their own, and that of sizes and tolerances. within: the same, with no more of its last cause than robots of one build
            differ by.
    """

    whole: Refit
    folds: list[Refit]
    std: tuple[Mapping[str, float], ...]
    likelihood: float
    within: float


class Fits:
    """Fits to some runs.

    Attributes:
        found: where a fit of `nothing` came to, in tolerances as `Predictions.names`; 0 before.
    """

    def __init__(self, predictions: Predictions) -> None:
        self.predictions = predictions
        self.solver = Solver(predictions)
        self._learnt: dict[Hypothesis, dict[int, Floats]] = {}
        self._least = np.inf
        self.found = np.zeros(len(predictions.names))

    def nothing(self) -> Refit:
        """No cause at all, only what tolerances let move, from where it was last found to be."""
        return Refit((), (), self.found)

    def of(self, parts: Iterable[Part], x: Iterable[Mapping[str, float]]) -> Refit:
        """Causes at these coordinates, from where a fit without them came to."""
        return Refit(tuple(parts), tuple(x), self.found)

    def begun(
        self, starts: Sequence[Refit], training: Sequence[int], base: Hypothesis = ()
    ) -> list[tuple[Refit, float]]:
        """Where each has come to by its first steps, from the best of some sizes of its last cause, and the logarithm of how likely that is.

        Tolerances have taken up what a cause does while there was none: to each size they are moved first.

        Args:
            base: a hypothesis that was fitted, which lacks the last cause: slopes of tolerances are as they are there.
        """
        fitted, tolerances, learnt = list(training), len(self.predictions.names), self._slopes(base)
        tried = [[Descent.of(some, tolerances, learnt).of_this_size() for some in _sized(start)] for start in starts]
        self.solver.follow([one for some in tried for one in some], fitted, FIRST_STEPS)
        best = [min(some, key=lambda one: one.least) for some in tried]
        descents = [Descent.of(refit_at(one.start, one.at), tolerances, learnt) for one in best]
        self.solver.follow(descents, fitted, FIRST_STEPS)
        return [(refit_at(one.start, one.at), -0.5 * one.least) for one in descents]

    def refit(
        self, starts: Sequence[Refit], training: Sequence[int], leave_out: Sequence[Collection[int]]
    ) -> list[Fit]:
        """Fit within tolerance, and polish sizes: each on all the runs to train on, and without each group of some of them.

        All share one linearisation each, at what is found on all of the training runs; and are simulated side by side.

        Args:
            starts: the first is what the others are compared with: each has one cause more.
        """
        fitted = list(training)
        base = starts[0].hypothesis
        descents = self._no_worse(self._descend(starts, fitted, base), fitted)
        for one in [one for one in descents if not one.causes] + self._finish(descents[1:], fitted):
            self._keep(one)
        out = []
        limited = self._within(descents, fitted)
        if self._without(descents, limited, fitted):
            limited = self._within(self._no_worse(descents, fitted), fitted)
        # What may be larger leaves no more: where it does, its descent has ended in a hollow.
        hollow = [n for n, one in enumerate(descents) if one.least - limited[n].least > 2 * LEAST_GAIN]
        self._anew(descents, {n: refit_at(limited[n].start, limited[n].at) for n in hollow}, fitted, base)
        for one, within in zip(descents, (-0.5 * one.least for one in limited), strict=True):
            folds = [[k for k in one.blocks if k not in left] for left in leave_out]
            # Where a fold leads otherwise than all of them together, from where these came to; held back it would not leave there.
            one.damping = 0.0
            whole_way = self.solver.solve(one, list(one.blocks))
            each = [np.clip(one.at + self.solver.solve(one, fold) - whole_way, one.low, one.high) for fold in folds]
            whole, parts = refit_at(one.start, one.at), [refit_at(one.start, u) for u in each]
            out.append(Fit(whole, parts, refit_at(one.start, self._deviations(one, parts)).x, -0.5 * one.least, within))
        return out

    def _deviations(self, descent: Descent, folds: Sequence[Refit]) -> Array:
        """Standard deviations of a fit's coordinates."""
        normal = np.diag(1 / descent.scale**2)
        for block in descent.blocks.values():
            normal += block.weighted(1 / block.inflation(block.cost))[0]
        curvature: Array = np.sqrt(np.diag(np.linalg.inv(normal)))
        if len(folds) < 2:
            return curvature
        each = np.array([np.concatenate([sizes(fold), fold.nuisance]) for fold in folds])
        spread = np.sqrt((len(each) - 1) / len(each) * np.square(each - each.mean(axis=0)).sum(axis=0))
        out: Array = np.maximum(curvature, spread)
        return out

    def _within(self, descents: Sequence[Descent], fitted: Sequence[int]) -> list[Descent]:
        """Each with no more of its last cause than robots of one build differ by."""
        limited = [one.of_one_build() if one.causes else one for one in descents]
        beyond = [one for one in limited if not one.inside]
        for one in beyond:
            one.u, one.least = self.solver.solve(one, list(one.blocks)), np.inf
        self.solver.follow(beyond, fitted, LOOKS)
        return limited

    def _no_worse(self, descents: list[Descent], fitted: Sequence[int]) -> list[Descent]:
        """Where a hypothesis leaves more than the first, which lacks its last cause, a descent from there in its place."""
        first = descents[0]
        worse = [n for n, one in enumerate(descents) if one.least - first.least > 2 * LEAST_GAIN]
        bare = refit_at(first.start, first.at)
        self._anew(descents, {n: without_last(descents[n].start, bare) for n in worse}, fitted, first.start.hypothesis)
        return descents

    def _without(self, descents: list[Descent], limited: Sequence[Descent], fitted: Sequence[int]) -> bool:
        """Where robots of one build with a little of a cause leave less than without any, none at all from there; whether that leaves less.

        Else each cause that leads out of a hollow would seem to be what the robot has.
        """
        first, best = descents[0], min(limited, key=lambda one: one.least)
        if first.causes or first.least - best.least <= 2 * LEAST_GAIN:
            return False
        [again] = self._descend([Refit((), (), best.at[best.causes :])], fitted, ())
        if first.least - again.least <= 2 * LEAST_GAIN:
            return False
        descents[0] = again
        self._keep(again)
        return True

    def _anew(
        self, descents: list[Descent], starts: Mapping[int, Refit], fitted: Sequence[int], base: Hypothesis
    ) -> None:
        """Follow some of them from other starts, in their places."""
        if starts:
            for n, one in zip(starts, self._descend(list(starts.values()), fitted, base), strict=True):
                descents[n] = one

    def _descend(self, starts: Sequence[Refit], fitted: Sequence[int], base: Hypothesis) -> list[Descent]:
        """Follow each start to where it leaves least on these runs; a cause that was never followed from a larger size, too.

        Tolerances have come to where there was none: a small one stays in their hollow where a larger one leaves it.
        """
        # Slopes cost the most: causes begin with what was learnt of tolerances without them on the floor, where each takes a simulation.
        learnt = {k: slopes for k, slopes in self._slopes(base).items() if k in fitted and self._on_floor(k)}
        ways = [[start, *(_larger(start) if start.hypothesis not in {base, *self._learnt} else ())] for start in starts]
        descents = [[Descent.of(start, len(self.predictions.names), learnt) for start in some] for some in ways]
        every = [one for some in descents for one in some]
        self.solver.follow(every, fitted, ITERATIONS)
        if self._least == np.inf:
            self._choose_form(every[0], fitted)
        if not learnt:
            self._go_on(every, fitted)
        return [min(some, key=lambda one: one.least) for some in descents]

    def _finish(self, descents: Sequence[Descent], fitted: Sequence[int]) -> list[Descent]:
        """Follow those that leave least by slopes of tolerances that are learnt where they have come to."""
        floor = any(self._on_floor(k) for k in fitted)
        finished = sorted(descents, key=lambda one: one.least)[:FINISHED] if floor else []
        self._go_on(finished, fitted)
        return finished

    def _go_on(self, descents: Sequence[Descent], fitted: Sequence[int]) -> None:
        """Follow by slopes that are measured where each has come to, as long as those lead on."""
        begun = list(descents)
        for _ in range(MEASURED - 1):
            before = [one.least for one in begun]
            for one in begun:
                one.begin()
            self.solver.follow(begun, fitted, ITERATIONS)
            begun = [one for one, cost in zip(begun, before, strict=True) if cost - one.least > 2 * LEAST_GAIN]

    def _choose_form(self, found: Descent, fitted: Sequence[int]) -> None:
        """Go on in the form of simulation that leaves least where a descent is."""
        left = []
        for form in self.predictions.forms:
            self.predictions.form = form
            tried = dataclasses.replace(
                found, u=found.at, least=np.inf, errors={}, blocks={}, slopes=dict(found.slopes)
            )
            self.solver.look([tried], fitted)
            left.append(tried.least)
        self.predictions.form = self.predictions.forms[int(np.argmin(left))]

    def _keep(self, found: Descent) -> None:
        """Remember what was learnt of tolerances."""
        self._learnt[found.start.hypothesis] = {k: slopes[found.causes :] for k, slopes in found.slopes.items()}
        if not found.causes:
            self._least = found.least
            self.found = found.at

    def _slopes(self, hypothesis: Hypothesis) -> Mapping[int, Floats]:
        """Of each run how tolerances move it, where a hypothesis was fitted, or else no cause; nothing before that."""
        return self._learnt.get(hypothesis) or self._learnt.get((), {})

    def _on_floor(self, k: int) -> bool:
        return self.predictions.protocol.runs[k].plant.setup is Setup.FLOOR


def _sized(start: Refit, factors: Sequence[float] = SIZES) -> list[Refit]:
    """A hypothesis with its last cause so many times as large."""
    *others, last = start.x
    cause = start.hypothesis[-1].cause
    return [dataclasses.replace(start, x=(*others, sized(cause, last, times))) for times in factors]


def _larger(start: Refit) -> list[Refit]:
    """A hypothesis with its last cause LARGER times as large, where it is not as large as it may be, nor nothing."""
    return [one for one in _sized(start, [LARGER]) if one.x != start.x]
