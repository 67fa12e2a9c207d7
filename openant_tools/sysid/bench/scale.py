"""Press one leg against what holds it, step by step, and read what servo and builder see: the kitchen scale's procedure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openant_tools.calib.wires import heard
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.servos import Servo
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.numbers import number, percent, span
from openant_tools.procedure.step import Ask, Hands, Intent, Procedure, Progress, Say, Subroutine
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE
from openant_tools.sysid.bench.stiffness import (
    ARM_UNCERTAINTY,
    SATURATED,
    DutyReading,
    Lever,
    Weighing,
    checked,
    scale_line,
    servo_line,
    stiffness_finding,
)

__all__ = ["Pressed", "Pressing", "press", "stiffness"]

Array = NDArray[np.float64]

#: The leg comes to rest against the scale, and the scale's display settles.
SETTLE_S = 0.8
#: what a reading is averaged over
MEASURE_S = 0.5
#: share of answers below which a reading does not count
LEAST_ANSWERS = 0.5


@dataclass(frozen=True)
class Pressing:
    """How to press.

    Attributes:
        joint: which one; the others stay at home.
        pose_rad: its angle where the foot just touches.
        step_rad, steps: how far beyond that the goal goes, and how often.
        direction: −1 presses a knee's foot down.
    """

    joint: str
    pose_rad: float
    step_rad: float = 0.02
    steps: int = 5
    direction: int = -1

    @property
    def deflections_rad(self) -> list[float]:
        return [k * self.step_rad for k in range(self.steps + 1)]

    def check(self, config: EngineConfig) -> Servo:
        """The joint's servo; BadInput where there is none, or where a goal would be outside its limits."""
        servo = next((servo for servo in config.servos if servo.joint == self.joint), None)
        if servo is None:
            raise BadInput(
                f"no joint {self.joint!r}", remedy=f"the joints are {', '.join(s.joint for s in config.servos)}"
            )
        if not self.step_rad > 0 or self.steps < 1:
            raise BadInput(
                f"{self.steps} steps of {number(self.step_rad, 'rad', decimals=1)}", remedy="such as 5 steps of 1.1°"
            )
        ends = self.pose_rad, self.pose_rad + self.direction * self.deflections_rad[-1]
        low, high = config.limits_rad.get(self.joint, (-math.inf, math.inf))
        if min(ends) < low or max(ends) > high:
            raise BadInput(
                f"{self.joint} would go from {span(*ends, 'rad')}, its limits are {span(low, high, 'rad')}",
                remedy="choose another --pose, or smaller steps",
            )
        return servo


@dataclass(frozen=True)
class Pressed:
    """What came of it.

    Attributes:
        readings: of the servo, one a step.
        weighings: of the builder; a step that was not weighed is missing.
        volts: mean supply at the servo.
        p_gain, i_gain, pwm_limit: in force, the last as a share.
    """

    readings: tuple[DutyReading, ...]
    weighings: tuple[Weighing, ...]
    volts: float
    p_gain: float
    i_gain: float
    pwm_limit: float


def stiffness(
    config: EngineConfig,
    pressing: Pressing,
    lever: Lever,
    *,
    command: str,
    weighings: Sequence[Weighing] = (),
    weigh: bool = False,
    held: bool = False,
) -> Procedure:
    """Press a leg, and say what scale and servo tell of its stiffness; arguments as those of `press`.

    Raises:
        BadInput: as `press`; or nothing held the leg.
        HardwareFault: as `press`.
    """
    servo = pressing.check(config).model
    arm = None if lever.of_hip and lever.measured_m is None else lever.at(pressing.pose_rad)
    if weigh or weighings:
        arm = lever.at(pressing.pose_rad)  # before anything moves
    found = yield from press(config, pressing, weighings=weighings, weigh=weigh, held=held)
    weighed = {w.deflection_rad: w.grams for w in found.weighings}
    pairs = [(r, weighed[r.deflection_rad]) for r in found.readings if r.deflection_rad in weighed]
    line = None
    if pairs and arm is not None:
        line = scale_line(
            [r.error_rad for r, _ in pairs],
            [grams for _, grams in pairs],
            [lever.at(r.position_rad) for r, _ in pairs],
            torque_limit_nm=servo.stall_torque_at(found.volts, found.pwm_limit),
            arm_uncertainty_m=ARM_UNCERTAINTY * arm,
        )
    return stiffness_finding(
        pressing.joint, servo, p_gain=found.p_gain, i_gain=found.i_gain, supply_v=found.volts, pwm_limit=found.pwm_limit,
        scale=line, duty=servo_line(found.readings, found.pwm_limit), measured_error=True, weighings=found.weighings,
        readings=found.readings, arm_m=arm, command=command,
    )  # fmt: skip


