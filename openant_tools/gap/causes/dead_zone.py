"""The position loop ignores small errors."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("dead_zone", "width_rad")[joints] += values["width_rad"]


CAUSE = Cause(
    name="dead_zone",
    family="transmission",
    words="the position loop ignores small errors",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("width_rad", "rad", 0.008, 0.12),),
    enter=_enter,
    native=False,
)
