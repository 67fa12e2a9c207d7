"""Who runs first: a loop does where the system lets it, what it starts and what comes after does not."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from openant_tools.scheduling import LOOP, NICE, gives_way, in_time

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such priorities")

POLICY = "import os; print(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)"


def policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


def may_be_first() -> bool:
    """Whether the system lets this user have real-time priority; asked in a process that ends with it."""
    ask = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({LOOP}))"
    return not subprocess.run([sys.executable, "-c", ask], capture_output=True, check=False).returncode


def test_a_loop_runs_first_and_nothing_else_does() -> None:
    before = policy()
    with in_time(LOOP):
        now = policy()
        started = subprocess.run([sys.executable, "-c", POLICY], capture_output=True, text=True, check=True).stdout
    assert now == (os.SCHED_FIFO if may_be_first() else before)
    assert int(started) == before == policy()


def test_a_thread_gives_way_alone() -> None:
    niceness = []

    def compute() -> None:
        gives_way()
        niceness.append(os.getpriority(os.PRIO_PROCESS, 0))

    before = os.getpriority(os.PRIO_PROCESS, 0)
    thread = threading.Thread(target=compute)
    thread.start()
    thread.join()
    assert niceness == [min(before + NICE, 19)]
    assert os.getpriority(os.PRIO_PROCESS, 0) == before
