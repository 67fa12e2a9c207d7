"""Feet stick to the floor."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Reference, Robot

__all__ = ["effect"]


def _weight(reference: Reference, joints: Ints) -> float:
    return 9.81 * reference.robot_kg / 2


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.adhesion_n += values["force_n"]


effect = Effect(
    name="foot_adhesion",
    family="contact",
    words="feet stick to the floor",
    scopes=(Scope.BODY,),
    quantities=(amount("force_n", "N", 0.05, 0.9, scale=_weight),),
    enter=_enter,
    native=True,
    shows=lambda reference: reference.floor,
)
