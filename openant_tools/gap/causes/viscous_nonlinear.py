"""Damping grows with the square of speed."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Reference, Robot

__all__ = ["CAUSE"]


def _damping(reference: Reference, joints: Ints) -> float:
    return float(reference.damping[joints].mean())


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("viscous_nonlinear", "coefficients")[joints] += values["coefficients"]


CAUSE = Cause(
    name="viscous_nonlinear",
    family="friction",
    words="damping grows with the square of speed",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("coefficients", "N·m·s²/rad²", 0.12, 1.2, scale=_damping),),
    enter=_enter,
    native=True,
)
