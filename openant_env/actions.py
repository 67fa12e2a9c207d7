"""Which joint angles the actions −1…1 stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.robot.config import ACTION_PRESETS, ActionRange
from openant_tools.robot.joints import JOINTS

__all__ = ["LIMITS", "RANGES", "ActionMap", "action_map"]

Array = NDArray[np.float64]

#: The paper states the ranges of the published environment's default; the platform's SAC and SARSA scripts set others.
RANGES: Mapping[str, ActionRange] = {"paper": ACTION_PRESETS["platform"], **ACTION_PRESETS}
#: the whole of each joint's own limits
LIMITS = "limits"


@dataclass(frozen=True)
class ActionMap:
    """command = clip(centre + half · clip(action, −1, 1), low, high), each (joints,), rad.

    Attributes:
        clipped: whether the limits cut into the range at all.
    """

    centre: Array
    half: Array
    low: Array
    high: Array
    clipped: bool

    @property
    def rest(self) -> Array:
        """(joints,) rad, the command of action 0."""
        return np.clip(self.centre, self.low, self.high)


def action_map(chosen: str | ActionRange, joints: Sequence[str], low: Array, high: Array) -> ActionMap:
    """The map from actions to commands.

    Args:
        chosen: a range of a robot's own, a name in `RANGES`, or `limits`: each joint's limits from end to end.
        joints: joint names in the order of the actions.
        low, high: (joints,) rad, the calibrated limits; commands never leave them.

    Raises:
        BadInput: no such range.
    """
    if chosen == LIMITS:
        return ActionMap(0.5 * (low + high), 0.5 * (high - low), low, high, clipped=False)
    if isinstance(chosen, str):
        if chosen not in RANGES:
            raise BadInput(f"no such action range: {chosen!r}", remedy=f"choose one of {', '.join([*RANGES, LIMITS])}")
        chosen = RANGES[chosen]
    centre = np.array([chosen.centre(JOINTS[joint].kind) for joint in joints])
    half = np.array([chosen.half_range(JOINTS[joint].kind) for joint in joints])
    # A rounding error at the stop (45° written as 0.7853981634) is no cut.
    tolerance = 1e-6
    clipped = bool(np.any(centre - half < low - tolerance) or np.any(centre + half > high + tolerance))
    return ActionMap(centre, half, low, high, clipped)
