"""The floor is not level."""

from __future__ import annotations

import math

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.tilt += np.array([values["downhill_x"], values["downhill_y"]])


CAUSE = Cause(
    name="floor_tilt",
    family="environment",
    words="the floor is not level",
    scopes=(Scope.BODY,),
    quantities=(
        amount("downhill_x", "rad", 0.014, 0.16, signed=True),
        amount("downhill_y", "rad", 0.014, 0.16, signed=True),
    ),
    enter=_enter,
    native=True,
    together=True,
    shows=lambda reference: reference.floor,
    stated=lambda values, reference, joints: {
        "angle_rad": math.hypot(values["downhill_x"], values["downhill_y"]),
        "direction": math.atan2(values["downhill_y"], values["downhill_x"]),
    },
    restored=lambda given, x, reference, joints: {
        "downhill_x": given["angle_rad"] * math.cos(given["direction"]),
        "downhill_y": given["angle_rad"] * math.sin(given["direction"]),
    },
)
