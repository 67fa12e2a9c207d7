"""When a command acts scatters about when it was logged."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.jitter_s = float(np.hypot(robot.jitter_s, values["std_s"]))


CAUSE = Cause(
    name="clock_jitter",
    family="timing",
    words="when a command acts scatters",
    scopes=(Scope.ALL,),
    quantities=(amount("std_s", "s", 0.0015, 0.015),),
    enter=_enter,
    native=False,
    random=True,
)
