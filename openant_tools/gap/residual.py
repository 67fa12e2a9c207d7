"""What a diagnosis leaves of the gap: where, and which quantity it still follows at which frequencies.

Nobody can name an effect that no catalogue has; but whoever looks for it is helped by where it shows, by what it moves with and by
how fast.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.hypothesis import Refit
from openant_tools.gap.measure import Measurement
from openant_tools.gap.prediction import Predictions
from openant_tools.recording.run import Run

__all__ = ["Residual", "places_left", "residual_after", "residual_of"]

Array = NDArray[np.float64]

#: s that a spectrum's segments last, each half overlapped by the next
SEGMENT_S = 1.28
#: Hz, edges of the octaves among which the band is looked for that has most of what is left
OCTAVES_HZ = (0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6)
#: share of what is left in that band which a quantity must explain before it is said that this follows it
FOLLOWS = 0.3
#: rad/s about which a direction of motion turns into the other
TURN_RAD_S = 0.05


@dataclass(frozen=True)
class Residual:
    """What most of the rest moves with.

    Attributes:
        joint: which has most of it. low_hz, high_hz: the octave in which most of that lies; share: how much of the joint's.
        regressor: what it follows there, in words; None where that is nothing looked at.
        coherence: share of it there that a linear filter of the regressor explains, beyond chance.
    """

    joint: str
    low_hz: float
    high_hz: float
    share: float
    regressor: str | None
    coherence: float

    def as_json(self) -> dict[str, Any]:
        return {
            "joint": self.joint, "band_hz": [self.low_hz, self.high_hz], "share": self.share, "regressor": self.regressor,
            "coherence": self.coherence,
        }  # fmt: skip


def residual_of(
    runs: Sequence[Run], joints: Sequence[str], errors: Sequence[Array], simulated: Sequence[Mapping[str, Array]]
) -> Residual | None:
    """What the errors of a model follow; None where runs are too short to say.

    By coherence, |S_xy|² / (S_xx S_yy), from spectra averaged over half-overlapping segments (Welch 1967) of all runs, less what as
    many segments have by chance (Carter, Knapp and Nuttall 1973).

    Args:
        errors: of each run (rows, joints) rad, NaN where nobody knows. simulated: of each run pos, vel and torque (rows, joints),
            as the model moves: measured ones would share their noise with the errors.
    """
    period = float(np.median(np.concatenate([np.diff(run.t) for run in runs])))
    length = max(8, round(SEGMENT_S / period))
    even = [_evenly(run.t, period) for run in runs]
    # Half-overlapping segments of a Hann window say as much as about as many that do not overlap as fit, times 4/3.
    independent = sum(len(grid) / length for grid in even) * 4 / 3
    if independent < 3 or min(len(grid) for grid in even) < length:
        return None
    worst = int(np.argmax(sum(np.nansum(np.square(one), axis=0) for one in errors)))
    left = [_on(grid, run.t, np.nan_to_num(one[:, worst])) for grid, run, one in zip(even, runs, errors, strict=True)]
    f, power = _spectrum(left, left, period, length)
    edges = [edge for edge in OCTAVES_HZ if edge < 0.5 / period] + [0.5 / period]
    bands = [band for low, high in itertools.pairwise(edges) if (band := (f >= low) & (f < high)).any()]
    if not bands or not power[f > 0].sum() > 0:
        return None
    band = max(bands, key=lambda one: float(power[one].sum().real))
    best, coherence = None, 0.0
    for words, values in _regressors(runs, joints, worst, simulated).items():
        x = [_on(grid, run.t, one) for grid, run, one in zip(even, runs, values, strict=True)]
        if not all(np.isfinite(one).all() for one in x) or max(np.ptp(one) for one in x) == 0:
            continue
        _, own = _spectrum(x, x, period, length)
        _, shared = _spectrum(x, left, period, length)
        explained = np.abs(shared[band]) ** 2 / np.maximum(own[band].real, 1e-30)
        raw = float(explained.sum() / power[band].real.sum())
        beyond = (raw - 1 / independent) / (1 - 1 / independent)
        if beyond > coherence:
            best, coherence = words, beyond
    return Residual(
        joints[worst], float(f[band].min() - f[1] / 2), float(f[band].max() + f[1] / 2),
        float(power[band].real.sum() / power[f > 0].real.sum()), best if coherence > FOLLOWS else None, coherence,
    )  # fmt: skip


def residual_after(
    predictions: Predictions, refit: Refit, judged: Sequence[int], measured: Measurement
) -> tuple[Residual | None, list[dict[str, Any]]]:
    """What a re-fitted model leaves on these runs: what it follows, and the places of the gap with what is left there.

    Args:
        judged: of the protocol's runs, those that were measured, in that order.
    """
    joints = predictions.protocol.joints
    runs = [predictions.protocol.runs[k].run for k in judged]
    simulated = [predictions.simulated(k, refit, ("pos", "vel", "torque")) for k in judged]
    errors = [
        predictions.measured[k][:, : predictions.joints] - one["pos"] for k, one in zip(judged, simulated, strict=True)
    ]
    return residual_of(runs, joints, errors, simulated), places_left(measured, simulated)


def places_left(measured: Measurement, simulated: Sequence[Mapping[str, Array]]) -> list[dict[str, Any]]:
    """The places of a gap, each with what another simulation of the same runs leaves there.

    Returns:
        as `Measurement.as_json` has them, with `gap_after` and `share_after`, of what the excess was before; None where that
        simulation fell apart.
    """
    left = {(place.signal, place.joint, place.regime): place for place in measured.resimulated(simulated)}
    return [
        {**words, "gap_after": there and there.gap, "share_after": there and there.share}
        for words in measured.as_json()["where"]
        for there in [left.get((words["signal"], words["joint"], words["regime"]))]
    ]


def _regressors(
    runs: Sequence[Run], joints: Sequence[str], j: int, simulated: Sequence[Mapping[str, Array]]
) -> dict[str, list[Array]]:
    """What the error of a joint may follow, in words; of each run (rows,)."""
    pos, vel, torque = ([one[name].astype(np.float64) for one in simulated] for name in ("pos", "vel", "torque"))
    velocity, load = [one[:, j] for one in vel], [one[:, j] for one in torque]
    found = {
        "where the joint is": [one[:, j] for one in pos],
        "its velocity": velocity,
        "the square of its velocity": [one * np.abs(one) for one in velocity],
        "the direction in which it moves": [np.tanh(one / TURN_RAD_S) for one in velocity],
        "its acceleration": [_slope(one, run.t) for one, run in zip(velocity, runs, strict=True)],
        "how fast its command moves": [_slope(run.column(f"cmd.{joints[j]}"), run.t) for run in runs],
        "the torque of its motor": load,
        "friction under load": [np.abs(one) * np.tanh(v / TURN_RAD_S) for one, v in zip(load, velocity, strict=True)],
        "the torque of all motors together": [np.abs(one).sum(axis=1) for one in torque],
        "the supply's voltage": [run.column(f"volt.{joints[j]}") for run in runs],
        "its temperature": [run.column(f"temp.{joints[j]}") for run in runs],
    }
    return found | {f"the torso's turning about {axis}": [run.column(f"gyro.{axis}") for run in runs] for axis in "xyz"}


def _slope(values: Array, t: Array) -> Array:
    known = np.isfinite(values)
    out = np.full(len(values), np.nan)
    if known.sum() > 1:
        out[known] = np.gradient(values[known], t[known])
    return out


def _evenly(t: Array, period: float) -> Array:
    grid: Array = np.arange(t[0], t[-1] + period / 2, period)
    return grid


def _on(grid: Array, t: Array, values: Array) -> Array:
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(grid), np.nan)
    out: Array = np.interp(grid, t[known], values[known])
    return out


def _spectrum(
    x: Sequence[Array], y: Sequence[Array], period: float, length: int
) -> tuple[Array, NDArray[np.complex128]]:
    """Frequencies, Hz, and the cross spectrum summed over runs, each by its length."""
    from scipy.signal import csd  # a second to load

    total = np.zeros(length // 2 + 1, complex)
    for one, other in zip(x, y, strict=True):
        f, found = csd(one, other, 1 / period, nperseg=length, detrend="constant")
        total += found * len(one)
    return f, total
