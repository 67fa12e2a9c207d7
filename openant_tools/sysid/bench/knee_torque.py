"""What a knee must bear in stance against what its servo can give: the table by which the paper chose its motors.

The robot's weight is shared by the legs in stance, so that a knee bears

    τ = (m g / n) L sin θ

with θ the angle of the lower leg from the vertical and L the distance from the knee's axis to the point of contact
(paper, appendix on torque).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number, percent, span
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.robot.config import RobotConfig
from openant_tools.robot.kit import HOME_RAD, PLATFORM_PWM_LIMIT, Kit
from openant_tools.robot.servo import ServoModel

__all__ = [
    "GRAVITY_M_S2",
    "KNEE_TO_GROUND_M",
    "Load",
    "knee_load",
    "knee_loads",
    "knee_torque",
    "torque_finding",
    "torque_table",
]

GRAVITY_M_S2 = 9.81

#: Both figures of the paper (0.66 N·m for 1.2 kg, 0.54 N·m for 0.98 kg, two legs at 45°) imply 0.157 to 0.160 m. The
#: platform's model has 0.170 m from the knee's axis to the centre of the foot's sphere.
KNEE_TO_GROUND_M = 0.159

#: Legs in stance: standing, one leg lifted, trotting.
LEGS_IN_STANCE = (4, 3, 2)
#: Of the lower leg from the vertical: the home stand's, and the paper's.
ANGLES_RAD = (math.pi / 2 + HOME_RAD["knee"], math.pi / 4)
MOST_LEGS = 4

Verdict = Literal["holds", "heats", "gives way"]


@dataclass(frozen=True)
class Load:
    """One row of the table.

    Attributes:
        joint: whose knee, or the servo's name where no robot is meant.
        servo: the servo model's name.
        legs: in stance.
        angle_rad: of the lower leg from the vertical.
        torque_nm: what the knee must bear.
        nominal_nm: what the servo bears for long.
        limit_nm: stall torque at the PWM limit in force and at this supply: what it can give at all.
    """

    joint: str
    servo: str
    legs: int
    angle_rad: float
    torque_nm: float
    nominal_nm: float
    limit_nm: float

    @property
    def verdict(self) -> Verdict:
        """`holds` for long, `heats` beyond the nominal torque, `gives way` beyond what the PWM limit leaves."""
        if self.torque_nm > self.limit_nm:
            return "gives way"
        return "heats" if self.torque_nm > self.nominal_nm else "holds"


def knee_torque(mass_kg: float, legs: int, angle_rad: float, length_m: float = KNEE_TO_GROUND_M) -> float:
    """N·m at each knee in stance.

    Raises:
        BadInput: a mass or length that is not positive, a number of legs that an Ant has not, an angle beyond a quarter turn.
    """
    if not mass_kg > 0:
        raise BadInput(f"the mass is {exact(mass_kg, 'kg')}", remedy="give the robot's mass in kg")
    if not length_m > 0:
        raise BadInput(f"the leg is {exact(length_m, 'm')} long", remedy="give the distance from knee to ground in m")
    if not 1 <= legs <= MOST_LEGS:
        raise BadInput(f"{legs} legs in stance", remedy="an Ant stands on 1 to 4")
    if not 0 <= angle_rad <= math.pi / 2 + 1e-9:
        raise BadInput(
            f"a leg at {number(angle_rad, 'rad', decimals=0)} from the vertical is above its knee",
            remedy="0° is a leg straight down, 90° straight out; give the angle its unit: write 45deg",
        )
    return mass_kg * GRAVITY_M_S2 / legs * length_m * math.sin(angle_rad)


def knee_load(
    joint: str,
    servo: ServoModel,
    mass_kg: float,
    legs: int,
    angle_rad: float,
    *,
    supply_v: float,
    pwm_limit: float,
    length_m: float = KNEE_TO_GROUND_M,
) -> Load:
    """One knee in one stance; see `knee_torque` for what raises BadInput."""
    if not 0 < pwm_limit <= 1:
        raise BadInput(f"a PWM limit of {exact(pwm_limit)}", remedy="give a share of full duty, 0 to 1")
    low, high = servo.supply_range_v
    if not low <= supply_v <= high:
        raise BadInput(
            f"{servo.name} does not run on {exact(supply_v, 'V')}", remedy=f"it needs {span(low, high, 'V')}"
        )
    return Load(
        joint,
        servo.name,
        legs,
        angle_rad,
        knee_torque(mass_kg, legs, angle_rad, length_m),
        servo.nominal_torque_nm,
        servo.stall_torque_at(supply_v, pwm_limit),
    )


def knee_loads(
    knees: Sequence[tuple[str, ServoModel]],
    mass_kg: float,
    legs: Sequence[int],
    angles_rad: Sequence[float],
    *,
    supply_v: float,
    pwm_limit: float,
    length_m: float = KNEE_TO_GROUND_M,
) -> list[Load]:
    """The table: every knee (name, servo) in every stance."""
    return [
        knee_load(joint, servo, mass_kg, count, angle, supply_v=supply_v, pwm_limit=pwm_limit, length_m=length_m)
        for joint, servo in knees
        for count in legs
        for angle in angles_rad
    ]


def torque_table(
    kit: Kit,
    config: RobotConfig | None = None,
    *,
    servo: ServoModel | None = None,
    mass_kg: float | None = None,
    legs: Sequence[int] = (),
    angles_rad: Sequence[float] = (),
    length_m: float = KNEE_TO_GROUND_M,
    supply_v: float | None = None,
    pwm_limit: float | None = None,
    command: str,
) -> Finding:
    """The table for a kit, a robot or a servo, and what it says.

    Args:
        config: the robot's, whose own knees and PWM limit count; None for the kit's.
        servo: of the knees, instead.
        mass_kg: of the whole robot; None for the kit's, as weighed.
        legs, angles_rad: in stance, and of the lower leg from the vertical; none for standing, one leg lifted, trotting, at
            the home stand's angle and the paper's.
        supply_v, pwm_limit: None for the kit's (or the servo's own) and the robot's (or the platform's).

    Raises:
        BadInput: what `knee_load` refuses.
    """
    own = [motor.servo for motor in config.motors.values() if motor.kind == "knee"] if config else []
    knees = [servo] if servo else list({one.name: one for one in own}.values()) or [kit.servo("knee")]
    supply = supply_v or (servo.nominal_voltage_v if servo else kit.supply_v)
    if pwm_limit is None:
        pwm_limit = config.bus.pwm_limit if config else PLATFORM_PWM_LIMIT
    mass = kit.total_mass_kg if mass_kg is None else mass_kg
    loads = knee_loads(
        [(one.name, one) for one in knees], mass, legs or LEGS_IN_STANCE, angles_rad or ANGLES_RAD, supply_v=supply,
        pwm_limit=pwm_limit, length_m=length_m,
    )  # fmt: skip
    return torque_finding(loads, mass, length_m, supply, pwm_limit, command)


def torque_finding(
    loads: Sequence[Load], mass_kg: float, length_m: float, supply_v: float, pwm_limit: float, command: str
) -> Finding:
    """What the table says: whether every knee in it works within what its servo can hold."""
    worst = max(loads, key=lambda load: (load.torque_nm > load.limit_nm, load.torque_nm / load.nominal_nm))
    where = f"on {worst.legs} leg{'s' * (worst.legs > 1)} at {number(worst.angle_rad, 'rad', decimals=0)}"
    bears = number(worst.torque_nm, "N·m", decimals=2)
    figures = f"{bears} against a nominal {number(worst.nominal_nm, 'N·m', decimals=2)}"
    if worst.verdict == "holds":
        what, action = f"{worst.servo} knees hold: {where} they bear {figures}.", ""
    elif worst.verdict == "heats":
        what = f"{worst.servo} knees work beyond what they can hold: {where} they bear {figures}, and heat up."
        action = (
            "Let the robot walk in turns with rests and watch the knees' temperature; stand on four legs or with the lower "
            "legs steeper; take off mass, or use stronger servos."
        )
    else:
        what = (
            f"{worst.servo} knees give way: {where} they must bear {bears}, and have "
            f"{number(worst.limit_nm, 'N·m', decimals=2)} at {exact(supply_v, 'V')} and a PWM limit of {percent(pwm_limit)}."
        )
        action = "Stand with the lower legs steeper, take off mass, or raise the PWM limit as far as heat allows."
    several = len({load.servo for load in loads}) > 1
    rows = tuple(
        Evidence(
            f"{load.servo + ' ' if several else ''}on {load.legs} leg{'s' * (load.legs > 1)} at "
            f"{number(load.angle_rad, 'rad', decimals=0)}",
            load.torque_nm,
            "N·m",
            "τ = (m g / n) L sin θ",
            most=min(load.nominal_nm, load.limit_nm),
        )
        for load in loads
    )
    servos = {load.servo: load for load in loads}
    return Finding(
        step="knee-torque",
        ok=worst.verdict == "holds",
        what=what,
        evidence=(
            *rows,
            *(Evidence(f"nominal torque of {n}", one.nominal_nm, "N·m", "data sheet") for n, one in servos.items()),
            *(
                Evidence(f"stall torque of {n} at the PWM limit", one.limit_nm, "N·m", "data sheet, at this supply")
                for n, one in servos.items()
            ),
            Evidence("mass", mass_kg, "kg", "as given"),
            Evidence("knee to ground", length_m, "m", "as given"),
            Evidence("supply", supply_v, "V", "as given"),
            Evidence("PWM limit", pwm_limit, "share", "as given"),
        ),
        next_action=action,
        command=command,
        data={"rows": [{**vars(load), "verdict": load.verdict} for load in loads]},
        problems=() if worst.verdict == "holds" else (what,),
    )
