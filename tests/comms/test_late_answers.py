"""To which question an answer belongs: late, doubled, swapped, echoed and stolen ones, and lines that never fall silent."""

from __future__ import annotations

import os
import pty
import random
import struct
import sys
import threading
import time
import tty
from collections import Counter
from collections.abc import Iterator, Sequence

import pytest
from faulty_line import IDS, FaultyLine, register_bytes
from places import ROOT
from wire import MemoryLine

from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.clock import RealClock, SteppedClock, portions
from openant_tools.comms.faults import BrokenAnswer, Cause, NeverSilent, NoAnswer
from openant_tools.comms.line import PortGone, SerialLine
from openant_tools.comms.protocol2 import Status
from openant_tools.comms.ticks import PROOF_S, TickClock

sys.path.append(str(ROOT / "benchmarks"))
from fuzz_transactions import TICK_GRAIN_S, faults, transact


def bus_of(line: FaultyLine, latency_timer_s: float = 1e-3) -> Bus:
    return Bus(line, line, BusTiming(return_delay_s=0.0, latency_timer_s=latency_timer_s))


@pytest.mark.parametrize("seed", range(8))
def test_no_value_is_wrong_on_a_line_that_does_all_of_it(seed: int) -> None:
    chance, seen = random.Random(seed), Counter[str]()
    line = FaultyLine(faults=faults(chance), seed=seed)
    assert transact(bus_of(line, chance.choice((1e-3, 16e-3))), line, chance, 200, seen) == []
    assert seen["kept"] > seen["rows"] / 2


@pytest.mark.parametrize("latency_timer_s", [1e-3, 16e-3])
@pytest.mark.parametrize("late_s", [0.006, 0.012, 0.02, 0.03, 0.045, 0.07, 0.1])
def test_one_late_answer_spoils_no_later_question(late_s: float, latency_timer_s: float) -> None:
    line = FaultyLine(faults={})
    bus = bus_of(line, latency_timer_s)
    bus.read(10, 44, 1)
    line.latest_s, line.faults = late_s, {"late": 1.0}
    line._chance.uniform = lambda low, high: high  # type: ignore[method-assign]
    try:
        assert bus.read(10, 31, 1) == register_bytes(10, 31, 1)
    except NoAnswer:
        pass
    line.faults = {}
    for address in (9, 11, 13, 18):
        assert bus.read(10, address, 1) == register_bytes(10, address, 1)


def test_a_loop_of_100_hz_keeps_its_rows_where_one_answer_in_a_hundred_is_late() -> None:
    line = FaultyLine(faults={"late": 0.01}, seed=3)
    bus, rows, kept = bus_of(line), 0, 0
    start = line.now()
    for k in range(1500):
        line.sleep_until(start + k * 0.01)
        asked = line.now()
        for answer in bus.sync_read(120, 27, IDS):
            rows += 1
            kept += answer.ok
            if answer.ok:
                _, read_at = struct.unpack("<Hq", (answer.data or b"")[:10])
                assert read_at * 1e-6 > asked - TICK_GRAIN_S, "an answer of an earlier cycle was taken for this one's"
    assert kept / rows > 0.97
    assert line.now() - start < 1501 * 0.01, "the loop kept its rate"


def test_an_answer_that_comes_again_in_the_next_cycle_is_dropped_and_the_next_one_kept() -> None:
    line = FaultyLine(faults={})
    bus = bus_of(line)
    for k in range(20):
        line.sleep_until(100.0 + k * 0.01)
        bus.sync_read(120, 27, [10])
    old = bus.sync_read(120, 27, [10])[0]
    line.sleep_until(line.now() + 0.01)
    line.bring(Status(10, 0, old.data or b"").encode(), line.now())
    [answer] = bus.sync_read(120, 27, [10])
    assert answer.ok
    assert answer.data != old.data
    assert bus.statistics.of(10).lost[Cause.LATE] == 1


