"""What a joint is doing, row by row: a gap lies in some motions and not in others, and that tells what causes it."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from openant_tools.model.plant import Plant
from openant_tools.model.servo import read_stiffness, torque_limit
from openant_tools.recording.run import Run

__all__ = ["Regime", "regimes", "slope"]

Array = NDArray[np.float64]

#: rad/s, below which a joint is at rest, and above which it is fast (half of what the servos' PWM limit allows)
REST_RAD_S, FAST_RAD_S = 0.05, 1.5
#: s on both sides of a turning point
REVERSAL_S = 0.06
#: s over which a velocity is taken from positions
SLOPE_S = 0.03
#: share of the torque limit that counts as all of it
SATURATED = 0.98


class Regime(StrEnum):
    """One of these a row and joint is in; the first that holds."""

    RELEASED = "released"
    SATURATED = "saturated"
    REVERSAL = "reversal"
    HOLD = "hold"
    FAST = "fast"
    SLOW = "slow"

    @property
    def words(self) -> str:
        return {
            "released": "torque is off", "saturated": "the servo gives all it may", "reversal": "the joint turns back",
            "hold": "it stands", "fast": "it moves fast", "slow": "it moves slowly",
        }[self.value]  # fmt: skip


def regimes(run: Run, plant: Plant) -> NDArray[np.str_]:
    """(rows, joints) of Regime.

    Saturation is judged by what the model's servo would be asked for at the measured position; a run that logs duty shows
    the servo's own.
    """
    t, pos, cmd = run.t, run.signal("pos", plant.joints), run.signal("cmd", plant.joints)
    velocity = np.stack([slope(t, pos[:, j]) for j in range(pos.shape[1])], axis=1)
    out = np.full(pos.shape, Regime.SLOW.value, dtype="<U9")
    out[np.abs(velocity) > FAST_RAD_S] = Regime.FAST
    out[np.abs(velocity) < REST_RAD_S] = Regime.HOLD
    for j in range(pos.shape[1]):
        moving = np.where(np.abs(velocity[:, j]) > REST_RAD_S, np.sign(velocity[:, j]), 0.0)
        for row in np.flatnonzero(_turns(moving)):
            near = np.abs(t - t[row]) <= REVERSAL_S
            out[near, j] = Regime.REVERSAL
        stiffness, limit = read_stiffness(plant.model, plant, j), torque_limit(plant.model, plant, j)
        out[np.abs(stiffness * (cmd[:, j] - pos[:, j])) > SATURATED * limit, j] = Regime.SATURATED
    out[run.signal("torque", plant.joints, default=1.0) == 0] = Regime.RELEASED
    return out


def slope(t: Array, pos: Array) -> Array:
    """rad/s, by differences over SLOPE_S on both sides, across gaps."""
    known = np.isfinite(pos)
    if known.sum() < 2:
        return np.zeros_like(pos)
    ahead, behind = np.interp(t + SLOPE_S, t[known], pos[known]), np.interp(t - SLOPE_S, t[known], pos[known])
    span = np.minimum(t + SLOPE_S, t[known][-1]) - np.maximum(t - SLOPE_S, t[known][0])
    out: Array = (ahead - behind) / np.maximum(span, 1e-9)
    return out


def _turns(moving: Array) -> NDArray[np.bool_]:
    """Rows at which motion goes on the other way than before, rests between them left out."""
    out = np.zeros(len(moving), bool)
    rows = np.flatnonzero(moving)
    out[rows[1:]] = moving[rows[1:]] != moving[rows[:-1]]
    return out
