"""A servo whose gain and torque have fallen together."""

from __future__ import annotations

from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Robot

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    for kind in ("stiffness", "torque_limit"):
        robot.weaken(kind, joints, 1 - values["loss"])


_swap = Action("swap two servos", "what moves with the servo is the servo's, what stays is the leg's")

effect = Effect(
    name="weak_joint",
    family="gain",
    words="gain and torque have fallen together",
    scopes=(Scope.JOINT,),
    quantities=(amount("loss", "1", 0.18, 0.7),),
    enter=_enter,
    native=True,
    # With one joint it is stiffness and torque limit of all.
    shows=lambda reference: len(reference.torque) > 1,
    stated=lambda values, reference, joints: {"scale": 1 - values["loss"]},
    restored=lambda given, x, reference, joints: {"loss": 1 - given["scale"]},
    told_from={"torque_limit": _swap, "stiffness_error": _swap},
)
