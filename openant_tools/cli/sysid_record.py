"""`openant sysid record`: excite the robot on its stand and record it."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.options import robot_option
from openant_tools.cli.virtual_for_command import VIRTUAL_DEFAULT, virtual_option, virtual_robot

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder

__all__ = ["record", "robot_of"]


@click.command()
@click.option("--protocol", "name", default="stand", show_default=True, help="What to play; see --list.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="RUN.mcap")
@virtual_option
@click.option("--port", metavar="PATH", help="The bus. Default: robot.toml's, else the one U2D2 that is plugged in.")
@robot_option
@click.option("--rate", "rate_hz", default=100.0, show_default=True, metavar="HZ", help="Commands and reads a second.")
@click.option("--seed", default=0, show_default=True, help="Chance of the protocol; the same seed plays the same.")
@click.option("--seconds", type=float, metavar="S", help="How long to play. Default: the protocol's own time.")
@click.option("--repeat", "repeats", type=click.IntRange(1), default=1, show_default=True, help="Play it so often.")
@click.option("--setup", type=click.Choice(["stand", "floor"]), default="stand", show_default=True)
@click.option("--imu/--no-imu", default=None, help="Record the IMU too. Default: on the floor.")
@click.option("--camera/--no-camera", default=None, help="Record the pose too. Default: on the floor, if there is one.")
@click.option("--yes", is_flag=True, help="The robot may move: do not ask. Needed where no terminal is attached.")
def record(
    name: str,
    out: Path,
    virtual_source: str | None,
    port: str | None,
    robot: Path | None,
    rate_hz: float,
    seed: int,
    seconds: float | None,
    repeats: int,
    setup: str,
    imu: bool | None,
    camera: bool | None,
    yes: bool,
) -> None:
    """Play an excitation on the robot and record it.

    The robot hangs on its stand, legs free. It goes slowly to its home pose, plays, and lets go. Ctrl-C stops it with
    torque off and keeps what was recorded.

    \b
      openant sysid record --protocol stand --out run.mcap --robot my-ant
      openant sysid record --virtual --protocol chirp --seconds 15 --out run.mcap --yes
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from openant_tools.comms.setup import camera_of_robot, config_of_robot, config_of_unknown_robot, imu_of_robot
    from openant_tools.errors import BadInput
    from openant_tools.recording.writer import recording_path
    from openant_tools.sysid.protocols import protocol
    from openant_tools.sysid.record import record_protocol, repeat_paths

    played = protocol(name, seconds)
    out = recording_path(out)
    for path in repeat_paths(out, repeats):
        if path.exists():
            raise BadInput("there is a recording already", where=path, remedy="record under another name")
    folder = robot_of(robot, needed=virtual_source is None)
    console = Console(stderr=True)
    with contextlib.ExitStack() as stack:
        control = imu_port = camera_source = None
        if virtual_source is not None:
            # One that is ours alone need not wait for real time.
            clock = "stepped" if virtual_source == VIRTUAL_DEFAULT else None
            found = stack.enter_context(virtual_robot(virtual_source, clock=clock))
            port, control, imu_port = port or found["bus"], found["control"], found["imu"]
            camera_source = found["camera"]
        described = None if folder is None else folder.config()
        floor = setup == "floor"
        more = {
            "rate_hz": rate_hz,
            "imu": imu_of_robot(described, imu_port) if (floor if imu is None else imu) else None,
            "camera": camera_of_robot(described, camera_source) if (floor if camera is None else camera) else None,
        }
        if described is not None:
            config = config_of_robot(described, port, control=control, **more)
        else:
            assert port is not None
            config = config_of_unknown_robot(port, control, **more)
        console.print(
            f"{played.name}: {played.words}; {played.seconds:.0f} s"
            + (f", {repeats} times" if repeats > 1 else "")
            + f". All {len(config.servos)} joints move on {config.port}; the robot must hang free on its {setup}."
        )
        _ask(yes)
        columns = TextColumn("{task.description:18}"), BarColumn(), TextColumn("{task.percentage:3.0f} %")
        bar = stack.enter_context(Progress(*columns, TimeElapsedColumn(), console=console, transient=True))
        task = bar.add_task("connecting", total=1.0)
        done = record_protocol(
            config,
            played,
            out,
            seed=seed,
            repeats=repeats,
            setup=setup,
            robot_toml=None if folder is None else folder.config_file.read_text(),
            progress=lambda words, share: bar.update(task, description=words, completed=share),
            journal=None if folder is None else folder.journal,
            notice=lambda text: bar.console.print(text, highlight=False),
        )
    for recorded in done:
        click.echo(f"{recorded.path}  {recorded.cycles} cycles")


def robot_of(robot: Path | None, *, needed: bool) -> RobotFolder | None:
    """The robot's folder by `--robot`, $OPENANT_ROBOT or the working directory; None where none is meant nor needed."""
    from openant_tools.robot.config import CONFIG_NAME
    from openant_tools.robot.folder import RobotFolder

    path = robot or Path(os.environ.get("OPENANT_ROBOT", "."))
    meant = robot is not None or "OPENANT_ROBOT" in os.environ or (path / CONFIG_NAME).is_file()
    return RobotFolder.at(path) if meant or needed else None


def _ask(yes: bool) -> None:
    from openant_tools.errors import BadInput

    if yes:
        return
    if not sys.stdin.isatty():
        raise BadInput("the robot would move and nobody is there to ask", remedy="add --yes if it may")
    click.confirm("May it move?", abort=True, err=True)
