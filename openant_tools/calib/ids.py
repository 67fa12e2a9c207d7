"""Motor IDs: one bare servo at a time is told which joint it is, and proves it; or servos wired already are renamed.

Exactly one servo must answer over all baud rates before anything is written: factory-fresh servos all have id 1, and a
write to two at once is heard by both.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

from openant_tools.calib.mute import scan_and_mend
from openant_tools.calib.wires import BOOT_S, bare_config, journalled, opened_bus, wait
from openant_tools.comms import messages
from openant_tools.comms.bus import Bus
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.scan import BAUDS, Scan, Scanned, scan
from openant_tools.comms.servos import Servo, Servos
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import (
    Answer,
    Ask,
    Bench,
    Hands,
    Intent,
    Live,
    Procedure,
    Progress,
    RegisterChange,
    Say,
    Subroutine,
    confirmed,
)
from openant_tools.procedure.unfinished import Parts
from openant_tools.robot.config import MotorSection, RobotConfig
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE
from openant_tools.robot.servo import baud_code, servo_model

__all__ = ["ids", "locate", "nudge"]

COMMAND = "openant calib ids"
#: A horn that turns so far and back is seen, and pinches nobody: bare servos have no leg yet.
NUDGE_RAD = 0.2
NUDGE_PWM = 0.2
#: Ids that servos wait under while others are renamed; the guide's go up to 41.
PARKING = range(200, 240)
BLINKS, BLINK_S = 3, 0.15
SETTLE_S = 0.3
AGAIN, LEAVE, NONE = "try again", "leave it", "none of them"


@dataclass(frozen=True)
class _Wrong:
    """What keeps a servo from being named, in one line."""

    words: str


def ids(bench: Bench) -> Procedure:
    """Name every servo of `bench.joints` (all by default)."""
    config = bench.folder.config()
    motors = [motor for motor in config.motors.values() if not bench.joints or motor.joint in bench.joints]
    named, problems = list[str](), list[str]()
    yield Progress(None, "looking for servos at every baud rate")
    with opened_bus(bench) as bus:
        found = yield from scan_and_mend(bench, bus, COMMAND)
    if _all_named(found, motors, config):
        return _finding([motor.joint for motor in motors], motors, [], "every servo has its id already")
    parts = Parts(bench, "ids", [motor.joint for motor in motors], bench.joints)
    wired = (
        not parts.before and not found.garbled and len(found.servos) > 1 and not any(one.clash for one in found.servos)
    )
    if wired:
        answer = yield Ask(
            f"{len(found.servos)} servos answer under ids of their own: rename them as they are wired, or set bare "
            "servos up one at a time?",
            ("as they are wired", "one at a time"),
            default="as they are wired",
        )
        if answer == "as they are wired":
            problems += yield from _rename(bench, found, motors, config)
            with opened_bus(bench) as bus:
                found = scan(bus)
            named = [m.joint for m in motors if any((o.id, o.baud) == (m.id, config.bus.baud) for o in found.servos)]
            return _finding(named, motors, problems)
    if parts.before:
        yield Say(parts.words)
    odd = {motor.joint: _differs(found, motor, config) for motor in motors if motor.joint in parts.before}
    if found.servos or found.garbled:
        yield Hands("Take every servo off the cable; they are set up one at a time.", "unplug")
    for k, motor in enumerate(motors):
        if motor.joint in parts.before:
            if not odd[motor.joint]:
                named.append(motor.joint)
                continue
            yield Say(f"{motor.joint} is not as it was left: {odd[motor.joint]}; it is done again", "warn")
        yield Progress(k / len(motors), f"{motor.joint} ({k + 1} of {len(motors)})")
        trouble = yield from _one(bench, motor, motors, config, named)
        if trouble is None:
            named.append(motor.joint)
            parts.done(motor.joint, id=motor.id)
        else:
            problems.append(trouble.words)
        yield Hands(f"Take it off the cable, and write {motor.joint} on it.", "unplug", motor.joint)
    return _finding(named, motors, problems)


def _one(
    bench: Bench, motor: MotorSection, motors: Sequence[MotorSection], config: RobotConfig, named: Sequence[str]
) -> Subroutine[_Wrong | None]:
    """One servo from the box; None once it is named and has proven it. `named`: joints that have their servo already."""
    words = JOINTS[motor.joint].words
    while True:
        yield Hands(
            f"Plug in one servo for the {words} ({motor.joint}), an {motor.model}, and no other.", "plug", motor.joint
        )
        with opened_bus(bench) as bus:
            wait(bus.clock, BOOT_S)
            found = yield from scan_and_mend(bench, bus, COMMAND)
        wrong = _not_one(found, motor, motors, config) or _another(found, config, motor, named)
        if wrong is None:
            break
        if (yield Ask(wrong.words, (AGAIN, LEAVE), default=LEAVE)) != AGAIN:
            return wrong
        yield Hands("Take everything off the cable.", "unplug")
    seen = found.servos[0]
    model = servo_model(seen.model_number)
    wanted = {"id": motor.id, "baud_rate": baud_code(config.bus.baud), "return_delay_time": 0}
    servo = Servo(motor.joint, seen.id, model)
    with opened_bus(bench, seen.baud) as bus:
        servos = journalled(bus, [servo], bench, COMMAND)
        servos.set_torque(False)
        old = {name: servos.read_counts(name, motor.joint) for name in wanted}
    means = {
        "baud_rate": f"{seen.baud} → {config.bus.baud} baud",
        "return_delay_time": f"{2 * old['return_delay_time']} → 0 µs",
    }
    yield Intent(
        f"make this {seen.model} (id {seen.id}, {seen.baud} baud, firmware {seen.firmware}) the {words}: id {motor.id}, "
        f"{config.bus.baud} baud, no return delay; then blink its LED and nudge its horn",
        tuple(
            RegisterChange(motor.joint, n, old[n], wanted[n], means.get(n, "")) for n in wanted if old[n] != wanted[n]
        ),
        moves=True,
    )
    with opened_bus(bench, seen.baud) as bus:
        servos = journalled(bus, [servo], bench, COMMAND)
        servos.write_counts("return_delay_time", motor.joint, 0)
        servos = _rename_to(bench, bus, servos, motor, config)
        values = {name: servos.read_counts(name, motor.joint) for name in wanted}
    for name, count in wanted.items():
        if values[name] != count:
            return _Wrong(
                f"{motor.joint}: {name} reads {values[name]}, {count} was written → power it off and on and try again"
            )
    yield from nudge(bench, servos[motor.joint], config.bus.baud)
    seen_turning = f"Did this servo, and only this one, blink and turn? It is the {words} from now on."
    if not (yield from confirmed(bench, seen_turning)):
        return _Wrong(
            f"{motor.joint}: id {motor.id} answered, but the servo at hand did not move → another one is on the cable, or its "
            "gear is broken"
        )
    yield Say(f"{motor.joint}: id {motor.id}, {config.bus.baud} baud, read back", "ok")
    return None


def _differs(found: Scan, motor: MotorSection, config: RobotConfig) -> str:
    """What of a servo that was named is not as it was left, where it is on the cable; "" where it is not, or all is."""
    here = [one for one in found.servos if one.id == motor.id]
    if any(one.clash for one in here):
        return f"two servos answer under id {motor.id}"
    baud = [one for one in here if one.baud != config.bus.baud]
    if baud:
        return f"id {motor.id} answers at {baud[0].baud} baud"
    model = [one for one in here if one.model_number != motor.servo.number]
    return f"id {motor.id} is a {model[0].model}, not a {motor.model}" if model else ""


def _another(found: Scan, config: RobotConfig, motor: MotorSection, named: Sequence[str]) -> _Wrong | None:
    """The servo at hand is another joint's already: it would lose its name."""
    seen = found.servos[0]
    owner = config.motor_with_id(seen.id)
    if owner is None or owner.joint not in named or seen.baud != config.bus.baud:
        return None
    return _Wrong(
        f"{motor.joint}: this servo has id {seen.id}, it is {owner.joint} since before → plug in one that has no name yet"
    )


