"""Damping is back-EMF, which vanishes with the torque."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]

#: share; what is left in the joint keeps a step stable
MOST = 0.98


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.electrical[joints] = np.minimum(np.maximum(robot.electrical[joints], values["share"]), MOST)


CAUSE = Cause(
    name="electrical_damping",
    family="gain",
    words="damping is back-EMF and goes with the torque",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("share", "1", 0.2, 0.97),),
    enter=_enter,
    native=True,
)
