"""Releases the servos when the engine dies: it knows an open port, a packet, and a pipe that ends with the engine.

Started by the engine as `python -I -S guardian.py FD PACKET_HEX PATIENCE_S`, in a session of its own, where no terminal's
keys reach it. The engine says `bye` before it ends in good order; a pipe that ends without it means that the engine was
killed with torque perhaps on. While torque is on the engine says `+` again and again, and `-` once it is off: after
PATIENCE_S of silence (0: never) it is taken for suspended, and torque goes off as well.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time

#: A packet may hit the rest of one that the engine had half sent, or an answer: servos drop those within this time.
REPEATS = 5
PAUSE_S = 0.01


def main() -> None:
    port, packet, patience = int(sys.argv[1]), bytes.fromhex(sys.argv[2]), float(sys.argv[3])
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    words = b""
    while True:
        holding = patience > 0 and words.endswith(b"+")
        if holding and not select.select([0], [], [], patience)[0]:
            release(port, packet)
            words = b""
            continue
        data = os.read(0, 64)
        if not data:
            break
        words = (words + data)[-3:]
    if not words.endswith(b"bye"):
        release(port, packet)


def release(port: int, packet: bytes) -> None:
    for _ in range(REPEATS):
        time.sleep(PAUSE_S)
        try:
            os.write(port, packet)
        except OSError:
            pass  # full or gone: the next try, or the servos' own watchdog


if __name__ == "__main__":
    main()
