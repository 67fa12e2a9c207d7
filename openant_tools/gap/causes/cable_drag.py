"""A cable pulls at the torso."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Reference, Robot

__all__ = ["CAUSE"]


def _weight(reference: Reference, joints: Ints) -> float:
    return 9.81 * reference.robot_kg


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.cable.force_n[:2] += values["force_x_n"], values["force_y_n"]
    robot.cable.damping_n_s_m += values["damping_n_s_m"]


CAUSE = Cause(
    name="cable_drag",
    family="environment",
    words="a cable pulls at the torso",
    scopes=(Scope.BODY,),
    quantities=(
        amount("force_x_n", "N", 0.015, 0.15, signed=True, scale=_weight),
        amount("force_y_n", "N", 0.015, 0.15, signed=True, scale=_weight),
        amount("damping_n_s_m", "N·s/m", 0.05, 0.5, scale=_weight),
    ),
    enter=_enter,
    native=True,
    together=True,
    shows=lambda reference: reference.floor,
)
