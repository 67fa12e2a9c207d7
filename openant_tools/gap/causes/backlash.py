"""The gears have play."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.play[joints] += values["gap_rad"]


CAUSE = Cause(
    name="backlash",
    family="transmission",
    words="the gears have play",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("gap_rad", "rad", 0.006, 0.09),),
    enter=_enter,
    native=True,
)
