"""What of a model a re-fit may move within tolerance: of each joint, of floor and body, and of an IMU."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from openant_tools.effects.robot import Robot
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.tolerance import FACTORS, FLOOR, STAMP_S, tolerance_of, torso_kg

__all__ = [
    "AMOUNTS", "BODY", "BRISTLE", "BRISTLE_RAD", "HEAT_LOSS", "LESS", "ONE_SIDED", "TILTS", "UNWRITTEN", "Nuisance", "adjust", "nuisances",
]  # fmt: skip

#: what tilts a floor along its x and y, rad
TILTS = ("tilt_x", "tilt_y")
#: what is added where it moves, and its unit; all else is a factor
AMOUNTS = {"coulomb_friction": "N·m", "zero_offset": "rad", "delay": "s", "torso_kg": "kg"} | dict.fromkeys(
    TILTS, "rad"
)
#: what a warm motor loses, and °C between runs from which it is asked how much; what of a servo is less by it
HEAT_LOSS, WARMED_C, LESS = "heat_loss", 2.0, ("stiffness", "torque_limit")
#: whose calibration it is that belongs to no joint
BODY = "body"
#: what an IMU may read at rest, and how it may sit, about its three axes; and how late it may be
IMU_AXES, IMU_LATE = ("gyro_bias", "acc_bias", "imu_rotation"), "imu_delay"
#: what part of all servos' damping may be back-EMF, up to the tolerance of the effect of this name
BACK_EMF = "electrical_damping"
#: what lies between none and twice its tolerance
ONE_SIDED = {HEAT_LOSS, IMU_LATE, BACK_EMF}
#: how far dry friction gives before it slides, rad, and what this may be times as much or as little, where it gives at all: of the form
#: of a simulation, which no model says
BRISTLE, BRISTLE_RAD, BRISTLE_TIMES = "bristle", 5e-4, 3.0
#: when torque goes or comes, of what rows leave open: none says when exactly
SWITCHING = "switching"
#: what no model of a robot within tolerance is written with: servos of another kind would hold it, or it is of the log
UNWRITTEN = {BACK_EMF, BRISTLE, SWITCHING}


@dataclass(frozen=True)
class Nuisance:
    """What may move within tolerance; of the body and the floor where it has no joints."""

    name: str
    joints: tuple[int, ...]
    tolerance: float

    @property
    def of_imu(self) -> bool:
        """Whether it moves nothing."""
        return self.name == IMU_LATE or self.name[:-2] in IMU_AXES

    def value(self, u: float) -> float:
        """The factor, or what is added (N·m, rad, s, kg), at so many tolerances; 1/°C of what is lost to heat."""
        if self.name in ONE_SIDED:
            return self.tolerance * (1 + u)
        relative = self.name in FACTORS or self.name in FLOOR or self.name == BRISTLE
        return float(np.exp(u * self.tolerance)) if relative else float(u * self.tolerance)


def adjust(robot: Robot, kind: str, joints: Sequence[int], value: float) -> None:
    """Move a robot within tolerance, by a value of `calibration_of`.

    Args:
        joints: none for what belongs to the body or the floor.

    Raises:
        KeyError: no such kind.
    """
    at = list(joints)
    if kind in FACTORS:
        robot.factor(kind)[at] *= value
    elif kind == "coulomb_friction":
        robot.more(kind)[at] += value
    elif kind == "zero_offset":
        robot.zero[at] += value
    elif kind == "delay":
        robot.delay[at] += value
    elif kind == SWITCHING:
        robot.switching += value
    elif kind in FLOOR:
        setattr(robot, kind, getattr(robot, kind) * value)
    elif kind == "torso_kg":
        robot.torso_kg += value
    elif kind == BACK_EMF:
        robot.electrical[at] = np.maximum(robot.electrical[at], value)
    elif kind in TILTS:
        robot.tilt = robot.tilt + value * np.eye(2)[TILTS.index(kind)]
    elif kind == IMU_LATE:
        robot.log_delay["imu"] = robot.log_delay.get("imu", 0.0) + value
    elif kind[:-2] in IMU_AXES:
        getattr(robot, kind[:-2])["xyz".index(kind[-1])] += value
    else:
        raise KeyError(kind)


def nuisances(protocol: RunSet, sensed: Collection[str]) -> list[Nuisance]:
    """What may move within tolerance: of each joint, of floor and body, and of an IMU."""
    out = []
    joints = range(len(protocol.joints))
    for kind in ("stiffness", "damping", "torque_limit", "armature", "link_mass"):
        if kind != "torque_limit" or np.isfinite(protocol.reference.limit).all():
            out += [Nuisance(kind, (j,), FACTORS[kind]) for j in joints]
    out += [
        Nuisance(
            "coulomb_friction",
            (j,),
            tolerance_of("coulomb_friction") * min(1.0, float(protocol.reference.torque[j]) / 0.2),
        )
        for j in joints
    ]
    out += [Nuisance("zero_offset", (j,), tolerance_of("zero_offset")) for j in joints]
    # Rows that are stamped early or late look like commands that act late or early.
    out.append(Nuisance("delay", tuple(joints), tolerance_of("action_delay") + STAMP_S))
    out.append(Nuisance(BACK_EMF, tuple(joints), tolerance_of(BACK_EMF) / 2))
    out.append(Nuisance(BRISTLE, tuple(joints), math.log(BRISTLE_TIMES)))
    if any(one.switches for one in protocol.runs):
        out.append(Nuisance(SWITCHING, tuple(joints), 1.0))
    if protocol.warmed_c > WARMED_C:
        out.append(Nuisance(HEAT_LOSS, tuple(joints), tolerance_of("thermal_derating")))
    if protocol.reference.floor:
        out += [Nuisance(kind, (), tolerance) for kind, tolerance in FLOOR.items()]
        out.append(Nuisance("torso_kg", (), torso_kg(protocol.reference)))
        out += [Nuisance(kind, (), tolerance_of("floor_tilt") / np.sqrt(2)) for kind in TILTS]
    if {"gyro", "acc"} & set(sensed):
        within = (
            tolerance_of("imu_bias", "gyro_x"),
            tolerance_of("imu_bias", "acc_x"),
            tolerance_of("imu_misalignment"),
        )
        out += [Nuisance(f"{kind}_{x}", (), one) for kind, one in zip(IMU_AXES, within, strict=True) for x in "xyz"]
        out.append(Nuisance(IMU_LATE, (), tolerance_of("sensor_delay", "imu") / 2))
    return out
