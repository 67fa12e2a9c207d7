"""Friction grows with the torque that the gears carry."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount, share
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("load_friction", "coefficient")[joints] += values["coefficient"]
    robot.law("load_friction", "electrical")[joints] = values["electrical"]


CAUSE = Cause(
    name="load_friction",
    family="friction",
    words="friction grows with the torque that the gears carry",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    # How much of the damping is back-EMF, which the gears do not carry, no data sheet of a model says.
    quantities=(amount("coefficient", "N·m/(N·m)", 0.06, 0.6), share("electrical")),
    enter=_enter,
    native=False,
    restored=lambda given, x, reference, joints: {"electrical": 0.0, **given},
)
