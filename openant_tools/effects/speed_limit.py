"""The torque that a servo can give falls with its speed."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.effect import Effect, Ints, Scope, Values, rate
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Reference, Robot
from openant_tools.effects.servo_form import servo
from openant_tools.effects.step import TINY, Law, Step
from openant_tools.model.plant import Plant
from openant_tools.model.servo import read_damping, torque_limit, write_damping

__all__ = ["effect", "fading"]


def _speed(reference: Reference, joints: Ints) -> float:
    """rad/s, of a small geared servo."""
    return 4.0


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.no_load[joints] = np.minimum(robot.no_load[joints], values["no_load_rad_s"])


def fading(no_load: NDArray[np.float64]) -> Law:
    """The law, for (robots, joints) rad/s, inf for none."""

    def act(step: Step) -> None:
        along = step.motor_torque * step.velocity > 0
        left = np.clip(1 - np.abs(step.velocity) / no_load, TINY, 1.0)
        step.limit = step.limit * np.where(along, left, 1.0)

    return act


def _read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """Where the servo's whole torque goes into its damping: what a data sheet calls its no-load speed."""
    damping = read_damping(model, plant, j)
    return torque_limit(model, plant, j) / damping if damping > 0 else math.inf


def _set(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    write_damping(model, plant, j, torque_limit(model, plant, j) / value)


effect = Effect(
    name="speed_limit",
    family="torque supply",
    words="torque falls with speed",
    scopes=(Scope.SERVO, Scope.ALL),
    quantities=(rate("no_load_rad_s", "rad/s", 0.25, 2.5, _speed),),
    enter=_enter,
    native=True,
    writer=servo,
    # As well known as the damping, whose ratio to the torque limit it is.
    kinds=(
        Kind(
            "speed_limit",
            "rad/s",
            _read,
            _set,
            0.125,
            low=1e-6,
            holds=lambda model, plant, j: math.isfinite(_read(model, plant, j)),
            shown_by="`saturating-steps`",
        ),
    ),
)
