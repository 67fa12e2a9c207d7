"""Floor friction from a tilted plate: at the angle where the robot begins to slide, μ = tan α.

Two angles mean two numbers. Tilted slowly from level, the robot holds until the static coefficient is reached; pushed or
tapped, it keeps sliding without growing faster at the angle of the kinetic one. MuJoCo's contact has one sliding
coefficient, and what decides a gait is feet that slip: the kinetic one.

With an IMU on the robot, tan α is the ratio of what the accelerometer reads along the plate to what it reads across it.
While the robot slides the ratio is that of friction to normal force, which is not above the static coefficient. So the
largest ratio of a trial is the onset, wherever the plate goes afterwards.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.sysid.bench.knee_torque import GRAVITY_M_S2
from openant_tools.sysid.bench.readings import reading_rows

__all__ = [
    "BODY_UP", "Coefficient", "Kind", "Slope", "checked", "coefficient", "friction_finding", "onset_angle", "read_slopes",
    "up_direction",
]  # fmt: skip

Array = NDArray[np.float64]
Kind = Literal["static", "kinetic"]

BODY_UP = np.array([0.0, 0.0, 1.0])
#: A robot on its feet topples before: its feet stand some 0.25 m from the centre, 0.15 m below it.
STEEPEST_RAD = math.radians(58)
#: at rest the accelerometer reads gravity; further off than this its scale is wrong
GRAVITY_TOLERANCE = 0.08
#: s over which the accelerometer is smoothed: longer than a shock of the plate, shorter than the slide begins
SMOOTHING_S = 0.2
#: steel on wet ice
LEAST_FRICTION = 0.02
#: two-sided confidence of intervals
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Slope:
    """One reading of the plate's angle (rad): where sliding began, or where it kept on."""

    angle_rad: float
    kind: Kind


@dataclass(frozen=True)
class Coefficient:
    """A friction coefficient and its 95 % interval; None where one reading leaves it open."""

    value: float
    low: float | None
    high: float | None
    readings: int


def checked(angle_rad: float, where: str) -> float:
    """The angle, or BadInput where no plate was tilted so."""
    if not 0 < angle_rad <= STEEPEST_RAD:
        raise BadInput(
            f"a plate at {number(angle_rad, 'rad', decimals=0)}",
            where=where,
            remedy="give its angle from level, at most 57°, with its unit: write 31deg. On a steeper one the robot topples",
        )
    return angle_rad


def coefficient(angles_rad: Sequence[float], resolution_rad: float = math.radians(0.5)) -> Coefficient:
    """μ = tan α over several readings: mean, with Student's t for their scatter and the instrument's resolution.

    Args:
        angles_rad: (n,) readings.
        resolution_rad: smallest step of the instrument; its rounding is uniform and shared by equal readings.
    """
    from scipy import stats

    mu = np.tan(np.asarray(angles_rad, float))
    mean, n = float(mu.mean()), len(mu)
    if n < 2:
        return Coefficient(mean, None, None, n)
    scatter = float(stats.t.ppf(0.5 + CONFIDENCE / 2, n - 1) * mu.std(ddof=1) / math.sqrt(n))
    rounding = float(stats.norm.ppf(0.5 + CONFIDENCE / 2)) * resolution_rad / math.sqrt(12) * (1 + mean**2)
    half = math.hypot(scatter, rounding)
    return Coefficient(mean, max(0.0, mean - half), mean + half, n)


def up_direction(acc: Array) -> Array:
    """(3,) unit vector away from the ground, in the body's frame, from (n, 3) m/s² at rest.

    Raises:
        BadInput: no samples, or they are not gravity.
    """
    samples = acc[np.isfinite(acc).all(axis=1)]
    if not len(samples):
        raise BadInput(
            "the accelerometer said nothing",
            remedy="plug the flight controller in and name it in robot.toml, ports.imu",
        )
    mean = samples.mean(axis=0)
    norm = float(np.linalg.norm(mean))
    if abs(norm / GRAVITY_M_S2 - 1) > GRAVITY_TOLERANCE:
        raise BadInput(
            f"at rest the accelerometer reads {number(norm, 'm/s²', decimals=2)}",
            remedy="keep the plate still, or calibrate the accelerometer's scale",
        )
    return np.asarray(mean / norm)


def onset_angle(t: Array, acc: Array, up: Array = BODY_UP) -> float:
    """rad, the largest angle between specific force and the plate's normal in one slow trial.

    Args:
        t: (n,) s.
        acc: (n, 3) m/s² in the body's frame, NaN where there was no sample.
        up: the plate's normal in that frame: `up_direction` on the level plate, so that no mounting error enters.

    Raises:
        BadInput: fewer samples than the smoothing needs.
    """
    good = np.isfinite(acc).all(axis=1)
    t, acc = t[good], acc[good]
    if len(t) < 3 or t[-1] - t[0] < 2 * SMOOTHING_S:
        raise BadInput("too few samples of the accelerometer", remedy="tilt the plate over some seconds")
    width = min(max(3, round(SMOOTHING_S / float(np.median(np.diff(t))))), len(t))
    # Means of forces, not of angles: a foot that chatters leaves the ground and comes down hard, and friction stays below
    # μ times the normal force in the mean of both.
    mean = np.lib.stride_tricks.sliding_window_view(acc, width, axis=0).mean(axis=2)
    mean = mean[np.linalg.norm(mean, axis=1) > GRAVITY_M_S2 / 2]
    normal = mean @ up
    along = np.linalg.norm(mean - normal[:, None] * up, axis=1)
    return float(np.arctan2(along, normal).max(initial=0.0))


