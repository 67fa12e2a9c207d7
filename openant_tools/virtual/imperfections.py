"""What `[[effect]]` entries of a scenario do to this robot: the catalogue's names, given effect by our own physics.

Names, parameters and scopes are the catalogue's (effects.md); how each acts is written here and in `drives`, `motor`
and `body`, independently of the analysis that is to find it. Values are absolute where the catalogue names a quantity
(a friction torque, an armature) and relative where it names a scale.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from openant_tools.errors import BadInput
from openant_tools.virtual.body import Payload, Tether
from openant_tools.virtual.camera_scene import OverheadCameraSettings
from openant_tools.virtual.motor import MotorSettings
from openant_tools.virtual.world import WorldSettings

__all__ = ["CATALOGUE", "ScenarioEffect", "apply_entry", "nearest"]


@dataclass(frozen=True)
class ScenarioEffect:
    """One `[[effect]]` of a scenario: name, joints (or "all", "body"), parameters in SI units."""

    effect: str
    joints: tuple[str, ...] | str
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Effect:
    """One name of the catalogue: its parameters with their defaults (None: required), and what it does.

    `motor` changes one servo's settings; `world` changes what is shared, given the joints in scope.
    """

    parameters: Mapping[str, Any]
    motor: Callable[..., None] | None = None
    world: Callable[..., None] | None = None


def nearest(name: str, known: Iterable[str]) -> str:
    """A remedy for a name that is not known: the nearest one, or the list."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"known are {', '.join(sorted(known))}"


# ---- joints ----


def _action_delay(m: MotorSettings, delay_s: float) -> None:
    m.action_delay_s += delay_s


def _actuator_lag(m: MotorSettings, time_constant_s: float) -> None:
    m.lag_s = time_constant_s


def _slew_limit(m: MotorSettings, rate_rad_s: float) -> None:
    m.slew_rad_s = rate_rad_s


def _sensor_delay(m: MotorSettings, delay_s: float) -> None:
    m.sensor_delay_s = delay_s


def _clock_jitter(m: MotorSettings, std_s: float) -> None:
    m.jitter_s = std_s


def _command_dropout(m: MotorSettings, fraction: float, longest_s: float) -> None:
    m.dropout_fraction, m.dropout_s = fraction, longest_s


def _stiffness_error(m: MotorSettings, scale: float) -> None:
    m.stiffness_scale *= scale


def _damping(m: MotorSettings) -> float:
    return m.kt * m.ke / m.resistance + m.viscous


def _damping_error(m: MotorSettings, scale: float) -> None:
    """More drag is friction in the gear; less than back-EMF alone gives is a motor with less of it."""
    viscous = m.viscous + (scale - 1) * _damping(m)
    if viscous < 0:
        m.ke = max(0.0, m.ke + viscous * m.resistance / m.kt)
        viscous = 0.0
    m.viscous = viscous


def _electrical_damping(m: MotorSettings, share: float) -> None:
    total = _damping(m)
    m.ke = share * total * m.resistance / m.kt
    m.viscous = (1 - share) * total


def _weak_joint(m: MotorSettings, scale: float) -> None:
    m.strength *= scale


def _coulomb_friction(m: MotorSettings, torque_nm: float) -> None:
    m.coulomb_nm = torque_nm


def _stribeck_friction(m: MotorSettings, coulomb_nm: float, static_nm: float, velocity_rad_s: float) -> None:
    m.coulomb_nm, m.static_nm, m.stribeck_rad_s = coulomb_nm, static_nm, velocity_rad_s


def _load_friction(m: MotorSettings, coefficient: float) -> None:
    m.load_friction = coefficient


def _asymmetric_friction(m: MotorSettings, positive_nm: float, negative_nm: float) -> None:
    m.coulomb_nm = (positive_nm + negative_nm) / 2
    m.friction_bias_nm = (positive_nm - negative_nm) / 2


def _viscous_nonlinear(m: MotorSettings, coefficients: Sequence[float]) -> None:
    linear, quadratic = (*coefficients, 0.0, 0.0)[:2]
    m.viscous, m.viscous_quadratic = linear, quadratic


def _torque_limit(m: MotorSettings, torque_nm: float) -> None:
    m.torque_limit_nm = torque_nm


def _thermal_derating(m: MotorSettings, loss_per_c: float, time_constant_s: float) -> None:
    m.derating_per_k, m.derating_s = loss_per_c, time_constant_s


def _backlash(m: MotorSettings, gap_rad: float) -> None:
    m.backlash_rad = gap_rad


def _joint_compliance(m: MotorSettings, stiffness_nm_rad: float) -> None:
    m.compliant, m.gear_stiffness = True, stiffness_nm_rad


def _cogging(m: MotorSettings, amplitude_nm: float, periods: float) -> None:
    m.cogging_nm, m.cogging_periods = amplitude_nm, periods


def _dead_zone(m: MotorSettings, width_rad: float) -> None:
    m.dead_zone_rad = width_rad


def _armature_error(m: MotorSettings, kg_m2: float) -> None:
    m.armature = kg_m2


# ---- robot and room ----


