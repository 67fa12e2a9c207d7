"""Attacks on what is kept and read: the rows of docs/reliability.md about files."""

from __future__ import annotations

import functools
import itertools
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from campaign import Campaign
from fuzz_readers import fuzz

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from readers import READERS

from openant_tools.robot.folder import RobotFolder, create_robot

__all__ = ["campaigns"]

#: mutations of a try
EACH = 100


def campaigns() -> list[Campaign]:
    """Each kind of bad file, two programs at one robot, and a holder that is killed."""
    files = [
        Campaign(
            f"{kind}: {EACH} mutations are read, or refused in one line",
            2,
            functools.partial(_refused, kind),
        )
        for kind in READERS
    ]
    return [
        *files,
        Campaign("two programs change one robot.toml at once: every change is kept", 2, _concurrent_updates),
        Campaign("who holds a robot is killed (SIGKILL): the next one has it at once", 3, _holder_killed),
    ]


def _refused(kind: str, k: int) -> bool:
    return not fuzz(kind, k, EACH)


def _program(code: str, *arguments: object) -> subprocess.Popen[str]:
    start = "import sys\nfrom openant_tools.robot.folder import RobotFolder\nrobot = RobotFolder.at(sys.argv[1])\n"
    return subprocess.Popen(
        [sys.executable, "-c", start + code, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _concurrent_updates(k: int) -> bool:
    joints, count = ("hip_rr", "knee_fl"), 10
    with tempfile.TemporaryDirectory() as name:
        robot = create_robot(Path(name) / "ant")
        code = f"for n in range({count}): robot.update({{f'motors.{{sys.argv[2]}}.zero_offset_rad': 0.5 + 0.01 * n}})"
        programs = [_program(code, robot.path, joint) for joint in joints]
        done = [program.wait(120) == 0 for program in programs]
        last = [robot.config().motors[joint].zero_offset_rad for joint in joints]
        kept = len(list(robot.backups.iterdir())) == count * len(joints)
        return all(done) and kept and all(abs(zero - (0.5 + 0.01 * (count - 1))) < 1e-9 for zero in last)


def _holder_killed(k: int) -> bool:
    with tempfile.TemporaryDirectory() as name:
        robot = create_robot(Path(name) / "ant")
        with _program("with robot.hold():\n    print('holds', flush=True)\n    sys.stdin.read()", robot.path) as other:
            assert other.stdout is not None
            other.stdout.readline()
            named = robot.holder is not None and robot.holder.pid == other.pid
            os.kill(other.pid, signal.SIGKILL)
            other.wait()
        with RobotFolder.at(robot.path).hold():
            return named


if __name__ == "__main__":
    for campaign in campaigns():
        survived = sum(campaign.run(k) for k in itertools.islice(itertools.count(), campaign.tries))
        print(f"| {campaign.attack} | {campaign.tries} | {survived} |", flush=True)
