"""The numbers of a LeRobot dataset as angles: in which unit they are, which no dataset says, and what of the calibration enters.

LeRobot reads counts, p, and writes with a joint's calibrated range (a, b), its middle m = (a + b) / 2, a turn of 4096 counts:
    degrees        (p − m) · 360 / 4095            whatever the joint's `drive_mode`
    −100 … 100     (p − a) / (b − a) · 200 − 100   its negative where `drive_mode` is 1 (Feetech)
    0 … 100        (p − a) / (b − a) · 100         100 less it where `drive_mode` is 1; a gripper, whatever the others are in
and cuts the latter two off at their ends. `homing_offset` stands in the servo, and so in p already. An angle of ours is
(p − m) · 2π / 4096: zero in the middle of the range, counted as the servo counts; from one robot the same in either unit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.files import read_json
from openant_tools.numbers import number
from openant_tools.recording.run import Array

__all__ = [
    "RESOLUTION_RAD",
    "MotorRange",
    "SeenRange",
    "Unit",
    "UnitScale",
    "joint_scale",
    "joint_units",
    "read_calibration",
]

Unit = Literal["degrees", "normalised", "radians", "percent"]

#: of a turn of the STS3215 and of every Dynamixel X
COUNTS = 4096
RESOLUTION_RAD = 2.0 * math.pi / COUNTS
#: what LeRobot calls its robots whose servos it reads itself: never in radians
IN_TURNS = ("so100", "so101", "so_", "bi_so", "koch", "omx", "lekiwi", "hope_jr", "openarm")
#: its robots of Dynamixels, which turn backwards by themselves where `drive_mode` says so
DYNAMIXEL = ("koch", "omx")
#: counts by which a position may be off a whole one: 32 bits keep it a hundred times better
OFF_COUNT = 0.01
#: different positions without which nothing is said of counts, and how many are looked at
FEW, MANY = 10, 2000
#: of a unit, beyond which a number lies outside of it; one that stands at its end was cut off there
BEYOND = 1e-3


@dataclass(frozen=True)
class MotorRange:
    """A joint's entry in the calibration: the counts between which it moves, and whether LeRobot turns its sign."""

    low: int
    high: int
    reversed: bool


@dataclass(frozen=True)
class UnitScale:
    """How a number becomes an angle: (number − middle) · per_unit, in rad."""

    per_unit: float
    middle: float = 0.0

    def __call__(self, numbers: Array) -> Array:
        return (numbers - self.middle) * self.per_unit


@dataclass
class SeenRange:
    """What a whole dataset shows of one joint.

    Attributes:
        low, high: of its positions and commands.
        positions: (≤ MANY,) different ones.
        rows, at_end: how many there are, and how many stand at an end of a normalised range.
    """

    gripper: bool
    low: float = math.inf
    high: float = -math.inf
    positions: Array = field(default_factory=lambda: np.zeros(0))
    rows: int = 0
    at_end: int = 0

    def add(self, positions: Array, commands: Array) -> None:
        """Take in (n,) positions and commands."""
        self.low = min(self.low, float(positions.min()), float(commands.min()))
        self.high = max(self.high, float(positions.max()), float(commands.max()))
        if len(self.positions) < MANY:
            self.positions = np.unique(np.concatenate([self.positions, positions]))[:MANY]
        self.rows += len(positions)
        ends = (0.0, 100.0) if self.gripper else (-100.0, 100.0)
        self.at_end += int(np.isin(positions, ends).sum())

    @property
    def in_percent(self) -> bool:
        """Whether it is a gripper in 0 … 100, as LeRobot has them whatever the others are in."""
        return self.gripper and self.low >= -BEYOND and self.high <= 100.0 + BEYOND

    def whole(self, unit: Unit, span: MotorRange | None) -> bool | None:
        """Whether its positions are whole counts if they are in `unit`; None where that cannot be told."""
        if unit == "radians" or len(self.positions) < FEW or (unit != "degrees" and span is None):
            return None
        if unit == "degrees" or span is None:
            # Half counts, as the middle of a range may lie between two; datasets of v2.0 divide by 4096.
            steps = [self.positions * (2.0 * turn / 360.0) for turn in (COUNTS - 1, COUNTS)]
        elif unit == "percent":
            steps = [self.positions * (span.high - span.low) / 100.0]
        else:
            steps = [(self.positions + 100.0) * (span.high - span.low) / 200.0]
        return any(bool((np.abs(one - np.round(one)) < OFF_COUNT).all()) for one in steps)


