"""Which joint angles the actions −1…1 stand for: ranges by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput

__all__ = ["RANGES", "ActionMap", "action_map"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Range:
    """Centre and half-width of the commands of hips and knees, degrees."""

    hip_centre: float
    hip_half: float
    knee_centre: float
    knee_half: float


#: `paper`: the ranges that the paper states for SAC, and the published environment's default. `platform`: those of
#: the published SAC launcher. `platform-sarsa`: those of its SARSA agent, which ask a knee for more than its stop.
RANGES: Mapping[str, Range] = {
    "paper": Range(0.0, 45.0, -50.0, 20.0),
    "platform": Range(0.0, 30.0, -50.0, 20.0),
    "platform-sarsa": Range(0.0, 30.0, -60.0, 45.0),
}
#: the whole of each joint's own limits
LIMITS = "limits"


@dataclass(frozen=True)
class ActionMap:
    """command = clip(centre + half · clip(action, −1, 1), low, high), each (joints,), rad.

    Attributes:
        name: of the range.
        clipped: whether the limits cut into the range at all.
    """

    name: str
    centre: Array
    half: Array
    low: Array
    high: Array
    clipped: bool

    @property
    def rest(self) -> Array:
        """(joints,) rad, the command of action 0."""
        return np.clip(self.centre, self.low, self.high)


def action_map(name: str, joints: Sequence[str], low: Array, high: Array) -> ActionMap:
    """The map from actions to commands.

    Args:
        name: `paper`, `platform`, `platform-sarsa`, or `limits`: each joint's own limits from end to end.
        joints: joint names in the order of the actions.
        low, high: (joints,) rad, the calibrated limits; commands never leave them.

    Raises:
        BadInput: no such range, or joints that it says nothing about.
    """
    if name == LIMITS:
        return ActionMap(name, 0.5 * (low + high), 0.5 * (high - low), low, high, False)
    if name not in RANGES:
        raise BadInput(f"no such action range: {name!r}", remedy=f"choose one of {', '.join([*RANGES, LIMITS])}")
    chosen = RANGES[name]
    kinds = [joint.partition("_")[0] for joint in joints]
    strangers = [joint for joint, kind in zip(joints, kinds, strict=True) if kind not in ("hip", "knee")]
    if strangers:
        raise BadInput(
            f"the action range {name} knows hips and knees, not {strangers[0]}",
            remedy=f"use action_range={LIMITS!r} for a robot with other joints",
        )
    hips = np.array([kind == "hip" for kind in kinds])
    centre = np.where(hips, math.radians(chosen.hip_centre), math.radians(chosen.knee_centre))
    half = np.where(hips, math.radians(chosen.hip_half), math.radians(chosen.knee_half))
    # a rounding error at the stop (45° written as 0.7853981634) is no cut
    tolerance = 1e-6
    clipped = bool(np.any(centre - half < low - tolerance) or np.any(centre + half > high + tolerance))
    return ActionMap(name, centre, half, low, high, clipped)