def _speed_limit(w: WorldSettings, joints: Sequence[str], no_load_rad_s: float) -> None:
    for setup in w.servos:
        if setup.joint in joints:
            assert setup.motor is not None
            setup.motor.ke = w.supply.volts / no_load_rad_s


def _voltage_sag(w: WorldSettings, joints: Sequence[str], resistance_ohm: float) -> None:
    w.supply.resistance_ohm = resistance_ohm


def _link_mass(w: WorldSettings, joints: Sequence[str], scale: float) -> None:
    w.body.link_scale = {**w.body.link_scale, **dict.fromkeys(joints, scale)}


def _blocked_joint(w: WorldSettings, joints: Sequence[str], angle_rad: float) -> None:
    w.body.blocked = {**w.body.blocked, **dict.fromkeys(joints, angle_rad)}


def _zero_offset(w: WorldSettings, joints: Sequence[str], angle_rad: float) -> None:
    for setup in w.servos:
        if setup.joint in joints:
            setup.zero_error_rad += angle_rad


def _payload(w: WorldSettings, joints: Sequence[str], mass_kg: float, position_m: Sequence[float]) -> None:
    x, y, z = position_m
    w.body.payloads = [*w.body.payloads, Payload(mass_kg, (x, y, z))]


def _floor_friction(w: WorldSettings, joints: Sequence[str], sliding: float) -> None:
    w.body.floor_friction = sliding


def _contact_softness(w: WorldSettings, joints: Sequence[str], time_constant_s: float) -> None:
    w.body.contact_time_s = time_constant_s


def _foot_adhesion(w: WorldSettings, joints: Sequence[str], force_n: float) -> None:
    w.body.adhesion_n = force_n


def _floor_tilt(w: WorldSettings, joints: Sequence[str], angle_rad: float, direction: float) -> None:
    w.body.tilt_rad, w.body.tilt_direction_rad = angle_rad, direction


def _cable_drag(
    w: WorldSettings, joints: Sequence[str], force_n: float, direction: float, damping_n_s_m: float,
    stiffness_n_m: float, anchor_m: Sequence[float],
) -> None:  # fmt: skip
    x, y, z = anchor_m
    force = (force_n * math.cos(direction), force_n * math.sin(direction), 0.0)
    w.body.cable = Tether(force, damping_n_s_m, stiffness_n_m, (x, y, z))


def _imu_misalignment(w: WorldSettings, joints: Sequence[str], rotation_rad: Sequence[float]) -> None:
    w.imu = {**w.imu, "mount_rpy": tuple(rotation_rad)}


def _imu_bias(w: WorldSettings, joints: Sequence[str], rad_s: Sequence[float], m_s2: Sequence[float]) -> None:
    w.imu = {**w.imu, "gyro_bias": tuple(rad_s), "acc_bias": tuple(m_s2)}


def _tracker_scale(w: WorldSettings, joints: Sequence[str], scale: float, yaw_rad: float, latency_s: float) -> None:
    """Tags printed at another size than declared scale every distance; a tag glued askew turns the heading."""
    settings = OverheadCameraSettings(**w.camera)
    origin, body = settings.origin, settings.body
    w.camera = {
        **w.camera,
        "latency_s": settings.latency_s + latency_s,
        "origin": None if origin is None else replace(origin, size=origin.size / scale),
        "body": None if body is None else replace(body, size=body.size / scale, yaw=body.yaw + yaw_rad),
    }


_ZERO = (0.0, 0.0, 0.0)

