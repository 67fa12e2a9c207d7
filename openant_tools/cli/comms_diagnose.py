"""`openant comms diagnose` and `timing`: what recordings tell of the bus, and where a step's time goes."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import json_option, report_option, robot_option, write_report
from openant_tools.numbers import percent

__all__ = ["diagnose", "timing"]


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN…")
@click.option(
    "--effects",
    "effects_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the losses as effects of a simulation (command_dropout).",
)
@click.option("--keep", is_flag=True, help="Keep the finding in the robot's folder.")
@robot_option
@json_option
@report_option
def diagnose(
    runs: tuple[Path, ...],
    effects_file: Path | None,
    keep: bool,
    robot: Path | None,
    json_file: Path | None,
    report: Path | None,
) -> None:
    """Find out what loses the communication in RUNs of one robot, with probability, evidence, remedy and next test.

    A RUN is a recording, a soak, or a table of any other software; columns may be missing. Exit code 1 where a fault was
    found.

    \b
      openant comms diagnose soak.mcap --report bus
      openant comms diagnose log.parquet --json causes.json
      openant comms diagnose at-1M.mcap at-500k.mcap       noise grows with the baud rate
    """
    from openant_tools.comms.dropouts.diagnose import diagnose_dropouts
    from openant_tools.comms.dropouts.outcome import dropouts_finding, effects_toml
    from openant_tools.comms.dropouts.report import dropouts_report
    from openant_tools.files import json_text, write_text
    from openant_tools.procedure.finding import keep as keep_finding
    from openant_tools.recording.tables import read_run

    found = diagnose_dropouts([read_run(path, need=()) for path in runs])
    click.echo(found.what)
    for tie in (found.tied,) if found.tied else ():
        click.echo(f"these runs do not tell apart: {', '.join(tie)}")
    if found.verdict != "none":
        for suspect in found.suspects[:3]:
            if suspect.probability < 0.02:
                continue
            click.echo(f"{suspect.cause:16} {percent(suspect.probability):>5}  {', '.join(suspect.where)}")
            for why in [one for one in suspect.evidence if one.nats > 0][:4]:
                click.echo(f"  {why.words}")
        if found.verdict != "unknown":
            click.echo(f"remedy: {found.suspects[0].remedy}")
        click.echo(f"next test: {found.next_test}")
    if json_file:
        write_text(json_file, json_text(found.as_json()))
    if effects_file:
        write_text(effects_file, effects_toml(found))
    if report:
        write_report(dropouts_report(found), report, runs)
    if keep:
        from openant_tools.cli.hardware import robot_of

        folder = robot_of(robot, needed=True)
        assert folder is not None
        finding = dropouts_finding(found, [folder.relative(path) for path in runs])
        mention(f"wrote {keep_finding(finding, folder)}")
    if found.verdict != "none":
        click.get_current_context().exit(1)


@click.command()
@click.argument("run", type=click.Path(path_type=Path), metavar="RUN")
@click.option(
    "--picture", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE.png", help="Write the picture."
)
@json_option
@report_option
def timing(run: Path, picture: Path | None, json_file: Path | None, report: Path | None) -> None:
    """Show where each millisecond of an agent's step goes, and how much it scatters, in any recording of a robot at work.

    \b
      openant comms timing walk.mcap --report timing
    """
    from openant_tools.comms.step_timing import COLUMNS, sentence, step_timing, timing_figure, timing_report
    from openant_tools.files import json_text, write_bytes, write_text
    from openant_tools.recording.tables import read_run
    from openant_tools.report import plots

    found = step_timing(read_run(run, need=("cmd",)))
    rows = [COLUMNS, *found.table()]
    widths = [max(len(row[k]) for row in rows) for k in range(len(COLUMNS))]
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        click.echo(row[0].ljust(widths[0]) + "  " + "  ".join(cells))
    click.echo(sentence(found))
    if json_file:
        write_text(json_file, json_text(found.as_json()))
    if picture:
        figure = timing_figure(found)
        figure.set_facecolor("white")
        write_bytes(picture, plots.as_png(figure))
    if report:
        write_report(timing_report(found), report, [run])
