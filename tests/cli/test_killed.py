"""Work that was killed leaves no processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")

#: s, of a computer that has much else to do
PATIENCE_S = 90.0
#: s in which all that was started has gone
GONE_S = 5.0


def descendants(pid: int) -> set[int]:
    """Every process below `pid`, zombies left out."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, parent = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
            except OSError:
                continue
            if state != "Z":
                parents[int(entry.name)] = int(parent)
    below = {pid}
    while more := {child for child, parent in parents.items() if parent in below} - below:
        below |= more
    return below - {pid}


def alive(pids: set[int]) -> set[int]:
    """Those that are there and no zombies."""
    found = set()
    for pid in pids:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
                found.add(pid)
        except OSError:
            pass
    return found


def until(what: Callable[[], object], seconds: float) -> bool:
    give_up = time.monotonic() + seconds
    while time.monotonic() < give_up:
        if what():
            return True
        time.sleep(0.05)
    return bool(what())


def killed(command: list[str], tmp_path: Path, count: int) -> set[int]:
    """Kill a command once it has so many processes below it; which of those are left a moment later."""
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=tmp_path)
    try:
        there = until(lambda: process.poll() is not None or len(descendants(process.pid)) >= count, PATIENCE_S)
        assert there, (tmp_path / "log").read_text()
        assert process.poll() is None, (tmp_path / "log").read_text()
        time.sleep(1.0)  # so that each has begun
        below = descendants(process.pid)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    until(lambda: not alive(below), GONE_S)
    left = alive(below)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return left


def script(code: str) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(code)]


def test_workers_of_a_killed_command_end(tmp_path: Path) -> None:
    work = """
        import time
        from joblib import Parallel, delayed
        from openant_tools.workers import tied
        list(Parallel(n_jobs=2, return_as="generator_unordered")(delayed(tied(time.sleep))(60) for _ in range(2)))
    """
    assert not killed(script(work), tmp_path, 2)


def test_a_command_that_a_killed_program_had_started_ends(tmp_path: Path) -> None:
    program = """
        import time
        from pathlib import Path
        from openant_tools.tui.process import Process
        Process(("virtual", "start", "--no-camera"), Path("said")).start()
        time.sleep(60)
    """
    assert not killed(script(program), tmp_path, 1)


def test_a_virtual_robot_and_the_engine_of_a_killed_command_end(tmp_path: Path) -> None:
    record = [sys.executable, "-m", "openant_tools.cli", "sysid", "record", "--virtual", "--protocol", "stand", "--yes"]
    scenario = tmp_path / "ant.toml"
    scenario.write_text('[clock]\nmode = "real"\n')
    record[record.index("--virtual")] = f"--virtual={scenario}"
    assert not killed([*record, "--seconds", "60", "--out", str(tmp_path / "run.mcap")], tmp_path, 3)
