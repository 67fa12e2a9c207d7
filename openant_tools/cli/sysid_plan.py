"""`openant sysid plan`: what recordings will tell, before anything moves."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.hardware import robot_of
from openant_tools.cli.log import mention
from openant_tools.cli.options import (
    Number,
    json_option,
    rate_option,
    report_option,
    robot_option,
    seconds_option,
    tie_option,
    write_report,
)
from openant_tools.cli.progress import progress_bar
from openant_tools.cli.sysid_record import DEFAULT_PROTOCOL, protocols_of, setup_option
from openant_tools.numbers import exact, number, percent, span

if TYPE_CHECKING:
    from openant_tools.sysid.plan import Plan

__all__ = ["plan"]


@click.command()
@click.option(
    "--protocol", "name", metavar="NAME", help=f"What to simulate; see `record --list`.  [default: {DEFAULT_PROTOCOL}]"
)
@click.option("--plan", "plan_file", type=click.Path(path_type=Path), metavar="FILE", help="Simulate such a file.")
@click.option(
    "--model",
    type=click.Path(path_type=Path),
    metavar="M.xml",
    help="Default: the robot's model, else the standard kit's.",
)
@robot_option
@click.option(
    "--kinds", multiple=True, metavar="KIND", help="Parameters of interest. Repeatable. Default: a fit's own."
)
@tie_option
@setup_option
@seconds_option
@rate_option
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Chance of the protocol, and of what --optimise draws.",
)
@click.option(
    "--noise",
    "noise_mrad",
    type=Number(min=0, min_open=True),
    metavar="MRAD",
    help="What a fit will leave on the stand.  [default: 1.5, as the virtual robot; real ones leave 3 to 20]",
)
@click.option(
    "--memory",
    "memory_s",
    type=Number(min=0),
    metavar="S",
    help="For how long such an error lasts.  [default: 0.05]",
)
@click.option(
    "--optimise", is_flag=True, help="Choose the motions on the stand so that they tell most in the same time."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the plan, for `record --plan`.",
)
@json_option
@report_option
def plan(
    name: str | None,
    plan_file: Path | None,
    model: Path | None,
    robot: Path | None,
    kinds: tuple[str, ...],
    tie: str,
    setup: str | None,
    seconds: float | None,
    rate_hz: float,
    seed: int,
    noise_mrad: float | None,
    memory_s: float | None,
    optimise: bool,
    out: Path | None,
    json_file: Path | None,
    report: Path | None,
) -> int:
    """Simulate recordings before they are made: what each parameter's interval will be, and how hard the robot works.

    With --optimise the motions on the stand are chosen anew: of many random ones within the robot's limits, those that
    together determine the parameters best (D-optimal).

    \b
      openant sysid plan --robot my-ant --report plan
      openant sysid plan --robot my-ant --optimise --setup stand --out best.toml
      openant sysid record --plan best.toml --out run.mcap --robot my-ant

    Exit code 1: it must not be played, since the robot would touch itself or fall.
    """
    from openant_tools.files import json_text, write_text
    from openant_tools.sysid.design import optimised
    from openant_tools.sysid.plan import Planned, Residual, make_plan
    from openant_tools.sysid.plan_file import write_plan
    from openant_tools.sysid.plan_report import plan_report
    from openant_tools.sysid.protocols import CommandSpace

    folder = robot_of(robot, needed=False)
    described = None if folder is None else folder.config()
    limits = None if described is None else {m.joint: (m.min_rad, m.max_rad) for m in described.motors.values()}
    if model is None:
        if folder is None:
            from openant_tools.robot.mjcf import nominal_model_path

            model = nominal_model_path()
        else:
            model = folder.model_path(described)
    played = protocols_of(name, plan_file, seconds, setup)
    assumed = Residual()
    asked = Planned(
        model,
        CommandSpace.around_home(limits),
        rate_hz,
        seed,
        kinds or None,
        tie,
        {} if described is None else {m.joint: m.servo.name for m in described.motors.values()},
        Residual(
            rad=assumed.rad if noise_mrad is None else 1e-3 * noise_mrad,
            memory_s=assumed.memory_s if memory_s is None else memory_s,
        ),
    )
    with progress_bar("planning", remaining=False) as step:
        result = (optimised if optimise else make_plan)(asked, played, step)
    _print(result)
    for note in result.notes:
        click.echo(note)
    for objection in result.objections:
        click.echo(f"do not play it: {objection}")
    if out is not None:
        made = tuple(one.protocol for one in result.forecasts)
        write_plan(
            out, made, f"made by `openant sysid plan` for {model.name}; play it with `openant sysid record --plan`"
        )
        mention(f"wrote {out}")
    if json_file is not None:
        write_text(json_file, json_text(result.as_json()))
    if report is not None:
        write_report(plan_report(result), report, [model])
    return 1 if result.objections else 0


def _print(result: Plan) -> None:
    from openant_tools.sysid.kinds import said

    for one in result.forecasts:
        protocol = one.protocol
        heading = f" at {number(protocol.heading_rad, 'rad', decimals=0)}" if protocol.heading_rad else ""
        fast = max(one.peaks, key=lambda peak: peak.speed_rad_s / peak.no_load_rad_s)
        strong = max(one.peaks, key=lambda peak: peak.saturated)
        moves = (
            f"; leans {number(one.lean_rad, 'rad', decimals=0)}, goes {number(100 * one.travel_m, 'cm', decimals=0)}"
            if protocol.setup == "floor"
            else ""
        )
        near = f"{number(1e3 * one.clearance_m, 'mm', decimals=0)} ({', '.join(one.nearest)})" if one.nearest else "far"
        click.echo(
            f"{protocol.name}, {protocol.setup}{heading}: {number(protocol.seconds, 's', decimals=0)}; fastest {fast.joint} {number(fast.speed_rad_s, 'rad/s', decimals=0)} "
            f"of {number(fast.no_load_rad_s, 'rad/s', decimals=0)}; {strong.joint} {percent(strong.saturated)} at its torque limit, largest "
            f"{number(max(peak.torque_nm for peak in one.peaks), 'N·m', decimals=2)}; nearest to itself {near}{moves}"
        )
    width = max(len(said(one.name)) for one in result.expectations)
    click.echo(f"{'':{width}}  {'expected':>15}  {'95 % interval':28}  {'prior':28}")
    for value in result.expectations:
        tied = (
            f" to {said(value.tied_to)} ({number(value.correlation, sign=True, decimals=2)})"
            if value.tied_to and value.verdict == "tied"
            else ""
        )
        click.echo(
            f"{said(value.name):{width}}  {number(value.nominal, value.unit):>15}  {span(value.low, value.high, value.unit):28}  "
            f"{span(value.prior_low, value.prior_high, value.unit):28}  {value.verdict}{tied}"
        )
    counts = {
        verdict: sum(one.verdict == verdict for one in result.expectations)
        for verdict in ("identified", "tied", "weak")
    }
    click.echo(
        f"{counts['identified']} of {len(result.expectations)} identified, {counts['weak']} weak, {counts['tied']} tied, in "
        f"{number(result.seconds, 's', decimals=0)}; if a fit leaves {exact(1e3 * result.asked.residual.rad, 'mrad')}"
    )
