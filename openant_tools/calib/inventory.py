"""Inventory: what is set in every servo, EEPROM and RAM, found against expected; what differs is mended or accepted.

How it stands afterwards is the robot's passport: what every later motion compares its servos with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from openant_tools.calib.ids import locate
from openant_tools.calib.mute import let_answer, silenced
from openant_tools.calib.wires import journalled, opened_bus, robot_servos, wait
from openant_tools.comms.bus import Bus, FoundServo
from openant_tools.comms.faults import NoAnswer
from openant_tools.comms.servos import BLOCK_ADDRESS, BLOCK_SIZE, Servo, Servos
from openant_tools.comms.setup import find_bus
from openant_tools.comms.silence import diagnose
from openant_tools.comms.state import Difference, differences_of_robot, in_words, passport_registers, read_state
from openant_tools.comms.vendor_sdk import VendorSdk
from openant_tools.errors import BadInput
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Hands, Intent, Procedure, Progress, RegisterChange, Say, Subroutine
from openant_tools.robot.config import MotorSection, Provenance, RobotConfig
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.registers import EEPROM_END, Register
from openant_tools.robot.servo import baud_code, servo_model

__all__ = ["FIRMWARE_BRINGS", "inventory", "inventory_by_sdk", "silence_words"]

COMMAND = "openant calib inventory"
#: firmware → what it brought (ROBOTIS e-manual); older ones lack it.
FIRMWARE_BRINGS: Mapping[int, str] = {
    38: "the Bus Watchdog, which stops a servo that nobody talks to",
    42: "clearing of turns, time-based profiles",
    45: "Fast Sync Read and the servo's own backup",
}
#: Return delays to try, in counts of 2 µs; the factory's is the last.
DELAYS = (0, 1, 5, 10, 25, 50, 125, 250)
SWEEP_READS = 120
#: The vendor's SDK asks once and waits for milliseconds: a computer that is busy for longer is no silent servo.
SDK_TRIES = 3
FIX_ALL, FIX_ONE, ACCEPT = "fix all", "fix one by one", "accept"


def inventory(bench: Bench) -> Procedure:
    """Look through all servos, mend what is granted, and find the smallest return delay without loss."""
    config = bench.folder.config()
    problems, evidence = list[str](), list[Evidence]()
    table: dict[str, dict[str, int]] = {}
    with opened_bus(bench) as bus:
        bus.names = {motor.id: motor.joint for motor in config.motors.values()}
        yield Progress(None, "asking every id whether it answers")
        found, missing = _ping_all(bus, config)
        if len(missing) == len(config.motors):
            yield Hands("Connect the whole robot: all eight servos on the cable, 12 V on.", "plug")
            wait(bus.clock, 0.8)
            found, missing = _ping_all(bus, config)
        if len(missing) < len(config.motors):
            yield from let_answer(bench, bus, silenced(bus, config.motors.values()), COMMAND)
            found, missing = _ping_all(bus, config)
        if missing:
            problems += yield from _missing(bench, bus, config, missing)
            found, missing = _ping_all(bus, config)
        problems += _wrong_models(found, config)
        present = [
            replace(servo, firmware=found[servo.joint].firmware)
            for servo in robot_servos(config)
            if servo.joint in found and not _wrong(found, config, servo.joint)
        ]
        servos = journalled(bus, present, bench, COMMAND)
        for k, servo in enumerate(present):
            yield Progress(k / max(1, len(present)), f"reading {servo.joint}")
            table[servo.joint] = _read_eeprom(servos, servo, found[servo.joint].firmware)
        yield Say(f"{len(present)} of {len(config.motors)} servos read, {sum(map(len, table.values()))} settings")
        for joint, seen in found.items():
            lacks = [what for firmware, what in FIRMWARE_BRINGS.items() if seen.firmware < firmware]
            evidence.append(Evidence(f"firmware of {joint}", float(seen.firmware), "", "register 6"))
            if lacks:
                yield Say(f"{joint} has firmware {seen.firmware}, without {'; '.join(lacks)}", "warn")
        state = read_state(servos)
        passport = yield from _still_accepted(bench, state, present, config)
        odd = _of_settings(differences_of_robot(present, state, config, passport))
        # What is to be told or written does not rest on one reading.
        for one in odd:
            state[one.joint][one.register] = servos.confirmed_counts(one.register, one.joint)
        odd = _of_settings(differences_of_robot(present, state, config, passport))
        left: list[Difference] = []
        if odd:
            yield Say(f"{len(odd)} settings differ from what they should be", "warn")
            left = yield from _mend(servos, odd)
            problems += [
                f"{one.joint}: {one.register} is {one.found}, expected {one.expected} → accepted" for one in left
            ]
        delay_s = yield from _sweep(bus, servos, present)
        errors = {s.joint: servos.hardware_errors(s.joint) for s in present}
        problems += [f"{joint}: {e.name} → {e.advice}" for joint, found_errors in errors.items() for e in found_errors]
        volts = {s.joint: servos.read("present_input_voltage", s.joint) for s in present}
        state = read_state(servos)
    if delay_s is None:
        problems.append(
            "return delay: no servo could be tried"
            if not present
            else "return delay: answers are lost whatever the delay → look at cables and plugs, then `openant calib comms`"
        )
    else:
        evidence.append(
            Evidence("return delay", delay_s, "s", f"smallest of {len(DELAYS)} without a loss in {SWEEP_READS} reads")
        )
        bench.folder.update({"bus.return_delay_s": delay_s}, provenance=Provenance.measured(COMMAND))
    if volts:
        evidence.append(Evidence("lowest supply", min(volts.values()), "V", "register 144 at rest"))
    bad = (
        len(found) < len(config.motors) or bool(_wrong_models(found, config)) or any(errors.values()) or delay_s is None
    )
    ok = not bad
    return Finding(
        "inventory",
        ok,
        f"{len(present)} of {len(config.motors)} servos as expected"
        + (f", {len(odd) - len(left)} settings mended" if odd else ""),
        tuple(evidence),
        "" if ok else "mend what is listed and run it again",
        COMMAND,
        data={"eeprom": table, "registers": state, "accepted": [one.what for one in left], "volts": volts},
        problems=tuple(problems),
        stands=True,
    )


def inventory_by_sdk(bench: Bench) -> Procedure:
    """What the vendor's own SDK finds in every servo: a second opinion, which writes nothing and keeps nothing."""
    config = bench.folder.config()
    problems, table = list[str](), dict[str, dict[str, int]]()
    found: dict[str, FoundServo] = {}
    with VendorSdk(find_bus(bench.bus, config), config.bus.baud) as sdk:
        for k, servo in enumerate(robot_servos(config)):
            yield Progress(k / len(config.motors), f"the vendor's SDK asks {servo.joint}")
            seen = sdk.ping(servo.id, SDK_TRIES)
            if seen is None:
                problems.append(f"{servo.joint} (id {servo.id}): the vendor's SDK gets no answer: {sdk.why(servo.id)}")
                continue
            found[servo.joint] = seen
            if _wrong(found, config, servo.joint):
                continue
            for stretch in _stretches(servo, seen.firmware):
                start = stretch[0].address
                data = sdk.read(servo.id, start, stretch[-1].end - start, SDK_TRIES)
                if data is None:
                    problems.append(f"{servo.joint}: {stretch[0].name} and what follows: {sdk.why(servo.id)}")
                else:
                    table.setdefault(servo.joint, {}).update(_values(stretch, data))
            if seen.alert:
                problems.append(f"{servo.joint} reports a hardware error → `openant comms reboot --id {servo.id}`")
    problems += _wrong_models(found, config)
    return Finding(
        "inventory",
        not problems,
        f"the vendor's SDK reads {len(table)} of {len(config.motors)} servos, {sum(map(len, table.values()))} items",
        (),
        "" if not problems else f"compare with `{COMMAND}`: what both miss is the bus or the servo, not the program",
        f"{COMMAND} --driver sdk",
        data={"driver": "sdk", "eeprom": table},
        problems=tuple(problems),
    )


