"""From the bytes that follow a request to its servos' answers: whole at once, or sorted out where anything is unusual."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.faults import Cause
from openant_tools.comms.protocol2 import Garbage, Instruction, JoinedStatus, Parser, Reason, Status
from openant_tools.comms.ticks import LATEST_S, TICK_ADDRESS, TICK_SIZE, TickClock

__all__ = ["Answer", "Edge", "ReplyPlan", "Request", "Shape", "Sorting", "whole_answers"]

#: 8N1: a byte is ten bits on the wire.
BITS_PER_BYTE = 10
#: A status carries this many bytes besides its data, a servo's part of a joined one so many, and its head.
STATUS_OVERHEAD, PART_OVERHEAD, JOINED_HEAD = 11, 4, 8
_MARK = p2.HEADER[:3]

#: What an answer looks like from outside: bytes of data, and whether it is part of a joined reply.
Shape = tuple[int, bool]
#: (bytes so far, when they were there, whether in time) of a portion.
Edge = tuple[int, float, bool]


class Answer(NamedTuple):
    """What one servo answered to one request.

    Attributes:
        data: its parameters; None where no valid answer came. A late answer's data are kept.
        error: the raw error byte: alert bit and refusal code.
        cause: None where a valid answer came in time.
        rtt: s from the request's first byte to this answer's last, where it came.
    """

    id: int
    data: bytes | None
    error: int = 0
    cause: Cause | None = None
    rtt: float | None = None

    @property
    def ok(self) -> bool:
        """A valid answer came in time, alert or not."""
        return self.cause is None

    @property
    def alert(self) -> bool:
        return bool(self.error & p2.ALERT_BIT)

    @property
    def refusal(self) -> int:
        """The error code without the alert bit; 0 where the instruction was done."""
        return self.error & ~p2.ALERT_BIT & 0xFF

    @property
    def word(self) -> str:
        """As `err.J` of a run table wants it."""
        if self.cause is not None:
            return self.cause.value
        return Cause.ALERT.value if self.alert else ""


@dataclass(slots=True)
class Request:
    """A request and what it takes, made once and sent often.

    Attributes:
        counts: bytes of data wanted from each of `ids`. shapes: what each answer looks like.
        joined: whether one packet answers for all.
        alone: whether it asks one servo, which may refuse.
        tick_at: where in the data the servo's tick stands; None where it does not.
        expected: bytes of the whole reply as it should be. heads: each answer's first eight bytes, or the joined one's;
            crcs: their CRC.
        wire: s that the request takes. whole: s from its first byte to the last answer's last.
        quiet: s without a byte that mean none will come.
        decided_until: when to look again whether the clocks of all are known to run, or to stand still; s.
    """

    packet: bytes
    ids: tuple[int, ...]
    counts: tuple[int, ...]
    shapes: tuple[Shape, ...]
    joined: bool
    alone: bool
    tick_at: int | None
    expected: int
    heads: tuple[bytes, ...]
    crcs: tuple[int, ...]
    fitted_to: tuple[object, int] | None = None
    wire: float = 0.0
    whole: float = 0.0
    quiet: float = 0.0
    decided_until: float = 0.0

    @classmethod
    def of(
        cls, instruction: Instruction, ids: Sequence[int], counts: Sequence[int], address: int | None = None
    ) -> Request:
        """What `instruction` asks of `ids`: so many bytes of each, from `address` on where all give the same."""
        joined = instruction.code in (p2.Inst.FAST_SYNC_READ, p2.Inst.FAST_BULK_READ)
        if joined:
            heads: tuple[bytes, ...] = (
                p2.HEADER
                + struct.pack("<BHB", p2.BROADCAST, 1 + sum(PART_OVERHEAD + count for count in counts), p2.Inst.STATUS),
            )
            expected = JOINED_HEAD + sum(PART_OVERHEAD + count for count in counts)
        else:
            heads = tuple(
                p2.HEADER + struct.pack("<BHB", id, count + 4, p2.Inst.STATUS)
                for id, count in zip(ids, counts, strict=True)
            )
            expected = sum(STATUS_OVERHEAD + count for count in counts)
        ticks = address is not None and address <= TICK_ADDRESS and address + min(counts) >= TICK_ADDRESS + TICK_SIZE
        return cls(
            instruction.encode(),
            tuple(ids),
            tuple(counts),
            tuple((count, joined) for count in counts),
            joined,
            instruction.id != p2.BROADCAST,
            TICK_ADDRESS - (address or 0) if ticks else None,
            expected,
            heads,
            tuple(p2.crc16(head) for head in heads),
        )

    def tick(self, data: bytes) -> int:
        """The servo's tick in an answer's data; only where `tick_at` is known."""
        at = self.tick_at or 0
        return data[at] | data[at + 1] << 8


@dataclass(frozen=True, slots=True)
class ReplyPlan:
    """What has to be done so that the answers to a question are its own.

    Attributes:
        wait_until: s, before it is asked.
        listen_on: whether to listen for a second answer, of which one would be an earlier question's.
        doubtful: ids of which an answer to an earlier question may come nevertheless.
        refusing: ids of which a refusal may come that was meant for one.
    """

    wait_until: float = 0.0
    listen_on: bool = False
    doubtful: frozenset[int] = frozenset()
    refusing: frozenset[int] = frozenset()


def whole_answers(
    request: Request, data: bytes, edges: Sequence[Edge], started: float, clocks: Mapping[int, TickClock]
) -> list[Answer] | None:
    """The usual case: every answer where it should be, none stuffed, late, doubled or with an alert; else None.

    Args:
        clocks: of all ids, where the request reads their ticks.
    """
    ids, joined = request.ids, request.joined
    if len(data) != request.expected or not edges[-1][2] or data.count(_MARK) != len(request.heads):
        return None
    if joined and (not data.startswith(request.heads[0]) or p2.crc16(data[:-2]) != data[-2] | data[-1] << 8):
        return None  # the last CRC covers the earlier ones
    at, arrived = JOINED_HEAD if joined else 0, edges[0][1]
    at_once = len(edges) == 1
    answers: list[Answer] = []
    for k, id in enumerate(ids):
        if joined:
            end = at + request.counts[k] + PART_OVERHEAD
            if data[at + 1] != id or data[at]:
                return None  # out of turn, refused or with an alert: taken apart and counted one by one
            error, got = 0, data[at + 2 : end - 2]
        else:
            end = at + request.counts[k] + STATUS_OVERHEAD
            part = data[at + 8 : end - 2]
            if (
                not data.startswith(request.heads[k], at)
                or p2.crc16(part, request.crcs[k]) != data[end - 2] | data[end - 1] << 8
            ):
                return None
            error, got = part[0], part[1:]
            if error & p2.ALERT_BIT:
                return None
        if not at_once:
            arrived = _when(end, edges)[0]
        answers.append(Answer(id, got, error, None, arrived - started))
        at = end
    if request.tick_at is not None:
        where = request.tick_at
        for answer in answers:
            data, arrived = answer[1] or b"", started + (answer[4] or 0.0)
            clock, tick = clocks[answer[0]], data[where] | data[where + 1] << 8
            if clock.doubt(tick, started, arrived) or not clock.follow(tick, started, arrived):
                return None
    return answers


class Sorting:
    """A reply in which something is missing, broken, stuffed, late, doubled, or not for this request, as it comes in.

    Args:
        started: when the request's first byte left, s.
        clocks: of all ids, where the request reads their ticks.
        plan: of which ids an answer to an earlier question may still come.

    Attributes:
        complete: an answer of every servo has come.
        surplus: ids of answers that were not to this request, or too many.
        noise_bytes: bytes that were none. echoed: whether the host's own packet came back.
        doubted: id → (tick, arrival in s) of an answer that is out of step with a clock of which nobody knows if it runs.
    """

    def __init__(self, request: Request, started: float, clocks: Mapping[int, TickClock], plan: ReplyPlan) -> None:
        self.request = request
        self.surplus: list[int] = []
        self.noise_bytes = 0
        self.echoed = False
        self.doubted: dict[int, tuple[int, float]] = {}
        self._started, self._clocks, self._plan = started, clocks, plan
        self._parser = Parser()
        self._at = 0
        self._got: dict[int, list[Answer]] = {}
        self._unsure: set[int] = set()
        self._stale: set[int] = set()
        #: (position in the ids behind which it stands, cause)
        self._broken: list[tuple[int, Cause]] = []
        self._position = 0

    @property
    def complete(self) -> bool:
        return len(self._got.keys() | self._unsure) == len(self.request.ids)

    def feed(self, portion: bytes, edges: Sequence[Edge]) -> None:
        """Take more bytes in; `edges` of all so far."""
        for item in self._parser.feed(portion):
            self._take(item, edges)

    def answers(self, edges: Sequence[Edge]) -> list[Answer]:
        """What has come of each servo by now, in the order asked."""
        for item in self._parser.flush():
            self._take(item, edges)
        self._drop_early()
        answers = []
        for k, id in enumerate(self.request.ids):
            seen = self._got.get(id, [])
            clock = self._clocks.get(id)
            if len({answer.data for answer in seen}) > 1:
                # Two that differ: of one servo now and before, or of two servos with one id; neither can be believed.
                told = clock is not None and self.request.tick_at is not None and clock.proven(self._started)
                answers.append(Answer(id, None, 0, Cause.CRC if told else Cause.LATE))
            elif seen:
                answers.append(seen[0])
                if clock is not None and self.request.tick_at is not None and len(seen[0].data or b"") > 1:
                    clock.follow(
                        self.request.tick(seen[0].data or b""), self._started, self._started + (seen[0].rtt or 0)
                    )
            elif id in self._unsure:
                answers.append(Answer(id, None, 0, Cause.LATE))
            else:
                if id in self._stale and clock is not None:
                    clock.strike()
                # Garbage belongs to the first silent servo behind whose predecessor it stands.
                mine = next((entry for entry in self._broken if entry[0] <= k), None)
                if mine is not None:
                    self._broken.remove(mine)
                answers.append(Answer(id, None, 0, Cause.TIMEOUT if mine is None else mine[1]))
        return answers

    def _drop_early(self) -> None:
        """Servos answer in turn: one before its turn answers an earlier question, which its clock is too coarse to tell."""
        turns = [self.request.ids.index(id) for id in self._got]
        if self.request.joined or all(a < b for a, b in pairwise(turns)):
            return
        in_turn = _longest_rise(turns)
        for k, turn in enumerate(turns):
            if turn not in in_turn and any(other < turn for other in turns[k:]):
                id = self.request.ids[turn]
                self.surplus.append(id)
                self._unsure.add(id)
                del self._got[id]

    def _take(self, item: Instruction | Status | JoinedStatus | Garbage, edges: Sequence[Edge]) -> None:
        if isinstance(item, Status):
            self._at += len(item.encode())
            if self.request.joined:
                self.surplus.append(item.id)
                self.noise_bytes += len(item.encode())
            else:
                self._hear(item.id, item.error, item.params, _when(self._at, edges))
        elif isinstance(item, JoinedStatus):
            begin, self._at = self._at, self._at + len(item.raw)
            if not (self.request.joined and self._hear_joined(item.raw, begin, edges)):
                self.noise_bytes += len(item.raw)
        elif isinstance(item, Garbage):
            begin, self._at = self._at, self._at + len(item.data)
            heard = self._hear_joined(item.data, begin, edges) if self.request.joined else 0
            if heard < len(self.request.ids):
                self.noise_bytes += len(item.data)
                self._broken.append((self._position, Cause.SHORT if item.reason is Reason.SHORT else Cause.CRC))
        else:
            self._at += len(item.encode())
            if item.encode() == self.request.packet:
                self.echoed = True  # by an adapter without echo suppression
            else:
                self.noise_bytes += len(item.encode())

    def _hear_joined(self, raw: bytes, begin: int, edges: Sequence[Edge]) -> int:
        """The verified parts of a joined reply, which may have broken off; how many."""
        request = self.request
        parts = p2.split_joined(raw, list(zip(request.ids, request.counts, strict=True)))
        end = begin + JOINED_HEAD
        for part in parts:
            end += PART_OVERHEAD + len(part.params)
            self._hear(part.id, part.error, part.params, _when(end, edges))
        return len(parts)

    def _hear(self, id: int, error: int, params: bytes, arrival: tuple[float, bool]) -> None:
        """One servo's answer: to this request, to an earlier one, or a second."""
        request, (when, in_time) = self.request, arrival
        if id not in request.ids:
            self.surplus.append(id)
            self.noise_bytes += STATUS_OVERHEAD + len(params)
            return
        k = request.ids.index(id)
        refused = bool(error & ~p2.ALERT_BIT & 0xFF) and not params
        if not refused and len(params) != request.counts[k]:
            self.surplus.append(id)  # meant for an earlier question
            return
        self._position = k + 1
        clock = self._clocks.get(id) if request.tick_at is not None and not refused else None
        doubtful = id in (self._plan.refusing if refused else self._plan.doubtful)
        if clock is not None and (clock.usable if doubtful else clock.proven)(self._started):
            if clock.stale(request.tick(params), self._started, when):
                self.surplus.append(id)
                self._stale.add(id)
                return
            if doubtful and clock.vague(self._started):
                # Its own or an earlier one: dropped, and the clock goes on with what is sure, so that the next one is told.
                clock.follow(request.tick(params), self._started - LATEST_S, when)
                self._unsure.add(id)
                return
        elif doubtful:
            self._unsure.add(id)
            return
        elif clock is not None and clock.doubt(request.tick(params), self._started, when):
            self.surplus.append(id)
            self._unsure.add(id)
            self.doubted[id] = request.tick(params), when
            return
        seen = self._got.setdefault(id, [])
        if seen:
            self.surplus.append(id)
        seen.append(Answer(id, params, error, None if in_time else Cause.LATE, when - self._started))


def _longest_rise(values: Sequence[int]) -> set[int]:
    """The longest rising subsequence of different values."""
    best: list[list[int]] = []
    for value in values:
        before = [one for one in best if one[-1] < value]
        best.append([*max(before, key=lambda one: len(one)), value] if before else [value])
    longest = max(best, key=lambda one: len(one))
    return set(longest)


def _when(count: int, edges: Sequence[Edge]) -> tuple[float, bool]:
    """When the byte number `count` had arrived, and whether in time."""
    for total, at, in_time in edges:
        if total >= count:
            return at, in_time
    return edges[-1][1], edges[-1][2]
