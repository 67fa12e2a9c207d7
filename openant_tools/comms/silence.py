"""Why a servo does not answer: what can be asked is asked, and the cable is named when all else is excluded.

For a bus with torque off on which somebody did not answer. Nothing is written; a question costs some ten milliseconds, and
a silent servo is sought at every baud rate and in both protocols.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from openant_tools.comms import protocol1
from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus, called
from openant_tools.comms.faults import BrokenAnswer, NoAnswer
from openant_tools.comms.ports import Host, PortHolder
from openant_tools.comms.troubles import SILENCE
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.numbers import number, span
from openant_tools.robot.servo import BAUD_CODES, hardware_errors, servo_model

__all__ = [
    "PATIENCE_S",
    "Heard",
    "Silence",
    "ask",
    "diagnose",
    "explained",
    "explaining",
    "reader_words",
    "return_level",
]

#: s that a single question waits, again and again: a patient one tells a late answer from none.
PATIENCE_S = (0.06, 0.12, 0.25)
#: s without a byte before a question, and the most that is waited for it
QUIET_S, RESTLESS_S = 0.02, 0.3
#: pings of one servo that show whether its answers are taken away
PROOFS = 24
#: s that reads wait for an answer before a servo is called silent to reads, and how many of them must have been fair
LEVEL_WAITS_S, FAIR = (*PATIENCE_S[1:], 0.06, 0.06, 0.06), 3
#: share of a wait by which this computer may be late in it for the silence to count
LATE_SHARE = 0.5
RETURN_LEVEL, ERROR_STATUS, VOLTAGE = 68, 70, 144
#: so many silent servos are each sought at every baud rate; the others, where one of these is found
FEW = 3
#: Status Return Level → what a servo answers
LEVELS = {0: "pings only", 1: "pings and reads, and no writes"}


@dataclass
class Heard:
    """What came after one question.

    Attributes:
        data: every byte. answer_s: s from the question to the first answer of the servo asked.
        empty: how often the line was said to have bytes, and had none: somebody else had read them.
        garbage: bytes that are no packet.
        late_s: how late this computer was meanwhile.
    """

    data: bytes = b""
    statuses: list[p2.Status] = field(default_factory=list)
    answer_s: float | None = None
    empty: int = 0
    garbage: int = 0
    echo: bool = False
    late_s: float = 0.0


@dataclass(frozen=True)
class Silence:
    """Why it is silent.

    Attributes:
        cause: a key of `troubles.SILENCE`. ids: whom it concerns.
        what, remedy: its words.
        rest: further causes, of other servos.
        values: what was found, such as `level`, `baud`.
    """

    cause: str
    ids: tuple[int, ...]
    what: str
    remedy: str
    rest: tuple[Silence, ...] = ()
    values: dict[str, Any] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """All of it in one line."""
        return "; ".join([f"{one.what} → {one.remedy}" for one in (self, *self.rest)])

    def fault(self, where: str, before: str = "") -> NoAnswer:
        """The error that says it, after what was seen `before`."""
        what = (f"{before}: " if before else "") + "; ".join([self.what, *(one.what for one in self.rest)])
        return NoAnswer(
            what, where=where, remedy="; ".join(dict.fromkeys([self.remedy, *(one.remedy for one in self.rest)]))
        )


def ask(
    bus: Bus, packet: bytes, wait_s: float, done: Callable[[Heard], bool] = lambda heard: False, id: int | None = None
) -> Heard:
    """Send a packet on a line that has been quiet, and take all that comes within `wait_s` (s), or until `done`."""
    line, clock = bus.line, bus.clock
    heard = Heard()
    give_up = clock.now() + RESTLESS_S
    while clock.now() < give_up and clock.wait_readable(line, clock.now() + QUIET_S):
        if not line.read():
            break
    clock.lateness.mark()
    bus.send(packet)
    started = clock.now()
    deadline, parser = started + wait_s, p2.Parser()
    while clock.wait_readable(line, deadline):
        part = line.read()
        if not part:
            heard.empty += 1
            if heard.empty > 50:
                break
            continue
        heard.data += part
        for item in parser.feed(part):
            _take(heard, item, packet, id, clock.now() - started)
        if done(heard) or clock.now() > deadline:
            break
    for item in parser.flush():
        _take(heard, item, packet, id, clock.now() - started)
    heard.late_s = clock.lateness.cycle()
    return heard


def _take(heard: Heard, item: object, packet: bytes, id: int | None, after_s: float) -> None:
    if isinstance(item, p2.Status):
        heard.statuses.append(item)
        if item.id == id and heard.answer_s is None:
            heard.answer_s = after_s
    elif isinstance(item, p2.Garbage):
        heard.garbage += len(item.data)
    elif isinstance(item, p2.Instruction):
        heard.echo = heard.echo or item.encode() == packet


def patient_ping(bus: Bus, id: int, tries: Sequence[float] = PATIENCE_S) -> tuple[p2.Status | None, Heard]:
    """A servo's answer to a ping, asked for several times, each time longer; and all that was heard for it.

    `late_s` is then the smallest share of its time by which this computer was late in any of the tries.
    """
    every = Heard(late_s=math.inf)
    for wait_s in tries:
        heard = ask(bus, p2.ping(id).encode(), wait_s, lambda h: h.answer_s is not None, id)
        every.late_s = min(every.late_s, heard.late_s / wait_s)
        every.data, every.echo = every.data + heard.data, every.echo or heard.echo
        every.empty, every.garbage = every.empty + heard.empty, every.garbage + heard.garbage
        mine = [one for one in heard.statuses if one.id == id and len(one.params) >= 3]
        if mine:
            every.answer_s = heard.answer_s
            return mine[0], every
    return None, every


def read_register(bus: Bus, id: int, address: int, count: int) -> bytes | None:
    """A register of a servo that may be late; None where it does not answer a read."""
    for wait_s in PATIENCE_S[1:]:
        # An earlier ping's answer, late, is none to this.
        heard = ask(bus, p2.read(id, address, count).encode(), wait_s, lambda h: _register(h, id, count) is not None)
        data = _register(heard, id, count)
        if data is not None:
            return data
    return None


def _register(heard: Heard, id: int, count: int) -> bytes | None:
    return next((one.params for one in heard.statuses if one.id == id and len(one.params) == count), None)


def return_level(bus: Bus, id: int) -> int | None:
    """Status Return Level of a servo that answers pings; None where it cannot be told.

    Level 0, at which a servo answers pings alone, is told by silence, so only of one that answered a ping after each read
    that it let pass, while this computer was punctual.
    """
    fair = 0
    for wait_s in LEVEL_WAITS_S:
        heard = ask(bus, p2.read(id, RETURN_LEVEL, 1).encode(), wait_s, lambda h: _register(h, id, 1) is not None)
        data = _register(heard, id, 1)
        if data is not None:
            return data[0]
        status, ping = patient_ping(bus, id, PATIENCE_S[:1])
        fair += status is not None and max(heard.late_s / wait_s, ping.late_s) < LATE_SHARE
    return 0 if fair >= FAIR else None


def protocol_1_ping(bus: Bus, id: int, wait_s: float = PATIENCE_S[0]) -> list[int]:
    """The ids that answer a ping in Protocol 1.0."""
    asked = protocol1.ping(id)
    data = ask(bus, asked, wait_s, lambda h: id != p2.BROADCAST and len(h.data) > len(asked)).data
    # An echo of the question has the form of an answer: its error byte is the instruction.
    heard = protocol1.statuses(data.removeprefix(asked))
    return sorted({one.id for one in heard if one.id <= p2.MAX_ID and not one.params})


def reader_words(path: str, host: Host | None = None) -> str:
    """Another program that has this port open, in words; empty where none is seen."""
    readers = (host or Host()).readers(path)
    return SILENCE["second_reader"].says.format(who=_programs(readers)) if readers else ""


def _programs(readers: Sequence[PortHolder]) -> str:
    return ", ".join(f"{one.command} (process {one.pid})" for one in readers)


# ---- the diagnosis ---------------------------------------------------------------------------------------------------


def diagnose(
    bus: Bus,
    ids: Sequence[int],
    asked: Sequence[int] = (),
    chain: Sequence[Sequence[str]] = (),
    *,
    was_there: bool = False,
    host: Host | None = None,
) -> Silence:
    """Why `ids` did not answer. Nothing is written, and torque should be off.

    Args:
        asked: everyone who was asked, in the order of the cable as far as it is known.
        chain: lists of the servos' names, each in the order of its cable.
        was_there: they have answered a moment ago: they are not sought at other rates and in Protocol 1.0.
    """
    return _Questions(bus, tuple(ids), tuple(asked or ids), chain, was_there, host or Host()).answer()


@dataclass
class _Questions:
    bus: Bus
    ids: tuple[int, ...]
    asked: tuple[int, ...]
    chain: Sequence[Sequence[str]]
    was_there: bool
    host: Host
    seen: dict[int, p2.Status] = field(default_factory=dict)
    heard: dict[int, Heard] = field(default_factory=dict)

    def answer(self) -> Silence:
        bus = self.bus
        readers = self.host.readers(bus.line.path)
        if readers:
            return self._say("second_reader", self.ids, who=_programs(readers))
        for id in self.ids:
            status, heard = patient_ping(bus, id, PATIENCE_S if len(self.ids) < 4 else PATIENCE_S[1:2])
            self.heard[id] = heard
            if status is not None:
                self.seen[id] = status
        if self._stolen():
            return self._say("unseen_reader", self.ids, port=bus.line.path)
        found = [self._of_one_that_answers(id) for id in self.seen]
        silent = tuple(id for id in self.ids if id not in self.seen)
        if silent:
            found += self._of_silent(silent)
        return _together(found, self)

    def _stolen(self) -> bool:
        """Whether bytes are taken away: the line had some and then had none, more than once."""
        empty = sum(one.empty for one in self.heard.values())
        others = [id for id in self.asked if id not in self.ids]
        witness = next(iter(self.seen), others[0] if others else None)
        if witness is not None and (empty or len(self.seen) < len(self.ids) or not self._lateness.busy):
            for _ in range(PROOFS if empty or not self.seen else PROOFS // 3):
                empty += ask(self.bus, p2.ping(witness).encode(), 0.03, lambda h: h.answer_s is not None, witness).empty
        return empty > 1

    @property
    def _lateness(self) -> Any:
        return self.bus.clock.lateness

    def _of_one_that_answers(self, id: int) -> Silence:
        """What keeps a servo that answers pings from answering all."""
        bus, status = self.bus, self.seen[id]
        if status.alert:
            return self._error(id)
        level = return_level(bus, id)
        if level is None:
            return self._late((id,))
        if level < 2:
            return self._say("return_level", (id,), level=level, answers=LEVELS[level])
        # Alone on a quiet line: what came before may have been the answer to an earlier try.
        bus.clock.sleep_until(bus.clock.now() + PATIENCE_S[1])
        heard = ask(bus, p2.ping(id).encode(), PATIENCE_S[2], lambda h: h.answer_s is not None, id)
        after = heard.answer_s or 0.0
        timing = bus.timing
        usual = timing.return_delay_s + timing.latency_timer_s + timing.margin_s + bus.wire_s(24)
        if self._lateness.busy:
            return self._late((id,))
        if after > usual:
            return self._say("late_answers", (id,), after=number(after, "s"))
        return self._say("intermittent", (id,))

    def _error(self, id: int) -> Silence:
        value = read_register(self.bus, id, ERROR_STATUS, 1)
        errors = hardware_errors(value[0]) if value else ()
        names = " and ".join(error.name for error in errors) or "a hardware error"
        advice = errors[0].advice if errors else "let it cool, free the joint, look at the supply; then reboot it"
        return self._say("hardware_error", (id,), error=names, advice=advice, id=id, port=self.bus.line.path)

    def _of_silent(self, silent: tuple[int, ...]) -> list[Silence]:
        bus, out = self.bus, list[Silence]()
        own = bus.line.baud
        elsewhere = {} if self.was_there else find_elsewhere(bus, silent)
        for id in silent:
            if id not in elsewhere:
                continue
            baud, protocol = elsewhere[id]
            cause = "protocol_1" if protocol == 1 else "other_baud"
            out.append(self._say(cause, (id,), baud=baud, speed=f"{own} baud"))
        garbled = tuple(id for id in silent if id not in elsewhere and self.heard[id].garbage)
        if garbled:
            out.append(self._say("shared_id", garbled))
        left = tuple(id for id in silent if id not in elsewhere and id not in garbled)
        if left:
            out += self._of_mute(left)
        return out

    def _of_mute(self, left: tuple[int, ...]) -> list[Silence]:
        """For those that answer at no rate and in no protocol."""
        supply = self._supply([id for id in self.asked if id not in left])
        if supply is not None:
            volts, low, high = supply
            allowed = span(low, high, "V", decimals=1)
            return [self._say("supply", left, volts=number(volts, "V", decimals=1), range=allowed)]
        if all(self.heard[id].late_s > LATE_SHARE for id in left):
            return [self._late(left)]
        if len(left) == len(self.asked):
            if all(self.heard[id].echo for id in left):
                return [self._say("echo_only", left)]
            if len(left) > 1:
                return [self._say("all_lost" if self.was_there else "nobody", left)]
        cause = "lost" if self.was_there else "cable"
        return [self._say(cause, ids, first=first, before=before) for ids, first, before in self._places(left)]

    def _supply(self, others: Sequence[int]) -> tuple[float, float, float] | None:
        """(V, lowest and highest allowed) of one that answers and is out of its range."""
        for id in others:
            status, _ = patient_ping(self.bus, id, PATIENCE_S[:1])
            data = None if status is None else read_register(self.bus, id, VOLTAGE, 2)
            if status is None or data is None:
                continue
            try:
                low, high = servo_model(int.from_bytes(status.params[:2], "little")).supply_range_v
            except BadInput:
                continue
            volts = int.from_bytes(data, "little") * 0.1
            if not low <= volts <= high + 0.5:
                return volts, low, high
        return None

    def _places(self, left: Sequence[int]) -> Iterator[tuple[tuple[int, ...], str, str]]:
        """Cable by cable: its silent servos, the first of them, and what comes before that."""
        names = {self.bus.names.get(id, ""): id for id in self.asked}
        cables = [[names[name] for name in cable if name in names] for cable in self.chain]
        for cable in [cable for cable in cables if cable] or [list(self.asked)]:
            silent = tuple(id for id in cable if id in left)
            if silent:
                at = cable.index(silent[0])
                before = _name(self.bus, cable[at - 1]) if at else "the adapter or board"
                yield silent, _name(self.bus, silent[0]), before

    def _late(self, ids: tuple[int, ...]) -> Silence:
        return self._say("host_late", ids, late=self._lateness.words or "this computer was late")

    def _say(self, cause: str, ids: tuple[int, ...], **values: Any) -> Silence:
        trouble = SILENCE[cause]
        values = {"who": _who(self.bus, ids), **values}
        return Silence(cause, ids, trouble.says.format(**values), trouble.do.format(**values), (), values)


def find_elsewhere(bus: Bus, ids: Sequence[int]) -> dict[int, tuple[int, int]]:
    """id → (baud rate, protocol) at which it answers instead of Protocol 2.0 at the line's own rate; the line keeps its
    rate."""
    own, found = bus.line.baud, dict[int, tuple[int, int]]()
    try:
        for baud in (own, *(rate for rate in BAUD_CODES.values() if rate != own)):
            bus.line.set_baud(baud)
            here = len(found)
            for k, id in enumerate(ids):
                # Of many that are silent together a few are asked for the others.
                if id in found or (k >= FEW and len(found) == here and baud != own):
                    continue
                if baud != own and patient_ping(bus, id, PATIENCE_S[:1])[0] is not None:
                    found[id] = baud, 2
                elif protocol_1_ping(bus, id) == [id]:
                    found[id] = baud, 1
            if len(found) == len(ids):
                break
    finally:
        bus.line.set_baud(own)
    return found


def _name(bus: Bus, id: int) -> str:
    return bus.names.get(id, f"servo {id}")


def _who(bus: Bus, ids: Sequence[int]) -> str:
    return ", ".join(called(bus.names[id], id) if id in bus.names else f"servo {id}" for id in ids)


def _together(found: Sequence[Silence], questions: _Questions) -> Silence:
    """One of several causes leads, in the order of the table; servos of one cause and the same words share them."""
    grouped: dict[tuple[Any, ...], Silence] = {}
    for one in found:
        key = (
            one.cause,
            *(str(value) for name, value in one.values.items() if name not in ("who", "id", "after", "late")),
        )
        if key in grouped:
            values = {name: value for name, value in one.values.items() if name != "who"}
            grouped[key] = questions._say(one.cause, (*grouped[key].ids, *one.ids), **values)
        else:
            grouped[key] = one
    order = list(SILENCE)
    first, *rest = sorted(grouped.values(), key=lambda one: order.index(one.cause))
    return Silence(first.cause, first.ids, first.what, first.remedy, tuple(rest), first.values)


def explained(bus: Bus, error: HardwareFault, chain: Sequence[Sequence[str]] = ()) -> HardwareFault:
    """The same fault, and why, where it is a servo's silence: the servos are asked. Torque should be off."""
    if not isinstance(error, NoAnswer | BrokenAnswer) or not error.ids:
        return error
    try:
        found = diagnose(bus, error.ids, error.asked, chain)
    except HardwareFault as other:
        return other  # the port is gone, or never falls silent: that says more
    if isinstance(error, BrokenAnswer) and found.cause == "intermittent":
        return error  # what comes broken now and then is noise or a plug, as it says
    return found.fault(bus.line.path, error.what)


@contextlib.contextmanager
def explaining(bus: Bus, chain: Sequence[Sequence[str]] = ()) -> Iterator[None]:
    """A servo's silence within the block is raised with its cause."""
    try:
        yield
    except (NoAnswer, BrokenAnswer) as error:
        raise explained(bus, error, chain) from None
