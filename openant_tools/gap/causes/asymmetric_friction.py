"""Dry friction differs by direction."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Reference, Robot

__all__ = ["CAUSE"]


def _torque(reference: Reference, joints: Ints) -> float:
    return float(reference.torque[joints].mean())


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    for name in ("positive_nm", "negative_nm"):
        robot.law("asymmetric_friction", name)[joints] += values[name]


CAUSE = Cause(
    name="asymmetric_friction",
    family="friction",
    words="dry friction differs by direction",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        amount("positive_nm", "N·m", 0.035, 0.25, scale=_torque),
        amount("negative_nm", "N·m", 0.035, 0.25, scale=_torque),
    ),
    enter=_enter,
    native=False,
    together=True,
)
