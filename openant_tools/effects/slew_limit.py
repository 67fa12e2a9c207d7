"""The servo limits the speed of its own setpoint (its profile velocity)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.effect import Effect, Ints, Scope, Values, rate
from openant_tools.effects.robot import Reference, Robot
from openant_tools.effects.servo_form import servo
from openant_tools.effects.step import Law, Step

__all__ = ["effect", "slewing"]

Array = NDArray[np.float64]


def _speed(reference: Reference, joints: Ints) -> float:
    return float(reference.speed[joints].max())


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.slew[joints] = np.minimum(robot.slew[joints], values["rate_rad_s"])


def slewing(rate: Array, begun: Array) -> Law:
    """The law, for (robots, joints) rad/s, inf for none, and where setpoints are as it begins, rad; NaN: where they are asked to be."""
    at: list[Array] = []

    def act(step: Step) -> None:
        if not at:
            at.append(np.where(np.isnan(begun), step.setpoint, begun))
        at[0] += np.clip(step.setpoint - at[0], -rate * step.dt, rate * step.dt)
        step.setpoint = at[0].copy()

    return act


effect = Effect(
    name="slew_limit",
    family="timing",
    words="the servo limits how fast its setpoint moves",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(rate("rate_rad_s", "rad/s", 0.6, 8.0, _speed),),
    enter=_enter,
    native=True,
    writer=servo,
)
