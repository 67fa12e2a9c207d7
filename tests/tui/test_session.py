"""What the screens share of a robot."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path

import pytest

from openant_tools.errors import BadInput
from openant_tools.robot.folder import create_robot
from openant_tools.tui.app import OpenAnt
from openant_tools.tui.session import Session


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
