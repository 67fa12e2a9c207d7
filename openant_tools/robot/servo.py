"""The servos of the Open Ant as data: control table, ratings, and what follows from them in SI units."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from openant_tools.errors import BadInput
from openant_tools.robot import gains
from openant_tools.robot.control_table import control_table
from openant_tools.robot.gains import Rating
from openant_tools.robot.registers import PULSES_PER_TURN, PWM_FULL, RAD_PER_PULSE, RAD_S_PER_COUNT, Register

__all__ = [
    "BAUD_CODES", "HARDWARE_ERRORS", "PULSES_PER_TURN", "PWM_FULL", "RAD_PER_PULSE", "RAD_S_PER_COUNT", "SERVO_MODELS",
    "HardwareError", "Rating", "Register", "ServoModel", "baud_code", "hardware_errors", "servo_model",
]  # fmt: skip

_RPM = 2 * math.pi / 60

#: Code of the register `baud_rate` → bits per second.
BAUD_CODES: Mapping[int, int] = {
    0: 9_600, 1: 57_600, 2: 115_200, 3: 1_000_000, 4: 2_000_000, 5: 3_000_000, 6: 4_000_000, 7: 4_500_000,
}  # fmt: skip


@dataclass(frozen=True)
class HardwareError:
    """One bit of `hardware_error_status` (70) and of the mask `shutdown` (63)."""

    bit: int
    name: str
    advice: str

    @property
    def mask(self) -> int:
        return 1 << self.bit


HARDWARE_ERRORS: tuple[HardwareError, ...] = (
    HardwareError(
        0,
        "input voltage",
        "the supply left the servo's voltage limits: look at the power connector and the supply under load, then "
        "`openant comms reboot`, or power it off and on",
    ),
    HardwareError(
        2,
        "overheating",
        "the servo passed its temperature limit: let it cool for 20 minutes and take load off this joint, then "
        "`openant comms reboot`, or power it off and on",
    ),
    HardwareError(
        3,
        "motor encoder",
        "the servo cannot read its encoder: `openant comms reboot`, or power it off and on; replace the servo if it comes "
        "back",
    ),
    HardwareError(
        4,
        "electrical shock",
        "the servo's circuit saw a shock or too little power to drive the motor: look at cable and supply, then "
        "`openant comms reboot`, or power it off and on",
    ),
    HardwareError(
        5,
        "overload",
        "a load beyond the servo's strength stood too long: free the joint, look for a blocked leg, then "
        "`openant comms reboot`, or power it off and on",
    ),
)


def hardware_errors(status: int) -> tuple[HardwareError, ...]:
    """The errors that stand in a value of `hardware_error_status` or of the mask `shutdown`."""
    return tuple(error for error in HARDWARE_ERRORS if status & error.mask)


def baud_code(baud: int) -> int:
    """The code of `baud_rate` for bits per second; raises BadInput for a rate that no servo has."""
    for code, rate in BAUD_CODES.items():
        if rate == baud:
            return code
    raise BadInput(f"no servo speaks {baud} baud", remedy=f"use one of {', '.join(map(str, BAUD_CODES.values()))}")


@dataclass(frozen=True)
class ServoModel:
    """One servo model.

    Attributes:
        name, number: the vendor's name, and what the register `model_number` reads.
        ratings: the data sheet's lines, by rising voltage.
        nominal_voltage_v: the recommended supply, one of the ratings.
        supply_range_v: lowest and highest supply.
        nominal_torque_nm: what it bears for long; a fifth of stall (Open Ant paper).
        temperature_limit_c: factory limit and end of the operating range.
        standby_current_a: what it draws at rest.
        backlash_rad: full play of the gear where the vendor states it.
        modes: the operating modes it has.
        position_p_divisor, position_i_divisor, position_d_divisor: counts of gain per count of PWM and pulse. The
            manual's; measurements on a relative (XL330) found 256 for P, so these are data, not law.
        control_period_s: period of the position loop, by which the D gain takes its difference. Not published; an
            assumption.
        rotor_inertia_kg_m2: of the motor before the gear. Not published; the size that fits a rotor of this class
            (some 16 mm wide, some grams), good to a factor of two. Identification replaces it.
    """

    name: str
    number: int
    ratings: tuple[Rating, ...]
    nominal_voltage_v: float
    supply_range_v: tuple[float, float]
    gear_ratio: float
    mass_kg: float
    nominal_torque_nm: float
    temperature_limit_c: float
    standby_current_a: float
    modes: tuple[int, ...]
    has_current_sensor: bool
    backlash_rad: float | None = None
    operating_minimum_c: float = -5.0
    position_p_divisor: float = gains.P_DIVISOR
    position_i_divisor: float = gains.I_DIVISOR
    position_d_divisor: float = gains.D_DIVISOR
    control_period_s: float = gains.CONTROL_PERIOD_S
    rotor_inertia_kg_m2: float = 1e-7
    registers: Mapping[str, Register] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "registers", control_table(self.name))

    @property
    def rating(self) -> Rating:
        """The rating at the nominal voltage."""
        return next(rating for rating in self.ratings if rating.voltage_v == self.nominal_voltage_v)

    @property
    def stall_torque_nm(self) -> float:
        return self.rating.stall_torque_nm

    @property
    def stall_current_a(self) -> float:
        return self.rating.stall_current_a

    @property
    def no_load_rad_s(self) -> float:
        return self.rating.no_load_rad_s

    @property
    def kt_nm_a(self) -> float:
        """Torque at the output per ampere, τ_stall / I_stall; gear friction is in it, so it is not `ke_v_s_rad`."""
        return gains.torque_constant_nm_a(self.rating)

    @property
    def ke_v_s_rad(self) -> float:
        """Back-EMF at the output, V / ω_no-load."""
        return gains.emf_constant_v_s_rad(self.rating)

    @property
    def resistance_ohm(self) -> float:
        """V / I_stall: winding, bridge and cable together."""
        return gains.resistance_ohm(self.rating)

    @property
    def electrical_damping_nm_s_rad(self) -> float:
        """τ_stall / ω_no-load: the slope of the torque-speed line, the same at any supply."""
        return gains.back_emf_damping_nm_s_rad(self.rating)

    @property
    def armature_kg_m2(self) -> float:
        """The rotor's inertia at the output, gear ratio² · rotor inertia; as uncertain as the latter."""
        return self.gear_ratio**2 * self.rotor_inertia_kg_m2

    def stall_torque_at(self, supply_v: float | None = None, duty: float = 1.0) -> float:
        """N·m at stall, at a supply (default: the nominal one) and duty: `gains.stall_torque_nm`."""
        return gains.stall_torque_nm(self.ratings, self.nominal_voltage_v if supply_v is None else supply_v, duty)

    def stiffness_nm_rad(self, p_gain: float | None = None, supply_v: float | None = None) -> float:
        """N·m of torque per rad of position error (`gains.stiffness_nm_rad`).

        Args:
            p_gain: the register `position_p_gain`; default the factory's.
            supply_v: supply at the servo; default the nominal one.
        """
        gain = self.register("position_p_gain").default if p_gain is None else p_gain
        assert gain is not None
        return gains.stiffness_nm_rad(gain, self.position_p_divisor, self.stall_torque_at(supply_v))

    def derivative_damping_nm_s_rad(self, d_gain: float | None = None, supply_v: float | None = None) -> float:
        """N·m·s/rad that the D gain adds (`gains.derivative_damping_nm_s_rad`).

        As uncertain as `control_period_s`; a prior at best.
        """
        gain = self.register("position_d_gain").default if d_gain is None else d_gain
        assert gain is not None
        return gains.derivative_damping_nm_s_rad(
            gain, self.position_d_divisor, self.control_period_s, self.stall_torque_at(supply_v)
        )

    def register(self, name: str) -> Register:
        """A register by name; BadInput suggests the nearest name."""
        try:
            return self.registers[name]
        except KeyError:
            raise BadInput(
                f"{self.name} has no register {name!r}", remedy=_nearest(name, self.registers, "its registers")
            ) from None

    @property
    def effort(self) -> Register:
        """What stands at address 126: `present_current` (A), or `present_load` (fraction) without a sensor."""
        return self.registers["present_current" if self.has_current_sensor else "present_load"]


