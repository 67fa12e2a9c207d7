"""The IMU is turned against the body."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.imu_rotation += np.array([values["x_rad"], values["y_rad"], values["z_rad"]])


CAUSE = Cause(
    name="imu_misalignment",
    family="sensing",
    words="the IMU is turned against the body",
    scopes=(Scope.BODY,),
    quantities=(
        amount("x_rad", "rad", 0.022, 0.3, signed=True),
        amount("y_rad", "rad", 0.022, 0.3, signed=True),
        amount("z_rad", "rad", 0.022, 0.3, signed=True),
    ),
    enter=_enter,
    native=True,
    together=True,
    shows=lambda reference: reference.imu,
    signal="imu",
)
