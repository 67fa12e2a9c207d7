"""Registers of a Dynamixel as the numbers of a MuJoCo `<position>` actuator, and wanted numbers as registers.

Each of the three pairs goes its own way: P gain ↔ kp, D gain ↔ kv, PWM limit ↔ forcerange. What is wanted is rounded to the
register's count, and every number that comes out is what the rounded registers give.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from openant_tools.errors import BadInput
from openant_tools.files import read_toml
from openant_tools.numbers import exact, literal
from openant_tools.robot import gains
from openant_tools.robot.config import Provenance
from openant_tools.robot.control_table import GAIN_MAX
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.gain_models import GainModel, Registers, SourcedFigure
from openant_tools.robot.gains import CONTROL_PERIOD_S, D_DIVISOR, I_DIVISOR
from openant_tools.robot.registers import PULSES_PER_TURN, PWM_FULL

__all__ = [
    "BackEmf", "Beside", "Constant", "Conversion", "Mjcf", "Wanted", "beside", "constants", "conversion", "identified",
    "registers_for", "to_mjcf",
]  # fmt: skip

#: Where a model has the servo's back-EMF: in the actuator's kv, or in the joint's damping.
BackEmf = Literal["kv", "joint"]
#: Beyond the maker's range by more than this no servo of the kind runs; within it some do (an XL330 at 7.4 V).
SUPPLY_SLACK = 0.5
#: MJCF number → the kinds of `identified.KIND.JOINT` that are it, together
IDENTIFIED: Mapping[str, tuple[str, ...]] = {
    "kp": ("stiffness",), "kv": ("velocity_gain", "damping"), "forcerange": ("torque_limit",),
}  # fmt: skip


@dataclass(frozen=True)
class Wanted:
    """Numbers of a model that the registers shall give; None where the register decides.

    Attributes:
        kp: N·m/rad.
        kv: N·m·s/rad.
        force_nm: the end of forcerange.
    """

    kp: float | None = None
    kv: float | None = None
    force_nm: float | None = None


@dataclass(frozen=True)
class Mjcf:
    """Numbers of a `<position>` actuator.

    Attributes:
        kp: N·m/rad.
        kv: N·m·s/rad, without what the joint's damping holds.
        damping: of the joint, N·m·s/rad: the back-EMF where it stands there, else 0.
        force_nm: the end of forcerange.
    """

    kp: float
    kv: float
    damping: float
    force_nm: float

    @property
    def saturates_at_rad(self) -> float | None:
        """The position error at which kp reaches the limit; None without stiffness."""
        return self.force_nm / self.kp if self.kp > 0 else None

    @property
    def lines(self) -> tuple[str, ...]:
        """As they stand in a model."""
        joint = (f'<joint damping="{literal(self.damping, 4)}"/>',) if self.damping else ()
        force = literal(self.force_nm, 4)
        return (
            *joint,
            f'<position kp="{literal(self.kp, 4)}" kv="{literal(self.kv, 4)}" forcerange="-{force} {force}"/>',
        )


@dataclass(frozen=True)
class Conversion:
    """One servo's registers beside the model's numbers that they give.

    Attributes:
        model: which servo.
        supply_v: at the servo.
        registers: given, as delivered, or rounded from what was wanted.
        wanted: what was.
        mjcf: what `registers` give by `model.p_divisor`.
        back_emf: where the model has it.
        by_divisor: each P divisor, the P gain by it, and the kp of that gain by it. The gain differs from that in `registers` only
            where kp was wanted.
        notes: what a reader should know.
    """

    model: GainModel
    supply_v: float
    registers: Registers
    wanted: Wanted
    mjcf: Mjcf
    back_emf: BackEmf
    by_divisor: tuple[tuple[SourcedFigure, int, float], ...]
    notes: tuple[str, ...]

    @property
    def stall_nm(self) -> float:
        """At the supply and full duty."""
        return gains.stall_torque_nm(self.model.ratings, self.supply_v)

    @property
    def back_emf_damping(self) -> float:
        return gains.back_emf_damping_nm_s_rad(self.model.rating)

    @property
    def derivative_damping(self) -> float:
        """The share of kv that the D gain makes."""
        return gains.derivative_damping_nm_s_rad(self.registers.position_d, D_DIVISOR, CONTROL_PERIOD_S, self.stall_nm)

    @property
    def ki(self) -> float:
        """N·m/(rad·s) of the I gain, which `<position>` has no word for."""
        return gains.integral_gain_nm_rad_s(self.registers.position_i, I_DIVISOR, CONTROL_PERIOD_S, self.stall_nm)

    def as_json(self) -> dict[str, Any]:
        """For `--json`: registers and MJCF numbers by their names, and where each constant comes from."""
        registers, mjcf = self.registers, self.mjcf
        asked = {"kp": self.wanted.kp, "kv": self.wanted.kv, "forcerange": self.wanted.force_nm}
        return {
            "motor": self.model.name,
            "supply_v": self.supply_v,
            "position_p": registers.position_p,
            "position_i": registers.position_i,
            "position_d": registers.position_d,
            "pwm_limit": registers.pwm_limit,
            "kp": mjcf.kp,
            "kv": mjcf.kv,
            "forcerange": [-mjcf.force_nm, mjcf.force_nm],
            "joint_damping": mjcf.damping,
            "back_emf": {"in": self.back_emf, "damping": self.back_emf_damping},
            "saturates_at_rad": mjcf.saturates_at_rad,
            "wanted": {name: value for name, value in asked.items() if value is not None},
            "by_p_divisor": [
                {"p_divisor": divisor.value, "position_p": p, "kp": kp, "used": k == 0, "source": divisor.source}
                for k, (divisor, p, kp) in enumerate(self.by_divisor)
            ],
            "constants": [
                {"quantity": one.quantity, **asdict(one.figure), "used": one.used}
                for one in constants(self.model, self.supply_v)
            ],
            "notes": list(self.notes),
        }


def to_mjcf(
    model: GainModel, registers: Registers, supply_v: float, back_emf: BackEmf = "kv", p_divisor: float | None = None
) -> Mjcf:
    """What registers give at a supply; formulas in `gains`.

    Args:
        p_divisor: other than the model's.
    """
    stall = gains.stall_torque_nm(model.ratings, supply_v)
    slope = gains.back_emf_damping_nm_s_rad(model.rating)
    derivative = gains.derivative_damping_nm_s_rad(registers.position_d, D_DIVISOR, CONTROL_PERIOD_S, stall)
    return Mjcf(
        kp=gains.stiffness_nm_rad(registers.position_p, p_divisor or model.p_divisor, stall),
        kv=derivative + (slope if back_emf == "kv" else 0.0),
        damping=slope if back_emf == "joint" else 0.0,
        force_nm=gains.torque_limit_nm(registers.pwm_limit, stall),
    )


def registers_for(
    model: GainModel,
    wanted: Wanted,
    supply_v: float,
    back_emf: BackEmf = "kv",
    *,
    base: Registers | None = None,
    p_divisor: float | None = None,
) -> Registers:
    """The registers that come nearest to what is wanted.

    Args:
        base: holds what nothing is wanted of; default the registers as delivered.
        p_divisor: other than the model's.

    Raises:
        BadInput: what no register gives; the line says what the servo can give.
    """
    registers, divisor = base or model.factory, p_divisor or model.p_divisor
    stall = gains.stall_torque_nm(model.ratings, supply_v)
    at = f"{model.name} at {exact(supply_v, 'V')}"
    if wanted.kp is not None:
        most = gains.stiffness_nm_rad(GAIN_MAX, divisor, stall)
        p = _count("kp", "N·m/rad", wanted.kp, gains.p_gain_for(wanted.kp, divisor, stall), most, GAIN_MAX, at)
        registers = replace(registers, position_p=p)
    if wanted.kv is not None:
        slope = gains.back_emf_damping_nm_s_rad(model.rating) if back_emf == "kv" else 0.0
        most = slope + gains.derivative_damping_nm_s_rad(GAIN_MAX, D_DIVISOR, CONTROL_PERIOD_S, stall)
        d = gains.d_gain_for(wanted.kv - slope, D_DIVISOR, CONTROL_PERIOD_S, stall)
        # A kv that was read off four digits may lie a hair below what the motor alone gives.
        if d < -0.5 and wanted.kv < slope * (1 - 1e-3):
            raise BadInput(
                f"kv {exact(wanted.kv, 'N·m·s/rad')} is less than the back-EMF of {at}, {literal(slope, 4)}, which no register takes away",
                remedy="ask for that or more, or, where the model's joint damping holds it, add --back-emf joint",
            )
        d_count = _count("kv", "N·m·s/rad", wanted.kv, max(d, 0.0), most, GAIN_MAX, at, may_be_zero=True)
        registers = replace(registers, position_d=d_count)
    if wanted.force_nm is not None:
        limit = gains.pwm_limit_for(wanted.force_nm, stall)
        pwm = _count("forcerange", "N·m", wanted.force_nm, limit, stall, PWM_FULL, at)
        registers = replace(registers, pwm_limit=pwm)
    return registers


def _count(
    name: str,
    unit: str,
    value: float,
    unrounded: float,
    most: float,
    largest: int,
    at: str,
    *,
    may_be_zero: bool = False,
) -> int:
    """`unrounded` as a register's count, or the line that says why it is none."""
    count = round(unrounded)
    if count > largest:
        raise BadInput(
            f"{name} {exact(value, unit)} is more than {at} can give", remedy=f"ask for {_below(most)} or less"
        )
    if count < 1 and not may_be_zero:
        raise BadInput(
            f"{name} {exact(value, unit)} is less than one count of the register gives on {at}",
            remedy=f"ask for {literal(most / largest, 2)} or more",
        )
    return count


