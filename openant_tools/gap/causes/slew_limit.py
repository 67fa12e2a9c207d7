"""The servo limits the speed of its own setpoint (its profile velocity)."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, rate
from openant_tools.gap.robot import Reference, Robot

__all__ = ["CAUSE"]


def _speed(reference: Reference, joints: Ints) -> float:
    return float(reference.speed[joints].max())


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.slew[joints] = np.minimum(robot.slew[joints], values["rate_rad_s"])


CAUSE = Cause(
    name="slew_limit",
    family="timing",
    words="the servo limits how fast its setpoint moves",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(rate("rate_rad_s", "rad/s", 0.6, 8.0, _speed),),
    enter=_enter,
    native=True,
)
