"""Who is on a bus: every baud rate, every ID, in about two seconds, whether IDs are unique, and whether that is all."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from openant_tools.comms.bus import Bus, FoundServo
from openant_tools.comms.faults import BrokenAnswer, Cause
from openant_tools.comms.line import SerialLine
from openant_tools.comms.ports import Host
from openant_tools.comms.protocol1 import ping as protocol_1_packet
from openant_tools.comms.protocol1 import statuses
from openant_tools.comms.protocol2 import BROADCAST
from openant_tools.comms.silence import (
    RETURN_LEVEL,
    Silence,
    ask,
    diagnose,
    patient_ping,
    protocol_1_ping,
    reader_words,
    return_level,
)
from openant_tools.comms.troubles import SILENCE
from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.servo import BAUD_CODES, servo_model

__all__ = ["BAUDS", "Scan", "Scanned", "scan", "scan_by_sdk"]

#: The platform's rate and the factory's first: most scans could end there.
BAUDS = (1_000_000, 57_600, *(rate for rate in BAUD_CODES.values() if rate not in (1_000_000, 57_600)))
#: Ids that are asked singly where all were asked and they kept silent: the Ant's, and the factory's.
KNOWN = (*(joint.id for joint in JOINTS.values()), 1)
#: s that the vendor's SDK allows each id to be late with its answer to a broadcast ping; the highest id is 252.
SLOT_S = 3e-3
PATIENT_S = 252 * SLOT_S + 0.03
#: s, where nobody has spoken: up to id 33 within the first, up to 43 while the line is listened to for Protocol 1.0
SHORT_S, QUIET_S, SINGLE_S = 0.1, 0.05, 0.03
#: Reads of the block of changing registers: two servos with one id answer them differently, even where pings agree.
PROOFS = 3
PROOF_ADDRESS, PROOF_SIZE = 120, 27


@dataclass(frozen=True)
class Scanned:
    """A servo found.

    Attributes:
        clash: its answers are garbled as if two servos shared the id.
        alert: it has a hardware error.
        return_level: what it answers (register 68): 0 pings, 1 reads too, 2 all.
        lossy: some of its answers did not come.
    """

    id: int
    baud: int
    model_number: int
    firmware: int
    clash: bool = False
    alert: bool = False
    return_level: int = 2
    lossy: bool = False

    @property
    def model(self) -> str:
        try:
            return servo_model(self.model_number).name
        except BadInput:
            return f"model number {self.model_number}"


@dataclass(frozen=True)
class Scan:
    """What one bus has.

    Attributes:
        garbled: baud rate → why nothing could be read though something spoke.
        doubts: why others may be missing from the list, in words; empty where it is whole.
        protocol_1: (id, baud rate) of servos that speak Protocol 1.0 and so are none of `servos`.
    """

    servos: tuple[Scanned, ...]
    garbled: dict[int, str]
    doubts: tuple[str, ...] = ()
    protocol_1: tuple[tuple[int, int], ...] = ()

    @property
    def certain(self) -> bool:
        """Whether the list is whole, as far as can be told."""
        return not self.doubts and not self.garbled


def scan(
    bus: Bus,
    bauds: Iterable[int] = BAUDS,
    *,
    known: Collection[int] = KNOWN,
    host: Host | None = None,
) -> Scan:
    """Ask everyone at every baud rate; the line keeps the rate it had before. Nothing is written.

    Where something spoke, at the line's own rate, and at a few `bauds` named, the latest answer is waited for that the
    vendor's SDK would wait for, and those of `known` who kept silent are asked singly.
    """
    before, bauds = bus.line.baud, tuple(bauds)
    found, garbled, other = list[Scanned](), dict[int, str](), list[tuple[int, int]]()
    doubts = _read_by_others(bus.line.path, host)
    reader = bool(doubts)
    try:
        for baud in bauds:
            bus.line.set_baud(baud)
            rate = _Rate(bus, baud == before or len(bauds) < 3, known, stolen=reader)
            try:
                found += rate.servos()
            except BrokenAnswer as error:
                garbled[baud] = str(error)
            other += [(id, baud) for id in rate.protocol_1]
            doubts += rate.doubts
            if not reader:
                doubts += _lossy(bus, [one for one in found if one.baud == baud and one.lossy], host)
    finally:
        bus.line.set_baud(before)
    for id, baud in other:
        doubts.append(_words("protocol_1", who=f"servo {id}", baud=baud))
    return Scan(tuple(found), garbled, tuple(dict.fromkeys(doubts)), tuple(other))


class _Rate:
    """One baud rate of a scan."""

    def __init__(self, bus: Bus, patient: bool, known: Collection[int], *, stolen: bool) -> None:
        self.bus, self.patient, self.known, self.stolen = bus, patient, known, stolen
        self.doubts: list[str] = []
        self.protocol_1: list[int] = []

    def servos(self) -> list[Scanned]:
        bus = self.bus
        seen = {} if self.patient else self._all(SHORT_S)
        heard = ask(bus, protocol_1_packet(BROADCAST), SINGLE_S)
        self._take_protocol_1(heard.data)
        if self.patient or seen or heard.statuses:
            seen |= self._all(PATIENT_S)
        if self.patient or seen:
            missing = [id for id in self.known if id not in seen]
            alone = {id: one for id in missing if (one := self._alone(id)) is not None}
            if alone:
                who = ", ".join(f"servo {id}" for id in alone)
                self.doubts.append(_words("broadcast_short", who=who))
            seen |= alone
            for id in missing:
                if id not in seen and id not in self.protocol_1 and protocol_1_ping(bus, id, SINGLE_S) == [id]:
                    self.protocol_1.append(id)
        return [_examined(bus, seen[id], stolen=self.stolen) for id in sorted(seen)]

    def _all(self, wait_s: float) -> dict[int, FoundServo]:
        bus, noise, began = self.bus, self.bus.statistics.noise_bytes, self.bus.clock.now()
        found = {one.id: one for one in bus.broadcast_ping(first_s=wait_s, quiet_s=QUIET_S)}
        noise = bus.statistics.noise_bytes - noise
        if noise:
            self.doubts.append(_words("garbled_list", count=noise, baud=bus.line.baud))
        if wait_s == PATIENT_S and bus.clock.now() - began > wait_s + QUIET_S / 2:
            self.doubts.append(_words("still_coming", baud=bus.line.baud, seconds=number(wait_s, "s")))
        return found

    def _alone(self, id: int) -> FoundServo | None:
        status, _ = patient_ping(self.bus, id, (SINGLE_S,))
        if status is None:
            return None
        return FoundServo(id, int.from_bytes(status.params[:2], "little"), status.params[2], status.alert)

    def _take_protocol_1(self, data: bytes) -> None:
        heard = statuses(data.removeprefix(protocol_1_packet(BROADCAST)))
        self.protocol_1 += [one.id for one in heard if one.id < BROADCAST and not one.params]


def _examined(bus: Bus, seen: FoundServo, *, stolen: bool) -> Scanned:
    """Whether the servo's answers are whole, and which questions it answers; what somebody else reads proves neither."""
    reads = [bus.sync_read(PROOF_ADDRESS, PROOF_SIZE, [seen.id])[0] for _ in range(PROOFS)]
    broken = sum(answer.cause in (Cause.CRC, Cause.SHORT) for answer in reads)
    level = bus.sync_read(RETURN_LEVEL, 1, [seen.id])[0]
    silent = sum(answer.data is None for answer in (*reads, level)) - broken
    mute = not stolen and silent == PROOFS + 1 and return_level(bus, seen.id) == 0
    return Scanned(
        seen.id, bus.line.baud, seen.model_number, seen.firmware,
        clash=broken > PROOFS // 2,
        alert=seen.alert,
        return_level=0 if mute else level.data[0] if level.data else 2,
        lossy=bool(silent) and not mute,
    )  # fmt: skip