def _below(most: float) -> str:
    """Four digits that are no more than `most`."""
    text = literal(most, 4)
    return text if float(text) <= most else literal(most * (1 - 5e-4), 4)


def conversion(
    model: GainModel, base: Registers, wanted: Wanted, supply_v: float, back_emf: BackEmf = "kv"
) -> Conversion:
    """Registers and MJCF numbers of one servo side by side.

    Args:
        base: registers that were given, as delivered where none was.
        wanted: takes the place of its register.

    Raises:
        BadInput: a supply at which it does not run, a register beyond its range, or a number that no register gives.
    """
    notes = [*_supply_notes(model, supply_v)]
    _check(base)
    registers = registers_for(model, wanted, supply_v, back_emf, base=base)
    by_divisor = []
    for divisor in model.p_divisors:
        p = registers.position_p
        if wanted.kp is not None:
            try:
                p = registers_for(
                    model, Wanted(kp=wanted.kp), supply_v, back_emf, base=base, p_divisor=divisor.value
                ).position_p
            except BadInput as error:
                notes.append(f"by a P divisor of {exact(divisor.value)}: {error.what}")
                continue
        kp = to_mjcf(model, replace(registers, position_p=p), supply_v, back_emf, divisor.value).kp
        by_divisor.append((divisor, p, kp))
    if registers.position_i:
        notes.append("position_i is not 0: it presses on while an error stands, and <position> has no such term")
    if registers.position_d:
        notes.append(
            "what the D gain gives is as good as the assumed control period of 1 ms; a shorter one gives less in proportion"
        )
    if len(model.p_divisors) == 1:
        notes.append(
            "the P divisor of this model is the manual's and was not measured as far as we know; on an XL330 it is twice as much"
        )
    notes.append(
        "rotor inertia and gear friction are not published: armature and frictionloss come out of `openant sysid fit`"
    )
    mjcf = to_mjcf(model, registers, supply_v, back_emf)
    return Conversion(model, supply_v, registers, wanted, mjcf, back_emf, tuple(by_divisor), (*notes, *model.remarks))