def _of_settings(odd: Sequence[Difference]) -> list[Difference]:
    """Without goals, which no bare bus writes: the engine sets them whenever torque comes on."""
    return [one for one in odd if not one.register.startswith("goal_")]


def _still_accepted(
    bench: Bench, state: Mapping[str, Mapping[str, int]], present: Sequence[Servo], config: RobotConfig
) -> Subroutine[Mapping[str, Mapping[str, int]]]:
    """The passport's registers; without those that were accepted once and are no longer meant."""
    passport = passport_registers(bench.folder, real=not bench.virtual)
    plain, kept = (
        differences_of_robot(present, state, config, {}),
        differences_of_robot(present, state, config, passport),
    )
    left = {(one.joint, one.register) for one in kept}
    accepted = [one for one in plain if (one.joint, one.register) not in left]
    if not accepted:
        return passport
    for one in accepted:
        yield Say(f"{one.what}; accepted before", "info")
    if (yield Ask("Keep what was accepted before?", ("yes", "no"), default="yes")) == "yes":
        return passport
    gone = {(one.joint, one.register) for one in accepted}
    return {
        joint: {name: counts for name, counts in table.items() if (joint, name) not in gone}
        for joint, table in passport.items()
    }


def _ping_all(bus: Bus, config: RobotConfig) -> tuple[dict[str, FoundServo], list[MotorSection]]:
    found = {motor.joint: bus.ping(motor.id, insist=True) for motor in config.motors.values()}
    return (
        {joint: seen for joint, seen in found.items() if seen is not None},
        [config.motors[joint] for joint, seen in found.items() if seen is None],
    )


