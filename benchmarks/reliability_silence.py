"""Attacks on a bus whose servos keep silent, and on a computer that is late: rows of docs/reliability.md."""

from __future__ import annotations

import contextlib
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from campaign import Campaign

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from talker import READER, Talker, talking
from wire import IDS, ant

from openant_tools.comms.bus import Bus
from openant_tools.comms.reboot import reboot
from openant_tools.comms.scan import scan
from openant_tools.comms.setup import open_bus
from openant_tools.comms.silence import diagnose
from openant_tools.procedure.step import Answer, Event, drive

__all__ = ["campaigns"]

ANT = tuple(IDS)
MEGABAUD = 1_000_000


class Granting:
    """Who grants everything."""

    def answer(self, event: Event) -> Answer:
        return True


@contextlib.contextmanager
def _bus(*ids: int, **habits: object) -> Iterator[tuple[Bus, Talker]]:
    with tempfile.TemporaryDirectory() as folder, talking(Path(folder), *ids, **habits) as talker:
        bus = open_bus(talker.path, MEGABAUD)
        try:
            yield bus, talker
        finally:
            bus.close()


def _late_ids(k: int) -> bool:
    ids = tuple(sorted(random.Random(k).sample(range(253), 5)))
    with _bus(*ids, slot_s=3e-3) as (bus, _):
        found = scan(bus, [MEGABAUD])
        return tuple(one.id for one in found.servos) == ids and found.certain


def _shy(k: int) -> bool:
    shy = tuple(random.Random(k).sample(ANT, 1 + k % 3))
    with _bus(*ANT, shy=shy) as (bus, _):
        found = scan(bus, [MEGABAUD])
        return tuple(one.id for one in found.servos) == ANT and not found.certain


def _thief(k: int) -> bool:
    with _bus(*ANT) as (bus, talker):
        other = subprocess.Popen([sys.executable, "-c", READER, talker.path], stdout=subprocess.PIPE)
        try:
            assert other.stdout is not None
            other.stdout.readline()
            found = scan(bus, [MEGABAUD])
            return not found.certain and any(f"process {other.pid}" in doubt for doubt in found.doubts)
        finally:
            other.kill()
            other.wait()


def _told(k: int) -> bool:
    """A servo that was told to be silent, one way or the other, behind an adapter that may echo."""
    chance = random.Random(k)
    id, way = chance.choice(ANT), chance.choice((0, 1, "protocol 1"))
    with _bus(*ANT, echo=bool(k % 2), old=(id,) if way == "protocol 1" else ()) as (bus, talker):
        if way != "protocol 1":
            talker.memory[id][68] = int(way)
        found = diagnose(bus, [id], ANT)
        cause = "protocol_1" if way == "protocol 1" else "return_level"
        return found.cause == cause and found.ids == (id,) and not talker.written


def _cut(k: int) -> bool:
    """A true bad cable is still called one, and the place is right."""
    bus, line = ant()
    at = 1 + k % 7
    line.wire.settings.lost |= dict.fromkeys(range(at, 8), 1.0)
    found = diagnose(bus, IDS[at:], IDS)
    return found.cause == "cable" and found.values["first"] == bus.names[IDS[at]]


def _held_back(k: int) -> bool:
    with _bus(*ANT, late_s=random.Random(k).uniform(0.03, 0.09)) as (bus, _):
        found = diagnose(bus, [31], ANT)
        return found.cause in ("late_answers", "host_late")


def _latched(k: int) -> bool:
    bit = (0x01, 0x04, 0x08, 0x10, 0x20)[k % 5]
    with _bus(10, 31) as (bus, talker):
        talker.memory[31][70], talker.memory[31][64] = bit, 1
        found = drive(reboot(bus, 31, "knee_fl", "openant comms reboot"), Granting())
        return bool(found.ok) and talker.memory[31][64] == 0


def _stopped(k: int) -> bool:
    """This process stands still in the midst of a wait, and must own up to it."""
    length = random.Random(k).uniform(0.03, 0.1)
    words = (
        "import os, signal, sys, time; pid, s = int(sys.argv[1]), float(sys.argv[2]); os.kill(pid, signal.SIGSTOP); "
    )
    words += "time.sleep(s); os.kill(pid, signal.SIGCONT)"
    with _bus(10) as (bus, _):
        late = bus.clock.lateness
        stopper = subprocess.Popen([sys.executable, "-S", "-c", words, str(os.getpid()), f"{length}"])
        late.mark()
        worst = 0.0
        while stopper.poll() is None:
            bus.clock.wait_readable(bus.line, bus.clock.now() + 0.001)
            worst = max(worst, late.cycle())
        return worst > length - 0.01 and "this computer was late by up to" in late.words


def campaigns() -> list[Campaign]:
    rows: list[tuple[str, int, Callable[[int], bool]]] = [
        ("five servos of random ids answer a broadcast ping 3 ms an id late: a scan lists them all", 10, _late_ids),
        ("servos ignore a broadcast ping: listed all the same, and the list says that it may be partial", 10, _shy),
        ("another program reads the port: it is named, and no list is called whole", 10, _thief),
        (
            "Status Return Level 0 or 1, or Protocol 1.0, every second time behind an echo: named, nothing written",
            20,
            _told,
        ),
        ("every answer comes 30 to 90 ms late: called late, never a cable", 10, _held_back),
        ("a cable is cut at a random place: called a cable, at that place", 20, _cut),
        ("this computer stands still for 30 to 100 ms in a wait: it says so, and how long", 10, _stopped),
        ("a hardware error is latched with torque on: named, cleared, torque off", 10, _latched),
    ]
    return [Campaign(*row) for row in rows]


if __name__ == "__main__":
    for one in campaigns():
        survived = sum(one.run(k) for k in range(one.tries))
        print(f"{survived} of {one.tries}: {one.attack}")
