"""The servo follows its command through a first-order filter."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.lag[joints] += values["time_constant_s"]


CAUSE = Cause(
    name="actuator_lag",
    family="timing",
    words="the servo follows a filtered command",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("time_constant_s", "s", 0.006, 0.12),),
    enter=_enter,
    native=True,
)
