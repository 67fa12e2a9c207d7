"""`openant rec`: look into recordings, make torn ones whole, turn them into tables and back."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import json_option
from openant_tools.cli.progress import progress_bar
from openant_tools.errors import BadInput
from openant_tools.numbers import number, percent, span

if TYPE_CHECKING:
    from openant_tools.recording.run import Run
    from openant_tools.recording.summary import RunSummary

__all__ = ["rec"]

RUN = click.Path(path_type=Path)
#: what `rec export` makes → how its files end
SUFFIXES = {"parquet": ".parquet", "csv": ".csv", "foxglove": ".foxglove.mcap", "rrd": ".rrd"}
#: and those that become one dataset
DATASETS = ("lerobot", "minari")


@click.group()
def rec() -> None:
    """Recordings: info, repair, export, import, view.

    A RUN is a native recording (NAME.mcap, which survives a kill or a power cut) or a table (NAME.parquet or NAME.csv
    with its facts in NAME.json), so that logs of other software can be used everywhere.
    """


@rec.command(short_help="Show what a run holds: signals, rate, gaps, loss, facts.")
@click.argument("run", type=RUN)
@click.option(
    "--model", type=RUN, metavar="M.xml", help="Compare with this model. Default: the one that the run names."
)
@json_option
def info(run: Path, model: Path | None, json_file: Path | None) -> None:
    """Show what RUN holds: joints, signals, rate and jitter, gaps, loss, facts.

    What is not plausible in it, by itself or beside its model, is noted; `sysid fit` and `gap` refuse some of it.
    """
    from dataclasses import asdict

    from openant_tools.files import json_text, write_text
    from openant_tools.recording.facts import facts_to_json
    from openant_tools.recording.reader import read_recording
    from openant_tools.recording.summary import summarize
    from openant_tools.recording.tables import find_run, read_table

    path = find_run(run)
    more: dict[str, Any] = {}
    if path.suffix == ".mcap":
        recording = read_recording(path)
        read = recording.run
        more = {
            "damage": recording.damage,
            "started": recording.started,
            "imu_samples": len(recording.imu.t),
            "pose_samples": len(recording.pose.t),
            "pictures": len(recording.pictures.t),
            "picture_bytes": int(recording.pictures.columns["bytes"].sum()),
            "events": list(recording.events),
            "has_config": recording.config is not None,
        }
    else:
        read = read_table(path, plausible=False)
    summary = summarize(read)
    notes = list(_notes(read, model))
    if json_file is not None:
        facts = {"facts": json.loads(facts_to_json(read.facts))}
        result = {"path": str(path)} | asdict(summary) | facts | more | {"notes": notes}
        write_text(json_file, json_text(result))
    for line in _lines(path, read, summary, more):
        click.echo(line)
    for note in notes:
        click.echo(f"  note: {note}")


@rec.command(short_help="Make a torn recording whole.")
@click.argument("run", type=RUN)
@click.option("--out", type=RUN, default=None, metavar="FILE", help="Where to; default: in place, the old one kept.")
def repair(run: Path, out: Path | None) -> None:
    """Make a torn recording whole: every whole record before the tear, with a summary for viewers."""
    from openant_tools.recording.repair import repair as repair_recording
    from openant_tools.recording.tables import find_run

    done = repair_recording(find_run(run), out)
    if done.damage is None:
        click.echo(f"{done.path}: whole already, {done.messages} records; nothing was written")
    else:
        click.echo(f"{done.path}: whole again, {done.messages} records kept ({done.damage})")
        if done.original is not None:
            click.echo(f"the torn file is kept as {done.original}")


@rec.command(short_help="Write runs as tables, for Foxglove and Rerun, or as datasets.")
@click.argument("runs", type=RUN, nargs=-1, required=True, metavar="RUN...")
@click.option("--to", "kind", type=click.Choice([*SUFFIXES, *DATASETS]), default="parquet", show_default=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="The folder to write to.",
)
@click.option(
    "--model", type=RUN, metavar="M.xml", help="The robot that viewers draw. Default: the run's own, else its robot's."
)
def export(runs: tuple[Path, ...], kind: str, out: Path, model: Path | None) -> None:
    """Write RUN into DIR, in SI units.

    \b
      parquet, csv   NAME.parquet or NAME.csv, a table, with its facts in NAME.json
      foxglove       NAME.foxglove.mcap: joint states, transforms, the robot, IMU, tracker, events and findings
      rrd            NAME.rrd: the same for Rerun
      lerobot        DIR is one LeRobot dataset (v3.0), an episode each RUN
      minari         DIR is one Minari dataset; a RUN may be the folder of a training run (SAC), too
    """
    if kind in DATASETS:
        from openant_tools.exchange.lerobot_write import write_lerobot
        from openant_tools.exchange.minari_write import write_minari

        if model is not None:
            raise BadInput("--model is what viewers draw", remedy="leave it out")
        episodes, steps = (write_lerobot if kind == "lerobot" else write_minari)(runs, out)
        click.echo(
            f"{out}: {episodes} episodes, {steps} {'frames' if kind == 'lerobot' else 'steps'}; its card is README.md"
        )
        return
    if kind in ("foxglove", "rrd"):
        for name in runs:
            _for_viewers(name, kind, out, model)
        return
    from openant_tools.recording.tables import read_run, write_table

    if model is not None:
        raise BadInput("--model is what viewers draw", remedy="add --to foxglove or --to rrd")
    for name in runs:
        run = read_run(name, need=())
        path = out / f"{run.name}{SUFFIXES[kind]}"
        write_table(run, path)
        click.echo(f"{path}: {len(run.t)} rows, {len(run.columns)} columns; facts in {path.with_suffix('.json').name}")


def _for_viewers(name: Path, kind: str, out: Path, model: Path | None) -> None:
    from openant_tools.exchange.source import read_source

    source = read_source(name, model)
    path = out / f"{source.run.name}{SUFFIXES[kind]}"
    if kind == "foxglove":
        from openant_tools.exchange.foxglove_file import write_foxglove

        what = f"{write_foxglove(source, path)} messages"
    else:
        from openant_tools.exchange.rerun_file import log_source, rerun_stream

        stream = rerun_stream(source.run.name, path)
        log_source(stream, source)
        stream.disconnect()
        what = f"{len(source.run.t)} rows"
    drawn = "" if source.scene is not None else "; the robot is not drawn, since nobody names its model → --model M.xml"
    click.echo(f"{path}: {what}{drawn}")


@rec.command(short_help="Open a run in Rerun: the robot, and its simulation over it.")
@click.argument("run", type=RUN)
@click.option("--model", type=RUN, metavar="M.xml", help="Default: the run's own, else its robot's.")
@click.option(
    "--effects",
    type=RUN,
    metavar="FILE.toml",
    help="What acts beside the model. Default: the robot's, where the model is its own.",
)
@click.option("--full", is_flag=True, help="Simulate from the run's start, instead of anew every half second.")
@click.option("--out", type=RUN, metavar="FILE.rrd", help="Write a file for Rerun instead of opening it.")
def view(run: Path, model: Path | None, effects: Path | None, full: bool, out: Path | None) -> None:
    """Open RUN in Rerun: the measured robot, the simulated one over it in orange, and the gap of each joint as a curve."""
    from openant_tools.cli.runs import checked, effects_of
    from openant_tools.exchange.rerun_file import log_gap, log_source, rerun_stream
    from openant_tools.exchange.source import read_source
    from openant_tools.gap.measure import measure
    from openant_tools.model.gap import HORIZON_S

    if out is not None and out.suffix != ".rrd":
        raise BadInput("a file for Rerun is .rrd", where=out, remedy="name it NAME.rrd")
    source = read_source(run, model)
    if source.scene is None:
        raise BadInput("nobody names the model of this robot", where=run, remedy="add --model M.xml")
    path, folder = source.scene.plant.path, None if source.folder is None else source.folder.path
    entries = effects_of([source.run], path, model, folder, effects)
    joints = source.scene.plant.joints
    (checked_run,) = checked([source.run], path, joints, entries)
    played = measure([checked_run], path, joints, None if full else HORIZON_S, entries[0]).played[0]
    if out is None:
        _need_screen()
    stream = rerun_stream(source.run.name, out)
    log_source(stream, source)
    log_gap(stream, source, dict(zip(joints, played.simulated["pos"].T, strict=True)))
    stream.disconnect()
    if out is not None:
        click.echo(f"{out}: open it with `rerun {out}`")


def _need_screen() -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise BadInput(
            "there is no screen here to open a window on", remedy="add --out FILE.rrd, and open that where there is one"
        )


@rec.command(name="import", short_help="Make a recording of a table, or tables of a LeRobot dataset.")
@click.argument("source", type=RUN)
@click.option("--from", "kind", type=click.Choice(["lerobot"]), help="What SOURCE is; default: a table of ours.")
@click.option(
    "--calibration", type=RUN, metavar="FILE", help="LeRobot's of the robot: for normalised units and grippers."
)
@click.option("--joints", "names", multiple=True, metavar="THEIRS=OURS", help="A joint's name here. Repeatable.")
@click.option(
    "--units",
    type=click.Choice(["degrees", "normalised", "radians"]),
    help="Of LeRobot's joints; default: what their numbers show.",
)
@click.option("--out", type=RUN, required=True, help="The recording (NAME.mcap), or the folder of tables, to make.")
def import_(
    source: Path, kind: str | None, calibration: Path | None, names: tuple[str, ...], units: str | None, out: Path
) -> None:
    """Make a native recording of the table SOURCE, so that viewers (Foxglove, Rerun, PlotJuggler) open it.

    With --from lerobot, SOURCE is the folder of a LeRobot dataset: each episode becomes a table in the folder --out.
    """
    if kind == "lerobot":
        _import_lerobot(source, calibration, names, units, out)
        return
    if calibration is not None or names or units is not None:
        raise BadInput("--calibration, --joints and --units are of LeRobot's datasets", remedy="add --from lerobot")
    from openant_tools.recording.convert import import_run
    from openant_tools.recording.tables import read_run

    run = read_run(source, need=())
    with progress_bar() as progress:
        path = import_run(run, out, progress=progress)
    click.echo(f"{path}: {len(run.t)} rows of {', '.join(run.joints)}")


def _import_lerobot(root: Path, calibration: Path | None, names: tuple[str, ...], units: Any, out: Path) -> None:
    from openant_tools.exchange.lerobot_import import convert, read_conversion
    from openant_tools.recording.tables import write_table

    rename = {}
    for pair in names:
        theirs, _, ours = pair.partition("=")
        if not theirs or not ours or "=" in ours or not ours.isprintable():
            raise BadInput(f"--joints {pair}", remedy="write THEIRS=OURS, and repeat the option for each joint")
        rename[theirs] = ours
    if out.exists() and not out.is_dir():
        raise BadInput(
            "this is a file", where=out, remedy="name a folder with --out: each episode becomes a table there"
        )
    conversion = read_conversion(root, calibration, rename, units)
    for remark in conversion.remarks:
        mention(remark)
    for run in convert(conversion):
        path = out / f"{run.name}.parquet"
        write_table(run, path)
        click.echo(
            f"{path}: {len(run.t)} rows over {number(run.duration_s, 's', decimals=1)} of {', '.join(run.joints)}"
        )


def _notes(run: Run, model: Path | None) -> Iterator[str]:
    """What is not plausible in a run, a line each."""
    from openant_tools.errors import BadInput
    from openant_tools.model.of_run import own_model
    from openant_tools.model.plant import load_plant, setup_of
    from openant_tools.recording.plausibility import problems
    from openant_tools.sysid.rules import findings

    impossible = list(problems(run, ""))
    for problem in impossible:
        yield str(problem)
    joints = [joint for joint in run.joints if run.has("cmd", [joint]) and run.has("pos", [joint])]
    source, plant = model or own_model(run), None
    if source is not None:
        try:
            joints = [joint for joint in load_plant(source).joints if joint in joints]
            plant = load_plant(source, joints, setup_of(run.facts.setup)) if joints else None
        except BadInput as error:
            yield str(error)
    # What is impossible cannot be simulated either.
    for found in findings(run, joints, None if impossible else plant):
        yield found.words


def _lines(path: Path, run: Run, summary: RunSummary, more: dict[str, Any]) -> list[str]:
    from openant_tools.recording.summary import words_of_pictures

    facts = run.facts
    lines = [
        str(path),
        f"  {summary.rows} rows over {number(summary.duration_s, 's', decimals=2)}, {number(summary.rate_hz, 'Hz', decimals=1)} "
        f"(a row every {number(1e3 * summary.period_s, 'ms', decimals=2)}; 98 % within {number(1e3 * summary.period_low_s, decimals=2)} to "
        f"{number(1e3 * summary.period_high_s, 'ms', decimals=2)}, longest {number(1e3 * summary.period_longest_s, 'ms', decimals=2)})",
    ]
    if more.get("damage"):
        lines.append(f"  DAMAGED: {more['damage']} → `openant rec repair {path}`")
    for gap in summary.gaps[:5]:
        lines.append(
            f"  gap of {number(gap.duration_s, 's')} at t = {number(gap.t, 's', decimals=3)} (row {gap.row + 1})"
        )
    if len(summary.gaps) > 5:
        lines.append(f"  … and {len(summary.gaps) - 5} more gaps")
    width = max(len(joint.joint) for joint in summary.joints)
    for joint in summary.joints:
        reach = "" if joint.pos_low is None else span(joint.pos_low, joint.pos_high, "rad", decimals=1)
        errors = ", ".join(f"{count} {word}" for word, count in joint.errors.items())
        lost = f"{percent(joint.lost, decimals=2)} lost" + (f" ({errors})" if errors else "")
        lines.append(
            f"  {joint.joint:<{width}}  {joint.motor or '–':<14}  {reach:<22}  {lost:<14}  {' '.join(joint.signals)}"
        )
    if summary.body:
        lines.append(f"  body: {' '.join(summary.body)}")
    if summary.other:
        lines.append(f"  other columns: {' '.join(summary.other)}")
    for key in ("setup", "protocol", "repeat_of", "model", "supply_v", "ambient_c", "heading_rad", "notes"):
        value = getattr(facts, key)
        if value is not None:
            lines.append(f"  {key}: {value}")
    if facts.registers:
        count = sum(len(table) for table in facts.registers.values())
        lines.append(f"  registers: {count} settings of {len(facts.registers)} servos")
    if more:
        lines.append(
            f"  started {more['started']['wall']}; {more['imu_samples']} IMU samples, {more['pose_samples']} poses, "
            f"{words_of_pictures(more['pictures'], more['picture_bytes'], run.duration_s)}, "
            f"{len(more['events'])} events, {'with' if more['has_config'] else 'without'} the robot's config"
        )
    return lines
