"""A gait that turns an Open Ant on the spot, by which it unwinds its cable.

Two legs across stand and turn the torso by their hips, while the other two are lifted and reach back; then they change.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["HALF_S", "turning_action"]

#: s for which one pair of legs is in the air: quicker the servos do not follow, and slower the torso tips between two legs
HALF_S = 0.36
_PAIR = ("rr", "fl")


def turning_action(joints: Sequence[str], way: float, k: int) -> NDArray[np.float64]:
    """The action (joints,) of half cycle `k`.

    Args:
        joints: names, in order. way: 1 turns to the left, −1 to the right.
    """
    pair = np.array([joint.rpartition("_")[2] in _PAIR for joint in joints])
    hips = np.array([joint.startswith("hip") for joint in joints])
    in_air = pair if k % 2 == 0 else ~pair
    return np.where(hips, np.where(in_air, way, -way), np.where(in_air, 1.0, 0.0))