def read_calibration(path: Path) -> dict[str, MotorRange]:
    """The robot's calibration, as LeRobot keeps it in `~/.cache/huggingface/lerobot/calibration/robots/KIND/ID.json`.

    Raises:
        BadInput: an entry lacks a number, or has one that cannot be; the joint and the key are named.
        OSError: it cannot be read.
    """
    remedy = "give the file that LeRobot wrote when this robot was calibrated"
    content = read_json(path, remedy)
    if not isinstance(content, dict) or not content:
        raise BadInput("is no calibration: an object, joint → entry", where=path, remedy=remedy)
    ranges = {}
    for joint, entry in content.items():
        where = f"{path}, {joint}"
        if not isinstance(entry, dict):
            raise BadInput("the entry is no object", where=where, remedy=remedy)
        values = {}
        for key in ("drive_mode", "range_min", "range_max"):
            value = entry.get(key)
            if isinstance(value, bool) or not isinstance(value, int) or not abs(value) < 2**31:
                raise BadInput(f"`{key}` is {str(value)[:40]}, not a whole number", where=where, remedy=remedy)
            values[key] = value
        if not values["range_min"] < values["range_max"] or values["drive_mode"] not in (0, 1):
            raise BadInput(
                f"the range {values['range_min']} … {values['range_max']} with drive mode {values['drive_mode']} cannot be",
                where=where,
                remedy="calibrate the joint again: through its whole range, and its drive mode is 0 or 1",
            )
        ranges[joint] = MotorRange(values["range_min"], values["range_max"], values["drive_mode"] == 1)
    return ranges


def joint_units(
    seen: Mapping[str, SeenRange], spans: Mapping[str, MotorRange | None], robot: str, said: Unit | None = None
) -> tuple[dict[str, Unit], bool]:
    """The unit of each joint, and whether the numbers themselves, or the user, say so.

    A gripper is in percent. All others are in one unit: in that in which their positions are whole counts; else, beyond ±100,
    in degrees; else normalised where there is a calibration, and in degrees where there is none.

    Args:
        seen: of each joint. spans: of each joint, None where there is no calibration.
        robot: LeRobot's name of its kind. said: the unit of all but grippers.

    Raises:
        BadInput: they may be radians, or are normalised and there is no calibration.
    """
    body = [joint for joint, one in seen.items() if not one.in_percent]
    unit, certain = (
        (said, True) if said is not None else _body_unit([seen[j] for j in body], [spans[j] for j in body], robot)
    )
    if unit == "radians":
        return dict.fromkeys(seen, unit), certain
    return {joint: unit if joint in body else "percent" for joint in seen}, certain


def _body_unit(seen: Sequence[SeenRange], spans: Sequence[MotorRange | None], robot: str) -> tuple[Unit, bool]:
    if not seen:
        return "normalised", True
    units: tuple[Unit, ...] = ("degrees", "normalised")
    for unit in units:
        known = [whole for one, span in zip(seen, spans, strict=True) if (whole := one.whole(unit, span)) is not None]
        if known and all(known):
            return unit, True
    reach = max(max(-one.low, one.high) for one in seen)
    if reach > 100.0 + BEYOND:
        return "degrees", True
    if None not in spans:
        return "normalised", False
    if reach <= 2.0 * math.pi and not robot.startswith(IN_TURNS):
        raise BadInput(
            f"no number leaves ±{number(reach)}: these may be radians or degrees",
            remedy="say which: --units radians|degrees",
        )
    if any(one.at_end for one in seen):
        raise BadInput(
            "joints stand at exactly ±100: these are normalised units, no angles without the robot's calibration",
            remedy="add --calibration FILE (~/.cache/huggingface/lerobot/calibration/robots/KIND/ID.json), or --units degrees",
        )
    return "degrees", False


def joint_scale(unit: Unit, span: MotorRange | None, robot: str) -> UnitScale | None:
    """How a joint's numbers become angles; None where that takes its calibration."""
    if unit == "radians":
        return UnitScale(1.0)
    if unit == "degrees":
        return UnitScale(math.pi / 180.0)
    if span is None:
        return None
    turned = -1.0 if span.reversed and not robot.startswith(DYNAMIXEL) else 1.0
    whole = turned * (span.high - span.low) * RESOLUTION_RAD
    return UnitScale(whole / 100.0, 50.0) if unit == "percent" else UnitScale(whole / 200.0)
