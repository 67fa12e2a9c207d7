"""A Dynamixel bus by IDs and addresses: every instruction, deadlines by arithmetic, losses by cause.

A request's deadline is the time its bytes and its answers take on the wire at this baud rate, plus each servo's return
delay, the adapter's latency timer and a margin for the operating system. Nothing is retried behind the caller's back:
where a retry is asked for, it is counted.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar
from weakref import WeakValueDictionary

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.clock import Clock
from openant_tools.comms.faults import BrokenAnswer, Cause, NeverSilent, Refused, missing_answers, refusal_words
from openant_tools.comms.line import BUFFER, Line
from openant_tools.comms.pending import LATEST_S, Pending
from openant_tools.comms.protocol2 import Garbage, Instruction, Parser, Status
from openant_tools.comms.reply import (
    BITS_PER_BYTE,
    STATUS_OVERHEAD,
    Answer,
    Edge,
    ReplyPlan,
    Request,
    Sorting,
    whole_answers,
)
from openant_tools.comms.statistics import BusStatistics
from openant_tools.comms.ticks import TickClock
from openant_tools.errors import BadInput

__all__ = ["Answer", "Bus", "BusTiming", "FoundServo", "called"]

#: What lets a servo move: Startup Configuration, Torque Enable, and the goals of PWM, current, velocity; and position.
STARTUP, TORQUE, GOALS = 60, 64, (range(100, 108), range(116, 120))
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
#: A line is quiet once nothing has come for so long, s; one that has not been for RESTLESS_S never falls silent.
QUIET_S = 20e-3
RESTLESS_S = 0.2
#: The turn of one servo's answer to a broadcast ping that ROBOTIS' SDK allows for, s, and how many there are.
PING_TURN_S, PING_TURNS = 3e-3, 253


@dataclass(frozen=True)
class BusTiming:
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


NOTHING_PENDING = ReplyPlan()
#: What becomes of those whose part of a joined reply is missing: they are asked again.
_BROKEN_OFF = (Cause.TIMEOUT, Cause.SHORT, Cause.CRC)


def called(name: str, id: int) -> str:
    """What a servo is called in messages: its joint and its id; its id alone, where nobody knows yet which joint it is."""
    return name if name == f"id {id}" else f"{name} (id {id})"


@dataclass(frozen=True)
class FoundServo:
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
        timing: see `BusTiming`; set from what was measured.
        statistics: every request and every loss so far.
        fast: ids whose firmware knows Fast Sync Read. Where it fails, plain Sync Read is used until that has been
            answered whole for a while.
        opened: the buses of this process that are not closed.
    """

    opened: ClassVar[WeakValueDictionary[int, Bus]] = WeakValueDictionary()

    line: Line
    clock: Clock
    timing: BusTiming = field(default_factory=BusTiming)
    names: Mapping[int, str] = field(default_factory=dict)
    statistics: BusStatistics = field(default_factory=BusStatistics)
    fast: set[int] = field(default_factory=set)
    #: requests that may be sent again by `read` and `write` (never by sync reads); each is counted
    retries: int = 2
    #: whether somebody switches torque off however this process ends: without that nothing is sent that would let a servo
    #: move. The engine sets it, which has a guardian, while the servos' watchdogs are armed.
    guarded: bool = False

    #: the last request of which something was lost, and all that came for it; for whoever keeps a log, who then clears it
    failed: tuple[bytes, bytes] | None = field(default=None, init=False)
    #: when the first byte of the last request left, s
    request_at: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        self.opened[id(self)] = self
        self._quiet_from = 0.0
        #: something was lost or came unasked: what lies on the line before the next question is looked at
        self._unsettled = False
        self._pending = Pending()
        self._clocks: dict[int, TickClock] = {}
        #: since when and with how many bytes the line has talked unasked without a pause, s
        self._restless_from: float | None = None
        self._restless_bytes = 0
        self._unasked_at = float("-inf")
        #: whole plain reads in a row wanted before joined ones are tried again; twice as many after each failure
        self._plain_left = self._plain_wanted = 0
        self._known: dict[tuple[int, int, int, tuple[int, ...]], Request] = {}

    # ---- one instruction each ------------------------------------------------------------------------------------

    def ping(self, id: int, *, insist: bool = False) -> FoundServo | None:
        """The servo with this ID, or None where none answers; asked `retries` times more where we `insist`."""
        again = False
        for attempt in range(1 + self.retries * insist):
            self.statistics.of(id).retries += attempt > 0
            answer = self._exchange(p2.ping(id), [id], [PING_SIZE], attempt * RETRY_PATIENCE_S, again)[0]
            if answer.ok:
                return _found(answer)
            again = answer.cause is not Cause.LATE
        return None

    def broadcast_ping(self, *, first_s: float = 0.2, quiet_s: float = 0.1) -> list[FoundServo]:
        """Everyone at this baud rate, by ID.

        Servos answer in turn of their IDs. How long a turn is nobody publishes; ROBOTIS' SDK allows 3 ms for each of
        252 and always waits for all. We stop once the line has stayed quiet: `first_s` (s) before the first answer,
        `quiet_s` after one.

        Raises:
            BrokenAnswer: answers collide: several servos share an ID.
            NeverSilent: the line goes on talking when all have had their turn.
        """
        self._settle(self.clock.now())
        started = self._send(p2.ping(p2.BROADCAST).encode())
        self._unsettled = True
        parser, found, garbage = Parser(), dict[int, FoundServo](), 0
        deadline = started + first_s + self.wire_s(STATUS_OVERHEAD + PING_SIZE)
        give_up = deadline + PING_TURNS * PING_TURN_S + quiet_s
        while self.clock.wait_readable(self.line, min(deadline, give_up)):
            for item in parser.feed(self.line.read()):
                if isinstance(item, Status) and len(item.params) == PING_SIZE and item.id not in found:
                    found[item.id] = _found(Answer(item.id, item.params, item.error))
                elif isinstance(item, Garbage):
                    garbage += len(item.data)
            deadline = max(deadline, self.clock.now() + quiet_s)
            if self.clock.now() > give_up:
                break
        garbage += sum(len(item.data) for item in parser.flush() if isinstance(item, Garbage))
        self.statistics.noise_bytes += garbage
        if deadline > give_up:
            raise self.never_silent(garbage, self.clock.now() - started)
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
        self.check_guarded(address, data)
        self._insist(p2.write(id, address, data), id, 0, what or f"register {address}")

    def reg_write(self, id: int, address: int, data: bytes) -> None:
        """As `write`, done once `action` comes."""
        self.check_guarded(address, data)
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
        for one in data.values():
            self.check_guarded(address, one)
        return self.send(p2.sync_write(address, count, data).encode())

    def bulk_write(self, items: Sequence[tuple[int, int, bytes]]) -> float:
        """Write (id, address, data) each; none answers. The time its last byte has left."""
        for _, address, data in items:
            self.check_guarded(address, data)
        return self.send(p2.bulk_write(items).encode())

    def send(self, packet: bytes) -> float:
        """Send what nobody answers; returns when its last byte has left (s), by the baud rate."""
        self._send(packet)
        return self._quiet_from

    def sync_read(self, address: int, count: int, ids: Sequence[int], *, again: bool = False) -> list[Answer]:
        """The same registers of several servos, in the order of `ids`. Never raises for a silent servo.

        An answer that is late is not taken for one to this question: where the servos' ticks are among the registers,
        by them; else a question waits until none can come any more, at most `pending.LATEST_S`. `again` waives that:
        the question is the same as the one before, and the answer to either will do.
        """
        ids = tuple(ids)
        able = bool(self.fast) and len(ids) > 1 and self.fast.issuperset(ids)
        if able and not self._plain_left:
            request = self._request(p2.Inst.FAST_SYNC_READ, address, count, ids)
            answers = self._transact(request, again=again)
            rest = [answer.id for answer in answers if answer.cause in _BROKEN_OFF]
            if rest:
                # A joined reply ends at the first silent servo: ask those behind it alone, and not joined for a while.
                self.statistics.fast_read_fallbacks += 1
                self._plain_wanted = min(2 * self._plain_wanted or FAST_AGAIN, FAST_AGAIN_LONGEST)
                self._plain_left = self._plain_wanted
                plain = self._transact(self._request(p2.Inst.SYNC_READ, address, count, tuple(rest)), again=again)
                by_id = {answer.id: answer for answer in plain}
                answers = [by_id.get(answer.id, answer) for answer in answers]
            return answers
        answers = self._transact(self._request(p2.Inst.SYNC_READ, address, count, ids), again=again)
        if able:
            self._plain_left = self._plain_left - 1 if all(answer.ok for answer in answers) else self._plain_wanted
            self.statistics.fast_read_returns += self._plain_left == 0
        return answers

    def _request(self, code: p2.Inst, address: int, count: int, ids: tuple[int, ...]) -> Request:
        key = (code, address, count, ids)
        request = self._known.get(key)
        if request is None:
            make = p2.sync_read if code == p2.Inst.SYNC_READ else p2.fast_sync_read
            request = self._known[key] = Request.of(make(address, count, ids), ids, (count,) * len(ids), address)
            for id in ids:
                self._clocks.setdefault(id, TickClock())
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

    def check_guarded(self, address: int, data: bytes) -> None:
        """Raise BadInput where writing `data` to `address` lets a servo move, now or once it has power, unguarded.

        A goal counts: with a bit of Drive Mode it switches torque on.
        """
        end = address + len(data)
        if address <= STARTUP < end and data[STARTUP - address] & 1:
            raise BadInput(
                "a servo that switches torque on as it starts is guarded by nobody", where=self.line.path,
                remedy="leave bit 0 of startup_configuration (60) at 0",
            )  # fmt: skip
        torque = address <= TORQUE < end and data[TORQUE - address] != 0
        goal = any(address < goals.stop and goals.start < end for goals in GOALS)
        if (torque or goal) and not self.guarded:
            raise BadInput(
                "nobody would switch torque off if this program died", where=self.line.path,
                remedy="switch torque on through the engine (`messages.Torque`), and move with what it offers",
            )  # fmt: skip

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

    def settle(self) -> None:
        """Wait until no answer to an earlier question can come any more."""
        self._settle(self.clock.now() + self.timing.latency_timer_s + self.timing.margin_s + LATEST_S)

    def close(self) -> None:
        self.opened.pop(id(self), None)
        self.line.close()

    # ---- how it is done ------------------------------------------------------------------------------------------

    def _name(self, id: int) -> str:
        return called(self.names[id], id) if id in self.names else f"servo {id}"

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
                self.clock.write_from(gap)
        started = self.request_at = self.clock.now()
        self.line.write(packet)
        # Counted from when the system has the bytes: whoever was held up before that must not cut the gap short.
        left = max(self._quiet_from, self.clock.now())
        self._quiet_from = left + len(packet) * BITS_PER_BYTE / self.line.baud
        return started

    @property
    def restless(self) -> bool:
        """Whether the line has been heard talking unasked for RESTLESS_S and more, without a pause."""
        return self._restless_from is not None and self._unasked_at - self._restless_from >= RESTLESS_S

    def never_silent(self, count: int = 0, seconds: float = 0.0) -> NeverSilent:
        """The error that says so: of so many bytes in so many seconds, or of what was noticed last."""
        if not seconds and self._restless_from is not None:
            count, seconds = self._restless_bytes, self._unasked_at - self._restless_from
        return NeverSilent(self.line.path, self.line.baud, count, seconds)

    def _settle(self, until: float) -> None:
        """Take what comes until then (s), answers to earlier questions or noise, and look whether the line falls silent."""
        parser, noise, lain, heard = Parser(), 0, 0, self.clock.now()
        while self.clock.wait_readable(self.line, until):
            data, heard = self.line.read(), self.clock.now()
            noise += self._count_stale(parser.feed(data))
            lain += len(data) if heard > until else 0
            if lain > BUFFER or not data:
                break  # no pause to wait for
        self._note_unasked(noise + self._count_stale(parser.flush()), heard)

    def _note_unasked(self, count: int, heard: float) -> None:
        """So many bytes have come that nobody asked for, the last at `heard` (s); without a pause between them they make a
        line restless."""
        now = self.clock.now()
        if count:
            if self._restless_from is None or heard - self._unasked_at > RESTLESS_S:  # nobody listened in between
                self._restless_from, self._restless_bytes = heard, 0
            self._restless_bytes += count
            self._unasked_at = heard
        elif now - self._unasked_at > QUIET_S:
            self._restless_from, self._restless_bytes = None, 0

    def _count_stale(self, items: Iterable[object]) -> int:
        """What nobody waits for any more: answers too late even for the grace, and noise, of which the bytes."""
        noise = 0
        for item in items:
            if isinstance(item, Garbage):
                noise += len(item.data)
            elif isinstance(item, Status):
                self._count_late(item.id)
        self.statistics.noise_bytes += noise
        return noise

    def _count_late(self, id: int) -> None:
        """An answer has come after it had been given up: it was late, not lost."""
        servo = self.statistics.of(id)
        servo.lost[Cause.LATE] = servo.lost.get(Cause.LATE, 0) + 1
        if servo.lost.get(Cause.TIMEOUT, 0):
            servo.lost[Cause.TIMEOUT] -= 1
        self._pending.distrust(self.clock.now())

    def _exchange(
        self, instruction: Instruction, ids: Sequence[int], counts: Sequence[int], extra_s: float = 0.0,
        again: bool = False,
    ) -> list[Answer]:  # fmt: skip
        """Send a request and collect one answer, of so many bytes of data, from each of `ids`."""
        return self._transact(Request.of(instruction, ids, counts), extra_s, again)

    def _transact(self, request: Request, extra_s: float = 0.0, again: bool = False) -> list[Answer]:
        """Send a request and collect its answers; `again` where the one before was the same, and its answer will do."""
        if request.fitted_to != (self.timing, self.line.baud):
            self._fit(request)
        undecided = request.tick_at is not None and self._undecided(request)
        if undecided and not again:
            self._settle(self.clock.now())  # what lies there is none of its answers, and says that more may come
        plan = (
            None if again else self._pending.plan(request, self.clock.now(), self._told, undecided)
        ) or NOTHING_PENDING
        if plan.wait_until > 0 or self._unsettled:
            self._settle(max(plan.wait_until, self.clock.now()))
        started = self._send(request.packet)
        answers = self._collect(request, started, extra_s, plan)
        rtt = answers[-1].rtt
        if rtt is not None:
            self.statistics.arrivals.append((started + rtt, rtt))
        return answers

    def _told(self, id: int) -> bool:
        """Whether a servo's own clock tells which question its answer belongs to."""
        clock = self._clocks.get(id)
        return clock is not None and clock.usable(self.clock.now())

    def _undecided(self, request: Request) -> bool:
        """Whether nobody knows yet of one of its servos if its clock runs."""
        now = self.clock.now()
        if now >= request.decided_until:
            request.decided_until = min(self._clocks[id].decided_until(now) for id in request.ids)
        return now >= request.decided_until

    def _fit(self, request: Request) -> None:
        """Compute the deadlines for this timing and rate."""
        timing = self.timing
        request.fitted_to = timing, self.line.baud
        byte_s = BITS_PER_BYTE / self.line.baud
        spare = timing.latency_timer_s + timing.margin_s
        request.wire = byte_s * len(request.packet)
        request.whole = request.wire + byte_s * request.expected + len(request.ids) * timing.return_delay_s + spare
        request.quiet = byte_s * (max(request.counts) + STATUS_OVERHEAD) + timing.return_delay_s + spare

    def _collect(self, request: Request, started: float, extra_s: float, plan: ReplyPlan) -> list[Answer]:
        """The answers to a request that has been sent, counted."""
        line, clock = self.line, self.clock
        data, edges = b"", list[Edge]()
        sorting: Sorting | None = None
        sorted_to = 0
        quiet, deadline, sent = request.quiet + extra_s, started + request.whole + extra_s, started + request.wire
        in_time, before, lain = True, line.received, 0
        while True:
            if not clock.wait_readable(line, deadline):
                if not in_time or self.timing.grace_s <= 0 or (sorting is not None and sorting.complete):
                    break
                in_time, deadline = False, deadline + self.timing.grace_s
                continue
            portion = line.read()
            if not portion:
                if clock.now() > deadline:
                    break
                continue  # somebody else on this port was quicker
            data += portion
            for total, at in clock.arrivals(line):
                edges.append((total - before, at, in_time and clock.in_time(at, deadline)))
            if clock.now() > deadline:
                # What lies there counts: this process was late. But a line that never falls silent must end, too.
                lain += len(portion)
                if lain > BUFFER:
                    break
            if sorting is None:
                if len(data) < request.expected and data.startswith(request.heads[0][: len(data)]):
                    if in_time:
                        deadline = min(deadline, max(edges[-1][1], sent) + quiet)
                    continue
                if not plan.listen_on and not plan.doubtful:
                    answers = whole_answers(request, data, edges, started, self._clocks)
                    if answers is not None:
                        return self._whole(request, answers, edges, started)
                sorting = Sorting(request, started, self._clocks, plan)
            sorting.feed(data[sorted_to:], edges)
            sorted_to = len(data)
            if sorting.complete and not plan.listen_on:
                break  # else to the deadline: what is there already may have been an earlier question's
            if in_time:
                deadline = min(deadline, max(edges[-1][1], sent) + quiet)
        if sorting is None:
            sorting = Sorting(request, started, self._clocks, plan)
            sorting.feed(data, edges)
        if sorting.doubted:
            return self._asked_again(request, started, extra_s, sorting)
        return self._sorted(request, sorting.answers(edges), sorting, data, edges, started)

    def _asked_again(self, request: Request, started: float, extra_s: float, sorting: Sorting) -> list[Answer]:
        """The same question once more, when no earlier answer can come any more: servos' clocks do not tell yet."""
        for id, (tick, arrived) in sorting.doubted.items():
            self._clocks[id].follow(tick, started, arrived)
            self.statistics.of(id).retries += 1
        self._pending.distrust(started)
        self.settle()
        return self._transact(request, extra_s, again=True)

    def _whole(self, request: Request, answers: list[Answer], edges: Sequence[Edge], started: float) -> list[Answer]:
        """Take in that all answered as they should."""
        at_once = len(edges) == 1
        rtt = edges[0][1] - started
        self.statistics.count_whole(request.ids, rtt if at_once else [answer[4] for answer in answers])  # type: ignore[misc]
        self._pending.answered(request, started, request.tick_at is not None and self._undecided(request))
        self._unsettled = False
        self._restless_from, self._restless_bytes = None, 0
        self._quiet_from = edges[-1][1] - self.timing.write_read_gap_s
        return answers

    def _sorted(
        self, request: Request, answers: list[Answer], sorting: Sorting, data: bytes, edges: Sequence[Edge], started: float
    ) -> list[Answer]:  # fmt: skip
        """Take in what was sorted out: count it, and remember what may still come."""
        statistics = self.statistics
        statistics.noise_bytes += sorting.noise_bytes
        statistics.echoes += sorting.echoed
        if sorting.noise_bytes > (0 if self._restless_from is not None else request.expected):
            # more than broken answers can be, or more of the same
            self._note_unasked(sorting.noise_bytes, self.clock.now())
        broken_off = False
        for answer in answers:
            # Of a joined reply that broke off, those behind the first silent one are asked again.
            if not (broken_off and answer.cause in _BROKEN_OFF):
                statistics.count(answer.id, answer.cause, answer.rtt, answer.alert)
            broken_off = broken_off or (request.joined and answer.cause in _BROKEN_OFF)
        for id in sorting.surplus:
            self._count_late(id)
        self._pending.note(request, answers, started, surplus=bool(sorting.surplus))
        self._unsettled = bool(sorting.noise_bytes or sorting.surplus) or not all(answer.ok for answer in answers)
        if not all(answer.ok for answer in answers):
            self.failed = request.packet, data
        if data:
            self._quiet_from = edges[-1][1] - self.timing.write_read_gap_s
        return answers

    def _insist(self, instruction: Instruction, id: int, count: int, what: str) -> Answer:
        """One servo's answer, asked for again up to `retries` times; raises where it says no or nothing."""
        again = False
        for attempt in range(1 + self.retries):
            if attempt:
                self.statistics.of(id).retries += 1
            answer = self._exchange(instruction, [id], [count], attempt * RETRY_PATIENCE_S, again)[0]
            if answer.data is not None:
                break
            again = answer.cause is not Cause.LATE
        else:
            if self._restless_from is not None and not self.restless:
                self._settle(self._restless_from + RESTLESS_S + QUIET_S)  # does it fall silent?
            if self.restless:
                raise self.never_silent()
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


def _found(answer: Answer) -> FoundServo:
    assert answer.data is not None
    model, firmware = struct.unpack("<HB", answer.data[:3])
    return FoundServo(answer.id, model, firmware, answer.alert)
