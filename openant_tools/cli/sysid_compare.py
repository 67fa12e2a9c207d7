"""`openant sysid compare`: two fits, two robots or two dates side by side."""

from __future__ import annotations

import datetime
from pathlib import Path

import click

from openant_tools.cli.options import json_option, report_option, robot_option, write_report
from openant_tools.numbers import number

__all__ = ["compare"]


@click.command()
@click.argument("a", metavar="A")
@click.argument("b", metavar="B")
@robot_option
@json_option
@report_option
def compare(a: str, b: str, robot: Path | None, json_file: Path | None, report: Path | None) -> int:
    """What changed between A and B beyond their intervals.

    Each is a fit.json (or its folder), a robot's folder, or with --robot a date: the newest that was known then.

    \b
      openant sysid compare spring/fit autumn/fit --report aging
      openant sysid compare ant12 ant13
      openant sysid compare 2026-03-01 2026-09-01 --robot my-ant

    So many parameters differ a little by chance; Holm's procedure holds the probability that any is wrongly called changed
    at 5 %. Exit code 1: something changed.
    """
    from openant_tools.cli.hardware import robot_of
    from openant_tools.files import json_text, write_text
    from openant_tools.sysid.compare import chance
    from openant_tools.sysid.compare import compare as compared
    from openant_tools.sysid.compare_sources import snapshot
    from openant_tools.sysid.kinds import said

    folder = robot_of(robot, needed=False)
    result = compared(snapshot(a, folder), snapshot(b, folder))
    width = max(len(said(change.name)) for change in result.changes)
    click.echo(f"{'':{width}}  {'A':>15}  {'B':>15}  B − A (95 % interval)")
    for change in result.changes:
        a, b = (number(one.value, one.unit or change.unit) for one in (change.a, change.b))
        line = f"{said(change.name):{width}}  {a:>15}  {b:>15}  "
        if change.status == "not comparable":
            click.echo(f"{line}– {change.why}")
            continue
        difference = number(change.difference, change.unit, change.low, change.high, sign=True)
        changed = f"changed, p {chance(change.p_holm)}" if change.status == "changed" else ""
        click.echo(f"{line}{difference:42} {changed}".rstrip())
    for note in result.notes:
        click.echo(note)
    click.echo(result.sentence)
    content = json_text(result.as_json())
    if robot is not None and folder is not None:
        stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
        write_text(folder.findings / f"comparison-{stamp}.json", content)
    if json_file:
        write_text(json_file, content)
    if report:
        from openant_tools.sysid.compare_report import comparison_report

        write_report(comparison_report(result), report, [Path(a), Path(b)])
    return 1 if result.changed else 0
