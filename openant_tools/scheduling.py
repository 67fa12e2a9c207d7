"""Who has a processor first: loops that have deadlines, before whatever else this computer does.

A loop at 100 Hz sleeps most of its time, but each time it wakes it competes with all that computes. Where the system lets this user have
real-time priority (root, or `rtprio` in limits.conf(5)), it does not: it runs as soon as it is ready (sched(7), SCHED_FIFO).
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

__all__ = ["ACTS", "LOOP", "ROBOT", "gives_way", "in_time"]

#: SCHED_FIFO priorities: of who chooses actions, of the loop that sends them, and of a virtual robot, which in reality nobody waits for
ACTS, LOOP, ROBOT = 5, 10, 20
#: niceness that a thread adds which only computes
NICE = 5


@contextlib.contextmanager
def in_time(priority: int) -> Iterator[None]:
    """Have this thread, but none that it starts, run as soon as it is ready, where the system allows that.

    It must sleep between its deadlines: nothing of lower priority runs meanwhile.
    """
    try:
        policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (AttributeError, OSError):  # not Linux, or not allowed
        yield
        return
    try:
        yield
    finally:
        # Who is no root may not take the flag back.
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, param)


def gives_way() -> None:
    """Have this thread, and those that it starts, come after loops; on Linux, where each thread has a niceness of its own."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + NICE)
