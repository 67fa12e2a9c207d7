"""Centring: each bare servo turns slowly to its mounting angle and holds it while the horn goes on."""

from __future__ import annotations

import numpy as np

from openant_tools.calib.sweep import play_watched
from openant_tools.calib.wires import BOOT_S, bare_config, differs, journalled, opened_bus, robot_servos, wait
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.motion import ramp
from openant_tools.comms.servos import Servo, Servos
from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import (
    Bench,
    Drawing,
    Hands,
    Intent,
    Procedure,
    Progress,
    RegisterChange,
    Say,
    Subroutine,
    confirmed,
)
from openant_tools.procedure.unfinished import Parts
from openant_tools.robot.config import MotorSection
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import NOMINAL_ZERO_RAD
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE

__all__ = ["centre"]

COMMAND = "openant calib centre"
#: slow enough to take a finger away
SLOW_RAD_S = 0.3
CENTRE_PWM = 0.3
#: An unloaded servo stops within friction of its goal: 23 pulses.
CLOSE_RAD = 0.035
SETTLE_S = 0.5
POSITION_MODE = 3
DRAWINGS = {
    "hip": """\
        horn (seen from above)
          ___                 the mark on the horn points straight OUT,
    body | o-|---> leg        away from the torso, along the diagonal;
         |___|                cable side of the servo towards the torso
""",
    "knee": """\
        horn (seen from the side)
          ___                 the lower leg points straight OUT,
    hip--| o-|---> foot       in line with the upper leg, level;
         |___|                up is where the servo's label can be read
""",
}


def centre(bench: Bench) -> Procedure:
    """Every servo in turn; torque goes off when its horn is screwed on.

    Raises:
        BadInput: a servo is in a leg already and can hardly turn freely; the message says which.
    """
    config = bench.folder.config()
    motors = [motor for motor in config.motors.values() if not bench.joints or motor.joint in bench.joints]
    centred, problems, evidence = list[str](), list[str](), list[Evidence]()
    with opened_bus(bench) as bus:
        connected = any(bus.ping(motor.id, insist=True) is not None for motor in motors)
    if not connected:
        yield Hands("Connect the servos, still without horns, one behind the other; 12 V on.", "plug")
        with opened_bus(bench) as bus:
            wait(bus.clock, BOOT_S)
    parts = Parts(bench, "centre", [motor.joint for motor in motors], bench.joints)
    if parts.before:
        yield Say(parts.words)
    for k, motor in enumerate(motors):
        joint = motor.joint
        if joint in parts.before:
            differs = _differs(bench, motor)
            if not differs:
                centred.append(joint)
                evidence.append(_off_evidence(joint, parts.before[joint].get("off_rad")))
                continue
            yield Say(f"{joint} is not as it was left: {differs}; it is done again", "warn")
        yield Progress(k / len(motors), f"{joint} ({k + 1} of {len(motors)})")
        with opened_bus(bench) as bus:
            if bus.ping(motor.id, insist=True) is None:
                problems.append(
                    f"{joint} (id {motor.id}) does not answer → plug it in and run the step again with --joint {joint}"
                )
                continue
            servos = journalled(bus, robot_servos(config, [joint]), bench, COMMAND)
            servos.set_torque(False)
            mode, at = servos.read_counts("operating_mode", joint), servos.read_counts("present_position", joint)
        to_position = RegisterChange(joint, "operating_mode", mode, POSITION_MODE, "position control")
        changes = [to_position] if mode != POSITION_MODE else []
        yield Drawing(f"{joint}: how its horn goes on", DRAWINGS[JOINTS[joint].kind])
        yield Intent(
            f"turn {joint} slowly from {number(at * RAD_PER_PULSE, 'rad', decimals=0)} to {number(NOMINAL_ZERO_RAD, 'rad', decimals=0)} "
            "and hold it there; keep the shaft free",
            tuple(changes),
            moves=True,
        )
        with opened_bus(bench) as bus:
            servos = journalled(bus, robot_servos(config, [joint]), bench, COMMAND)
            servos.write_counts("operating_mode", joint, POSITION_MODE)
        off, trouble = yield from _one(bench, motor)
        if abs(off) <= CLOSE_RAD:
            evidence.append(_off_evidence(joint, off))
        if trouble:
            problems.append(trouble)
        else:
            centred.append(joint)
            parts.done(joint, off_rad=off)
    if not motors:
        raise BadInput("no joint is named", remedy="leave out --joint")
    return Finding(
        "centre",
        not problems,
        f"{len(centred)} of {len(motors)} horns are on at the mounting angle of {number(NOMINAL_ZERO_RAD, 'rad', decimals=0)}",
        tuple(evidence),
        "mend what is listed and run it again" if problems else "",
        COMMAND,
        data={"centred": centred},
        problems=tuple(problems),
    )


def _off_evidence(joint: str, off_rad: float | None) -> Evidence:
    return Evidence(
        f"{joint} off its mounting angle", off_rad, "rad", "encoder, holding", least=-CLOSE_RAD, most=CLOSE_RAD
    )


def _differs(bench: Bench, motor: MotorSection) -> str:
    """What of a servo whose horn is on does not read as it was left; "" where all does."""
    with opened_bus(bench) as bus:
        another = differs(bus, motor)
        if another:
            return another
        servos = robot_servos(bench.folder.config(), [motor.joint])
        mode = Servos(bus, servos).read_counts("operating_mode", motor.joint)
    return "" if mode == POSITION_MODE else f"its operating mode is {mode}, not {POSITION_MODE}"


def _one(bench: Bench, motor: MotorSection) -> Subroutine[tuple[float, str]]:
    """Turn one servo to its mounting angle and hold it while its horn goes on; how far it is off, rad, and what is wrong."""
    joint = motor.joint
    config = bare_config(bench, [Servo(joint, motor.id, motor.servo)], bench.folder.config().bus.baud)
    # The engine holds, and keeps the watchdog quiet, for as long as the builder needs.
    with EngineProcess(config) as engine:
        [at] = engine.ask(messages.Torque(True))
        engine.ask(messages.WriteRegister(joint, "goal_pwm", round(CENTRE_PWM * PWM_FULL)))
        way = ramp(np.array([at]), np.array([NOMINAL_ZERO_RAD]), config.rate_hz, speed_rad_s=SLOW_RAD_S).commands
        yield from play_watched(engine, messages.Play(way), len(way) / config.rate_hz, "turning", None)
        engine.ask(messages.Hold(SETTLE_S))
        off = _off(engine, joint)
        if abs(off) > CLOSE_RAD:
            return (
                off,
                f"{joint}: stopped {number(off, 'rad', sign=True, decimals=0)} from its mounting angle → is the shaft blocked?",
            )
        question = f"{joint} holds. Put the horn on as drawn and drive its screw in. Done?"
        if not (yield from confirmed(bench, question)):
            return off, f"{joint}: no horn yet → run the step again with --joint {joint}"
        turned = _off(engine, joint) - off
        if abs(turned) > CLOSE_RAD:
            yield Say(
                f"{joint} was turned by {number(turned, 'rad', sign=True, decimals=1)} while the horn went on", "warn"
            )
    return off, ""


def _off(engine: EngineProcess, joint: str) -> float:
    counts: int = engine.ask(messages.ReadRegister("present_position"))[joint]
    return counts * RAD_PER_PULSE - NOMINAL_ZERO_RAD
