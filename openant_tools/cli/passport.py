"""`openant passport`: one page with everything known about a robot."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import robot_folder, robot_option

__all__ = ["passport"]


@click.command()
@robot_option
def passport(robot: Path | None) -> None:
    """Write passport.html and passport.md into the robot's folder: what is known, how, since when."""
    from openant_tools.bringup.passport import write_passport
    from openant_tools.robot.folder import RobotFolder

    for path in write_passport(RobotFolder.at(robot_folder(robot))):
        mention(f"wrote {path}")
