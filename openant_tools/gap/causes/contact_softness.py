"""Feet or floor are softer or harder than in the model."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, factor
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.softness *= values["time_constant"]


CAUSE = Cause(
    name="contact_softness",
    family="contact",
    words="feet or floor are softer or harder",
    scopes=(Scope.BODY,),
    quantities=(factor("time_constant", 0.35, 1.7),),
    enter=_enter,
    native=True,
    shows=lambda reference: reference.floor,
)
