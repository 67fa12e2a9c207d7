"""A joint's zero is off."""

from __future__ import annotations

import math

import mujoco

from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.plant import Plant

__all__ = ["effect", "read_zero", "write_zero"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.zero[joints] += values["angle_rad"]


def read_zero(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """What joint j's encoder reads in the pose that the model is drawn in, rad."""
    return float(model.qpos0[plant.qpos[j]])


def write_zero(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    """Move joint j's zero; the stops stay where they are in space, so their readings move with it."""
    adr, joint = plant.qpos[j], int(model.dof_jntid[plant.dof[j]])
    model.jnt_range[joint] += value - model.qpos0[adr]
    model.qpos_spring[adr] += value - model.qpos0[adr]
    model.qpos0[adr] = value


_angle = amount("angle_rad", "rad", 0.012, 0.16, signed=True, tolerance=math.radians(0.5))
effect = Effect(
    name="zero_offset",
    family="geometry",
    words="a joint's zero is off",
    scopes=(Scope.JOINT,),
    quantities=(_angle,),
    enter=_enter,
    native=True,
    kinds=(
        Kind(
            "zero_offset",
            "rad",
            read_zero,
            write_zero,
            None,
            lambda limit: _angle.tolerance,
            low=-math.pi,
            high=math.pi,
            constants=True,
            shown_by="`long-holds`; a joint with a vertical axis shows its zero only with the robot tilted",
        ),
    ),
    silent=True,
)
