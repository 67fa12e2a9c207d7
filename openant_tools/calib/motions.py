"""Diverse motions for the bounds of observations: what a robot that learns will do, calm and wild, and then some."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD

__all__ = ["LIBRARY", "motion"]

Array = NDArray[np.float64]

#: name → what it is.
LIBRARY: Mapping[str, str] = {
    "wander": "all joints by slow sums of sines through their whole range",
    "jumps": "random goals within the range of actions, as an agent that knows nothing sends them",
    "trot": "diagonal legs in turn, at rising pace",
    "shake": "small and fast, at all joints",
}
#: s of each; with ramps between them half a minute on the stand.
SECONDS: Mapping[str, float] = {"wander": 9.0, "jumps": 9.0, "trot": 6.0, "shake": 3.0}
#: s between two actions, the platform's.
ACTION_S = 0.12
#: Hips of neighbouring legs would meet beyond this when they turn towards each other; knees keep off their stops.
HIP_RAD, KNEE_MARGIN_RAD = 0.6, 0.08
#: On the floor: about the stand, so that it neither falls nor drags its belly.
FLOOR_HIP_RAD, FLOOR_KNEE_RAD = 0.4, 0.3


def motion(
    name: str,
    joints: tuple[str, ...],
    limits: Mapping[str, tuple[float, float]],
    rate_hz: float,
    seed: int,
    *,
    floor: bool,
) -> Array:
    """(n, joints) rad of one motion of `LIBRARY`, the same for the same seed, within the limits."""
    chance = np.random.default_rng(seed)
    n = round(SECONDS[name] * rate_hz)
    t = np.arange(n) / rate_hz
    centre, reach = _space(joints, limits, floor)
    if name == "wander":
        hz = chance.uniform(0.15, 0.9, (4, len(joints)))
        phase = chance.uniform(0, 2 * np.pi, (4, len(joints)))
        waves = np.sin(2 * np.pi * hz[:, None, :] * t[None, :, None] + phase[:, None, :]).sum(axis=0)
        unit = np.clip(waves / 2.0, -1.0, 1.0)
    elif name == "jumps":
        steps = chance.uniform(-1.0, 1.0, (int(np.ceil(SECONDS[name] / ACTION_S)) + 1, len(joints)))
        unit = steps[(t / ACTION_S).astype(int)]
    elif name == "trot":
        legs = {"rr": 0.0, "fl": 0.0, "fr": np.pi, "rl": np.pi}
        turn = 2 * np.pi * np.cumsum(np.linspace(0.7, 2.0, n)) / rate_hz
        unit = np.empty((n, len(joints)))
        for k, joint in enumerate(joints):
            lag = np.pi / 2 if JOINTS[joint].kind == "knee" else 0.0
            unit[:, k] = 0.8 * np.sin(turn + legs[JOINTS[joint].leg.name] + lag)
    else:
        hz, phase = chance.uniform(4.0, 9.0, len(joints)), chance.uniform(0, 2 * np.pi, len(joints))
        unit = 0.15 * np.sin(2 * np.pi * hz * t[:, None] + phase)
    ease = np.clip(np.minimum(t, t[-1] - t) / 0.4, 0.0, 1.0)[:, None]
    return np.asarray(centre + ease * unit * reach, float)


def _space(joints: tuple[str, ...], limits: Mapping[str, tuple[float, float]], floor: bool) -> tuple[Array, Array]:
    """Centre and half range of every joint, (joints,) rad."""
    centre, reach = np.empty(len(joints)), np.empty(len(joints))
    for k, joint in enumerate(joints):
        low, high = limits[joint]
        kind = JOINTS[joint].kind
        if floor:
            centre[k], half = HOME_RAD[kind], FLOOR_HIP_RAD if kind == "hip" else FLOOR_KNEE_RAD
        elif kind == "hip":
            centre[k], half = 0.0, HIP_RAD
        else:
            centre[k], half = (low + high) / 2, (high - low) / 2 - KNEE_MARGIN_RAD
        reach[k] = max(0.0, min(half, centre[k] - low, high - centre[k]))
    return centre, reach
