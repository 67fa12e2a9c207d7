"""`openant comms soak`: hours of traffic while the robot moves, and what it lost."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click

from openant_tools.cli.hardware import Moving, anyway_option, engine_config, may_move, port_option, robot_of, yes_option
from openant_tools.cli.log import mention
from openant_tools.cli.options import MINUTES, json_option, rate_option, robot_option
from openant_tools.cli.progress import BarFace, progress_bar
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.numbers import number, percent
from openant_tools.virtual.process import VIRTUAL_DEFAULT

__all__ = ["soak"]

#: cycles a second of a soak on the transaction level, where none is named
TRANSACTIONS_HZ = 10.0


@click.command(cls=Moving)
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="RUN", help="What to make."
)
@click.option("--minutes", type=MINUTES, default=15.0, show_default=True, metavar="M")
@click.option("--still", is_flag=True, help="Do not move: torque stays off.")
@click.option("--resume", is_flag=True, help="Go on with the soak that was cut short at --out, as one recording.")
@click.option(
    "--every-cycle", is_flag=True, help="Keep every cycle. Default: all around errors, ten healthy ones a second."
)
@click.option(
    "--transactions",
    is_flag=True,
    help="With --virtual: without bytes and ports, many times faster than real time, 10 cycles a second; RUN is a .parquet.",
)
@anyway_option
@yes_option
@port_option
@virtual_option
@robot_option
@rate_option
@json_option
@click.pass_context
def soak(
    context: click.Context,
    out: Path,
    minutes: float,
    still: bool,
    resume: bool,
    every_cycle: bool,
    transactions: bool,
    anyway: bool,
    yes: bool,
    port: str | None,
    virtual_source: str | None,
    robot: Path | None,
    rate_hz: float,
    json_file: Path | None,
) -> None:
    """Read and write at full rate for hours while the legs swing, log every loss with all that was seen around it.

    The robot is on its stand, legs free. What stops it is told; the legs swing again only after silence, twelve times in
    ten minutes at most (docs/restart.md), else the soak goes on listening, torque off. Ctrl-C ends it with torque off and
    the log whole; --resume goes on with it.

    \b
      openant comms soak --robot my-ant --out soak.mcap --minutes 60
      openant comms soak --virtual loose-plug.toml --out soak.mcap --minutes 2 --yes
      openant comms diagnose soak.mcap
    """
    from rich.console import Console

    from openant_tools.comms.soak import SWING_RAD, THIN_S
    from openant_tools.comms.soak import soak as soak_bus
    from openant_tools.errors import BadInput
    from openant_tools.files import json_text, write_text
    from openant_tools.procedure.step import drive
    from openant_tools.recording.writer import must_be_new, recording_path

    if transactions:
        if virtual_source is None:
            raise BadInput("only a virtual robot can be asked without bytes", remedy="add --virtual [SCENARIO]")
        given = context.get_parameter_source("rate_hz") is not click.core.ParameterSource.DEFAULT
        _transactions(virtual_source, out, minutes * 60, rate_hz if given else TRANSACTIONS_HZ, still)
        return
    path, seconds = recording_path(out), minutes * 60
    if not resume:
        must_be_new(path, "go on with it by --resume, or name another file")
    if resume and not path.exists():
        raise BadInput("there is no soak to go on with", where=path, remedy="leave out --resume")
    console = Console(stderr=True)
    folder = robot_of(robot, needed=False)
    with contextlib.ExitStack() as stack:
        config = stack.enter_context(
            engine_config(folder, port, virtual_source, rate_hz=rate_hz, still=still, anyway=anyway)
        )
        if not still:
            console.print(
                f"all {len(config.servos)} joints swing by up to {number(SWING_RAD, 'rad', decimals=0)}; the robot must be on its stand, legs free"
            )
            may_move(yes, remedy="add --yes if it may, or --still")
        shown = stack.enter_context(progress_bar("soaking", console=console))
        try:
            soaking = soak_bus(
                config, path, seconds, move=not still, resume=resume, thin_s=None if every_cycle else THIN_S,
                robot_toml=None if folder is None else folder.config_file.read_text(),
            )  # fmt: skip
            done = drive(soaking, BarFace(shown, console))
        except KeyboardInterrupt:
            console.print(f"kept as far as it got: {path}; go on with --resume")
            raise
    click.echo(f"{done.path}  {number(done.seconds, 's', decimals=0)}, {done.cycles} rows kept")
    for servo in done.statistics["servos"]:
        lost = ", ".join(f"{cause} {count}" for cause, count in servo["lost"].items())
        click.echo(f"  {servo['joint']:8} {percent(servo['loss'], decimals=3):>8} of {servo['asked']} lost  {lost}")
    if done.statistics.get("late"):
        click.echo(f"{done.statistics['late']}: losses are in part its own")
    for stop in done.stops:
        click.echo(f"stopped: {stop}")
    if json_file:
        content = {"run": str(done.path), "seconds": done.seconds, "rows": done.cycles, "stops": list(done.stops),
                   "ended": done.ended, "whole": done.whole, "statistics": done.statistics}  # fmt: skip
        write_text(json_file, json_text(content))
    mention(f"`openant comms diagnose {done.path}` says why")
    if done.ended:
        click.echo(f"openant: {'the soak' if still else 'motion'} has ended for good: {done.ended}", err=True)
    if not done.whole:
        raise SystemExit(1)


def _transactions(source: str, out: Path, seconds: float, rate_hz: float, still: bool) -> None:
    from openant_tools.blind.soak_virtual import swinging_soak
    from openant_tools.errors import BadInput
    from openant_tools.recording.tables import write_table
    from openant_tools.virtual.scenario import Scenario, load_scenario

    if out.suffix not in (".parquet", ".csv"):
        raise BadInput("this soak is a table", where=out, remedy=f"name it {out.with_suffix('.parquet').name}")
    if out.exists():
        raise BadInput("there is a run already", where=out, remedy="name another file")
    if source != VIRTUAL_DEFAULT and not source.endswith(".toml"):
        raise BadInput(
            "a running robot has ports only", where=source, remedy="name a scenario, or leave out --transactions"
        )
    scenario = Scenario() if source == VIRTUAL_DEFAULT else load_scenario(Path(source))
    with progress_bar("soaking") as tell:
        run = swinging_soak(scenario, seconds, rate_hz, out.stem, still=still, progress=tell)
    write_table(run, out)
    click.echo(f"{out}  {number(run.duration_s, 's', decimals=0)}, {len(run.t)} rows")
