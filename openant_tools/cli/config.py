"""`openant config`: the robot's configuration."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import json_option, robot_folder, robot_option
from openant_tools.cli.streams import has_terminal
from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number, span

if TYPE_CHECKING:
    from openant_tools.robot.config import Provenance, RobotConfig
    from openant_tools.robot.folder import RobotFolder

__all__ = ["config"]

FAILED = 1


@click.group()
def config() -> None:
    """The robot's configuration, robot.toml: make it, read it over, trade it with the platform's own software.

    \b
      openant config new --kit standard --robot my-ant   a folder with nominal values
      openant config import ant12.json --robot my-ant    from the platform's own file
      openant config check --robot my-ant                everything in it that cannot be
    """


@config.command()
@robot_option
@click.option("--kit", type=click.Choice(["standard", "lite"]), help="[default: standard]")
@click.option("--name", help="What to call the robot. Default: the folder's name.")
@click.option(
    "--from", "source", type=click.Path(path_type=Path), metavar="DIR",
    help="In place of nominal values those of this robot, and its model: the same robot, to be simulated otherwise.",
)  # fmt: skip
def new(robot: Path | None, kit: str | None, name: str | None, source: Path | None) -> None:
    """Make a robot's folder with the nominal values of its kit, or with those of another folder."""
    from openant_tools.robot.folder import RobotFolder, create_robot

    path = robot_folder(robot, must_exist=False)
    if source is None:
        folder = create_robot(path, kit or "standard", name)
        click.echo(f"made {folder.config_file} with the nominal values of the {kit or 'standard'} kit")
        return
    if kit is not None or name is not None:
        raise BadInput("--from is a robot with its own kit and name", remedy="leave --kit and --name out")
    from openant_tools.model.copy import copy_robot

    folder = copy_robot(RobotFolder.at(source), path)
    click.echo(f"made {folder.config_file} as {source} has it, with its model")


@config.command()
@robot_option
@json_option
def check(robot: Path | None, json_file: Path | None) -> int:
    """Read the configuration over and list, a line each, what cannot be. Exit code 1 if there is anything.

    Notes (a key that looks like a slip, two OpenCV that lie over each other) are listed too, but do not fail the check.
    """
    from openant_tools.files import json_text, write_text
    from openant_tools.optional import opencv
    from openant_tools.robot.folder import RobotFolder

    mention(f"note: {opencv().words}")  # which is asked for before there is a robot, too
    folder = RobotFolder.at(robot_folder(robot))
    _, located = folder.check()
    errors = [entry for entry in located if entry.problem.severity == "error"]
    for entry in located:
        click.echo(str(entry) if entry.problem.severity == "error" else f"note: {entry}")
    if json_file:
        problems = [{"line": entry.line, **dataclasses.asdict(entry.problem)} for entry in located]
        write_text(json_file, json_text({"consistent": not errors, "problems": problems}, indent=2))
    if errors:
        return FAILED
    click.echo(f"{folder.config_file} is consistent")
    return 0


@config.command()
@robot_option
@json_option
def show(robot: Path | None, json_file: Path | None) -> None:
    """Print what is known of the robot, and where each value came from."""
    from openant_tools.files import json_text, write_text
    from openant_tools.robot.folder import RobotFolder

    folder = RobotFolder.at(robot_folder(robot))
    configuration = folder.config()
    if json_file:
        write_text(json_file, json_text(dataclasses.asdict(configuration), indent=2, default=str))
    _print(folder, configuration)


@config.command("import")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@robot_option
@click.option(
    "--kit", type=click.Choice(["standard", "lite"]), help="The kit of a new robot; the file does not say. [standard]"
)
def import_(file: Path, robot: Path | None, kit: str | None) -> None:
    """Take over a configuration of the platform's own software (antNN.json).

    Makes the robot's folder where there is none, else changes the values that FILE has. A copy of FILE stays in the
    folder, so that an export gives back what robot.toml has no word for.
    """
    from openant_tools.robot.platform_config import import_platform_config, read_platform_config

    platform = read_platform_config(file)
    folder = import_platform_config(platform, robot_folder(robot, must_exist=False), kit)
    for note in platform.notes:
        click.echo(f"note: {note}")
    click.echo(f"{len(platform.values)} values of {file} stand in {folder.config_file}")