def _supply_notes(model: GainModel, supply_v: float) -> Iterator[str]:
    low, high = model.supply_range_v
    allowed = f"{exact(low)} to {exact(high, 'V')}"
    if not low * (1 - SUPPLY_SLACK) <= supply_v <= high * (1 + SUPPLY_SLACK):
        raise BadInput(
            f"an {model.name} does not run at {exact(supply_v, 'V')}",
            remedy=f"its maker allows {allowed}; give the volts at the servo",
        )
    if not low <= supply_v <= high:
        yield f"{exact(supply_v, 'V')} is beyond what the maker allows, {allowed}: the torque there is extrapolated"


def _check(registers: Registers) -> None:
    for name, count, least, most in (
        ("position-p", registers.position_p, 0, GAIN_MAX),
        ("position-i", registers.position_i, 0, GAIN_MAX),
        ("position-d", registers.position_d, 0, GAIN_MAX),
        ("pwm-limit", registers.pwm_limit, 1, PWM_FULL),
    ):
        if not least <= count <= most:
            raise BadInput(f"--{name} cannot be {count}", remedy=f"give it counts from {least} to {most}")


@dataclass(frozen=True)
class Constant:
    """A constant of a servo, and whether the numbers of a `Conversion` rest on it; what does not is there to be compared."""

    quantity: str
    figure: SourcedFigure
    used: bool


