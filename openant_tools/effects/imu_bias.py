"""The IMU reads something where nothing is."""

from __future__ import annotations

import math

import numpy as np

from openant_tools.effects.effect import Action, Effect, Ints, Parameter, Scope, Values, amount
from openant_tools.effects.robot import Robot

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.gyro_bias += np.array([values[f"gyro_{axis}"] for axis in "xyz"])
    robot.acc_bias += np.array([values[f"acc_{axis}"] for axis in "xyz"])


effect = Effect(
    name="imu_bias",
    family="sensing",
    words="the IMU reads something at rest",
    scopes=(Scope.BODY,),
    quantities=(
        amount("gyro_x", "rad/s", 0.013, 0.15, signed=True, tolerance=0.01),
        amount("gyro_y", "rad/s", 0.013, 0.15, signed=True, tolerance=0.01),
        amount("gyro_z", "rad/s", 0.013, 0.15, signed=True, tolerance=0.01),
        amount("acc_x", "m/s²", 0.13, 1.5, signed=True, tolerance=0.1),
        amount("acc_y", "m/s²", 0.13, 1.5, signed=True, tolerance=0.1),
        amount("acc_z", "m/s²", 0.13, 1.5, signed=True, tolerance=0.1),
    ),
    enter=_enter,
    native=False,
    # Three numbers each (effects.md), or axis by axis as diagnoses write them.
    parameters=(
        Parameter("rad_s", "rad/s", low=-math.inf),
        Parameter("m_s2", "m/s²", low=-math.inf),
        *(Parameter(f"gyro_{axis}", "rad/s", low=-math.inf) for axis in "xyz"),
        *(Parameter(f"acc_{axis}", "m/s²", low=-math.inf) for axis in "xyz"),
    ),
    acts_on="sensors",
    vector=True,
    shows=lambda reference: reference.imu,
    signal="imu",
    told_from={
        "floor_tilt": Action(
            "turn the robot", "at rest, in two headings: a tilt turns in the body's frame, a bias does not"
        ),
        "imu_misalignment": Action("turn it over", "at rest on each side: a bias stays, a turned sensor follows"),
    },
)
