"""The IMU is turned against the body."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Robot
from openant_tools.model.mjcf import numbers

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.imu_rotation += np.array([values["x_rad"], values["y_rad"], values["z_rad"]])


def _write(document: Document) -> None:
    turned = document.robot.imu_rotation
    for name in dict.fromkeys(str(sensor.get("site")) for sensor in document.inertial()) if turned.any() else ():
        site = next(e for e in document.root.iter("site") if e.get("name") == name)
        quat, turn = np.zeros(4), np.zeros(4)
        angle = float(np.linalg.norm(turned))
        mujoco.mju_axisAngle2Quat(turn, turned / angle, angle)
        mujoco.mju_mulQuat(quat, turn, document.plant.model.site(name).quat)
        for other in ("euler", "axisangle", "xyaxes", "zaxis"):
            site.attrib.pop(other, "")
        site.set("quat", numbers(quat))


effect = Effect(
    name="imu_misalignment",
    family="sensing",
    words="the IMU is turned against the body",
    scopes=(Scope.BODY,),
    quantities=(
        amount("x_rad", "rad", 0.022, 0.3, signed=True, tolerance=math.radians(1.0)),
        amount("y_rad", "rad", 0.022, 0.3, signed=True, tolerance=math.radians(1.0)),
        amount("z_rad", "rad", 0.022, 0.3, signed=True, tolerance=math.radians(1.0)),
    ),
    enter=_enter,
    native=True,
    writer=Writer(95, body=_write),
    vector=True,
    shows=lambda reference: reference.imu,
    signal="imu",
    told_from={
        "floor_tilt": Action(
            "turn the robot", "at rest, in two headings: a tilt turns in the body's frame, an IMU does not"
        )
    },
)
