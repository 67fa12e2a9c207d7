"""What the bus driver costs beside `dynamixel-sdk`: cycles of "write 8 goals, read 8 blocks of 27 bytes".

The other end has its answers computed beforehand, so that neither wire nor emulator is the limit; both clients get the
same bytes and take the same values out of them. It stands once in memory, in place of pyserial's port, where a cycle is
the client and nothing else, and once behind a pseudo-terminal in a process of its own, where most of a cycle is two hops
through the kernel.

    python benchmarks/bus_client.py [--seconds 3] [--lerobot PYTHON] [--json FILE]

LeRobot runs in an environment of its own; `benchmarks/lerobot_bus.py` says how to make it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import pty
import struct
import subprocess
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.clock import RealClock
from openant_tools.comms.line import Line, SerialLine
from openant_tools.comms.servos import BLOCK, BLOCK_ADDRESS, BLOCK_SIZE, Servo, Servos
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import kit

IDS = [joint.id for joint in JOINTS.values()]
GOALS = [2048 + k for k in range(8)]
BLOCKS = {id: BLOCK.pack(1000 + id, 0, 0, -5, 12, -3, 2048 + id, -3, 2048 + id, 120, 31) for id in IDS}
ROUNDS = 5


def replier(master: int) -> None:
    """Answer sync reads of the block, plain or fast; swallow everything else."""
    plain = p2.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, IDS).encode()
    fast = p2.fast_sync_read(BLOCK_ADDRESS, BLOCK_SIZE, IDS).encode()
    answers = {
        plain[-2:]: b"".join(p2.Status(id, 0, BLOCKS[id]).encode() for id in IDS),
        fast[-2:]: b"".join(p2.encode_joined([p2.JoinedAnswer(id, 0, BLOCKS[id]) for id in IDS])),
    }
    while data := os.read(master, 4096):
        answer = answers.get(data[-2:])
        if answer is not None and data.endswith((plain, fast)):
            os.write(master, answer)


def ours(path: str | None, fast: bool) -> Callable[[], list[int]]:
    line = MemoryPort() if path is None else SerialLine(path, 1_000_000)
    line.baud = 10**9  # no wire here, and none to wait for
    bus = Bus(line, MemoryClock() if path is None else RealClock(), BusTiming(write_read_gap_s=0.0))
    bus.guarded = True  # no servo is there
    servos = Servos(bus, [Servo(j.name, j.id, kit("standard").servo(j.kind)) for j in JOINTS.values()])
    bus.fast = set(IDS) if fast else set()

    def cycle() -> list[int]:
        servos.write_goals(GOALS)
        return [block.position for _, block in servos.read_blocks() if block is not None]

    return cycle


def theirs(path: str | None, fast: bool) -> Callable[[], list[int]]:
    import dynamixel_sdk as sdk

    port, packets = sdk.PortHandler(path or "memory"), sdk.PacketHandler(2.0)
    with mock.patch("serial.Serial", MemoryPort) if path is None else contextlib.nullcontext():
        port.openPort()
        port.setBaudRate(1_000_000)
    writer = sdk.GroupSyncWrite(port, packets, 116, 4)
    reader = sdk.GroupSyncRead(port, packets, BLOCK_ADDRESS, BLOCK_SIZE)
    for id in IDS:
        reader.addParam(id)

    def cycle() -> list[int]:
        for id, goal in zip(IDS, GOALS, strict=True):
            writer.addParam(id, struct.pack("<i", goal))
        writer.txPacket()
        writer.clearParam()
        assert (reader.fastSyncRead if fast else reader.txRxPacket)() == sdk.COMM_SUCCESS
        # The same eleven values of each block that our driver takes out.
        items = (
            (120, 2), (122, 1), (123, 1), (124, 2), (126, 2), (128, 4), (132, 4), (136, 4), (140, 4), (144, 2), (146, 1),
        )  # fmt: skip
        return [[reader.getData(id, address, size) for address, size in items][6] for id in IDS]

    return cycle


class MemoryPort:
    """A port whose answers are there as soon as they are asked for; both what pyserial's and what our own line is."""

    path, baud = "memory", 10**9

    def __init__(self, *_: object, **__: object) -> None:
        plain = p2.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, IDS).encode()
        fast = p2.fast_sync_read(BLOCK_ADDRESS, BLOCK_SIZE, IDS).encode()
        self._answers = {
            plain: b"".join(p2.Status(id, 0, BLOCKS[id]).encode() for id in IDS),
            fast: b"".join(p2.encode_joined([p2.JoinedAnswer(id, 0, BLOCKS[id]) for id in IDS])),
        }
        self._ready = b""
        self.baudrate, self.written, self.received = 1_000_000, 0, 0

    @property
    def in_waiting(self) -> int:
        return len(self._ready)

    def write(self, data: bytes) -> Any:
        self._ready = self._answers.get(bytes(data), self._ready)
        self.written += len(data)
        return len(data)

    def read(self, count: int = 4096) -> bytes:
        data, self._ready = self._ready[:count], self._ready[count:]
        self.received += len(data)
        return data

    def fileno(self) -> int:
        raise OSError("a port in memory")

    def flush(self) -> None: ...
    def reset_input_buffer(self) -> None: ...
    def set_baud(self, baud: int) -> None: ...
    def close(self) -> None: ...


