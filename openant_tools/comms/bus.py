"""A Dynamixel bus by IDs and addresses: every instruction, deadlines by arithmetic, losses by cause.

A request's deadline is the time its bytes and its answers take on the wire at this baud rate, plus each servo's return
delay, the adapter's latency timer and a margin for the operating system. Nothing is retried behind the caller's back:
where a retry is asked for, it is counted.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import ClassVar, NamedTuple
from weakref import WeakValueDictionary

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.clock import Clock
from openant_tools.comms.faults import BrokenAnswer, Cause, Refused, missing_answers, refusal_words
from openant_tools.comms.line import Line, PortGone
from openant_tools.comms.protocol2 import Garbage, Instruction, JoinedStatus, Parser, Reason, Status
from openant_tools.comms.statistics import BusStatistics

__all__ = ["Answer", "Bus", "Found", "Timing"]

#: 8N1: a byte is ten bits on the wire.
BITS_PER_BYTE = 10
#: A status carries this many bytes besides its data.
STATUS_OVERHEAD = 11
#: How much longer each further try waits: a busy host may have been late, not the servo.
RETRY_PATIENCE_S = 25e-3
#: Model number (2) and firmware.
PING_SIZE = 3
#: The FTDI driver's own setting of its latency timer; any longer one is somebody's mistake.
LONGEST_LATENCY_S = 16e-3
#: Fast Sync Read came with this firmware (ROBOTIS e-manual).
FAST_READ_FIRMWARE = 45
#: Whole plain reads in a row after which joined ones are tried again (a second at 100 Hz), and at most after failures.
FAST_AGAIN, FAST_AGAIN_LONGEST = 100, 6400
_MARK = p2.HEADER[:3]


@dataclass(frozen=True)
class Timing:
    """What a deadline is made of.

    Attributes:
        return_delay_s: what a servo waits before it answers (register 9), the largest on this bus. The factory's.
        latency_timer_s: after this time without more bytes an FTDI adapter hands over what it has.
        margin_s: for the operating system on either side.
        grace_s: how much longer to listen for answers that are then counted as late.
        write_read_gap_s: quiet time that servos need after a broadcast write before they hear a request. Measured on
            the platform: 0.1 ms loses most reads, 0.2 ms none (platform's driver, 40 reads each).
    """

    return_delay_s: float = 500e-6
    latency_timer_s: float = LONGEST_LATENCY_S
    margin_s: float = 4e-3
    grace_s: float = 3e-3
    write_read_gap_s: float = 0.2e-3


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
class _Request:
    """A request and what it takes, made once and sent often.

    Attributes:
        counts: bytes of data wanted from each of `ids`. sizes: bytes of each answer as it should be.
        heads: each answer's first eight bytes. crcs: their CRC.
        whole: s from the request's first byte to the last answer's last.
        quiet: s without a byte that mean none will come.
    """

    packet: bytes
    ids: tuple[int, ...]
    counts: tuple[int, ...]
    sizes: tuple[int, ...]
    expected: int
    heads: tuple[bytes, ...]
    crcs: tuple[int, ...]
    timing: Timing | None = None
    baud: int = 0
    wire: float = 0.0
    whole: float = 0.0
    quiet: float = 0.0

    @classmethod
    def of(cls, instruction: Instruction, ids: Sequence[int], counts: Sequence[int]) -> _Request:
        heads = tuple(
            p2.HEADER + struct.pack("<BHB", id, count + 4, p2.Inst.STATUS)
            for id, count in zip(ids, counts, strict=True)
        )
        sizes = tuple(count + STATUS_OVERHEAD for count in counts)
        crcs = tuple(p2.crc16(head) for head in heads)
        return cls(instruction.encode(), tuple(ids), tuple(counts), sizes, sum(sizes), heads, crcs)

    def fit(self, timing: Timing, baud: int) -> None:
        """Compute the deadlines for this timing and rate."""
        self.timing, self.baud = timing, baud
        byte_s = BITS_PER_BYTE / baud
        spare = timing.latency_timer_s + timing.margin_s
        self.wire = byte_s * len(self.packet)
        self.whole = self.wire + byte_s * self.expected + len(self.ids) * timing.return_delay_s + spare
        self.quiet = byte_s * max(self.sizes) + timing.return_delay_s + spare


@dataclass(frozen=True)
class Found:
    """A servo that answered a ping."""

    id: int
    model_number: int
    firmware: int
    alert: bool = False


@dataclass
class Bus:
    """One half-duplex bus.

    Attributes:
        names: id → what to call the servo in messages.
        timing: see `Timing`; set from what was measured.
        statistics: every request and every loss so far.
        fast: ids whose firmware knows Fast Sync Read. Where it fails, plain Sync Read is used until that has been
            answered whole for a while.
        opened: the buses of this process that are not closed.
    """

    opened: ClassVar[WeakValueDictionary[int, Bus]] = WeakValueDictionary()

    line: Line
    clock: Clock
    timing: Timing = field(default_factory=Timing)
    names: Mapping[int, str] = field(default_factory=dict)
    statistics: BusStatistics = field(default_factory=BusStatistics)
    fast: set[int] = field(default_factory=set)
    #: requests that may be sent again by `read` and `write` (never by sync reads); each is counted
    retries: int = 2

    #: the last request of which something was lost, and all that came for it; for whoever keeps a log, who then clears it
    failed: tuple[bytes, bytes] | None = field(default=None, init=False)
    #: when the first byte of the last request left, s
    request_at: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self.opened[id(self)] = self
        self._quiet_from = 0.0
        #: something was lost: what it left on the line may still come
        self._unsettled = False
        self._last_request = b""
        #: whole plain reads in a row wanted before joined ones are tried again; twice as many after each failure
        self._plain_left = self._plain_wanted = 0
        self._known: dict[tuple[int, int, int, tuple[int, ...]], _Request] = {}

    # ---- one instruction each ------------------------------------------------------------------------------------

    def ping(self, id: int, *, insist: bool = False) -> Found | None:
        """The servo with this ID, or None where none answers; asked `retries` times more where we `insist`."""
        for attempt in range(1 + self.retries * insist):
            self.statistics.of(id).retries += attempt > 0
            answer = self._exchange(p2.ping(id), [id], [PING_SIZE], attempt * RETRY_PATIENCE_S)[0]
            if answer.ok:
                return _found(answer)
        return None

    def broadcast_ping(self, *, first_s: float = 0.2, quiet_s: float = 0.1) -> list[Found]:
        """Everyone at this baud rate, by ID.

        Servos answer in turn of their IDs. How long a turn is nobody publishes; ROBOTIS' SDK allows 3 ms for each of
        252 and always waits for all. We stop once the line has stayed quiet: `first_s` (s) before the first answer,
        `quiet_s` after one.

        Raises:
            BrokenAnswer: answers collide: several servos share an ID.
        """
        started = self._begin(p2.ping(p2.BROADCAST).encode())
        self._unsettled = True
        parser, found, garbage = Parser(), dict[int, Found](), 0
        deadline = started + first_s + self.wire_s(STATUS_OVERHEAD + PING_SIZE)
        while self.clock.wait_readable(self.line, deadline):
            for item in parser.feed(self._readable()):
                if isinstance(item, Status) and len(item.params) >= 3:
                    found[item.id] = _found(Answer(item.id, item.params, item.error))
                elif isinstance(item, Garbage):
                    garbage += len(item.data)
            deadline = max(deadline, self.clock.now() + quiet_s)
        garbage += sum(len(item.data) for item in parser.flush() if isinstance(item, Garbage))
        self.statistics.noise_bytes += garbage
        if garbage and not found:
            raise BrokenAnswer(
                f"answers to a broadcast ping collide ({garbage} bytes that are no packet) at {self.line.baud} baud",
                where=self.line.path,
                remedy="several servos share an id, as factory-fresh ones do: connect one at a time",
            )
        return [found[id] for id in sorted(found)]

    def read(self, id: int, address: int, count: int) -> bytes:
        """`count` bytes from `address`.

        Raises:
            NoAnswer, BrokenAnswer: even after `retries` more requests.
            Refused: there is no such register.
        """
        answer = self._insist(p2.read(id, address, count), id, count, f"register {address}")
        assert answer.data is not None
        if len(answer.data) != count:
            raise BrokenAnswer(f"{len(answer.data)} bytes instead of {count}", where=self._place(id))
        return answer.data

    def write(self, id: int, address: int, data: bytes, what: str | None = None) -> None:
        """Write and wait for the servo's word. Raises as `read`; `what` names the register in messages."""
        self._insist(p2.write(id, address, data), id, 0, what or f"register {address}")

    def reg_write(self, id: int, address: int, data: bytes) -> None:
        """As `write`, done once `action` comes."""
        self._insist(p2.reg_write(id, address, data), id, 0, f"register {address}")

    def action(self, id: int = p2.BROADCAST) -> None:
        self._order(p2.action(id), id, "action")

    def reboot(self, id: int) -> None:
        """The servo is mute for a while (about 0.3 to 0.5 s) afterwards."""
        self._order(p2.reboot(id), id, "reboot")

    def factory_reset(self, id: int, option: int) -> None:
        """See `protocol2.factory_reset`. The servo reboots, perhaps under another ID and at another baud rate."""
        self._order(p2.factory_reset(id, option), id, "factory reset")

    def clear_multi_turn(self, id: int) -> None:
        self._order(p2.clear_multi_turn(id), id, "clear")

    def backup(self, id: int) -> None:
        self._order(p2.control_table_backup(id), id, "control table backup")

    def restore(self, id: int) -> None:
        """The servo reboots with its backup."""
        self._order(p2.control_table_restore(id), id, "control table restore")

    def sync_write(self, address: int, count: int, data: Mapping[int, bytes]) -> float:
        """Write the same registers of several servos; none answers. The time its last byte has left."""
        return self.send(p2.sync_write(address, count, data).encode())

    def bulk_write(self, items: Sequence[tuple[int, int, bytes]]) -> float:
        """Write (id, address, data) each; none answers. The time its last byte has left."""
        return self.send(p2.bulk_write(items).encode())

    def send(self, packet: bytes) -> float:
        """Send what nobody answers; returns when its last byte has left (s), by the baud rate."""
        self._send(packet)
        return self._quiet_from

    def sync_read(self, address: int, count: int, ids: Sequence[int]) -> list[Answer]:
        """The same registers of several servos, in the order of `ids`. Never raises for a silent servo."""
        ids = tuple(ids)
        able = bool(self.fast) and len(ids) > 1 and self.fast.issuperset(ids)
        if able and not self._plain_left:
            answers = self._fast_sync_read(address, count, ids)
            rest = [id for id, answer in zip(ids, answers, strict=True) if answer is None]
            if not rest:
                return [answer for answer in answers if answer is not None]
            # A joined reply ends at the first silent servo: ask those behind it one by one, and not joined for a while.
            self.statistics.fast_read_fallbacks += 1
            self._plain_wanted = min(2 * self._plain_wanted or FAST_AGAIN, FAST_AGAIN_LONGEST)
            self._plain_left = self._plain_wanted
            others = iter(self._exchange(p2.sync_read(address, count, rest), rest, [count] * len(rest)))
            return [answer or next(others) for answer in answers]
        plain = self._transact(self._request(p2.Inst.SYNC_READ, address, count, ids))
        if able:
            self._plain_left = self._plain_left - 1 if all(answer.ok for answer in plain) else self._plain_wanted
            self.statistics.fast_read_returns += self._plain_left == 0
        return plain

    def _request(self, code: p2.Inst, address: int, count: int, ids: tuple[int, ...]) -> _Request:
        key = (code, address, count, ids)
        request = self._known.get(key)
        if request is None:
            make = p2.sync_read if code == p2.Inst.SYNC_READ else p2.fast_sync_read
            request = self._known[key] = _Request.of(make(address, count, ids), ids, (count,) * len(ids))
        return request

    def bulk_read(self, items: Sequence[tuple[int, int, int]]) -> list[Answer]:
        """(id, address, bytes) each, answered in that order. Never raises for a silent servo."""
        return self._exchange(p2.bulk_read(items), [id for id, _, _ in items], [count for _, _, count in items])

    def measure_latency_timer(self, id: int, tries: int = 13) -> float:
        """What the adapter holds short answers back, s: for lines whose timer the host cannot read.

        The timer runs freely, so that an answer waits for anything between nothing and its whole period: twice the
        median of what a ping takes beyond wire and return delay.
        """
        waits = []
        for k in range(tries):
            # Asked at once after an answer, every ping would meet the timer at the same phase.
            self.clock.sleep_until(self.clock.now() + (0.618 * k) % 1.0 * LONGEST_LATENCY_S)
            answer = self._exchange(p2.ping(id), [id], [PING_SIZE])[0]
            if answer.rtt is not None:
                waits.append(answer.rtt - self.wire_s(10 + STATUS_OVERHEAD + PING_SIZE) - self.timing.return_delay_s)
        return max(1e-3, 2 * sorted(waits)[len(waits) // 2]) if waits else self.timing.latency_timer_s

    # ---- what must be there --------------------------------------------------------------------------------------

    def require(self, answers: Iterable[Answer]) -> list[Answer]:
        """The same answers, where all came; else the error that names the place.

        Raises:
            NoAnswer, BrokenAnswer: see `faults.missing_answers`.
        """
        answers = list(answers)
        if all(answer.ok for answer in answers):
            return answers
        broken = [answer for answer in answers if answer.cause in (Cause.CRC, Cause.SHORT)]
        if broken and all(answer.ok or answer in broken for answer in answers):
            names = ", ".join(self._name(answer.id) for answer in broken)
            raise BrokenAnswer(
                f"answers arrive broken from {names} ({broken[0].word})",
                where=self.line.path,
                remedy="a loose connector, two servos with one id, or noise: wiggle the cable before "
                f"{self._name(broken[0].id)} and look at `openant comms watch`",
                ids=[answer.id for answer in broken],
                asked=[answer.id for answer in answers],
            )
        raise missing_answers(
            [self._name(answer.id) for answer in answers],
            [answer.data is not None for answer in answers],
            where=self.line.path,
            speed=f"{self.line.baud} baud",
            ids=[answer.id for answer in answers],
        )

    def require_all(self, answered: Mapping[int, bool]) -> None:
        """Raise NoAnswer unless every one of these ids answered, in the order asked."""
        self.require([Answer(id, b"" if ok else None, 0, None if ok else Cause.TIMEOUT) for id, ok in answered.items()])

    def close(self) -> None:
        self.opened.pop(id(self), None)
        self.line.close()

    # ---- how it is done ------------------------------------------------------------------------------------------

    def _name(self, id: int) -> str:
        return f"{self.names[id]} (id {id})" if id in self.names else f"servo {id}"

    def _place(self, id: int) -> str:
        return f"{self.line.path}, {self._name(id)}"

    def wire_s(self, count: int) -> float:
        """How long `count` bytes take on the wire."""
        return count * BITS_PER_BYTE / self.line.baud

    def _send(self, packet: bytes) -> float:
        """Write a packet after the gap that the last one needs; returns when its first byte left."""
        if self.timing.write_read_gap_s > 0:
            gap = self._quiet_from + self.timing.write_read_gap_s
            if self.clock.now() < gap:
                self.clock.sleep_until(gap)
        if self._unsettled:
            self._count_stale(self.line.read())
        started = self.request_at = self.clock.now()
        self.line.write(packet)
        # Counted from when the system has the bytes: whoever was held up before that must not cut the gap short.
        left = max(self._quiet_from, self.clock.now())
        self._quiet_from = left + len(packet) * BITS_PER_BYTE / self.line.baud
        return started

    def _readable(self) -> bytes:
        """The bytes that the line is said to have. A terminal that has hung up is readable for ever, and empty."""
        data = self.line.read()
        if not data:
            raise PortGone(self.line.path, "it hung up")
        return data

    def _begin(self, packet: bytes) -> float:
        """Send a request that is answered; returns when its first byte left.

        Answers carry no number: one that comes too late could pass for the answer to the next request. So after a
        loss another question waits until the line has been quiet; the same question again may take either answer.
        """
        if self._unsettled and packet != self._last_request:
            quiet = self.timing.latency_timer_s + self.timing.margin_s
            while self.clock.wait_readable(self.line, self.clock.now() + quiet):
                self._count_stale(self._readable())
            self._unsettled = False
        self._last_request = packet
        return self._send(packet)

    def _count_stale(self, data: bytes) -> None:
        """Bytes nobody waits for any more: answers too late even for the grace, or noise."""
        parser = Parser()
        for item in parser.feed(data) + parser.flush():
            if isinstance(item, Garbage):
                self.statistics.noise_bytes += len(item.data)
            elif isinstance(item, Status):
                servo = self.statistics.of(item.id)
                servo.lost[Cause.LATE] = servo.lost.get(Cause.LATE, 0) + 1
                if servo.lost.get(Cause.TIMEOUT, 0):
                    servo.lost[Cause.TIMEOUT] -= 1

    def _exchange(
        self, instruction: Instruction, ids: Sequence[int], counts: Sequence[int], extra_s: float = 0.0
    ) -> list[Answer]:
        """Send a request and collect one answer, of so many bytes of data, from each of `ids`."""
        return self._transact(_Request.of(instruction, ids, counts), extra_s)

    def _transact(self, request: _Request, extra_s: float = 0.0) -> list[Answer]:
        if request.timing is not self.timing or request.baud != self.line.baud:
            request.fit(self.timing, self.line.baud)
        started = self._begin(request.packet)
        data, edges = self._collect(request, started, extra_s)
        answers = self._whole_answers(request, data, edges, started)
        if answers is None:
            answers = self._sort_out(data, request, edges, started)
            for answer in answers:
                self.statistics.count(answer.id, answer.cause, answer.rtt, answer.alert)
            self._unsettled = not all(answer.ok for answer in answers)
            if self._unsettled:
                self.failed = request.packet, data
        if data:
            self._quiet_from = edges[-1][1] - self.timing.write_read_gap_s
        rtt = answers[-1].rtt
        if rtt is not None:
            self.statistics.arrivals.append((started + rtt, rtt))
        return answers

    def _collect(
        self, request: _Request, started: float, extra_s: float
    ) -> tuple[bytes, list[tuple[int, float, bool]]]:
        """All bytes that come for a request, and (bytes so far, when, whether in time) of each portion."""
        data, edges = b"", list[tuple[int, float, bool]]()
        ids, quiet = request.ids, request.quiet + extra_s
        deadline, sent = started + request.whole + extra_s, started + request.wire
        # A refusal is shorter than an answer and stuffing makes it longer: the length field tells, once it is there.
        known, at_known, expected = 0, 0, request.expected
        in_time, line, before = True, self.line, self.line.received
        while len(data) < expected:
            if not self.clock.wait_readable(line, deadline):
                if not in_time or self.timing.grace_s <= 0:
                    break
                in_time, deadline = False, deadline + self.timing.grace_s
                continue
            data += self._readable()
            for total, at in self.clock.arrivals(line):
                edges.append((total - before, at, in_time and self.clock.in_time(at, deadline)))
            if len(data) == expected:
                break
            while (
                known < len(ids) and len(data) >= at_known + 7 and data.startswith(request.heads[known][:5], at_known)
            ):
                actual = 7 + (data[at_known + 5] | data[at_known + 6] << 8)
                expected += actual - request.sizes[known]
                known, at_known = known + 1, at_known + actual
            if len(data) < expected and in_time:
                deadline = min(deadline, max(edges[-1][1], sent) + quiet)
        return data, edges

    def _whole_answers(
        self, request: _Request, data: bytes, edges: list[tuple[int, float, bool]], started: float
    ) -> list[Answer] | None:
        """The usual case: every answer where it should be, none stuffed, none late. None where anything is not."""
        ids = request.ids
        if len(data) != request.expected or not edges[-1][2] or data.count(_MARK) != len(ids):
            return None
        at, alerts = 0, 0
        at_once = len(edges) == 1
        rtt = edges[0][1] - started
        answers: list[Answer] = []
        for id, size, head, crc in zip(ids, request.sizes, request.heads, request.crcs, strict=True):
            end = at + size
            part = data[at + 8 : end - 2]
            if not data.startswith(head, at) or p2.crc16(part, crc) != data[end - 2] | data[end - 1] << 8:
                return None
            error = part[0]
            alerts |= error
            if not at_once:
                rtt = _when(end, edges)[0] - started
            answers.append(Answer(id, part[1:], error, None, rtt))
            at = end
        if alerts & p2.ALERT_BIT:
            return None  # counted one by one
        self.statistics.count_whole(ids, rtt if at_once else [answer[4] for answer in answers])  # type: ignore[misc]
        self._unsettled = False
        return answers

    def _sort_out(
        self, data: bytes, request: _Request, edges: list[tuple[int, float, bool]], started: float
    ) -> list[Answer]:
        """Answers from a stream in which something is missing, broken, stuffed or late."""
        parser, ids = Parser(), request.ids
        got: dict[int, Answer] = {}
        broken: list[tuple[int, Cause]] = []  # (position in `ids` behind which it stands, cause)
        position, at = 0, 0
        for item in parser.feed(data) + parser.flush():
            if isinstance(item, Status):
                at += len(item.encode())
                # An answer of another length was meant for an earlier question; a refusal is empty.
                wanted = request.counts[ids.index(item.id)] if item.id in ids else None
                fits = len(item.params) == wanted or (item.code and not item.params)
                if wanted is not None and item.id not in got and fits:
                    when, in_time = _when(at, edges)
                    cause = None if in_time else Cause.LATE
                    got[item.id] = Answer(item.id, item.params, item.error, cause, when - started)
                    position = ids.index(item.id) + 1
                else:
                    self.statistics.noise_bytes += len(item.encode())
            elif isinstance(item, Garbage):
                at += len(item.data)
                self.statistics.noise_bytes += len(item.data)
                broken.append((position, Cause.SHORT if item.reason is Reason.SHORT else Cause.CRC))
            elif isinstance(item, JoinedStatus):
                at += len(item.raw)
            else:
                at += len(item.encode())  # our own request, echoed by an adapter without echo suppression
        answers: list[Answer] = []
        for k, id in enumerate(ids):
            answer = got.get(id)
            if answer is None:
                # Garbage belongs to the first silent servo behind whose predecessor it stands.
                mine = next((entry for entry in broken if entry[0] <= k), None)
                if mine is not None:
                    broken.remove(mine)
                answer = Answer(id, None, 0, Cause.TIMEOUT if mine is None else mine[1])
            answers.append(answer)
        return answers

    def _fast_sync_read(self, address: int, count: int, ids: tuple[int, ...]) -> Sequence[Answer | None]:
        """The verified part of a joined reply; None for those it does not reach."""
        request = self._request(p2.Inst.FAST_SYNC_READ, address, count, ids)
        if request.timing is not self.timing or request.baud != self.line.baud:
            request.fit(self.timing, self.line.baud)
        started = self._begin(request.packet)
        deadline, sent = started + request.whole, started + request.wire
        expected, data = 8 + len(ids) * (count + 4), b""
        edges: list[tuple[int, float, bool]] = []
        before = self.line.received
        while len(data) < expected and self.clock.wait_readable(self.line, deadline):
            data += self._readable()
            edges += [(total - before, at, True) for total, at in self.clock.arrivals(self.line)]
            deadline = min(deadline, max(edges[-1][1], sent) + request.quiet)
        if data:
            self._quiet_from = edges[-1][1] - self.timing.write_read_gap_s
        whole = self._whole_joined(request, data, edges, started)
        if whole is not None:
            return whole
        at = max(data.find(p2.HEADER), 0)
        parts = p2.split_joined(data[at:], [(id, count) for id in ids])
        answers: list[Answer | None] = [None] * len(ids)
        for k, part in enumerate(parts):
            when, _ = _when(at + 8 + (k + 1) * (count + 4), edges)
            answers[k] = Answer(part.id, part.params, part.error, None, when - started)
        for answer in answers:
            if answer is not None:
                self.statistics.count(answer.id, None, answer.rtt, answer.alert)
        if len(parts) < len(ids):
            broken = len(data) - at - 8 - len(parts) * (count + 4)
            cause = Cause.TIMEOUT if broken <= 0 else Cause.SHORT if len(data) < expected else Cause.CRC
            self.statistics.count(ids[len(parts)], cause, None, False)
            self._unsettled = True
            self.failed = request.packet, data
        return answers

    def _whole_joined(
        self, request: _Request, data: bytes, edges: list[tuple[int, float, bool]], started: float
    ) -> list[Answer] | None:
        """The usual case of a joined reply: all there, the last CRC, which covers the earlier ones, right."""
        ids, count = request.ids, request.counts[0]
        step = count + 4
        if len(data) != 8 + len(ids) * step or len(edges) != 1:
            return None
        head = _joined_head(len(ids), count)
        if not data.startswith(head) or p2.crc16(data[:-2]) != data[-2] | data[-1] << 8:
            return None
        at, rtt = len(head), edges[0][1] - started
        answers: list[Answer] = []
        for id in ids:
            if data[at + 1] != id or data[at]:
                return None  # out of turn, refused or with an alert: taken apart and counted one by one
            answers.append(Answer(id, data[at + 2 : at + step - 2], 0, None, rtt))
            at += step
        self.statistics.count_whole(ids, rtt)
        self.statistics.arrivals.append((edges[0][1], rtt))
        self._unsettled = False
        return answers

    def _insist(self, instruction: Instruction, id: int, count: int, what: str) -> Answer:
        """One servo's answer, asked for again up to `retries` times; raises where it says no or nothing."""
        for attempt in range(1 + self.retries):
            if attempt:
                self.statistics.of(id).retries += 1
            answer = self._exchange(instruction, [id], [count], attempt * RETRY_PATIENCE_S)[0]
            if answer.data is not None:
                break
        else:
            self.require([answer])
        self._check(answer, what)
        return answer

    def _order(self, instruction: Instruction, id: int, what: str) -> None:
        """An instruction with an effect: not sent twice, since the first may have been done. Broadcasts go unheard."""
        if id == p2.BROADCAST:
            self.send(instruction.encode())
            return
        [answer] = self._exchange(instruction, [id], [0])
        if answer.data is None:
            self.require([answer])
        self._check(answer, what)

    def _check(self, answer: Answer, what: str) -> None:
        if answer.refusal:
            why, remedy = refusal_words(answer.refusal)
            raise Refused(
                answer.id, answer.refusal, f"refuses {what}: {why}", where=self._place(answer.id), remedy=remedy
            )


@cache
def _joined_head(servos: int, count: int) -> bytes:
    return p2.HEADER + struct.pack("<BHB", p2.BROADCAST, 1 + servos * (count + 4), p2.Inst.STATUS)


def _found(answer: Answer) -> Found:
    assert answer.data is not None
    model, firmware = struct.unpack("<HB", answer.data[:3])
    return Found(answer.id, model, firmware, answer.alert)


def _when(count: int, edges: Sequence[tuple[int, float, bool]]) -> tuple[float, bool]:
    """When the byte number `count` had arrived, and whether in time."""
    for total, at, in_time in edges:
        if total >= count:
            return at, in_time
    return edges[-1][1], edges[-1][2]
