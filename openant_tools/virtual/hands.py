"""What a builder's hands do to a virtual robot: turn a limp joint, hold it, tilt the torso that stands on its stand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

__all__ = ["Grip", "Tilting", "grip_torque"]

Array = NDArray[np.float64]

#: N·m/rad and N·m·s/rad of a hand on a leg, and how strong it is: firm beside a limp servo, soft beside a stop.
HAND_NM_RAD, HAND_NM_S_RAD, HAND_NM = 60.0, 1.5, 4.0


@dataclass(frozen=True)
class Grip:
    """A hand on one joint: it goes through `angles` (rad, at the joint), each reached after `leg_s`, and holds the last."""

    start_s: float
    angles: tuple[float, ...]
    leg_s: float

    def at(self, t: float) -> float:
        """Where the hand wants the joint at `t` (s)."""
        legs = len(self.angles) - 1
        if legs == 0:
            return self.angles[0]
        where = min(max((t - self.start_s) / self.leg_s, 0.0), float(legs))
        leg = min(int(where), legs - 1)
        share = where - leg
        smooth = share * share * (3 - 2 * share)
        return self.angles[leg] + smooth * (self.angles[leg + 1] - self.angles[leg])


def grip_torque(grips: Mapping[int, Grip], q: Array, v: Array, t: float) -> Array:
    """(n,) N·m of all hands at the joints."""
    torque = np.zeros(len(q))
    for k, grip in grips.items():
        wanted = HAND_NM_RAD * (grip.at(t) - q[k]) - HAND_NM_S_RAD * v[k]
        torque[k] = min(max(wanted, -HAND_NM), HAND_NM)
    return torque


@dataclass(frozen=True)
class Tilting:
    """The torso turned by hand from one attitude to another.

    Attributes:
        start: (4,) w x y z, world from torso, where it begins at `start_s`. turn: (3,) the rotation vector to go, in the
            torso's own axes, within `seconds`.
    """

    start_s: float
    start: Array
    turn: Array
    seconds: float

    @classmethod
    def to(cls, start_s: float, start: Array, rotation_rad: Sequence[float], seconds: float) -> Tilting:
        """From attitude `start` to the one that a rotation vector (rad, in the world) makes of a level torso."""
        goal, back, between, turn = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_quatIntegrate(goal, np.array(rotation_rad, float), 1.0)
        mujoco.mju_negQuat(back, start)
        mujoco.mju_mulQuat(between, back, goal)
        mujoco.mju_quat2Vel(turn, between, 1.0)
        return cls(start_s, start.copy(), turn, seconds)

    def ended(self, t: float) -> bool:
        return t >= self.start_s + self.seconds

    def at(self, t: float) -> tuple[Array, Array]:
        """(4,) attitude and (3,) rad/s in the torso's axes at `t` (s)."""
        share = min(max((t - self.start_s) / self.seconds, 0.0), 1.0)
        smooth, slope = share * share * (3 - 2 * share), 6 * share * (1 - share) / self.seconds
        quaternion = self.start.copy()
        mujoco.mju_quatIntegrate(quaternion, self.turn, smooth)
        return quaternion, self.turn * slope
