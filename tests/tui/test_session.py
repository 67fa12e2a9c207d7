"""What the screens share of a robot."""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from openant_tools.errors import BadInput, HardwareFault, OpenAntError
from openant_tools.lock import Claim
from openant_tools.procedure.step import Bench, Say, Step
from openant_tools.robot.folder import create_robot
from openant_tools.tui.app import OpenAnt
from openant_tools.tui.session import Session
from openant_tools.tui.step_run import StepRun
from openant_tools.virtual.process import virtual_robot


def test_nothing_begins_while_a_virtual_robot_is_being_started(tmp_path: Path) -> None:
    """What it is to be asked would go to the robot that is plugged in."""
    create_robot(tmp_path / "ant", "standard")
    session = Session(tmp_path / "ant")
    session.doing = "starting a virtual robot"
    with pytest.raises(BadInput, match="not yet: starting a virtual robot"):
        session.bench()
    session.doing = ""
    assert session.bench().folder.path == tmp_path / "ant"


def test_a_fault_of_the_program_ends_it_with_one_line_torque_off_and_the_traceback_in_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    create_robot(tmp_path / "ant", "standard")
    log = logging.FileHandler(tmp_path / "openant.log")
    app = OpenAnt(tmp_path / "ant", ticking=False)
    said, released = list[str](), list[str]()
    end = app.panic

    def panic(*words: object) -> None:
        said.extend(map(str, words))
        end(*words)

    def broken() -> None:
        raise ZeroDivisionError("by no joint at all")

    async def use() -> None:
        async with app.run_test() as pilot:
            app.call_later(broken)
            await pilot.pause()

    monkeypatch.setattr(app, "panic", panic)
    monkeypatch.setattr(app.session, "release", lambda: released.append("torque off") or 1)
    monkeypatch.setattr(logging.getLogger("openant_tools"), "level", logging.INFO)
    monkeypatch.setattr(logging.getLogger(), "handlers", [log])
    with pytest.raises(ZeroDivisionError):
        asyncio.run(use())
    log.close()
    assert released
    assert app.return_code == 1
    assert said == [
        "openant: a fault of the program, torque is off: ZeroDivisionError: by no joint at all → report it "
        f"(`openant support`); the log is {log.baseFilename}"
    ]
    assert "Traceback" in Path(log.baseFilename).read_text()


def filling(bench: Bench) -> Iterator[Say]:
    """A procedure that meets a full disk half way."""
    yield Say("it begins")
    with open("/dev/full", "w") as file:
        file.write("found")


def forbidden(bench: Bench) -> Iterator[Say]:
    """A procedure that meets a disk that is read only."""
    yield Say("it begins")
    raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(bench.folder.path / "findings"))


@pytest.mark.parametrize(
    ("procedure", "says"),
    [
        (
            "filling",
            "{ant}: No space left on device → make room there, or choose another place, and begin the step again",
        ),
        ("forbidden", "{ant}/findings: Read-only file system → choose a place that you may write to"),
    ],
)
def test_a_step_that_the_disk_ends_says_where_and_what_to_do(tmp_path: Path, procedure: str, says: str) -> None:
    folder = create_robot(tmp_path / "ant", "standard")
    ended = list[object]()
    step = Step("estop", "Stop key", "It stops.", f"{__name__}:{procedure}")
    run = StepRun(step, Bench(folder), lambda event: None, lambda finding, why: ended.extend((finding, why)))
    run.start()
    assert run.join(20.0)
    assert ended == [None, says.format(ant=folder.path)]


def test_a_robot_that_cannot_be_made_here_says_where_and_why(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OpenAntError, match=r"/file.*: Not a directory → a part of this path is a file: choose another"):
        Session(tmp_path).create(tmp_path / "file" / "ant", "standard")


def test_a_robot_that_another_program_holds_can_be_read_here_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENANT_HELD_BY", raising=False)  # of who holds it with us
    folder = create_robot(tmp_path / "ant", "standard")
    other = Claim(folder.path / ".robot.lock", "held by {}", remedy="")
    [said] = Session(folder.path).notices
    other.release()
    assert said.endswith(": here you can read its findings and recordings, but neither watch, move nor change it")


def test_a_virtual_robot_that_was_started_anew_is_found_by_the_same_ready_file(tmp_path: Path) -> None:
    ready, scenario = tmp_path / "ready.json", tmp_path / "blind.toml"
    gone = {"bus": "/dev/pts/gone", "imu": None, "camera": None, "control": str(tmp_path / "gone.sock")}
    ready.write_text(json.dumps(gone))
    scenario.write_text("[camera]\npresent = false\n")
    session = Session(tmp_path)
    session.start_virtual(str(ready))
    with pytest.raises(HardwareFault, match="no virtual robot listens here"):
        session.connect()
    ready.unlink()  # between the two there may be none
    with pytest.raises(HardwareFault, match="no virtual robot listens here"):
        session.connect()
    with virtual_robot(str(scenario), clock="stepped") as robot:
        ready.write_text(json.dumps(dict(robot)))
        session.connect()
        assert session.watching
        assert session.virtual == robot
        session.close()
