"""The servo's own trajectory from one goal to the next: step, rectangle, triangle or trapezoid of velocity."""

from __future__ import annotations

import math
from dataclasses import dataclass

from openant_tools.robot.registers import PULSES_PER_TURN, RAD_S_PER_COUNT

__all__ = ["Trajectory", "start_trajectory"]

_PULSES_PER_RAD = PULSES_PER_TURN / (2 * math.pi)
PULSES_S_PER_COUNT = RAD_S_PER_COUNT * _PULSES_PER_RAD
#: 214.577 rev/min² in pulses/s²
PULSES_S2_PER_COUNT = 214.577 / 3600 * PULSES_PER_TURN
RECTANGLE, TRIANGLE, TRAPEZOID = 1, 2, 3


@dataclass(slots=True)
class Trajectory:
    """A move under way, in pulses and seconds; `step` walks it.

    Velocity rises and falls with `acceleration` (infinite for a rectangle) and never passes `speed`. A new goal in
    mid-move starts from the position and velocity reached, as the firmware's does.
    """

    position: float
    velocity: float
    goal: float
    speed: float
    acceleration: float
    shape: int

    def step(self, dt: float) -> bool:
        """Advance by dt; False once the goal is reached."""
        left = self.goal - self.position
        if math.isinf(self.acceleration):
            self.velocity = math.copysign(self.speed, left)
        else:
            # The speed from which the braking distance is just what is left, for steps of dt.
            a = self.acceleration
            braking = math.sqrt((a * dt / 2) ** 2 + 2 * a * abs(left)) - a * dt / 2
            wanted = math.copysign(min(self.speed, braking), left)
            change = a * dt
            self.velocity += max(-change, min(change, wanted - self.velocity))
        move = self.velocity * dt
        arrives = abs(left) <= abs(move) and left * move >= 0
        if arrives or (abs(left) < 0.5 and abs(self.velocity) <= self.acceleration * dt):
            self.position, self.velocity = self.goal, 0.0
            return False
        self.position += move
        return True


def start_trajectory(
    position: float, velocity: float, goal: float, *, velocity_count: float, acceleration_count: float, time_based: bool
) -> Trajectory | None:
    """The move to a new goal; None for a step (profile velocity 0).

    Args:
        position, velocity: where the trajectory stands, pulses and pulses/s.
        velocity_count, acceleration_count: the profile registers; counts, or ms of total and of rising time.
    """
    distance = abs(goal - position)
    if velocity_count == 0 or (distance == 0 and velocity == 0):
        return None
    if time_based:
        total = velocity_count * 1e-3
        rising = min(acceleration_count * 1e-3, total / 2)
        speed = distance / (total - rising)
        acceleration = speed / rising if rising > 0 else math.inf
        # A time of 1 ms over a long way is a step in all but name; nothing divides by zero below.
        shape = RECTANGLE if rising == 0 else TRIANGLE if rising * 2 >= total else TRAPEZOID
        return Trajectory(position, velocity, goal, speed, acceleration, shape) if speed > 0 else None
    speed = velocity_count * PULSES_S_PER_COUNT
    if acceleration_count == 0:
        return Trajectory(position, velocity, goal, speed, math.inf, RECTANGLE)
    acceleration = acceleration_count * PULSES_S2_PER_COUNT
    shape = TRAPEZOID if distance * acceleration > speed * speed else TRIANGLE
    return Trajectory(position, velocity, goal, speed, acceleration, shape)
