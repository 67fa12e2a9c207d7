"""Random and mutated byte streams into the MSP parser: does it ever raise, hang, or pass a wrong reading as good?

A stream is either noise (with `$`, `M`, `X` … made frequent) or the reply to one request, mutated: one byte replaced, a
burst of up to 8 bits, bytes lost or inserted, cut off, or several of these. A reading counts as good where the driver
would take it: the checksum holds, the payload has the length of its message, and nothing is left over (`MspParser.clean`).

What must be 0 here: one replaced byte, a burst of up to 8 bits (v2), lost and inserted bytes, a lost tail. Several
faults at once pass an 8-bit checksum once in 256 times where the length stays right, which no host can see; how often
that was is printed.

    python benchmarks/msp_fuzz.py [--streams 1000000] [--seed 1]
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import Counter

from openant_tools.comms import msp
from openant_tools.comms.msp import Command, Direction, Framing, MspFrame, MspParser

READINGS = [msp.RawImu((i, -i, 2048), (i * 3, 7, -i), (0, 0, 0)) for i in range(1, 40)]
ANGLES = [msp.Attitude(i, -i, i * 9 % 360) for i in range(1, 40)]
TRUE = {m.encode() for m in READINGS} | {m.encode() for m in ANGLES}
SPICE = b"$$$MMXX>><!\x12\x06\x66\x6c\xff\xe6\x00"
PROMISED = ("whole", "noise", "one byte", "burst", "lost", "inserted", "cut off")


def reply(rng: random.Random, framing: Framing) -> bytearray:
    """A reply as the driver polls for."""
    raw, angles = rng.choice(READINGS).encode(), rng.choice(ANGLES).encode()
    command, payload = rng.choice(
        [
            (Command.RAW_IMU, raw),
            (Command.ATTITUDE, angles),
            (Command.MULTIPLE_MSP, msp.encode_multiple([raw, angles])),
        ]
    )
    return bytearray(msp.encode(MspFrame(Direction.REPLY, command, payload, framing)))


def mutate(rng: random.Random, data: bytearray, how: str) -> None:
    """Break a stream in place."""
    at = rng.randrange(len(data))
    if how == "one byte":
        data[at] ^= rng.randint(1, 255)
    elif how == "burst":
        bits = rng.randint(1, 255) << rng.randint(0, 7)
        start = min(at, len(data) - 2)
        data[start] ^= bits >> 8  # the CRC reads each byte from its highest bit
        data[start + 1] ^= bits & 0xFF
    elif how == "lost":
        del data[at : at + rng.randint(1, 4)]
    elif how == "inserted":
        data[at:at] = rng.randbytes(rng.randint(1, 4))
    elif how == "cut off":
        del data[at:]
    else:
        for _ in range(rng.randint(2, 6)):
            if data:
                mutate(
                    rng, data, rng.choice(["one byte", "burst", "lost", "inserted"]) if len(data) > 1 else "one byte"
                )


def good_payloads(frames: list[MspFrame]) -> list[bytes]:
    """What the driver would take for readings."""
    out = []
    for frame in frames:
        if frame.direction is not Direction.REPLY:
            continue
        try:
            if frame.command == Command.MULTIPLE_MSP:
                raw, angles = msp.decode_multiple([Command.RAW_IMU, Command.ATTITUDE], frame.payload)
                msp.RawImu.decode(raw), msp.Attitude.decode(angles)
                out += [raw, angles]
            elif frame.command == Command.RAW_IMU:
                msp.RawImu.decode(frame.payload)
                out.append(frame.payload)
            elif frame.command == Command.ATTITUDE:
                msp.Attitude.decode(frame.payload)
                out.append(frame.payload)
        except msp.MspError:
            pass
    return out


def main() -> int:
    """Run; exit code 1 where a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--streams", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    rng = random.Random(args.seed)
    streams, good, wrong = Counter[str](), Counter[str](), Counter[str]()
    began, slowest = time.perf_counter(), 0.0
    for _ in range(args.streams):
        framing = rng.choice([Framing.V1, Framing.V2, Framing.V2, Framing.V2_OVER_V1])
        how = rng.choice(["whole", "noise", "one byte", "burst", "lost", "inserted", "cut off", "several"])
        if how == "noise":
            data = bytearray(rng.choice(SPICE) if rng.random() < 0.5 else rng.randrange(256) for _ in range(60))
        else:
            data = reply(rng, framing)
            # XOR sees no burst that flips one bit position in two neighbouring bytes.
            if how == "burst" and framing is Framing.V1:
                how = "one byte"
            if how != "whole":
                mutate(rng, data, how)
        machine = MspParser()
        one = time.perf_counter()
        at = rng.randrange(len(data) + 1)
        frames = machine.feed(data[:at]) + machine.feed(data[at:])
        found = good_payloads(frames) if machine.clean else []
        slowest = max(slowest, time.perf_counter() - one)
        streams[how] += 1
        good[how] += len(found)
        wrong[how] += sum(payload not in TRUE for payload in found)
    seconds = time.perf_counter() - began
    print("| stream | streams | good readings | wrong ones among them |\n|---|---|---|---|")
    for how in sorted(streams):
        print(f"| {how} | {streams[how]} | {good[how]} | {wrong[how]} |")
    print(f"\n{args.streams} streams in {seconds:.0f} s, none raised; the slowest took {1e3 * slowest:.1f} ms")
    return int(any(wrong[how] for how in PROMISED))


if __name__ == "__main__":
    sys.exit(main())
