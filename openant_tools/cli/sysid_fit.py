"""`openant sysid fit`: recordings in, calibrated model out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.log import mention
from openant_tools.cli.options import model_option, report_option, robot_folder, robot_option, tie_option, write_report
from openant_tools.cli.progress import progress_bar
from openant_tools.cli.runs import read_runs, say

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder

__all__ = ["fit"]


@click.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN…")
@model_option
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR")
@click.option(
    "--hold-out",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="RUN",
    help="Judge by this run, once. Repeatable.",
)
@click.option("--joint", "joints", multiple=True, metavar="NAME", help="Fit this joint only. Repeatable.")
@click.option("--kind", "kinds", multiple=True, metavar="KIND", help="Fit this kind of parameter only. Repeatable.")
@click.option("--also", multiple=True, metavar="KIND", help="Fit this kind besides the default ones. Repeatable.")
@click.option("--measured-supply", is_flag=True, help="Gains and torque limits follow the logged voltage.")
@click.option(
    "--no-effects",
    is_flag=True,
    help="Do not try what plain MuJoCo has no feature for, nor play what robot.toml has of it for another model.",
)
@click.option(
    "--parameters",
    "declared",
    type=click.Path(path_type=Path),
    metavar="FILE.toml",
    help="Fit what this file declares, too.",
)
@tie_option
@robot_option
@report_option
def fit(
    runs: tuple[Path, ...],
    model: Path | None,
    out: Path,
    hold_out: tuple[Path, ...],
    joints: tuple[str, ...],
    kinds: tuple[str, ...],
    also: tuple[str, ...],
    measured_supply: bool,
    no_effects: bool,
    declared: Path | None,
    tie: str,
    robot: Path | None,
    report: Path | None,
) -> int:
    """Fit a model to recordings and write calibrated.xml, fit.json and report.html to DIR.

    The runs are left out of the fit in turn, by motion and by gain; a kind of value that does not serve the one left out falls
    back to the given model. Runs given with --hold-out have no part in that: they judge the outcome once, and all of it falls
    back if it is not better. Without, runs left out of fit and choice in turn judge.
    With --robot, calibrated.xml and every value with its provenance go into the robot's folder too; effects that its
    robot.toml has act in the fit as they stand there.

    \b
      openant sysid fit run1.mcap run2.mcap --hold-out run3.mcap --robot my-ant --out fit
      openant sysid fit swing.parquet --model pendulum.xml --out fit

    Kinds of parameters, by default: stiffness, damping (or velocity_gain, whichever the model has), armature,
    coulomb_friction, zero_offset, action_delay; electrical_damping where torque was off for a while; floor_friction and
    contact_softness where the robot stood on the floor. Others by name: actuator_lag, torque_limit, speed_limit, link_mass,
    torso_mass, contact_impedance; and what MuJoCo has no feature for (load_friction, stribeck_friction_static_nm, dead_zone,
    voltage_sag …), which is written to calibrated.effects.toml and into robot.toml, and acts in the environment. Anything
    else in an MJCF with --parameters (docs/identify.md).

    Where what is left is not noise, load_friction is tried by itself; if runs left out are followed better with it, that model
    goes to DIR/with-effects and into the robot's folder, and DIR keeps the best for plain MuJoCo. Exit code 1: nothing beats
    the given model.
    """
    from dataclasses import replace

    from openant_tools import sysid
    from openant_tools.model.of_run import own_model
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.sysid.declared import read_declarations
    from openant_tools.sysid.fit_report import fit_report
    from openant_tools.sysid.result import WITH_EFFECTS

    folder = None if robot is None else RobotFolder.at(robot)
    if folder is not None:
        folder.refuse_if_held()  # now, not after minutes
    recordings, held_out = read_runs(runs), read_runs(hold_out)
    described = folder
    if model is None and any(own_model(run) is None for run in [*recordings, *held_out]):
        described = folder or _robot_here()
    declarations = None if declared is None else read_declarations(declared)
    told = list[str]()

    def tell(line: str) -> None:
        told.append(line)
        say([line])

    with progress_bar("fitting", remaining=False) as progress:
        found = sysid.fit(
            recordings,
            model,
            held_out,
            robot=None if described is None else described.path,
            joints=joints or None,
            kinds=kinds or None,
            also=also,
            measured_supply=measured_supply,
            tie=tie,
            declared=declarations,
            beyond_mujoco=not no_effects,
            tell=tell,
            progress=progress,
        )
        progress(1.0, "writing the report")
        written = sysid.report(found, out, robot=None if folder is None else folder.path)

    if report is not None:
        write_report(fit_report(found), report)
        if found.with_effects:
            write_report(fit_report(found.with_effects), report / WITH_EFFECTS)
    click.echo(sysid.summary(replace(found, notes=tuple(note for note in found.notes if note not in told))))
    accepted = found.accepted or found.with_effects
    if not accepted:
        click.echo("nothing that was fitted beats the given model on held-out runs; calibrated.xml is the given model")
    for path in written:
        mention(f"wrote {path}")
    return 0 if accepted else 1


def _robot_here() -> RobotFolder:
    """The robot of $OPENANT_ROBOT or the working directory, where neither model nor robot was named."""
    from openant_tools.errors import BadInput
    from openant_tools.robot.config import CONFIG_NAME
    from openant_tools.robot.folder import RobotFolder

    here = robot_folder(None, must_exist=False)
    if not (here / CONFIG_NAME).is_file():
        raise BadInput("no model to fit", remedy="name one with --model M.xml, or its robot with --robot DIR")
    return RobotFolder.at(here)