def _not_one(found: Scan, motor: MotorSection, motors: Sequence[MotorSection], config: RobotConfig) -> _Wrong | None:
    """Why what is on the cable cannot become this joint's servo."""
    clash = [one for one in found.servos if one.clash]
    if found.garbled or clash:
        where = ", ".join(f"id {one.id}" for one in clash) or "one id"
        return _Wrong(
            f"{motor.joint}: two servos answer at once under {where} → unplug all but one: pull the cable that goes on from "
            "the first servo"
        )
    if not found.servos:
        return _Wrong(
            f"{motor.joint}: nothing answers at any baud rate → is 12 V on, and the cable in to the click at both ends?"
        )
    if len(found.servos) > 1:
        known = {
            one.id: m.joint for m in motors for one in found.servos if (one.id, one.baud) == (m.id, config.bus.baud)
        }
        others = ", ".join(f"{known.get(one.id, one.model)} (id {one.id} at {one.baud} baud)" for one in found.servos)
        pull = next((name for name in known.values() if name != motor.joint), "all but the new one")
        return _Wrong(f"{motor.joint}: {len(found.servos)} servos answer: {others} → pull the cable of {pull}")
    seen = found.servos[0]
    if seen.model_number != motor.servo.number:
        places = sorted({JOINTS[m.joint].kind for m in config.motors.values() if m.servo.number == seen.model_number})
        belongs = f"it belongs into a {places[0]}" if places else "this kit has none of these"
        return _Wrong(f"{motor.joint}: this is a {seen.model}, but the place is for a {motor.model} → {belongs}")
    return None


