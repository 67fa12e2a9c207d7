"""`openant thermal soak`: load the robot and keep its temperatures, with live curves."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.hardware import Moving, anyway_option, engine_config, may_move, port_option, robot_of, yes_option
from openant_tools.cli.options import Number, json_option, robot_option
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.numbers import exact, number, percent
from openant_tools.virtual.process import placeable, placed

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.thermal.soak import SoakPlan

__all__ = ["soak"]


@click.command(cls=Moving)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="RUN.mcap")
@click.option(
    "--load", type=click.Choice(["stand", "hang", "stall"]), default="stand", show_default=True,
    help="Stand on its feet; hang on its stand, legs free; or lie under a weight that stalls the pressing knees.",
)  # fmt: skip
@click.option(
    "--play", "commands", type=click.Path(path_type=Path), metavar="RUN|DIR",
    help="Play a recording's commands instead, or those of a trained policy by its folder, over and over.",
)  # fmt: skip
@click.option(
    "--pose", "poses", multiple=True, metavar="POSE",
    help="home, low, tall, straight, or knee=-0.32,hip=0; repeat it to hold several in turn.  [default: home]",
)  # fmt: skip
@click.option(
    "--effort", type=Number(0.02, 1.0), default=0.5, show_default=True, metavar="SHARE",
    help="Of full duty, with which stalled knees press.",
)  # fmt: skip
@click.option(
    "--minutes", type=Number(0.05, 24 * 60), default=60.0, show_default=True, metavar="MIN",
    help="Under load.",
)  # fmt: skip
@click.option(
    "--cool-down", type=Number(0, 24 * 60), default=20.0, show_default=True, metavar="MIN",
    help="Recorded afterwards, torque off.",
)  # fmt: skip
@click.option(
    "--margin", type=Number(0, 60), default=3.0, show_default=True, metavar="K",
    help="The load ends so far below a servo's own limit.",
)  # fmt: skip
@click.option("--to-shutdown", is_flag=True, help="Let the servos shut down by themselves, as the paper's test did.")
@click.option(
    "--heat-sink", "heat_sinks", multiple=True, metavar="JOINT", help="Has one: a joint, knee, hip or all; repeatable."
)
@click.option(
    "--ambient",
    "ambient_c",
    type=Number(-20, 60),
    metavar="°C",
    help="Of the room, if known.",
)
@click.option("--note", metavar="TEXT", help="What is special, kept with the recording.")
@click.option("--resume", is_flag=True, help="Go on with a soak that was cut short; its plan stands in its recording.")
@click.option(
    "--rate", "rate_hz", type=Number(2, 100), metavar="HZ",
    help="Reads a second.  [default: 5, or 50 where motions are played]",
)  # fmt: skip
@virtual_option
@port_option
@robot_option
@anyway_option
@yes_option
@json_option
def soak(
    out: Path,
    load: str,
    commands: Path | None,
    poses: tuple[str, ...],
    effort: float,
    minutes: float,
    cool_down: float,
    margin: float,
    to_shutdown: bool,
    heat_sinks: tuple[str, ...],
    ambient_c: float | None,
    note: str | None,
    resume: bool,
    rate_hz: float | None,
    virtual_source: str | None,
    port: str | None,
    robot: Path | None,
    anyway: bool,
    yes: bool,
    json_file: Path | None,
) -> int:
    """Load the robot for minutes to hours and record how warm every servo gets.

    Each servo's own limit is read from it; the load ends a margin below, torque goes off, and the cooling is recorded too.
    Ctrl-C, a crash or a power cut leave a recording that --resume goes on with. --load stall is the stress test of the Open
    Ant paper: the robot lies under a weight that it cannot lift while its knees press down.

    \b
      openant thermal soak --robot my-ant --minutes 30 --out soak.mcap
      openant thermal soak --robot my-ant --load stall --to-shutdown --heat-sink knee --out stress.mcap
      openant thermal soak --robot my-ant --play walk.mcap --minutes 20 --out walking.mcap
      openant thermal soak --robot my-ant --play my-ant/runs/sac-1 --minutes 20 --out walking.mcap
      openant thermal soak --virtual --minutes 30 --out soak.mcap --yes

    Exit code 1: a servo came so near its limit that the load ended early.
    """
    from openant_tools.cli.thermal_curves import Curves
    from openant_tools.errors import BadInput
    from openant_tools.procedure.step import drive
    from openant_tools.recording.writer import must_be_new, recording_path
    from openant_tools.robot.joints import JOINT_NAMES
    from openant_tools.thermal.soak import SoakPlan, pose_angles, resume_plan, soak_config
    from openant_tools.thermal.soak import soak as run_soak

    out = recording_path(out)
    if resume:
        if not out.is_file():
            raise BadInput("there is no soak to go on with", where=out, remedy="leave out --resume to begin one")
        plan = resume_plan(out)
    else:
        must_be_new(out, "record under another name, or --resume it")
        plan = SoakPlan(
            load="play" if commands else load,  # type: ignore[arg-type]
            seconds=minutes * 60,
            cool_down_s=cool_down * 60,
            poses=poses or ("home",),
            effort=effort,
            margin_k=-1.0 if to_shutdown else margin,
            commands=None if commands is None else str(commands),
            notes=note,
            heat_sinks=_joints(heat_sinks),
            ambient_c=ambient_c,
        )
        for pose in plan.poses:
            pose_angles(pose, JOINT_NAMES)
    face = Curves(yes=yes)
    console = face.console
    folder = robot_of(robot, needed=virtual_source is None)
    if not resume and commands is not None and commands.is_dir():
        plan = replace(plan, commands=str(_walked(commands, out, folder)))
    with contextlib.ExitStack() as stack:
        if virtual_source is not None and placeable(virtual_source):
            virtual_source = stack.enter_context(placed(virtual_source, plan.setup, doze=True))
        config = stack.enter_context(engine_config(folder, port, virtual_source, anyway=anyway))
        config = soak_config(config, rate_hz or (50.0 if plan.load == "play" else 5.0), plan.margin_k)
        console.print(
            f"{'going on with ' if resume else ''}{_words(plan)}, {exact(plan.seconds / 60, 'min')}, then {exact(plan.cool_down_s / 60)} "
            f"min of cooling. {'The knees press' if plan.load == 'stall' else 'All joints move'} on {config.port}."
        )
        may_move(yes)
        toml = None if folder is None else folder.config_file.read_text()
        try:
            with face.table:
                made = drive(run_soak(config, plan, out, robot_toml=toml, resume=resume), face)
        except BaseException:
            if out.exists():
                console.print(
                    f"kept what was recorded: go on with `openant thermal soak --resume --out {out}`", markup=False
                )
            raise
    for joint, peak in made.peak_c.items():
        click.echo(
            f"{joint:9} {number(peak, '°C', decimals=0):>6} at most"
            + (f", {made.glitches[joint]} telemetry errors" if made.glitches[joint] else "")
        )
    click.echo(
        f"{made.path}  {made.cycles} cycles, {number(made.loaded_s / 60, 'min', decimals=1)} under load: {made.words}"
    )
    if json_file is not None:
        from openant_tools.files import json_text, write_text

        write_text(json_file, json_text({**vars(made), "path": str(made.path)}))
    return 0 if made.why == "time" else 1


def _walked(run: Path, out: Path, folder: RobotFolder | None) -> Path:
    """What the policy of a training run commands in the simulation, as a table beside `out`."""
    from openant_tools.cli.learning import need_agents
    from openant_tools.cli.walking import environment

    need_agents()
    from openant_agents.places import SIMULATED_ID, simulated_options
    from openant_agents.rollout import write_commands
    from openant_agents.runs import read_facts

    options = simulated_options(read_facts(run)["env"]["options"], None if folder is None else folder.path)
    table = out.with_name(f"{out.stem}-policy.parquet")
    with environment(SIMULATED_ID, options, run / "recordings") as env:
        write_commands(env, run, table)
    return table


def _joints(names: tuple[str, ...]) -> tuple[str, ...]:
    from openant_tools.errors import BadInput
    from openant_tools.robot.joints import JOINT_NAMES, JOINTS

    chosen: list[str] = []
    for name in names:
        found = [joint for joint in JOINT_NAMES if name in (joint, JOINTS[joint].kind, "all")]
        if not found:
            raise BadInput(f"no joint {name!r}", remedy=f"one of {', '.join(JOINT_NAMES)}, knee, hip or all")
        chosen += found
    return tuple(joint for joint in JOINT_NAMES if joint in chosen)


def _words(plan: SoakPlan) -> str:
    if plan.load == "stall":
        return f"the knees press with {percent(plan.effort)} of full duty against a weight that stalls them"
    if plan.load == "play":
        return f"the commands of {plan.commands} over and over"
    where = "standing on its feet" if plan.load == "stand" else "hanging on its stand"
    return f"{where}, {' then '.join(plan.poses)}"
