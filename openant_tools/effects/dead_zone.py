"""The position loop ignores small errors."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Ints, Parameter, Scope, Table, Values, amount
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Law, Step

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("dead_zone", "width_rad")[joints] += values["width_rad"]


def _law(values: Table) -> Law:
    half = values["width_rad"] / 2

    def act(step: Step) -> None:
        error = step.setpoint - step.position
        # Beyond the zone the whole error counts again, less the zone: the loop has no step in its torque.
        step.setpoint = step.position + np.sign(error) * np.maximum(np.abs(error) - half, 0.0)

    return act


effect = Effect(
    name="dead_zone",
    family="transmission",
    words="the position loop ignores small errors",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("width_rad", "rad", 0.008, 0.12),),
    enter=_enter,
    native=False,
    law=_law,
    order=20,
    parameters=(Parameter("width_rad", "rad", 0.01, high=0.5),),
)
