"""The servo gives less (or more) torque than the model lets it."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, factor
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.weaken("torque_limit", joints, values["limit"])


CAUSE = Cause(
    name="torque_limit",
    family="torque supply",
    words="the servo gives less torque than the model lets it",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(factor("limit", 0.18, 1.3),),
    enter=_enter,
    native=True,
    shows=lambda reference: bool(np.isfinite(reference.limit).any()),
)