def _missing(bench: Bench, bus: Bus, config: RobotConfig, missing: Sequence[MotorSection]) -> Subroutine[list[str]]:
    """Servos that do not answer: left at another baud rate, which is mended, or not there; in words."""
    yield Progress(None, f"looking for {', '.join(m.joint for m in missing)} at other baud rates")
    elsewhere = locate(bus, missing, config)
    words = []
    wanted = baud_code(config.bus.baud)
    if elsewhere:
        for joint, baud in elsewhere.items():
            yield Say(f"{joint} (id {config.motors[joint].id}) answers at {baud} baud: its rate was left there", "warn")
        if (yield Ask(f"Set them to {config.bus.baud} baud?", ("yes", "no"), default="yes")) == "yes":
            changes = tuple(RegisterChange(j, "baud_rate", baud_code(b), wanted) for j, b in elsewhere.items())
            yield Intent(f"set {', '.join(elsewhere)} to {config.bus.baud} baud", changes)
            for joint, baud in elsewhere.items():
                _set_baud(bench, bus, config.motors[joint], baud, config)
                words.append(f"{joint}: was left at {baud} baud → set to {config.bus.baud}")
            bus.line.set_baud(config.bus.baud)
    silent = [motor for motor in missing if motor.joint not in elsewhere]
    for line in silence_words(bus, silent, config):
        words.append(line)
        yield Say(line, "fail")
    return words


def silence_words(bus: Bus, silent: Sequence[MotorSection], config: RobotConfig) -> list[str]:
    """Why servos are silent: what can be asked is asked; else the cable before the first in its leg."""
    if not silent:
        return []
    legs = dict.fromkeys(JOINTS[joint].leg.name for joint in config.motors)
    chain = config.bus.chain or [[f"hip_{leg}", f"knee_{leg}"] for leg in legs]
    bus.names = {motor.id: motor.joint for motor in config.motors.values()}
    found = diagnose(bus, [motor.id for motor in silent], list(bus.names), chain)
    return [f"{one.what} → {one.remedy}" for one in (found, *found.rest)]


def _set_baud(bench: Bench, bus: Bus, motor: MotorSection, baud: int, config: RobotConfig) -> None:
    bus.line.set_baud(baud)
    found = bus.ping(motor.id, insist=True)
    if found is None:
        raise NoAnswer(f"{motor.joint} (id {motor.id}) answered at {baud} baud and no longer does", where=bus.line.path)
    servos = journalled(bus, [Servo(motor.joint, motor.id, servo_model(found.model_number))], bench, COMMAND)
    servos.set_torque(False)
    servos.write_baud(motor.joint, config.bus.baud)


def _wrong(found: Mapping[str, FoundServo], config: RobotConfig, joint: str) -> bool:
    return found[joint].model_number != config.motors[joint].servo.number


