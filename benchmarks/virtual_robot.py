"""How fast the virtual robot computes: times real time for each setup, and instructions a second.

    python benchmarks/virtual_robot.py

Times are of the processor, so that other work on the machine counts little.
"""

from __future__ import annotations

import time
from typing import Any

from openant_tools.comms import protocol2 as p2
from openant_tools.virtual.scenario import parse_scenario
from openant_tools.virtual.start import build
from openant_tools.virtual.world import World

IDS = [10, 11, 20, 21, 30, 31, 40, 41]
BAUD = 1_000_000
SETUPS: dict[str, dict[str, Any]] = {
    "stand": {},
    "floor": {"robot": {"setup": "floor", "pose": "home"}},
    "stand, play in every gear": {"effect": [{"effect": "backlash", "joints": "all", "parameters": {"gap_rad": 0.01}}]},
    "stand, load and Stribeck friction": {
        "effect": [
            {"effect": "load_friction", "joints": "all", "parameters": {"coefficient": 0.1}},
            {
                "effect": "stribeck_friction",
                "joints": "all",
                "parameters": {"coulomb_nm": 0.05, "static_nm": 0.1, "velocity_rad_s": 0.1},
            },
        ]
    },
    "stand, dozing while it stands still": {"clock": {"doze": True}},
}


def started(table: dict[str, Any]) -> World:
    """A world whose legs hold a pose."""
    world = build(parse_scenario(table))
    world.line.transact(p2.sync_write(64, 1, dict.fromkeys(IDS, b"\1")), 0.0)
    goals = {id: (1700 if id % 10 else 2048).to_bytes(4, "little") for id in IDS}
    world.line.transact(p2.sync_write(116, 4, goals), 0.01)
    world.advance(1.0)
    return world


def main() -> None:
    print(f"{'setup':40} {'× real time':>12}")
    for name, table in SETUPS.items():
        world, seconds = started(table), 20.0
        begin = time.process_time()
        world.advance(world.now + seconds)
        print(f"{name:40} {seconds / (time.process_time() - begin):12.0f}")
    print(f"\n{'sync reads of 27 bytes from 8 servos':40} {'a second':>12}")
    read = p2.sync_read(120, 27, IDS)
    data = read.encode()
    for how in ("with bytes", "without bytes"):
        world, count = started({}), 500
        begin = time.process_time()
        for _ in range(count):
            # The physics between two reads is not what is measured here: time hardly moves.
            if how == "with bytes":
                world.line.receive(data, world.line.free_at, BAUD)
            else:
                world.line.transact(read, world.line.free_at)
        physics = world.now - 1.0
        spent = time.process_time() - begin
        begin = time.process_time()
        world.advance(world.now + physics)
        print(f"{how:40} {count / (spent - (time.process_time() - begin)):12.0f}")


if __name__ == "__main__":
    main()
