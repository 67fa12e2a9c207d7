"""Stiffness is not what the model says."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, factor
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("stiffness")[joints] *= values["scale"]


CAUSE = Cause(
    name="stiffness_error",
    family="gain",
    words="stiffness is not what the model says",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(factor("scale", 0.18, 1.1),),
    enter=_enter,
    native=True,
)
