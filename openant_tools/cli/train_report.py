"""`openant train report`: one page of a training run on a robot, from its own recordings, curve and log."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import json_option, write_report

__all__ = ["report"]


@click.command()
@click.argument("run", type=click.Path(path_type=Path, file_okay=False), metavar="RUN")
@click.option(
    "--forecast", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="What `openant thermal forecast --json` said before, to stand beside the temperatures.",
)  # fmt: skip
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), metavar="DIR",
    help="Where the page goes.  [default: RUN/report]",
)  # fmt: skip
@json_option
def report(run: Path, forecast: Path | None, out: Path | None, json_file: Path | None) -> None:
    """Make the page of a training run on a robot: speed with every intervention, deadlines met and missed and why, the age of
    observations, temperatures, answers lost, and what the robot did while nobody looked.

    Training on a robot ends with it; this makes it again, of an unfinished run, too.

    \b
    Example:
      openant train report my-ant/runs/real-1
    """
    from openant_tools.bringup.training_report import read_training, training_report
    from openant_tools.files import json_text, write_text

    record = read_training(run, forecast)
    page = training_report(record)
    click.echo(page.answer.verdict)
    for one in record.unreadable:
        mention(f"left out: {one}")
    write_report(page, out or run / "report")
    if json_file is not None:
        write_text(json_file, json_text(record.as_json(), indent=2))
