"""Bounded nonlinear least squares where residuals are costly: Gauss–Newton in a box, with derivatives that are kept.

The cost is ½ Σ (weight · residual)² + ½ Σ precision (u − centre)². A descent asks for residuals (`Look`) and derivatives
(`Derive`) and goes on with the answer, so that many descents go side by side and what they ask for is simulated in one
batch (`side_by_side`). Nothing here knows what is simulated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

__all__ = ["ARRIVED", "STALE", "Derive", "Descent", "Look", "Movers", "Point", "Prior", "Steps", "Tangent", "descend", "side_by_side"]  # fmt: skip

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
#: for each channel, the unknowns that move it and their colours
Movers = Sequence[tuple[Ints, Ints]]

#: steps at most
MOST_STEPS = 20
#: prior deviations: the longest step, and how far from where it was taken a Jacobian is believed
REACH, STALE = 3.0, 1.5
#: so near the Jacobian's own place, prior deviations, it is as good as one taken anew
SAME_PLACE = 0.3
#: squared length of a step in posterior deviations, per unknown, below which a descent has arrived for good
ARRIVED = 0.002
#: shares of the promised gain: below the first a step is taken back; a Jacobian that keeps less than the second is stale
WORSE, BROKEN = 0.05, 0.4
#: nats per unknown that are not worth new derivatives; steps in a row that are refused before none is any good
TRIFLE, MOST_REFUSED = 0.05, 2
#: by which bounds are wider than what lies on them
TINY = 1e-12


@dataclass(frozen=True)
class Prior:
    """Where unknowns are likely, and between which ends they lie.

    Attributes:
        centre, precision: (unknowns,) the middle of each one's prior, and 1 / variance.
        low, high: (unknowns,)
    """

    centre: Array
    precision: Array
    low: Array
    high: Array

    def cost(self, u: Array) -> float:
        away = u - self.centre
        return 0.5 * float(away @ (self.precision * away))

    def step(
        self, hessian: Array, gradient: Array, u: Array, reach: float = math.inf, held: Bools | None = None
    ) -> Array:
        """The best step of the quadratic with this Hessian and gradient from u, within bounds and `reach`; none of the held."""
        out = np.zeros(len(u))
        free = self.high > self.low if held is None else ~held & (self.high > self.low)
        if not free.any():
            return out
        inside = hessian[np.ix_(free, free)]
        low = np.clip(self.low[free] - u[free], -reach, 0.0)
        high = np.clip(self.high[free] - u[free], 0.0, reach)
        plain = -np.linalg.solve(inside, gradient[free])
        if (plain >= low).all() and (plain <= high).all():
            out[free] = plain
        else:
            # What ends at a bound leaves its part to the others: clipped afterwards it would leave it undone.
            root = np.linalg.cholesky(inside)
            bounds = np.minimum(low, -TINY), np.maximum(high, TINY)
            out[free] = lsq_linear(root.T, -np.linalg.solve(root, gradient[free]), bounds, method="bvls").x
        return np.clip(u + out, self.low, self.high) - u


@dataclass(frozen=True)
class Point:
    """What is known at one u: (rows, channels) residual, NaN where missing; and how fast what is simulated moves, per s."""

    u: Array
    residual: Array
    velocity: Array


@dataclass(frozen=True)
class Tangent:
    """Derivatives of the residuals at u: `change`, (colours, rows, channels); unknowns that share no channel share a colour."""

    u: Array
    movers: Movers
    change: NDArray[np.float32]

    def moves(self, j: int) -> Array:
        """(movers, rows): how channel j's residual moves with each unknown that moves it."""
        return self.change[self.movers[j][1], :, j].astype(np.float64)

    def along(self, step: Array) -> Array:
        """(rows, channels): what a step does to the residuals, to first order."""
        return np.stack([step[p] @ self.moves(j) for j, (p, _) in enumerate(self.movers)], axis=1)

    def normal(self, point: Point, weight: Array, prior: Prior) -> tuple[Array, Array]:
        """Hessian (unknowns, unknowns) and gradient of the cost, the prior included; `weight` as the residuals."""
        hessian = np.diag(prior.precision)
        gradient = prior.precision * (point.u - prior.centre)
        for j, (p, _) in enumerate(self.movers):
            weighted = self.moves(j) * weight[:, j]
            hessian[np.ix_(p, p)] += weighted @ weighted.T
            gradient[p] += weighted @ (weight[:, j] * np.nan_to_num(point.residual[:, j]))
        return hessian, gradient

    def correct(self, step: Array, moved: Array) -> None:
        """Let derivatives hold for a step just taken and for what it did, and change no more (Broyden 1965), in place."""
        for j, (p, colour) in enumerate(self.movers):
            along = step[p]
            if along @ along > 0:
                missing = np.nan_to_num(moved[:, j]) - along @ self.change[colour, :, j]
                self.change[colour, :, j] += np.outer(along / (along @ along), missing)


@dataclass(frozen=True)
class Look:
    """Asks for the `Point` at u."""

    u: Array


@dataclass(frozen=True)
class Derive:
    """Asks for the `Tangent` at a point; `central`: from both sides; `coarse`: a direction is enough."""

    point: Point
    central: bool
    coarse: bool


@dataclass(frozen=True)
class Descent:
    """Where a descent ended, and the derivatives there."""

    point: Point
    tangent: Tangent
    converged: bool


#: a descent under way: what it asks for, the answers, where it ends
Steps = Generator[Look | Derive, Any, Descent]