@config.command()
@robot_option
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="Default: print it.")
@click.option("--grid", is_flag=True, help="Round zero offsets to multiples of 45°, as the platform's own maker does.")
@click.option("--to", "kind", type=click.Choice(["platform", "urdf"]), default="platform", show_default=True)
def export(robot: Path | None, out: Path | None, grid: bool, kind: str) -> None:
    """Write the configuration for the platform's own software (antNN.json, NN being the tag on the torso).

    With --to urdf, the robot's calibrated model as a URDF, its meshes in `meshes/` beside it, and a card (NAME.md). What URDF
    cannot hold stands in a comment at its top.
    """
    if kind == "urdf":
        _export_urdf(robot, out, grid)
        return
    from openant_tools.files import json_text, write_text
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.robot.platform_config import export_notes, export_platform_config, imported_object

    folder = RobotFolder.at(robot_folder(robot))
    configuration = folder.config()
    data = export_platform_config(configuration, imported_object(folder), on_grid=grid)
    text = json_text(data, indent=4)
    for note in export_notes(configuration, out, on_grid=grid):
        mention(f"note: {note}")
    if out is None:
        click.echo(text, nl=False)
    else:
        if out.resolve() == folder.config_file.resolve():
            raise BadInput("would replace robot.toml itself", where=out, remedy="name a file antNN.json")
        write_text(out, text)
        click.echo(f"wrote {out}")


def _export_urdf(robot: Path | None, out: Path | None, grid: bool) -> None:
    from openant_tools.exchange.card import card
    from openant_tools.exchange.urdf import write_urdf
    from openant_tools.files import write_text
    from openant_tools.robot.folder import RobotFolder

    if out is None or out.suffix != ".urdf" or grid:
        raise BadInput("a URDF is a file of its own", remedy="name it with --out NAME.urdf, without --grid")
    folder = RobotFolder.at(robot_folder(robot))
    model = folder.model_path()
    missing = write_urdf(model, out)
    notes = [f"URDF cannot hold {line}" for line in missing]
    write_text(out.with_suffix(".md"), card(f"{out.name}, a URDF", folder, [f"`{model.name}`"], notes))
    click.echo(f"wrote {out}; what it cannot hold ({len(missing)}) stands at its top; its card is {out.stem}.md")


def _degrees(value: float) -> str:

    return number(value, "rad", sign=True, decimals=2)


def _source(entry: Provenance | None) -> str:
    if entry is None:
        return ""
    parts = [entry.how]
    if entry.recording:
        parts.append(f"in {entry.recording}")
    if entry.date:
        parts.append(f"on {entry.date:%Y-%m-%d}")
    if entry.low is not None and entry.high is not None:
        parts.append(f"({span(entry.low, entry.high, 'rad')})")
    return " ".join(parts)


def _print(folder: RobotFolder, configuration: RobotConfig) -> None:
    from rich.console import Console
    from rich.table import Table

    # In a pipe there is no width to obey, and a wrapped table is hard to read.
    console = Console(width=None if has_terminal("stdout") else 160)
    facts = Table(show_header=False, box=None, pad_edge=False)
    rows: list[tuple[str, Any]] = [
        ("robot", f"{configuration.name} ({configuration.kit} kit)"),
        ("folder", folder.path),
        ("model", configuration.model),
        ("bus", f"{configuration.ports.bus or 'not known yet'}, {configuration.bus.baud} baud"),
        ("IMU", configuration.ports.imu or "not known yet"),
        ("camera", "not known yet" if configuration.ports.camera == "" else configuration.ports.camera),
        ("control step", exact(configuration.timing.dt_s, "s")),
        ("actions", f"range {configuration.actions.preset!r}"),
        ("measured bounds", f"{len(configuration.observation)} of 22 signals"),
        ("backups", len(list(folder.backups.glob("robot-*.toml")))),
    ]
    for name, value in rows:
        facts.add_row(name, str(value))
    console.print(facts)
    motors = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("joint", "id", "servo", "direction", "zero offset", "limits", "zero offset came from"):
        motors.add_column(column, no_wrap=True)
    for motor in configuration.motors.values():
        motors.add_row(
            motor.joint,
            str(motor.id),
            motor.model,
            number(motor.direction, sign=True),
            _degrees(motor.zero_offset_rad),
            f"{_degrees(motor.min_rad)} … {_degrees(motor.max_rad)}",
            _source(configuration.provenance_of(f"motors.{motor.joint}.zero_offset_rad")),
        )
    console.print()
    console.print(motors)
    for effect in configuration.effects:
        where = effect.joints if isinstance(effect.joints, str) else ", ".join(effect.joints)
        values = ", ".join(f"{name} = {value}" for name, value in effect.parameters.items())
        console.print(f"effect {effect.effect} on {where}: {values}{'' if effect.enabled else ' (off)'}", markup=False)
