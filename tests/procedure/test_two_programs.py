"""Two programs at one robot's folder, or at one training run: nothing is lost, and the second is told who was first."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from openant_tools.errors import BadInput
from openant_tools.procedure.finding import Finding, keep
from openant_tools.procedure.journal import EepromWrite, Journal
from openant_tools.robot.folder import RobotFolder, create_robot

PATIENCE_S = 60.0
ZERO = "motors.{}.zero_offset_rad"


def program(code: str, *arguments: object) -> subprocess.Popen[str]:
    """Another program, which has the folder class at hand as `RobotFolder` and its arguments in `sys.argv`."""
    return subprocess.Popen(
        [sys.executable, "-c", f"import sys\nfrom openant_tools.robot.folder import RobotFolder\n{code}", *map(str, arguments)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


@contextlib.contextmanager
def another_program_at(robot: RobotFolder) -> Iterator[subprocess.Popen[str]]:
    """One that works on the robot until it is told to end."""
    code = "with RobotFolder.at(sys.argv[1]).hold():\n    print('holds', flush=True)\n    sys.stdin.read()"
    with program(code, robot.path) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "holds\n"
        try:
            yield other
        finally:
            other.kill()


@pytest.fixture
def robot(tmp_path: Path) -> RobotFolder:
    return create_robot(tmp_path / "ant")


def test_changes_by_several_programs_are_all_kept(robot: RobotFolder) -> None:
    code = (
        "print('ready', flush=True); sys.stdin.readline()\n"
        "for k in range(8): RobotFolder.at(sys.argv[1]).update({sys.argv[2]: 0.5 + 0.01 * k})"
    )
    programs = [program(code, robot.path, ZERO.format(joint)) for joint in ("hip_rr", "knee_fl", "knee_rl")]
    for one in programs:
        assert one.stdout is not None
        assert one.stdout.readline() == "ready\n"
    for one in programs:  # from here on they change one file as fast as they can
        one.communicate("go\n", PATIENCE_S)
        assert one.returncode == 0
    motors = robot.config().motors
    assert [motors[joint].zero_offset_rad for joint in ("hip_rr", "knee_fl", "knee_rl")] == pytest.approx([0.57] * 3)
    assert len(list(robot.backups.iterdir())) == 24, "each change has kept what stood there before it"


def test_a_robot_that_another_program_works_on_is_read_only_and_says_who_holds_it(
    robot: RobotFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = robot.config_file.read_bytes()
    with another_program_at(robot) as other:
        assert robot.config().kit == "standard", "who only reads goes on"
        assert robot.holder is not None
        assert robot.holder.pid == other.pid
        names_it = rf"this robot is held by .*\(process {other.pid}\).* → wait for it, or stop it"
        with pytest.raises(BadInput, match=names_it), robot.hold():
            pass
        with pytest.raises(BadInput, match=names_it):
            robot.update({ZERO.format("hip_rr"): 0.5})
        with pytest.raises(BadInput, match=names_it):
            keep(Finding("estop", True, "it stops", (), "", "openant calib estop"), robot)
        refused = subprocess.run(
            [sys.executable, "-m", "openant_tools.cli", "calib", "connect", "--robot", str(robot.path), "--port", "/dev/none"],
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert refused.returncode == 2
        assert refused.stderr.count("\n") == 1
        assert f"(process {other.pid})" in refused.stderr
        assert robot.config_file.read_bytes() == before
        assert not list(robot.findings.iterdir())
        os.kill(other.pid, signal.SIGKILL)
        other.wait()
        robot.update({ZERO.format("hip_rr"): 0.5})  # a lock dies with its holder, however that ends
    assert robot.holder is None


def test_what_a_program_starts_works_on_the_robot_beside_it(robot: RobotFolder) -> None:
    code = f"with RobotFolder.at(sys.argv[1]).hold():\n    RobotFolder.at(sys.argv[1]).update({{{ZERO.format('hip_rr')!r}: 0.5}})"
    with robot.hold(), robot.hold():
        with program(code, robot.path) as child:
            child.communicate(timeout=PATIENCE_S)
        assert child.returncode == 0
        robot.update({ZERO.format("knee_rr"): 0.6})
    assert robot.config().motors["hip_rr"].zero_offset_rad == 0.5
    assert robot.config().motors["knee_rr"].zero_offset_rad == 0.6


def test_lines_of_the_journal_by_several_writers_stay_whole(robot: RobotFolder) -> None:
    write = EepromWrite("hip_rr", 10, "id", 1, 10)

    def add() -> None:
        for _ in range(20):
            Journal(robot.journal).append(write, "openant calib ids")

    threads = [threading.Thread(target=add) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [entry.write for entry in Journal(robot.journal).entries()] == [write] * 80


def test_of_trainers_that_start_together_one_trains(tmp_path: Path) -> None:
    runs = pytest.importorskip("openant_agents.runs")
    together = threading.Barrier(4)
    own, refused = list[tuple[int, Any]](), list[str]()

    def start() -> None:
        for k in range(20):
            together.wait()
            try:
                own.append((k, runs.TrainingRun(tmp_path / f"run{k}", {"agent": "sac"})))
            except BadInput as error:
                refused.append(str(error))

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(k for k, _ in own) == list(range(20))
    assert len(refused) == 60
    assert all("another process trains in this folder" in line for line in refused)
    for k, run in own:
        assert json.loads((tmp_path / f"run{k}" / "run.json").read_text())["agent"] == "sac"
        run.close()
