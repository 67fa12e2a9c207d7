"""`openant demo`: the whole way on a virtual robot."""

from __future__ import annotations

import functools
import time
from pathlib import Path
from typing import Any

import click

from openant_tools.cli.options import json_option

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
    "--steps", type=click.IntRange(min=100), default=6000, show_default=True,
    help="Length of the training; 6,000 steps are 12 minutes of the robot's time.",
)  # fmt: skip
@click.option("--fresh", is_flag=True, help="Begin anew, instead of going on where an earlier demo stopped.")
@json_option
def demo(robot: Path, steps: int, fresh: bool, json_file: Path | None) -> None:
    """The whole way on a virtual robot, in minutes: record, identify, learn, report.

    Each stage is a command that you could type; it is shown before it runs. What stands already is not done again:
    after Ctrl-C the same command goes on, and after a change of DIR/scenario.toml it does what follows from it.
    """
    from rich.console import Console
    from rich.markup import escape

    from openant_tools.bringup.demo import Demo
    from openant_tools.bringup.demo_report import write_report
    from openant_tools.files import json_text, write_text

    console = Console(stderr=True, highlight=False)
    say = functools.partial(console.print, soft_wrap=True)
    whole = Demo(robot, steps=steps)
    whole.prepare(fresh=fresh)
    began = time.monotonic()
    stages = whole.stages()
    try:
        for number, stage in enumerate(stages, 1):
            title = f"[bold]{number}/{len(stages) + 1} {stage.name}[/bold]"
            if whole.stands(stage):
                say(f"{title}: stands already ({escape(str(stage.results[-1]))})")
                continue
            say(f"{title}: {escape(stage.words)}")
            since = time.monotonic()
            whole.run(stage, lambda line: say(f"  [dim]$ {escape(line)}[/dim]"))
            say(f"  [green]done[/green] in {time.monotonic() - since:.0f} s")
        if not whole.learns:
            say("learning is left out: it needs torch (pip install 'openant-tools\\[agents]')")
        with console.status("report"):
            figures = write_report(whole)
    except KeyboardInterrupt:
        say(f"stopped; the same command goes on from here (in {escape(str(robot))})")
        raise
    say(
        f"[bold]{len(stages) + 1}/{len(stages) + 1} report[/bold]: {escape(str(whole.report))}; "
        f"{time.monotonic() - began:.0f} s in all"
    )
    _print(whole, figures)
    if json_file is not None:
        write_text(json_file, json_text(figures, indent=2))


def _print(whole: Any, figures: dict[str, Any]) -> None:
    robot = whole.folder
    click.echo(
        f"\nheld-out error {1e3 * figures['gap_before_rad']:.1f} → {1e3 * figures['gap_after_rad']:.2f} mrad "
        f"(floor {1e3 * figures['floor_rad']:.2f}); {figures['settings_within_interval']} of "
        f"{figures['settings_determined']} settings recovered within their intervals"
    )
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
