"""What the robot is rewarded for: walking back and forth across a circle, or straight on.

A task sees the torso's planar position and heading once a step and answers with a reward in metres and with the
direction that stands in the observation. Plain floats throughout: a step costs about a microsecond.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.numbers import exact

__all__ = ["TASKS", "BackAndForth", "Forward", "Task", "make_task"]

#: m, radius of the circle in all experiments of the paper.
RADIUS_M = 0.3


class Task(ABC):
    """Reward and goal direction from planar motion.

    Attributes:
        ux, uy: the reward direction in force, a unit vector in the world.
    """

    name: str
    ux: float = 1.0
    uy: float = 0.0

    def __init__(self) -> None:
        self._x = 0.0
        self._y = 0.0

    def reset(self, x: float, y: float, random: np.random.Generator, direction_rad: float | None = None) -> None:
        """Begin at a position (m), with a given reward direction (rad, world) or the task's own."""
        self._x, self._y = x, y

    @abstractmethod
    def reward(self, x: float, y: float) -> float:
        """m, the reward of the step that ended at this position (m)."""

    @abstractmethod
    def observed_direction(self, hx: float, hy: float) -> tuple[float, float]:
        """The direction in the observation, given the robot's heading (unit vector in the world)."""

    def get_state(self) -> dict[str, float]:
        """What `set_state` needs to go on from here."""
        return {"x": self._x, "y": self._y, "ux": self.ux, "uy": self.uy}

    def set_state(self, state: Mapping[str, float]) -> None:
        """Go on where `get_state` was called."""
        self._x, self._y, self.ux, self.uy = state["x"], state["y"], state["ux"], state["uy"]


class BackAndForth(Task):
    """Cross a circle again and again: r = (p_t − p_{t−1})·u, with u turned towards the centre beyond the circle.

    The direction turns when |p − o| > R and (p − o)·u > 0; it becomes (o − p)/|o − p| (the paper's equations for
    reward and switching). The observation holds u in the body frame: along the heading, and to its left.

    Args:
        radius_m: m, the circle's radius R.
        origin: (x, y) in m, its centre o.
        scored: `"paper"`: a step is scored against the direction in force while it was made, and the new direction
            holds from the next step on. `"platform"`: the published software turns first, so that the step which
            crosses the circle is scored against the new direction.
    """

    name = "back-and-forth"

    def __init__(
        self, *, radius_m: float = RADIUS_M, origin: Sequence[float] = (0.0, 0.0), scored: str = "paper"
    ) -> None:
        super().__init__()
        if scored not in ("paper", "platform"):
            raise BadInput(f"no such way of scoring: {scored!r}", remedy="use 'paper' or 'platform'")
        if not radius_m > 0.0:
            raise BadInput(f"the circle's radius is {exact(radius_m, 'm')}", remedy="give a radius above 0")
        self.radius_m = float(radius_m)
        self.ox, self.oy = (float(value) for value in origin)
        self.scored = scored

    def reset(self, x: float, y: float, random: np.random.Generator, direction_rad: float | None = None) -> None:
        super().reset(x, y, random)
        angle = random.uniform(-math.pi, math.pi) if direction_rad is None else direction_rad
        self.ux, self.uy = math.cos(angle), math.sin(angle)

    def reward(self, x: float, y: float) -> float:
        dx, dy = x - self._x, y - self._y
        self._x, self._y = x, y
        reward = dx * self.ux + dy * self.uy
        ax, ay = x - self.ox, y - self.oy
        distance = math.hypot(ax, ay)
        if distance > self.radius_m and ax * self.ux + ay * self.uy > 0.0:
            self.ux, self.uy = -ax / distance, -ay / distance
            if self.scored == "platform":
                reward = dx * self.ux + dy * self.uy
        return reward

    def observed_direction(self, hx: float, hy: float) -> tuple[float, float]:
        return self.ux * hx + self.uy * hy, self.uy * hx - self.ux * hy


class Forward(Task):
    """Walk along the world's x axis: r = Δx. The observation holds the heading in the world."""

    name = "forward"

    def reward(self, x: float, y: float) -> float:
        dx = x - self._x
        self._x, self._y = x, y
        return dx

    def observed_direction(self, hx: float, hy: float) -> tuple[float, float]:
        return hx, hy


TASKS: Mapping[str, type[Task]] = {task.name: task for task in (BackAndForth, Forward)}


def make_task(name: str, options: Mapping[str, Any] | None = None) -> Task:
    """A task by name.

    Raises:
        BadInput: no such task, or an option that it does not know.
    """
    if name not in TASKS:
        raise BadInput(f"no such task: {name!r}", remedy=f"choose one of {', '.join(TASKS)}")
    try:
        return TASKS[name](**(options or {}))
    except TypeError:
        raise BadInput(
            f"the task {name} does not take the options {', '.join(options or {})}",
            remedy="back-and-forth takes radius_m, origin and scored; forward takes none",
        ) from None
