"""Undo: the journal backwards, each register given its old value where it still has the one that was written."""

from __future__ import annotations

from openant_tools.calib.wires import opened_bus, robot_servos
from openant_tools.comms.bus import Bus
from openant_tools.comms.faults import BrokenAnswer, NoAnswer
from openant_tools.comms.servos import Servo, Servos
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.journal import EepromWrite, Journal, JournalEntry
from openant_tools.procedure.step import Bench, Intent, Procedure, Progress, RegisterChange, Say
from openant_tools.procedure.unfinished import forget
from openant_tools.robot.registers import EEPROM_END
from openant_tools.robot.servo import BAUD_CODES, ServoModel

__all__ = ["undo"]

COMMAND = "openant calib undo"
#: Registers that protect a servo, or who stands beside it, by a bound from above or from below.
UPPER_BOUNDS = frozenset(
    {"temperature_limit", "max_voltage_limit", "pwm_limit", "current_limit", "velocity_limit", "max_position_limit",
     "startup_configuration"}
)  # fmt: skip
LOWER_BOUNDS = frozenset({"min_voltage_limit", "min_position_limit"})


def undo(bench: Bench, *, everything: bool = False) -> Procedure:
    """Take back the writes of the last command in the journal, or all of them.

    Where a servo does not answer, its writes stay and are named; they can be undone later.
    """
    journal = Journal(bench.folder.journal)
    left = journal.open_entries()
    if not everything and left:
        last = left[-1].command
        start = next((k for k in range(len(left) - 1, -1, -1) if left[k].command != last), -1)
        left = left[start + 1 :]
    if bench.joints:
        left = [entry for entry in left if entry.write.joint in bench.joints]
    if not left:
        return Finding("undo", True, "the journal holds nothing that could be undone", (), "", COMMAND)
    models = {servo.joint: servo.model for servo in robot_servos(bench.folder.config())}
    # Memory that forgets falls back by itself with the next power-off.
    backwards = [
        entry
        for entry in reversed(left)
        if entry.write.joint in models and models[entry.write.joint].register(entry.write.register).address < EEPROM_END
    ]
    yield Intent(
        f"take back {len(backwards)} writes of `{left[-1].command}`",
        tuple(RegisterChange(e.write.joint, e.write.register, e.write.new, e.write.old) for e in backwards),
    )
    done, problems = 0, list[str]()
    with opened_bus(bench) as bus:
        for k, entry in enumerate(backwards):
            yield Progress(k / len(backwards), f"{entry.write.joint}: {entry.write.register}")
            bus.line.set_baud(_baud_after(entry.write, bus.line.baud))
            trouble = _take_back(bus, entry, models[entry.write.joint], journal)
            if trouble:
                problems.append(trouble)
                yield Say(trouble, "fail")
            else:
                done += 1
    # What a step had done of its parts is not so any more.
    for command in {entry.command for entry in backwards}:
        forget(bench.folder, command.rpartition(" ")[2], virtual=bench.virtual)
    ok = not problems
    return Finding(
        "undo",
        ok,
        f"{done} of {len(backwards)} writes taken back",
        (Evidence("taken back", float(done), "", "journal.jsonl"),),
        "" if ok else "plug in the servos that are named, one at a time, and run it again",
        COMMAND,
        problems=tuple(problems),
    )


def _baud_after(write: EepromWrite, now: int) -> int:
    return BAUD_CODES[write.new] if write.register == "baud_rate" else write.baud or now


def _take_back(bus: Bus, entry: JournalEntry, model: ServoModel, journal: Journal) -> str:
    """Undo one write; what keeps it from being undone, or nothing."""
    write, item = entry.write, model.register(entry.write.register)
    servo = Servo(write.joint, write.id_after, model)
    place = f"{write.joint} (id {servo.id})"
    try:
        if bus.ping(servo.id, insist=True) is None:
            if write.register in ("id", "baud_rate") and bus.ping(write.id, insist=True) is not None:
                journal.append(
                    EepromWrite(write.joint, write.id, write.register, write.old, write.old), COMMAND, entry.number
                )
                return ""  # the program died before the write was sent
            return f"{place} does not answer at {bus.line.baud} baud → plug it in and run undo again"
        now = Servos(bus, [servo]).confirmed_counts(write.register, write.joint)
        if now == write.new:
            if write.register == "id" and bus.ping(write.old) is not None:
                return (
                    f"{place} cannot have id {write.old} again, another servo has it → leave only this one on the cable"
                )
            if not write.confirmed and _lowers_protection(write):
                return (
                    f"{place}: {write.register} would go from {now} to {write.old}, less protection, and the journal's line "
                    f"{entry.number} does not say that {write.old} was read twice → left as it is; `openant calib inventory` "
                    "sets what it should be"
                )
            bus.write(servo.id, 64, b"\0", "torque off")
            journal.append(
                EepromWrite(write.joint, servo.id, write.register, now, write.old, bus.line.baud, confirmed=True),
                COMMAND,
                entry.number,
            )
            bus.write(servo.id, item.address, item.encode(write.old), f"{write.register} = {write.old}")
            if write.register == "baud_rate":
                bus.line.set_baud(BAUD_CODES[write.old])
            reader = write.old if write.register == "id" else servo.id
            if item.decode(bus.read(reader, item.address, item.size)) != write.old:
                return f"{place}: {write.register} does not read back {write.old} → run undo again"
        elif now != write.old:
            return f"{place}: {write.register} is {now} by now, not {write.new} as the journal says → left as it is"
    except (NoAnswer, BrokenAnswer) as error:
        return str(error)
    return ""


def _lowers_protection(write: EepromWrite) -> bool:
    """Whether the old value lets the servo do or bear more than the new one."""
    if write.register == "shutdown":
        return bool(write.new & ~write.old)  # a bit each: what switches torque off
    return (write.register in UPPER_BOUNDS and write.old > write.new) or (
        write.register in LOWER_BOUNDS and write.old < write.new
    )
