"""The stop key of a face: torque off at everything that this process has open, whoever in it is moving the robot."""

from __future__ import annotations

import time

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.errors import HardwareFault

__all__ = ["release_all"]

#: A packet may hit one that another thread has half sent, or an answer; servos drop those within the pause (guardian).
REPEATS = 5
PAUSE_S = 0.01


def release_all() -> int:
    """Switch torque off through every engine and every open bus of this process, from any thread, waiting for nobody.

    Whoever waits for a motion of an engine is told. Who drives a bus of its own must be ended besides: it does not know.

    Returns:
        How many were told.
    """
    told = 0
    for engine in list(EngineProcess.running):
        try:
            engine.let_go()
            told += 1
        except HardwareFault:
            pass  # it has died, and its guardian has done it
    buses = list(Bus.opened.values())
    packet = p2.write(p2.BROADCAST, 64, b"\0").encode()
    for _ in range(REPEATS if buses else 0):
        for bus in buses:
            try:
                bus.line.write(packet)
            except (OSError, HardwareFault):
                pass  # the port is gone
        time.sleep(PAUSE_S)
    return told + len(buses)
