"""How near to the limit of the wire the driver and the virtual robot come together, with wire time on.

A cycle is "write 8 goals, read 8 blocks of 27 bytes", as fast as it goes, in real time through a pseudo-terminal. The
limit is what these bytes take on the wire (facts: goals 54, request 22, answers 8 · 38 or joined 256 bytes, ten bits
each); neither latency timer nor write-to-read gap are on, since they would only make it easier to reach. Whatever else
this machine does lands in the mean; the median cycle and the fastest tenth tell what the two programs themselves cost.

    python benchmarks/bus_rate.py [--seconds 3] [--rounds 4] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import statistics
import time
from dataclasses import replace
from pathlib import Path

from openant_tools.comms.bench import bus_limit_hz
from openant_tools.comms.servos import Servo, Servos
from openant_tools.comms.setup import open_bus
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import kit
from openant_tools.virtual.scenario import parse_scenario
from openant_tools.virtual.start import assemble

BAUDS = (1_000_000, 4_000_000)
GOALS = [2048] * 8


def one(baud: int, *, fast: bool, seconds: float) -> dict[str, float]:
    """Cycles for a while against a virtual robot in a process of its own."""
    scenario = parse_scenario({"bus": {"baud": baud, "latency_timer_ms": 0, "write_read_gap_s": 0}})
    server = assemble(scenario, camera=False)
    child = os.fork()
    if child == 0:
        ended: list[int] = []
        signal.signal(signal.SIGTERM, lambda number, frame: ended.append(number))
        server.run(until=lambda: bool(ended))
        os._exit(0)
    try:
        bus = open_bus(str(server.addresses["bus"]), baud)
        bus.guarded = True  # these servos end with this program
        bus.timing = replace(bus.timing, return_delay_s=0.0, latency_timer_s=1e-3, write_read_gap_s=0.0)
        servos = Servos(bus, [Servo(j.name, j.id, kit("standard").servo(j.kind)) for j in JOINTS.values()])
        bus.fast = set(servos.ids) if fast else set()
        took, lost, cpu = list[float](), 0, time.process_time()
        begin = last = time.perf_counter()
        while last - begin < seconds:
            servos.write_goals(GOALS)
            missing = sum(block is None for _, block in servos.read_blocks())
            lost += missing
            if missing and fast:
                bus.fast = set(servos.ids)
            now = time.perf_counter()
            took.append(now - last)
            last = now
        cpu = time.process_time() - cpu
        bus.close()
    finally:
        os.kill(child, signal.SIGTERM)
        os.waitpid(child, 0)
        server.close()
    took.sort()
    limit = bus_limit_hz(baud, len(GOALS), fast=fast, gap_s=0.0)
    return {
        "limit_hz": limit, "hz": len(took) / (last - begin), "median_hz": 1 / statistics.median(took),
        "best_hz": 1 / took[len(took) // 10], "lost": lost / len(took) / len(GOALS), "client_us": cpu / len(took) * 1e6,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = []
    load = os.getloadavg()[0]
    print("| baud | read | limit Hz | mean | median cycle | fastest tenth | lost | client CPU µs | server CPU µs |")
    print("|---|---|---|---|---|---|---|---|---|")
    for baud in BAUDS:
        # Paired: the two reads take turns, so that what else runs here meets both alike.
        results: dict[bool, list[dict[str, float]]] = {False: [], True: []}
        server = dict.fromkeys((False, True), 0.0)
        for _ in range(options.rounds):
            for fast in (False, True):
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                results[fast].append(row := one(baud, fast=fast, seconds=options.seconds))
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
                server[fast] += spent / (row["hz"] * options.seconds) * 1e6 / options.rounds
        for fast, runs in results.items():
            row = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
            row |= {"baud": baud, "fast": fast, "server_us": server[fast]}
            rows.append(row)
            shares = " | ".join(f"{row[key] / row['limit_hz']:.0%}" for key in ("hz", "median_hz", "best_hz"))
            print(
                f"| {baud} | {'fast sync' if fast else 'sync'} | {row['limit_hz']:.0f} | {shares} | {row['lost']:.2%} | "
                f"{row['client_us']:.0f} | {row['server_us']:.0f} |",
                flush=True,
            )
    print(f"load {load:.1f} before, {os.getloadavg()[0]:.1f} after, on {os.cpu_count()} cores")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
