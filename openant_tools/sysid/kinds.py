"""The physical quantities that identification knows by name: how each is read from a compiled model and set in it.

Most belong to a joint or its servo. Some belong to the body or the world it stands on (`body`): they are one number whatever
the joints, and move all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.model.body import floor_contacts, link_bodies, scale_mass, torso_body
from openant_tools.model.plant import (
    KD,
    KP,
    LEAST_SHARE,
    LONGEST_DELAY_S,
    MOTOR_CONSTANT,
    RESISTANCE,
    VMAX,
    Plant,
    is_filtered,
    is_motor,
    set_lag,
)

__all__ = [
    "ACTION_DELAY",
    "ACTUATOR_LAG",
    "ELECTRICAL_DAMPING",
    "KINDS",
    "SPEED_LIMIT",
    "Kind",
    "torque_limit",
    "usual_torque",
]

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
        holds: whether a joint can have it at all; default every one.
        body: of the body or the world: one number whatever the joints, which moves all of them.
        alike: of links: those of the same mass are the same part, and share it.
        effect: the effect and its parameter, for what acts between steps because MuJoCo has no feature for it.
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
    holds: Callable[[mujoco.MjModel, Plant, int], bool] = lambda model, plant, j: True
    body: bool = False
    alike: bool = False
    effect: tuple[str, str] | None = None


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


def _read_lag(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    i = int(plant.actuator[j])
    return float(model.actuator_dynprm[i, 0]) if is_filtered(model, i) else 0.0


def _write_lag(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    set_lag(model, int(plant.actuator[j]), value)


def _read_speed_limit(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """Where the servo's whole torque goes into its damping: what a data sheet calls its no-load speed."""
    damping = _read_damping(model, plant, j)
    return torque_limit(model, plant, j) / damping if damping > 0 else math.inf


