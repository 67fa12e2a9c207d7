"""Dry friction differs by direction."""

from __future__ import annotations

from collections.abc import Mapping

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount, usual_torque
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]

#: share by which the two directions must differ
APART = 0.25


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    for name in ("positive_nm", "negative_nm"):
        robot.law("asymmetric_friction", name)[joints] += values[name]


def _simpler(x: Mapping[str, float]) -> str | None:
    """Friction that is nearly alike either way is plain dry friction."""
    high, low = max(x.values()), min(x.values())
    return "coulomb_friction" if low > (1 - APART) * high else None


CAUSE = Cause(
    name="asymmetric_friction",
    family="friction",
    words="dry friction differs by direction",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        amount("positive_nm", "N·m", 0.035, 0.35, scale=usual_torque),
        amount("negative_nm", "N·m", 0.035, 0.35, scale=usual_torque),
    ),
    enter=_enter,
    native=False,
    together=True,
    simpler=_simpler,
)
