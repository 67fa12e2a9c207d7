"""What identification may change in a model, one parameter at a time.

A parameter is a physical quantity of one joint, or of several joints tied together. Internally it is one number u in units
of its prior's standard deviation, 0 at the prior: quantities that the model states (stiffness 18.6 N·m/rad) are scaled,
value = nominal · exp(σ u), so that joints of different size can be tied and runs may bring models of their own gains;
quantities that the model lacks (friction 0) are added, value = nominal + σ u.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.model.plant import (
    KD,
    KP,
    LEAST_SHARE,
    LONGEST_DELAY_S,
    MOTOR_CONSTANT,
    RESISTANCE,
    VMAX,
    Plant,
    is_motor,
)

__all__ = ["ACTION_DELAY", "KINDS", "Kind", "Parameter", "apply", "buffered", "choose", "delays"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Kind:
    """A physical quantity that a joint or its servo has.

    Attributes:
        name: as in fit.json, `name.JOINT`.
        unit: SI.
        read: its value in a compiled model, for the joint at an index of the plant.
        write: sets that value in a model of the same layout.
        relative_std: the prior's standard deviation of log(value), where the model states a value. Half the tolerance
            within which robots of one build differ (effects.md), because a tolerance is taken as two deviations.
        absolute_std: the prior's standard deviation where the model has none, from the joint's torque limit in N·m.
        low, high: hard physical bounds of the value.
        constants: whether a change alters constants that MuJoCo derives from the model (mj_setConst).
        valley: whether the cost has a valley at each end of its range, so that a fit must start from both.
        prior: the value that physics suggests, where that is not what the given model says.
    """

    name: str
    unit: str
    read: Callable[[mujoco.MjModel, Plant, int], float]
    write: Callable[[mujoco.MjModel, Plant, int, float], None]
    relative_std: float | None
    absolute_std: Callable[[float], float]
    low: float = 0.0
    high: float = math.inf
    constants: bool = False
    valley: bool = False
    prior: float | None = None


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


def _read_stiffness(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    return float(motor[KP]) if motor is not None else -float(model.actuator_biasprm[plant.actuator[j], 1])


def _write_stiffness(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    i, motor = plant.actuator[j], _motor(model, plant, j)
    if motor is not None:
        motor[KP] = value
        return
    if model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED:
        model.actuator_gainprm[i, 0] *= value / -model.actuator_biasprm[i, 1]
    model.actuator_biasprm[i, 1] = -value


def _read_velocity_gain(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    if motor is not None:
        return float(motor[KD]) - _back_emf(motor)
    return -float(model.actuator_biasprm[plant.actuator[j], 2])


def _write_velocity_gain(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    motor = _motor(model, plant, j)
    if motor is not None:
        motor[KD] = value + _back_emf(motor)
    else:
        model.actuator_biasprm[plant.actuator[j], 2] = -value


def _read_damping(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    return float(model.dof_damping[plant.dof[j]]) + (0.0 if motor is None else _back_emf(motor))


def _write_damping(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    motor, share = _motor(model, plant, j), _read_electrical(model, plant, j)
    model.dof_damping[plant.dof[j]] = (1 - share) * value
    if motor is not None:
        _set_back_emf(motor, share * value)


def _read_electrical(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    motor = _motor(model, plant, j)
    return 0.0 if motor is None else _back_emf(motor) / _read_damping(model, plant, j)


def _write_electrical(model: mujoco.MjModel, plant: Plant, j: int, share: float) -> None:
    motor, total = _motor(model, plant, j), _read_damping(model, plant, j)
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


def _read_zero(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    return float(model.qpos0[plant.qpos[j]])


def _write_zero(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    # The stops stay where they are in space, so their readings move with the zero.
    adr, joint = plant.qpos[j], int(model.dof_jntid[plant.dof[j]])
    model.jnt_range[joint] += value - model.qpos0[adr]
    model.qpos_spring[adr] += value - model.qpos0[adr]
    model.qpos0[adr] = value


def torque_limit(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """The most torque (N·m) that the joint's servo gives at standstill, infinite where the model sets none."""
    i, motor = plant.actuator[j], _motor(model, plant, j)
    if motor is not None:
        return float(motor[MOTOR_CONSTANT] * motor[VMAX] / motor[RESISTANCE])
    return float(model.actuator_forcerange[i, 1]) if model.actuator_forcelimited[i] else math.inf


