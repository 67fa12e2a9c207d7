"""Fitting a model to runs: bounded nonlinear least squares on rollouts, weighted by noise, with priors.

The estimate maximises a posterior (MAP). Its cost is Σ (measured − simulated)² / s² over positions, plus Σ u² over
parameters (priors of unit deviation). What s² is decides how far data move a parameter. The residual of a robot is
not white noise: a model error lasts for as long as the motion that shows it, so a thousand samples may be worth ten. Per
joint s² is the mean squared residual at the estimate times the integrated autocorrelation time in samples (2τ), found by
iteration. With a perfect model that is the sensor's noise, sample by sample; with an imperfect one it tempers the
likelihood by itself, and intervals widen as they must.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from openant_tools.model.gap import HORIZON_S, Gap, gap
from openant_tools.model.plant import Plant, Setup
from openant_tools.model.rollout import Rollouts, Trajectories
from openant_tools.recording.run import Run
from openant_tools.sysid.parameter import KINDS, Parameter, apply, delays
from openant_tools.sysid.quality import quantum

__all__ = ["Dataset", "Estimate", "Problem", "autocorrelation_time"]

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

#: finite-difference step in prior deviations: far above rounding and the solver's tolerance, far below curvature
STEP = 0.1
#: rounds of fit and re-weighting; weights settle in two to three
ROUNDS = 4
#: Gauss-Newton steps before the first weights, which come from the given model's errors, are replaced
EARLY_STEPS = 3
#: one effective sample per this many seconds where fits are compared whose residuals are model error
TEMPER_S = 0.5
#: priors weigh this much where the data lead alone: only against directions of which the data say nothing
LOOSE = 0.1
#: a residual is white where it forgets itself within this many samples, and more than model error where within so many
WHITE, SHORT_LIVED = 1.5, 10
#: nats by which a posterior must be better to count as another one: less is where the descent happened to stop
DECISIVE = 1.0
#: half of the ±2 ms within which delays count as calibrated (effects.md)
TIMING_STD_S = 1e-3


@dataclass(frozen=True)
class Dataset:
    """Runs of one plant, prepared for rollouts at both horizons.

    Attributes:
        plant: the model as given, set up as these runs were made.
        runs: the recordings.
        measured: (rows, joints) rad, the runs' positions one after another.
    """

    plant: Plant
    runs: tuple[Run, ...]
    full: Rollouts
    horizon: Rollouts
    measured: Array

    @classmethod
    def prepare(cls, plant: Plant, runs: Sequence[Run], nthread: int = 0) -> Dataset:
        return cls(
            plant=plant,
            runs=tuple(runs),
            full=Rollouts(plant, runs, None, nthread),
            horizon=Rollouts(plant, runs, HORIZON_S, nthread),
            measured=np.concatenate([run.signal("pos", plant.joints) for run in runs]),
        )

    @property
    def fitted(self) -> Rollouts:
        """What the fit compares: full runs, but on the floor, where contact makes long runs chaotic, the horizon.

        A robot whose base nobody measured cannot be put back on its feet in mid-gait: such runs are compared whole too.
        """
        placed = all(np.isfinite(run.column("base.x")).any() for run in self.runs)
        return self.horizon if self.plant.setup is Setup.FLOOR and placed else self.full

    def simulate(
        self, parameters: Sequence[Parameter], us: Sequence[Array], rollouts: Rollouts | None = None
    ) -> Trajectories:
        """What the model would have done with the parameters at each u, (parameters,), by default as the fit compares."""
        models = [apply(self.plant, parameters, u) for u in us]
        late = np.array([delays(self.plant, parameters, u) for u in us])
        return (rollouts or self.fitted)(models, late if late.any() else None)


@dataclass
class Estimate:
    """Where a fit ended.

    Attributes:
        parameters: what was estimated.
        u: (parameters,) in prior deviations.
        covariance: (parameters, parameters) of u, the prior included.
        centre: (parameters,) the middle of the prior.
        low, high: (parameters,) the physical bounds of u.
        information: (parameters,) share of each parameter's posterior precision that the data gave: 0 prior only, 1 data.
        noise: (joints,) rad, standard deviation of the residual per joint, of all datasets.
        correlation_s: (joints,) s, integrated autocorrelation time of the residual.
        converged: whether the optimiser met its tolerances.
    """

    parameters: tuple[Parameter, ...]
    u: Array
    covariance: Array
    centre: Array
    low: Array
    high: Array
    information: Array
    noise: Array
    correlation_s: Array
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


@dataclass
class Problem:
    """A least-squares problem: parameters, the data they are judged by, and the weights of those data.

    Attributes:
        datasets: all with the same joints in the same order.
        parameters: the unknowns.
        floor: (joints,) rad, the least residual deviation that a sensor of this resolution can show.
    """

    datasets: Sequence[Dataset]
    parameters: Sequence[Parameter]
    floor: Array
    evaluations: int = field(default=0, init=False)
    _prior_weight: float = field(default=1.0, init=False)

    def __post_init__(self) -> None:
        nj = len(self.datasets[0].plant.joints)
        self._stretches = self._find_stretches()
        self._has_limp = any(not driven for _, driven, _ in self._stretches)
        self._weight: Array = np.ones((sum(len(data.measured) for data in self.datasets), nj))
        self.noise, self.correlation_s = np.zeros(nj), np.zeros(nj)
        self._valley = np.array([KINDS[parameter.kind].valley for parameter in self.parameters], bool)
        self._colours = _colours(self.datasets, self.parameters)
        low, high = [], []
        for parameter in self.parameters:
            kind = KINDS[parameter.kind]
            ends = [
                parameter.bounds(kind.read(data.plant.model, data.plant, j))
                for data in self.datasets
                for j in parameter.joints
            ]
            low.append(max(end[0] for end in ends))
            high.append(min(end[1] for end in ends))
        self.low, self.high = np.array(low), np.array(high)
        self.centre = np.array([parameter.centre for parameter in self.parameters])

    def residual(self, us: Sequence[Array]) -> Array:
        """(variants, rows, joints) rad, measured minus simulated; NaN where something is missing."""
        self.evaluations += len(us)
        return np.concatenate(
            [data.measured[None] - data.simulate(self.parameters, us).pos for data in self.datasets], axis=1
        )

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
            ends = np.where(np.isfinite(self.low), self.low, first)
            if self._valley.any():
                starts.append(np.where(self._valley, ends, first))
        best: tuple[float, Estimate] | None = None
        for k, u in enumerate(starts):

            def report(done: float, part: int = k) -> None:
                if progress:
                    progress("fitting", (part + done) / len(starts))

            estimate = self._descend(u, report)
            score = self._score(estimate.u)
            if best is None or score < best[0]:
                best = score, estimate
        assert best is not None
        score, estimate = best
        period = max(period for _, _, period in self._stretches)
        if (estimate.correlation_s < WHITE * period).all():
            return estimate
        again = self._descend(self._by_data_alone(estimate.u), lambda done: None)
        short_lived = bool((again.correlation_s < SHORT_LIVED * period).all())
        if short_lived and again.correlation_s.mean() < estimate.correlation_s.mean():
            return again
        return again if self._score(again.u) < score - DECISIVE else estimate

    def _by_data_alone(self, u: Array) -> Array:
        """Where the data lead from u with the priors all but ignored, as if all that is left were the sensors' noise."""
        self._weight = np.broadcast_to(1.0 / self.floor, self._weight.shape)
        self._prior_weight = LOOSE
        try:
            return self._least_squares(u, 40)[0]
        finally:
            self._prior_weight = 1.0

    def _least_squares(self, u: Array, most: int, *, polish: bool = False) -> tuple[Array, bool]:
        """The minimum near u under the present weights, and whether it was reached within `most` evaluations.

        Args:
            polish: with derivatives from both sides, and from u as it is.
        """
        if not polish:
            # Off the bounds: on them a derivative points one way only and a least-squares step may stick there.
            margin = np.minimum(0.05, (self.high - self.low) / 4)
            u = np.clip(u, self.low + margin, self.high - margin)
        solution = least_squares(
            self._vector,
            u,
            lambda u: self._jacobian(u, central=polish),
            bounds=(self.low, self.high),
            method="dogbox",
            x_scale="jac",
            xtol=1e-4,
            ftol=1e-4,
            max_nfev=most,
        )
        return np.asarray(solution.x, np.float64), bool(solution.success)

    def _descend(self, u: Array, progress: Callable[[float], None]) -> Estimate:
        """The estimate reached from one start."""
        converged = False
        # A servo works with torque on. What a falling leg adds is taken as far as it agrees with what the driven one
        # shows: the driven stretches are fitted alone first, and the others enter with the weight that this leaves them.
        for rounds, driven_only in ((2, True), (ROUNDS, False)) if self._has_limp else ((ROUNDS, False),):
            for round_ in range(rounds):
                self._reweigh(self.residual([u])[0], driven_only)
                before = u
                # No need to reach the bottom of a cost whose weights are about to change.
                u, converged = self._least_squares(u, EARLY_STEPS if round_ < rounds - 2 else 25)
                if driven_only:
                    # Nothing in driven stretches tells these; their prior alone must not move them out of the valley.
                    u = np.where(self._valley, before, u)
                progress((round_ + 1) / rounds)
                if np.abs(u - before).max(initial=0.0) < 0.05:
                    break
        # Differences to one side are good enough to get near. Where parameters almost undo each other (all torques a
        # per cent larger) they are not: there the minimum and the intervals come from both sides.
        u, converged = self._least_squares(u, 25, polish=True)
        self._reweigh(self.residual([u])[0])
        jacobian = self._jacobian(u, central=True)[: -len(u)]
        covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian + np.eye(len(u))), np.float64)
        # A parameter at its bound cannot give way to what is left open; the others must hold all of it.
        free = (u > self.low + 1e-6) & (u < self.high - 1e-6)
        moved = jacobian[:, free]
        left_open = np.concatenate([self._timing(u), self._time_step(u)[:, None]], axis=1)
        open_ = np.zeros((len(u), left_open.shape[1]))
        open_[free] = np.linalg.solve(moved.T @ moved + np.eye(int(free.sum())), moved.T @ left_open)
        return Estimate(
            parameters=tuple(self.parameters),
            u=u,
            covariance=covariance + open_ @ open_.T,
            centre=self.centre,
            low=self.low,
            high=self.high,
            # What the data, all other parameters free, say about each: 1 − posterior variance over prior variance.
            information=1.0 - np.diag(covariance),
            noise=self.noise,
            correlation_s=self.correlation_s,
            converged=converged,
            evaluations=self.evaluations,
        )

    def _timing(self, u: Array) -> Array:
        """(residuals, joints): what one standard deviation of each joint's unknown sampling time does to the residuals.

        A bus log's `t` is when the read begins; a servo samples at some moment before the last byte of its answer. What
        the stamps leave open, the intervals of the parameters must hold: a millisecond is several per cent of a servo's
        lag. The moment is taken as anywhere in the round trip where that is logged; and a servo acts on a command, and
        notes where it is, once in a period of its own.
        """
        columns = []
        for data in self.datasets:
            vel = data.simulate(self.parameters, [u]).vel[0]
            late = np.full(vel.shape, TIMING_STD_S)
            for run, part in zip(data.runs, data.fitted.rows, strict=True):
                for j, joint in enumerate(data.plant.joints):
                    rtt = run.column(f"rtt.{joint}")
                    if np.isfinite(rtt).any():
                        late[part, j] = math.hypot(TIMING_STD_S, np.nanmedian(rtt) / math.sqrt(3))
            columns.append(np.nan_to_num(vel * late))
        moved = np.concatenate(columns) * self._weight
        out = np.zeros((moved.size, moved.shape[1]))
        for j in range(moved.shape[1]):
            column = np.zeros_like(moved)
            column[:, j] = moved[:, j]
            out[:, j] = column.ravel()
        return out

    def _time_step(self, u: Array) -> Array:
        """(residuals,): what the model's own time step does to the residuals, by Richardson's rule from half of it.

        A step h of an implicit integrator brakes a joint of damping D as if it had h·D more inertia, among the like: the
        values that fit best are those of the model with its step, and the robot's own may lie that far off.
        """
        out = []
        for data in self.datasets:
            model = copy.copy(data.plant.model)
            if model.nhistory:
                out.append(np.zeros_like(data.measured))  # buffers hold a number of steps, too few at half of one
                continue
            model.opt.timestep /= 2
            plant = replace(data.plant, model=model)
            horizon = data.fitted.horizon
            finer = replace(data, plant=plant, full=Rollouts(plant, data.runs, horizon, data.fitted.nthread))
            whole, half = (
                one.simulate(self.parameters, [u], roll).pos[0] for one, roll in ((data, None), (finer, finer.full))
            )
            out.append(2.0 * np.nan_to_num(half - whole))
        return (np.concatenate(out) * self._weight).ravel()

    def _score(self, u: Array) -> float:
        """−log posterior with each stretch's own unknown noise, one effective sample per TEMPER_S: compares starts."""
        residual = self.residual([u])[0]
        score = 0.5 * float(np.sum((u - self.centre) ** 2))
        for stretch, _, period in self._stretches:
            for j, rows in enumerate(stretch):
                part = residual[rows, j]
                n = int(np.isfinite(part).sum())
                if n:
                    variance = max(float(np.nanmean(part**2)), self.floor[j] ** 2)
                    score += 0.5 * n * period / TEMPER_S * math.log(variance)
        return score

    def _reweigh(self, residual: Array, driven_only: bool = False) -> None:
        """Weigh each joint's stretches by the size and the autocorrelation of their own residuals."""
        self._weight = np.zeros_like(residual)
        squares, samples, times = np.zeros(residual.shape[1]), np.zeros(residual.shape[1]), np.zeros(residual.shape[1])
        for stretch, driven, period in self._stretches:
            if driven_only and not driven:
                continue
            for j, rows in enumerate(stretch):
                part = residual[rows, j]
                n = int(np.isfinite(part).sum())
                if not n:
                    continue
                variance = max(float(np.nanmean(part**2)), self.floor[j] ** 2)
                inflation = autocorrelation_time(part, limit=len(part) // 2)
                self._weight[rows, j] = 1.0 / math.sqrt(variance * inflation)
                squares[j] += n * variance
                samples[j] += n
                times[j] += n * inflation * period
        self.noise = np.sqrt(squares / np.maximum(samples, 1))
        self.correlation_s = times / np.maximum(samples, 1)

    def _find_stretches(self) -> list[tuple[list[NDArray[np.int64]], bool, float]]:
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
                        out.append(([rows[state[:, j]] for j in range(len(joints))], driven, period))
            offset += len(data.measured)
        return out

    def _vector(self, u: Array) -> Array:
        weighted = np.nan_to_num(self.residual([u])[0]) * self._weight
        return np.concatenate([weighted.ravel(), self._prior_weight * (u - self.centre)])

    def _jacobian(self, u: Array, central: bool) -> Array:
        # Forward where the bound allows, else backward; where both, the other side too.
        up, down = u + STEP <= self.high, u - STEP >= self.low
        ahead = np.where(up, STEP, -STEP)
        behind = np.where(up & down, -STEP, 0.0) if central else np.zeros(len(u))
        variants = [u]
        for step in (ahead, behind) if central else (ahead,):
            for members, _ in self._colours:
                moved = u.copy()
                moved[members] += step[members]
                variants.append(moved)
        base, *residuals = self.residual(variants) * self._weight
        out = np.zeros((base.size + len(u), len(u)))
        n = len(self._colours)
        for c, (members, joints) in enumerate(self._colours):
            change = np.nan_to_num(residuals[c] - (residuals[n + c] if central else base))
            for p, affected in zip(members, joints, strict=True):
                column = np.zeros_like(base)
                column[:, affected] = change[:, affected] / (ahead[p] - behind[p])
                out[: base.size, p] = column.ravel()
        out[base.size :] = self._prior_weight * np.eye(len(u))
        return out


def gaps(datasets: Sequence[Dataset], parameters: Sequence[Parameter], us: Sequence[Array]) -> list[Gap]:
    """The gap of each variant over all datasets together, at the horizon and over full runs."""
    measured = np.concatenate([data.measured for data in datasets])
    simulated = []
    for horizon in (True, False):
        per_dataset = [data.simulate(parameters, us, data.horizon if horizon else data.full).pos for data in datasets]
        simulated.append(np.concatenate(per_dataset, axis=1))
    short, long = simulated
    return [Gap(gap(measured, short[v]), gap(measured, long[v])) for v in range(len(us))]


def _colours(
    datasets: Sequence[Dataset], parameters: Sequence[Parameter]
) -> list[tuple[list[int], list[NDArray[np.bool_]]]]:
    """Parameters that can be perturbed in one rollout, because they move joints of different kinematic trees.

    On the stand the legs do not move each other (the torso is fixed), so that one rollout serves one parameter of each leg.
    On the floor everything moves everything.

    Returns:
        for each colour, the indices of its parameters and, for each, the mask of the joints that it moves.
    """
    plants = [data.plant for data in datasets]
    coupled = any(plant.setup is Setup.FLOOR for plant in plants)
    tree = plants[0].tree if not coupled else np.zeros_like(plants[0].tree)
    colours: list[tuple[set[int], list[int], list[NDArray[np.bool_]]]] = []
    for p, parameter in enumerate(parameters):
        trees = {int(tree[j]) for j in parameter.joints}
        affected = np.isin(tree, list(trees))
        for used, members, masks in colours:
            if not used & trees:
                used |= trees
                members.append(p)
                masks.append(affected)
                break
        else:
            colours.append((trees, [p], [affected]))
    return [(members, masks) for _, members, masks in colours]


def sensor_floor(runs: Sequence[Run], joints: Sequence[str]) -> Array:
    """(joints,) rad, the deviation that the encoder's resolution alone gives: its coarsest quantum / √12."""
    return np.array([max(quantum(run, joint) for run in runs) for joint in joints]) / math.sqrt(12)
