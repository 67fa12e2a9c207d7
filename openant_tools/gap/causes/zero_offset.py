"""A joint's zero is off."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.zero[joints] += values["angle_rad"]


CAUSE = Cause(
    name="zero_offset",
    family="geometry",
    words="a joint's zero is off",
    scopes=(Scope.JOINT,),
    quantities=(amount("angle_rad", "rad", 0.012, 0.16, signed=True),),
    enter=_enter,
    native=True,
    silent=True,
)
