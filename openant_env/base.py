"""What the simulated and the real Open Ant have in common as environments: actions, observations, task, names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_env.actions import action_map
from openant_env.metrics import AverageReward
from openant_env.observations import ORDERS, layout
from openant_env.robots import SimulatedRobot
from openant_env.tasks import BackAndForth, make_task
from openant_tools.errors import BadInput
from openant_tools.numbers import exact

__all__ = ["AntBase", "Observation", "OnFall", "unit"]

Observation = NDArray[np.float32]
OnFall = Literal["truncate", "terminate", "ignore"]


class AntBase(gymnasium.Env[Observation, NDArray[Any]]):  # type: ignore[misc]
    """An Open Ant that walks: the same spaces and the same words, whether it is simulated or stands on the floor.

    Args:
        robot: limits, ranges, bounds and model.
        others: as `openant_env.ant.Ant` describes them.

    Raises:
        BadInput: in one line, which argument cannot be used.
    """

    metadata: dict[str, Any] = {}  # noqa: RUF012

    def __init__(
        self,
        robot: SimulatedRobot,
        *,
        task: str,
        task_options: Mapping[str, Any] | None,
        dt: float | None,
        action_range: str | None,
        observation_order: str,
        on_fall: OnFall,
        time_limit_s: float | None,
    ) -> None:
        if on_fall not in ("truncate", "terminate", "ignore"):
            raise BadInput(f"on_fall is {on_fall!r}", remedy="use 'truncate', 'terminate' or 'ignore'")
        if observation_order not in ORDERS:
            raise BadInput(
                f"no such order of observations: {observation_order!r}", remedy=f"choose one of {', '.join(ORDERS)}"
            )
        if time_limit_s is not None and not time_limit_s > 0.0:
            raise BadInput(
                f"the time limit is {exact(time_limit_s, 's')}", remedy="give a time above 0, or None for no limit"
            )
        self.robot = robot
        self.dt = robot.dt_s if dt is None else float(dt)
        self.metadata = {**type(self).metadata, "render_fps": max(1, round(1.0 / self.dt)) if self.dt > 0.0 else 1}
        joints = robot.joints
        self.actions = action_map(
            robot.action_range if action_range is None else action_range, joints, robot.low, robot.high
        )
        self.layout = layout(joints, observation_order)
        circle = {"radius_m": robot.arena.radius_m} if task == BackAndForth.name else {}
        self.task = make_task(task, {**circle, **(task_options or {})})
        self.average_reward = AverageReward()
        self._on_fall = on_fall
        self._time_limit_s = math.inf if time_limit_s is None else float(time_limit_s)
        self._seconds = 0.0

        size = len(self.layout)
        low, high = np.full(size, -np.inf, np.float32), np.full(size, np.inf, np.float32)
        direction = self.layout.slices["direction"]
        # A unit vector computed in single precision may stick out by its rounding error.
        low[direction], high[direction] = -1.0 - 1e-6, 1.0 + 1e-6
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(joints),), np.float32)
        self._command = np.empty(len(joints))
        self._least, self._most = np.full(len(joints), -1.0), np.full(len(joints), 1.0)  # quicker than plain −1 and 1
        measured = [name for name in self.layout.names if name in robot.measured_bounds]
        self._bounded = np.array([self.layout.names.index(name) for name in measured], np.intp)
        self._bounded_low = np.array([robot.measured_bounds[name][0] for name in measured])
        self._bounded_high = np.array([robot.measured_bounds[name][1] for name in measured])

    @property
    def observation_names(self) -> tuple[str, ...]:
        """What each number of an observation is, such as `pos.hip_rr`."""
        return self.layout.names

    @property
    def observation_bounds(self) -> tuple[Observation, Observation]:
        """Low and high, each (24,), that observations keep to in practice: the robot's measured bounds where its
        folder has them, else nominal ones. Not a promise: use them to normalise, never to clip what you learn from."""
        return self.robot.bounds(self.layout)

    @property
    def measured_bounds(self) -> Mapping[str, tuple[float, float]]:
        """Name of an observation → (low, high), of those alone whose bounds were measured on the robot."""
        return self.robot.measured_bounds

    @property
    def command(self) -> NDArray[np.float64]:
        """(joints,) rad, what the last action commanded."""
        return self._command.copy()

    def describe(self) -> dict[str, Any]:
        """What a policy trained here depends on, as plain values: to be kept beside it and compared before it plays."""
        return {
            "observation_names": list(self.layout.names),
            "action_names": list(self.robot.joints),
            "action_range": {
                "centre_rad": self.actions.centre.round(6).tolist(),
                "half_rad": self.actions.half.round(6).tolist(),
            },
            "dt": self.dt,
            "task": self.task.name,
            "model_sha256": self.robot.model_sha256(),
        }

    def _set_command(self, action: NDArray[Any]) -> None:
        """Work out what an action commands, (joints,) rad, into `_command`; finite ones are clipped, others refused."""
        command, actions = self._command, self.actions
        action = np.asarray(action)
        if action.shape != command.shape:
            raise BadInput(f"an action has shape {action.shape}", remedy=f"give {len(command)} numbers")
        if action.dtype.kind not in "fiu":
            raise BadInput(f"an action is of {action.dtype}, no numbers", remedy=f"give {len(command)} numbers")
        if not np.isfinite(action).all():
            joint = int(np.flatnonzero(~np.isfinite(action))[0])
            raise BadInput(
                f"an action is not finite: {action[joint]} for {self.robot.joints[joint]}",
                remedy="look for NaN in the agent's networks",
            )
        np.minimum(np.maximum(action, self._least, out=command), self._most, out=command)
        command *= actions.half
        command += actions.centre
        if actions.clipped:
            np.minimum(np.maximum(command, actions.low, out=command), actions.high, out=command)

    def _info(self, x: float, y: float, hx: float, hy: float, observation: Any) -> dict[str, Any]:
        task = self.task
        info = {
            "position": np.array((x, y)),
            "heading": np.array((hx, hy)),
            "reward_direction": np.array((task.ux, task.uy)),
            "average_reward_m_s": self.average_reward.value,
            "time_s": self._seconds,
            "dt": self.dt,
        }
        if len(self._bounded):
            seen = observation[self._bounded]
            beyond = (seen < self._bounded_low) | (seen > self._bounded_high)
            if beyond.any():
                info["out_of_bounds"] = tuple(self.layout.names[k] for k in self._bounded[beyond])
        return info


def unit(x: float, y: float) -> tuple[float, float]:
    """The vector made 1 long; east where it has no length, as the heading of a robot that points straight up."""
    length = math.hypot(x, y)
    return (x / length, y / length) if length > 1e-9 else (1.0, 0.0)
