"""`openant loop`: from simulation to robot and back."""

from __future__ import annotations

import os
from pathlib import Path

import click

from openant_tools.cli.hardware import Moving, need_terminal
from openant_tools.cli.learning import need_agents, settings_of, settings_option
from openant_tools.cli.options import SECONDS, json_option, robot_folder, robot_option
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.cli.walking import hardware_robot, may_walk

__all__ = ["loop"]


@click.command(cls=Moving)
@robot_option
@virtual_option
@click.option(
    "--steps", type=click.IntRange(min=1), default=30_000, show_default=True,
    help="Training in the simulation as it is; 30,000 steps of 0.12 s are an hour.",
)  # fmt: skip
@click.option(
    "--fine-tune-steps", type=click.IntRange(min=1), default=10_000, show_default=True,
    help="Training on, in the improved simulation, and of the control in the one as it is.",
)  # fmt: skip
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option(
    "--seconds", type=SECONDS, default=12.0, show_default=True,
    help="Robot time from each start. With the five starts a play is a minute, which is enough to diagnose.",
)  # fmt: skip
@click.option(
    "--starts", type=click.IntRange(min=1), default=5, show_default=True,
    help="How often each agent starts anew in each place: an interval needs two.",
)  # fmt: skip
@settings_option
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
    help="The loop's folder. A loop that stands there goes on at the first stage that is not done.",
)  # fmt: skip
@click.option("--yes", is_flag=True, help="The robot may move: do not ask.")
@json_option
def loop(
    robot: Path | None,
    virtual_source: str | None,
    steps: int,
    fine_tune_steps: int,
    seed: int,
    seconds: float,
    starts: int,
    settings_file: Path | None,
    out: Path,
    yes: bool,
    json_file: Path | None,
) -> None:
    """Train in simulation, play on the robot, improve the simulation by that recording, train on in it, and play again.

    A control trains on as long in the simulation as it was, so that one sees what the improvement is worth. Every stage is a
    command that you could type; report.html lists them, and loop.log has what they said. The robot's folder stays as it is.

    \b
    Example:
      openant loop --robot my-ant --steps 30000 --fine-tune-steps 10000 --out my-ant/loops/1
      openant loop --robot my-ant --virtual --steps 30000 --fine-tune-steps 10000 --out try --yes
    """
    need_agents()
    from rich.markup import escape

    from openant_agents.sac import SacSettings
    from openant_tools.bringup.loop import Loop, result_of
    from openant_tools.bringup.loop_report import loop_report, verdict, what_was_found
    from openant_tools.cli.log import command_line
    from openant_tools.cli.stages import StageLines
    from openant_tools.files import json_text, write_text
    from openant_tools.lock import held

    settings_of(SacSettings, settings_file, "sac", {})
    folder = robot_folder(robot).absolute()
    options = hardware_robot(folder, None, virtual_source, None)
    whole = Loop(
        Path(os.path.abspath(out)), folder, options.get("virtual"), steps, fine_tune_steps, seed, seconds, starts,
        None if settings_file is None else settings_file.absolute(),
    )  # fmt: skip
    if yes:
        may_walk(options, yes)
    else:
        need_terminal("the robot would walk")
    whole.prepare()
    with (
        held(whole.folder / ".loop.lock", "this loop is being done by {}", remedy="wait for it, or stop it"),
        StageLines(whole, whole.stages()) as lines,
    ):
        place = 0
        while place < len(stages := whole.stages()):
            stage = stages[place]
            if whole.moves(stage) and not yes and not whole.stands(stage):
                may_walk(options, yes)
            place += 1
            lines.do(stage, place, len(stages) + 1)
        with lines.step("report", "put it all on one page", place + 1, place + 1):
            result = result_of(whole)
            answer = json_text(result.as_json(), indent=2)
            write_text(whole.result, answer)
            loop_report(whole, result, command_line()).write(whole.report)
        lines.say(escape(f"wrote {whole.report}"))
    click.echo(what_was_found(result))
    click.echo(verdict(result))
    if json_file is not None:
        write_text(json_file, answer)