def constants(model: GainModel, supply_v: float) -> list[Constant]:
    """Every constant with what is said of it and by whom, the used one of a quantity first."""
    sheet = f"manual: {model.url}, Specifications"
    pid = f"manual: {model.url}, Position PID Gain(80, 82, 84)"
    ratings, rating = model.ratings, model.rating
    line = f"at {exact(rating.voltage_v, 'V')}"
    derived = f"derived of the line {line}"
    if any(one.voltage_v == supply_v for one in ratings):
        stall = f"{sheet}, at {exact(supply_v, 'V')}"
    else:
        torques = " / ".join(exact(one.stall_torque_nm) for one in ratings)
        volts = " / ".join(exact(one.voltage_v) for one in ratings)
        stall = f"derived: torque per volt of the nearest lines times {exact(supply_v, 'V')}; {sheet}, {torques} N·m at {volts} V"
    found = [
        Constant("stall torque", SourcedFigure(gains.stall_torque_nm(ratings, supply_v), "N·m", stall), True),
        Constant("no-load speed", SourcedFigure(rating.no_load_rad_s, "rad/s", f"{sheet}, {line}"), True),
        Constant(
            "back-EMF damping",
            SourcedFigure(
                gains.back_emf_damping_nm_s_rad(rating), "N·m·s/rad", f"{derived}: τ_stall / ω_no-load, at any supply"
            ),
            True,
        ),
        *(Constant("P divisor", figure, k == 0) for k, figure in enumerate(model.p_divisors)),
        Constant("I divisor", SourcedFigure(I_DIVISOR, "1", pid), True),
        Constant("D divisor", SourcedFigure(D_DIVISOR, "1", pid), True),
        Constant(
            "control period",
            SourcedFigure(
                CONTROL_PERIOD_S,
                "s",
                "assumed: not published; of velocity control ROBOTIS says much faster than 1 kHz (DynamixelSDK issue 534)",
            ),
            True,
        ),
        Constant("PWM full range", SourcedFigure(PWM_FULL, "counts", f"manual: {model.url}, PWM Limit(36)"), True),
        Constant("pulses per turn", SourcedFigure(PULSES_PER_TURN, "pulses", sheet), True),
        *(
            Constant(
                f"{letter} gain as delivered",
                SourcedFigure(count, "counts", f"manual: {model.url}, Control Table"),
                True,
            )
            for letter, count in (
                ("P", model.factory.position_p),
                ("I", model.factory.position_i),
                ("D", model.factory.position_d),
            )
        ),
        Constant("stall current", SourcedFigure(rating.stall_current_a, "A", f"{sheet}, {line}"), False),
    ]
    kt, ke, resistance = (
        law(rating) for law in (gains.torque_constant_nm_a, gains.emf_constant_v_s_rad, gains.resistance_ohm)
    )
    compared = {
        "torque constant kt": (SourcedFigure(kt, "N·m/A", f"{derived}: τ_stall / I_stall"),),
        "EMF constant ke": (
            SourcedFigure(ke, "V·s/rad", f"{derived}: V / ω_no-load; kt but for friction and rounding"),
        ),
        "resistance R": (SourcedFigure(resistance, "Ω", f"{derived}: V / I_stall"),),
    }
    for quantity in dict.fromkeys((*compared, *model.measured)):
        figures = (*compared.get(quantity, ()), *model.measured.get(quantity, ()))
        found += [Constant(quantity, figure, False) for figure in figures]
    return found


