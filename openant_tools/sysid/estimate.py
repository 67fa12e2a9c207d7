"""What a fit found, and how well it is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from openant_tools.sysid.forward import ForwardModel
from openant_tools.sysid.intervals import halves, left_open, wider_by_blocks
from openant_tools.sysid.parameter import Parameter
from openant_tools.sysid.solve import Descent, Prior
from openant_tools.sysid.weights import Weighing

__all__ = ["CONFLICT", "Estimate", "Posterior", "estimate", "posterior"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: prior deviations beyond which the data contradict a prior that they are to be weighed against: one in 370
CONFLICT = 3.0
#: share of the time step's effect that is taken as unknown: the rule is of first order
RICHARDSON = 0.5


@dataclass(frozen=True)
class Posterior:
    """Where a fit ended, and what may lie about it.

    Attributes:
        u: (parameters,) in prior deviations.
        covariance: (parameters, parameters) of u, the prior included.
        centre: (parameters,) the middle of the prior.
        low, high: (parameters,) the physical bounds of u.
        precision: (parameters, parameters) of u, what the data alone say.
        prior_precision: (parameters,) of u: 1, or next to nothing where the prior would have held the estimate back.
    """

    u: Array
    covariance: Array
    centre: Array
    low: Array
    high: Array
    precision: Array
    prior_precision: Array

    @cached_property
    def narrow(self) -> Array:
        """(parameters, parameters) covariance of u as the residuals alone have it, the prior included."""
        return np.asarray(np.linalg.inv(self.precision + np.diag(self.prior_precision)), np.float64)

    @property
    def information(self) -> Array:
        """(parameters,) share of each one's precision that the data gave, all others free: 0 prior only, 1 data."""
        return 1.0 - np.diag(self.narrow) * self.prior_precision

    def with_given(self, back: Bools) -> Array:
        """u given that the parameters in `back` are at the given model's values (0), to first order.

        The mean of a normal posterior, conditioned: u_k − Σ_kb Σ_bb⁻¹ u_b.
        """
        u = self.u.copy()
        if back.any():
            cross = self.covariance[np.ix_(~back, back)]
            within = self.covariance[np.ix_(back, back)]
            u[~back] -= cross @ np.linalg.solve(within, u[back])
            u[back] = 0.0
            u[~back] = np.clip(u, self.low, self.high)[~back]
        return u


def posterior(found: Descent, weighing: Weighing, prior: Prior) -> Posterior:
    """To first order, where a descent ended."""
    both, _ = found.tangent.normal(found.point, weighing(found.point).each, prior)
    covariance = np.asarray(np.linalg.inv(both), np.float64)
    told = both - np.diag(prior.precision)
    return Posterior(found.point.u, covariance, prior.centre, prior.low, prior.high, told, prior.precision)


@dataclass(frozen=True)
class Estimate(Posterior):
    """What is known where a fit ended, with all that no residual can show in its covariance.

    Attributes:
        parameters: what was estimated.
        found: where the descent ended.
        step_shift: (parameters,) of u, by which a model with an infinitely small time step would be fitted otherwise.
        halves: (2, parameters) of u, what each half of the data alone would say (to first order); NaN where there is one.
        contradictory: (parameters,) whether the two halves differ by more than chance.
        contradicts: (parameters,) whether the estimate lies where the prior says that it cannot.
        noise: (joints,) rad, standard deviation of the residual per joint, of all datasets.
        correlation_s: (joints,) s, integrated autocorrelation time of the residual.
        stamp_error_s: s, standard deviation by which the rows' time stamps miss the moments of sampling, row by row.
        converged: whether the optimiser met its tolerances.
        score: nats, −log posterior: compares fits of the same parameters to the same runs; less is better.
    """

    parameters: tuple[Parameter, ...]
    found: Descent
    step_shift: Array
    halves: Array
    contradictory: Bools
    contradicts: Bools
    noise: Array
    correlation_s: Array
    stamp_error_s: float
    converged: bool
    score: float
    evaluations: int


def estimate(found: Descent, model: ForwardModel, weighing: Weighing, prior: Prior, score: float) -> Estimate:
    """What is known where a descent ended."""
    point, u = found.point, found.point.u
    weights = weighing(point)
    first = posterior(found, weighing, prior)
    precision = first.precision + np.diag(prior.precision)
    # A parameter at its bound cannot give way to what is left open; the others must hold all of it.
    free = (u > prior.low + 1e-6) & (u < prior.high - 1e-6)
    inside = np.ix_(free, free)
    give = np.zeros_like(precision)
    give[inside] = np.linalg.inv(precision[inside])
    open_ = give @ left_open(model, found, weights)
    # What the step does has a direction: most of it is known, and the rest is as uncertain as the rule is rough.
    by_step = point.residual.shape[1]
    step_shift = open_[:, by_step].copy()
    open_[:, by_step] *= RICHARDSON
    wider = wider_by_blocks(model.datasets, found, weights, precision, free)
    each, contradictory = halves(model.datasets, weighing, found, prior, free)
    return Estimate(
        parameters=tuple(model.parameters),
        found=found,
        u=u,
        covariance=np.outer(wider, wider) * first.covariance + open_ @ open_.T,
        step_shift=step_shift,
        precision=first.precision,
        centre=prior.centre,
        low=prior.low,
        high=prior.high,
        halves=each,
        contradictory=contradictory,
        contradicts=np.abs(u - prior.centre) > CONFLICT,
        prior_precision=prior.precision,
        noise=weights.noise,
        correlation_s=weights.correlation_s,
        stamp_error_s=weights.stamp_error_s,
        converged=found.converged,
        score=score,
        evaluations=model.evaluations,
    )
