"""A joint's stiffness from a kitchen scale and from the servo's own duty, and which P divisor they support.

Two estimators of the same number, N·m of torque per rad of position error e:

- the scale: grams under the foot give τ = m g r with the lever arm r of the foot; its line over e is the stiffness as the
  leg delivers it, behind the gear and its friction;
- the servo: Present PWM over e is what its controller asks for, duty = P / divisor · e / 885 (e in pulses; e-manual), times
  the stall torque at the supply.

The manual says a divisor of 128; BAM found 256 on an XL330. The second estimator decides it in seconds, because neither
friction nor torque constant enter; the first needs the data sheet's stall torque to be compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.robot.gains import stiffness_nm_rad
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE
from openant_tools.robot.servo import ServoModel
from openant_tools.sysid.bench.knee_torque import GRAVITY_M_S2, KNEE_TO_GROUND_M
from openant_tools.sysid.bench.readings import reading_rows

__all__ = [
    "ARM_UNCERTAINTY", "DIVISORS", "DivisorVerdict", "DutyReading", "Lever", "Line", "Weighing", "checked", "decide_divisor", "fit_line",
    "read_weighings", "scale_line", "servo_line", "stiffness_finding", "weighed_finding",
]  # fmt: skip

Array = NDArray[np.float64]

#: P divisors that are known of Dynamixel servos: the manual's, and BAM's measurement of an XL330.
DIVISORS = (128.0, 256.0)
#: relative standard deviation of a lever arm: the paper's leg and the platform's model differ by 7 %
ARM_UNCERTAINTY = 0.03
#: readings below which a line has no interval
LEAST_READINGS = 3
#: share of the torque or duty limit from which a reading is taken to be cut off by it
SATURATED = 0.93
#: share of the deflection that must remain as error: a leg that is held keeps nearly all of it
HELD = 0.3
#: what a kitchen scale rounds to
GRAM_STEP = 1.0
#: two-sided confidence of intervals
CONFIDENCE = 0.95
#: a deflection beyond this is degrees, or a leg that no scale holds
LARGEST_DEFLECTION_RAD = 0.8
#: a kitchen scale's range
MOST_GRAMS = 20_000.0


@dataclass(frozen=True)
class Weighing:
    """One line of the builder's notes: how far the goal was beyond where the leg touched (rad), and the scale (g)."""

    deflection_rad: float
    grams: float


@dataclass(frozen=True)
class DutyReading:
    """What the servo said while it was held.

    Attributes:
        deflection_rad: of the goal from where the leg touched, in the pushing direction.
        error_rad: goal minus measured position, in the pushing direction, whole pulses.
        duty: Present PWM in the pushing direction, fraction of full.
        volts: at the servo.
        position_rad: joint angle measured.
    """

    deflection_rad: float
    error_rad: float
    duty: float
    volts: float
    position_rad: float


@dataclass(frozen=True)
class Line:
    """y = slope · x + intercept by least squares.

    Attributes:
        low, high: 95 % interval of the slope, from Student's t with n − 2 degrees of freedom.
        residual: standard deviation about the line, in y's unit.
        used: how many readings; left_out: how many were cut off by a limit and left out.
    """

    slope: float
    low: float
    high: float
    intercept: float
    residual: float
    used: int
    left_out: int = 0

    def scaled(self, by: float) -> Line:
        """The line of y · `by`."""
        return Line(
            self.slope * by,
            self.low * by,
            self.high * by,
            self.intercept * by,
            self.residual * abs(by),
            self.used,
            self.left_out,
        )


def fit_line(x: Array, y: Array, *, left_out: int = 0, rounding: float = 0.0) -> Line:
    """Fit a line to (n,) readings.

    Args:
        left_out: readings that were not given, for messages.
        rounding: standard deviation that y has at least, because it is rounded; rounded values can lie on a line by chance.

    Raises:
        BadInput: fewer than three readings, or all at one x.
    """
    from scipy import stats

    if len(x) < LEAST_READINGS:
        cut = f" ({left_out} more are cut off by the torque limit)" if left_out else ""
        raise BadInput(
            f"{len(x)} readings do not make a line with an interval{cut}",
            remedy=f"take at least {LEAST_READINGS}, with smaller steps if the servo is at its limit",
        )
    if not np.ptp(x) > 0:
        raise BadInput("all readings are at one deflection", remedy="press in steps")
    result = stats.linregress(x, y)
    deviation = max(float(result.stderr), rounding / float(np.sqrt(np.sum((x - x.mean()) ** 2))))
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, len(x) - 2)) * deviation
    slope, intercept = float(result.slope), float(result.intercept)
    residual = float(np.sqrt(np.sum((y - slope * x - intercept) ** 2) / (len(x) - 2)))
    return Line(slope, slope - half, slope + half, intercept, residual, len(x), left_out)


