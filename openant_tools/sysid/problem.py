"""Fitting a model to runs: bounded nonlinear least squares on rollouts, weighted by noise, with priors.

The estimate maximises a posterior (MAP). Its cost is Σ (measured − simulated)² / s² over positions, plus Σ u² over
parameters (priors of unit deviation). What s² is decides how far data move a parameter. The residual of a robot is
not white noise: a model error lasts for as long as the motion that shows it, so a thousand samples may be worth ten. Per
joint s² is the mean squared residual at the estimate times the integrated autocorrelation time in samples (2τ), found by
iteration. With a perfect model that is the sensor's noise, sample by sample; with an imperfect one it tempers the
likelihood by itself, and intervals widen as they must.

Rollouts are all of the cost. A Jacobian takes a dozen of them: it is taken in long time steps where short ones are not
needed, and used for several steps, as long as what it promises is what comes. Weights take none: they follow what the
Jacobian foresees, so that one step goes as far as it would in many.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.sysid.dataset import Dataset
from openant_tools.sysid.estimate import CONFLICT, Estimate, Posterior, estimate, posterior
from openant_tools.sysid.forward import ForwardModel
from openant_tools.sysid.kinds import ZERO_OFFSET
from openant_tools.sysid.parameter import ACTION_DELAY, Parameter
from openant_tools.sysid.solve import (
    ARRIVED,
    STALE,
    Derive,
    Descent,
    Look,
    Point,
    Prior,
    Steps,
    Tangent,
    descend,
    side_by_side,
)
from openant_tools.sysid.weights import SHORT_LIVED, WHITE, Weighing, Weights, stretches

__all__ = ["Problem"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Progress = Callable[[float, str], None]

#: squared length of a step in posterior deviations, per parameter, below which a descent is near, if the step is short in prior
#: deviations too; and where it started near
NEAR, NEARER = 5.0, 0.05
#: rounds in which a step and the weights that it leads to find each other, before anything is simulated
FORESEEN = 4
#: a residual this small, in deviations that the encoder alone makes, has nothing in it that a second descent could find
CLEAN = 1.5
#: priors weigh this much where the data lead alone: only against directions of which the data say nothing
LOOSE = 0.1
#: nats by which a posterior must be better to count as another one: less is where the descent happened to stop
DECISIVE = 1.0
#: delays (s) from which a fit starts where they explain the data far better than none
DELAYS_S = (0.02, 0.04, 0.06)
#: rad by which a zero may be off that no prior expects: horns that sit some teeth off, or the wrong way round
ZEROS_RAD = tuple(math.radians(angle) for angle in (-135, -90, -45, -25, 25, 45, 90, 135, 180))
#: share of what is left to tell of a fit's progress that each step takes: how many there are nobody knows beforehand
TOLD = 0.06


@dataclass
class Problem:
    """A least-squares problem: parameters, the data they are judged by, and the weights of those data.

    Attributes:
        datasets: all with the same joints in the same order.
        parameters: the unknowns.
        floor: (joints,) rad, the least residual deviation that a sensor of this resolution can show.
        tempered: all runs of a joint count alike, by their length: for laws all of which are wrong, by the error that they leave.
            Trusting each stretch as far as the model can follow it, as is done otherwise, lets a wrong model choose what it is
            judged by.
        trust: (parameters,) what their priors weigh: 1, or next to nothing where the data contradict them; found by `solve`.
        left_out: (rows,) of all datasets that nothing is fitted to: they are simulated, and count for nothing; None: no row.
    """

    datasets: Sequence[Dataset]
    parameters: Sequence[Parameter]
    floor: Array
    tempered: bool = False
    trust: Array = field(default_factory=lambda: np.ones(0))
    left_out: Bools | None = None

    def __post_init__(self) -> None:
        self._model = ForwardModel(self.datasets, self.parameters)
        self._weighing = Weighing(stretches(self.datasets, self.left_out), self.floor, self.tempered)
        self._valley = np.array([parameter.definition.valley for parameter in self.parameters], bool)
        self.centre: Array = np.array([parameter.centre for parameter in self.parameters])
        if not len(self.trust):
            self.trust = np.ones(len(self.parameters))

    @property
    def prior(self) -> Prior:
        """Of unit deviation, but where the data contradict it."""
        return Prior(self.centre, self.trust**2, self._model.low, self._model.high)

    def solve(self, start: Array | None = None, progress: Progress | None = None) -> Estimate:
        """Fit, re-weight, and fit again until the weights settle; from both ends where the cost is known to have valleys.

        Weights that the priors' misfit made can settle too: far from the truth residuals are correlated, the data count
        for little, and the priors hold the estimate where it is. So unless what is left is white, the data lead once
        with the priors all but ignored, and the weights settle from there. Where the model is right, that ends in what
        sensors leave, which is short-lived; where it is not, the better posterior counts.

        Args:
            start: (parameters,) first guess in prior deviations; default the prior.
            progress: called with what is being done and the share that is done.
        """
        follow = self._following(progress)
        found = self._best(follow("fitting", *(self._descend(u) for u in self._starts(start))))
        (found,) = follow("following the data", self._further(found))
        return estimate(found, self._model, self._weighing, self.prior, self._score(found.point))

    def solve_without(
        self,
        left_out: Sequence[Bools],
        found: Descent,
        starts: Sequence[Array] = (),
        held: Sequence[Bools] = (),
        progress: Progress | None = None,
    ) -> list[Posterior]:
        """What the other rows say, where some are left out: for each choice of them, all choices side by side.

        Where all rows lead is near where most of them do; that it is only the start says nothing of those left out. Derivatives
        taken there serve as long as they keep what they promise, so that most of these fits take a few simulations.

        Args:
            left_out: for each fit, (rows,) of all datasets, what it does not see.
            found: where the fit to all of them ended.
            starts: for each fit, (parameters,) u where it begins; default where that one ended.
            held: for each fit, (parameters,) what stays where it begins; default nothing.
            progress: as `solve` calls it.
        """
        others = [replace(self, left_out=rows, trust=self.trust.copy()) for rows in left_out]
        begun = [
            other._from(found, starts[k] if starts else None, held[k] if held else None)
            for k, other in enumerate(others)
        ]
        ends = self._following(progress)("leaving runs out in turn", *begun)
        return [posterior(one, other._weighing, other.prior) for one, other in zip(ends, others, strict=True)]

    def _following(self, progress: Progress | None) -> Callable[..., list[Descent]]:
        left = 1.0

        def follow(what: str, *descents: Steps) -> list[Descent]:
            def tell() -> None:
                nonlocal left
                left *= 1 - TOLD
                if progress:
                    progress(1 - left, what)

            return side_by_side(
                descents,
                lambda asked: self._model.look([one.u for one in asked.values()]),
                lambda asked: self._model.derive(list(asked.values())),
                tell,
            )

        return follow

    def _from(self, found: Descent, start: Array | None, held: Bools | None) -> Steps:
        tangent = replace(found.tangent, change=found.tangent.change.copy())  # a descent changes it
        point = found.point if start is None else (yield Look(start))
        return (yield from self._approach(point, enough=NEARER, held=held, tangent=tangent))

    def _further(self, found: Descent) -> Steps:
        """Once more from where the data lead alone, if what is left may have something in it that the priors kept from view."""
        weights = self._weighing(found.point)
        lasting = weights.correlation_s >= WHITE * self._weighing.period
        if not (lasting & (weights.noise > CLEAN * self.floor)).any():
            return found
        for lead in (self._by_other_zeros(), self._by_data_alone(found)):
            led = yield from lead
            if led is None:
                continue
            before, score = self.trust, self._score(found.point)
            away = np.abs(led - self.centre)
            # However far the data lead: what is left of the prior must not pull them back.
            self.trust = np.where(away > CONFLICT, np.minimum(LOOSE, 1 / np.maximum(away, CONFLICT)), before)
            again = yield from self._descend(led)
            if self._explains(again, weights) or self._score(again.point) < score - DECISIVE:
                return again
            self.trust = before
        return found

    def _starts(self, start: Array | None) -> list[Array]:
        prior = self.prior
        first = np.clip(self.centre if start is None else start, prior.low, prior.high)
        if start is not None:
            return [first]
        first = self._with_delays(first)
        if not self._valley.any():
            return [first]
        ends = np.where(np.isfinite(prior.low), prior.low, first)
        return [first, *(np.where(self._valley, ends * share + first * (1 - share), first) for share in (1.0, 0.5))]

    def _with_delays(self, u: Array) -> Array:
        """u with the delays among DELAYS_S that leave less than half of what none leaves, joint by joint.

        Where a motion is fast a delay of more than a quarter of its period lies in another valley.
        """
        delayed = [p for p, parameter in enumerate(self.parameters) if parameter.kind == ACTION_DELAY]
        if not delayed:
            return u
        prior, tried = self.prior, [u]
        for delay in DELAYS_S:
            moved = u.copy()
            for p in delayed:
                moved[p] = np.clip(delay / self.parameters[p].std, prior.low[p], prior.high[p])
            tried.append(moved)
        left = np.array([np.nansum(point.residual**2, axis=0) for point in self._model.look(tried)])  # (tried, joints)
        out = u.copy()
        for p in delayed:
            squares = left[:, list(self.parameters[p].joints)].sum(axis=1)
            best = int(np.argmin(squares))
            if squares[best] < 0.5 * squares[0]:
                out[p] = tried[best][p]
        return out

    def _by_other_zeros(self) -> Generator[Look | Derive, Any, Array | None]:
        """The prior with the zeros among ZEROS_RAD that leave less than half of what its own leaves, joint by joint; None where
        none does.

        Commands and positions go along with the zero, so that only gravity tells it: its pull has the other sign elsewhere.
        """
        plant = self.datasets[0].plant
        turns = plant.model.jnt_type[plant.model.dof_jntid[plant.dof]] == mujoco.mjtJoint.mjJNT_HINGE
        zeros = [
            p for p, one in enumerate(self.parameters) if one.kind == ZERO_OFFSET and turns[list(one.joints)].all()
        ]
        prior = self.prior
        first = np.clip(self.centre, prior.low, prior.high)
        tried = [first]
        for zero in ZEROS_RAD if zeros else ():
            moved = first.copy()
            moved[zeros] = [zero / self.parameters[p].std for p in zeros]
            tried.append(moved)
        left = []
        for u in tried if zeros else ():
            point = yield Look(u)
            left.append(np.nansum(point.residual**2, axis=0))
        out = first.copy()
        for p in zeros:
            squares = [float(one[list(self.parameters[p].joints)].sum()) for one in left]
            best = int(np.argmin(squares))
            if squares[best] < 0.5 * squares[0]:
                out[p] = tried[best][p]
        return None if np.array_equal(out, first) else out

    def _descend(self, u: Array) -> Steps:
        """To the estimate that is reached from one start."""
        point = yield Look(u)
        # A servo works with torque on. What a falling leg adds is taken as far as it agrees with what the driven one
        # shows: the driven stretches are fitted alone first, and the others enter with the weight that this leaves them.
        if self._weighing.limp and not self.tempered:
            # Nothing in driven stretches tells the valleys; their prior alone must not move them out of theirs.
            driven = yield from self._approach(point, enough=NEAR, driven_only=True, held=self._valley)
            point = driven.point
        near = yield from self._approach(point, enough=NEAR)
        # Differences to one side are good enough to get near. Where parameters almost undo each other (all torques a
        # per cent larger) they are not: there the minimum and the intervals come from both sides.
        return (yield from self._approach(near.point, central=True))

    def _approach(
        self,
        point: Point,
        *,
        enough: float = ARRIVED,
        central: bool = False,
        driven_only: bool = False,
        held: Bools | None = None,
        tangent: Tangent | None = None,
    ) -> Steps:
        # On the floor contacts chatter otherwise in long steps: these are good for a direction only.
        coarse = self._model.coarse and not (central and self._model.on_floor)
        return descend(
            point,
            self.prior,
            lambda there: self._weighing(there, driven_only=driven_only).each,
            enough=enough,
            rounds=FORESEEN,
            central=central,
            coarse=coarse,
            least=self._model.differences,
            held=held,
            tangent=tangent,
        )

    def _by_data_alone(self, found: Descent) -> Generator[Look | Derive, Any, Array | None]:
        """To where the data lead with the priors all but ignored, as if all that is left were the sensors' noise.

        None where a second descent could not win: derivatives taken there promise no step worth the name. (Those that a
        descent has corrected on its way say little of parameters that it hardly moved.)
        """
        point, prior = found.point, self.prior
        weight = self._weighing.counts(point.residual) / self.floor
        loose = replace(prior, precision=LOOSE**2 * prior.precision)
        tangent = yield Derive(point, True, self._model.coarse and not self._model.on_floor)
        hessian, gradient = tangent.normal(point, weight, loose)
        step = loose.step(hessian, gradient, point.u)
        if np.abs(step).max(initial=0.0) < STALE:
            moved = replace(point, u=point.u + step, residual=point.residual + tangent.along(step))
            if self._score(moved) > self._score(point) - DECISIVE:
                return None
        led = yield from descend(
            point,
            loose,
            lambda there: weight,
            coarse=self._model.coarse,
            least=self._model.differences,
            tangent=tangent,
        )
        return led.point.u

    def _best(self, descents: Sequence[Descent]) -> Descent:
        """Posteriors that are as good as each other are told apart by what they leave, in plain rad."""
        scores = [self._score(found.point) for found in descents]
        equal = [found for found, score in zip(descents, scores, strict=True) if score < min(scores) + DECISIVE]
        return min(equal, key=lambda found: float(np.nansum(found.point.residual**2)))

    def _explains(self, again: Descent, before: Weights) -> bool:
        """Whether a descent leaves what sensors leave, and earlier weights say that another left more."""
        times = self._weighing(again.point).correlation_s
        short_lived = bool((times < SHORT_LIVED * self._weighing.period).all())
        return short_lived and bool(times.mean() < before.correlation_s.mean())

    def _score(self, point: Point) -> float:
        """−log posterior with unknown noise: compares starts."""
        away = (point.u - self.centre) ** 2
        prior = 0.5 * float(np.sum(np.where(self.trust < 1, np.minimum(away, CONFLICT**2), away)))
        return prior + self._weighing.score(point.residual)