class MemoryClock(RealClock):
    """Waits for a port in memory."""

    def wait_readable(self, line: Line, deadline: float) -> bool:
        return isinstance(line, MemoryPort) and line.in_waiting > 0


@contextlib.contextmanager
def answered() -> Iterator[str]:
    """A port behind which the replier sits."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    other = multiprocessing.get_context("fork").Process(target=replier, args=(master,), daemon=True)
    other.start()
    try:
        yield os.ttyname(slave)
    finally:
        other.terminate()
        os.close(master)
        os.close(slave)


def measure(
    make: Callable[[str | None, bool], Callable[[], list[int]]], fast: bool, seconds: float, memory: bool = False
) -> dict[str, float]:
    with contextlib.nullcontext() if memory else answered() as path:
        cycle = make(path, fast)
        assert cycle() == [2048 + id for id in IDS]
        best = {"cpu_us": float("inf"), "hz": 0.0}
        for _ in range(ROUNDS):
            cycles, cpu, start = 0, time.process_time(), time.perf_counter()
            while (took := time.perf_counter() - start) < seconds / ROUNDS:
                cycle()
                cycles += 1
            best["cpu_us"] = min(best["cpu_us"], (time.process_time() - cpu) / cycles * 1e6)
            best["hz"] = max(best["hz"], cycles / took)
        return best


def measure_lerobot(python: Path, seconds: float) -> dict[str, float]:
    with answered() as path:
        command = [str(python), str(Path(__file__).with_name("lerobot_bus.py"))]
        ran = subprocess.run(
            [*command, "--cycles-at", path, "--seconds", str(seconds)], stdout=subprocess.PIPE, text=True, check=True
        )
    best: dict[str, float] = json.loads(ran.stdout.splitlines()[-1])
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--lerobot", type=Path, help="the Python that has LeRobot")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = {}
    print("| answers | client | read | CPU µs a cycle | cycles/s |\n|---|---|---|---|---|")
    for place, memory in (("memory", True), ("terminal", False)):
        for name, make in (("dynamixel-sdk", theirs), ("openant", ours)):
            for read, fast in (("sync", False), ("fast sync", True)):
                rows[f"{name}, {read}, {place}"] = row = measure(make, fast, options.seconds, memory)
                print(f"| {place} | {name} | {read} | {row['cpu_us']:.0f} | {row['hz']:.0f} |", flush=True)
    peers = [("dynamixel-sdk", read, place) for place in ("memory", "terminal") for read in ("sync", "fast sync")]
    if options.lerobot:
        rows["LeRobot, sync, terminal"] = row = measure_lerobot(options.lerobot, options.seconds)
        print(f"| terminal | LeRobot | sync | {row['cpu_us']:.0f} | {row['hz']:.0f} |")
        peers.append(("LeRobot", "sync", "terminal"))
    print()
    for name, read, place in peers:
        peer, own = rows[f"{name}, {read}, {place}"], rows[f"openant, {read}, {place}"]
        ratios = f"CPU {own['cpu_us'] / peer['cpu_us']:.2f}, cycles {own['hz'] / peer['hz']:.1f} times"
        print(f"{read}, {place}: {ratios} {name}'s")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