def _wrong_models(found: Mapping[str, FoundServo], config: RobotConfig) -> list[str]:
    """Servos of another model than the place is for; two of one leg that stand in each other's are swapped."""
    wrong = {joint for joint in found if _wrong(found, config, joint)}
    words = []
    for joint in sorted(wrong):
        other = ("knee" if joint.startswith("hip") else "hip") + joint[-3:]
        model = _name(found[joint].model_number)
        if other in wrong and found[other].model_number == config.motors[joint].servo.number:
            if joint < other:
                words.append(
                    f"{joint} and {other} are swapped: id {config.motors[joint].id} is a {model} → exchange their ids "
                    "(`openant calib ids`), or the motors"
                )
        else:
            words.append(
                f"{joint} is a {model}, the place is for a {config.motors[joint].model} → put the right servo in"
            )
    return words


def _name(number: int) -> str:
    try:
        return servo_model(number).name
    except BadInput:
        return f"servo of model number {number}"


def _read_eeprom(servos: Servos, servo: Servo, firmware: int) -> dict[str, int]:
    """Every item below 64 that this firmware has."""
    values: dict[str, int] = {}
    for stretch in _stretches(servo, firmware):
        start = stretch[0].address
        values |= _values(stretch, servos.bus.read(servo.id, start, stretch[-1].end - start))
    return values


def _stretches(servo: Servo, firmware: int) -> list[list[Register]]:
    """The EEPROM's items that this firmware has, in stretches without a hole, each for one read: holes refuse."""
    items = sorted(
        (r for r in servo.model.registers.values() if r.end <= EEPROM_END and r.min_firmware <= firmware),
        key=lambda register: register.address,
    )
    stretches: list[list[Register]] = []
    for item in items:
        if stretches and stretches[-1][-1].end == item.address:
            stretches[-1].append(item)
        else:
            stretches.append([item])
    return stretches


def _values(stretch: Sequence[Register], data: bytes) -> dict[str, int]:
    start = stretch[0].address
    return {r.name: r.decode(data[r.address - start : r.end - start]) for r in stretch}


def _mend(servos: Servos, odd: Sequence[Difference]) -> Subroutine[list[Difference]]:
    """Ask what to do with them, do it; what was accepted as it is."""
    for line in in_words(odd, remedy=False):
        yield Say(line, "warn")
    answer = yield Ask(
        "What to do with them? What you accept is expected from now on.", (FIX_ALL, FIX_ONE, ACCEPT), default=FIX_ALL
    )
    chosen = list(odd) if answer == FIX_ALL else []
    if answer == FIX_ONE:
        for one in odd:
            if (yield Ask(f"Set {_change(one)}?", ("yes", "no"), default="yes")) == "yes":
                chosen.append(one)
    if chosen:
        yield Intent(f"write {len(chosen)} settings, each read back", tuple(_change(one) for one in chosen))
        servos.set_torque(False)
        for one in chosen:
            servos.write_counts(one.register, one.joint, one.expected)
    return [one for one in odd if one not in chosen]


def _change(one: Difference) -> RegisterChange:
    return RegisterChange(one.joint, one.register, one.found, one.expected)


def _sweep(bus: Bus, servos: Servos, present: Sequence[Servo]) -> Subroutine[float | None]:
    """The smallest return delay, s, at which no read of all servos loses an answer; None where none is clean."""
    if not present:
        return None
    kept, ids = bus.timing, [servo.id for servo in present]
    old = servos.read_all("return_delay_time")
    tried: int | None = None
    for delay in DELAYS:
        if any(value != delay for value in servos.read_all("return_delay_time").values()):
            changes = tuple(RegisterChange(j, "return_delay_time", v, delay) for j, v in old.items() if v != delay)
            yield Intent(f"try a return delay of {2 * delay} µs", changes)
            for servo in present:
                servos.write_counts("return_delay_time", servo.joint, delay)
        bus.timing = replace(kept, return_delay_s=delay * 2e-6)
        yield Progress(None, f"{SWEEP_READS} reads with a return delay of {2 * delay} µs")
        lost = sum(
            not answer.ok for _ in range(SWEEP_READS) for answer in bus.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, ids)
        )
        if lost == 0:
            tried = delay
            break
        yield Say(f"{lost} of {SWEEP_READS * len(ids)} answers were lost", "warn")
    bus.timing = kept
    return None if tried is None else tried * 2e-6
