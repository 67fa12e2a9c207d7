"""What the bus driver costs beside `dynamixel-sdk`: cycles of "write 8 goals, read 8 blocks of 27 bytes".

The other end is a replier with answers computed beforehand, on a pseudo-terminal, in a process of its own, so that
neither wire nor emulator is the limit. Both clients get the same bytes and take the same values out of them.

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

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus, Timing
from openant_tools.comms.clock import RealClock
from openant_tools.comms.line import SerialLine
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


def ours(path: str, fast: bool) -> Callable[[], list[int]]:
    line = SerialLine(path, 1_000_000)
    line.baud = 10**9  # no wire here, and none to wait for
    bus = Bus(line, RealClock(), Timing(write_read_gap_s=0.0))
    servos = Servos(bus, [Servo(j.name, j.id, kit("standard").servo(j.kind)) for j in JOINTS.values()])
    bus.fast = set(IDS) if fast else set()

    def cycle() -> list[int]:
        servos.write_goals(GOALS)
        return [block.position for _, block in servos.read_blocks() if block is not None]

    return cycle


def theirs(path: str, fast: bool) -> Callable[[], list[int]]:
    import dynamixel_sdk as sdk

    port, packets = sdk.PortHandler(path), sdk.PacketHandler(2.0)
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
            (120, 2),
            (122, 1),
            (123, 1),
            (124, 2),
            (126, 2),
            (128, 4),
            (132, 4),
            (136, 4),
            (140, 4),
            (144, 2),
            (146, 1),
        )
        return [[reader.getData(id, address, size) for address, size in items][6] for id in IDS]

    return cycle


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


def measure(make: Callable[[str, bool], Callable[[], list[int]]], fast: bool, seconds: float) -> dict[str, float]:
    with answered() as path:
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
    print("| client | read | CPU µs a cycle | cycles/s |\n|---|---|---|---|")
    for name, make in (("dynamixel-sdk", theirs), ("openant", ours)):
        for read, fast in (("sync", False), ("fast sync", True)):
            rows[f"{name}, {read}"] = row = measure(make, fast, options.seconds)
            print(f"| {name} | {read} | {row['cpu_us']:.0f} | {row['hz']:.0f} |")
    if options.lerobot:
        rows["LeRobot, sync"] = row = measure_lerobot(options.lerobot, options.seconds)
        print(f"| LeRobot | sync | {row['cpu_us']:.0f} | {row['hz']:.0f} |")
        own = rows["openant, sync"]
        print(f"\nsync: CPU {own['cpu_us'] / row['cpu_us']:.2f} of LeRobot's, {own['hz'] / row['hz']:.1f}× its cycles")
    for read in ("sync", "fast sync"):
        sdk, own = rows[f"dynamixel-sdk, {read}"], rows[f"openant, {read}"]
        print(f"{read}: CPU {own['cpu_us'] / sdk['cpu_us']:.2f} of the SDK's, {own['hz'] / sdk['hz']:.1f}× its cycles")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