_ANGLE = re.compile(r"([-+]?\d*\.?\d+(?:e[-+]?\d+)?)\s*(rad|deg|°)?", re.IGNORECASE)


def read_slopes(path: Path) -> list[Slope]:
    """Readings from a CSV of `angle,kind`: rad or `31deg`, then static (also where the column is missing) or kinetic.

    Raises:
        BadInput: names the line that cannot be.
    """
    slopes: list[Slope] = []
    for where, cells in reading_rows(path, "angle,kind"):
        match = _ANGLE.fullmatch(cells[0])
        if match is None:
            if not slopes and not any(character.isdigit() for character in cells[0]):
                continue  # the heading
            raise BadInput(f"{cells[0]!r} is no angle", where=where, remedy="0.54 or 31deg")
        angle = float(match[1])
        if (match[2] or "").lower() in ("deg", "°"):
            angle = math.radians(angle)
        kind = cells[1].lower() if len(cells) > 1 and cells[1] else "static"
        if kind not in get_args(Kind):
            raise BadInput(f"a reading of kind {kind!r}", where=where, remedy="static or kinetic")
        slopes.append(Slope(checked(angle, where), "kinetic" if kind == "kinetic" else "static"))
    if not slopes:
        raise BadInput("has no readings", where=path, remedy="a CSV of angle,kind")
    return slopes


def friction_finding(
    slopes: Sequence[Slope], command: str, *, source: str, resolution_rad: float = math.radians(0.5), slid: bool = True
) -> Finding:
    """What the readings say of the floor.

    Args:
        slopes: at least one reading.
        source: the instrument.
        slid: False where the robot held at every angle: then the readings are a lower bound.
    """
    found: dict[Kind, Coefficient] = {}
    for kind in get_args(Kind):
        angles = [slope.angle_rad for slope in slopes if slope.kind == kind]
        if angles:
            found[kind] = coefficient(angles, resolution_rad)
    data: Mapping[str, object] = {"readings": [vars(slope) for slope in slopes], "slid": slid}

    def of(kind: Kind, name: str) -> Evidence:
        c = found[kind]
        return Evidence(name, c.value, "1", f"{kind}, μ = tan α, {c.readings} readings by {source}", c.low, c.high)

    evidence = tuple(of(kind, f"{kind} friction") for kind in found)
    if not slid:
        most = max(math.tan(slope.angle_rad) for slope in slopes)
        return Finding(
            "floor-friction", None, f"The robot did not slide: the coefficient is above {number(most, decimals=2)}.",
            (Evidence("friction, at least", most, "1", f"μ = tan α by {source}"),),
            "Tilt further, until it slides.", command, data=data,
            unsure=("The coefficient is known from below only.",),
        )  # fmt: skip
    chosen: Kind = "kinetic" if "kinetic" in found else "static"
    mu = found[chosen]
    what = f"Floor friction: μ = {of(chosen, '').words} ({chosen}, {mu.readings} readings)."
    actions: list[str] = []
    problems: list[str] = []
    unsure: list[str] = []
    if mu.low is None:
        unsure.append("One reading has no interval.")
        actions.append("Take at least three readings, with the robot turned in between.")
    if mu.value < LEAST_FRICTION:
        problems.append(f"A coefficient of {number(mu.value)} cannot be.")
        actions.append("No floor is so slippery: did the plate tilt, and was it level when the reference was taken?")
    if len(found) == 2:
        ratio = found["static"].value / mu.value
        what += f" It holds up to {number(found['static'].value)} before it slides, {number(ratio, decimals=2)} times as much."
        if ratio < 1 and not _overlap(found["static"], mu):
            problems.append("Static friction below kinetic friction cannot be.")
            actions.append("Look whether the two kinds of readings were swapped.")
    elif chosen == "static":
        actions.append("Feet that slip feel the kinetic coefficient, which is lower: tap the plate and add --kinetic.")
    return Finding(
        "floor-friction", False if problems else None if unsure else True, what, evidence, " ".join(actions), command,
        parameters=(of(chosen, "floor_friction"),), data=data, problems=tuple(problems), unsure=tuple(unsure),
    )  # fmt: skip


def _overlap(a: Coefficient, b: Coefficient) -> bool:
    if a.low is None or a.high is None or b.low is None or b.high is None:
        return True
    return a.low <= b.high and b.low <= a.high
