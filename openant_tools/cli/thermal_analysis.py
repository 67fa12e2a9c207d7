"""`openant thermal fit | forecast | compare`: what recordings say of heat."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.log import command_line, mention
from openant_tools.cli.options import Number, json_option, report_option, robot_option, write_report
from openant_tools.numbers import exact, number, percent

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.thermal.inputs import Inputs

__all__ = ["compare", "fit", "forecast"]

after_option = click.option(
    "--after", type=click.Path(path_type=Path, dir_okay=False), metavar="FIT.json",
    help="Begin from what an earlier `thermal fit` of this robot taught.",
)  # fmt: skip


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN...")
@after_option
@robot_option
@json_option
@report_option
def fit(
    runs: tuple[Path, ...], after: Path | None, robot: Path | None, json_file: Path | None, report: Path | None
) -> int:
    """Fit the two-node model (winding and case) to recordings with temperatures, in the order in which they were made.

    Any run table with temp.J will do; the load is taken from cur.J, else from pwm.J and volt.J, else from load.J, and is
    fitted itself where none of them was logged. The last run's first 60 % are fitted apart and meet the rest.

    \b
      openant thermal fit soak.mcap --robot my-ant --json fit.json --report fit
      openant thermal fit monday.mcap tuesday.mcap --json fit.json

    Exit code 1: the fit of the first part misses the later one by more than 2 K.
    """
    from openant_tools.numbers import number
    from openant_tools.thermal.finding import BELIEVED_K
    from openant_tools.thermal.fit import PARAMETER_WORDS, Known, fit_and_judge
    from openant_tools.thermal.forecast import forecast as look_ahead
    from openant_tools.thermal.forecast import rest_advice

    inputs = [_read(path) for path in runs]
    found, held = fit_and_judge(inputs, after=None if after is None else Known.read(after))
    for one in found.estimates:
        if one.name in SHOWN:
            mark = "" if one.informed > 0.5 else "  mostly believed before"
            value = number(one.value, one.unit, one.low, one.high)
            click.echo(f"{one.joint or 'all':9} {PARAMETER_WORDS[one.name]:55} {value}{mark}")
    click.echo(
        f"crossings missed by {number(float(max(found.residual_k)), 'K', decimals=2)} rms at the worst joint; slow disturbance "
        f"{exact(found.disturbance_k, 'K')} over {number(found.disturbance_s / 60, 'min', decimals=0)}"
    )
    if held is not None:
        click.echo(
            f"fitted until {number(held.from_s / 60, 'min', decimals=0)}, the later part is missed by {number(held.rms_k, 'K', decimals=2)} rms, {number(held.worst_k, 'K', decimals=1)} "
            f"at most ({held.worst}); {percent(held.within)} of it inside the 95 % band"
        )
    if json_file is not None:
        _write(json_file, {**found.as_json(held), "runs": [str(path) for path in runs]})
    folder = _folder(robot)
    then = found.at(inputs[-1].loaded_s)
    told = look_ahead(then, from_cold=True) if report is not None or folder is not None else None
    if report is not None and told is not None:
        from openant_tools.thermal.report import fit_report

        write_report(fit_report(found, told, inputs, held), report, runs)
    if folder is not None and told is not None:
        from openant_tools.procedure.finding import keep
        from openant_tools.thermal.finding import thermal_finding, warning_of

        finding = thermal_finding(
            then, told, command=command_line(), recording=folder.relative(runs[-1]), held=held,
            rest=rest_advice(then), warning=warning_of(folder.config()),
        )  # fmt: skip
        mention(f"wrote {keep(finding, folder, folder.relative(runs[-1]))}")
    return 1 if held is not None and held.rms_k > BELIEVED_K else 0


SHOWN = ("case_j_k", "air_w_k", "winding_w_k", "scale", "leg_w_k", "room_c", "exponent", "held_w")


@click.command()
@click.argument("run", type=click.Path(path_type=Path), metavar="RUN")
@click.option(
    "--at", "at_min", type=Number(min=0.5), metavar="MIN",
    help="Know only the run's first MIN minutes.  [default: all of it, looked at from the end of its load]",
)  # fmt: skip
@click.option("--load", "loads", multiple=True, metavar="JOINT=NM", help="Hold this torque instead; repeatable.")
@click.option("--from-cold", is_flag=True, help="From the room's temperature instead of from the run's state.")
@click.option(
    "--whole", is_flag=True, help="Take the mean load of the whole run, not that at its end: a policy's recording."
)
@after_option
@click.option(
    "--derate", is_flag=True, help="Write the rule under which this load can go on into robot.toml, [derating]."
)
@robot_option
@json_option
@report_option
def forecast(
    run: Path,
    at_min: float | None,
    loads: tuple[str, ...],
    from_cold: bool,
    whole: bool,
    after: Path | None,
    derate: bool,
    robot: Path | None,
    json_file: Path | None,
    report: Path | None,
) -> int:
    """When each servo would shut down if this went on, what it could hold, and how long to rest.

    A servo shuts down when its reading passes its own limit. Intervals are 95 %; they are open where the servo may well
    never get there (8 hours are looked ahead).

    \b
      openant thermal forecast soak.mcap --at 10
      openant thermal forecast walk.mcap --whole --from-cold --after fit.json
      openant thermal forecast soak.mcap --load knee_fl=0.6
      openant thermal forecast soak.mcap --derate --robot my-ant

    Exit code 1: a servo is more likely than not to shut down.
    """
    from openant_tools.errors import BadInput
    from openant_tools.thermal.finding import keep_derating, warning_of
    from openant_tools.thermal.fit import Known
    from openant_tools.thermal.forecast import outlook

    inputs = _read(run)
    ahead = outlook(
        inputs, after=None if after is None else Known.read(after), at_s=None if at_min is None else 60 * at_min,
        torque_nm=_torques(loads), whole=whole, from_cold=from_cold,
    )  # fmt: skip
    found, told, rest, rules = ahead.found, ahead.told, ahead.rest, ahead.rules.joints
    since = "from cold" if from_cold else f"from {number(found.inputs.duration_s / 60, 'min', decimals=1)} on"
    click.echo(f"{told.load.words}, {since}:")
    for one in told.joints:
        torque = one.continuous_torque_nm
        hold = "" if torque is None else f"; {number(torque.value, 'N·m', torque.low, torque.high)} for ever"
        if one.hour_torque_nm is not None:
            hold += f", {number(one.hour_torque_nm.value, decimals=2)} for an hour"
        click.echo(f"  {one.words} (now {number(one.temperature_c, '°C', decimals=0)}){hold}")
    click.echo(f"advice: {rest.words}")
    for joint, interval in ahead.cooling.items():
        click.echo(f"  {joint} has cooled {number(interval.value / 60, 'min', decimals=0)} after torque goes off")
    for joint, rule in rules.items():
        click.echo(
            f"  derating {joint}: all of its torque up to {number(rule.start_c, '°C', decimals=0)}, {percent(rule.least)} of it from {number(rule.stop_c, '°C', decimals=0)} on"
        )
    folder = _folder(robot)
    if warning := None if folder is None else warning_of(folder.config()):
        click.echo(warning)
    if derate:
        if folder is None:
            raise BadInput("no robot to write the rule to", remedy="name it with --robot DIR")
        if rules:
            keep_derating(ahead.rules, folder, run, command_line())
            mention(f"wrote {folder.config_file}")
        else:
            mention("no servo needs derating under this load; robot.toml is left as it is")
    if json_file is not None:
        _write(json_file, {**ahead.as_json(), "run": str(run)})
    if report is not None:
        from openant_tools.thermal.report import forecast_report

        shown = None if at_min is None or from_cold else inputs
        write_report(forecast_report(found, told, rest.words, shown), report, [run])
    return 1 if ahead.shuts_down else 0


@click.command()
@click.argument("a", type=click.Path(path_type=Path), metavar="A")
@click.argument("b", type=click.Path(path_type=Path), metavar="[B]", required=False)
@click.option(
    "--joint",
    "joints",
    multiple=True,
    metavar="JOINT[:OTHER]",
    help="Only this joint, or A's against another of B; repeatable.",
)
@click.option("--paper", is_flag=True, help="A against the paper's stress test of the same servo.")
@json_option
@report_option
def compare(
    a: Path, b: Path | None, joints: tuple[str, ...], paper: bool, json_file: Path | None, report: Path | None
) -> int:
    """Two soaks: with and without heat sink, two motors, two dates; or one soak against the paper's curves.

    Rooms and loads differ between soaks: compared is where each servo settles under one torque in a room of 25 °C.

    \b
      openant thermal compare bare.mcap finned.mcap
      openant thermal compare soak.mcap soak.mcap --joint knee_fl:knee_fr
      openant thermal compare stress.mcap --paper
    """
    from openant_tools.errors import BadInput
    from openant_tools.thermal.compare import against_paper
    from openant_tools.thermal.compare import compare as subtract
    from openant_tools.thermal.fit import fit as fit_runs

    if (b is None) == (not paper):
        raise BadInput("name two soaks, or one and --paper", remedy="openant thermal compare A B")
    one = fit_runs([_read(a)])
    content: dict[str, Any] = {"schema": "openant.thermal-compare/1", "a": str(a)}
    if b is None:
        beside = against_paper(one.at(one.inputs.loaded_s))
        click.echo(beside.words)
        content |= beside.as_json()
    else:
        pairs = [(first, second or first) for first, _, second in (pair.partition(":") for pair in joints)]
        differences = subtract(one, fit_runs([_read(b)]), joints=dict(pairs) or None)
        for d in differences:
            click.echo(
                f"{d.joint:9} at {number(d.torque_nm, 'N·m', decimals=2)}: {number(d.a_c.value, decimals=0)} → {number(d.b_c.value, '°C', decimals=0)}, "
                f"{number(d.difference_k.value, 'K', d.difference_k.low, d.difference_k.high, sign=True)}{' *' if d.certain else ''}"
            )
        click.echo("* beyond what either soak leaves open (95 %)")
        content |= {"b": str(b), "joints": [d.as_json() for d in differences]}
    if json_file is not None:
        _write(json_file, content)
    if report is not None:
        from openant_tools.thermal.report import compare_report, paper_report

        page = paper_report(beside, a.name) if b is None else compare_report(differences, a.name, b.name)
        write_report(page, report, [a] if b is None else [a, b])
    return 0


# ---- reading and writing ----


def _read(path: Path) -> Inputs:
    from openant_tools.recording.plausibility import problems
    from openant_tools.recording.tables import read_run
    from openant_tools.thermal.inputs import inputs_of

    run = read_run(path, need=(), plausible=False)
    for problem in problems(run, str(run.path)):
        click.echo(problem, err=True)
    return inputs_of(run)


def _folder(robot: Path | None) -> RobotFolder | None:
    from openant_tools.robot.folder import RobotFolder

    return None if robot is None else RobotFolder.at(robot)


def _torques(loads: tuple[str, ...]) -> dict[str, float]:
    from openant_tools.errors import BadInput

    out = {}
    for text in loads:
        joint, _, number = text.partition("=")
        try:
            out[joint.strip()] = float(number)
        except ValueError:
            out[joint.strip()] = math.nan
        if not math.isfinite(out[joint.strip()]):
            raise BadInput(f"{text!r} is no load", remedy="write --load knee_fl=0.6, in N·m")
    return out


def _write(path: Path, content: dict[str, Any]) -> None:
    from openant_tools.files import json_text, write_text

    write_text(path, json_text(content))
