"""The floor is more or less slippery than in the model."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, factor
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.floor_friction *= values["sliding"]


CAUSE = Cause(
    name="floor_friction",
    family="contact",
    words="the floor is more or less slippery",
    scopes=(Scope.BODY,),
    quantities=(factor("sliding", 0.18, 1.2),),
    enter=_enter,
    native=True,
    alike=("foot_adhesion",),
    shows=lambda reference: reference.floor,
)
