"""How large an effect of the blind benchmark is: small lies near the tolerance, medium matters, large cannot be missed.

The tolerances are those of the effect catalogue; where it states none, the platform's nominal value stands for scale. All
values are SI, drawn evenly between the two figures of their size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from openant_tools.numbers import literal
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT, Kit, kit

__all__ = ["KINDS", "SIZES", "Family", "Kind", "Size", "size_table"]

Size = Literal["small", "medium", "large"]
Family = Literal["joint", "body"]
SIZES: tuple[Size, ...] = ("small", "medium", "large")

Parameters = dict[str, Any]
Draw = Callable[[int, np.random.Generator, Sequence[str], Kit], Parameters]
Ranges = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Kind:
    """How robots get one effect of the catalogue.

    Attributes:
        family: "joint" for joint, servo and bus, "body" for body, contact, environment and IMU.
        scopes: letters of the catalogue from which one is drawn: j(oint), g(roup of one servo model), a(ll), b(ody).
        draw: parameters for size 0, 1, 2, given the joints in scope.
        words: what the sizes are, for the docs.
        joints: of which a single one is drawn.
        needs_tracker: shows in `base.*` alone.
        near: a small one lies within 2.5 times a tolerance that the catalogue states, so that "none" is fair.
    """

    family: Family
    scopes: str
    draw: Draw
    words: str
    joints: tuple[str, ...] = tuple(JOINTS)
    needs_tracker: bool = False
    near: bool = False


def _even(ranges: Ranges, size: int, chance: np.random.Generator) -> float:
    return float(chance.uniform(*ranges[size]))


def _range(ends: tuple[float, float]) -> str:
    return "…".join(map(literal, ends))


def _plain(name: str, unit: str, *ranges: tuple[float, float], more: Callable[..., Parameters] | None = None) -> Any:
    """A parameter in its own unit, and what else the effect needs."""
    assert len(ranges) == 3
    three: Ranges = (ranges[0], ranges[1], ranges[2])

    def draw(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
        return {name: _even(three, size, chance), **(more(size, chance) if more else {})}

    return draw, f"{name} " + ", ".join(map(_range, ranges)) + (f" {unit}" if unit else "")


def _either(name: str, up: Ranges, down: Ranges, nominal: Callable[[str, Kit], float] | None = None) -> Any:
    """A scale that may be too large or too small, of a nominal value where the parameter is not itself a scale."""

    def draw(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
        scale = _even(up if chance.random() < 0.5 else down, size, chance)
        return {name: scale * (nominal(joints[0], kit) if nominal else 1.0)}

    pairs = [f"{_range(less)} or {_range(more)}" for more, less in zip(up, down, strict=True)]
    return draw, f"{name} " + ", ".join(pairs) + (" × nominal" if nominal else "")


def _share(name: str, nominal: Callable[[str, Kit], float], *ranges: tuple[float, float]) -> Any:
    three: Ranges = (ranges[0], ranges[1], ranges[2])

    def draw(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
        return {name: _even(three, size, chance) * nominal(joints[0], kit)}

    return draw, f"{name} " + ", ".join(map(_range, ranges)) + " × nominal"


def _limit(joint: str, kit: Kit) -> float:
    return kit.servo(JOINTS[joint].kind).stall_torque_at(kit.supply_v, PLATFORM_PWM_LIMIT)


def _speed(joint: str, kit: Kit) -> float:
    """rad/s at which the nominal force range is all spent on the nominal damping."""
    return _limit(joint, kit) / kit.servo(JOINTS[joint].kind).electrical_damping_nm_s_rad


def _armature(joint: str, kit: Kit) -> float:
    return kit.servo(JOINTS[joint].kind).armature_kg_m2


def _stribeck(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    return {
        "coulomb_nm": float(chance.uniform(0.05, 0.07)),
        "static_nm": _even(((0.12, 0.15), (0.22, 0.30), (0.40, 0.50)), size, chance),
        "velocity_rad_s": float(chance.uniform(0.05, 0.15)),
    }


def _asymmetric(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    low = float(chance.uniform(0.04, 0.06))
    high = low + _even(((0.06, 0.08), (0.13, 0.18), (0.25, 0.35)), size, chance)
    names = ("positive_nm", "negative_nm") if chance.random() < 0.5 else ("negative_nm", "positive_nm")
    return dict(zip(names, (high, low), strict=True))


def _blocked(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    if JOINTS[joints[0]].kind == "knee":
        return {"angle_rad": -_even(((1.06, 1.10), (0.95, 1.0), (0.89, 0.92)), size, chance)}
    side = 1.0 if chance.random() < 0.5 else -1.0
    return {"angle_rad": side * _even(((0.42, 0.48), (0.28, 0.34), (0.14, 0.20)), size, chance)}


def _zero(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    side = 1.0 if chance.random() < 0.5 else -1.0
    return {"angle_rad": side * _even(((0.013, 0.018), (0.035, 0.06), (0.09, 0.14)), size, chance)}


def _floor(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    # The nominal model's sliding coefficient is 0.6.
    up, down = ((1.25, 1.35), (1.6, 1.9), (2.3, 2.8)), ((0.72, 0.78), (0.45, 0.55), (0.25, 0.35))
    return {"sliding": 0.6 * _even(up if chance.random() < 0.4 else down, size, chance)}


def _payload(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    x, y = chance.uniform(-0.03, 0.03, 2)
    return {
        "mass_kg": _even(((0.08, 0.12), (0.2, 0.3), (0.4, 0.6)), size, chance),
        "position_m": [float(x), float(y), float(chance.uniform(0.0, 0.05))],
    }


def _cable(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    return {
        "force_n": _even(((0.15, 0.25), (0.5, 0.8), (1.2, 1.8)), size, chance),
        "direction": float(chance.uniform(-math.pi, math.pi)),
        "damping_n_s_m": float(chance.uniform(0.0, 2.0)),
    }


def _misalignment(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    axis = chance.standard_normal(3)
    axis /= np.linalg.norm(axis)
    angle = _even(((0.03, 0.04), (0.08, 0.12), (0.2, 0.3)), size, chance)
    return {"rotation_rad": [float(value) for value in angle * axis]}


def _bias(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    def vector(length: float) -> list[float]:
        axis = chance.standard_normal(3)
        return [float(value) for value in length * axis / np.linalg.norm(axis)]

    return {
        "rad_s": vector(_even(((0.02, 0.03), (0.05, 0.1), (0.2, 0.3)), size, chance)),
        "m_s2": vector(_even(((0.2, 0.3), (0.5, 0.8), (1.5, 2.0)), size, chance)),
    }


def _tracker(size: int, chance: np.random.Generator, joints: Sequence[str], kit: Kit) -> Parameters:
    side = 1.0 if chance.random() < 0.5 else -1.0
    return {
        "scale": 1 + side * _even(((0.04, 0.06), (0.12, 0.16), (0.25, 0.35)), size, chance),
        "yaw_rad": side * _even(((0.02, 0.03), (0.06, 0.1), (0.15, 0.25)), size, chance),
        "latency_s": _even(((0.02, 0.03), (0.05, 0.07), (0.1, 0.14)), size, chance),
    }


def _longest(size: int, chance: np.random.Generator) -> Parameters:
    return {"longest_s": float(chance.uniform(0.02, 0.1))}


def _direction(size: int, chance: np.random.Generator) -> Parameters:
    return {"direction": float(chance.uniform(-math.pi, math.pi))}


def _slow(size: int, chance: np.random.Generator) -> Parameters:
    return {"time_constant_s": float(chance.uniform(0.0, 3.0))}


def _periods(size: int, chance: np.random.Generator) -> Parameters:
    return {"periods": int(chance.integers(12, 41))}


_KNEES = tuple(name for name, joint in JOINTS.items() if joint.kind == "knee")


def _kinds() -> dict[str, Kind]:
    def joint(scopes: str, drawn: Any, **more: Any) -> Kind:
        draw, words = drawn
        return Kind("joint", scopes, draw, words, **more)

    def body(drawn: Any, **more: Any) -> Kind:
        draw, words = drawn
        return Kind("body", "b", draw, words, **more)

    return {
        "action_delay": joint("ja", _plain("delay_s", "s", (0.005, 0.008), (0.012, 0.02), (0.03, 0.05))),
        "actuator_lag": joint("ja", _plain("time_constant_s", "s", (0.008, 0.012), (0.02, 0.035), (0.05, 0.09))),
        "slew_limit": joint("ja", _plain("rate_rad_s", "rad/s", (2.2, 2.8), (1.1, 1.6), (0.5, 0.8))),
        "sensor_delay": joint("ab", _plain("delay_s", "s", (0.005, 0.008), (0.012, 0.02), (0.03, 0.05))),
        "clock_jitter": joint("a", _plain("std_s", "s", (0.002, 0.003), (0.005, 0.007), (0.010, 0.014))),
        "command_dropout": joint(
            "ja", _plain("fraction", "", (0.03, 0.05), (0.08, 0.14), (0.2, 0.3), more=_longest)
        ),
        "stiffness_error": joint(
            "jga",
            _either("scale", ((1.22, 1.3), (1.45, 1.7), (2.0, 2.6)), ((0.72, 0.78), (0.52, 0.62), (0.33, 0.42))),
        ),
        "damping_error": joint(
            "jga",
            _either("scale", ((1.4, 1.5), (1.8, 2.3), (2.8, 3.5)), ((0.55, 0.65), (0.3, 0.42), (0.1, 0.2))),
        ),
        "electrical_damping": joint("ga", _plain("share", "", (0.3, 0.4), (0.55, 0.75), (0.85, 1.0))),
        "weak_joint": joint("j", _plain("scale", "", (0.72, 0.78), (0.52, 0.62), (0.3, 0.4))),
        "coulomb_friction": joint("jga", _plain("torque_nm", "N·m", (0.09, 0.11), (0.16, 0.22), (0.3, 0.4))),
        "stribeck_friction": joint("ja", (_stribeck, "static_nm 0.12…0.15, 0.22…0.3, 0.4…0.5 N·m")),
        "load_friction": joint("jga", _plain("coefficient", "", (0.1, 0.14), (0.28, 0.4), (0.5, 0.7))),
        "asymmetric_friction": joint("j", (_asymmetric, "difference 0.06…0.08, 0.13…0.18, 0.25…0.35 N·m")),
        "viscous_nonlinear": joint("jga", _plain("coefficients", "N·m·s²/rad²", (0.06, 0.1), (0.2, 0.3), (0.5, 0.8))),
        "torque_limit": joint("jg", _share("torque_nm", _limit, (0.74, 0.8), (0.52, 0.62), (0.3, 0.4))),
        "speed_limit": joint("g", _share("no_load_rad_s", _speed, (2.4, 3.0), (1.1, 1.5), (0.5, 0.7))),
        "voltage_sag": joint("a", _plain("resistance_ohm", "Ω", (0.2, 0.3), (0.6, 0.9), (1.4, 2.0))),
        "thermal_derating": joint(
            "jga", _plain("loss_per_c", "1/°C", (0.006, 0.009), (0.016, 0.024), (0.03, 0.04), more=_slow)
        ),
        "backlash": joint("jg", _plain("gap_rad", "rad", (0.006, 0.009), (0.016, 0.024), (0.035, 0.05))),
        "joint_compliance": joint("jg", _plain("stiffness_nm_rad", "N·m/rad", (18.0, 25.0), (6.0, 8.0), (2.5, 3.5))),
        "cogging": joint("jg", _plain("amplitude_nm", "N·m", (0.06, 0.08), (0.14, 0.2), (0.28, 0.38), more=_periods)),
        "dead_zone": joint("jga", _plain("width_rad", "rad", (0.008, 0.012), (0.022, 0.032), (0.05, 0.07))),
        "armature_error": joint(
            "g",
            _either(
                "kg_m2", ((1.5, 1.7), (2.2, 2.8), (3.8, 5.0)), ((0.55, 0.62), (0.3, 0.4), (0.12, 0.2)), _armature
            ),
        ),
        "link_mass": joint("a", _plain("scale", "", (1.13, 1.2), (1.45, 1.65), (2.0, 2.5))),
        "zero_offset": joint("j", (_zero, "angle_rad ±0.013…0.018, 0.035…0.06, 0.09…0.14 rad"), joints=_KNEES),
        "blocked_joint": joint(
            "j", (_blocked, "reach lost at the end of the motion: about 0.09, 0.2, 0.27 rad (knee), 0.1, 0.24, 0.38 (hip)")
        ),
        "payload": body((_payload, "mass_kg 0.08…0.12, 0.2…0.3, 0.4…0.6 kg")),
        "floor_friction": body((_floor, "sliding 0.72…0.78, 0.45…0.55, 0.25…0.35 or 1.25…1.35, 1.6…1.9, 2.3…2.8 × nominal")),
        "contact_softness": body(_plain("time_constant_s", "s", (0.03, 0.036), (0.05, 0.065), (0.08, 0.11))),
        "foot_adhesion": body(_plain("force_n", "N", (0.4, 0.7), (1.5, 2.2), (3.5, 5.0))),
        "floor_tilt": body(_plain("angle_rad", "rad", (0.014, 0.02), (0.04, 0.055), (0.08, 0.11), more=_direction)),
        "cable_drag": body((_cable, "force_n 0.15…0.25, 0.5…0.8, 1.2…1.8 N, with damping up to 2 N·s/m")),
        "imu_misalignment": body((_misalignment, "rotation 0.03…0.04, 0.08…0.12, 0.2…0.3 rad")),
        "imu_bias": body((_bias, "gyro 0.02…0.03, 0.05…0.1, 0.2…0.3 rad/s; accelerometer 0.2…0.3, 0.5…0.8, 1.5…2 m/s²")),
        "tracker_scale": body(
            (_tracker, "scale ±0.04…0.06, 0.12…0.16, 0.25…0.35, with yaw and latency"), needs_tracker=True
        ),
    }  # fmt: skip


#: Small ones of these lie near a tolerance; the others have none in the catalogue, or begin well beyond it.
_NEAR = frozenset({
    "stiffness_error", "damping_error", "weak_joint", "coulomb_friction", "torque_limit", "armature_error",
    "link_mass", "zero_offset", "floor_friction", "contact_softness", "floor_tilt", "imu_misalignment",
    "imu_bias",
})  # fmt: skip

#: name of the catalogue → how robots get it
KINDS: Mapping[str, Kind] = {name: replace(kind, near=name in _NEAR) for name, kind in _kinds().items()}


def size_table() -> str:
    """The sizes as a Markdown table."""
    lines = ["| effect | scopes | small, medium, large |", "|---|---|---|"]
    lines += [f"| `{name}` | {' '.join(kind.scopes)} | {kind.words} |" for name, kind in KINDS.items()]
    return "\n".join(lines)


STANDARD = kit("standard")
