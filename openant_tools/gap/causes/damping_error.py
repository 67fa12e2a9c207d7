"""Velocity gain and damping together are not what the model says."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, factor
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("damping")[joints] *= values["scale"]


CAUSE = Cause(
    name="damping_error",
    family="gain",
    words="velocity gain and damping are not what the model says",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(factor("scale", 0.28, 2.0),),
    enter=_enter,
    native=True,
)
