"""`openant gap diagnose | apply | prepare | next`: what a gap comes from, the model without it, and what to record next."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import joint_option, json_option, report_option, robot_option, write_report
from openant_tools.cli.progress import progress_bar
from openant_tools.cli.runs import checked, model_of, read_runs
from openant_tools.errors import BadInput
from openant_tools.numbers import number, percent

if TYPE_CHECKING:
    from openant_tools.gap.diagnosis import Diagnosis

__all__ = ["apply", "diagnose", "next_experiment", "prepare"]

#: effects shown in the terminal; the JSON has all
SHOWN = 6

runs_argument = click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN…")
model_option = click.option(
    "--model",
    type=click.Path(path_type=Path),
    metavar="M.xml",
    help="Default: each run's own model, else that of the robot's folder.",
)


@click.command()
@runs_argument
@model_option
@click.option(
    "--hold-out",
    "hold_out",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="RUN",
    help="Judge on this run. Repeatable. Default: parts of RUNs are left out in turn.",
)
@click.option(
    "--prior",
    multiple=True,
    metavar="EFFECT",
    help="An effect that you know or expect of this robot: it decides where the runs cannot. Repeatable.",
)
@joint_option
@robot_option
@json_option
@report_option
def diagnose(
    runs: tuple[Path, ...],
    model: Path | None,
    hold_out: tuple[Path, ...],
    prior: tuple[str, ...],
    joints: tuple[str, ...],
    robot: Path | None,
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Say where the gap between RUNs and a model lies, which unmodelled effect causes it, and how far it closes.

    \b
      openant gap diagnose walk.mcap --robot my-ant --json gap.json --report gap
      openant gap diagnose a.parquet b.parquet --hold-out c.parquet --model pendulum.xml

    Any recording will do, also a single one of a policy: robots with every cause are simulated for it, which takes a minute or
    two, and a second where the same was asked before. Exit code 0 whatever the verdict.
    """
    from openant_tools.files import json_text, write_text
    from openant_tools.gap.diagnose import diagnose as diagnosed
    from openant_tools.gap.report import diagnosis_report

    fitted, held = read_runs(runs), read_runs(hold_out)
    everything, given = model_of([*fitted, *held], model, robot)
    everything = checked(everything, given, joints)
    recordings, held_out = everything[: len(fitted)], everything[len(fitted) :]
    with progress_bar("reading", lines=True) as tell:
        found = diagnosed(
            recordings, given, hold_out=held_out, joints=joints or None, prior=prior, recall=True, progress=tell
        )
        if json_file:
            write_text(json_file, json_text(found.as_json()))
        page = None
        if report:
            tell(1.0, "writing the report")
            page = diagnosis_report(found, recordings, held_out, given)
    _print(found)
    if report and page:
        write_report(page, report, [*runs, *hold_out])


@click.command()
@runs_argument
@model_option
@joint_option
@robot_option
def prepare(runs: tuple[Path, ...], model: Path | None, joints: tuple[str, ...], robot: Path | None) -> None:
    """Simulate the robots that a diagnosis of RUNs will be judged by, so that it takes less. No verdict depends on it."""
    from openant_tools.gap.diagnose import prepare as prepared

    recordings, given = model_of(read_runs(runs), model, robot)
    recordings = checked(recordings, given, joints)
    with progress_bar("reading", lines=True) as tell:
        made = prepared(recordings, given, joints or None, tell)
    click.echo(f"ready: {made} simulated robots")


@click.command()
@click.argument("diagnosis", type=click.Path(path_type=Path), metavar="OUT.json")
@model_option
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="IMPROVED.xml", help="What to make.")
@robot_option
@click.option(
    "--for",
    "engine",
    type=click.Choice(["mujoco", "mjx"]),
    default="mujoco",
    show_default=True,
    help="What is to play the model.",
)
def apply(diagnosis: Path, model: Path | None, out: Path, robot: Path | None, engine: str) -> None:
    """Write the model with the effects that a diagnosis selected.

    What MuJoCo has features for stands in IMPROVED.xml, which plain MuJoCo loads; the rest beside it in
    IMPROVED.effects.toml, or with --robot in its robot.toml. With --for mjx what MJX does not carry stands there, too, for the
    code that steps it. Which engines carry what was written is said, and stands in the file's first comment.
    """
    from openant_tools.cli.options import robot_folder
    from openant_tools.gap.apply import apply as applied
    from openant_tools.gap.diagnosis import read_diagnosis
    from openant_tools.robot.folder import RobotFolder

    found = read_diagnosis(diagnosis)
    source = model or (RobotFolder.at(robot_folder(robot)).model_path() if robot is not None else Path(found.model))
    if robot is not None and engine != "mujoco":
        raise BadInput("a robot's folder is simulated by MuJoCo", remedy="leave --robot or --for out")
    done = applied(found, source, out, robot=robot, engine=None if engine == "mujoco" else engine)
    for line in done.carried:
        click.echo(line)
    for line in done.notes:
        mention(line)
    for path in done.written:
        mention(f"wrote {path}")


@click.command("next")
@click.argument("diagnosis", type=click.Path(path_type=Path), metavar="OUT.json")
@model_option
@json_option
def next_experiment(diagnosis: Path, model: Path | None, json_file: Path | None) -> None:
    """Say which experiment best separates what a diagnosis left open, and how far it would.

    Simulates what is still possible on every protocol of `openant sysid record --list`.
    """
    from openant_tools.files import json_text, write_text
    from openant_tools.gap.diagnosis import read_diagnosis
    from openant_tools.gap.next import experiments

    found = read_diagnosis(diagnosis)
    with progress_bar("reading", lines=True) as tell:
        answer = experiments(found, model or Path(found.model), progress=tell)
    click.echo(answer.sentence)
    for one in answer.experiments:
        click.echo(f"  {one.name:22}  {one.words}")
    if json_file:
        write_text(json_file, json_text(answer.as_json()))


def _print(found: Diagnosis) -> None:
    from openant_tools.gap.diagnosis import UNEXPLAINED
    from openant_tools.gap.words import closing, rest_words, sentence, sizes, where_words

    click.echo(sentence(found))
    shown = found.effects[:SHOWN]
    wide = max((len(where_words(one.joints)) for one in shown), default=0)
    click.echo(f"{'effect':20} {'where':{wide}}  present  closes  size")
    for one in shown:
        closed = "–" if one.gap_closed is None else closing(one.gap_closed)
        mark = "*" if one.effect in found.selected else " "
        click.echo(
            f"{mark}{one.effect:19} {where_words(one.joints):{wide}}  {percent(one.probability):>7}  {closed:>6}  {sizes(one)}"
        )
    gap = found.gap
    click.echo(
        f"gap of position on held-out runs: {number(gap['before'], 'rad', name='gap')} → "
        f"{number(gap['after'], 'rad', name='gap')}, floor {number(gap['floor'], 'rad', name='floor')}"
    )
    if found.rest and found.verdict != UNEXPLAINED:
        click.echo(rest_words(found))
    for note in found.notes:
        click.echo(note)
    if found.next_experiment:
        click.echo(f"next: {found.next_experiment}")
