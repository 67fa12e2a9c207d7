"""What a robot amid a run remembers of it: a simulation that begins there has to know it, too.

It is made up from what was commanded and measured until then, so that it costs no simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Step
from openant_tools.effects.thermal_derating import Heating
from openant_tools.model.rollout import Measured, Staircase

__all__ = ["heats", "setpoints"]

Array = NDArray[np.float64]

#: s, steps in which setpoints of limited rate are followed
STEP_S = 0.01
#: s, of heat: between two commands a servo's torque is not what it is as one comes
HEAT_STEP_S = 0.005


def setpoints(commands: Staircase, starts: Sequence[float], robots: Sequence[Robot]) -> Array:
    """(starts, robots, joints) rad: how far setpoints of limited rate have come, NaN where the rate is not limited."""
    rate, delay = (np.array([getattr(robot, name) for robot in robots]) for name in ("slew", "delay"))
    limited = np.isfinite(rate)
    if not limited.any():
        return np.full((len(starts), *rate.shape), np.nan)
    grid = np.arange(min(commands.times[0], *starts), max(starts) + STEP_S, STEP_S)
    path = np.zeros((len(grid), *rate.shape))
    for r, j in np.argwhere(limited):
        path[:, r, j] = commands.column(int(j)).at(grid - delay[r, j])[:, 0]
    for k in range(1, len(grid)):
        path[k] = path[k - 1] + np.clip(path[k] - path[k - 1], -rate * STEP_S, rate * STEP_S)
    return np.where(limited, _between(grid, path, starts), np.nan)


def heats(
    measured: Measured,
    commands: Staircase,
    starts: Sequence[float],
    robots: Sequence[Robot],
    start_c: Array,
    servos: Callable[[float, tuple[Array, Array], Array], Step],
) -> Array:
    """(starts, robots, joints) °C: how warm servos have become that were commanded so and moved as measured.

    Args:
        start_c: (robots, joints) °C as the run begins.
        servos: the robots' as (dt, (positions, velocities), setpoints) find them.
    """
    zero, delay = (np.array([getattr(robot, name) for robot in robots]) for name in ("zero", "delay"))
    loss, seconds = np.array([robot.derating for robot in robots]), np.array([[robot.derating_s] for robot in robots])
    heating = Heating({"loss_per_c": loss, "time_constant_s": seconds}, start_c)
    times: Array = np.arange(measured.begin, max(*starts, measured.begin) + HEAT_STEP_S, HEAT_STEP_S, dtype=np.float64)
    setpoint = np.empty((len(times), *zero.shape))
    for j in range(zero.shape[1]):
        for late in np.unique(delay[:, j]):
            setpoint[:, delay[:, j] == late, j] = commands.column(j).at(times - late)
    position, velocity = measured.at(times)
    path = np.empty((len(times), *zero.shape))
    for k in range(len(times)):
        path[k] = heating.state
        state = position[k] - zero, np.broadcast_to(velocity[k], zero.shape)
        heating(servos(HEAT_STEP_S, state, setpoint[k] - zero))
    return _between(times, path, starts)


def _between(times: Array, path: Array, at: Sequence[float]) -> Array:
    """(at, …) of what is known (times, …), between them in proportion."""
    when = np.clip(at, times[0], times[-1])
    low = np.clip(np.searchsorted(times, when, side="right") - 1, 0, max(len(times) - 2, 0))
    high = np.minimum(low + 1, len(times) - 1)
    share = (when - times[low]) / np.maximum(times[high] - times[low], 1e-9)
    share = share.reshape(-1, *[1] * (path.ndim - 1))
    out: Array = path[low] * (1 - share) + path[high] * share
    return out
