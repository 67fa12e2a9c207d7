"""The torso carries something."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Reference, Robot

__all__ = ["CAUSE"]


def _robot(reference: Reference, joints: Ints) -> float:
    return reference.robot_kg


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.payload_kg += values["mass_kg"]
    robot.payload_m[:2] = values["x_m"], values["y_m"]


CAUSE = Cause(
    name="payload",
    family="inertia",
    words="the torso carries something",
    scopes=(Scope.BODY,),
    quantities=(
        amount("mass_kg", "kg", 0.06, 0.5, scale=_robot),
        amount("x_m", "m", 0.01, 0.06, signed=True),
        amount("y_m", "m", 0.01, 0.06, signed=True),
    ),
    enter=_enter,
    native=True,
    shows=lambda reference: reference.floor,
)
