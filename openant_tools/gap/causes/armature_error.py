"""The rotor's inertia, seen through the gear, is not what the model says."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, factor
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("armature")[joints] *= values["scale"]


CAUSE = Cause(
    name="armature_error",
    family="inertia",
    words="the rotor's inertia is not what the model says",
    scopes=(Scope.SERVO, Scope.ALL),
    quantities=(factor("scale", 0.34, 1.8),),
    enter=_enter,
    native=True,
)
