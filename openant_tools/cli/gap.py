"""`openant gap`: how far a simulation is from its robot, where, and why."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.gap_blind import blind
from openant_tools.cli.gap_diagnose import apply, diagnose, next_experiment, prepare
from openant_tools.cli.options import joint_option, json_option, model_option, report_option, robot_option, write_report
from openant_tools.cli.runs import checked, effects_of, model_of, read_runs

__all__ = ["gap"]


@click.group()
def gap() -> None:
    """The gap between a robot and its simulation."""


for _command in (apply, blind, diagnose, next_experiment, prepare):
    gap.add_command(_command)


@gap.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN…")
@model_option
@joint_option
@click.option(
    "--horizon", default="0.5", show_default=True, metavar="S", help="Seconds between re-initialisations, or `full`."
)
@click.option(
    "--effects",
    "effects_file",
    type=click.Path(path_type=Path),
    metavar="FILE.toml",
    help="What acts beside the model. Default: the robot's, where the model is its own.",
)
@robot_option
@json_option
@report_option
def measure(
    runs: tuple[Path, ...],
    model: Path | None,
    joints: tuple[str, ...],
    horizon: str,
    effects_file: Path | None,
    robot: Path | None,
    json_file: Path | None,
    report: Path | None,
) -> int:
    """Simulate RUNs with their own commands and say how far off the model is: per signal, joint and kind of motion.

    \b
      openant gap measure run.mcap --robot my-ant --report gap
      openant gap measure swing.parquet --model pendulum.xml --horizon full
      openant gap measure swing.parquet --model fit/with-effects/calibrated.xml --effects fit/with-effects/calibrated.effects.toml

    Effects that were fitted act beside the model that was fitted with them, and are refused beside any other.

    Exit code 1: it cannot be judged, since repeats of one motion disagree.
    """
    from openant_tools.errors import BadInput
    from openant_tools.files import json_text, write_text
    from openant_tools.gap.measure import measure as measured
    from openant_tools.gap.measure_report import gap_report, sentence, table

    try:
        seconds = None if horizon == "full" else float(horizon)
    except ValueError:
        seconds = -1.0
    if seconds is not None and not 0.02 <= seconds < 1e6:
        raise BadInput(f"--horizon {horizon} is no time", remedy="give seconds, 0.02 or more, or `full`")
    recordings, path = model_of(read_runs(runs), model, robot)
    effects = effects_of(recordings, path, model, robot, effects_file)
    found = measured(checked(recordings, path, joints, effects), path, joints or None, seconds, effects[0])
    click.echo(sentence(found))
    if found.effects:
        click.echo(f"beside the model act: {', '.join(dict.fromkeys(name for name, _ in found.effects))}")
    for words in table(found):
        click.echo(words)
    if json_file:
        write_text(json_file, json_text(found.as_json()))
    if report:
        write_report(gap_report(found), report, runs)
    return 1 if found.doubt else 0