@dataclass(frozen=True)
class Lever:
    """How far from a joint's axis the scale takes the foot's force.

    Attributes:
        joint: a knee's lever follows from its angle, a hip's must be measured.
        length_m: from the knee's axis to the foot's contact.
        measured_m: the lever, where somebody measured it instead.
    """

    joint: str
    length_m: float = KNEE_TO_GROUND_M
    measured_m: float | None = None

    @property
    def of_hip(self) -> bool:
        return self.joint in JOINTS and JOINTS[self.joint].kind == "hip"

    def at(self, angle_rad: float) -> float:
        """m, the horizontal distance from the axis to the foot on the scale: of a knee L cos q, with q = 0 for a leg straight
        out.

        Raises:
            BadInput: nobody measured a hip's; or the leg stands straight on the scale.
        """
        if self.measured_m is not None:
            return self.measured_m
        if self.of_hip:
            raise BadInput("a hip's lever arm is not known", remedy="measure it from axis to hook and give it by --arm")
        arm = self.length_m * math.cos(angle_rad)
        if not arm > 0.1 * self.length_m:
            raise BadInput(
                f"at a knee angle of {number(angle_rad, 'rad')} the leg stands straight on the scale and has no lever",
                remedy="choose a pose with the leg further out, such as -50°",
            )
        return arm


def scale_line(
    deflection_rad: Sequence[float],
    grams: Sequence[float],
    arm_m: float | Sequence[float],
    *,
    torque_limit_nm: float | None = None,
    arm_uncertainty_m: float = 0.0,
) -> Line:
    """N·m/rad from what the scale showed.

    Args:
        deflection_rad: (n,) the position error where it was measured, else how far the goal was moved.
        grams: (n,) on the scale; a scale not tared at the touch shifts the intercept only.
        arm_m: lever arm of the foot, or (n,) of them.
        torque_limit_nm: stall torque at the PWM limit; readings near it are left out, because there the servo pushes no more.
        arm_uncertainty_m: standard deviation of the arm, shared by all readings, so that it enters the slope's interval.

    Raises:
        BadInput: too few readings, or readings that cannot be.
    """
    x = np.asarray(deflection_rad, float)
    arms = np.broadcast_to(np.asarray(arm_m, float), x.shape)
    torque = np.asarray(grams, float) * 1e-3 * GRAVITY_M_S2 * arms
    free = np.ones(len(x), bool)
    if torque_limit_nm is not None:
        free = torque - torque.min() < SATURATED * torque_limit_nm
    rounding = GRAM_STEP * 1e-3 * GRAVITY_M_S2 * float(arms.mean()) / math.sqrt(12)
    line = fit_line(x[free], torque[free], left_out=int((~free).sum()), rounding=rounding)
    # The arm multiplies every torque alike, so that its relative error is the slope's.
    half = math.hypot((line.high - line.low) / 2, 1.96 * line.slope * arm_uncertainty_m / float(arms.mean()))
    return Line(
        line.slope, line.slope - half, line.slope + half, line.intercept, line.residual, line.used, line.left_out
    )


def servo_line(readings: Sequence[DutyReading], pwm_limit: float = 1.0) -> Line:
    """Duty per rad of position error, from what the servo said; readings at the PWM limit are left out.

    Raises:
        BadInput: the leg followed its goal because nothing held it, or too few readings are left.
    """
    pressed = [r for r in readings if r.deflection_rad > 0]
    if pressed and max(r.error_rad / r.deflection_rad for r in pressed) < HELD:
        raise BadInput(
            f"nothing holds the leg: it followed its goal to within {number(max(abs(r.error_rad) for r in pressed), 'rad', name='error')}",
            remedy="put the scale, or something that does not give, under the foot at the pose where it touches (--pose)",
        )
    free = [reading for reading in readings if abs(reading.duty) < SATURATED * pwm_limit]
    x = np.array([reading.error_rad for reading in free])
    y = np.array([reading.duty for reading in free])
    # The error needs no such allowance: its whole pulses are what the controller works with.
    return fit_line(x, y, left_out=len(readings) - len(free), rounding=1 / PWM_FULL / math.sqrt(12))


@dataclass(frozen=True)
class DivisorVerdict:
    """Which P divisor the data support.

    Attributes:
        divisor, low, high: what the data say, and its 95 % interval.
        supported: the known divisors inside the interval.
    """

    divisor: float
    low: float
    high: float
    supported: tuple[float, ...]

    @property
    def words(self) -> str:
        if len(self.supported) == 1:
            return f"the P divisor is {number(self.supported[0])}"
        if self.supported:
            return f"the data do not tell a P divisor of {' from '.join(map(number, self.supported))}"
        return f"the data support neither known P divisor ({', '.join(map(number, DIVISORS))}); they say {number(self.divisor, decimals=0)}"


