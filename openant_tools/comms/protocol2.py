"""Dynamixel Protocol 2.0: packets to bytes and bytes to packets, for both ends of the wire.

The driver encodes instructions and parses statuses, the virtual servo does the reverse; both use this one codec.
A packet is `FF FF FD 00 | ID | LEN (2) | INST | parameters | CRC (2)`, numbers little-endian, LEN the count of bytes
after itself. Inside INST…parameters each `FF FF FD` is followed by a stuffed `FD`, so a header can stand nowhere
else; the joined replies of fast reads are the exception, they are not stuffed. A status is INST 0x55 with the error
byte before its parameters. Source: ROBOTIS e-manual, Protocol 2.0.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

__all__ = [
    "ALERT_BIT",
    "BROADCAST",
    "HEADER",
    "MAX_ID",
    "MAX_PACKET",
    "Error",
    "Garbage",
    "Inst",
    "Instruction",
    "JoinedAnswer",
    "JoinedStatus",
    "Parser",
    "Reason",
    "Status",
    "SyncWriteTemplate",
    "action",
    "bulk_read",
    "bulk_write",
    "clear_multi_turn",
    "control_table_backup",
    "control_table_restore",
    "crc16",
    "encode_joined",
    "factory_reset",
    "fast_sync_read",
    "ping",
    "read",
    "reboot",
    "reg_write",
    "split_joined",
    "stuff",
    "sync_read",
    "sync_write",
    "unstuff",
    "write",
]

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 254
MAX_ID = 252
#: bytes of a whole packet, both ways: the buffer of ROBOTIS' own SDK
MAX_PACKET = 1024
ALERT_BIT = 0x80

_MARK = HEADER[:3]
_STUFFED = _MARK + b"\xfd"
_BODY = 7  # header (4), ID, LEN (2)
_INSTRUCTION_LEN = 3  # INST and CRC
_STATUS_LEN = 4  # INST, ERR and CRC


class Inst(IntEnum):
    """Instruction codes; STATUS marks a reply."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    CONTROL_TABLE_BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class Error(IntEnum):
    """What a servo says of the instruction it answers (bits 6:0 of the error byte)."""

    OK = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class Reason(Enum):
    """Why bytes are not a packet."""

    NOISE = "bytes outside any packet"
    CRC = "checksum does not match"
    SHORT = "packet broke off"
    HEADER = "impossible header: reserved byte, ID or length"
    UNSTUFFED = "a bare header mark inside a packet"


@dataclass(frozen=True, slots=True)
class Instruction:
    """What the host sends. `code` may be any byte: unknown instructions exist on real buses."""

    id: int
    code: int
    params: bytes = b""

    def encode(self) -> bytes:
        return _frame(self.id, bytes((self.code,)) + self.params)


@dataclass(frozen=True, slots=True)
class Status:
    """One servo's reply. `error` is the raw byte: the alert bit and the code of `Error`."""

    id: int
    error: int = 0
    params: bytes = b""

    @property
    def alert(self) -> bool:
        """Hardware Error Status (register 70) is not zero; the instruction itself may have been done."""
        return bool(self.error & ALERT_BIT)

    @property
    def code(self) -> int:
        """Bits 6:0, see `Error`; 0 where the instruction was done."""
        return self.error & ~ALERT_BIT & 0xFF

    def encode(self) -> bytes:
        return _frame(self.id, bytes((Inst.STATUS, self.error)) + self.params)


@dataclass(frozen=True, slots=True)
class JoinedStatus:
    """A whole reply to a fast read, its last CRC verified; `split_joined` gives each servo's part."""

    raw: bytes


class JoinedAnswer(NamedTuple):
    """One servo's part of a joined reply, verified by the CRC that runs over everything before it."""

    id: int
    error: int
    params: bytes


@dataclass(frozen=True, slots=True)
class Garbage:
    """Bytes that are no packet. `id` is what a broken packet claimed, and may itself be wrong."""

    data: bytes
    reason: Reason
    id: int | None = None


