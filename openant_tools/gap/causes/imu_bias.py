"""The IMU reads something where nothing is."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.gyro_bias += np.array([values[f"gyro_{axis}"] for axis in "xyz"])
    robot.acc_bias += np.array([values[f"acc_{axis}"] for axis in "xyz"])


CAUSE = Cause(
    name="imu_bias",
    family="sensing",
    words="the IMU reads something at rest",
    scopes=(Scope.BODY,),
    quantities=(
        amount("gyro_x", "rad/s", 0.013, 0.15, signed=True),
        amount("gyro_y", "rad/s", 0.013, 0.15, signed=True),
        amount("gyro_z", "rad/s", 0.013, 0.15, signed=True),
        amount("acc_x", "m/s²", 0.13, 1.5, signed=True),
        amount("acc_y", "m/s²", 0.13, 1.5, signed=True),
        amount("acc_z", "m/s²", 0.13, 1.5, signed=True),
    ),
    enter=_enter,
    native=False,
    together=True,
    shows=lambda reference: reference.imu,
    signal="imu",
)
