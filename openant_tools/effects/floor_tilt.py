"""The floor is not level."""

from __future__ import annotations

import math

import numpy as np

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Robot, tilted
from openant_tools.model.mjcf import numbers

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.tilt += np.array([values["downhill_x"], values["downhill_y"]])


def _write(document: Document) -> None:
    tilt = document.robot.tilt
    if tilt.any():
        document.last("option").set("gravity", numbers(tilted(document.plant.model.opt.gravity, tilt)))


effect = Effect(
    name="floor_tilt",
    family="environment",
    words="the floor is not level",
    scopes=(Scope.BODY,),
    quantities=(
        amount("downhill_x", "rad", 0.014, 0.16, signed=True, tolerance=math.radians(0.5)),
        amount("downhill_y", "rad", 0.014, 0.16, signed=True, tolerance=math.radians(0.5)),
    ),
    enter=_enter,
    native=True,
    writer=Writer(75, body=_write),
    vector=True,
    shows=lambda reference: reference.floor,
    stated=lambda values, reference, joints: {
        "angle_rad": math.hypot(values["downhill_x"], values["downhill_y"]),
        "direction": math.atan2(values["downhill_y"], values["downhill_x"]),
    },
    restored=lambda given, x, reference, joints: {
        "downhill_x": given["angle_rad"] * math.cos(given["direction"]),
        "downhill_y": given["angle_rad"] * math.sin(given["direction"]),
    },
    told_from={
        "cable_drag": Action(
            "turn the robot",
            "record `shifts`, which plays in two headings, and unplug the cable or hold it up for one of them",
        )
    },
)
