"""A million random and mutated streams into the packet parser: it never raises, hangs, or passes a wrong packet.

    python benchmarks/fuzz_packets.py [--streams 1000000] [--seed 0]

A packet counts as wrong when its bytes do not stand in the stream, or its CRC is not that of its bytes. What a CRC of
16 bits cannot see, nobody can: mutated packets that pass with a right CRC are counted as such.
"""

from __future__ import annotations

import argparse
import random
import time

from openant_tools.comms import protocol2 as p2

MARKS = (b"\xff", b"\xff\xff\xfd", b"\xff\xff\xfd\x00", b"\xfd", b"\x00", b"\x55")


def stream(chance: random.Random) -> tuple[bytes, set[bytes]]:
    """Bytes of up to four packets, mutated or not, or of pure noise; and the packets as they were sent."""
    if chance.random() < 0.2:
        return b"".join(chance.choice((*MARKS, chance.randbytes(3))) for _ in range(chance.randrange(40))), set()
    packets = []
    for _ in range(chance.randrange(1, 5)):
        params = b"".join(chance.choice((*MARKS, chance.randbytes(4))) for _ in range(chance.randrange(8)))
        if chance.random() < 0.5:
            packets.append(p2.Status(chance.randrange(253), chance.randrange(256), params).encode())
        else:
            packets.append(p2.Instruction(chance.choice((1, 41, 254)), chance.choice((1, 2, 3, 0x82)), params).encode())
    data = bytearray(b"".join(packets))
    for _ in range(chance.choice((0, 0, 1, 1, 2, 4))):
        at = chance.randrange(len(data))
        what = chance.random()
        if what < 0.5:
            data[at] ^= chance.randrange(1, 256)
        elif what < 0.75:
            del data[at : at + chance.randrange(1, 4)]
            if not data:
                break
        else:
            data[at:at] = chance.randbytes(chance.randrange(1, 4))
    return bytes(data), set(packets)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--streams", type=int, default=1_000_000)
    options.add_argument("--seed", type=int, default=0)
    chosen = options.parse_args()
    chance = random.Random(chosen.seed)
    parser = p2.Parser()
    good = unseen = 0
    start = time.perf_counter()
    for _ in range(chosen.streams):
        data, sent = stream(chance)
        cut = chance.randrange(len(data) + 1)
        found = parser.feed(data[:cut]) + parser.feed(data[cut:]) + parser.flush()
        assert parser.pending == 0
        pieces = []
        for item in found:
            if isinstance(item, p2.Garbage):
                pieces.append(item.data)
                continue
            raw = item.raw if isinstance(item, p2.JoinedStatus) else item.encode()
            assert p2.crc16(raw[:-2]) == raw[-2] | raw[-1] << 8
            pieces.append(raw)
            good += raw in sent
            unseen += raw not in sent
        assert b"".join(pieces) == data
    took = time.perf_counter() - start
    print(
        f"{chosen.streams} streams in {took:.0f} s: {good} packets as sent, {unseen} changed with a right CRC by chance"
    )


if __name__ == "__main__":
    main()
