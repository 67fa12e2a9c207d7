"""`openant sysid torque | scale | tilt`: the bench procedures of the Open Ant paper."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.options import json_option, robot_option
from openant_tools.cli.sysid_record import robot_of

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.sysid.bench.finding import Finding

__all__ = ["ANGLE", "torque"]


class Angle(click.ParamType[float]):
    """An angle in rad, or in degrees as `45deg` or `45°`."""

    name = "angle"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, int | float):
            return float(value)
        match = re.fullmatch(r"\s*([-+]?[0-9.]+(?:e[-+]?\d+)?)\s*(rad|deg|°)?\s*", str(value), re.IGNORECASE)
        try:
            number = float(match[1]) if match else math.nan
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or match is None:
            self.fail(f"{value!r} is no angle; write 0.785 (rad) or 45deg", param, ctx)
        return math.radians(number) if (match[2] or "").lower() in ("deg", "°") else number


ANGLE = Angle()


@click.command()
@click.option("--kit", type=click.Choice(["standard", "lite"]), help="Mass, knees and supply of a kit.")
@robot_option
@click.option("--servo", metavar="MODEL", help="Knee servo, such as XL430-W250-T. Default: the kit's or robot's.")
@click.option("--mass", "mass_kg", type=float, metavar="KG", help="Of the whole robot. Default: the kit's, as weighed.")
@click.option("--legs", type=int, multiple=True, metavar="N", help="In stance; repeatable. Default: 4, 3 and 2.")
@click.option(
    "--angle", "angles", type=ANGLE, multiple=True, metavar="RAD",
    help="Of the lower leg from the vertical, or 45deg; repeatable. Default: the home stand's 40° and the paper's 45°.",
)  # fmt: skip
@click.option(
    "--length", "length_m", type=float, metavar="M", help="From the knee's axis to the ground. Default: 0.159."
)
@click.option("--supply", "supply_v", type=float, metavar="V", help="At the servos. Default: the kit's.")
@click.option("--pwm-limit", type=float, metavar="SHARE", help="Share of full duty. Default: the robot's, else 0.5.")
@json_option
def torque(
    kit: str | None,
    robot: Path | None,
    servo: str | None,
    mass_kg: float | None,
    legs: tuple[int, ...],
    angles: tuple[float, ...],
    length_m: float | None,
    supply_v: float | None,
    pwm_limit: float | None,
    json_file: Path | None,
) -> int:
    """What the knees must bear against what their servos can hold.

    τ = (m g / n) L sin θ at each of n legs in stance, beside the servo's nominal torque (what it bears for long) and its
    stall torque at the PWM limit and supply (what it can give at all).

    \b
      openant sysid torque --kit lite
      openant sysid torque --robot my-ant --mass 1.45 --legs 2 --angle 50deg
      openant sysid torque --servo XM430-W210-T --mass 1.2 --supply 12

    Exit code 1: a knee works beyond what it can hold.
    """
    from openant_tools.robot.kit import HOME_RAD, PLATFORM_PWM_LIMIT
    from openant_tools.robot.kit import kit as kit_by_name
    from openant_tools.robot.servo import servo_model
    from openant_tools.sysid.bench.knee_torque import (
        KNEE_TO_GROUND_M,
        LEGS_IN_STANCE,
        knee_loads,
        torque_finding,
    )

    folder = None if kit else robot_of(robot, needed=robot is not None)
    config = folder.config() if folder else None
    parts = kit_by_name(kit or (config.kit if config else "standard"))
    if servo:
        own = servo_model(servo)
        knees = [(own.name, own)]
        supply = supply_v or own.nominal_voltage_v
    else:
        models = {m.servo.name: m.servo for m in config.motors.values() if m.joint.startswith("knee")} if config else {}
        knees = list(models.items()) or [(parts.knee, parts.servo("knee"))]
        supply = supply_v or parts.supply_v
    mass = parts.total_mass_kg if mass_kg is None else mass_kg
    length = KNEE_TO_GROUND_M if length_m is None else length_m
    limit = pwm_limit if pwm_limit is not None else config.bus.pwm_limit if config else PLATFORM_PWM_LIMIT
    loads = knee_loads(
        knees,
        mass,
        legs or LEGS_IN_STANCE,
        angles or (math.pi / 2 + HOME_RAD["knee"], math.pi / 4),
        supply_v=supply,
        pwm_limit=limit,
        length_m=length,
    )
    finding = torque_finding(loads, mass, length, supply, limit, _command())
    click.echo(f"{mass:g} kg, {length:g} m from knee to ground, {supply:g} V, PWM limit {limit:.0%}")
    click.echo("knee           legs  from vertical   must bear   nominal   stall at limit")
    for load in loads:
        mark = {"holds": "", "heats": "  heats: beyond nominal", "gives way": "  gives way"}[load.verdict]
        click.echo(
            f"{load.servo:13}  {load.legs:4}  {load.angle_rad:.3f} rad {math.degrees(load.angle_rad):3.0f}°  "
            f"{load.torque_nm:6.2f} N·m  {load.nominal_nm:4.2f} N·m   {load.limit_nm:10.2f} N·m{mark}"
        )
    return _conclude(finding, folder if robot is not None else None, json_file)


def _command() -> str:
    return "openant sysid " + str(click.get_current_context().info_name)


def _conclude(finding: Finding, folder: RobotFolder | None, json_file: Path | None) -> int:
    """Print what was found, write it where it belongs, and say by the exit code whether it is well."""
    from openant_tools.files import write_text
    from openant_tools.sysid.bench.finding import keep

    click.echo(finding.what)
    if finding.next_action:
        click.echo(f"→ {finding.next_action}")
    if folder is not None:
        click.echo(f"wrote {keep(finding, folder)}", err=True)
    if json_file:
        content: Mapping[str, Any] = finding.as_json()
        write_text(json_file, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    return 0 if finding.ok else 1