def _write_torque_limit(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    motor = _motor(model, plant, j)
    if motor is not None:
        motor[VMAX] = value * motor[RESISTANCE] / motor[MOTOR_CONSTANT]
    else:
        model.actuator_forcerange[plant.actuator[j]] = (-value, value)


def _read_delay(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    return float(model.actuator_delay[plant.actuator[j]])


def _write_delay(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    """Nothing in the model: a rollout takes delays beside it (`delays`), a written model in its buffers (`buffered`)."""


ACTION_DELAY = "action_delay"
#: s; a loop of 50 Hz may act a period late
DELAY_STD_S = 0.02
#: What brakes a DC servo beyond its friction is back-EMF, which vanishes with the torque: a share near 1, this uncertain.
ELECTRICAL_STD = 0.3
#: Friction of a small geared servo is of the order of a tenth of its stall torque; a model that has none says nothing
#: about it, so its prior is that wide.
FRICTION_SHARE = 0.1
#: Rotor inertia behind a gear of a servo of 1 N·m stall torque, order of magnitude (kg·m²).
ARMATURE_PER_NM = 0.005
#: Back-EMF slope of such a servo, N·m·s/rad per N·m of stall torque (about 1 / no-load speed).
DAMPING_PER_NM = 0.2

KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("stiffness", "N·m/rad", _read_stiffness, _write_stiffness, 0.075, lambda limit: math.nan, low=1e-6),
        Kind(
            "velocity_gain",
            "N·m·s/rad",
            _read_velocity_gain,
            _write_velocity_gain,
            0.125,
            lambda limit: DAMPING_PER_NM * limit,
        ),
        Kind(
            "damping",
            "N·m·s/rad",
            _read_damping,
            _write_damping,
            0.125,
            lambda limit: DAMPING_PER_NM * limit,
        ),
        Kind(
            "armature",
            "kg·m²",
            _read_dof("dof_armature"),
            _write_dof("dof_armature"),
            0.15,
            lambda limit: ARMATURE_PER_NM * limit,
            constants=True,
        ),
        Kind(
            "coulomb_friction",
            "N·m",
            _read_dof("dof_frictionloss"),
            _write_dof("dof_frictionloss"),
            None,
            lambda limit: FRICTION_SHARE * limit,
        ),
        # After damping, whose share it is.
        Kind(
            "electrical_damping",
            "1",
            _read_electrical,
            _write_electrical,
            None,
            lambda limit: ELECTRICAL_STD,
            high=1.0,
            valley=True,
            prior=1.0,
        ),
        Kind(
            "zero_offset",
            "rad",
            _read_zero,
            _write_zero,
            None,
            lambda limit: math.radians(0.5),
            low=-math.pi,
            high=math.pi,
            constants=True,
        ),
        Kind("action_delay", "s", _read_delay, _write_delay, None, lambda limit: DELAY_STD_S, high=LONGEST_DELAY_S),
        Kind("torque_limit", "N·m", torque_limit, _write_torque_limit, 0.075, lambda limit: math.nan, low=1e-6),
    )
}


@dataclass(frozen=True)
class Parameter:
    """One unknown of a fit: a kind of quantity for one joint, or for several joints that share it.

    Attributes:
        kind: a key of KINDS.
        label: the joint, the servo model, or `all`.
        joints: indices into the plant's joints.
        relative: whether u scales the model's value (else it is added).
        std: the prior's standard deviation, of log(value) if relative, else in the kind's unit.
    """

    kind: str
    label: str
    joints: tuple[int, ...]
    relative: bool
    std: float

    @property
    def name(self) -> str:
        return f"{self.kind}.{self.label}"

    def value(self, nominal: float, u: float) -> float:
        """The physical value that the internal number u stands for, given the model's own."""
        return nominal * math.exp(self.std * u) if self.relative else nominal + self.std * u

    def bounds(self, nominal: float) -> tuple[float, float]:
        """The internal numbers between which the value stays physical."""
        kind = KINDS[self.kind]
        if self.relative:
            return -math.inf, math.inf
        return (kind.low - nominal) / self.std, (kind.high - nominal) / self.std

    @property
    def centre(self) -> float:
        """Where the prior has its middle: 0, the given model's value, unless physics knows better."""
        prior = KINDS[self.kind].prior
        return 0.0 if prior is None else prior / self.std


def apply(plant: Plant, parameters: Sequence[Parameter], u: Array) -> mujoco.MjModel:
    """A copy of the plant's model with every parameter at its u."""
    model = copy.copy(plant.model)
    constants = False
    for parameter, value in zip(parameters, u, strict=True):
        kind = KINDS[parameter.kind]
        for j in parameter.joints:
            nominal = kind.read(plant.model, plant, j)
            kind.write(model, plant, j, parameter.value(nominal, float(value)))
        constants |= kind.constants
    if constants:
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def delays(plant: Plant, parameters: Sequence[Parameter], u: Array) -> Array:
    """(joints,) s by which the parameters at u let commands act later than the given model does."""
    out = np.zeros(len(plant.joints))
    for parameter, value in zip(parameters, u, strict=True):
        if parameter.kind == ACTION_DELAY:
            out[list(parameter.joints)] = parameter.std * value
    # A microsecond moves nothing; shifting commands by it would cost as much as by a millisecond.
    return np.where(np.abs(out) > 1e-6, out, 0.0)


def buffered(plant: Plant, model: mujoco.MjModel, late: Array) -> None:
    """Put delays (joints,) into the buffers of a model loaded with `delayed=True`.

    The newest command in a buffer is one step old, so that MuJoCo makes a whole step of any delay between none and one.
    """
    for j, delay in enumerate(late):
        total = float(plant.model.actuator_delay[plant.actuator[j]]) + float(delay)
        model.actuator_delay[plant.actuator[j]] = total if total > plant.timestep / 2 else 0.0


def choose(
    plant: Plant, kinds: Sequence[str], tie: str = "joint", motors: dict[str, str] | None = None
) -> list[Parameter]:
    """The parameters of these kinds, one a joint, one a servo model (`tie="servo"`), or one for all (`tie="all"`).

    Kinds that a model cannot have are left out: a torque limit where the actuator has none.
    """
    groups: dict[str, list[int]] = {}
    for j, joint in enumerate(plant.joints):
        label = {"joint": joint, "servo": (motors or {}).get(joint, "all"), "all": "all"}[tie]
        groups.setdefault(label, []).append(j)
    chosen = []
    for name in kinds:
        kind = KINDS[name]
        for label, joints in groups.items():
            nominals = [kind.read(plant.model, plant, j) for j in joints]
            limits = [torque_limit(plant.model, plant, j) for j in joints]
            if name == "torque_limit" and not np.isfinite(limits).all():
                continue
            if name == "electrical_damping" and not all(is_motor(plant.model, int(plant.actuator[j])) for j in joints):
                continue
            limit = float(
                np.mean(
                    [
                        value if math.isfinite(value) else _usual_torque(plant, j)
                        for j, value in zip(joints, limits, strict=True)
                    ]
                )
            )
            relative = kind.relative_std is not None and all(value > 0 for value in nominals)
            std = kind.relative_std if relative and kind.relative_std is not None else kind.absolute_std(limit)
            chosen.append(Parameter(name, label, tuple(joints), relative, std))
    return chosen


def _usual_torque(plant: Plant, j: int) -> float:
    """A torque scale (N·m) for a joint without a limit: what its stiffness gives at a tenth of a radian of error."""
    return 0.1 * _read_stiffness(plant.model, plant, j)