def _rename_to(bench: Bench, bus: Bus, servos: Servos, motor: MotorSection, config: RobotConfig) -> Servos:
    """Id, then baud rate, each heard again at once under the new one; the servos as they answer afterwards."""
    servo = servos[motor.joint]
    servos.write_counts("id", motor.joint, motor.id)
    servos = journalled(bus, [Servo(motor.joint, motor.id, servo.model)], bench, COMMAND)
    servos.write_baud(motor.joint, config.bus.baud)
    return servos


def nudge(
    bench: Bench, servo: Servo, baud: int, angle_rad: float = NUDGE_RAD
) -> Subroutine[tuple[float, frozenset[str]]]:
    """Blink the LED, turn by `angle_rad` and back with little force. Torque is off afterwards.

    Returns how far it went, rad, and which joints of a virtual robot were seen to blink: a real one's only the builder sees.

    Raises:
        HardwareFault: it does not answer, or a guard stopped it.
    """
    config = bare_config(bench, [servo], baud)
    blinked = set[str]()
    with EngineProcess(config) as engine:
        for _ in range(BLINKS):
            for on in (1, 0):
                engine.ask(messages.WriteRegister(servo.joint, "led", on))
                blinked |= _lit(bench) if on else set()
                engine.ask(messages.LetPass(BLINK_S))
        start = engine.ask(messages.Torque(True))
        engine.ask(messages.WriteRegister(servo.joint, "goal_pwm", round(NUDGE_PWM * PWM_FULL)))
        end = start + angle_rad
        if end > config.limits_rad[servo.joint][1]:
            end = start - angle_rad
        for words in engine.notices():
            yield Say(words)
        engine.ask(messages.Ramp(end))
        engine.ask(messages.Hold(SETTLE_S))
        counts: int = engine.ask(messages.ReadRegister("present_position"))[servo.joint]
        went = servo.to_joint(counts * RAD_PER_PULSE) - float(start[0])
        yield Live({servo.joint: went}, "rad", "nudged by")
        engine.ask(messages.Ramp(start))
        engine.ask(messages.Hold(SETTLE_S))
    return abs(went), frozenset(blinked)


def _lit(bench: Bench) -> set[str]:
    """Joints of a virtual robot whose LED is on now."""
    if bench.control is None:
        return set()
    with contextlib.closing(VirtualControl(bench.control)) as eyes:
        return set(eyes.ask("look")["lit"])


# ---- servos that are wired already -----------------------------------------------------------------------------------