def _nearest(name: str, names: Iterable[str], what: str) -> str:
    close = difflib.get_close_matches(name, list(names), n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else f"{what} start with {', '.join(sorted(names)[:5])} …"


def _ratings(*lines: tuple[float, float, float, float]) -> tuple[Rating, ...]:
    """Lines of (V, stall N·m, stall A, no-load rpm) as data sheets print them."""
    return tuple(Rating(voltage, torque, current, rpm * _RPM) for voltage, torque, current, rpm in lines)


_WITHOUT_CURRENT = (1, 3, 4, 16)
_WITH_CURRENT = (0, 1, 3, 4, 5, 16)
_XM_BACKLASH_RAD = math.radians(0.25)

# Source of every figure: ROBOTIS e-manual; the XC430's nominal torque is our fifth of stall, the paper gives none.
_MODELS = (
    ServoModel(
        name="XL430-W250-T",
        number=1060,
        ratings=_ratings((9.0, 1.0, 1.0, 47), (11.1, 1.4, 1.3, 57), (12.0, 1.5, 1.4, 61)),
        nominal_voltage_v=11.1,
        supply_range_v=(6.5, 12.0),
        gear_ratio=258.5,
        mass_kg=0.0572,
        nominal_torque_nm=0.28,
        temperature_limit_c=72.0,
        standby_current_a=0.052,
        modes=_WITHOUT_CURRENT,
        has_current_sensor=False,
    ),
    ServoModel(
        name="XC430-W240-T",
        number=1080,
        ratings=_ratings((9.0, 1.4, 1.1, 52), (11.1, 1.7, 1.3, 65), (12.0, 1.9, 1.4, 70)),
        nominal_voltage_v=12.0,
        supply_range_v=(6.5, 14.8),
        gear_ratio=245.22,
        mass_kg=0.065,
        nominal_torque_nm=0.38,
        temperature_limit_c=80.0,
        standby_current_a=0.046,
        modes=_WITHOUT_CURRENT,
        has_current_sensor=False,
    ),
    ServoModel(
        name="XM430-W210-T",
        number=1030,
        ratings=_ratings((11.1, 2.7, 2.1, 70), (12.0, 3.0, 2.3, 77), (14.8, 3.7, 2.7, 95)),
        nominal_voltage_v=12.0,
        supply_range_v=(10.0, 14.8),
        gear_ratio=212.6,
        mass_kg=0.082,
        nominal_torque_nm=0.6,
        temperature_limit_c=80.0,
        standby_current_a=0.04,
        modes=_WITH_CURRENT,
        has_current_sensor=True,
        backlash_rad=_XM_BACKLASH_RAD,
    ),
    ServoModel(
        name="XM430-W350-T",
        number=1020,
        ratings=_ratings((11.1, 3.8, 2.1, 43), (12.0, 4.1, 2.3, 46), (14.8, 4.8, 2.7, 57)),
        nominal_voltage_v=12.0,
        supply_range_v=(10.0, 14.8),
        gear_ratio=353.5,
        mass_kg=0.082,
        nominal_torque_nm=0.82,
        temperature_limit_c=80.0,
        standby_current_a=0.04,
        modes=_WITH_CURRENT,
        has_current_sensor=True,
        backlash_rad=_XM_BACKLASH_RAD,
    ),
)

#: name → model.
SERVO_MODELS: Mapping[str, ServoModel] = {model.name: model for model in _MODELS}


def servo_model(name_or_number: str | int) -> ServoModel:
    """A servo model by the vendor's name or by its model number; BadInput suggests the nearest.

    The final `-T` (the TTL variant, which is all there is of these) may be left out, and case does not matter.
    """
    if isinstance(name_or_number, int):
        for model in SERVO_MODELS.values():
            if model.number == name_or_number:
                return model
        known = ", ".join(f"{model.number} ({model.name})" for model in SERVO_MODELS.values())
        raise BadInput(f"no servo model has the number {name_or_number}", remedy=f"known are {known}")
    wanted = name_or_number.strip().upper()
    for name, model in SERVO_MODELS.items():
        if wanted in (name, name.removesuffix("-T")):
            return model
    raise BadInput(f"no servo model is called {name_or_number!r}", remedy=_nearest(wanted, SERVO_MODELS, "the models"))