def _crc_table() -> list[int]:
    """CRC-16 of every 16-bit word, polynomial 0x8005, most significant bit first, start 0.

    The CRC is linear over GF(2): the table doubles with each bit by one exclusive-or.
    """
    table, bit = [0], 0x8005
    for _ in range(16):
        table += [value ^ bit for value in table]
        bit = (bit << 1) & 0xFFFF ^ (0x8005 if bit & 0x8000 else 0)
    return table


_CRC = _crc_table()


_WORDS = [struct.Struct(f">{count}H").unpack_from for count in range(MAX_PACKET // 2 + 1)]


def crc16(data: bytes | bytearray | memoryview, crc: int = 0) -> int:
    """CRC-16 of Protocol 2.0 (polynomial 0x8005, not reflected), continued from `crc`; two bytes a step."""
    count = len(data)
    odd = count & 1
    if odd:
        crc = ((crc << 8) & 0xFFFF) ^ _CRC[(crc >> 8) ^ data[0]]
    table = _CRC
    words = _WORDS[count >> 1] if count <= MAX_PACKET else struct.Struct(f">{count >> 1}H").unpack_from
    for word in words(data, odd):
        crc = table[crc ^ word]
    return crc


def stuff(body: bytes) -> bytes:
    """Insert `FD` after each `FF FF FD` of INST…parameters."""
    return body.replace(_MARK, _STUFFED)


def unstuff(body: bytes) -> bytes:
    """Undo `stuff`."""
    return body.replace(_STUFFED, _MARK)


def _frame(id: int, body: bytes) -> bytes:
    if not (0 <= id <= MAX_ID or id == BROADCAST):
        raise ValueError(f"no packet can carry ID {id}")
    body = body.replace(_MARK, _STUFFED)
    packet = HEADER + struct.pack("<BH", id, len(body) + 2) + body
    if len(packet) + 2 > MAX_PACKET:
        raise ValueError(f"a packet of {len(packet) + 2} bytes; servos take {MAX_PACKET}")
    return packet + struct.pack("<H", crc16(packet))


class Parser:
    """Bytes in any portions to packets, for either end of the wire.

    `feed` never raises and keeps at most one packet's worth of bytes. What it returns as a packet has a right
    length, a right CRC and no bare header inside; everything else comes back as `Garbage`, and no byte is lost: the
    parser goes on at the next possible header, even one inside the broken packet.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Bytes of a packet not yet complete."""
        return len(self._buffer)

    def feed(self, data: bytes | bytearray | memoryview) -> list[Instruction | Status | JoinedStatus | Garbage]:
        """Take more bytes; return what became clear, in the order of the wire."""
        self._buffer += data
        found: list[Instruction | Status | JoinedStatus | Garbage] = []
        while self._buffer and self._step(found):
            pass
        return found

    def flush(self) -> list[Instruction | Status | JoinedStatus | Garbage]:
        """The line has gone quiet: give up the packet that broke off and return what stands behind it."""
        found: list[Instruction | Status | JoinedStatus | Garbage] = []
        while self._buffer:
            if not self._step(found):
                whole_header = self._buffer.startswith(HEADER)
                id = self._buffer[4] if len(self._buffer) > 4 else None
                self._drop(found, Reason.SHORT if whole_header else Reason.NOISE, id, search_from=1, to_end=True)
        return found

    def _step(self, found: list[Instruction | Status | JoinedStatus | Garbage]) -> bool:
        """Settle what stands at the head of the buffer; False where more bytes are needed to tell."""
        buffer = self._buffer
        if not buffer.startswith(HEADER):
            if HEADER.startswith(buffer):
                return False
            self._drop(found, Reason.NOISE, None, search_from=0)
            return True
        if len(buffer) < _BODY + 1:
            return False
        id, length, code = buffer[4], buffer[5] | buffer[6] << 8, buffer[7]
        joined = id == BROADCAST and code == Inst.STATUS
        shortest = _STATUS_LEN if code == Inst.STATUS else _INSTRUCTION_LEN
        if not (id <= MAX_ID or id == BROADCAST) or not shortest <= length <= MAX_PACKET - _BODY:
            self._drop(found, Reason.HEADER, id, search_from=1)
            return True
        end = _BODY + length
        if not joined:
            # No stuffed packet can hold a header: the one that begins here broke off, and need not be waited for.
            inner = buffer.find(HEADER, _BODY, min(end - 2, len(buffer)))
            if inner >= 0:
                self._drop(found, Reason.SHORT, id, search_from=1)
                return True
        if len(buffer) < end:
            return False
        raw = bytes(buffer[:end])
        if crc16(raw[:-2]) != raw[-2] | raw[-1] << 8:
            self._drop(found, Reason.CRC, id, search_from=1)
            return True
        if joined:
            found.append(JoinedStatus(raw))
        else:
            body = unstuff(raw[_BODY:-2])
            if stuff(body) != raw[_BODY:-2]:
                self._drop(found, Reason.UNSTUFFED, id, search_from=1)
                return True
            found.append(Status(id, body[1], body[2:]) if code == Inst.STATUS else Instruction(id, code, body[1:]))
        del buffer[:end]
        return True

    def _drop(
        self,
        found: list[Instruction | Status | JoinedStatus | Garbage],
        reason: Reason,
        id: int | None,
        *,
        search_from: int,
        to_end: bool = False,
    ) -> None:
        """Report the bytes before the next possible header as garbage and go on there."""
        buffer = self._buffer
        at = buffer.find(HEADER, search_from)
        if at < 0:
            at = len(buffer)
            if not to_end:
                # A header may have begun in the last three bytes.
                for tail in (3, 2, 1):
                    if at - tail >= search_from and HEADER.startswith(buffer[at - tail :]):
                        at -= tail
                        break
        found.append(Garbage(bytes(buffer[:at]), reason, id))
        del buffer[:at]


def split_joined(data: bytes, expected: Sequence[tuple[int, int]]) -> list[JoinedAnswer]:
    """The verified parts of a reply to a fast read, as far as it goes.

    Args:
        data: what arrived, from the packet's header on; may break off anywhere.
        expected: (id, bytes of data) of each servo asked, in that order.

    Returns:
        The answers whose CRC is right, up to the first that is missing, out of turn or broken: each CRC runs over
        the whole packet so far, so that nothing behind a broken part can be trusted.
    """
    answers: list[JoinedAnswer] = []
    total = 1 + sum(4 + count for _, count in expected)
    head = HEADER + struct.pack("<BHB", BROADCAST, total, Inst.STATUS)
    if data[: len(head)] != head:
        return answers
    crc, at = crc16(head), len(head)
    for id, count in expected:
        part = data[at : at + count + 4]
        if len(part) < count + 4 or part[1] != id:
            break
        crc = crc16(part[:-2], crc)
        if crc != part[-2] | part[-1] << 8:
            break
        answers.append(JoinedAnswer(id, part[0], bytes(part[2:-2])))
        crc, at = crc16(part[-2:], crc), at + len(part)
    return answers


def encode_joined(parts: Sequence[JoinedAnswer]) -> list[bytes]:
    """The joined reply, cut into what each servo sends in turn: the first sends the header too."""
    total = 1 + sum(4 + len(part.params) for part in parts)
    pieces: list[bytes] = []
    crc = 0
    for part in parts:
        piece = bytes((part.error, part.id)) + part.params
        if not pieces:
            piece = HEADER + struct.pack("<BHB", BROADCAST, total, Inst.STATUS) + piece
        crc = crc16(piece, crc)
        tail = struct.pack("<H", crc)
        crc = crc16(tail, crc)
        pieces.append(piece + tail)
    return pieces


# ---- the instructions, one function each -------------------------------------------------------------------------


def ping(id: int) -> Instruction:
    """Who is there? `BROADCAST` asks all."""
    return Instruction(id, Inst.PING)


def read(id: int, address: int, count: int) -> Instruction:
    return Instruction(id, Inst.READ, struct.pack("<HH", address, count))


def write(id: int, address: int, data: bytes) -> Instruction:
    return Instruction(id, Inst.WRITE, struct.pack("<H", address) + data)


def reg_write(id: int, address: int, data: bytes) -> Instruction:
    """A write that waits for `action`."""
    return Instruction(id, Inst.REG_WRITE, struct.pack("<H", address) + data)


def action(id: int = BROADCAST) -> Instruction:
    return Instruction(id, Inst.ACTION)


def factory_reset(id: int, option: int) -> Instruction:
    """Option 0xFF: everything; 0x01: all but the ID; 0x02: all but ID and baud rate."""
    return Instruction(id, Inst.FACTORY_RESET, bytes((option,)))


def reboot(id: int) -> Instruction:
    return Instruction(id, Inst.REBOOT)


def clear_multi_turn(id: int) -> Instruction:
    """Fold Present Position to one turn; refused while the servo moves."""
    return Instruction(id, Inst.CLEAR, b"\x01DXL\x22")


def control_table_backup(id: int) -> Instruction:
    """Keep the control table in the servo's own flash; refused while torque is on."""
    return Instruction(id, Inst.CONTROL_TABLE_BACKUP, b"\x01CTRL")


def control_table_restore(id: int) -> Instruction:
    """Bring the backup back; the servo reboots."""
    return Instruction(id, Inst.CONTROL_TABLE_BACKUP, b"\x02CTRL")


def sync_read(address: int, count: int, ids: Sequence[int]) -> Instruction:
    return Instruction(BROADCAST, Inst.SYNC_READ, struct.pack("<HH", address, count) + bytes(ids))


def fast_sync_read(address: int, count: int, ids: Sequence[int]) -> Instruction:
    """As `sync_read`, answered by one joined packet; firmware 45 or later."""
    return Instruction(BROADCAST, Inst.FAST_SYNC_READ, struct.pack("<HH", address, count) + bytes(ids))


def sync_write(address: int, count: int, data: Mapping[int, bytes]) -> Instruction:
    """The same registers of several servos, `count` bytes each; never answered."""
    parts = [struct.pack("<HH", address, count)]
    for id, values in data.items():
        if len(values) != count:
            raise ValueError(f"{len(values)} bytes for ID {id} in a sync write of {count}")
        parts.append(bytes((id,)) + values)
    return Instruction(BROADCAST, Inst.SYNC_WRITE, b"".join(parts))


class SyncWriteTemplate:
    """One sync write of whole numbers, encoded again and again: everything that does not change is made once.

    Args:
        address: of the register.
        format: of one value, as in `struct`, such as "i".
        ids: in order.
    """

    def __init__(self, address: int, format: str, ids: Sequence[int]) -> None:
        self._address, self._value, self._ids = address, struct.Struct("<" + format), tuple(ids)
        self._pack = struct.Struct("<" + ("B" + format) * len(ids)).pack
        self._numbers = [id for id in ids for _ in range(2)]
        size = self._value.size
        length = 7 + len(ids) * (1 + size)
        self._head = HEADER + struct.pack("<BHBHH", BROADCAST, length, Inst.SYNC_WRITE, address, size)
        self._crc = crc16(self._head)

    def encode(self, values: Sequence[int]) -> bytes:
        """The whole packet for these values, in the order of the ids; equal to `sync_write(…).encode()`."""
        self._numbers[1::2] = values
        body = self._pack(*self._numbers)
        if _MARK in body:
            data = {id: self._value.pack(value) for id, value in zip(self._ids, values, strict=True)}
            return sync_write(self._address, self._value.size, data).encode()
        return self._head + body + struct.pack("<H", crc16(body, self._crc))


def bulk_read(items: Sequence[tuple[int, int, int]]) -> Instruction:
    """`items` of (id, address, bytes), an ID once."""
    return Instruction(BROADCAST, Inst.BULK_READ, b"".join(struct.pack("<BHH", *item) for item in items))


def bulk_write(items: Sequence[tuple[int, int, bytes]]) -> Instruction:
    """`items` of (id, address, data); never answered."""
    return Instruction(
        BROADCAST, Inst.BULK_WRITE, b"".join(struct.pack("<BHH", id, at, len(data)) + data for id, at, data in items)
    )
