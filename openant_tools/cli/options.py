"""Options that several commands share, spelled once."""

from __future__ import annotations

import os
from pathlib import Path

import click

from openant_tools.errors import BadInput

__all__ = ["json_option", "out_option", "report_option", "robot_folder", "robot_option"]

robot_option = click.option(
    "--robot",
    type=click.Path(path_type=Path),
    default=None,
    metavar="DIR",
    help="The robot's folder (or its robot.toml). Default: $OPENANT_ROBOT, else the working directory.",
)
json_option = click.option(
    "--json",
    "json_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the result as JSON.",
)
report_option = click.option(
    "--report",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write a report that opens offline.",
)
out_option = click.option("--out", type=click.Path(path_type=Path), required=True, metavar="PATH", help="What to make.")


def robot_folder(robot: Path | None, *, must_exist: bool = True) -> Path:
    """The robot's folder named by `--robot`, `$OPENANT_ROBOT` or the working directory (formats, section 4)."""
    path = robot or Path(os.environ.get("OPENANT_ROBOT", "."))
    folder = path.parent if path.name.endswith(".toml") else path
    if must_exist and not (folder / "robot.toml").is_file():
        raise BadInput(
            "there is no robot.toml here",
            where=folder,
            remedy="name one with --robot DIR, or make one with `openant config import antNN.json --robot DIR`",
        )
    return folder
