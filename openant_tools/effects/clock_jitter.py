"""When a command acts scatters about when it was logged."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Chance, Effect, Ints, Parameter, Scope, Values, amount
from openant_tools.effects.robot import Robot

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.jitter_s = float(np.hypot(robot.jitter_s, values["std_s"]))


effect = Effect(
    name="clock_jitter",
    family="timing",
    words="when a command acts scatters",
    scopes=(Scope.ALL,),
    quantities=(amount("std_s", "s", 0.0015, 0.015),),
    enter=_enter,
    native=False,
    parameters=(Parameter("std_s", "s", high=1.0),),
    acts_on="commands",
    random=Chance.SCATTERED,
)
