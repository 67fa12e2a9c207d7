"""Dynamixel Protocol 1.0, as much as it takes to find a servo that was left in it and to bring it back.

A packet is `FF FF | ID | LEN | INST or ERR | parameters | CHK`, LEN the count of bytes after itself, CHK the complement of
the sum from ID on. A servo of Protocol 2.0 takes none of it for its own. Source: ROBOTIS e-manual, Protocol 1.0.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Protocol1Status", "ping", "read", "statuses", "write"]

_MARK = b"\xff\xff"
_PING, _READ, _WRITE = 1, 2, 3
_MAX_ID, _LONGEST = 253, 250


@dataclass(frozen=True, slots=True)
class Protocol1Status:
    """One servo's reply; `error` is the raw byte: bits of hardware and packet errors."""

    id: int
    error: int = 0
    params: bytes = b""

    def encode(self) -> bytes:
        return _frame(self.id, self.error, self.params)


def ping(id: int) -> bytes:
    """The packet that asks one servo, or all by `protocol2.BROADCAST`."""
    return _frame(id, _PING, b"")


def read(id: int, address: int, count: int) -> bytes:
    return _frame(id, _READ, bytes((address, count)))


def write(id: int, address: int, data: bytes) -> bytes:
    return _frame(id, _WRITE, bytes((address,)) + data)


def statuses(data: bytes) -> list[Protocol1Status]:
    """The whole replies in a stream, checksums verified; all else is left out, and so is an echo of what was sent."""
    found, at = list[Protocol1Status](), data.find(_MARK)
    while 0 <= at <= len(data) - 6:
        id, length = data[at + 2], data[at + 3]
        end = at + 4 + length
        if (
            id > _MAX_ID
            or not 2 <= length <= _LONGEST
            or end > len(data)
            or _check(data[at + 2 : end - 1]) != data[end - 1]
        ):
            at = data.find(_MARK, at + 1)
            continue
        found.append(Protocol1Status(id, data[at + 4], data[at + 5 : end - 1]))
        at = data.find(_MARK, end)
    return found


def _frame(id: int, code: int, params: bytes) -> bytes:
    body = bytes((id, len(params) + 2, code)) + params
    return _MARK + body + bytes((_check(body),))


def _check(body: bytes) -> int:
    return ~sum(body) & 0xFF
