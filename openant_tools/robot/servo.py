"""The servos of the Open Ant as data: control table and build, and what follows from them and the ratings in SI units."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from openant_tools.errors import BadInput
from openant_tools.robot import gains
from openant_tools.robot.control_table import control_table
from openant_tools.robot.gain_models import GAIN_MODELS, GainModel
from openant_tools.robot.gains import Rating
from openant_tools.robot.registers import PULSES_PER_TURN, PWM_FULL, RAD_PER_PULSE, RAD_S_PER_COUNT, Register

__all__ = [
    "BAUD_CODES", "HARDWARE_ERRORS", "PULSES_PER_TURN", "PWM_FULL", "RAD_PER_PULSE", "RAD_S_PER_COUNT", "SERVO_MODELS",
    "HardwareError", "Rating", "Register", "ServoModel", "baud_code", "hardware_errors", "servo_model",
]  # fmt: skip

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
        name: the vendor's.
        nominal_torque_nm: what it bears for long; a fifth of stall (Open Ant paper).
        temperature_limit_c: factory limit and end of the operating range.
        standby_current_a: what it draws at rest.
        backlash_rad: full play of the gear where the vendor states it.
        modes: the operating modes it has.
        rotor_inertia_kg_m2: of the motor before the gear. Not published; the size that fits a rotor of this class
            (some 16 mm wide, some grams), good to a factor of two. Identification replaces it.
        sheet: its ratings and what its gains count, as `gain_models` has them.
        registers: name → register.
    """

    name: str
    gear_ratio: float
    mass_kg: float
    nominal_torque_nm: float
    temperature_limit_c: float
    standby_current_a: float
    modes: tuple[int, ...]
    has_current_sensor: bool
    backlash_rad: float | None = None
    operating_minimum_c: float = -5.0
    rotor_inertia_kg_m2: float = 1e-7
    sheet: GainModel = field(init=False, repr=False, compare=False)
    registers: Mapping[str, Register] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sheet", GAIN_MODELS[self.name])
        object.__setattr__(self, "registers", control_table(self.name))

    @property
    def number(self) -> int:
        """What the register `model_number` reads."""
        return self.sheet.number

    @property
    def ratings(self) -> tuple[Rating, ...]:
        """The data sheet's lines, by rising voltage."""
        return self.sheet.ratings

    @property
    def rating(self) -> Rating:
        """The rating at the nominal voltage."""
        return self.sheet.rating

    @property
    def nominal_voltage_v(self) -> float:
        """The recommended supply, one of the ratings."""
        return self.sheet.nominal_voltage_v

    @property
    def supply_range_v(self) -> tuple[float, float]:
        """Lowest and highest supply, V."""
        return self.sheet.supply_range_v

    @property
    def position_p_divisor(self) -> float:
        """Counts of P per count of PWM and pulse; of the other two gains that are `gains.I_DIVISOR` and `gains.D_DIVISOR`."""
        return self.sheet.p_divisor

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

        As uncertain as the control period; a prior at best.
        """
        gain = self.register("position_d_gain").default if d_gain is None else d_gain
        assert gain is not None
        return gains.derivative_damping_nm_s_rad(
            gain, gains.D_DIVISOR, gains.CONTROL_PERIOD_S, self.stall_torque_at(supply_v)
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


_WITHOUT_CURRENT = (1, 3, 4, 16)
_WITH_CURRENT = (0, 1, 3, 4, 5, 16)
_XM_BACKLASH_RAD = math.radians(0.25)

# Source of every figure: ROBOTIS e-manual; the XC430's nominal torque is our fifth of stall, the paper gives none.
_MODELS = (
    ServoModel(
        name="XL430-W250-T",
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