def side_by_side(
    descents: Sequence[Steps],
    look: Callable[[Mapping[int, Look]], Sequence[Point]],
    derive: Callable[[Mapping[int, Derive]], Sequence[Tangent]],
    tell: Callable[[], None] = lambda: None,
) -> list[Descent]:
    """Follow descents to their ends, answering all that they ask for at a time at once.

    Args:
        look, derive: from what is asked, by the number of who asks it, to the answers in the same order.
        tell: called after each answer.
    """
    ended: dict[int, Descent] = {}
    answers: dict[int, Point | Tangent | None] = dict.fromkeys(range(len(descents)))
    while answers:
        looks, derivatives = {}, {}
        for k, answer in answers.items():
            try:
                asked = descents[k].send(answer)
            except StopIteration as end:
                ended[k] = end.value
                continue
            if isinstance(asked, Look):
                looks[k] = asked
            else:
                derivatives[k] = asked
        answers = {}
        if looks:
            answers |= zip(looks, look(looks), strict=True)
            tell()
        if derivatives:
            answers |= zip(derivatives, derive(derivatives), strict=True)
            tell()
    return [ended[k] for k in range(len(descents))]


@dataclass(frozen=True)
class _Step:
    """A step with the weights that it leads to, and the quadratic that promises it."""

    by: Array
    weight: Array
    hessian: Array
    gradient: Array

    @property
    def length(self) -> float:
        return _length(self.by, self.hessian)

    @property
    def promised(self) -> float:
        """Nats."""
        return -float(self.gradient @ self.by + 0.5 * self.by @ self.hessian @ self.by)


def descend(
    point: Point,
    prior: Prior,
    weigh: Callable[[Point], Array],
    *,
    enough: float = ARRIVED,
    rounds: int = 1,
    central: bool = False,
    coarse: bool = False,
    least: Array | float = 0.0,
    held: Bools | None = None,
    tangent: Tangent | None = None,
) -> Steps:
    """Gauss–Newton in a box, with derivatives that are kept as long as they keep what they promise.

    Args:
        point: where to start.
        weigh: (rows, channels) weights by what is left at a point.
        enough: squared length of a step, in posterior deviations and per unknown, that is not worth taking.
        rounds: in which a step and the weights that it leads to find each other, before anything is simulated.
        central: derivatives from both sides.
        coarse: derivatives that show a direction will do, until they do not.
        least: (unknowns,) derivatives learn nothing from a step that is shorter than this in all.
        held: unknowns that stay where they are.
        tangent: derivatives that are there already; they are changed.
    """
    damping, refused = 0.0, 0
    for _ in range(MOST_STEPS):
        if tangent is None:
            tangent = yield Derive(point, central, coarse)
        step = _best_step(point, tangent, prior, weigh, damping, held, enough, rounds)
        away = _longest(point.u - tangent.u)
        short = _longest(step.by) < SAME_PLACE
        reliable = away < SAME_PLACE or enough > ARRIVED
        arrived = step.length < (enough if short else ARRIVED)
        if arrived and reliable:
            return Descent(point, tangent, True)
        if arrived:
            tangent = None
            continue
        there = yield Look(point.u + step.by)
        gained = _cost(point, step.weight, prior) - _cost(there, step.weight, prior)
        kept = gained / max(step.promised, 1e-300)
        taken, broken = kept > WORSE, kept < BROKEN
        if taken:
            if (np.abs(step.by) > least).any():
                tangent.correct(step.by, there.residual - point.residual)
            point, refused = there, 0
            damping /= 10 if kept > BROKEN else 1
        settled = short and reliable
        if step.promised < TRIFLE * len(point.u) and (broken or settled):
            return Descent(point, tangent, True)  # what is left is no more than a hair's difference makes
        if not taken and away == 0.0:
            # Derivatives of this very place promise what is not there: they are too coarse, or the step too long.
            damping, refused = max(0.3, 5 * damping), refused + 1
            if coarse:
                coarse, tangent = False, None
            elif refused > MOST_REFUSED:
                return Descent(point, tangent, False)
        elif broken or _longest(point.u - tangent.u) > STALE:
            tangent = None
    if tangent is None:
        tangent = yield Derive(point, central, coarse)
    return Descent(point, tangent, False)


def _best_step(
    point: Point, tangent: Tangent, prior: Prior, weigh: Callable[[Point], Array],
    damping: float, held: Bools | None, enough: float, rounds: int,
) -> _Step:  # fmt: skip
    """Weights follow from what a step leaves, and the step from them: what derivatives foresee costs nothing."""
    by = np.zeros(len(point.u))
    for _ in range(rounds):
        weight = weigh(replace(point, residual=point.residual + tangent.along(by)))
        hessian, gradient = tangent.normal(point, weight, prior)
        damped = hessian + damping * np.diag(np.diag(hessian))
        before, by = by, prior.step(damped, gradient, point.u, REACH, held)
        if _length(by - before, hessian) < enough:
            break
    return _Step(by, weight, hessian, gradient)


def _length(step: Array, hessian: Array) -> float:
    """Squared, in posterior deviations, per unknown."""
    return float(step @ hessian @ step) / max(1, len(step))


def _cost(point: Point, weight: Array, prior: Prior) -> float:
    return 0.5 * float(np.nansum((weight * point.residual) ** 2)) + prior.cost(point.u)


def _longest(step: Array) -> float:
    return float(np.abs(step).max(initial=0.0))
