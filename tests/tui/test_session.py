"""What the screens share of a robot."""

from __future__ import annotations

from pathlib import Path

import pytest

from openant_tools.errors import BadInput
from openant_tools.robot.folder import create_robot
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
