"""The numbers of a servo and its joint in a compiled model: read, and set in a model of the same layout."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.model.plant import KD, KP, LEAST_SHARE, MOTOR_CONSTANT, RESISTANCE, VMAX, Plant, is_motor

__all__ = [
    "hold_still",
    "read_armature",
    "read_damping",
    "read_electrical",
    "read_friction",
    "read_stiffness",
    "read_velocity_gain",
    "torque_limit",
    "usual_torque",
    "write_armature",
    "write_damping",
    "write_electrical",
    "write_friction",
    "write_stiffness",
    "write_torque_limit",
    "write_velocity_gain",
]

Array = NDArray[np.float64]

#: rad; the greatest error that a servo works with, about: gains may be set low, but the friction of its gears stays
USUAL_ERROR_RAD = 1.0
#: least and largest impedance of dry friction: as MuJoCo has it by default, where a joint that should stick creeps (at its least d and
#: solref 0.02 s by a (1 − d)/d / (2/(0.95 · 0.02 s)) = a/950 rad/s, of the acceleration a that it would have), and so stiff that it does not
GIVES_WAY, HOLDS = (0.9, 0.95), (0.999, 0.999)

# A servo is either affine (`position`, `general`, `pid`: τ = clip(kp e − kv ω, ±L)) or a DC motor of resistance 1 Ω
# (plant.motor_form): duty clip(kp e − kv ω, ±L) with back-EMF K² ω beyond it, derivative gain K² + kv, Vmax = L / K.


def _motor(model: mujoco.MjModel, plant: Plant, j: int) -> NDArray[np.float64] | None:
    """The parameters of joint j's DC motor, to read and write; None where its servo is affine."""
    i = int(plant.actuator[j])
    return np.asarray(model.actuator_gainprm[i]) if is_motor(model, i) else None


def _back_emf(motor: Array) -> float:
    return float(motor[MOTOR_CONSTANT] ** 2 / motor[RESISTANCE])


def _set_back_emf(motor: Array, slope: float) -> None:
    """Change a motor's back-EMF slope (N·m·s/rad) and keep its gains and torque limit."""
    limit = motor[MOTOR_CONSTANT] * motor[VMAX]
    motor[KD] += slope * motor[RESISTANCE] - _back_emf(motor)
    motor[MOTOR_CONSTANT] = math.sqrt(slope * motor[RESISTANCE])
    motor[VMAX] = limit / motor[MOTOR_CONSTANT]


def read_stiffness(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    return float(motor[KP]) if motor is not None else -float(model.actuator_biasprm[plant.actuator[j], 1])


def write_stiffness(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    i, motor = plant.actuator[j], _motor(model, plant, j)
    if motor is not None:
        motor[KP] = value
        return
    if model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED:
        model.actuator_gainprm[i, 0] *= value / -model.actuator_biasprm[i, 1]
    model.actuator_biasprm[i, 1] = -value


def read_velocity_gain(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    if motor is not None:
        return float(motor[KD]) - _back_emf(motor)
    return -float(model.actuator_biasprm[plant.actuator[j], 2])


def write_velocity_gain(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    motor = _motor(model, plant, j)
    if motor is not None:
        motor[KD] = value + _back_emf(motor)
    else:
        model.actuator_biasprm[plant.actuator[j], 2] = -value


def read_damping(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    return float(model.dof_damping[plant.dof[j]]) + (0.0 if motor is None else _back_emf(motor))


def write_damping(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    motor, share = _motor(model, plant, j), read_electrical(model, plant, j)
    model.dof_damping[plant.dof[j]] = (1 - share) * value
    if motor is not None:
        _set_back_emf(motor, share * value)


def read_electrical(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    return 0.0 if motor is None else _back_emf(motor) / read_damping(model, plant, j)


def write_electrical(model: mujoco.MjModel, plant: Plant, j: int, share: float) -> None:
    motor, total = _motor(model, plant, j), read_damping(model, plant, j)
    if motor is None:
        return  # a servo that has no motor form keeps its damping where it is
    share = max(share, LEAST_SHARE)
    model.dof_damping[plant.dof[j]] = (1 - share) * total
    _set_back_emf(motor, share * total)


def _read_dof(field: str) -> Callable[[mujoco.MjModel, Plant, int], float]:
    def read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
        return float(getattr(model, field)[plant.dof[j]])

    return read


def _write_dof(field: str) -> Callable[[mujoco.MjModel, Plant, int, float], None]:
    def write(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
        getattr(model, field)[plant.dof[j]] = value

    return write


def torque_limit(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """The most torque (N·m) that the joint's servo gives at standstill, infinite where the model sets none."""
    i, motor = plant.actuator[j], _motor(model, plant, j)
    if motor is not None:
        return float(motor[MOTOR_CONSTANT] * motor[VMAX] / motor[RESISTANCE])
    return float(model.actuator_forcerange[i, 1]) if model.actuator_forcelimited[i] else math.inf


def write_torque_limit(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    motor = _motor(model, plant, j)
    if motor is not None:
        motor[VMAX] = value * motor[RESISTANCE] / motor[MOTOR_CONSTANT]
    else:
        model.actuator_forcerange[plant.actuator[j]] = (-value, value)


def hold_still(model: mujoco.MjModel, plant: Plant) -> None:
    """Let joints that dry friction holds stay where they are, unless the model says itself how far they give way."""
    given = plant.dof[(model.dof_solimp[plant.dof, :2] == GIVES_WAY).all(axis=1)]
    model.dof_solimp[given, :2] = HOLDS


def usual_torque(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """A torque scale (N·m) for a joint: its limit, or what its stiffness asks for at USUAL_ERROR_RAD where that is less.

    A force range that no error of this servo ever reaches says nothing of its friction.
    """
    return min(torque_limit(model, plant, j), USUAL_ERROR_RAD * read_stiffness(model, plant, j))


read_armature, write_armature = _read_dof("dof_armature"), _write_dof("dof_armature")
read_friction, write_friction = _read_dof("dof_frictionloss"), _write_dof("dof_frictionloss")
