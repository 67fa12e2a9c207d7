"""The line: one half-duplex wire, its adapter, and the servos along the cables.

Bytes from the host take their time on the wire at the host's baud rate, then each servo that hears the packet acts on
it and, in its turn, answers. What comes back is what the adapter would hand to the host, and when: in portions at the
ticks of the latency timer. The line knows no clock; it asks the world to be brought to the instant of each packet.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.protocol2 import (
    BROADCAST,
    Garbage,
    Inst,
    Instruction,
    JoinedAnswer,
    Parser,
    Status,
    encode_joined,
    stuff,
)  # fmt: skip
from openant_tools.virtual.servo import ServoDevice, read_requests

__all__ = ["Arrival", "BusSettings", "Tap", "TransactionPart", "Wire"]

Array = NDArray[np.float64]

BITS_PER_BYTE = 10
#: s, a longer pause inside an instruction packet makes servos drop it (e-manual).
INTER_BYTE_S = 1.5e-3
#: bytes after which a USB serial adapter sends without waiting for its timer
ADAPTER_BUFFER = 510
#: of a status without parameters
_STATUS_BYTES = 11
#: s, a microframe of USB; an adapter with a shorter timer has none, and hands over each answer as it ends.
SHORTEST_TIMER_S = 125e-6
_SYNC = (Inst.SYNC_READ, Inst.BULK_READ)
_FAST = (Inst.FAST_SYNC_READ, Inst.FAST_BULK_READ)
_SILENT = (Inst.SYNC_WRITE, Inst.BULK_WRITE)


@dataclass
class BusSettings:
    """Adapter and cables.

    Attributes:
        chains: servos by position, each list in the order of its cable from the adapter outwards.
        latency_timer_s: of the adapter.
        write_read_gap_s: how long after an unanswered write an instruction may be missed.
        byte_error: probability that a byte is broken, either way.
        lost: position → probability that a packet does not reach this servo, or its answer the host.
        broken: position → probability that an answer arrives with a broken byte.
        cut: positions before which the cable is broken now: nothing from there outwards hears or answers.
        response_s: from the end of a packet to the answer, besides the return delay.
        waits_for_silent: in a sync or bulk read a servo waits for the answer before its own; unpublished for
            silent ones. True: those behind a silent servo stay silent. False: they answer after a pause.
        silent_pause_s: that pause.
        stalled_until: the host stands still until this time (s).
        holds_back: the line hands nothing over meanwhile, either way. False where whoever keeps the host's clock lets the
            host itself stand still.
    """

    chains: Sequence[Sequence[int]] = ()
    latency_timer_s: float = 1e-3
    write_read_gap_s: float = 2e-4
    byte_error: float = 0.0
    lost: dict[int, float] = field(default_factory=dict)
    broken: dict[int, float] = field(default_factory=dict)
    cut: set[int] = field(default_factory=set)
    stalled_until: float = -math.inf
    holds_back: bool = True
    response_s: float = 0.0
    waits_for_silent: bool = True
    silent_pause_s: float = 1e-3


@dataclass(frozen=True, slots=True)
class Arrival:
    """Bytes that reach the host at `t` (s)."""

    t: float
    data: bytes


@dataclass(frozen=True, slots=True)
class TransactionPart:
    """One servo's part in a transaction: its status, or why there is none ("timeout", "crc"), known at `t` (s)."""

    id: int
    status: Status | None
    error: str
    t: float


@dataclass(slots=True)
class Tap:
    """What a listener with a clip on the wire would count; for tests and for the ground truth."""

    packets: int = 0
    blind: int = 0
    garbage: int = 0
    collisions: int = 0


@dataclass(slots=True)
class _Burst:
    """Bytes of one servo on the wire."""

    start: float
    data: bytes

    def end(self, byte_s: float) -> float:
        return self.start + len(self.data) * byte_s