def test_an_answer_before_its_turn_is_an_earlier_ones_however_little_it_is_older() -> None:
    """A loop that is behind asks a millisecond after the last answer: no clock tells so little apart."""
    line = FaultyLine(faults={})
    bus = bus_of(line)
    for k in range(20):
        line.sleep_until(100.0 + k * 0.01)
        old = bus.sync_read(120, 27, IDS)[-1]
    line.sleep_until(line.now() + 1e-3)
    line.bring(Status(IDS[-1], 0, old.data or b"").encode(), line.now() + 1.1e-3)
    *others, answer = bus.sync_read(120, 27, IDS)
    assert all(other.ok for other in others)
    assert answer.cause is Cause.LATE


def test_a_doubled_write_that_was_lost_is_not_taken_for_done() -> None:
    line = FaultyLine(faults={"doubled": 0.3, "late": 0.1, "lost": 0.1}, seed=5)
    bus = bus_of(line)
    for value in range(100):
        try:
            bus.write(10, 65, bytes((value,)))
        except NoAnswer:
            continue
        assert line.written_values[10] == value


def test_an_adapter_that_echoes_changes_nothing_but_is_known() -> None:
    line = FaultyLine(faults={"echoed": 1.0})
    bus = bus_of(line)
    assert bus.ping(10) is not None
    assert bus.read(10, 11, 1) == register_bytes(10, 11, 1)
    bus.write(10, 65, b"\1")
    before = line.now()
    assert all(answer.ok for answer in bus.sync_read(120, 27, IDS))
    bus.fast = set(IDS)
    assert all(answer.ok for answer in bus.sync_read(120, 27, IDS))
    assert line.now() - before < 0.012, "nobody waited for a deadline"
    assert bus.statistics.echoes == 5
    assert bus.statistics.noise_bytes == 0


def test_a_servo_that_starts_anew_is_believed_again_after_a_few_answers() -> None:
    clock = TickClock()
    for k in range(20):
        assert clock.follow(5000 + 10 * k, 1.0 + 0.01 * k, 1.002 + 0.01 * k)
    assert clock.proven(1.2)
    assert not clock.follow(3, 1.21, 1.212), "a tick that cannot be"
    for _ in range(3):
        clock.strike()
    assert not clock.proven(1.22)
    assert clock.follow(13, 1.22, 1.222)
    assert clock.follow(13 + round(PROOF_S * 1e3), 1.22 + PROOF_S, 1.222 + PROOF_S)
    assert clock.proven(1.3)


def test_a_clock_that_stands_still_is_doubted_once_and_then_tells_nothing() -> None:
    clock = TickClock()
    followed = []
    for k in range(50):
        followed.append(clock.follow(77, 1.0 + 0.01 * k, 1.002 + 0.01 * k))
        assert not clock.proven(1.0 + 0.01 * k)
    assert followed == [True, False, *[True] * 48]
    assert clock.decided_until(1.5) > 1.5, "nobody waits for it any more"


def test_servos_whose_clocks_stand_still_lose_no_answer() -> None:
    line = FaultyLine(faults={})
    line._read = lambda id, address, count, t: Status(id, 0, register_bytes(id, address, count))  # type: ignore[method-assign]
    bus, start = bus_of(line), line.now()
    for k in range(100):
        line.sleep_until(start + 0.01 * k)
        assert all(answer.ok for answer in bus.sync_read(120, 27, IDS))
    assert line.now() - start < 1.1, "one question was asked again, after what might have come"


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize("again_s", [0.002, 0.0075, 0.012, 0.04])
@pytest.mark.parametrize("lost", [False, True])
def test_an_answer_that_comes_twice_before_clocks_are_proven_is_not_the_next_cycles(
    joined: bool, again_s: float, lost: bool
) -> None:
    """Whether it lies there before the question, or comes before the answer, or instead of it."""
    line = FaultyLine(faults={})
    bus = bus_of(line)
    bus.fast = set(IDS) if joined else set()
    bring, kept, delays = line.bring, 0, (0.0,)

    def bring_after(data: bytes, t: float) -> None:
        for delay in delays:
            bring(data, t + delay)

    line.bring = bring_after  # type: ignore[method-assign]
    for k in range(20):
        line.sleep_until(line.now() + 0.01)
        asked = line.now()
        delays = {1: (0.0, again_s), 2: () if lost else (0.0,)}.get(k, (0.0,))
        for answer in bus.sync_read(120, 27, IDS):
            kept += answer.ok
            if answer.ok:
                _, read_at = struct.unpack("<Hq", (answer.data or b"")[:10])
                assert read_at * 1e-6 > asked - TICK_GRAIN_S
    assert kept >= 16 * len(IDS)


