"""A million transactions over a line that is late, doubles, swaps, echoes, steals, breaks and loses: no wrong value.

    python benchmarks/fuzz_transactions.py [--transactions 1000000] [--seed 0]

Single questions (pings, reads, writes, refusals) and cyclic reads of blocks, mixed, at fault rates from 1 in 1000 to 1 in
10. A value is wrong when it is not what stands there; a write, when it is confirmed and was not done; a block, when it was
read before it was asked for and is taken as this cycle's.
"""

from __future__ import annotations

import argparse
import random
import struct
import sys
import time
from collections import Counter
from pathlib import Path

from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.faults import BrokenAnswer, NoAnswer, Refused

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from faulty_line import HOLE, IDS, WRITABLE, FaultyLine, register_bytes

KINDS = ("late", "doubled", "lost", "stolen", "flipped", "swapped", "noise", "echoed")
#: A tick is a millisecond, and the servo's clock drifts: what was read this long before counts as now, s.
TICK_GRAIN_S = 2.5e-3
LINES = 500


def faults(chance: random.Random) -> dict[str, float]:
    """Some kinds, at some rates."""
    kinds = chance.sample(KINDS, chance.randrange(1, len(KINDS) + 1))
    return {kind: 10 ** chance.uniform(-3, -1) for kind in kinds}


def transact(bus: Bus, line: FaultyLine, chance: random.Random, count: int, seen: Counter[str]) -> list[str]:
    """So many transactions; what was wrong of them."""
    wrong = []
    cycle = line.now()
    for _ in range(count):
        seen["transactions"] += 1
        what, id = chance.random(), chance.choice(IDS)
        try:
            if what < 0.35:
                cycle = max(cycle + 0.01, line.now())
                line.sleep_until(cycle)
                bus.fast = set(IDS) if chance.random() < 0.5 else set()
                asked = line.now()
                for answer in bus.sync_read(120, 27, IDS):
                    seen["rows"] += 1
                    if answer.ok:
                        seen["kept"] += 1
                        _, read_at = struct.unpack("<Hq", (answer.data or b"")[:10])
                        if read_at * 1e-6 < asked - TICK_GRAIN_S:
                            wrong.append(f"a block of {asked - read_at * 1e-6:.4f} s before")
            elif what < 0.65:
                address, size = chance.randrange(60), chance.choice((1, 2, 4))
                if bus.read(id, address, size) != register_bytes(id, address, size):
                    wrong.append(f"register {address} of {id}")
            elif what < 0.72:
                if bus.ping(id, insist=True) is None:
                    seen["no answer"] += 1
            elif what < 0.8:
                value = chance.randrange(256)
                bus.write(id, WRITABLE, bytes((value,)))
                if line.written_values.get(id) != value:
                    wrong.append("a write that was confirmed and not done")
                if bus.read(id, WRITABLE, 1)[0] != value:
                    wrong.append("what was written reads back otherwise")
            elif what < 0.85:
                bus.read(id, HOLE, 1)
                wrong.append("a hole that was read")
            else:
                address = chance.randrange(60)
                for answer in bus.sync_read(address, 2, IDS):
                    if answer.data is not None and answer.data != register_bytes(answer.id, address, 2):
                        wrong.append(f"register {address} of {answer.id}, read of all")
        except Refused:
            if what < 0.8 or what >= 0.85:
                wrong.append("a refusal of what can be done")
        except (NoAnswer, BrokenAnswer):
            seen["no answer"] += 1
        line.sleep_until(line.now() + chance.choice((0.0, 0.0, 1e-3, 5e-3)))
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--transactions", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    began, seen, wrong, seed = time.monotonic(), Counter[str](), list[str](), options.seed
    while seen["transactions"] < options.transactions:
        chance = random.Random(seed)
        line = FaultyLine(faults=faults(chance), seed=seed)
        bus = Bus(line, line, BusTiming(return_delay_s=0.0, latency_timer_s=chance.choice((1e-3, 16e-3))))
        found = transact(bus, line, chance, LINES, seen)
        if found:
            print(f"seed {seed}, {line.faults}: {Counter(found)}")
        wrong += found
        seed += 1
    print(
        f"{seen['transactions']} transactions on {seed - options.seed} lines in {time.monotonic() - began:.0f} s: "
        f"{len(wrong)} wrong values, {seen['no answer']} without an answer, {seen['kept'] / seen['rows']:.1%} of the blocks kept"
    )
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
