"""`openant sysid fit`: recordings in, calibrated model out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.options import model_option, robot_folder, robot_option, tie_option
from openant_tools.cli.progress import progress_bar

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder

__all__ = ["fit"]


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN…")
@model_option
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR")
@click.option(
    "--hold-out", multiple=True, type=click.Path(path_type=Path), metavar="RUN", help="Judge on this run. Repeatable."
)
@click.option("--joint", "joints", multiple=True, metavar="NAME", help="Fit this joint only. Repeatable.")
@click.option("--kind", "kinds", multiple=True, metavar="KIND", help="Fit this kind of parameter only. Repeatable.")
@click.option("--also", multiple=True, metavar="KIND", help="Fit this kind besides the default ones. Repeatable.")
@click.option("--measured-supply", is_flag=True, help="Gains and torque limits follow the logged voltage.")
@click.option(
    "--parameters",
    "declared",
    type=click.Path(path_type=Path),
    metavar="FILE.toml",
    help="Fit what this file declares, too.",
)
@tie_option
@robot_option
def fit(
    runs: tuple[Path, ...],
    model: Path | None,
    out: Path,
    hold_out: tuple[Path, ...],
    joints: tuple[str, ...],
    kinds: tuple[str, ...],
    also: tuple[str, ...],
    measured_supply: bool,
    declared: Path | None,
    tie: str,
    robot: Path | None,
) -> int:
    """Fit a model to recordings and write calibrated.xml, fit.json and report.html to DIR.

    What does not beat the given model on held-out runs falls back to it. Without --hold-out, runs are left out in turn.
    With --robot, calibrated.xml and every value with its provenance go into the robot's folder too; effects that its
    robot.toml has act in the fit as they stand there.

    \b
      openant sysid fit run1.mcap run2.mcap --hold-out run3.mcap --robot my-ant --out fit
      openant sysid fit swing.parquet --model pendulum.xml --out fit

    Kinds of parameters, by default: stiffness, damping (or velocity_gain, whichever the model has), armature,
    coulomb_friction, zero_offset, action_delay; electrical_damping where torque was off for a while; floor_friction and
    contact_softness where the robot stood on the floor. Others by name: actuator_lag, torque_limit, speed_limit, link_mass,
    torso_mass, contact_impedance; and what MuJoCo has no feature for (load_friction, stribeck_friction_static_nm, dead_zone,
    voltage_sag …), which is written to calibrated.effects.toml and into robot.toml, and acts in the environment. Anything else in an MJCF with --parameters (docs/identify.md). Exit code 1: nothing beats
    the given model.
    """
    from openant_tools.recording.tables import read_run
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.sysid.declared import read_declarations
    from openant_tools.sysid.identify import identify
    from openant_tools.sysid.result import write_fit, write_robot

    folder = None if robot is None else RobotFolder.at(robot)
    described = folder
    if model is None:
        described = folder or _robot_here()
        model = described.model_path()
    recordings = [read_run(path) for path in runs]
    held_out = [read_run(path) for path in hold_out]
    with progress_bar("fitting", remaining=False) as tell:
        result = identify(
            recordings,
            model,
            held_out,
            joints=joints or None,
            kinds=kinds or None,
            also=also,
            measured_supply=measured_supply,
            tie=tie,
            declared=None if declared is None else read_declarations(declared),
            effects=() if described is None else described.config().effects,
            progress=tell,
        )
        tell("writing the report", 1.0)
        written = write_fit(result, out)
    if folder is not None and result.accepted:
        write_robot(result, folder)
        written.append(folder.config_file)

    width = max(len(value.name) for value in result.values)
    for value in result.values:
        click.echo(
            f"{value.name:{width}}  {value.value:10.5g}  [{value.low:.4g}, {value.high:.4g}] {value.unit:10} {value.words}"
        )
    judged = "runs left out in turn" if result.in_turn else "held-out runs"
    click.echo(
        f"error on {judged}, full run: {1e3 * result.before.full:.2f} → {1e3 * result.after.full:.2f} mrad; "
        f"0.5 s: {1e3 * result.before.horizon:.2f} → {1e3 * result.after.horizon:.2f} mrad; "
        f"floor {1e3 * result.floor:.2f} mrad"
    )
    for note in result.notes:
        click.echo(note)
    if not result.accepted:
        click.echo("nothing that was fitted beats the given model on held-out runs; calibrated.xml is the given model")
    for path in written:
        click.echo(f"wrote {path}", err=True)
    return 0 if result.accepted else 1


def _robot_here() -> RobotFolder:
    """The robot of $OPENANT_ROBOT or the working directory, where neither model nor robot was named."""
    from openant_tools.errors import BadInput
    from openant_tools.robot.config import CONFIG_NAME
    from openant_tools.robot.folder import RobotFolder

    here = robot_folder(None, must_exist=False)
    if not (here / CONFIG_NAME).is_file():
        raise BadInput("no model to fit", remedy="name one with --model M.xml, or its robot with --robot DIR")
    return RobotFolder.at(here)
