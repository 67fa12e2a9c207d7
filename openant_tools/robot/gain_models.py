"""Dynamixel servos as far as their gains go: what each needs for `gains`, and who says so.

This is the only table of ratings and divisors: `servo` has what else is known of those that the Open Ant uses. The others are here
for their gains only: nothing assigns them an ID, drives or simulates them, and no joint of a `robot.toml` can name them.

Figures and factory settings are the e-manual's (the page of each model: Specifications, Control Table). What others measured stands
beside it. A measured P divisor is used before the manual's, since Present PWM over position error needs no data sheet.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from openant_tools.errors import BadInput
from openant_tools.robot.control_table import control_table
from openant_tools.robot.gains import P_DIVISOR, Rating
from openant_tools.robot.registers import PWM_FULL

__all__ = ["GAIN_MODELS", "GainModel", "Registers", "SourcedFigure", "gain_model"]

_RPM = 2 * math.pi / 60
_MANUAL = "https://emanual.robotis.com/docs/en/dxl/"


@dataclass(frozen=True)
class SourcedFigure:
    """A number, its unit, and who says so."""

    value: float
    unit: str
    source: str


@dataclass(frozen=True)
class Registers:
    """What the servo holds, in counts: gains of position mode (84, 82, 80) and PWM limit (36)."""

    position_p: int
    position_i: int = 0
    position_d: int = 0
    pwm_limit: int = PWM_FULL


@dataclass(frozen=True)
class GainModel:
    """One servo model, as far as gains go.

    Attributes:
        name, number: the vendor's name, and what the register `model_number` reads.
        page: its page of the e-manual, below `docs/en/dxl/`.
        ratings: the data sheet's lines, by rising voltage.
        nominal_voltage_v: the recommended supply, one of the ratings.
        supply_range_v: lowest and highest supply that the maker allows.
        factory: registers as delivered.
        p_divisors: counts of P per count of PWM and pulse; the first is used.
        measured: quantity → what was measured of it. Shown, not used.
        remarks: what a reader of the numbers should know of this model.
    """

    name: str
    number: int
    page: str
    ratings: tuple[Rating, ...]
    nominal_voltage_v: float
    supply_range_v: tuple[float, float]
    factory: Registers
    p_divisors: tuple[SourcedFigure, ...]
    measured: Mapping[str, tuple[SourcedFigure, ...]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    @property
    def url(self) -> str:
        return f"{_MANUAL}{self.page}/"

    @property
    def rating(self) -> Rating:
        """The rating at the nominal voltage."""
        return next(rating for rating in self.ratings if rating.voltage_v == self.nominal_voltage_v)

    @property
    def p_divisor(self) -> float:
        """The one that is used."""
        return self.p_divisors[0].value


def _divisors(page: str, *measured: tuple[float, str]) -> tuple[SourcedFigure, ...]:
    manual = SourcedFigure(P_DIVISOR, "1", f"manual: {_MANUAL}{page}/, Position PID Gain(80, 82, 84)")
    return (*(SourcedFigure(value, "1", f"measured: {source}") for value, source in measured), manual)


_XL330 = (
    "an XL330-M288: Rhoban/bam, bam/dynamixel/actuator.py; Present PWM over position error in nine of its recordings gives "
    "255 to 267"
)
_V2 = "parkgeon1202/bam, bam/dynamixel/actuator.py, Present PWM over position error at P 100 to 800"
_WEIGHED = (
    "kitchen scale: Open Ant paper, Motor Stiffness; at factory gains as far as known, and doubtful, as it is more than the stall "
    "torque over the steps of 0.1 rad that it speaks of"
)


def _bam(
    name: str, kt: tuple[float, float], ohm: tuple[float, float], what: str
) -> dict[str, tuple[SourcedFigure, ...]]:
    """kt and R that Rhoban/bam fitted to a pendulum: with constant friction (m1), and with friction that grows with load (m6)."""
    return {
        quantity: tuple(
            SourcedFigure(value, unit, f"fitted: Rhoban/bam, bam/params/{name}/{law}.json, {what}")
            for value, law in zip(values, ("m1", "m6"), strict=True)
        )
        for quantity, unit, values in (("torque constant kt", "N·m/A", kt), ("resistance R", "Ω", ohm))
    }


_SLOPE_5V = (
    "PWM Slope(62) lets the duty rise by 0.277 V/ms as delivered: full duty takes 18 ms at 5 V, which neither kp nor kv has",
)
_SLOPE_12V = (
    "PWM Slope(62) lets the duty rise by 1.01 V/ms as delivered: full duty takes 12 ms at 12 V, which neither kp nor kv has",
)
_PROTOCOL_2 = (
    "with the firmware of Protocol 2; with that of Protocol 1 (another model number) the gains are other registers, in other units",
)


def _model(
    name: str,
    number: int,
    page: str,
    lines: tuple[tuple[float, float, float, float], ...],
    nominal_v: float,
    supply_range_v: tuple[float, float],
    factory: Registers,
    *divisors: tuple[float, str],
    measured: Mapping[str, tuple[SourcedFigure, ...]] | None = None,
    remarks: tuple[str, ...] = (),
) -> GainModel:
    """An entry; `lines` are (V, stall N·m, stall A, no-load rpm) as data sheets print them."""
    ratings = tuple(Rating(volts, torque, current, rpm * _RPM) for volts, torque, current, rpm in lines)
    return GainModel(
        name,
        number,
        page,
        ratings,
        nominal_v,
        supply_range_v,
        factory,
        _divisors(page, *divisors),
        measured or {},
        remarks,
    )


def _delivered(name: str) -> Registers:
    """The gains as delivered of a servo whose whole control table is known."""
    table = control_table(name)
    return Registers(*(table[f"position_{letter}_gain"].default or 0 for letter in "pid"))


def _weighed(stiffness: float) -> dict[str, tuple[SourcedFigure, ...]]:
    return {"stiffness": (SourcedFigure(stiffness, "N·m/rad", _WEIGHED),)}


_5V, _11V, _12V = (3.7, 6.0), (6.5, 12.0), (10.0, 14.8)
_OF_THE_ANT = (
    _model(
        "XL430-W250-T", 1060, "x/xl430-w250",
        ((9.0, 1.0, 1.0, 47), (11.1, 1.4, 1.3, 57), (12.0, 1.5, 1.4, 61)),
        11.1, _11V, _delivered("XL430-W250-T"), measured=_weighed(19.499),
    ),
    _model(
        "XC430-W240-T", 1080, "x/xc430-w240",
        ((9.0, 1.4, 1.1, 52), (11.1, 1.7, 1.3, 65), (12.0, 1.9, 1.4, 70)),
        12.0, (6.5, 14.8), _delivered("XC430-W240-T"),
    ),
    _model(
        "XM430-W210-T", 1030, "x/xm430-w210",
        ((11.1, 2.7, 2.1, 70), (12.0, 3.0, 2.3, 77), (14.8, 3.7, 2.7, 95)),
        12.0, _12V, _delivered("XM430-W210-T"),
    ),
    _model(
        "XM430-W350-T", 1020, "x/xm430-w350",
        ((11.1, 3.8, 2.1, 43), (12.0, 4.1, 2.3, 46), (14.8, 4.8, 2.7, 57)),
        12.0, _12V, _delivered("XM430-W350-T"), measured=_weighed(18.638),
    ),
)  # fmt: skip
_GAINS_ONLY = (
    _model(
        "XL330-M077-T", 1190, "x/xl330-m077",
        ((3.7, 0.180, 1.11, 278), (5.0, 0.215, 1.47, 383), (6.0, 0.228, 1.74, 456)),
        5.0, _5V, Registers(400, 400, 0), (256.0, _XL330), remarks=_SLOPE_5V,
    ),
    _model(
        "XL330-M288-T", 1200, "x/xl330-m288",
        ((3.7, 0.42, 1.11, 76), (5.0, 0.52, 1.47, 103), (6.0, 0.60, 1.74, 123)),
        5.0, _5V, Registers(400), (256.0, _XL330),
        measured=_bam("xl330", (0.387, 0.366), (4.02, 2.81), "at 7.5 V"), remarks=_SLOPE_5V,
    ),
    _model(
        "XC330-M181-T", 1230, "x/xc330-m181",
        ((3.7, 0.52, 1.34, 95), (5.0, 0.60, 1.80, 129), (6.0, 0.66, 2.15, 155)),
        5.0, _5V, Registers(1200, 0, 500), remarks=_SLOPE_5V,
    ),
    _model(
        "XC330-M288-T", 1240, "x/xc330-m288",
        ((3.7, 0.69, 1.34, 59), (5.0, 0.93, 1.80, 81), (6.0, 1.10, 2.15, 97)),
        5.0, _5V, Registers(1100, 0, 500), remarks=_SLOPE_5V,
    ),
    _model(
        "XC330-T181-T", 1210, "x/xc330-t181",
        ((9.0, 0.65, 0.61, 83), (11.1, 0.76, 0.80, 104), (12.0, 0.80, 0.88, 113)),
        11.1, _11V, Registers(900), remarks=_SLOPE_12V,
    ),
    _model(
        "XC330-T288-T", 1220, "x/xc330-t288",
        ((9.0, 0.76, 0.61, 52), (11.1, 0.92, 0.80, 65), (12.0, 1.00, 0.88, 71)),
        11.1, _11V, Registers(900), remarks=_SLOPE_12V,
    ),
    _model(
        "XM540-W150-T", 1130, "x/xm540-w150",
        ((11.1, 6.9, 4.2, 50), (12.0, 7.3, 4.4, 53), (14.8, 8.9, 5.5, 66)),
        12.0, _12V, Registers(800),
    ),
    _model(
        "XM540-W270-T", 1120, "x/xm540-w270",
        ((11.1, 10.0, 4.2, 28), (12.0, 10.6, 4.4, 30), (14.8, 12.9, 5.5, 37)),
        12.0, _12V, Registers(800),
    ),
    _model(
        "MX-28(2.0)", 30, "mx/mx-28-2",
        ((11.1, 2.3, 1.3, 50), (12.0, 2.5, 1.4, 55), (14.8, 3.1, 1.7, 67)),
        12.0, _12V, Registers(850), remarks=_PROTOCOL_2,
    ),
    _model(
        "MX-64(2.0)", 311, "mx/mx-64-2",
        ((11.1, 5.5, 3.9, 58), (12.0, 6.0, 4.1, 63), (14.8, 7.3, 5.2, 78)),
        12.0, _12V, Registers(850), (141.3, f"one MX-64(2.0): {_V2}, 140.8 to 142.2"),
        measured=_bam("mx64", (1.62, 1.60), (3.95, 2.32), "firmware of Protocol 1, at 15 V"), remarks=_PROTOCOL_2,
    ),
    _model(
        "MX-106(2.0)", 321, "mx/mx-106-2",
        ((11.1, 8.0, 4.8, 41), (12.0, 8.4, 5.2, 45), (14.8, 10.0, 6.3, 55)),
        12.0, _12V, Registers(850), (147.0, f"one MX-106(2.0): {_V2}, 144.7 to 149.0"),
        measured=_bam("mx106", (2.19, 2.21), (2.96, 2.03), "firmware of Protocol 1, at 15 V"), remarks=_PROTOCOL_2,
    ),
)  # fmt: skip

#: name → model, those of the Open Ant first.
GAIN_MODELS: Mapping[str, GainModel] = {model.name: model for model in (*_OF_THE_ANT, *_GAINS_ONLY)}


def _key(name: str) -> str:
    return re.sub(r"[^A-Z0-9]", "", name.upper())


def _names(model: GainModel) -> Iterator[str]:
    """How a model may be called: as the maker does, with or without the ending that says how it is wired."""
    stem = _key(model.name.removesuffix("(2.0)").removesuffix("-T"))
    yield from (stem, f"{stem}T", f"{stem}R", f"{stem}TR")
    if model.name.startswith("MX"):
        yield from (f"{stem}AT", f"{stem}AR", f"{stem}2", f"{stem}20")


def gain_model(name: str) -> GainModel:
    """A model by the maker's name or by its model number; case, hyphens and the ending for its wiring (-T, -R) do not matter.

    Raises:
        BadInput: no such model, or several; the line names those that it may be.
    """
    wanted = _key(name).removeprefix("DYNAMIXEL")
    for model in GAIN_MODELS.values():
        if wanted in _names(model) or wanted == str(model.number):
            return model
    alike = [model.name for model in GAIN_MODELS.values() if wanted and _key(model.name).startswith(wanted)]
    if alike:
        raise BadInput(f"{name} is more than one servo", remedy=f"name {' or '.join(alike)}")
    raise BadInput(f"no gains are known of a servo {name!r}", remedy=f"known are {', '.join(GAIN_MODELS)}")
