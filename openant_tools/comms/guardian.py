"""Releases the servos when the engine dies: it knows an open port, a packet, and a pipe that ends with the engine.

Started by the engine as `python -I -S guardian.py FD PACKET_HEX`, in a session of its own. The engine says `bye` before
it ends in good order; a pipe that ends without it means that the engine was killed with torque perhaps on.
"""

from __future__ import annotations

import os
import sys
import time

#: A packet may hit the rest of one that the engine had half sent, or an answer: servos drop those within this time.
REPEATS = 5
PAUSE_S = 0.01


def main() -> None:
    port, packet = int(sys.argv[1]), bytes.fromhex(sys.argv[2])
    last_words = b""
    while data := os.read(0, 64):
        last_words = data
    if last_words.endswith(b"bye"):
        return
    for _ in range(REPEATS):
        time.sleep(PAUSE_S)
        try:
            os.write(port, packet)
        except OSError:
            pass  # full or gone: the next try, or the servos' own watchdog


if __name__ == "__main__":
    main()
