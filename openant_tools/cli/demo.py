"""`openant demo`: the whole way on a virtual robot."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

from openant_tools.cli.options import json_option
from openant_tools.numbers import number

__all__ = ["demo"]


@click.command()
@click.option(
    "--robot",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("demo-robot"),
    show_default=True,
    metavar="DIR",
    help="The folder for everything it makes.",
)
@click.option(
    "--steps", type=click.IntRange(min=100), default=7000, show_default=True,
    help="Length of the training; 7,000 steps are 14 minutes of the robot's time.",
)  # fmt: skip
@click.option("--fresh", is_flag=True, help="Begin anew, instead of going on where an earlier demo stopped.")
@json_option
def demo(robot: Path, steps: int, fresh: bool, json_file: Path | None) -> None:
    """The whole way on a virtual robot, in minutes: record, identify, learn, report.

    Each step is made of commands that you could type; report.html lists them, and demo.log has what they said. What stands
    already is not done again: after Ctrl-C the same command goes on, and after a change of DIR/scenario.toml it does what
    follows from it.
    """
    from rich.markup import escape

    from openant_tools.bringup.demo import Demo
    from openant_tools.bringup.demo_report import write_report
    from openant_tools.cli.stages import StageLines
    from openant_tools.files import json_text, write_text

    whole = Demo(robot, steps=steps)
    whole.prepare(fresh=fresh)
    stages = whole.stages()
    with StageLines(whole, stages) as lines:
        lines.say(
            f"A virtual Open Ant in {escape(str(robot))}: from its first recording to walking, in about three minutes."
        )
        for place, stage in enumerate(stages, 1):
            lines.do(stage, place, len(stages) + 1)
        if not whole.learns:
            lines.say("learning is left out: it needs torch (pip install 'openant-tools\\[agents]')")
        elif not whole.video.exists():
            lines.say("no pictures of the walk: there is no OpenGL here (an EGL or OSMesa library would do)")
        with lines.step("report", "put it all on one page", len(stages) + 1, len(stages) + 1):
            figures = write_report(whole)
        lines.say(f"{number(time.monotonic() - lines.began, 's', decimals=0)} in all")
    _print(whole, figures)
    if json_file is not None:
        write_text(json_file, json_text(figures, indent=2))


def _print(whole: Any, figures: dict[str, Any]) -> None:
    robot = whole.folder
    from openant_tools.bringup.demo_report import gap_words, spread
    from openant_tools.bringup.gait import walks_at

    before, after, floor = (gap_words(figures[name]) for name in ("gap_before_rad", "gap_after_rad", "floor_rad"))
    click.echo(
        f"\nheld-out error {before} → {after} (floor {floor}); {figures['settings_within_interval']} of "
        f"{figures['settings_determined']} settings within the intervals that were found"
    )
    if figures["walking"] is not None:
        found = figures["walking"]
        click.echo(f"it {walks_at(found['sampled']['median'])}; {spread(found)}")
    rows = [
        (whole.report, "everything at a glance; opens in any browser, offline"),
        (robot / "robot.toml", "the robot, and where each value came from"),
        (robot / "calibrated.xml", "its MJCF, for plain MuJoCo too"),
        (whole.fitted.parent, "what was recorded; `openant rec info` looks inside"),
        (whole.fit / "report.html", "the fit, joint by joint"),
        (whole.scenario, "what was wrong with the virtual robot; change it and run the demo again"),
    ]
    if whole.learns:
        rows.insert(4, (whole.training, "what was learned"))
        if whole.video.exists():
            rows.insert(1, (whole.video, "the robot walking; also in the report"))
    width = max(len(str(path)) for path, _ in rows)
    click.echo("\n".join(f"  {path!s:{width}}  {words}" for path, words in rows))
    click.echo("\nnext:")
    if whole.learns:
        click.echo(
            f"  openant train sac --robot {robot} --steps 15000 --out {robot}/runs/sac-1    half an hour of walking"
        )
    click.echo(f"  openant rec info {whole.fitted}")
    click.echo("  openant virtual start --ready-file ant.json    a virtual Ant that any Dynamixel software can drive")
    click.echo("  openant config new --kit standard --robot my-ant    a folder for your own robot")
