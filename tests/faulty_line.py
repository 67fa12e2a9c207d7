"""A bus of servos in memory whose answers come late, doubled, swapped, echoed, stolen, broken or not at all, and a clock that jumps.

Each register's value follows from id and address, so that every wrong value shows; register 120 is the tick, and the
bytes behind it hold the microsecond in which the block was read.
"""

from __future__ import annotations

import random
import struct
from dataclasses import dataclass, field

from wire import MemoryLine

from openant_tools.comms import protocol2 as p2

__all__ = ["FaultyLine", "register_bytes"]

IDS = (10, 11, 20, 21, 30, 31, 40, 41)
#: A servo answers so long after it was asked, and one behind the other, s.
ANSWER_S = 0.2e-3
#: What refuses to be read.
HOLE = 200
#: Where what was written is kept; all else is fixed.
WRITABLE = 65


def register_bytes(id: int, address: int, count: int) -> bytes:
    """What stands there for good."""
    return bytes((id * 37 + at * 101 + (id * at >> 3) * 7 + 13) & 0xFF for at in range(address, address + count))


@dataclass(kw_only=True)
class FaultyLine(MemoryLine):
    """Servos whose answers go wrong.

    Attributes:
        faults: kind of fault → its probability for each answer; kinds are `late`, `doubled`, `lost`, `stolen`, `flipped`,
            `swapped` (with the next servo's), `noise`, and `echoed` (of each request).
        latest_s: how late an answer may be.
        written_values: id → byte in register 65.
    """

    faults: dict[str, float]
    seed: int = 0
    latest_s: float = 0.1
    written_values: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._t = 100.0
        self._chance = random.Random(self.seed)

    def write(self, data: bytes) -> None:
        self.written += len(data)
        if self._happens("echoed"):
            self.bring(data, self._t)
        self._t += len(data) * 10 / self.baud
        for item in p2.Parser().feed(data):
            assert isinstance(item, p2.Instruction)
            self._answer(item)

    # ---- servos

    def _happens(self, kind: str) -> bool:
        return self._chance.random() < self.faults.get(kind, 0.0)

    def _answer(self, asked: p2.Instruction) -> None:
        replies: list[p2.Status] = []
        at = self._t
        if asked.code == p2.Inst.PING and asked.id in IDS:
            replies.append(p2.Status(asked.id, 0, register_bytes(asked.id, 0, 3)))
        elif asked.code == p2.Inst.READ and asked.id in IDS:
            address, count = struct.unpack("<HH", asked.params)
            replies.append(self._read(asked.id, address, count, at))
        elif asked.code == p2.Inst.WRITE and asked.id in IDS:
            address = int.from_bytes(asked.params[:2], "little")
            if address == WRITABLE:
                self.written_values[asked.id] = asked.params[2]
            replies.append(p2.Status(asked.id, 0 if address == WRITABLE else p2.Error.ACCESS))
        elif asked.code in (p2.Inst.SYNC_READ, p2.Inst.FAST_SYNC_READ):
            address, count = struct.unpack("<HH", asked.params[:4])
            for k, id in enumerate(asked.params[4:]):
                replies.append(self._read(id, address, count, at + ANSWER_S + k * (count + 11) * 10 / self.baud))
        if asked.code == p2.Inst.FAST_SYNC_READ:
            parts = [p2.JoinedAnswer(reply.id, reply.error, reply.params) for reply in replies]
            self._deliver([b"".join(p2.encode_joined(parts))], at)
        else:
            self._deliver([reply.encode() for reply in replies], at)

    def _read(self, id: int, address: int, count: int, t: float) -> p2.Status:
        if address <= HOLE < address + count:
            return p2.Status(id, p2.Error.ACCESS)
        data = bytearray(register_bytes(id, address, count))
        if address == 120 and count >= 10:
            data[:10] = struct.pack("<Hq", int(t * 1e3) % 0x8000, int(t * 1e6))
        if address == WRITABLE:
            data[0] = self.written_values.get(id, 0)
        return p2.Status(id, 0, bytes(data))

    def _deliver(self, packets: list[bytes], at: float) -> None:
        if len(packets) > 1 and self._happens("swapped"):
            k = self._chance.randrange(len(packets) - 1)
            packets[k], packets[k + 1] = packets[k + 1], packets[k]
        for data in packets:
            at += ANSWER_S + len(data) * 10 / self.baud
            t = at + self._chance.uniform(0.0, self.latest_s) if self._happens("late") else at
            if self._happens("doubled"):
                self.bring(
                    data, t + self._chance.choice((0.0, 0.5e-3, 2e-3, 10e-3, self._chance.uniform(0, self.latest_s)))
                )
            if self._happens("lost"):
                continue
            if self._happens("stolen"):
                first = self._chance.randrange(len(data))
                data = data[:first] + data[first + self._chance.randrange(1, len(data)) :]
            if self._happens("flipped"):
                broken = bytearray(data)
                broken[self._chance.randrange(len(broken))] ^= 1 << self._chance.randrange(8)
                data = bytes(broken)
            if self._happens("noise"):
                data = self._chance.randbytes(self._chance.randrange(1, 30)) + data
            self.bring(data, t)
