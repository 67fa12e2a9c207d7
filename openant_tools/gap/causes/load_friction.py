"""Friction grows with the torque that the gears carry."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("load_friction", "coefficient")[joints] += values["coefficient"]


CAUSE = Cause(
    name="load_friction",
    family="friction",
    words="friction grows with the torque that the gears carry",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("coefficient", "N·m/(N·m)", 0.06, 0.6),),
    enter=_enter,
    native=False,
)