def press(
    config: EngineConfig,
    pressing: Pressing,
    *,
    weighings: Sequence[Weighing] = (),
    weigh: bool = False,
    held: bool = False,
) -> Subroutine[Pressed]:
    """Go to the pose, let the builder put something under the foot, press in steps, go back, let go. Ends early at the PWM
    limit.

    Args:
        weighings: what a scale showed, where it was written down before. weigh: whether the builder is asked at each step.
        held: whether something is under the foot already, so that no hands are asked for.

    Raises:
        BadInput: the goals are outside the joint's limits; nothing has moved then.
        HardwareFault: a guard stopped it, or the joint answers too rarely; torque is off.
    """
    servo = pressing.check(config)
    joint, size = pressing.joint, number(pressing.step_rad, "rad")
    yield Intent(
        f"turn {joint} to {number(pressing.pose_rad, 'rad')} and press {pressing.steps} × {size} beyond; the others stand at "
        "home, the torso is fixed on its stand, feet free",
        moves=True,
    )
    k = [s.joint for s in config.servos].index(joint)
    pose = np.array([_home(s.joint, config) for s in config.servos])
    pose[k] = pressing.pose_rad
    known = {round(w.deflection_rad / pressing.step_rad): w.grams for w in weighings}
    readings: list[DutyReading] = []
    weighed: list[Weighing] = []
    deflections = pressing.deflections_rad
    # The scale is to hold the joint back.
    with EngineProcess(replace(config, guards=replace(config.guards, behind_rad=None))) as engine:
        yield from heard(engine)
        registers = engine.description["registers"][joint]
        limit = registers["pwm_limit"] / PWM_FULL
        yield Progress(0.0, "to the pose")
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(pose))
        if not held:
            thing = "the scale" if weigh else "something that does not give"
            tare = ", and tare it" if weigh else ""
            words = f"Slide {thing} under the foot until it just touches{tare}."
            yield Hands(words, "turn", joint, path_rad=(pressing.pose_rad,))
        for step, deflection in enumerate(deflections):
            yield from heard(engine)
            yield Progress(step / len(deflections), f"{number(deflection, 'rad')} beyond")
            goal = pose.copy()
            goal[k] += pressing.direction * deflection
            engine.ask(messages.Ramp(goal))
            engine.ask(messages.Hold(SETTLE_S))
            engine.telemetry()
            engine.ask(messages.Hold(MEASURE_S))
            reading = _reading(engine, servo, deflection, goal[k], pressing.direction)
            readings.append(reading)
            error = number(reading.error_rad, "rad", name="error")
            yield Say(
                f"{number(deflection, 'rad')} beyond: {error} off, duty {percent(reading.duty, decimals=1)}, "
                f"{number(reading.volts, 'V', decimals=1)}"
            )
            grams = (yield from _grams(deflection)) if weigh else known.get(step)
            if grams is not None:
                weighed.append(Weighing(deflection, grams))
            if abs(reading.duty) >= SATURATED * limit:
                yield Say(f"the servo is at its PWM limit at {number(deflection, 'rad')}: no further")
                break
        yield from heard(engine)
        engine.ask(messages.Ramp(pose))
        engine.ask(messages.Torque(False))
        if not held:
            yield Hands("Torque is off: take away what held the foot.", "free", while_watching=True)
    return Pressed(
        tuple(readings),
        tuple(weighed),
        float(np.mean([reading.volts for reading in readings])),
        float(registers["position_p_gain"]),
        float(registers["position_i_gain"]),
        limit,
    )


def _grams(deflection: float) -> Subroutine[float | None]:
    """What the scale shows; None where the builder leaves this weighing out."""
    while True:
        question = f"{number(deflection, 'rad')} beyond: what does the scale show, in grams? Empty leaves it out."
        said = str((yield Ask(question, unit="text", default="")) or "").strip()
        if not said:
            return None
        try:
            return checked(Weighing(deflection, float(said.removesuffix("g").replace(",", "."))), "the scale").grams
        except (ValueError, BadInput):
            yield Say(f"{said!r} is no number of grams", "warn")


def _home(joint: str, config: EngineConfig) -> float:
    low, high = config.limits_rad.get(joint, (-math.inf, math.inf))
    return min(max(HOME_RAD[JOINTS[joint].kind] if joint in JOINTS else 0.0, low), high)


def _reading(engine: EngineProcess, servo: Servo, deflection: float, goal: float, direction: int) -> DutyReading:
    """The mean over the rows since the last look."""
    rows = engine.telemetry()

    def column(signal: str) -> Array:
        return np.asarray(rows[:, engine.columns.index(f"{signal}.{servo.joint}")])

    good = (column("ok") == 1) & np.isfinite(column("pwm"))
    if not len(good) or good.mean() < LEAST_ANSWERS:
        raise HardwareFault(
            f"{servo.called} answered {int(good.sum())} of {len(good)} times",
            where=engine.config.port,
            remedy="look at its cable; `openant comms watch` shows what is lost",
        )
    position = column("pos")[good]
    # The servo compares whole pulses; a whole turn that the engine moved its zero by is a whole number of them.
    pulses = round(servo.to_servo(goal) / RAD_PER_PULSE) - np.round(
        (servo.direction * position + servo.zero_rad) / RAD_PER_PULSE
    )
    return DutyReading(
        deflection,
        float(direction * servo.direction * pulses.mean() * RAD_PER_PULSE),
        float(direction * column("pwm")[good].mean()),
        float(column("volt")[good].mean()),
        float(position.mean()),
    )
