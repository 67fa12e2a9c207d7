"""The gears have play."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Robot
from openant_tools.effects.transmission import hinges

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.play[joints] += values["gap_rad"]


effect = Effect(
    name="backlash",
    family="transmission",
    words="the gears have play",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("gap_rad", "rad", 0.006, 0.09),),
    enter=_enter,
    native=True,
    writer=hinges,
)