class Wire:
    """The wire between adapter and servos.

    Args:
        servos: the devices, by position.
        advance: brings the world (physics, power, faults) to a time in s; never asked to go back.
        seed: of byte errors, losses and blind times.
    """

    def __init__(
        self, servos: Sequence[ServoDevice], settings: BusSettings, advance: Callable[[float], None], *, seed: int = 0
    ) -> None:
        self.servos, self.settings = list(servos), settings
        self.tap = Tap()
        self._advance = advance
        self._random = np.random.default_rng(seed)
        self._parser = Parser()
        self._baud = 0
        #: when the last byte from the host, and the last one of an answer, leaves the wire
        self._host_end = -math.inf
        self._answer_end = -math.inf
        self._blind_until = -math.inf
        #: how much earlier than their stamp the host's last bytes may have been written, s
        self._late_s = 0.0
        self._phase = float(self._random.random())
        #: positions plugged in now; a box of loose motors has one at a time
        self.plugged: set[int] = set(range(len(self.servos)))

    @property
    def free_at(self) -> float:
        """When the wire falls silent, s."""
        return max(self._host_end, self._answer_end)

    @property
    def _held_until(self) -> float:
        """When the line hands anything over again, s."""
        return self.settings.stalled_until if self.settings.holds_back else -math.inf

    # ---- host → servos ----

    def receive(self, data: bytes, t: float, baud: int, *, late_s: float = 0.0) -> list[Arrival]:
        """Bytes that the host wrote at `t` (s) with its port at `baud`; what comes back of it, by rising time.

        Args:
            late_s: how much earlier they may have been written, where `t` is when a busy reader came to them. A pause
                before them may have been shorter by it, one behind them longer: servos miss nothing that they would
                have heard if it was so.
        """
        byte_s = BITS_PER_BYTE / baud
        start = max(t, self._host_end, self._held_until)
        if baud != self._baud:
            self._parser, self._baud = Parser(), baud
        elif self._parser.pending and start - late_s - self._host_end > INTER_BYTE_S:
            self._parser.flush()
        collided = start < self._answer_end
        if collided:
            self.tap.collisions += 1
            data = bytes(len(data))
        if self.settings.byte_error > 0:
            data = self._corrupt(data)
        pending = self._parser.pending
        found = self._parser.feed(data)
        self._host_end = start + len(data) * byte_s
        self._late_s = late_s
        at = start - pending * byte_s
        replies: list[Arrival] = []
        for packet in found:
            began = at
            at += _wire_length(packet) * byte_s
            if isinstance(packet, Instruction):
                replies += self._deliver(self._execute(packet, began, at, byte_s), byte_s)
            else:
                self.tap.garbage += 1
        return replies

    def _corrupt(self, data: bytes) -> bytes:
        hit = np.flatnonzero(self._random.random(len(data)) < self.settings.byte_error)
        if not len(hit):
            return data
        broken = bytearray(data)
        for k in hit:
            broken[k] ^= int(self._random.integers(1, 256))
        return bytes(broken)

    def _reached(self) -> list[int]:
        """Positions that the signal gets to now."""
        cut = self.settings.cut
        if not cut:
            return sorted(self.plugged)
        reached: set[int] = set()
        chained: set[int] = set()
        for chain in self.settings.chains:
            whole = True
            for position in chain:
                whole = whole and position not in cut
                chained.add(position)
                if whole:
                    reached.add(position)
        reached |= {k for k in range(len(self.servos)) if k not in chained and k not in cut}
        return sorted(reached & self.plugged)

    def _lost(self, position: int) -> bool:
        share = self.settings.lost.get(position, 0.0)
        return share > 0 and bool(self._random.random() < share)

    def _scratched(self, position: int, data: bytes) -> bytes:
        """An answer as it leaves a bad contact: maybe with one byte broken."""
        share = self.settings.broken.get(position, 0.0)
        if not share or self._random.random() >= share:
            return data
        scratched = bytearray(data)
        scratched[int(self._random.integers(len(data)))] ^= int(self._random.integers(1, 256))
        return bytes(scratched)

    def _execute(self, packet: Instruction, began: float, ended: float, byte_s: float) -> list[_Burst]:
        """Let the servos act on a packet whose last byte passes at `ended`; what they put on the wire."""
        said, acted = self._obey(packet, began, ended)
        bursts = self._speak(packet, said, ended, byte_s)
        if bursts:
            self._answer_end = max(burst.end(byte_s) for burst in bursts)
        self._finish(acted, max(ended, self._answer_end))
        return bursts

    def _obey(self, packet: Instruction, began: float, ended: float) -> tuple[dict[int, Status], list[ServoDevice]]:
        """Who hears the packet does it: position → what it says, and all who have heard."""
        self.tap.packets += 1
        if began < self._blind_until and packet.code not in (*_SILENT, Inst.WRITE, Inst.REG_WRITE):
            self.tap.blind += 1
            return {}, []
        self._advance(ended)
        said: dict[int, Status] = {}
        acted: list[ServoDevice] = []
        for position in self._reached():
            servo = self.servos[position]
            if servo.baud != self._baud or self._lost(position):
                continue
            acted.append(servo)
            status = servo.execute(packet, ended)
            if status is not None and not self._lost(position):
                said[position] = status
        if packet.code in _SILENT or (packet.id == BROADCAST and packet.code in (Inst.WRITE, Inst.REG_WRITE)):
            self._blind_until = ended - self._late_s + self._blind_time()
        return said, acted

    def _finish(self, acted: list[ServoDevice], t: float) -> None:
        for servo in acted:
            servo.replied(t)

    def _blind_time(self) -> float:
        """How long servos stay deaf after a write that nobody answers, s.

        The platform's authors lost 96 % of reads sent at once, 80 % after half the gap, and none after the gap.
        """
        gap = self.settings.write_read_gap_s
        luck = self._random.random()
        if luck < 0.04:
            return 0.0
        return gap * (0.5 * self._random.random() if luck < 0.2 else 0.5 + 0.5 * self._random.random())

    # ---- servos → host ----

    def _turns(self, packet: Instruction, said: dict[int, Status]) -> list[list[tuple[int, Status]]]:
        """Who speaks after whom: (position, status) of all who take a turn, [] for a servo asked that says nothing."""
        if packet.id != BROADCAST:
            return [list(said.items())] if said else []
        by_id: dict[int, list[tuple[int, Status]]] = {}
        for position, status in said.items():
            by_id.setdefault(status.id, []).append((position, status))
        if packet.code in (*_SYNC, *_FAST):
            turns = [by_id.get(id, []) for id, _, _ in read_requests(packet)]
        else:
            # A broadcast ping: one after another by ID.
            turns = [by_id[id] for id in sorted(by_id)]
        if packet.code in _FAST or self.settings.waits_for_silent:
            turns = turns[: next((k for k, turn in enumerate(turns) if not turn), len(turns))]
        return turns

    def _speak(self, packet: Instruction, said: dict[int, Status], ended: float, byte_s: float) -> list[_Burst]:
        """What the servos put on the wire, and when."""
        turns = self._turns(packet, said)
        pieces: list[list[bytes]]
        if packet.code in _FAST and packet.id == BROADCAST:
            joined = self._joined(packet, turns)
            pieces = [[piece] * len(turn) for piece, turn in zip(joined, turns, strict=True)]
        else:
            pieces = [[status.encode() for _, status in turn] for turn in turns]
        bursts: list[_Burst] = []
        t = ended + self.settings.response_s
        for turn, data in zip(turns, pieces, strict=True):
            if not turn:
                t += self.settings.silent_pause_s
                continue
            spoken = [
                _Burst(t + self.servos[k].return_delay_s, self._scratched(k, piece))
                for (k, _), piece in zip(turn, data, strict=True)
            ]
            bursts += spoken
            t = max(burst.end(byte_s) for burst in spoken) + self.settings.response_s
        return bursts

    def _joined(self, packet: Instruction, turns: list[list[tuple[int, Status]]]) -> list[bytes]:
        """The pieces of a joined reply for those who speak; its announced length counts all who were asked."""
        parts: list[JoinedAnswer] = []
        for n, (id, _, count) in enumerate(read_requests(packet)):
            status = turns[n][0][1] if n < len(turns) else Status(id)
            # A refused read has no data, yet the packet's length is announced: the place is filled with zeros.
            parts.append(JoinedAnswer(id, status.error, status.params.ljust(count, b"\0")[:count]))
        return encode_joined(parts)[: len(turns)]

    # ---- the same without bytes ----

    def transact(self, packet: Instruction, t: float) -> tuple[list[TransactionPart], float]:
        """One instruction without its bytes: what each servo asked answers, and when the host knows.

        For soaks of hours, where packets need not be spelled. Devices, order, faults and times are those of `receive`
        (with the probabilities of broken bytes put together per packet), and the port's rate is right.

        Args:
            t: s, when the host writes.
        """
        self._late_s = 0.0
        self._baud = self._baud or max((self.servos[k].baud for k in self.plugged), default=57_600)
        byte_s, noise = BITS_PER_BYTE / self._baud, self.settings.byte_error
        began = max(t, self.free_at, self._held_until)
        length = _wire_length(packet)
        ended = self._host_end = began + length * byte_s
        if noise and self._random.random() < 1 - (1 - noise) ** length:
            self.tap.garbage += 1
            said, acted = {}, []  # type: dict[int, Status], list[ServoDevice]
        else:
            said, acted = self._obey(packet, began, ended)
        answers: list[TransactionPart] = []
        at = ended + self.settings.response_s
        for turn in self._turns(packet, said):
            if not turn:
                at += self.settings.silent_pause_s
                continue
            length = _STATUS_BYTES + len(turn[0][1].params)
            at += max(self.servos[k].return_delay_s for k, _ in turn) + length * byte_s
            clean = all(status == turn[0][1] for _, status in turn)
            broken = max(self.settings.broken.get(k, 0.0) for k, _ in turn)
            right = (1 - broken) * (1 - noise) ** length
            if clean and (right == 1 or self._random.random() < right):
                answers.append(TransactionPart(turn[0][1].id, turn[0][1], "", self._tick_after(at)))
            else:
                answers.append(TransactionPart(turn[0][1].id, None, "crc", self._tick_after(at)))
            at += self.settings.response_s
        if answers:
            self._answer_end = at
        self._finish(acted, max(ended, self._answer_end))
        heard = {answer.id for answer in answers}
        asked = [id for id, _, _ in read_requests(packet)] if packet.code in (*_SYNC, *_FAST) else [packet.id]
        missing = [id for id in asked if id not in heard and id != BROADCAST]
        answers += [TransactionPart(id, None, "timeout", ended) for id in missing]
        return answers, max([ended, *(answer.t for answer in answers)])

    def _tick_after(self, t: float) -> float:
        """When the adapter hands over what has arrived at t."""
        period = self.settings.latency_timer_s
        if period < SHORTEST_TIMER_S:
            return max(t, self._held_until)
        tick = (math.floor(t / period - self._phase) + 1 + self._phase) * period
        return max(tick, self._held_until)

    def _deliver(self, bursts: list[_Burst], byte_s: float) -> list[Arrival]:
        """What the host gets: the line's bytes, cut at the ticks of the latency timer."""
        if not bursts:
            return []
        bursts.sort(key=lambda burst: burst.start)
        data = b"".join(burst.data for burst in bursts)
        stalled, period = self._held_until, self.settings.latency_timer_s
        spaced = all(b.start >= a.end(byte_s) - byte_s / 2 for a, b in itertools.pairwise(bursts))
        if spaced and period < SHORTEST_TIMER_S and self.settings.byte_error == 0 and len(data) < ADAPTER_BUFFER:
            return self._pieces(bursts, byte_s)
        ends = np.concatenate([burst.start + byte_s * np.arange(1, len(burst.data) + 1) for burst in bursts])
        if not spaced:
            data, ends = _collide(data, ends, byte_s)
        if self.settings.byte_error > 0:
            data = self._corrupt(data)
        if period < SHORTEST_TIMER_S:
            ticks, at_tick = np.cumsum(np.diff(ends, prepend=ends[0]) > 1.5 * byte_s), None
        else:
            # The timer runs free; a byte waits for its next tick, together with all that arrive until then.
            ticks = np.floor(ends / period - self._phase)
            at_tick = (ticks + 1 + self._phase) * period
        starts = [0, *(np.flatnonzero(np.diff(ticks)) + 1).tolist()]
        stops = [*starts[1:], len(data)]
        at = np.maximum(ends[np.array(stops) - 1] if at_tick is None else at_tick[starts], stalled).tolist()
        replies: list[Arrival] = []
        for start, stop, tick in zip(starts, stops, at, strict=True):
            # A full buffer goes out at once.
            while stop - start >= ADAPTER_BUFFER:
                full = start + ADAPTER_BUFFER
                replies.append(Arrival(max(float(ends[full - 1]), stalled), data[start:full]))
                start = full
            if start < stop:
                replies.append(Arrival(tick, data[start:stop]))
        return replies

    def _pieces(self, bursts: list[_Burst], byte_s: float) -> list[Arrival]:
        """Without a timer: what comes in one piece is handed over in one piece."""
        replies: list[Arrival] = []
        piece, until = bursts[0].data, bursts[0].end(byte_s)
        for burst in bursts[1:]:
            if burst.start > until + byte_s / 2:
                replies.append(Arrival(max(until, self._held_until), piece))
                piece = b""
            piece += burst.data
            until = burst.end(byte_s)
        replies.append(Arrival(max(until, self._held_until), piece))
        return replies


def _collide(data: bytes, ends: Array, byte_s: float) -> tuple[bytes, Array]:
    """Bytes that overlap on the wire become one: the line is low wherever anyone pulls it low."""
    order = np.argsort(ends, kind="stable")
    merged, at = bytearray(), []  # type: bytearray, list[float]
    for k in order:
        if at and ends[k] - at[-1] < byte_s / 2:
            merged[-1] &= data[k]
        else:
            merged.append(data[k])
            at.append(float(ends[k]))
    return bytes(merged), np.array(at)


def _wire_length(packet: object) -> int:
    """Bytes that a parsed packet had on the wire."""
    if isinstance(packet, Instruction):
        return 9 + len(stuff(bytes((packet.code,)) + packet.params))
    if isinstance(packet, Garbage):
        return len(packet.data)
    if isinstance(packet, Status):
        return len(packet.encode())
    return 0
