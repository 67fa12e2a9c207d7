"""How a body follows its legs, by the log's own word: no simulation has a part in it.

A robot that stands on its feet turns as its joints do: its gyroscope is, near enough, a linear function of their speeds. Which one is
fitted; the shift in time at which it fits best says how late one is behind the other, whatever the actuators do, and how well it
fits there says how firmly the feet stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["KINDS", "ImuDelay"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

#: s: shifts that are tried, and their spacing
SHIFTS_S, SPACING_S = (-0.08, 0.1), 0.005
#: s: shifts at which it is said how much worse the fit is than at its best; s that count as one
ASKED_S, LAG_S = (-0.04, -0.02, 0.0, 0.02, 0.04, 0.06), 0.01
#: s at a run's beginning that are left out, beyond the shifts; rows without which nothing is said
SKIP_S, FEWEST = 0.4, 50
#: what is said of a run
KINDS = ("lag", "loose", *(["worse"] * len(ASKED_S)))
#: share of joints' speeds that is taken for noise, and rad/s of speeds and of turning that always is
NOISE, LEAST_RAD_S = 1e-3, 1e-3
#: share of the turning below which nothing counts as unexplained
LEAST_SHARE = 1e-4


@dataclass(frozen=True)
class ImuDelay:
    """The rows of a run at which body and legs are compared.

    Attributes:
        t: (rows,) s. inside: which rows of the legs. shifts: s, that the body is asked later by.
        before, share: (shifts, inside) the row of the body before each of these moments, and how far on to the next that is.
    """

    t: Array
    inside: Ints
    shifts: Array
    before: Ints
    share: Array

    @classmethod
    def of(cls, t: Array) -> ImuDelay | None:
        """For rows at these times, s; None where there are too few."""
        shifts = np.arange(SHIFTS_S[0], SHIFTS_S[1] + SPACING_S / 2, SPACING_S)
        inside = np.flatnonzero((t > t[0] + SKIP_S - SHIFTS_S[0]) & (t < t[-1] - SHIFTS_S[1]))
        if len(inside) < FEWEST:
            return None
        at = t[inside] + shifts[:, None]
        before = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
        return cls(t, inside, shifts, before, (at - t[before]) / (t[before + 1] - t[before]))

    def __call__(self, pos: Floats, gyro: Floats) -> Array:
        """(robots, kinds) how far the body lags, in `LAG_S`; logarithms of the share of its turning that legs do not explain, and
        of how much larger that is at other shifts.

        Args:
            pos: (robots, rows, joints) rad. gyro: (robots, rows, 3) rad/s. NaN where nobody knows.
        """
        moved, turned = _filled(pos, self.t), _filled(gyro, self.t)
        speed = np.gradient(moved, self.t, axis=1)[:, self.inside]
        angle = moved[:, self.inside] - moved[:, self.inside].mean(axis=1, keepdims=True)
        legs = np.concatenate([speed, speed * np.sin(angle)], axis=2)
        legs -= legs.mean(axis=1, keepdims=True)
        square = np.swapaxes(legs, 1, 2) @ legs
        usual = np.trace(square, axis1=1, axis2=2) / square.shape[1] + len(self.inside) * LEAST_RAD_S**2
        inverse = np.linalg.inv(square + NOISE * usual[:, None, None] * np.eye(square.shape[1]))
        # Between rows noise would average out: what is explained is asked there of a spline, how much there is of the rows alone.
        from scipy.interpolate import CubicSpline  # half a second to load

        turning = CubicSpline(self.t, turned, axis=1)
        energy = np.square(turned - turned.mean(axis=1, keepdims=True)).sum(axis=2)
        left = np.empty((len(pos), len(self.shifts)))
        for k, (shift, before, share) in enumerate(zip(self.shifts, self.before, self.share, strict=True)):
            along = np.swapaxes(legs, 1, 2) @ turning(self.t[self.inside] + shift)
            whole = (energy[:, before] * (1 - share) + energy[:, before + 1] * share).sum(axis=1)
            whole += len(self.inside) * LEAST_RAD_S**2
            left[:, k] = 1 - np.einsum("rki,rkl,rli->r", along, inverse, along) / whole
        left = np.log10(np.clip(left, LEAST_SHARE, 1.0))
        best = np.clip(left.argmin(axis=1), 1, len(self.shifts) - 2)
        rows = np.arange(len(left))
        a, b, c = left[rows, best - 1], left[rows, best], left[rows, best + 1]
        # The parabola through the best three.
        off = np.clip(0.5 * (a - c) / np.maximum(a - 2 * b + c, 1e-9), -1, 1)
        lag = self.shifts[best] + SPACING_S * off
        asked = left[:, np.searchsorted(self.shifts, np.array(ASKED_S) - SPACING_S / 2)]
        out: Array = np.column_stack([lag / LAG_S, b, asked - b[:, None]])
        return out


def _filled(x: Floats, t: Array) -> Array:
    """The same with what nobody knows between what is known; 0 where nothing is."""
    out = x.astype(np.float64)
    for r, k in zip(*np.nonzero(~np.isfinite(out).all(axis=1)), strict=True):
        known = np.isfinite(out[r, :, k])
        out[r, :, k] = np.interp(t, t[known], out[r, known, k]) if known.any() else 0.0
    return out
