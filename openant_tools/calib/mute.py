"""Servos that keep silent because they were told to: Status Return Level and Protocol 1.0, set back after the question.

Other software leaves both behind. The first stands in memory that forgets, the second in memory that does not; both
writes stand in the journal before they are sent, and are proven by what the servo answers afterwards.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from openant_tools.comms import protocol1
from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus, called
from openant_tools.comms.scan import Scan, scan
from openant_tools.comms.silence import (
    LEVELS,
    PATIENCE_S,
    RETURN_LEVEL,
    ask,
    find_elsewhere,
    patient_ping,
    read_register,
    return_level,
)
from openant_tools.comms.troubles import SILENCE
from openant_tools.errors import HardwareFault
from openant_tools.procedure.journal import EepromWrite, Journal
from openant_tools.procedure.step import Bench, Intent, RegisterChange, Say, Subroutine
from openant_tools.robot.config import MotorSection

__all__ = ["Mute", "in_scan", "let_answer", "scan_and_mend", "silenced"]

PROTOCOL_TYPE, TORQUE_ENABLE = 13, 64
TRIES = 3


@dataclass(frozen=True)
class Mute:
    """A servo that was told to be silent.

    Attributes:
        register: `status_return_level` or `protocol_type`; `old` is what stands there.
    """

    joint: str
    id: int
    baud: int
    register: str
    old: int

    @property
    def words(self) -> str:
        if self.register == "protocol_type":
            return SILENCE["protocol_1"].says.format(who=self.who, baud=self.baud)
        return SILENCE["return_level"].says.format(who=self.who, level=self.old, answers=LEVELS[self.old])

    @property
    def who(self) -> str:
        return called(self.joint, self.id)


def silenced(bus: Bus, motors: Iterable[MotorSection]) -> list[Mute]:
    """Those of `motors` that hear at this baud rate and do not answer everything, and those in Protocol 1.0 at any."""
    found, silent = list[Mute](), list[MotorSection]()
    for motor in motors:
        status, _ = patient_ping(bus, motor.id, PATIENCE_S[:1])
        if status is None:
            silent.append(motor)
            continue
        level = return_level(bus, motor.id)
        if level is not None and level < 2:
            found.append(Mute(motor.joint, motor.id, bus.line.baud, "status_return_level", level))
    elsewhere = find_elsewhere(bus, [motor.id for motor in silent]) if silent else {}
    for motor in silent:
        baud, protocol = elsewhere.get(motor.id, (0, 2))
        if protocol == 1:
            found.append(Mute(motor.joint, motor.id, baud, "protocol_type", 1))
    return found


def in_scan(found: Scan) -> list[Mute]:
    """The same of a scan, in which nobody has said which joint an id is."""
    return [
        Mute(f"id {one.id}", one.id, one.baud, "status_return_level", one.return_level)
        for one in found.servos
        if one.return_level < 2
    ] + [Mute(f"id {id}", id, baud, "protocol_type", 1) for id, baud in found.protocol_1]


def scan_and_mend(bench: Bench, bus: Bus, command: str) -> Subroutine[Scan]:
    """Who is on the bus, once those that were told to be silent answer again."""
    found = scan(bus)
    if in_scan(found):
        yield from let_answer(bench, bus, in_scan(found), command)
        found = scan(bus)
    return found


def let_answer(bench: Bench, bus: Bus, mute: Sequence[Mute], command: str) -> Subroutine[list[str]]:
    """Set them back, once that is granted; what was done, in words.

    Raises:
        HardwareFault: one does not answer as it should afterwards.
    """
    if not mute:
        return []
    for one in mute:
        yield Say(one.words, "warn")
    changes = tuple(RegisterChange(one.joint, one.register, one.old, 2) for one in mute)
    yield Intent(f"let {', '.join(dict.fromkeys(one.joint for one in mute))} answer everything again", changes)
    journal, before, done = Journal(bench.folder.journal), bus.line.baud, list[str]()
    try:
        for one in mute:
            bus.line.set_baud(one.baud)
            journal.append(EepromWrite(one.joint, one.id, one.register, one.old, 2, one.baud), command)
            if not _set_back(bus, one):
                raise HardwareFault(
                    f"{one.words}, and still does after {one.register} = 2 was written",
                    where=bus.line.path,
                    remedy="power it off and on, then run it again",
                )
            done.append(f"{one.words} → {one.register} set to 2")
            yield Say(done[-1], "ok")
    finally:
        bus.line.set_baud(before)
    return done


def _set_back(bus: Bus, one: Mute) -> bool:
    """Write register 68 or 13; whether the servo then says that it is so."""
    for _ in range(TRIES):
        if one.register == "protocol_type":
            # Memory that stays is locked while torque is on.
            ask(bus, protocol1.write(one.id, TORQUE_ENABLE, b"\0"), PATIENCE_S[0])
            ask(bus, protocol1.write(one.id, PROTOCOL_TYPE, b"\2"), PATIENCE_S[0])
            address = PROTOCOL_TYPE
        else:
            # Whether it answers this write is the old level's matter or the new one's; reading back tells.
            ask(bus, p2.write(one.id, RETURN_LEVEL, b"\2").encode(), PATIENCE_S[0])
            address = RETURN_LEVEL
        if read_register(bus, one.id, address, 1) == b"\2":
            return True
    return False
