"""What a residual is divided by: how far each stretch of each run is trusted (problem.py says why)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from openant_tools.sysid.dataset import Dataset, runs_of
from openant_tools.sysid.solve import Point

__all__ = ["SHORT_LIVED", "WHITE", "Stretch", "Weighing", "Weights", "autocorrelation_time", "stamp_error", "stretches"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

#: one effective sample per this many seconds where fits are compared whose residuals are model error
TEMPER_S = 0.5
#: a residual is white where it forgets itself within this many samples, and more than model error where within so many
WHITE, SHORT_LIVED = 1.5, 10


@dataclass(frozen=True)
class Stretch:
    """Rows of one run with torque, or without: for each joint; and the run's median sample time (s).

    A model's errors differ from motion to motion, and most of all between driving and falling: a servo without torque is
    another machine. Each stretch is therefore trusted as far as the model can follow it.
    """

    rows: tuple[Ints, ...]
    driven: bool
    period: float


def stretches(datasets: Sequence[Dataset], left_out: NDArray[np.bool_] | None = None) -> tuple[Stretch, ...]:
    """Those of all runs, without the rows (of all datasets) that are left out."""
    out = []
    for data, run, part in runs_of(datasets):
        rows = np.arange(part.start, part.stop)
        on = run.signal("torque", data.plant.joints, default=1.0) != 0
        if left_out is not None:
            rows, on = rows[~left_out[rows]], on[~left_out[rows]]
        period = float(np.median(np.diff(run.t)))
        for driven, state in ((True, on), (False, ~on)):
            if state.any():
                out.append(Stretch(tuple(rows[column] for column in state.T), driven, period))
    return tuple(out)


@dataclass(frozen=True)
class Weights:
    """What residuals are multiplied by, and what is said of them.

    Attributes:
        each: (rows, joints) 1/rad; 0 where nothing counts.
        noise: (joints,) rad, standard deviation.
        correlation_s: (joints,) s, integrated autocorrelation time.
        stamp_error_s: s, standard deviation by which time stamps miss the moments of sampling, row by row.
    """

    each: Array
    noise: Array
    correlation_s: Array
    stamp_error_s: float


@dataclass(frozen=True)
class Weighing:
    """How residuals are weighed.

    Attributes:
        stretches: of all runs.
        floor: (joints,) rad, the least deviation.
        tempered: all rows of a joint alike, by what is left of all; else each stretch by its own residuals.
    """

    stretches: Sequence[Stretch]
    floor: Array
    tempered: bool

    @property
    def period(self) -> float:
        """s, the longest sample time."""
        return max(stretch.period for stretch in self.stretches)

    @property
    def limp(self) -> bool:
        """Whether there was motion without torque."""
        return any(not stretch.driven for stretch in self.stretches)

    def __call__(self, point: Point, *, driven_only: bool = False) -> Weights:
        """Weights by what is left at a point; `driven_only`: none of what was recorded without torque."""
        return self._alike(point.residual) if self.tempered else self._apart(point, driven_only)

    def counts(self, residual: Array) -> Array:
        """1 where a residual, (rows, joints), is of a stretch, else 0."""
        out = np.zeros_like(residual)
        for stretch in self.stretches:
            for j, rows in enumerate(stretch.rows):
                out[rows, j] = 1.0
        return out

    def score(self, residual: Array) -> float:
        """−log likelihood with unknown noise (each stretch's own, if not `tempered`), one effective sample per TEMPER_S."""
        score = 0.0
        together = self._together(residual) if self.tempered else None
        for stretch in self.stretches:
            for j, rows in enumerate(stretch.rows):
                part = residual[rows, j]
                n = int(np.isfinite(part).sum())
                if n:
                    own = float(np.nanmean(part**2) if together is None else together[j])
                    score += 0.5 * n * stretch.period / TEMPER_S * math.log(max(own, self.floor[j] ** 2))
        return score

    def _apart(self, point: Point, driven_only: bool) -> Weights:
        """Each joint's stretches by the size and the autocorrelation of their own residuals.

        Where a joint moves fast its stamp's error is an error of position: such rows weigh less.
        """
        each = np.zeros_like(point.residual)
        squares, samples, times = np.zeros((3, each.shape[1]))
        stamps, stamped = 0.0, 0
        for stretch in self.stretches:
            if driven_only and not stretch.driven:
                continue
            for j, rows in enumerate(stretch.rows):
                part, velocity = point.residual[rows, j], point.velocity[rows, j]
                n = int(np.isfinite(part).sum())
                if not n:
                    continue
                white, stamp = stamp_error(part, velocity, self.floor[j])
                expected = np.sqrt(white**2 + (stamp * np.nan_to_num(velocity)) ** 2)
                relative = part / expected
                variance = max(float(np.nanmean(relative**2)), (self.floor[j] / white) ** 2)
                inflation = autocorrelation_time(relative, limit=len(part) // 2)
                each[rows, j] = 1.0 / (expected * math.sqrt(variance * inflation))
                squares[j] += n * max(float(np.nanmean(part**2)), self.floor[j] ** 2)
                samples[j] += n
                times[j] += n * inflation * stretch.period
                stamps, stamped = stamps + n * stamp**2, stamped + n
        self._let_driven_lead(each)
        samples = np.maximum(samples, 1)
        return Weights(each, np.sqrt(squares / samples), times / samples, math.sqrt(stamps / max(stamped, 1)))

    def _let_driven_lead(self, each: Array) -> None:
        """No row without torque counts for more than one of the least trusted driven stretch.

        A leg that falls is followed well by a friction that a servo at work does not have; it must not decide for both.
        """
        for j in range(each.shape[1]):
            typical = [(stretch, float(np.median(each[stretch.rows[j], j]))) for stretch in self.stretches
                       if len(stretch.rows[j])]  # fmt: skip
            driven = [weight for stretch, weight in typical if stretch.driven and weight > 0]
            for stretch, weight in typical:
                if driven and not stretch.driven and weight > min(driven):
                    each[stretch.rows[j], j] *= min(driven) / weight

    def _together(self, residual: Array) -> Array:
        """(joints,) mean square of all that counts."""
        return np.asarray(np.nanmean(np.where(self.counts(residual) > 0, residual, np.nan) ** 2, axis=0), np.float64)

    def _alike(self, residual: Array) -> Weights:
        """One deviation for all rows of a joint, and one effective sample per autocorrelation time."""
        each = np.zeros_like(residual)
        noise = np.maximum(np.sqrt(self._together(residual)), self.floor)
        samples, times = np.zeros((2, len(noise)))
        for stretch in self.stretches:
            for j, rows in enumerate(stretch.rows):
                part = residual[rows, j]
                n = int(np.isfinite(part).sum())
                samples[j] += n
                times[j] += n * autocorrelation_time(part, limit=len(part) // 2) * stretch.period
        times /= np.maximum(samples, 1)
        for stretch in self.stretches:
            for j, rows in enumerate(stretch.rows):
                each[rows, j] = math.sqrt(stretch.period / max(times[j], stretch.period)) / noise[j]
        return Weights(each, noise, times, 0.0)


def autocorrelation_time(residual: Array, limit: int) -> float:
    """Integrated autocorrelation time 1 + 2 Σ ρ_k in samples, summed until ρ first falls below zero (at most `limit` lags).

    A bias counts: it is model error too.

    Args:
        residual: (n,) evenly enough spaced; NaN counts as missing.
    """
    x = residual[np.isfinite(residual)]
    if len(x) < 4:
        return 1.0
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
