"""Dry friction is larger at rest than in motion."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount, shape, usual_torque
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("stribeck_friction", "static_nm")[joints] += values["static_nm"]
    robot.law("stribeck_friction", "velocity_rad_s")[joints] = values["velocity_rad_s"]


CAUSE = Cause(
    name="stribeck_friction",
    family="friction",
    words="dry friction is larger at rest than in motion",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        amount("static_nm", "N·m", 0.03, 0.6, scale=usual_torque),
        shape("velocity_rad_s", "rad/s", 0.05, 0.6),
    ),
    enter=_enter,
    native=True,
    stated=lambda values, reference, joints: {"coulomb_nm": 0.0, **values},
)