def decide_divisor(duty_per_rad: Line, p_gain: float, tolerance: float = 0.03) -> DivisorVerdict:
    """The P divisor from duty per rad: divisor = P / (slope · 885 · rad per pulse).

    Args:
        duty_per_rad: from `servo_line`, or from a stiffness divided by the stall torque.
        p_gain: the register `position_p_gain`.
        tolerance: relative, what is systematic beside the readings' scatter: encoder linearity and PWM rounding for the
            servo's own duty, the spread of torque constants and friction (some 20 %) for the scale.
    """
    if not duty_per_rad.slope > 0:
        raise BadInput(
            f"pushing harder gave less ({number(100 * math.radians(duty_per_rad.slope), '% of full duty')} for each degree)",
            remedy="the leg must be held by the scale: fix the torso, and push downwards",
        )

    def divisor(slope: float) -> float:
        return p_gain / (slope * PWM_FULL * RAD_PER_PULSE)

    low = divisor(duty_per_rad.high) * (1 - tolerance)
    high = divisor(duty_per_rad.low) * (1 + tolerance) if duty_per_rad.low > 0 else math.inf
    return DivisorVerdict(
        divisor(duty_per_rad.slope), low, high, tuple(known for known in DIVISORS if low <= known <= high)
    )


def read_weighings(path: Path) -> list[Weighing]:
    """Readings from a CSV of `deflection,grams` (rad, g); a heading is optional, empty lines and # comments are skipped.

    Raises:
        BadInput: names the line that cannot be.
    """
    readings: list[Weighing] = []
    for where, cells in reading_rows(path, "deflection,grams"):
        if len(cells) < 2:
            raise BadInput("needs two columns", where=where, remedy="deflection in rad, then grams")
        try:
            deflection, grams = float(cells[0]), float(cells[1])
        except ValueError:
            if not readings and not _is_number(cells[0]) and not _is_number(cells[1]):
                continue  # the heading
            raise BadInput(f"{', '.join(cells[:2])} are no numbers", where=where) from None
        readings.append(checked(Weighing(deflection, grams), where))
    if not readings:
        raise BadInput("has no readings", where=path, remedy="a CSV of deflection (rad), grams")
    return readings


def checked(reading: Weighing, where: str) -> Weighing:
    """The reading, or BadInput where it cannot be meant."""
    if not abs(reading.deflection_rad) <= LARGEST_DEFLECTION_RAD:
        raise BadInput(
            f"a deflection of {number(reading.deflection_rad, 'rad', decimals=0)}",
            where=where,
            remedy="were degrees given? A deflection is in rad: 0.1 is 5.73°",
        )
    if not abs(reading.grams) <= MOST_GRAMS:
        raise BadInput(f"{exact(reading.grams, 'g')} on a kitchen scale", where=where, remedy="readings are in grams")
    return reading


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def weighed_finding(
    joint: str,
    servo: ServoModel,
    weighings: Sequence[Weighing],
    lever: Lever,
    *,
    pose_rad: float,
    p_gain: float | None = None,
    supply_v: float | None = None,
    pwm_limit: float,
    command: str,
) -> Finding:
    """What a scale alone says of a joint's stiffness, without a robot.

    Args:
        pose_rad: where the foot touched.
        p_gain, supply_v: None for the factory's, and for what the servo is meant for.

    Raises:
        BadInput: too few readings, or readings that cannot be.
    """
    supply = servo.nominal_voltage_v if supply_v is None else supply_v
    arm = lever.at(pose_rad)
    line = scale_line(
        [w.deflection_rad for w in weighings],
        [w.grams for w in weighings],
        arm,
        torque_limit_nm=servo.stall_torque_at(supply, pwm_limit),
        arm_uncertainty_m=ARM_UNCERTAINTY * arm,
    )
    return stiffness_finding(
        joint, servo, p_gain=p_gain or float(servo.register("position_p_gain").default or 0), supply_v=supply,
        pwm_limit=pwm_limit, scale=line, duty=None, measured_error=False, weighings=weighings, arm_m=arm, command=command,
    )  # fmt: skip


#: Relative spread of what the data sheet says of a single servo: torque constant, friction of the gear.
_SHEET_TOLERANCE = 0.2


