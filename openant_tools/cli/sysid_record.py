"""`openant sysid record`: excite the robot, on its stand and on the floor, and record it."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.hardware import (
    Moving,
    anyway_option,
    engine_config,
    may_move,
    port_option,
    record_pictures_option,
    robot_of,
    yes_option,
)
from openant_tools.cli.options import Number, rate_option, robot_option, seconds_option
from openant_tools.cli.progress import BarFace, progress_bar
from openant_tools.cli.streams import has_terminal
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.numbers import exact, number, span
from openant_tools.virtual.process import VIRTUAL_DEFAULT, has_camera, placeable, placed

if TYPE_CHECKING:
    from rich.console import Console

    from openant_tools.robot.folder import RobotFolder
    from openant_tools.sysid.protocols import Protocol
    from openant_tools.sysid.record import Recorded, Take

__all__ = ["DEFAULT_PROTOCOL", "protocols_of", "record", "setup_option"]

#: `protocols.FULL`, without loading it for every --help
DEFAULT_PROTOCOL = "full"

setup_option = click.option(
    "--setup", type=click.Choice(["stand", "floor"]), help="Only what is played there. Default: all of it."
)


@click.command(cls=Moving)
@click.option("--protocol", "name", metavar="NAME", help=f"What to play; see --list.  [default: {DEFAULT_PROTOCOL}]")
@click.option(
    "--plan",
    "plan_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Play what `openant sysid plan --out` wrote.",
)
@click.option("--list", "listing", is_flag=True, is_eager=True, help="List the protocols and how far each joint goes.")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), metavar="RUN.mcap", help="What to make.")
@virtual_option
@port_option
@robot_option
@rate_option
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Chance of the protocol; the same seed plays the same.",
)
@seconds_option
@click.option("--repeat", "repeats", type=click.IntRange(1), default=1, show_default=True, help="Play it so often.")
@click.option(
    "--hold-out-seed", type=click.IntRange(0), metavar="SEED", help="Record it with this seed, too, to judge a fit by."
)
@click.option(
    "--hot",
    "hot_s",
    type=Number(min=0, max=3600),
    is_flag=False,
    flag_value=60.0,
    default=0.0,
    metavar="[S]",
    help="Work for S (60) seconds or until a servo is 10 K warmer, and repeat it hot.",
)
@setup_option
@click.option("--imu/--no-imu", default=None, help="Record the IMU too. Default: on the floor.")
@click.option("--camera/--no-camera", default=None, help="Record the pose too. Default: on the floor, if there is one.")
@record_pictures_option
@anyway_option
@yes_option
def record(
    name: str | None,
    plan_file: Path | None,
    listing: bool,
    out: Path | None,
    virtual_source: str | None,
    port: str | None,
    robot: Path | None,
    rate_hz: float,
    seed: int,
    seconds: float | None,
    repeats: int,
    hold_out_seed: int | None,
    hot_s: float,
    setup: str | None,
    imu: bool | None,
    camera: bool | None,
    record_pictures: bool,
    anyway: bool,
    yes: bool,
) -> None:
    """Play an excitation on the robot and record it.

    On the stand the legs hang free. The robot goes slowly to its home pose, plays, and lets go. A protocol that goes on
    on the floor asks for the robot to be put there, and turned. Ctrl-C stops it with torque off and keeps what was recorded.

    \b
      openant sysid record --out run.mcap --robot my-ant --repeat 2 --hold-out-seed 1
      openant sysid record --virtual --protocol chirp --seconds 15 --out run.mcap --yes
      openant sysid record --list
    """
    from rich.console import Console

    from openant_tools.errors import BadInput
    from openant_tools.recording.writer import must_be_new, recording_path
    from openant_tools.sysid.record import takes

    if listing:
        _list(robot)
        return
    if out is None:
        raise BadInput("no name for the recording", remedy="name it with --out RUN.mcap")
    if record_pictures and camera is False:
        raise BadInput("pictures come from the camera", remedy="leave out --no-camera or --record-pictures")
    played = protocols_of(name, plan_file, seconds, setup)
    wanted = takes(recording_path(out), played, seed, repeats=repeats, hold_out_seed=hold_out_seed, hot_s=hot_s)
    for take in wanted:
        must_be_new(take.path)
    folder = robot_of(robot, needed=virtual_source is None)
    console = Console(stderr=True)
    placements = [
        [take for take in wanted if (take.protocol.setup, take.protocol.heading_rad) == place]
        for place in dict.fromkeys((take.protocol.setup, take.protocol.heading_rad) for take in wanted)
    ]
    # A virtual robot that is started here is put where it is needed; any other, and a real one, needs hands.
    moves_itself = virtual_source is not None and placeable(virtual_source)
    if placements[1:] and not moves_itself and (yes or not has_terminal()):
        rest = "; ".join(_where(later[0].protocol) for later in placements[1:])
        console.print(f"left out, since nobody is asked to move the robot: {rest}; record it with --setup floor")
        del placements[1:]
    if any(_looks(place[0].protocol, camera, record_pictures) for place in placements):
        _must_see(console, folder, virtual_source, everywhere=bool(camera) or record_pictures)
    for k, place in enumerate(placements):
        protocol = place[0].protocol
        if k and not moves_itself:
            click.confirm(f"Put the robot {_where(protocol)}. Ready?", abort=True, err=True)
        with contextlib.ExitStack() as stack:
            source = virtual_source
            if source is not None and moves_itself:
                source = stack.enter_context(placed(source, protocol.setup, protocol.heading_rad))
            done = _record_here(
                stack, console, place, source, port, folder, rate_hz, imu, camera, yes or k > 0, anyway, record_pictures
            )
        for recorded in done:
            click.echo(f"{recorded.path}  {recorded.cycles} cycles")
            _print_tracking(recorded.path)
            if record_pictures:
                _print_pictures(recorded.path)


def _looks(protocol: Protocol, camera: bool | None, pictures: bool) -> bool:
    """Whether the camera is read while this is played."""
    return pictures or (protocol.setup == "floor" if camera is None else camera)


def _must_see(console: Console, folder: RobotFolder | None, virtual_source: str | None, *, everywhere: bool) -> None:
    """Before anything moves: what is played last may be the first to look through the camera.

    Args:
        everywhere: whether the camera is read on the stand, too.

    Raises:
        BadInput: robot.toml does not say what the camera is to look for. HardwareFault: a real robot's camera shows nothing.
    """
    from openant_tools.comms.clock import RealClock
    from openant_tools.comms.setup import camera_of_robot
    from openant_tools.errors import OpenAntError

    if folder is None:
        return
    source = VIRTUAL_DEFAULT if virtual_source is not None and has_camera(virtual_source) else None
    try:
        camera = camera_of_robot(folder.config(), source)
        if camera is not None and virtual_source is None:
            from openant_tools.comms.camera import look  # not without OpenCV

            console.print(f"looking through the camera {camera.settings.name}")
            look(camera.settings, RealClock())
    except OpenAntError as error:
        ways = "record without the camera (--no-camera)" + (
            "" if everywhere else ", or on the stand alone (--setup stand)"
        )
        error.remedy = "; or ".join(filter(None, (error.remedy, ways)))
        raise


def protocols_of(
    name: str | None, plan_file: Path | None, seconds: float | None, setup: str | None
) -> tuple[Protocol, ...]:
    """What is to be played: the protocols of a name, else those of a plan's file.

    Raises:
        BadInput: both are given, or there is nothing for the setup.
    """
    from openant_tools.errors import BadInput
    from openant_tools.sysid.plan_file import read_plan
    from openant_tools.sysid.protocols import protocols

    if plan_file is None:
        return protocols(name or DEFAULT_PROTOCOL, seconds, setup)
    if name is not None or seconds is not None:
        raise BadInput("a plan says what to play", remedy="leave out --protocol and --seconds")
    played = tuple(one for one in read_plan(plan_file) if setup in (None, one.setup))
    if not played:
        raise BadInput(f"the plan has nothing for the {setup}", where=plan_file, remedy="leave out --setup")
    return played


def _print_tracking(path: Path) -> None:
    """How late each joint follows, where sines were played."""
    from openant_tools.recording.tables import read_run
    from openant_tools.sysid.tracking import tracking

    for joint in tracking(read_run(path)):
        seen = ", ".join(
            f"{number(1e3 * late, 'ms', decimals=1)} at {exact(hz, 'Hz')} (gain {number(gain, decimals=2)})"
            for hz, late, gain in zip(joint.hz, joint.late_s, joint.gain, strict=True)
        )
        click.echo(f"  {joint.joint} follows later by {seen}")


def _print_pictures(path: Path) -> None:
    from openant_tools.recording.reader import read_recording
    from openant_tools.recording.summary import words_of_pictures

    recording = read_recording(path)
    size = float(recording.pictures.columns["bytes"].sum())
    click.echo(f"  {words_of_pictures(len(recording.pictures.t), size, recording.run.duration_s)}")


def _where(protocol: Protocol) -> str:

    if protocol.setup == "stand":
        return "on its stand, legs free"
    heading = (
        f", turned left by {number(protocol.heading_rad, 'rad', decimals=0)} from where it looked"
        if protocol.heading_rad
        else ""
    )
    return f"on the floor, with room around it{heading}"


def _record_here(
    stack: contextlib.ExitStack,
    console: Console,
    wanted: list[Take],
    virtual_source: str | None,
    port: str | None,
    folder: RobotFolder | None,
    rate_hz: float,
    imu: bool | None,
    camera: bool | None,
    yes: bool,
    anyway: bool,
    pictures: bool,
) -> list[Recorded]:
    """Connect to the robot where it is, and record."""
    from openant_tools.errors import HardwareFault
    from openant_tools.procedure.step import drive
    from openant_tools.sysid.record import record_takes

    floor = wanted[0].protocol.setup == "floor"
    config = stack.enter_context(
        engine_config(
            folder,
            port,
            virtual_source,
            imu=floor if imu is None else imu,
            camera=_looks(wanted[0].protocol, camera, pictures),
            rate_hz=rate_hz,
            anyway=anyway,
        )
    )
    first = wanted[0].protocol
    console.print(
        f"{first.name}: {first.words}; {number(sum(take.protocol.seconds for take in wanted), 's', decimals=0)}"
        + (f" in {len(wanted)} recordings" if len(wanted) > 1 else "")
        + f". All {len(config.servos)} joints move on {config.port}; the robot must be {_where(first)}."
    )
    may_move(yes)
    text = None if folder is None else folder.config_file.read_text()
    shown = stack.enter_context(progress_bar("connecting", console=console))
    try:
        return drive(record_takes(config, wanted, robot_toml=text, pictures=pictures), BarFace(shown, console))
    except (HardwareFault, KeyboardInterrupt):
        kept = [str(take.path) for take in wanted if take.path.exists()]
        if kept:
            console.print(f"kept, the last one as far as it got: {', '.join(kept)}")
        raise


def _list(robot: Path | None) -> None:
    """Names, times, and how far each joint is commanded within this robot's limits."""
    from openant_tools.sysid.protocols import PROTOCOLS, CommandSpace, protocols

    folder = robot_of(robot, needed=False)
    limits = None
    if folder is not None:
        limits = {motor.joint: (motor.min_rad, motor.max_rad) for motor in folder.config().motors.values()}
    space = CommandSpace.around_home(limits)
    for name, (words, _) in PROTOCOLS.items():
        click.echo(f"{name:17} {words}" + ("  (default)" if name == DEFAULT_PROTOCOL else ""))
        for one in protocols(name):
            reach = {"hip": (0.0, 0.0), "knee": (0.0, 0.0)}
            moved = one.commands(space, 50.0) - one.space(space).home
            for kind in reach:
                columns = [k for k, joint in enumerate(space.joints) if joint.startswith(kind)]
                reach[kind] = float(moved[:, columns].min()), float(moved[:, columns].max())
            where = one.setup + (f" at {number(one.heading_rad, 'rad', decimals=0)}" if one.heading_rad else "")
            click.echo(
                f"{'':17} {where:13} {number(one.seconds, 's', decimals=0):>6}   from home: "
                + "   ".join(f"{kind} {span(low, high, 'rad', decimals=0)}" for kind, (low, high) in reach.items())
            )
