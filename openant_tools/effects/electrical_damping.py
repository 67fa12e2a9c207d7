"""Damping is back-EMF, which vanishes with the torque."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.effects.servo_form import servo
from openant_tools.effects.step import Law, Step
from openant_tools.model.plant import is_motor
from openant_tools.model.servo import read_electrical, write_electrical

__all__ = ["braking", "effect", "generating"]

Array = NDArray[np.float64]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    # What is left in the joint keeps a step stable.
    robot.electrical[joints] = np.minimum(np.maximum(robot.electrical[joints], values["share"]), 0.98)


def generating(slope: Array) -> Law:
    """What follows from a motor's torque follows from what its back-EMF leaves."""

    def act(step: Step) -> None:
        step.back_emf = step.back_emf + slope

    return act


def braking(slope: Array) -> Law:
    """Models of many robots at once have no back-EMF to be changed: it acts as a torque beside the servo's."""

    def act(step: Step) -> None:
        step.back_emf = step.back_emf - slope
        step.torque -= np.where(step.on, slope * step.velocity, 0.0)

    return act


effect = Effect(
    name="electrical_damping",
    family="gain",
    words="damping is back-EMF and goes with the torque",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    # Up to the tolerance of what a model calls damping may be back-EMF on any robot.
    quantities=(amount("share", "1", 0.2, 0.97, tolerance=0.15),),
    enter=_enter,
    native=True,
    writer=servo,
    kinds=(
        # What brakes a DC servo beyond its friction is back-EMF, which vanishes with the torque: a share near 1, this uncertain.
        Kind(
            "electrical_damping",
            "1",
            read_electrical,
            write_electrical,
            None,
            lambda limit: 0.3,
            high=1.0,
            valley=True,
            prior=1.0,
            holds=lambda model, plant, j: is_motor(model, int(plant.actuator[j])),
            shown_by="`releases` and `drops`",
        ),
    ),
)
