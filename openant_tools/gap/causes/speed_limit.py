"""The torque that a servo can give falls with its speed."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, rate
from openant_tools.gap.robot import Reference, Robot

__all__ = ["CAUSE"]

#: rad/s, of a small geared servo
USUAL = 4.0


def _speed(reference: Reference, joints: Ints) -> float:
    return USUAL


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.no_load[joints] = np.minimum(robot.no_load[joints], values["no_load_rad_s"])


CAUSE = Cause(
    name="speed_limit",
    family="torque supply",
    words="torque falls with speed",
    scopes=(Scope.SERVO, Scope.ALL),
    quantities=(rate("no_load_rad_s", "rad/s", 0.25, 2.5, _speed),),
    enter=_enter,
    native=True,
)
