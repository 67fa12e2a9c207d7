"""The two Open Ant kits by numbers: servos, supply, masses, lengths, limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINTS, Kind
from openant_tools.robot.servo import ServoModel, servo_model

__all__ = [
    "ANGLE_LIMIT_RAD", "HOME_RAD", "KITS", "NOMINAL_ZERO_RAD", "PLATFORM_PWM_LIMIT", "PLATFORM_PWM_LIMIT_COUNTS", "Kit",
    "home_angles", "kit",
]  # fmt: skip

#: The platform's driver writes int(50 / 0.113) into every servo's `pwm_limit`: half of the full duty.
PLATFORM_PWM_LIMIT_COUNTS = 442
PLATFORM_PWM_LIMIT = 0.5

#: Largest angle either way, by kind of joint: the platform's command limits and its model's stops.
ANGLE_LIMIT_RAD: Mapping[Kind, float] = {"hip": math.radians(45), "knee": math.radians(70)}
#: The middle of the platform's action ranges, a firm stand with the torso 0.15 m high.
HOME_RAD: Mapping[Kind, float] = {"hip": 0.0, "knee": math.radians(-50)}

#: Servo angle at joint zero until it is measured. Horns go on in steps of 45°, and half a turn keeps the whole range of
#: every joint away from the encoder's seam.
NOMINAL_ZERO_RAD = math.pi


def home_angles() -> tuple[float, ...]:
    """The joint angles of the stand, rad, in the order of the joints."""
    return tuple(HOME_RAD[joint.kind] for joint in JOINTS.values())


@dataclass(frozen=True)
class Kit:
    """What the parts of one kit amount to.

    Masses are the platform's model's for the standard kit, with the torso taking up what lacks to the mass that the
    paper weighed; for the Lite kit each link is lighter by what its servo is lighter, and the torso by the rest.

    Attributes:
        name: "standard" or "lite".
        words: for people.
        hip, knee: names of servo models.
        supply_v: the supply that comes with the kit.
        total_mass_kg: as weighed (paper).
        leg_root_mass_kg: the part of a leg fixed to the torso, which holds the hip's servo.
        upper_leg_mass_kg: from hip to knee, holds the knee's servo.
        lower_leg_mass_kg: from knee to foot.
    """

    name: str
    words: str
    hip: str
    knee: str
    supply_v: float
    total_mass_kg: float
    leg_root_mass_kg: float
    upper_leg_mass_kg: float
    lower_leg_mass_kg: float

    def servo(self, kind: Kind) -> ServoModel:
        return servo_model(self.hip if kind == "hip" else self.knee)

    @property
    def torso_mass_kg(self) -> float:
        return self.total_mass_kg - 4 * (self.leg_root_mass_kg + self.upper_leg_mass_kg + self.lower_leg_mass_kg)


KITS: Mapping[str, Kit] = {
    "standard": Kit(
        name="standard",
        words="Open Ant: 4 knees XM430-W350-T, 4 hips XC430-W240-T, 12 V",
        hip="XC430-W240-T",
        knee="XM430-W350-T",
        supply_v=12.0,
        total_mass_kg=1.20,
        leg_root_mass_kg=0.082,
        upper_leg_mass_kg=0.099,
        lower_leg_mass_kg=0.030,
    ),
    "lite": Kit(
        name="lite",
        words="Open Ant Lite: 8 XL430-W250-T, 11.1 V",
        hip="XL430-W250-T",
        knee="XL430-W250-T",
        supply_v=11.1,
        total_mass_kg=0.98,
        leg_root_mass_kg=0.074,
        upper_leg_mass_kg=0.074,
        lower_leg_mass_kg=0.030,
    ),
}


def kit(name: str) -> Kit:
    """A kit by name; raises BadInput for any other than "standard" and "lite"."""
    try:
        return KITS[name]
    except KeyError:
        raise BadInput(f"there is no kit {name!r}", remedy=f"use {' or '.join(KITS)}") from None
