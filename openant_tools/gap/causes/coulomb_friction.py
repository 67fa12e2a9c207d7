"""Dry friction is not what the model says."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount, usual_torque
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.more("coulomb_friction")[joints] += values["torque_nm"]


CAUSE = Cause(
    name="coulomb_friction",
    family="friction",
    words="dry friction is not what the model says",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("torque_nm", "N·m", 0.025, 0.4, signed=True, scale=usual_torque),),
    enter=_enter,
    native=True,
)
