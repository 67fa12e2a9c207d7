"""Hand-made servos behind a pseudo-terminal, each with a habit that real ones, or what lies between, have."""

from __future__ import annotations

import contextlib
import heapq
import os
import pty
import select
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from openant_tools.comms import protocol1
from openant_tools.comms import protocol2 as p2

XM430 = 1020
#: Another program that has the port open without a lock, and only reads: `python -c READER PATH`.
READER = """
import os, select, sys
fd = os.open(sys.argv[1], os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
print("reading", flush=True)
while True:
    select.select([fd], [], [], 1)
    try: os.read(fd, 4096)
    except BlockingIOError: pass
"""


@dataclass
class Talker:
    """Servos on one line.

    Attributes:
        echo: the host's own bytes come back first.
        slot_s: a broadcast ping is answered so much later for each id.
        shy: ids that do not answer when all are asked.
        old: ids that speak Protocol 1.0.
        latched: id → hardware errors; a reboot clears them, but for those of `coming_back`.
        noise: bytes that come among the answers to a broadcast ping.
        late_s: every answer comes so much later.
        memory: id → its control table; `written` what was written, in order.
    """

    ids: tuple[int, ...]
    path: str = ""
    echo: bool = False
    slot_s: float = 5e-4
    shy: tuple[int, ...] = ()
    old: tuple[int, ...] = ()
    coming_back: tuple[int, ...] = ()
    noise: bytes = b""
    late_s: float = 0.0
    memory: dict[int, bytearray] = field(default_factory=dict)
    written: list[tuple[int, int, bytes]] = field(default_factory=list)
    rebooted: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        for id in self.ids:
            table = self.memory[id] = bytearray(1024)
            table[0:2], table[6], table[7], table[8] = XM430.to_bytes(2, "little"), 46, id, 3
            table[11], table[13], table[31], table[68] = 3, 1 if id in self.old else 2, 80, 2
            table[32:34], table[34:36] = (160).to_bytes(2, "little"), (95).to_bytes(2, "little")
            table[36:38] = (885).to_bytes(2, "little")
            table[132:136], table[144], table[146] = (2048).to_bytes(4, "little"), 120, 30

    def run(self, master: int, stop: int) -> None:
        waiting: list[tuple[float, int, bytes]] = []
        parser, count = p2.Parser(), 0
        while True:
            wait = max(0.0, waiting[0][0] - time.monotonic()) if waiting else 1.0
            ready, _, _ = select.select([master, stop], [], [], wait)
            if stop in ready:
                return
            now = time.monotonic()
            while waiting and waiting[0][0] <= now:
                os.write(master, heapq.heappop(waiting)[2])
            if master not in ready:
                continue
            data = os.read(master, 4096)
            if self.echo:
                os.write(master, data)
            for after_s, answer in [*self._protocol_1(data), *self._protocol_2(parser.feed(data))]:
                count += 1
                heapq.heappush(waiting, (now + after_s + self.late_s, count, answer))

    def _protocol_2(self, items: Sequence[object]) -> Iterator[tuple[float, bytes]]:
        for asked in items:
            if isinstance(asked, p2.Instruction):
                for place, id in enumerate(self.ids):
                    if self.memory[id][13] == 2:
                        yield from self._answer(asked, id, place)

    def _answer(self, asked: p2.Instruction, id: int, place: int) -> Iterator[tuple[float, bytes]]:
        table, everyone, mine = self.memory[id], asked.id == p2.BROADCAST, asked.id == id
        alert = p2.ALERT_BIT if table[70] else 0
        params = asked.params
        address, count = (params[0] | params[1] << 8, params[2:]) if len(params) >= 2 else (0, b"")
        if asked.code == p2.Inst.PING and (mine or (everyone and id not in self.shy)):
            after = self.slot_s * id if everyone else 1e-3
            packet = p2.Status(id, alert, bytes(table[0:2] + table[6:7])).encode()
            yield after, (self.noise if everyone else b"") + packet
        elif asked.code == p2.Inst.READ and mine and table[68] > 0:
            size = count[0] | count[1] << 8
            yield 1e-3, p2.Status(id, alert, bytes(table[address : address + size])).encode()
        elif asked.code == p2.Inst.SYNC_READ and id in params[4:] and table[68] > 0:
            size = count[0] | count[1] << 8
            yield 1e-3 + place * 5e-4, p2.Status(id, alert, bytes(table[address : address + size])).encode()
        elif asked.code == p2.Inst.WRITE and (mine or everyone):
            self._write(id, address, bytes(count))
            if mine and table[68] > 1:
                yield 1e-3, p2.Status(id, alert).encode()
        elif asked.code == p2.Inst.REBOOT and mine:
            self.rebooted.append(id)
            table[64], table[68] = 0, 2
            table[70] = table[70] if id in self.coming_back else 0
            yield 1e-3, p2.Status(id).encode()

    def _protocol_1(self, data: bytes) -> Iterator[tuple[float, bytes]]:
        """An instruction of Protocol 1.0 has the form of a status whose error byte is the instruction."""
        for asked in protocol1.statuses(data):
            for id in self.ids:
                if self.memory[id][13] != 1 or asked.id not in (id, p2.BROADCAST):
                    continue
                if asked.error == 3:
                    self._write(id, asked.params[0], asked.params[1:])
                if asked.error in (1, 3):
                    yield 1e-3 + id * 1e-4, protocol1.Protocol1Status(id).encode()

    def _write(self, id: int, address: int, data: bytes) -> None:
        self.written.append((id, address, data))
        self.memory[id][address : address + len(data)] = data


@contextlib.contextmanager
def talking(folder: Path, *ids: int, **habits: object) -> Iterator[Talker]:
    """Servos behind a port of this process."""
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    talker = Talker(ids, os.ttyname(slave), **habits)  # type: ignore[arg-type]
    reader, writer = os.pipe()
    thread = threading.Thread(target=talker.run, args=(master, reader), daemon=True)
    thread.start()
    try:
        yield talker
    finally:
        os.write(writer, b"x")
        thread.join(5.0)
        for descriptor in (master, slave, reader, writer):
            os.close(descriptor)