# ---- lines that never fall silent --------------------------------------------------------------------------------


@pytest.fixture
def terminal() -> Iterator[tuple[int, SerialLine]]:
    """The other end of a line, and the line, on a pseudo-terminal."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    line = SerialLine(os.ttyname(slave), 1_000_000)
    yield master, line
    line.close()
    os.close(slave)
    os.close(master)


@pytest.fixture
def babble(terminal: tuple[int, SerialLine]) -> Iterator[SerialLine]:
    """A line on which bytes come without a pause."""
    master, line = terminal
    stop = threading.Event()

    def talk() -> None:
        chance = random.Random(1)
        while not stop.is_set():
            try:
                os.write(master, chance.randbytes(40))
            except BlockingIOError:
                pass
            time.sleep(0.001)

    thread = threading.Thread(target=talk)
    thread.start()
    yield line
    stop.set()
    thread.join()


def test_every_question_ends_on_a_line_that_never_falls_silent_and_says_so(babble: SerialLine) -> None:
    bus = Bus(babble, RealClock(), BusTiming(return_delay_s=0.0, latency_timer_s=1e-3))
    began = time.monotonic()
    with pytest.raises(NeverSilent, match=r"the line never falls silent: \d+ bytes that are no answer"):
        bus.read(10, 31, 1)
    with pytest.raises(NeverSilent, match=r"the line never falls silent: \d+ bytes that are no answer"):
        bus.broadcast_ping()
    for _ in range(100):
        assert not bus.sync_read(120, 27, IDS)[0].ok
    assert bus.restless
    with pytest.raises(BrokenAnswer, match="the line never falls silent"):
        bus.read(10, 31, 1)
    assert time.monotonic() - began < 20.0, "none of them goes on for ever"


def test_noise_before_and_after_a_program_was_suspended_is_no_line_that_never_falls_silent() -> None:
    line = FaultyLine(faults={})
    bus = bus_of(line)
    for pause_s in (0.5, 0.5, 1e-3):
        line.bring(bytes(700), line.now() + 1e-4)
        bus.sync_read(120, 27, IDS)
        assert not bus.restless
        line.sleep_until(line.now() + pause_s)
        assert not bus.restless


def test_listening_until_a_deadline_ends_whatever_comes(babble: SerialLine) -> None:
    clock = RealClock()
    heard = sum(len(portion) for portion in portions(clock, babble, clock.now() + 0.05))
    assert heard > 0


def test_an_answer_that_somebody_else_has_read_is_no_hang_up(terminal: tuple[int, SerialLine]) -> None:
    _, line = terminal
    assert line.read() == b"", "nothing is there, as after another program was quicker"
    bus = Bus(line, RealClock(), BusTiming(return_delay_s=0.0, latency_timer_s=1e-3))
    assert bus.ping(10) is None


def test_a_line_whose_other_end_is_gone_is(terminal: tuple[int, SerialLine]) -> None:
    master, slave = pty.openpty()
    line = SerialLine(os.ttyname(slave), 1_000_000)
    os.close(slave)
    os.close(master)
    with pytest.raises(PortGone):
        line.read()


class Told:
    """A robot's control socket: four bytes came at 1.001 s, four more at 1.003 s."""

    path = "control"

    def ask(self, do: str, **fields: object) -> dict[str, object]:
        return {"t": 1.0, "stepped": True}

    def ask_all(self, requests: Sequence[object]) -> list[dict[str, object]]:
        said = {"bus_sent": 8, "bus_arrivals": [[4, 1.001], [8, 1.003]], "imu_sent": 0, "imu_arrivals": []}
        return [{"t": 1.004, **said} for _ in requests]


def test_in_stepped_time_bytes_that_a_terminal_brings_in_parts_came_when_the_robot_sent_them() -> None:
    line = MemoryLine()
    clock = SteppedClock(Told(), bus=line)  # type: ignore[arg-type]
    clock.sleep_until(1.004)
    line.received = 6
    assert clock.arrivals(line) == [(4, 1.001), (6, 1.003)]
    line.received = 8
    assert clock.arrivals(line) == [(8, 1.003)]
