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

import copy
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear, nnls
from scipy.stats import norm

from openant_tools.effects.catalogue import effect
from openant_tools.effects.rollout import EffectValues, rollout
from openant_tools.model.floor import steps
from openant_tools.model.gap import HORIZON_S, Gap, gap
from openant_tools.model.plant import Plant, Setup
from openant_tools.model.rollout import Rollouts, Trajectories
from openant_tools.recording.run import Run
from openant_tools.sysid.parameter import ACTION_DELAY, Parameter, apply, colours, delays, effect_values

__all__ = ["Dataset", "Estimate", "Problem", "autocorrelation_time"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Progress = Callable[[str, float], None]

#: finite-difference step in prior deviations: far above rounding and the solver's tolerance, and small enough that two
#: parameters which move a robot alike have columns alike (at 0.1 their curvature told them apart)
STEP = 0.03
#: on the floor contacts chatter, and small differences are that: of joints, and of what belongs to body and floor
FLOOR_STEP, FLOOR_STEP_OF_BODY = 0.1, 0.6
#: models about the estimate that are looked at for how contacts chatter
CHATTER_LOOKS = 4
#: steps at most, in each part of a descent
MOST_STEPS = 20
#: prior deviations: the longest first step, and how far from where it was taken a Jacobian is believed
REACH, STALE = 3.0, 1.5
#: so near the Jacobian's own place, prior deviations, it is as good as one taken anew
SAME_PLACE = 0.3
#: squared length of a step in posterior deviations, per parameter, below which a descent has arrived: near, if the step is short
#: in prior deviations too, and for good
NEAR, ARRIVED = 5.0, 0.002
#: the first where laws are compared that differ by little
NEAR_TEMPERED = 0.05
#: shares of the promised gain: below the first a step is taken back; a Jacobian that keeps less than the second is stale
WORSE, BROKEN = 0.05, 0.4
#: nats per parameter that are not worth new derivatives; shorter steps in a row that are tried where none is any good
TRIFLE, MOST_REFUSED = 0.05, 2
#: rounds in which a step and the weights that it leads to find each other, before anything is simulated
FORESEEN = 4
#: a residual this small, in deviations that the encoder alone makes, has nothing in it that a second descent could find
CLEAN = 1.5
#: one effective sample per this many seconds where fits are compared whose residuals are model error
TEMPER_S = 0.5
#: priors weigh this much where the data lead alone: only against directions of which the data say nothing
LOOSE = 0.1
#: prior deviations beyond which the data contradict a prior that they are to be weighed against: one in 370
CONFLICT = 3.0
#: a residual is white where it forgets itself within this many samples, and more than model error where within so many
WHITE, SHORT_LIVED = 1.5, 10
#: nats by which a posterior must be better to count as another one: less is where the descent happened to stop
DECISIVE = 1.0
#: half of the ±2 ms within which delays count as calibrated (effects.md)
TIMING_STD_S = 1e-3
#: s; the longest time step that derivatives are taken with, where the model's own is at most half of it
COARSEST_S = 0.004
#: share of the time step's effect that is taken as unknown: the rule is of first order
RICHARDSON = 0.5
#: delays (s) from which a fit starts where they explain the data far better than none
DELAYS_S = (0.02, 0.04, 0.06)
#: a block of the resampling is this many autocorrelation times long, and at least so many seconds; fewer blocks tell nothing
BLOCK_TIMES, BLOCK_S, FEWEST_BLOCKS = 5.0, 0.5, 8
#: share of the rows with the base's whole pose from which a robot on the floor can be put where it was
PLACED = 0.9
#: chance of calling two halves of good data contradictory, over all parameters of a fit
FALSE_ALARM = 1e-3
#: rounds in which each half finds its own weights
OWN_WEIGHTS = 4


@dataclass(frozen=True)
class Dataset:
    """Runs of one plant, prepared for rollouts at both horizons.

    Attributes:
        plant: the model as given, set up as these runs were made.
        runs: the recordings.
        measured: (rows, joints) rad, the runs' positions one after another.
        nthread: of the rollouts; 0 takes all cores.
        measured_supply: gains and torque limits follow the voltage that the runs logged.
        acting: effects between steps that the robot is known to have, in every simulation; at joints where a parameter
            says what an effect is, the parameter counts.
    """

    plant: Plant
    runs: tuple[Run, ...]
    measured: Array
    nthread: int = 0
    measured_supply: bool = False
    acting: EffectValues = field(default_factory=dict)

    @classmethod
    def prepare(
        cls,
        plant: Plant,
        runs: Sequence[Run],
        nthread: int = 0,
        *,
        measured_supply: bool = False,
        acting: EffectValues | None = None,
    ) -> Dataset:
        measured = np.concatenate([run.signal("pos", plant.joints) for run in runs])
        return cls(plant, tuple(runs), measured, nthread, measured_supply, acting or {})

    @cached_property
    def full(self) -> Rollouts:
        return Rollouts(self.plant, self.runs, None, self.nthread)

    @cached_property
    def horizon(self) -> Rollouts:
        return Rollouts(self.plant, self.runs, HORIZON_S, self.nthread)

    @cached_property
    def coarse(self) -> Dataset:
        """The same with twice the time step, where that is short enough: half the cost, and as good to find a direction."""
        if 2 * self.plant.timestep > COARSEST_S or self.plant.model.nhistory:
            return self
        return self.stepped(2.0)

    def stepped(self, times: float) -> Dataset:
        """The same with so many times the time step."""
        model = copy.copy(self.plant.model)
        model.opt.timestep *= times
        return replace(self, plant=replace(self.plant, model=model))

    @property
    def fitted(self) -> Rollouts:
        """What the fit compares: full runs, but on the floor, where contact makes long runs chaotic, the horizon.

        A robot whose base nobody measured, or a camera now and then, cannot be put back on its feet in mid-gait: such runs
        are compared whole too.
        """
        if self.plant.setup is not Setup.FLOOR:
            return self.full
        pose = [[run.column(f"base.{axis}") for axis in ("x", "y", "z", "qw")] for run in self.runs]
        placed = min(float(np.isfinite(columns).all(axis=0).mean()) for columns in pose)
        return self.horizon if placed > PLACED else self.full

    def simulate(
        self, parameters: Sequence[Parameter], us: Sequence[Array], rollouts: Rollouts | None = None
    ) -> Trajectories:
        """What the model would have done with the parameters at each u, (parameters,), by default as the fit compares."""
        rollouts = rollouts or self.fitted
        models, late = self._variants(parameters, us, rollouts)
        effects = [effect_values(self.plant, parameters, u, self.acting) for u in us]
        if self.measured_supply or any(effects):
            return rollout(rollouts, models, effects, late, measured_supply=self.measured_supply)
        return rollouts(models, late)

    def stream(
        self, parameters: Sequence[Parameter], us: Sequence[Array], rollouts: Rollouts | None = None
    ) -> Iterator[tuple[slice, Array, Array]]:
        """`simulate` piece by piece, so that no more than a piece of it is held: rows, positions, velocities."""
        rollouts = rollouts or self.fitted
        if self.measured_supply or any(effect_values(self.plant, parameters, u, self.acting) for u in us):
            whole = self.simulate(parameters, us, rollouts)  # effects act step by step on all runs at once
            return iter([(slice(0, whole.pos.shape[1]), whole.pos, whole.vel)])
        return rollouts.stream(*self._variants(parameters, us, rollouts))

    def _variants(
        self, parameters: Sequence[Parameter], us: Sequence[Array], rollouts: Rollouts
    ) -> tuple[list[mujoco.MjModel], Array | None]:
        models = [apply(rollouts.plant, parameters, u) for u in us]
        late = np.array([delays(self.plant, parameters, u) for u in us])
        return models, late if late.any() else None


@dataclass
class Estimate:
    """Where a fit ended.

    Attributes:
        parameters: what was estimated.
        u: (parameters,) in prior deviations.
        covariance: (parameters, parameters) of u, the prior included.
        step_shift: (parameters,) of u, by which a model with an infinitely small time step would be fitted otherwise.
        precision: (parameters, parameters) of u, what the data alone say.
        centre: (parameters,) the middle of the prior.
        low, high: (parameters,) the physical bounds of u.
        information: (parameters,) share of each parameter's posterior precision that the data gave: 0 prior only, 1 data.
        halves: (2, parameters) of u, what each half of the data alone would say (to first order); NaN where there is one.
        contradictory: (parameters,) whether the two halves differ by more than chance.
        contradicts: (parameters,) whether the estimate lies where the prior says that it cannot.
        prior_precision: (parameters,) of u: 1, or next to nothing where the prior would have held the estimate back.
        noise: (joints,) rad, standard deviation of the residual per joint, of all datasets.
        correlation_s: (joints,) s, integrated autocorrelation time of the residual.
        stamp_error_s: s, standard deviation by which the rows' time stamps miss the moments of sampling, row by row.
        converged: whether the optimiser met its tolerances.
    """

    parameters: tuple[Parameter, ...]
    u: Array
    covariance: Array
    step_shift: Array
    precision: Array
    centre: Array
    low: Array
    high: Array
    information: Array
    halves: Array
    contradictory: Bools
    contradicts: Bools
    prior_precision: Array
    noise: Array
    correlation_s: Array
    stamp_error_s: float
    converged: bool
    evaluations: int


def autocorrelation_time(residual: Array, limit: int) -> float:
    """Integrated autocorrelation time 1 + 2 Σ ρ_k in samples, summed until ρ first falls below zero (at most `limit` lags).

    Args:
        residual: (n,) evenly enough spaced; NaN counts as missing.
    """
    x = residual[np.isfinite(residual)]
    if len(x) < 4:
        return 1.0
    x = x - 0.0  # a bias is model error too and must not be subtracted
    n = len(x)
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(x, size)
    auto = np.fft.irfft(spectrum * np.conj(spectrum), size)[: min(limit, n - 1)]
    if auto[0] <= 0:
        return 1.0
    rho = auto / auto[0]
    below = np.flatnonzero(rho < 0.0)
    end = int(below[0]) if len(below) else len(rho)
    return float(max(1.0, 1.0 + 2.0 * rho[1:end].sum()))


@dataclass(frozen=True)
class _Point:
    """What the model does at one u: (rows, joints) measured minus simulated, rad, NaN where missing; and its speed, rad/s."""

    u: Array
    residual: Array
    velocity: Array


@dataclass(frozen=True)
class _Tangent:
    """Derivatives of the residuals at u, (colours, rows, joints): parameters that share no joint share a colour."""

    u: Array
    change: NDArray[np.float32]


@dataclass(frozen=True)
class _Descent:
    """Where a descent ended, and the derivatives there."""

    point: _Point
    tangent: _Tangent
    converged: bool


@dataclass(frozen=True)
class _Stretch:
    """Rows of one run with torque, or without: for each joint; and the run's median sample time (s)."""

    rows: tuple[Ints, ...]
    driven: bool
    period: float


@dataclass
class Problem:
    """A least-squares problem: parameters, the data they are judged by, and the weights of those data.

    Attributes:
        datasets: all with the same joints in the same order.
        parameters: the unknowns.
        floor: (joints,) rad, the least residual deviation that a sensor of this resolution can show.
        tempered: all runs of a joint count alike, by their length, as one observation per TEMPER_S: to compare models all
            of which are wrong by the error that they leave. Trusting each stretch as far as the model can follow it, as is
            done otherwise, lets a wrong model choose what it is judged by.
        freed: (parameters,) whose priors the data contradict, so that they count for next to nothing; found by `solve`.
    """

    datasets: Sequence[Dataset]
    parameters: Sequence[Parameter]
    floor: Array
    tempered: bool = False
    freed: Bools = field(default_factory=lambda: np.zeros(0, bool))
    evaluations: int = field(default=0, init=False)
    _prior_weight: float = field(default=1.0, init=False)

    def __post_init__(self) -> None:
        nj = len(self.datasets[0].plant.joints)
        self._stretches = self._find_stretches()
        self._has_limp = any(not stretch.driven for stretch in self._stretches)
        self._weight: Array = np.ones((sum(len(data.measured) for data in self.datasets), nj))
        self.noise, self.correlation_s, self.stamp_error_s = np.zeros(nj), np.zeros(nj), 0.0
        self._valley = np.array([parameter.definition.valley for parameter in self.parameters], bool)
        floor = any(data.plant.setup is Setup.FLOOR for data in self.datasets)
        shared = any(effect(name).shared for data in self.datasets for name, _ in data.acting)
        self._colours = colours(self.datasets[0].plant, self.parameters, coupled=floor or shared)
        self._on_floor = floor
        # Laws that are compared shall differ in nothing but themselves.
        self._coarse = not self.tempered and any(data.coarse is not data for data in self.datasets)
        chattering = [FLOOR_STEP_OF_BODY if p.definition.body else FLOOR_STEP for p in self.parameters]
        self._differences = np.array(chattering if self._on_floor else [STEP] * len(self.parameters))
        #: for each joint, the parameters that move it and their colours
        self._movers: list[tuple[Ints, Ints]] = []
        for j in range(nj):
            pairs = [
                (p, c)
                for c, (members, masks) in enumerate(self._colours)
                for p, mask in zip(members, masks, strict=True)
                if mask[j]
            ]
            self._movers.append((np.array([p for p, _ in pairs], np.int64), np.array([c for _, c in pairs], np.int64)))
        low, high = [], []
        for parameter in self.parameters:
            kind = parameter.definition
            ends = [
                parameter.bounds(kind.read(data.plant.model, data.plant, j))
                for data in self.datasets
                if parameter.belongs(data.plant)
                for j in parameter.joints
            ]
            # Of a gain whose runs are all left out nothing is known but its prior.
            low.append(max((end[0] for end in ends), default=-np.inf))
            high.append(min((end[1] for end in ends), default=np.inf))
        self.low, self.high = np.array(low), np.array(high)
        self.centre = np.array([parameter.centre for parameter in self.parameters])
        self._free(self.freed if len(self.freed) else np.zeros(len(self.parameters), bool))

    def _free(self, freed: Bools) -> None:
        self.freed = freed
        self._prior: Array = np.where(freed, LOOSE, 1.0) ** 2

    def gaps(self, u: Array, datasets: Sequence[Dataset] | None = None) -> Gap:
        """The gap of the model at u on these datasets (default: the problem's own), at both horizons."""
        return gaps(datasets or self.datasets, self.parameters, [u])[0]

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
        first = np.clip(self.centre if start is None else start, self.low, self.high)
        starts = [first]
        if start is None:
            starts = [self._with_delays(first)]
            if self._valley.any():
                ends = np.where(np.isfinite(self.low), self.low, starts[0])
                starts += [
                    np.where(self._valley, ends * share + starts[0] * (1 - share), starts[0]) for share in (1.0, 0.5)
                ]
        told = 0.0

        def tell(what: str) -> None:
            # How many steps a descent takes nobody knows beforehand; what is left halves every dozen.
            nonlocal told
            told += (1.0 - told) * 0.06
            if progress:
                progress(what, told)

        descents = [self._descend(u, lambda: tell("fitting")) for u in starts]
        scores = [self._score(found.point) for found in descents]
        # Posteriors that are as good as each other are told apart by what they leave, in plain rad.
        equal = [k for k, score in enumerate(scores) if score < min(scores) + DECISIVE]
        chosen = min(equal, key=lambda k: float(np.nansum(descents[k].point.residual ** 2)))
        score, found = scores[chosen], descents[chosen]
        self._reweigh(found.point)
        times = self.correlation_s
        period = max(stretch.period for stretch in self._stretches)
        if ((times >= WHITE * period) & (self.noise > CLEAN * self.floor)).any():
            led = self._by_data_alone(found, lambda: tell("following the data alone"))
            if led is not None:
                before = self.freed
                self._free(before | (np.abs(led - self.centre) > CONFLICT))
                again = self._descend(led, lambda: tell("fitting once more"))
                self._reweigh(again.point)
                short_lived = bool((self.correlation_s < SHORT_LIVED * period).all())
                better = short_lived and self.correlation_s.mean() < times.mean()
                if better or self._score(again.point) < score - DECISIVE:
                    found = again
                else:
                    self._free(before)
        return self._estimate(found)

    def _with_delays(self, u: Array) -> Array:
        """u with the delays among DELAYS_S that leave less than half of what none leaves, joint by joint.

        Where a motion is fast a delay of more than a quarter of its period lies in another valley.
        """
        delayed = [p for p, parameter in enumerate(self.parameters) if parameter.kind == ACTION_DELAY]
        if not delayed:
            return u
        tried = [u]
        for delay in DELAYS_S:
            moved = u.copy()
            for p in delayed:
                moved[p] = np.clip(delay / self.parameters[p].std, self.low[p], self.high[p])
            tried.append(moved)
        left = np.nansum(self._residuals(tried) ** 2, axis=1)  # (tried, joints)
        out = u.copy()
        for p in delayed:
            squares = left[:, list(self.parameters[p].joints)].sum(axis=1)
            best = int(np.argmin(squares))
            if squares[best] < 0.5 * squares[0]:
                out[p] = tried[best][p]
        return out

    def _residuals(self, us: Sequence[Array]) -> Array:
        """(variants, rows, joints) rad, measured minus simulated; NaN where something is missing."""
        self.evaluations += len(us)
        return np.concatenate(
            [data.measured[None] - data.simulate(self.parameters, us).pos for data in self.datasets], axis=1
        )

    def _look(self, u: Array) -> _Point:
        self.evaluations += 1
        simulated = [data.simulate(self.parameters, [u]) for data in self.datasets]
        measured = [data.measured for data in self.datasets]
        residual = [there - made.pos[0] for there, made in zip(measured, simulated, strict=True)]
        return _Point(u, np.concatenate(residual), np.concatenate([made.vel[0] for made in simulated]))

    def _by_data_alone(self, found: _Descent, tell: Callable[[], None]) -> Array | None:
        """Where the data lead with the priors all but ignored, as if all that is left were the sensors' noise.

        None where a second descent could not win: derivatives taken there promise no step worth the name. (Those that a
        descent has corrected on its way say little of parameters that it hardly moved.)
        """
        tangent = self._tangent(found.point, True, self._coarse and not self._on_floor)
        self._weight = np.broadcast_to(1.0 / self.floor, self._weight.shape)
        self._prior_weight = LOOSE
        try:
            precision, gradient = self._normal(tangent, found.point)
            step = self._step(precision, gradient, found.point.u, math.inf, np.zeros(len(gradient), bool))
            if np.abs(step).max(initial=0.0) < STALE:
                moved = found.point.residual + self._along(tangent, step)
                promised = self._score(replace(found.point, u=found.point.u + step, residual=moved))
                if promised > self._score(found.point) - DECISIVE:
                    return None
            return self._approach(found.point, tell, reweigh=False, tangent=tangent).point.u
        finally:
            self._prior_weight = 1.0

    def _descend(self, u: Array, tell: Callable[[], None]) -> _Descent:
        """The estimate reached from one start."""
        point = self._look(u)
        tell()
        # A servo works with torque on. What a falling leg adds is taken as far as it agrees with what the driven one
        # shows: the driven stretches are fitted alone first, and the others enter with the weight that this leaves them.
        if self._has_limp and not self.tempered:
            # Nothing in driven stretches tells the valleys; their prior alone must not move them out of theirs.
            point = self._approach(point, tell, enough=NEAR, driven_only=True, held=self._valley).point
        near = self._approach(point, tell, enough=NEAR_TEMPERED if self.tempered else NEAR)
        # Differences to one side are good enough to get near. Where parameters almost undo each other (all torques a
        # per cent larger) they are not: there the minimum and the intervals come from both sides.
        return self._approach(near.point, tell, central=True)

    def _approach(
        self,
        point: _Point,
        tell: Callable[[], None],
        *,
        enough: float = ARRIVED,
        central: bool = False,
        reweigh: bool = True,
        driven_only: bool = False,
        held: Bools | None = None,
        tangent: _Tangent | None = None,
    ) -> _Descent:
        """Gauss–Newton in a box, with derivatives that are kept as long as they keep what they promise.

        Args:
            enough: squared length of a step, in posterior deviations and per parameter, that is not worth taking.
            central: derivatives from both sides.
            reweigh: weigh anew by what is left before every step.
            driven_only: leave out what was recorded without torque.
            held: parameters that stay where they are.
            tangent: derivatives that are there already.
        """
        held = np.zeros(len(point.u), bool) if held is None else held
        # On the floor contacts chatter otherwise in long steps: these are good for a direction only.
        coarse, damping, refused = self._coarse and not (central and self._on_floor), 0.0, 0
        for _ in range(MOST_STEPS):
            if tangent is None:
                tangent = self._tangent(point, central, coarse)
                tell()
            step = np.zeros(len(point.u))
            for _ in range(FORESEEN if reweigh and not self.tempered else 1):
                # Weights follow from what a step leaves, and the step from them: what the derivatives foresee costs nothing.
                if reweigh:
                    foreseen = replace(point, residual=point.residual + self._along(tangent, step))
                    self._reweigh(foreseen, driven_only)
                precision, gradient = self._normal(tangent, point)
                damped = precision + damping * np.diag(np.diag(precision))
                before, step = step, self._step(damped, gradient, point.u, REACH, held)
                if (step - before) @ precision @ (step - before) < enough * len(step):
                    break
            away = float(np.abs(point.u - tangent.u).max(initial=0.0))
            short = self.tempered or float(np.abs(step).max(initial=0.0)) < SAME_PLACE
            if step @ precision @ step < (enough if short else ARRIVED) * len(step):
                if away < SAME_PLACE or enough > ARRIVED:
                    return _Descent(point, tangent, True)
                tangent = None
                continue
            there = self._look(point.u + step)
            tell()
            promised = -float(gradient @ step + 0.5 * step @ precision @ step)
            kept = (self._cost(point) - self._cost(there)) / max(promised, 1e-300)
            if kept > WORSE:
                if self.tempered or (np.abs(step) > self._differences).any():
                    # A shorter step than the differences themselves tells less than they do, and more of stiction.
                    self._correct(tangent, step, there.residual - point.residual)
                point = there
                damping, refused = damping / 10 if kept > BROKEN else damping, 0
            settled = short and not self.tempered and (away < SAME_PLACE or enough > ARRIVED)
            if promised < TRIFLE * len(step) and (kept < BROKEN or settled):
                return _Descent(point, tangent, True)  # what friction makes of a hair's difference is all that is left
            if kept <= WORSE and away == 0.0:
                damping, refused = max(0.3, 5 * damping), refused + 1
                if coarse:
                    coarse, tangent = False, None
                elif refused > MOST_REFUSED:
                    return _Descent(point, tangent, False)
                continue
            if kept < BROKEN or np.abs(point.u - tangent.u).max() > STALE:
                tangent = None
        return _Descent(point, tangent or self._tangent(point, central, coarse), False)

    def _step(self, precision: Array, gradient: Array, u: Array, reach: float, held: Bools) -> Array:
        """The best step of the quadratic with this Hessian and gradient, within bounds and `reach`."""
        out = np.zeros(len(u))
        free = ~held & (self.high > self.low)
        if not free.any():
            return out
        root = np.linalg.cholesky(precision[np.ix_(free, free)])
        low = np.clip(self.low[free] - u[free], -reach, 0.0)
        high = np.clip(self.high[free] - u[free], 0.0, reach)
        plain = -np.linalg.solve(precision[np.ix_(free, free)], gradient[free])
        if (plain >= low).all() and (plain <= high).all():
            out[free] = plain
        else:
            low, high = np.minimum(low, -1e-12), np.maximum(high, 1e-12)
            target = -np.linalg.solve(root, gradient[free])
            out[free] = lsq_linear(root.T, target, (low, high), method="bvls").x
        return np.clip(u + out, self.low, self.high) - u

    def _cost(self, point: _Point) -> float:
        weighted = self._weight * point.residual
        away = self._prior_weight * (point.u - self.centre)
        return 0.5 * float(np.nansum(weighted**2) + away @ (self._prior * away))

    def _normal(self, tangent: _Tangent, point: _Point, rows: Bools | None = None) -> tuple[Array, Array]:
        """Hessian (parameters, parameters) and gradient of the cost, the prior included; of some rows where they are named."""
        prior = self._prior_weight**2 * self._prior
        hessian = np.diag(prior)
        gradient = prior * (point.u - self.centre)
        for j, (p, _) in enumerate(self._movers):
            moves = self._moves(tangent, j)
            weight = self._weight[:, j] if rows is None else self._weight[:, j] * rows
            weighted = moves * weight
            hessian[np.ix_(p, p)] += weighted @ weighted.T
            gradient[p] += weighted @ (weight * np.nan_to_num(point.residual[:, j]))
        return hessian, gradient

    def _moves(self, tangent: _Tangent, j: int) -> Array:
        """(movers, rows): how joint j's residual moves with each parameter that moves it."""
        return tangent.change[self._movers[j][1], :, j].astype(np.float64)

    def _along(self, tangent: _Tangent, step: Array) -> Array:
        """(rows, joints): what a step does to the residuals, to first order."""
        return np.stack([step[p] @ self._moves(tangent, j) for j, (p, _) in enumerate(self._movers)], axis=1)

    def _correct(self, tangent: _Tangent, step: Array, moved: Array) -> None:
        """Let derivatives hold for a step just taken and for what it did, and change no more (Broyden 1965), in place."""
        for j, (p, colour) in enumerate(self._movers):
            along = step[p]
            if along @ along > 0:
                missing = np.nan_to_num(moved[:, j]) - along @ tangent.change[colour, :, j]
                tangent.change[colour, :, j] += np.outer(along / (along @ along), missing)

    def _estimate(self, found: _Descent) -> Estimate:
        point, tangent = found.point, found.tangent
        u, n = point.u, len(point.u)
        self._reweigh(point)
        precision, _ = self._normal(tangent, point)
        covariance = np.asarray(np.linalg.inv(precision), np.float64)
        # A parameter at its bound cannot give way to what is left open; the others must hold all of it.
        free = (u > self.low + 1e-6) & (u < self.high - 1e-6)
        give = np.zeros((n, n))
        give[np.ix_(free, free)] = np.linalg.inv(precision[np.ix_(free, free)])
        open_ = give @ self._left_open(tangent, point)
        # What the step does has a direction: most of it is known, and the rest is as uncertain as the rule is rough.
        by_step = point.residual.shape[1]
        step_shift = open_[:, by_step].copy()
        open_[:, by_step] *= RICHARDSON
        wider = self._wider_by_blocks(tangent, point, covariance, free)
        halves, contradictory = self._halves(tangent, point, free)
        return Estimate(
            parameters=tuple(self.parameters),
            u=u,
            covariance=np.outer(wider, wider) * covariance + open_ @ open_.T,
            step_shift=step_shift,
            precision=precision - np.diag(self._prior),
            centre=self.centre,
            low=self.low,
            high=self.high,
            # What the data, all other parameters free, say about each: 1 − posterior variance over prior variance.
            information=1.0 - np.diag(covariance) * self._prior,
            halves=halves,
            contradictory=contradictory,
            contradicts=np.abs(u - self.centre) > CONFLICT,
            prior_precision=self._prior,
            noise=self.noise,
            correlation_s=self.correlation_s,
            stamp_error_s=self.stamp_error_s,
            converged=found.converged,
            evaluations=self.evaluations,
        )

    def _left_open(self, tangent: _Tangent, point: _Point) -> Array:
        """(parameters, causes): how what no residual can show pulls at each parameter.

        One standard deviation of each joint's sampling time, all that the time step does, and how contacts chatter.
        """
        late = self._late(point) * self._weight**2
        shared = [part * self._weight**2 for part in (self._time_step(point), *self._chatter(tangent, point))]
        out = np.zeros((len(self.parameters), late.shape[1] + len(shared)))
        for j, (p, _) in enumerate(self._movers):
            moves = self._moves(tangent, j)
            out[p, j] = moves @ late[:, j]
            for k, part in enumerate(shared):
                out[p, late.shape[1] + k] += moves @ part[:, j]
        return out

    def _chatter(self, tangent: _Tangent, point: _Point) -> list[Array]:
        """(rows, joints) rad each: what models near the estimate do beyond the tangent, on the floor.

        There a hair's difference lets a foot slip a moment earlier, and the rest of the run is another. A robot is such a model
        too: no estimate is better than that.
        """
        if not self._on_floor:
            return []
        chance, out = np.random.default_rng(0), []
        for _ in range(CHATTER_LOOKS):
            moved = np.clip(point.u + self._differences * chance.standard_normal(len(point.u)), self.low, self.high)
            beyond = self._look(moved).residual - point.residual - self._along(tangent, moved - point.u)
            out.append(np.nan_to_num(beyond) / math.sqrt(CHATTER_LOOKS))
        return out

    def _late(self, point: _Point) -> Array:
        """(rows, joints) rad: what one standard deviation of each joint's unknown sampling time does to its position.

        A bus log's `t` is when the read begins; a servo samples at some moment before the last byte of its answer. What
        the stamps leave open, the intervals of the parameters must hold: a millisecond is several per cent of a servo's
        lag. The moment is taken as anywhere in the round trip where that is logged; and a servo acts on a command, and
        notes where it is, once in a period of its own.
        """
        late = np.full(point.velocity.shape, TIMING_STD_S)
        offset = 0
        for data in self.datasets:
            for run, part in zip(data.runs, data.fitted.rows, strict=True):
                for j, joint in enumerate(data.plant.joints):
                    rtt = run.column(f"rtt.{joint}")
                    if np.isfinite(rtt).any():
                        spread = math.hypot(TIMING_STD_S, np.nanmedian(rtt) / math.sqrt(3))
                        late[offset + part.start : offset + part.stop, j] = spread
            offset += len(data.measured)
        moved: Array = np.nan_to_num(point.velocity * late)
        return moved

    def _time_step(self, point: _Point) -> Array:
        """(rows, joints) rad: what the model's own time step does to positions, by Richardson's rule from half of it.

        A step h of an implicit integrator brakes a joint of damping D as if it had h·D more inertia, among the like: the
        values that fit best are those of the model with its step, and the robot's own lie about that far off.
        """
        out = []
        offset = 0
        for data in self.datasets:
            rows = slice(offset, offset + len(data.measured))
            offset = rows.stop
            if data.plant.model.nhistory:
                out.append(np.zeros_like(data.measured))  # buffers hold a number of steps, too few at half of one
                continue
            simulated = data.measured - point.residual[rows]
            self.evaluations += 1
            if self._coarse and not self._on_floor and data.coarse is not data:
                twice = data.coarse.simulate(self.parameters, [point.u]).pos[0]
                out.append(np.nan_to_num(simulated - twice))
            else:
                half = data.stepped(0.5).simulate(self.parameters, [point.u]).pos[0]
                out.append(2.0 * np.nan_to_num(half - simulated))
        return np.concatenate(out)

    def _wider_by_blocks(self, tangent: _Tangent, point: _Point, covariance: Array, free: Bools) -> Array:
        """(parameters,) how many times wider intervals are if each block of the runs counts as one observation, at least 1.

        The jackknife over blocks, to first order (Miller 1974; cluster-robust "CR3"): how far the estimate moves when one
        block is left out, the prior staying. It needs no model of the residual: whether errors last, come with a single
        fast motion, or differ from motion to motion, blocks hold them whole. A block that alone tells a parameter moves it
        far. Where blocks are few it is rough, so that it may widen intervals only.
        """
        block = self._blocks()
        count = int(block.max()) + 1
        if count < FEWEST_BLOCKS:
            return np.ones(len(self.parameters))
        precision, _ = self._normal(tangent, point)
        inside = np.ix_(free, free)
        moved = np.empty((count, int(free.sum())))
        edges = np.flatnonzero(np.diff(block, prepend=-1, append=count))
        # Block by block: there are the more of them the longer the runs are, and all they tell at once would fill memory.
        for b, (first, stop) in enumerate(itertools.pairwise(edges)):
            told, pulled = np.zeros(precision.shape), np.zeros(len(free))
            weight, left = self._weight[first:stop], np.nan_to_num(point.residual[first:stop])
            for j, (p, colour) in enumerate(self._movers):
                part = tangent.change[colour, first:stop, j] * weight[:, j]
                told[np.ix_(p, p)] += part @ part.T
                pulled[p] += part @ (weight[:, j] * left[:, j])
            moved[b] = np.linalg.solve((precision - told)[inside], pulled[free])
        moved -= moved.mean(axis=0)
        give = np.linalg.inv(precision[inside])
        robust = (count - 1) / count * (moved**2).sum(axis=0) + (give**2).sum(axis=0)
        wider = np.ones(len(free))
        wider[free] = np.sqrt(np.maximum(1.0, robust / np.diag(covariance)[free]))
        return wider

    def _blocks(self) -> Ints:
        """(rows,) number of each row's block, in order; a block is a part of one run."""
        seconds = max(BLOCK_S, BLOCK_TIMES * float(self.correlation_s.max(initial=0.0)))
        out, count = [], 0
        for run in (run for data in self.datasets for run in data.runs):
            parts = max(1, round(run.duration_s / seconds))
            part = np.minimum((run.t - run.t[0]) / max(run.duration_s, 1e-9) * parts, parts - 1).astype(np.int64)
            part = np.unique(part, return_inverse=True)[1]
            out.append(part + count)
            count += int(part.max()) + 1
        return np.concatenate(out)

    def _halves(self, tangent: _Tangent, point: _Point, free: Bools) -> tuple[Array, Bools]:
        """What the first half of the runs (of a single one, its first half) and the second say, and where they differ.

        Each half with the prior and with weights of its own, to first order from where both together end: a half that
        disagrees counts for little in the whole, whose misfit to it is large. They differ by more than chance where
        chance, as the residuals' size and memory make it, would do so once in 1 / FALSE_ALARM fits.
        """
        n = len(point.u)
        ends = np.cumsum([len(run.t) for data in self.datasets for run in data.runs])
        middle = int(ends[len(ends) // 2 - 1]) if len(ends) > 1 else int(ends[0]) // 2
        first = np.arange(len(self._weight)) < middle
        halves = np.full((2, n), np.nan)
        inverses = []
        kept = self._weight, self.noise, self.correlation_s, self.stamp_error_s
        inside = np.ix_(free, free)
        for k, rows in enumerate((first, ~first)):
            step = np.zeros(n)
            for _ in range(OWN_WEIGHTS):
                self._reweigh(replace(point, residual=point.residual + self._along(tangent, step)))
                precision, gradient = self._normal(tangent, point, rows)
                inverse = np.linalg.inv(precision[inside])
                step[free] = -inverse @ gradient[free]
            halves[k] = point.u + step
            inverses.append(inverse)
        self._weight, self.noise, self.correlation_s, self.stamp_error_s = kept
        # Of the data alone, for the prior is in both; but it draws each half as far as that half leaves it room.
        variance = sum(inverse - inverse @ inverse for inverse in inverses)
        apart = inverses[0] - inverses[1]
        deviation = np.sqrt(np.maximum(np.diag(variance + apart @ apart), 1e-12))
        limit = norm.isf(FALSE_ALARM / 2 / max(1, int(free.sum())))
        contradictory = np.zeros(n, bool)
        contradictory[free] = np.abs(halves[0] - halves[1])[free] > limit * deviation
        return np.clip(halves, self.low, self.high), contradictory

    def _score(self, point: _Point) -> float:
        """−log posterior with unknown noise (each stretch's own, if not `tempered`), one effective sample per TEMPER_S:
        compares starts."""
        away = (point.u - self.centre) ** 2
        score = 0.5 * float(np.sum(np.where(self.freed, np.minimum(away, CONFLICT**2), away)))
        together = np.nanmean(point.residual**2, axis=0)
        for stretch in self._stretches:
            for j, rows in enumerate(stretch.rows):
                part = point.residual[rows, j]
                n = int(np.isfinite(part).sum())
                if n:
                    own = float(together[j] if self.tempered else np.nanmean(part**2))
                    variance = max(own, self.floor[j] ** 2)
                    score += 0.5 * n * stretch.period / TEMPER_S * math.log(variance)
        return score

    def _reweigh(self, point: _Point, driven_only: bool = False) -> None:
        """Weigh each joint's stretches by the size and the autocorrelation of their own residuals.

        Where a joint moves fast its stamp's error is an error of position: such rows weigh less.
        """
        residual = point.residual
        self._weight = np.zeros_like(residual)
        if self.tempered:
            self._weigh_alike(residual)
            return
        joints = residual.shape[1]
        squares, samples, times = np.zeros(joints), np.zeros(joints), np.zeros(joints)
        stamps, stamped = 0.0, 0
        for stretch in self._stretches:
            if driven_only and not stretch.driven:
                continue
            for j, rows in enumerate(stretch.rows):
                part = residual[rows, j]
                n = int(np.isfinite(part).sum())
                if not n:
                    continue
                white, stamp = stamp_error(part, point.velocity[rows, j], self.floor[j])
                expected = np.sqrt(white**2 + (stamp * np.nan_to_num(point.velocity[rows, j])) ** 2)
                relative = part / expected
                variance = max(float(np.nanmean(relative**2)), (self.floor[j] / white) ** 2)
                inflation = autocorrelation_time(relative, limit=len(part) // 2)
                self._weight[rows, j] = 1.0 / (expected * math.sqrt(variance * inflation))
                squares[j] += n * max(float(np.nanmean(part**2)), self.floor[j] ** 2)
                samples[j] += n
                times[j] += n * inflation * stretch.period
                stamps, stamped = stamps + n * stamp**2, stamped + n
        self._let_driven_lead()
        self.noise = np.sqrt(squares / np.maximum(samples, 1))
        self.correlation_s = times / np.maximum(samples, 1)
        self.stamp_error_s = math.sqrt(stamps / max(stamped, 1))

    def _weigh_alike(self, residual: Array) -> None:
        """One deviation for all rows of a joint, and one effective sample per TEMPER_S."""
        self.noise = np.maximum(np.sqrt(np.nanmean(residual**2, axis=0)), self.floor)
        self.correlation_s, self.stamp_error_s = np.full(len(self.noise), TEMPER_S), 0.0
        for stretch in self._stretches:
            for j, rows in enumerate(stretch.rows):
                self._weight[rows, j] = math.sqrt(stretch.period / TEMPER_S) / self.noise[j]

    def _let_driven_lead(self) -> None:
        """No row without torque counts for more than one of the least trusted driven stretch.

        A leg that falls is followed well by a friction that a servo at work does not have; it must not decide for both.
        """
        for j in range(self._weight.shape[1]):
            typical = [(stretch, float(np.median(self._weight[stretch.rows[j], j]))) for stretch in self._stretches
                       if len(stretch.rows[j])]  # fmt: skip
            driven = [weight for stretch, weight in typical if stretch.driven and weight > 0]
            for stretch, weight in typical:
                if driven and not stretch.driven and weight > min(driven):
                    self._weight[stretch.rows[j], j] *= min(driven) / weight

    def _find_stretches(self) -> list[_Stretch]:
        """For each run, with torque and without: the rows of each joint, and the run's median sample time (s).

        A model's errors differ from motion to motion, and most of all between driving and falling: a servo without torque
        is another machine. Each stretch is therefore trusted as far as the model can follow it.
        """
        out = []
        offset = 0
        for data in self.datasets:
            joints = data.plant.joints
            for run, part in zip(data.runs, data.fitted.rows, strict=True):
                rows = np.arange(part.start, part.stop) + offset
                on = run.signal("torque", joints, default=1.0) != 0
                period = float(np.median(np.diff(run.t)))
                for driven, state in ((True, on), (False, ~on)):
                    if state.any():
                        out.append(_Stretch(tuple(rows[state[:, j]] for j in range(len(joints))), driven, period))
            offset += len(data.measured)
        return out

    def _tangent(self, point: _Point, central: bool, coarse: bool) -> _Tangent:
        # Forward where the bound allows, else backward; where both, the other side too.
        u = point.u
        by = self._differences
        up, down = u + by <= self.high, u - by >= self.low
        ahead = np.where(up, by, -by)
        behind = np.where(up & down, -by, 0.0) if central else np.zeros(len(u))
        variants = []
        for step in (ahead, behind) if central else (ahead,):
            for members, _ in self._colours:
                moved = u.copy()
                moved[members] += step[members]
                variants.append(moved)
        n = len(self._colours)
        if coarse and not central:
            variants.append(u)  # what both differ from must be stepped alike
        self.evaluations += len(variants)
        apart = np.ones((n, point.residual.shape[1]))
        for c, (members, masks) in enumerate(self._colours):
            for p, affected in zip(members, masks, strict=True):
                apart[c, affected] = ahead[p] - behind[p]
        change = np.zeros((n, *point.residual.shape), np.float32)
        offset = 0
        for data in self.datasets:
            for rows, pos, _ in (data.coarse if coarse else data).stream(self.parameters, variants):
                here = slice(rows.start + offset, rows.stop + offset)
                base = pos[n:] if central or coarse else (data.measured[rows] - point.residual[here])[None]
                # The residual is measured minus simulated, so that it falls as the position rises.
                change[:, here] = np.nan_to_num((base - pos[:n]) / apart[:, None, :])
            offset += len(data.measured)
        change[:, ~np.isfinite(point.residual)] = 0.0
        return _Tangent(u, change)


def stamp_error(residual: Array, velocity: Array, floor: float) -> tuple[float, float]:
    """(rad, s): the white part of a residual, and the deviation of its time stamps from the moments of sampling.

    A stamp that is off by δ shows as velocity · δ. From how far a residual lies off its neighbours, which a lasting model
    error hardly enters: that varies by white² + velocity² stamp², a line that is fitted three times, weighted by itself.
    """
    ok = np.isfinite(residual) & np.isfinite(velocity)
    r, v = residual[ok], velocity[ok]
    if len(r) < 20:
        return max(floor, float(np.sqrt(np.mean(r**2))) if len(r) else floor), 0.0
    jumps = np.diff(r, 2) ** 2 / 6
    # A jump of many times the usual is a contact or a step that comes early: no jitter.
    fast = (v[2:] ** 2 + 4 * v[1:-1] ** 2 + v[:-2] ** 2) / 6
    jumps = np.minimum(jumps, 100 * max(float(np.median(jumps)), floor**2))
    weight = np.full(len(jumps), 1.0)
    white, slope = floor**2, 0.0
    for _ in range(3):
        scale = max(float(fast.max()), 1e-12)
        lines = np.stack([np.ones_like(fast), fast / scale], axis=1) * weight[:, None]
        (white, slope), _ = nnls(lines, jumps * weight)
        slope /= scale
        white = max(white, floor**2)
        weight = 1.0 / (white + slope * fast)
        weight /= weight.max()
    return math.sqrt(white), math.sqrt(slope)


def gaps(datasets: Sequence[Dataset], parameters: Sequence[Parameter], us: Sequence[Array]) -> list[Gap]:
    """The gap of each variant over all datasets together, at the horizon and over full runs."""
    measured = np.concatenate([data.measured for data in datasets])
    simulated = []
    for horizon in (True, False):
        per_dataset = [data.simulate(parameters, us, data.horizon if horizon else data.full).pos for data in datasets]
        simulated.append(np.concatenate(per_dataset, axis=1))
    short, long = simulated
    return [Gap(gap(measured, short[v]), gap(measured, long[v])) for v in range(len(us))]


def sensor_floor(runs: Sequence[Run], joints: Sequence[str]) -> Array:
    """(joints,) rad, the deviation that the encoder's resolution alone gives: its coarsest quantum / √12."""
    return steps(runs, "pos", joints) / math.sqrt(12)