#: Every name of the catalogue that this robot can have.
CATALOGUE: Mapping[str, _Effect] = {
    "action_delay": _Effect({"delay_s": None}, _action_delay),
    "actuator_lag": _Effect({"time_constant_s": None}, _actuator_lag),
    "slew_limit": _Effect({"rate_rad_s": None}, _slew_limit),
    "sensor_delay": _Effect({"delay_s": None}, _sensor_delay),
    "clock_jitter": _Effect({"std_s": None}, _clock_jitter),
    "command_dropout": _Effect({"fraction": None, "longest_s": 0.0}, _command_dropout),
    "stiffness_error": _Effect({"scale": None}, _stiffness_error),
    "damping_error": _Effect({"scale": None}, _damping_error),
    "electrical_damping": _Effect({"share": None}, _electrical_damping),
    "weak_joint": _Effect({"scale": None}, _weak_joint),
    "coulomb_friction": _Effect({"torque_nm": None}, _coulomb_friction),
    "stribeck_friction": _Effect({"coulomb_nm": None, "static_nm": None, "velocity_rad_s": None}, _stribeck_friction),
    "load_friction": _Effect({"coefficient": None}, _load_friction),
    "asymmetric_friction": _Effect({"positive_nm": None, "negative_nm": None}, _asymmetric_friction),
    "viscous_nonlinear": _Effect({"coefficients": None}, _viscous_nonlinear),
    "torque_limit": _Effect({"torque_nm": None}, _torque_limit),
    "speed_limit": _Effect({"no_load_rad_s": None}, world=_speed_limit),
    "voltage_sag": _Effect({"resistance_ohm": None}, world=_voltage_sag),
    "thermal_derating": _Effect({"loss_per_c": None, "time_constant_s": 0.0}, _thermal_derating),
    "backlash": _Effect({"gap_rad": None}, _backlash),
    "joint_compliance": _Effect({"stiffness_nm_rad": None}, _joint_compliance),
    "cogging": _Effect({"amplitude_nm": None, "periods": None}, _cogging),
    "dead_zone": _Effect({"width_rad": None}, _dead_zone),
    "armature_error": _Effect({"kg_m2": None}, _armature_error),
    "link_mass": _Effect({"scale": None}, world=_link_mass),
    "payload": _Effect({"mass_kg": None, "position_m": _ZERO}, world=_payload),
    "zero_offset": _Effect({"angle_rad": None}, world=_zero_offset),
    "blocked_joint": _Effect({"angle_rad": None}, world=_blocked_joint),
    "floor_friction": _Effect({"sliding": None}, world=_floor_friction),
    "contact_softness": _Effect({"time_constant_s": None}, world=_contact_softness),
    "foot_adhesion": _Effect({"force_n": None}, world=_foot_adhesion),
    "floor_tilt": _Effect({"angle_rad": None, "direction": 0.0}, world=_floor_tilt),
    "cable_drag": _Effect(
        {"force_n": 0.0, "direction": 0.0, "damping_n_s_m": 0.0, "stiffness_n_m": 0.0, "anchor_m": _ZERO},
        world=_cable_drag,
    ),
    "imu_misalignment": _Effect({"rotation_rad": None}, world=_imu_misalignment),
    "imu_bias": _Effect({"rad_s": _ZERO, "m_s2": _ZERO}, world=_imu_bias),
    "tracker_scale": _Effect({"scale": 1.0, "yaw_rad": 0.0, "latency_s": 0.0}, world=_tracker_scale),
}  # fmt: skip

#: Needs a stand or a floor: nothing is moved in a box of motors.
_NEEDS_ROBOT = frozenset({"link_mass", "payload", "blocked_joint", "floor_friction", "floor_tilt", "cable_drag"})
_VECTORS = {"position_m": 3, "anchor_m": 3, "rotation_rad": 3, "rad_s": 3, "m_s2": 3, "coefficients": 0}


def apply_entry(settings: WorldSettings, entry: ScenarioEffect, where: str) -> None:
    """Build one effect into a world's settings; every servo's `motor` must be filled in.

    Raises:
        BadInput: unknown effect, parameter or joint, a missing or impossible value; names `where`.
    """
    effect = CATALOGUE.get(entry.effect)
    if effect is None:
        raise BadInput(f"no effect is called {entry.effect!r}", where=where, remedy=nearest(entry.effect, CATALOGUE))
    if entry.effect in _NEEDS_ROBOT and settings.body.setup == "loose":
        raise BadInput(f"{entry.effect!r} needs an assembled robot", where=where, remedy='[robot] setup = "stand"')
    joints = _scope(settings, entry, where)
    parameters = _parameters(entry, effect, where)
    if effect.motor is not None:
        for setup in settings.servos:
            if setup.joint in joints:
                assert setup.motor is not None
                effect.motor(setup.motor, **parameters)
    if effect.world is not None:
        effect.world(settings, joints, **parameters)


def _scope(settings: WorldSettings, entry: ScenarioEffect, where: str) -> tuple[str, ...]:
    known = [setup.joint for setup in settings.servos]
    if isinstance(entry.joints, str):
        if entry.joints in ("all", "body"):
            return tuple(known)
        raise BadInput(f"joints = {entry.joints!r}", where=where, remedy='a list of joints, "all" or "body"')
    for name in entry.joints:
        if name not in known:
            raise BadInput(f"no joint {name!r}", where=where, remedy=nearest(name, known))
    return entry.joints


def _parameters(entry: ScenarioEffect, effect: _Effect, where: str) -> dict[str, Any]:
    for name in entry.parameters:
        if name not in effect.parameters:
            raise BadInput(
                f"{entry.effect} has no parameter {name!r}", where=where, remedy=nearest(name, effect.parameters)
            )
    values: dict[str, Any] = {}
    for name, default in effect.parameters.items():
        value = entry.parameters.get(name, default)
        if value is None:
            raise BadInput(f"{entry.effect} needs {name}", where=where, remedy=f"parameters = {{ {name} = … }}")
        values[name] = _number(name, value, f"{where}, {name}")
    return values


def _number(name: str, value: Any, where: str) -> Any:
    if name in _VECTORS:
        count = _VECTORS[name]
        numbers = list(value) if isinstance(value, list | tuple) else [value]
        good = all(isinstance(v, int | float) and math.isfinite(v) for v in numbers)
        if not good or (count and len(numbers) != count):
            raise BadInput(f"{value!r}", where=where, remedy=f"a list of {count or 'some'} numbers")
        return tuple(float(v) for v in numbers)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise BadInput(f"{value!r} is not a number", where=where)
    if value < 0 and not name.startswith(("angle", "direction", "positive", "negative", "force", "yaw")):
        raise BadInput(f"{value} is below zero", where=where)
    return float(value)
