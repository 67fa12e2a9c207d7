"""The supply's voltage falls with what all servos draw together."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("voltage_sag", "resistance_ohm")[:] += values["resistance_ohm"]


CAUSE = Cause(
    name="voltage_sag",
    family="torque supply",
    words="the supply's voltage falls with what all servos draw",
    scopes=(Scope.ALL,),
    quantities=(amount("resistance_ohm", "Ω", 0.15, 4.0),),
    enter=_enter,
    native=False,
    witness="volt",
)
