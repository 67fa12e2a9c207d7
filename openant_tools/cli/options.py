"""Options that several commands share, spelled once."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.log import mention
from openant_tools.errors import BadInput
from openant_tools.numbers import exact

if TYPE_CHECKING:
    from openant_tools.report import Report

__all__ = [
    "MINUTES", "POSITIVE", "SECONDS", "Number", "driver_option", "joint_option", "json_option", "model_option", "out_option", "rate_option", "report_option", "robot_folder",
    "robot_option", "seconds_option", "tie_option", "write_report",
]  # fmt: skip


#: beyond it nothing of a robot is measured, counted or waited for: 1e300 is a slip of the hand
LARGEST = 1e9


class Number(click.FloatRange):
    """A number on the command line, the type of every option that takes one: finite, and within a range where it has one.

    What click takes for a number need not be one: nan is within every range.
    """

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        given: float = click.FLOAT.convert(value, param, ctx)
        if not abs(given) <= LARGEST:
            option = param.opts[0] if param is not None else "it"
            raise BadInput(f"{option} is {exact(given)}", remedy="give it a number")
        return float(super().convert(given, param, ctx))


#: a length, a mass, a voltage
POSITIVE = Number(0.0, min_open=True)
#: s that a command moves, measures or plays, a day at most; and the same of a soak, min, a week at most
SECONDS = Number(0.0, 86_400.0, min_open=True)
MINUTES = Number(0.02, 7 * 24 * 60.0)


robot_option = click.option(
    "--robot",
    type=click.Path(path_type=Path),
    default=None,
    metavar="DIR",
    help="The robot's folder (or its robot.toml). Default: $OPENANT_ROBOT, else the working directory.",
)
model_option = click.option(
    "--model",
    type=click.Path(path_type=Path),
    metavar="M.xml",
    help="Default: each run's own model, else that of the robot's folder.",
)
joint_option = click.option("--joint", "joints", multiple=True, metavar="NAME", help="Only this joint. Repeatable.")
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


def write_report(report: Report, folder: Path, recordings: Sequence[Path] = ()) -> None:
    """Write a report with the command that makes it and links to what it was made from; says where it lies."""
    from openant_tools.cli.log import command_line

    made_by = command_line()
    report.made_by = made_by if " " in made_by else report.made_by
    report.recordings = tuple(recordings) or report.recordings
    mention(f"wrote {report.write_folder(folder)}")


out_option = click.option("--out", type=click.Path(path_type=Path), required=True, metavar="PATH", help="What to make.")
#: commands a second; a bus of eight servos at 1 Mbaud manages about 300
rate_option = click.option(
    "--rate",
    "rate_hz",
    type=Number(10, 1000),
    default=100.0,
    show_default=True,
    metavar="HZ",
    help="Commands and reads a second.",
)
seconds_option = click.option(
    "--seconds",
    type=POSITIVE,
    metavar="S",
    help="How long to play, in all: the protocol's recordings (stand, floor) share it. Default: the protocol's own time.",
)
tie_option = click.option(
    "--tie",
    type=click.Choice(["joint", "servo", "all"]),
    default="joint",
    show_default=True,
    help="One value a joint, one a servo model, or one for all.",
)


driver_option = click.option(
    "--driver",
    type=click.Choice(("own", "sdk")),
    default="own",
    show_default=True,
    help="Who asks: these tools, or the vendor's SDK, as a second opinion; it writes nothing.",
)


def robot_folder(robot: Path | None, *, must_exist: bool = True) -> Path:
    """The robot's folder named by `--robot`, `$OPENANT_ROBOT` or the working directory (formats, section 4)."""
    path = robot or Path(os.environ.get("OPENANT_ROBOT", "."))
    folder = path.parent if path.name.endswith(".toml") else path
    if must_exist and not (folder / "robot.toml").is_file():
        raise BadInput(
            "there is no robot.toml here",
            where=folder,
            remedy="name one with --robot DIR, or make one with `openant config new --robot DIR`",
        )
    return folder
