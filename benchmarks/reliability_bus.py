"""Answers that belong to other questions, and lines that never fall silent: rows for docs/reliability.md."""

from __future__ import annotations

import os
import pty
import random
import sys
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from campaign import Campaign
from fuzz_transactions import KINDS, faults, transact

from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.clock import RealClock
from openant_tools.comms.faults import NeverSilent
from openant_tools.comms.line import SerialLine
from openant_tools.errors import HardwareFault

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from faulty_line import IDS, FaultyLine

__all__ = ["campaigns"]

TRANSACTIONS = 1000


def campaigns() -> list[Campaign]:
    """Each kind of fault alone, all together, and babble at several rates."""
    of_a_kind = [
        Campaign(
            f"{TRANSACTIONS} transactions while up to one answer in ten is {kind}: no wrong value",
            20,
            lambda k, kind=kind: _transactions({kind: 10 ** random.Random(k).uniform(-3, -1)}, k),  # type: ignore[misc]
        )
        for kind in KINDS
        if kind != "echoed"
    ]
    return [
        *of_a_kind,
        Campaign(
            f"{TRANSACTIONS} transactions over an adapter that echoes and loses: no wrong value",
            20,
            lambda k: _transactions({"echoed": 1.0, "lost": 0.02}, k),
        ),
        Campaign(
            f"{TRANSACTIONS} transactions while all of it happens at once: no wrong value",
            100,
            lambda k: _transactions(faults(random.Random(k)), k),
        ),
        Campaign(
            "the line to the host babbles, 1 to 60 bytes each 1 to 3 ms: every question ends within 1.5 s and says so",
            10,
            _babble,
        ),
    ]


def _transactions(kinds: dict[str, float], seed: int) -> bool:
    chance = random.Random(seed)
    line = FaultyLine(faults=kinds, seed=seed)
    bus = Bus(line, line, BusTiming(return_delay_s=0.0, latency_timer_s=chance.choice((1e-3, 16e-3))))
    return not transact(bus, line, chance, TRANSACTIONS, Counter())


def _babble(seed: int) -> bool:
    chance = random.Random(seed)
    size, period = chance.randrange(1, 60), chance.uniform(0.001, 0.003)
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    line, stop = SerialLine(os.ttyname(slave), 1_000_000), threading.Event()

    def talk() -> None:
        while not stop.is_set():
            try:
                os.write(master, os.urandom(size))
            except BlockingIOError:
                pass
            time.sleep(period)

    talker = threading.Thread(target=talk)
    talker.start()
    bus = Bus(line, RealClock(), BusTiming(return_delay_s=0.0, latency_timer_s=1e-3))
    longest, said = 0.0, False
    try:
        asks: list[Callable[[], object]] = [
            lambda: bus.broadcast_ping(),
            *[lambda: bus.sync_read(120, 27, IDS)] * 60,
            lambda: bus.read(10, 31, 1),
        ]
        for ask in asks:
            began = time.monotonic()
            try:
                ask()
            except NeverSilent:
                said = True
            except HardwareFault:
                pass
            longest = max(longest, time.monotonic() - began)
    finally:
        stop.set()
        talker.join()
        line.close()
        os.close(slave)
        os.close(master)
    return said and longest < 1.5
