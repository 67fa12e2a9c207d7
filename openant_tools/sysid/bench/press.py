"""Press one leg against what holds it, step by step, and read what servo and builder see: the moving half of the kitchen
scale's procedure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.servos import Servo
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.procedure.journal import append_writes
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE
from openant_tools.sysid.bench.heed import heed
from openant_tools.sysid.bench.stiffness import SATURATED, DutyReading, Weighing

__all__ = ["Pressed", "Pressing", "press"]

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
            raise BadInput(f"{self.steps} steps of {self.step_rad:g} rad", remedy="such as 5 steps of 0.02 rad")
        ends = self.pose_rad, self.pose_rad + self.direction * self.deflections_rad[-1]
        low, high = config.limits_rad.get(self.joint, (-math.inf, math.inf))
        if min(ends) < low or max(ends) > high:
            raise BadInput(
                f"{self.joint} would go from {ends[0]:.2f} to {ends[1]:.2f} rad, its limits are {low:.2f} to {high:.2f}",
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


def press(
    config: EngineConfig,
    pressing: Pressing,
    *,
    ready: Callable[[], None] = lambda: None,
    grams: Callable[[float], float | None] = lambda deflection_rad: None,
    progress: Callable[[str, float], None] = lambda words, share: None,
    notice: Callable[[str], None] = lambda text: None,
    journal: Path | None = None,
) -> Pressed:
    """Go to the pose, wait for the builder, press in steps, go back, let go. Stops early at the PWM limit.

    Args:
        ready: called when the leg is at its pose with torque on; returns when the scale is under the foot.
        grams: called at every step with its deflection; what the scale shows, or None.
        journal: file that every write to a servo's permanent memory is added to.

    Raises:
        BadInput: the goals are outside the joint's limits; nothing has moved then.
        HardwareFault: a guard stopped it, or the joint answers too rarely; torque is off.
        KeyboardInterrupt: torque is off when it leaves here.
    """
    servo = pressing.check(config)
    k = [s.joint for s in config.servos].index(pressing.joint)
    pose = np.array([_home(s.joint, config) for s in config.servos])
    pose[k] = pressing.pose_rad
    readings: list[DutyReading] = []
    weighings: list[Weighing] = []
    deflections = pressing.deflections_rad
    # The scale is to hold the joint back.
    with EngineProcess(replace(config, guards=replace(config.guards, behind_rad=None))) as engine:
        heed(engine, notice)
        if journal is not None:
            append_writes(journal, engine.description["eeprom_writes"], "sysid scale")
        registers = engine.description["registers"][pressing.joint]
        limit = registers["pwm_limit"] / PWM_FULL
        progress("to the pose", 0.0)
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(pose))
        ready()
        volts: list[float] = []
        for step, deflection in enumerate(deflections):
            heed(engine, notice)
            progress(f"{deflection:.3f} rad", step / len(deflections))
            goal = pose.copy()
            goal[k] += pressing.direction * deflection
            engine.ask(messages.Ramp(goal))
            engine.ask(messages.Hold(SETTLE_S))
            engine.telemetry()
            engine.ask(messages.Hold(MEASURE_S))
            reading = _reading(engine, servo, deflection, goal[k], pressing.direction)
            readings.append(reading)
            volts.append(reading.volts)
            weighed = grams(deflection)
            if weighed is not None:
                weighings.append(Weighing(deflection, weighed))
            if abs(reading.duty) >= SATURATED * limit:
                notice(f"the servo is at its PWM limit at {deflection:.3f} rad: no further")
                break
        heed(engine, notice)
        engine.ask(messages.Ramp(pose))
        engine.ask(messages.Torque(False))
        progress("done", 1.0)
    return Pressed(
        tuple(readings),
        tuple(weighings),
        float(np.mean(volts)),
        float(registers["position_p_gain"]),
        float(registers["position_i_gain"]),
        limit,
    )


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