def _rename(bench: Bench, found: Scan, motors: Sequence[MotorSection], config: RobotConfig) -> Subroutine[list[str]]:
    """Ask of each servo which joint it is, park those whose id is another's, and name all; what could not be done."""
    left = [motor.joint for motor in motors]
    chosen: dict[str, Scanned] = {}
    for one in found.servos:
        yield Intent(f"blink the LED of id {one.id} and nudge its horn, to see which joint it is", moves=True)
        servo = Servo(f"id {one.id}", one.id, servo_model(one.model_number))
        _, blinked = yield from nudge(bench, servo, one.baud, 0.06)
        fits = [joint for joint in left if config.motors[joint].servo.number == one.model_number]
        question = f"Which joint is id {one.id} ({one.model})?"
        answer: Answer
        if bench.virtual:
            answer = next((joint for joint in fits if joint in blinked), NONE)
            yield Say(f"{question} {answer} (this robot is virtual: it looked itself which one blinked)")
        else:
            own = config.motor_with_id(one.id)
            guess = own.joint if own is not None and own.joint in fits else fits[0] if fits else NONE
            answer = yield Ask(question, (*fits, NONE), default=guess)
        if isinstance(answer, str) and answer in left:
            chosen[answer] = one
            left.remove(answer)
    wanted = baud_code(config.bus.baud)
    changes = [
        RegisterChange(joint, "id", one.id, config.motors[joint].id)
        for joint, one in chosen.items()
        if one.id != config.motors[joint].id
    ] + [
        RegisterChange(joint, "baud_rate", baud_code(one.baud), wanted)
        for joint, one in chosen.items()
        if one.baud != config.bus.baud
    ]
    if changes:
        yield Intent("give these servos the ids and the baud rate of their joints", tuple(changes))
    taken = {one.id for one in found.servos} | {motor.id for motor in motors}
    parking = iter([id for id in PARKING if id not in taken])
    moved: dict[str, Servo] = {}
    with opened_bus(bench) as bus:
        for joint, one in chosen.items():
            bus.line.set_baud(one.baud)
            servo = Servo(joint, one.id, servo_model(one.model_number))
            if one.id != config.motors[joint].id:
                parked = next(parking)
                journalled(bus, [servo], bench, COMMAND).write_counts("id", joint, parked)
                servo = Servo(joint, parked, servo.model)
            moved[joint] = servo
        for joint, servo in moved.items():
            bus.line.set_baud(chosen[joint].baud)
            _rename_to(bench, bus, journalled(bus, [servo], bench, COMMAND), config.motors[joint], config)
            yield Say(f"{joint}: id {config.motors[joint].id}, {config.bus.baud} baud", "ok")
    return [f"{joint}: no servo was named so → plug it in and run the step again" for joint in left]


def locate(bus: Bus, missing: Sequence[MotorSection], config: RobotConfig) -> dict[str, int]:
    """joint → the baud rate at which its id answers instead of the robot's own, for those that are found."""
    before, found = bus.line.baud, dict[str, int]()
    try:
        for baud in BAUDS:
            if baud == config.bus.baud:
                continue
            bus.line.set_baud(baud)
            found |= {
                m.joint: baud for m in missing if m.joint not in found and bus.ping(m.id, insist=True) is not None
            }
    finally:
        bus.line.set_baud(before)
    return found


def _all_named(found: Scan, motors: Sequence[MotorSection], config: RobotConfig) -> bool:
    seen = {(one.id, one.baud, one.model_number) for one in found.servos if not one.clash}
    return not found.garbled and {(m.id, config.bus.baud, m.servo.number) for m in motors} <= seen


def _finding(named: Sequence[str], motors: Sequence[MotorSection], problems: Sequence[str], what: str = "") -> Finding:
    said = " ".join(problems)
    problems = [
        *problems,
        *(
            f"{m.joint}: id {m.id} was not read back → run the step again with --joint {m.joint}"
            for m in motors
            if m.joint not in named and m.joint not in said
        ),
    ]
    ok = not problems
    return Finding(
        "ids",
        ok,
        what or f"{len(named)} of {len(motors)} servos have their id, read back",
        tuple(
            Evidence(f"id of {m.joint}", float(m.id), "", "register 7, read back") for m in motors if m.joint in named
        ),
        "" if ok else "mend what is listed and run the step again: what is named stays named",
        COMMAND,
        data={"named": list(named)},
        problems=tuple(problems),
    )
