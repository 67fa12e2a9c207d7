"""What sensors make of the truth: in how many ways a servo may tell its torque, and what noise and steps do to every signal.

Nobody says how a given servo filters, scales and rounds its current, or whether it has a sign at all. What simulated robots
are compared with has to be as varied, so that nothing of it can be mistaken for a cause.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.robot import Robot
from openant_tools.gap.features import Floats, Signals, with_noise

__all__ = ["TorqueSensor", "logged_by", "widened"]

Array = NDArray[np.float64]

#: s: time constants of a driver's filter, and by how much its reading is older than the servo's position
FILTER_S, OLDER_S = (0.002, 0.06), 0.02
#: logarithm of how unequal the scales of joints are; shares of the usual torque: standby, offsets, steps, and where it clips
UNEQUAL, STANDBY, OFFSET, STEP, CLIPS = 0.08, 0.4, 0.1, (0.01, 0.3), (0.8, 3.0)
#: s by which a tracker's poses are older than joints, and velocities beyond what a register's filter makes them; scale of a tracker
TRACKER_LATE_S, VELOCITY_LATE_S, TRACKER_SCALE = 0.05, 0.01, 0.01
#: of how many robots each is true
FILTERED, OLD, STANDS_BY, OFF, STEPS, CLIPPED, UNSIGNED = 0.5, 0.3, 0.35, 0.3, 0.6, 0.2, 0.08


@dataclass(frozen=True)
class TorqueSensor:
    """How the servos of one robot tell their torque; all but the scale in shares of what they usually give.

    Attributes:
        filter_s: time constant, 0 for none. older_s: beyond the position's row. scale, offset: (joints,).
        standby: added to its size, whatever it gives. step: 0 for none. clip: inf for none. unsigned: it has no sign.
    """

    filter_s: float
    older_s: float
    scale: Array
    offset: Array
    standby: float
    step: float
    clip: float
    unsigned: bool

    @classmethod
    def draw(cls, rng: np.random.Generator, joints: int) -> TorqueSensor:
        def either(share: float, value: float, otherwise: float = 0.0) -> float:
            return value if rng.random() < share else otherwise

        return cls(
            filter_s=either(FILTERED, math.exp(rng.uniform(*np.log(FILTER_S)))),
            older_s=either(OLD, float(rng.uniform(0, OLDER_S))),
            scale=np.exp(UNEQUAL * rng.normal(size=joints)),
            offset=either(OFF, OFFSET) * rng.normal(size=joints),
            standby=either(STANDS_BY, float(rng.uniform(0, STANDBY))),
            step=either(STEPS, math.exp(rng.uniform(*np.log(STEP)))),
            clip=either(CLIPPED, math.exp(rng.uniform(*np.log(CLIPS))), math.inf),
            unsigned=bool(rng.random() < UNSIGNED),
        )

    def __call__(self, torque: Floats, t: Array, usual: float) -> Floats:
        """What it tells: (rows, joints) for a torque (rows, joints) at times t (s), both in N·m."""
        y = torque.astype(np.float64)
        period = float(np.median(np.diff(t)))
        if self.filter_s:
            from scipy.signal import lfilter  # a second to load

            keep = math.exp(-period / self.filter_s)
            known = np.nan_to_num(y)
            y = lfilter([1 - keep], [1, -keep], known, axis=0, zi=keep * known[:1])[0]
        if self.older_s:
            y = np.stack([np.interp(t - self.older_s, t, column) for column in y.T], axis=1)
        y = y * self.scale + usual * (self.offset + self.standby * np.sign(y))
        if self.unsigned:
            y = np.abs(y)
        y = np.clip(y, -self.clip * usual, self.clip * usual)
        if self.step:
            y = np.round(y / (self.step * usual)) * self.step * usual
        return y.astype(np.float32)


def widened(robot: Robot, rng: np.random.Generator) -> None:
    """Let a robot's sensors and its log differ, in place, by what is no effect of theirs but how trackers, filters and hosts are."""
    robot.log_delay["base"] = robot.log_delay.get("base", 0.0) + float(rng.uniform(0, TRACKER_LATE_S))
    robot.log_delay["vel"] = robot.log_delay.get("vel", 0.0) + float(rng.uniform(0, VELOCITY_LATE_S))
    robot.base_scale *= math.exp(float(rng.normal(0, TRACKER_SCALE)))
    robot.switching = float(rng.uniform(-1, 1))


def logged_by(
    robots: Sequence[Robot], signals: Signals, resolution: Mapping[str, float], rng: np.random.Generator, t: Array
) -> dict[str, Floats]:
    """What the sensors of robots, each with its own, log of the truth.

    Args:
        signals: name → (robots, rows, columns). resolution: signal → steps of its sensor. t: (rows,) s.
    """
    out = with_noise(signals, robots, resolution, rng, t)
    if "torque" in out:
        torque = out["torque"]
        usual = np.sqrt(np.nanmean(np.square(torque), axis=(1, 2))) + 1e-9
        for r in range(len(robots)):
            # What was commanded when a run began is not known: rows before its first are NaN.
            whole = np.isfinite(torque[r]).all(axis=1)
            sensor = TorqueSensor.draw(np.random.default_rng(rng.integers(2**63)), torque.shape[2])
            if whole.sum() > 2:
                torque[r, whole] = sensor(torque[r, whole], t[whole], float(usual[r]))
    return out