def _lossy(bus: Bus, servos: Collection[Scanned], host: Host | None) -> list[str]:
    """Why servos that were found lose answers: whoever is lost wholly is not in the list."""
    if not servos:
        return []
    found: Silence = diagnose(bus, [one.id for one in servos], host=host)
    return [found.words]


def _words(cause: str, **values: Any) -> str:
    trouble = SILENCE[cause]
    return f"{trouble.says.format(**values)} → {trouble.do.format(**values)}"


def scan_by_sdk(path: str, bauds: Iterable[int] = BAUDS) -> Scan:
    """The same question asked by the vendor's SDK, which waits for 252 ids at each rate: about ten seconds.

    It tells neither collisions from silence nor who answers what; 4.5 Mbaud it does not know.

    Raises:
        HardwareFault: the port does not open.
    """
    from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, PacketHandler, PortHandler

    SerialLine(path, BAUDS[0]).close()  # which says why it does not open; the SDK takes no heed of who holds it
    port, packets = PortHandler(path), PacketHandler(2.0)
    found, doubts = list[Scanned](), _read_by_others(path)
    try:
        for baud in bauds:
            if not port.setBaudRate(baud):
                continue
            answers, result = packets.broadcastPing(port)
            found += [Scanned(id, baud, model, firmware) for id, (model, firmware) in sorted(answers.items())]
            if result not in (COMM_SUCCESS, COMM_RX_TIMEOUT):
                doubts.append(f"at {baud} baud the SDK says: {packets.getTxRxResult(result).strip(' []')}")
    finally:
        if port.is_open:
            port.closePort()
    return Scan(tuple(found), {}, tuple(doubts))


def _read_by_others(path: str, host: Host | None = None) -> list[str]:
    words = reader_words(path, host)
    return [f"{words} → {SILENCE['second_reader'].do}"] if words else []
