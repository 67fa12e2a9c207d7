"""Commands act later than they were sent."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.delay[joints] += values["delay_s"]


CAUSE = Cause(
    name="action_delay",
    family="timing",
    words="commands act later than they were sent",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("delay_s", "s", 0.003, 0.06),),
    enter=_enter,
    native=True,
)
