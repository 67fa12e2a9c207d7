"""Who is on a bus: every baud rate, every ID, in less than two seconds, and whether IDs are unique."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from openant_tools.comms.bus import Bus
from openant_tools.comms.faults import BrokenAnswer, Cause
from openant_tools.errors import BadInput
from openant_tools.robot.servo import BAUD_CODES, servo_model

__all__ = ["Scan", "Scanned", "scan"]

#: The platform's rate and the factory's first: most scans could end there.
BAUDS = (1_000_000, 57_600, *(rate for rate in BAUD_CODES.values() if rate not in (1_000_000, 57_600)))
#: Reads of the block of changing registers: two servos with one id answer them differently, even where pings agree.
PROOFS = 3
PROOF_ADDRESS, PROOF_SIZE = 120, 27


@dataclass(frozen=True)
class Scanned:
    """A servo found.

    Attributes:
        clash: its answers are garbled as if two servos shared the id.
        alert: it has a hardware error.
    """

    id: int
    baud: int
    model_number: int
    firmware: int
    clash: bool = False
    alert: bool = False

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
    """

    servos: tuple[Scanned, ...]
    garbled: dict[int, str]


def scan(bus: Bus, bauds: Iterable[int] = BAUDS, progress: Callable[[int], None] = lambda baud: None) -> Scan:
    """Ask everyone at every baud rate; the line keeps the rate it had before."""
    before, found, garbled = bus.line.baud, list[Scanned](), dict[int, str]()
    try:
        for baud in bauds:
            progress(baud)
            bus.line.set_baud(baud)
            try:
                seen = bus.broadcast_ping()
            except BrokenAnswer as error:
                garbled[baud] = str(error)
                continue
            found += [
                Scanned(one.id, baud, one.model_number, one.firmware, _clashes(bus, one.id), one.alert) for one in seen
            ]
    finally:
        bus.line.set_baud(before)
    return Scan(tuple(found), garbled)


def _clashes(bus: Bus, id: int) -> bool:
    answers = [bus.sync_read(PROOF_ADDRESS, PROOF_SIZE, [id])[0] for _ in range(PROOFS)]
    broken = sum(answer.cause in (Cause.CRC, Cause.SHORT) for answer in answers)
    return broken > PROOFS // 2