def _write_speed_limit(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    _write_damping(model, plant, j, torque_limit(model, plant, j) / value)


def _read_link_mass(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    return float(model.body_mass[link_bodies(model, plant, j)].sum())


def _write_link_mass(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    scale_mass(model, link_bodies(model, plant, j), value / _read_link_mass(model, plant, j))


def _read_torso_mass(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    return float(model.body_mass[torso_body(model, plant)])


def _write_torso_mass(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    torso = torso_body(model, plant)
    scale_mass(model, np.array([torso]), value / float(model.body_mass[torso]))


def _contact(field: str, columns: int) -> tuple[Callable[..., float], Callable[..., None]]:
    """Reader and writer of the first number of a contact's field: the greatest of all; all are scaled alike.

    Args:
        field: as after `geom_` and `pair_`.
        columns: how many of a pair's numbers mean the same (its friction has two sliding directions).
    """

    def numbers(model: mujoco.MjModel) -> tuple[Array, Array]:
        contacts = floor_contacts(model)
        # A negative time constant is a stiffness (`solref`): it is none, and stays.
        geoms = np.asarray(getattr(model, f"geom_{field}"))[contacts.geoms, 0]
        pairs = np.asarray(getattr(model, f"pair_{field}"))[contacts.pairs, 0]
        return geoms, pairs

    def read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
        return max(float(part.max(initial=0.0)) for part in numbers(model))

    def write(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
        contacts, factor = floor_contacts(model), value / read(model, plant, j)
        geoms, pairs = numbers(model)
        getattr(model, f"geom_{field}")[contacts.geoms, 0] *= np.where(geoms > 0, factor, 1.0)
        for column in range(columns):
            getattr(model, f"pair_{field}")[contacts.pairs, column] *= np.where(pairs > 0, factor, 1.0)

    return read, write


_read_floor_friction, _write_floor_friction = _contact("friction", 2)
_read_softness, _write_softness = _contact("solref", 1)
_read_impedance, _write_impedance = _contact("solimp", 1)


def usual_torque(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """A torque scale (N·m) for a joint: its limit, or what its stiffness asks for at USUAL_ERROR_RAD where that is less.

    A force range that no error of this servo ever reaches says nothing of its friction.
    """
    return min(torque_limit(model, plant, j), USUAL_ERROR_RAD * _read_stiffness(model, plant, j))


def _carried(model: mujoco.MjModel, plant: Plant) -> bool:
    """Whether the robot's torso is a body of its own, with mass, that its joints do not move."""
    torso = torso_body(model, plant)
    joints = set(model.jnt_bodyid[model.dof_jntid[plant.dof]].tolist())
    return bool(model.body_mass[torso] > 0 and torso not in joints)


ACTION_DELAY = "action_delay"
ACTUATOR_LAG = "actuator_lag"
ELECTRICAL_DAMPING = "electrical_damping"
SPEED_LIMIT = "speed_limit"
#: s; a loop of 50 Hz may act a period late
DELAY_STD_S = 0.02
#: s; a servo that filters its setpoint at all does so within a few periods of its loop, and the platform's MJCF up to 0.6 s
LAG_STD_S, LONGEST_LAG_S = 0.02, 1.0
#: ±0.03 kg of the Open Ant's torso of 0.32 kg are two deviations (effects.md)
TORSO_STD = 0.05
#: share; `solimp` is tuned, not measured: between MuJoCo's default of 0.9 and the platform's 0.7
IMPEDANCE_STD = 0.15
#: What brakes a DC servo beyond its friction is back-EMF, which vanishes with the torque: a share near 1, this uncertain.
ELECTRICAL_STD = 0.3
#: rad; the greatest error that a servo works with, about: gains may be set low, but the friction of its gears stays
USUAL_ERROR_RAD = 1.0
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
            ELECTRICAL_DAMPING,
            "1",
            _read_electrical,
            _write_electrical,
            None,
            lambda limit: ELECTRICAL_STD,
            high=1.0,
            valley=True,
            prior=1.0,
            holds=lambda model, plant, j: is_motor(model, int(plant.actuator[j])),
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
        Kind(ACTION_DELAY, "s", _read_delay, _write_delay, None, lambda limit: DELAY_STD_S, high=LONGEST_DELAY_S),
        Kind(
            "torque_limit",
            "N·m",
            torque_limit,
            _write_torque_limit,
            0.075,
            lambda limit: math.nan,
            low=1e-6,
            holds=lambda model, plant, j: math.isfinite(torque_limit(model, plant, j)),
        ),
        # After the torque limit, whose ratio to the damping it is.
        Kind(
            SPEED_LIMIT,
            "rad/s",
            _read_speed_limit,
            _write_speed_limit,
            0.125,
            lambda limit: math.nan,
            low=1e-6,
            holds=lambda model, plant, j: math.isfinite(_read_speed_limit(model, plant, j)),
        ),
        Kind(
            ACTUATOR_LAG,
            "s",
            _read_lag,
            _write_lag,
            0.3,
            lambda limit: LAG_STD_S,
            high=LONGEST_LAG_S,
            holds=lambda model, plant, j: is_filtered(model, int(plant.actuator[j])),
        ),
        Kind(
            "link_mass",
            "kg",
            _read_link_mass,
            _write_link_mass,
            0.025,
            lambda limit: math.nan,
            low=1e-9,
            constants=True,
            holds=lambda model, plant, j: _read_link_mass(model, plant, j) > 0,
            alike=True,
        ),
        Kind(
            "torso_mass",
            "kg",
            _read_torso_mass,
            _write_torso_mass,
            TORSO_STD,
            lambda limit: math.nan,
            low=1e-9,
            constants=True,
            holds=lambda model, plant, j: _carried(model, plant),
            body=True,
        ),
        Kind(
            "floor_friction",
            "1",
            _read_floor_friction,
            _write_floor_friction,
            0.075,
            lambda limit: math.nan,
            low=1e-6,
            holds=lambda model, plant, j: _read_floor_friction(model, plant, j) > 0,
            body=True,
        ),
        Kind(
            "contact_softness",
            "s",
            _read_softness,
            _write_softness,
            0.15,
            lambda limit: math.nan,
            low=1e-6,
            holds=lambda model, plant, j: _read_softness(model, plant, j) > 0,
            body=True,
        ),
        Kind(
            "contact_impedance",
            "1",
            _read_impedance,
            _write_impedance,
            IMPEDANCE_STD,
            lambda limit: math.nan,
            low=1e-4,
            high=0.9999,
            holds=lambda model, plant, j: _read_impedance(model, plant, j) > 0,
            body=True,
        ),
    )
}


def _nothing(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """A model knows nothing of what acts between its steps."""
    return 0.0


def _write_nothing(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    """What acts between steps is told to the rollout, beside the model (`effect_values`)."""


def _share_of_limit(share: float) -> Callable[[float], float]:
    return lambda limit: share * limit


def _constant(std: float) -> Callable[[float], float]:
    return lambda limit: std


def _effect_kinds() -> Iterator[Kind]:
    """One kind for each parameter of each effect that acts between steps; the chief one bears the effect's own name."""
    for effect in catalogue().values():
        for quantity in effect.quantities:
            yield Kind(
                effect.name if quantity is effect.chief else f"{effect.name}_{quantity.name}",
                quantity.unit,
                _nothing,
                _write_nothing,
                None,
                _share_of_limit(quantity.std) if quantity.unit == "N·m" else _constant(quantity.std),
                low=quantity.low,
                high=quantity.high,
                body=effect.shared,
                effect=(effect.name, quantity.name),
            )


KINDS |= {kind.name: kind for kind in _effect_kinds()}