def stiffness_finding(
    joint: str,
    servo: ServoModel,
    *,
    p_gain: float,
    supply_v: float,
    pwm_limit: float,
    scale: Line | None,
    duty: Line | None,
    measured_error: bool,
    command: str,
    i_gain: float = 0.0,
    arm_m: float | None = None,
    weighings: Sequence[Weighing] = (),
    readings: Sequence[DutyReading] = (),
) -> Finding:
    """What scale, servo and register say of one joint's stiffness, and whether they agree.

    Args:
        scale: N·m per rad; None where nothing was weighed.
        duty: duty per rad from `servo_line`; None without a robot.
        measured_error: whether the scale's line is over the measured position error, not over the goal's deflection.
    """
    stall = servo.stall_torque_at(supply_v)
    formula = {d: stiffness_nm_rad(p_gain, d, stall) for d in DIVISORS}
    servo_stiffness = None if duty is None else duty.scaled(stall)
    evidence = [
        Evidence(
            f"stiffness by P = {number(p_gain)} and divisor {number(d)}", value, "N·m/rad", "register and data sheet"
        )
        for d, value in formula.items()
    ]
    parameters: list[Evidence] = []
    words: list[str] = []
    actions: list[str] = []
    problems: list[str] = []
    unsure: list[str] = []
    verdict: DivisorVerdict | None = None
    if duty is not None and servo_stiffness is not None:
        verdict = decide_divisor(duty, p_gain)
        source = f"Present PWM over position error, {duty.used} readings, times {number(stall, 'N·m', decimals=2)} stall at {number(supply_v, 'V', decimals=1)}"
        evidence.append(_stiffness("stiffness by the servo's duty", servo_stiffness, source))
        evidence.append(
            Evidence("P divisor", verdict.divisor, "1", "Present PWM over position error", verdict.low, verdict.high)
        )
        words.append(f"By the servo's own duty {verdict.words}")
        if len(verdict.supported) != 1:
            unsure.append("the servo's own duty does not decide which P divisor this firmware has")
        if i_gain:
            problems.append(f"position_i_gain is {number(i_gain)}, so that duty grows while the error stands")
            actions.append("Set position_i_gain to 0 for this measurement.")
    if scale is not None:
        over = "measured position error" if measured_error else "deflection of the goal"
        arm = "" if arm_m is None else f", lever arm {number(arm_m, 'm')}"
        source = f"kitchen scale over {over}, {scale.used} readings{arm}"
        evidence.append(_stiffness("stiffness by the scale", scale, source))
        parameters.append(_stiffness(f"scale_stiffness.{joint}", scale, source))
        if verdict is None:
            verdict = decide_divisor(scale.scaled(1 / stall), p_gain, _SHEET_TOLERANCE)
            words.append(f"By the scale {verdict.words}, as far as the data sheet's stall torque is true")
            if len(verdict.supported) != 1:
                unsure.append("the scale does not decide which P divisor this firmware has")
        if servo_stiffness is not None:
            ratio = scale.slope / servo_stiffness.slope
            evidence.append(Evidence("scale over servo", ratio, "1", "the two stiffnesses above"))
            if abs(ratio - 1) > _SHEET_TOLERANCE + (scale.high - scale.low) / 2 / scale.slope:
                problems.append(
                    f"the scale gives {number(ratio, decimals=2)} times what duty and data sheet give: more than servos differ"
                )
                actions.append(
                    "Measure the lever arm again (--arm), look whether the torso moves, and repeat with smaller steps."
                )
        if (problems or unsure) and not measured_error and verdict is not None and not verdict.supported:
            actions.append("Repeat with the robot connected, so that the position error is measured, not assumed.")
    elif servo_stiffness is not None:
        # Under a name of its own: its interval leaves out what the data sheet's stall torque may be wrong by.
        parameters.append(_stiffness(f"duty_stiffness.{joint}", servo_stiffness, "Present PWM over position error"))
    left_out = (scale.left_out if scale else 0) + (duty.left_out if duty else 0)
    if left_out:
        words.append(f"{left_out} readings at the torque limit are left out")
    best = parameters[0]
    by = "" if scale is not None else ", if its stall torque is the data sheet's"
    return Finding(
        step="stiffness",
        ok=False if problems else None if unsure else True,
        what=f"{joint} is {best.words} stiff{by}. " + "; ".join(words) + ".",
        evidence=tuple(evidence),
        next_action=" ".join(dict.fromkeys(actions)),
        problems=tuple(problems),
        unsure=tuple(unsure),
        command=command,
        parameters=tuple(parameters),
        data={
            "joint": joint,
            "servo": servo.name,
            "p_gain": p_gain,
            "supply_v": supply_v,
            "pwm_limit": pwm_limit,
            "arm_m": arm_m,
            "divisor_supported": None if verdict is None else list(verdict.supported),
            "weighings": [vars(weighing) for weighing in weighings],
            "servo_readings": [vars(reading) for reading in readings],
        },
    )


def _stiffness(name: str, line: Line, source: str) -> Evidence:
    return Evidence(name, line.slope, "N·m/rad", source, line.low, line.high)
