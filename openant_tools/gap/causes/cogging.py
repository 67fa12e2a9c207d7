"""A torque that repeats with the joint's angle: magnets, or a bad tooth."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount, shape, usual_torque
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("cogging", "amplitude_nm")[joints] += values["amplitude_nm"]
    robot.law("cogging", "periods")[joints] = values["periods"]


CAUSE = Cause(
    name="cogging",
    family="transmission",
    words="a torque repeats with the joint's angle",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        amount("amplitude_nm", "N·m", 0.03, 0.4, scale=usual_torque),
        shape("periods", "1", 6.0, 40.0, levels=12),
    ),
    enter=_enter,
    native=True,
)