@dataclass(frozen=True)
class Beside:
    """A number of the data sheet's and what was identified of one joint.

    Attributes:
        joint: of the robot.
        name: `kp`, `kv` or `forcerange`.
        sheet: of the conversion. For kv with all back-EMF in it, wherever the model has that.
        value: what `robot.toml` holds, in the same unit: of kv velocity gain and joint damping together.
        low, high: its 95 % interval; None where the file states none, or it is a sum.
        how: where it came from.
    """

    joint: str
    name: str
    sheet: float
    value: float
    low: float | None
    high: float | None
    how: str


def identified(folder: RobotFolder) -> dict[str, dict[str, float]]:
    """kind → joint → value of what was identified, as `robot.toml` has it.

    Raises:
        BadInput: a value that is no number.
    """
    found: dict[str, dict[str, float]] = {}
    table = read_toml(folder.config_file).get("identified", {})
    for kind, by_joint in table.items() if isinstance(table, Mapping) else ():
        for joint, value in by_joint.items() if isinstance(by_joint, Mapping) else ():
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise BadInput(
                    f"identified.{kind}.{joint} is no number",
                    where=folder.config_file,
                    remedy="correct it, or identify again",
                )
            found.setdefault(str(kind), {})[str(joint)] = float(value)
    return found


def _origin(origin: Provenance | None) -> str:
    if origin is None:
        return "of unknown origin"
    return f"{origin.how} in {origin.recording}" if origin.recording else origin.how


def beside(result: Conversion, folder: RobotFolder) -> list[Beside]:
    """What was identified of the robot's joints that this servo drives, beside the data sheet's numbers."""
    config, known = folder.config(), identified(folder)
    mjcf = result.mjcf
    sheet = {"kp": mjcf.kp, "kv": mjcf.kv + mjcf.damping, "forcerange": mjcf.force_nm}
    rows: list[Beside] = []
    for joint, motor in config.motors.items():
        if motor.model != result.model.name:
            continue
        for name, kinds in IDENTIFIED.items():
            parts = {kind: known[kind][joint] for kind in kinds if joint in known.get(kind, {})}
            if not parts:
                continue
            origins = {kind: config.provenance_of(f"identified.{kind}.{joint}") for kind in parts}
            single = origins[next(iter(parts))] if len(parts) == 1 else None
            words = [f"{kind} {literal(value, 4)}, {_origin(origins[kind])}" for kind, value in parts.items()]
            rows.append(
                Beside(
                    joint, name, sheet[name], sum(parts.values()), single.low if single else None,
                    single.high if single else None, _origin(single) if len(parts) == 1 else " + ".join(words),
                )
            )  # fmt: skip
    return rows
