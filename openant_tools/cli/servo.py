"""`openant servo`: what a servo's registers come to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from openant_tools.cli.options import POSITIVE, Number, json_option
from openant_tools.errors import BadInput
from openant_tools.numbers import exact, literal, number, percent

if TYPE_CHECKING:
    from openant_tools.robot.servo_gains import Beside, Conversion

__all__ = ["servo"]


class Counts(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.5 on
    """A register's value: a whole number."""

    name = "counts"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        from openant_tools.robot.registers import PWM_FULL

        try:
            return int(str(value))
        except ValueError:
            option = param.opts[0] if param is not None else "it"
            share = Number().convert(value, param, ctx)
            remedy = "give it a whole number, as the register holds it"
            if option == "--pwm-limit" and 0 < share <= 1:
                remedy = f"it counts to {PWM_FULL}: for {percent(share)} give {number(share * PWM_FULL, decimals=0)}"
            raise BadInput(f"{option} {value} is no count", remedy=remedy) from None


COUNTS = Counts()


@click.group()
def servo() -> None:
    """A servo by its data sheet and its registers.

    \b
      openant servo gains --motor XM430-W350 --supply 12             what it has as delivered
      openant servo gains --motor XL330-M288 --supply 5 --kp 2       the registers for a wanted stiffness
    """


@servo.command("gains")
@click.option("--motor", required=True, metavar="MODEL", help="Such as XM430-W350 or MX-64, or its model number.")
@click.option(
    "--supply", "supply_v", type=POSITIVE, metavar="V",
    help="At the servo. Default: the one that its maker recommends.",
)  # fmt: skip
@click.option("--kp", type=POSITIVE, metavar="N·m/rad", help="Wanted stiffness.")
@click.option("--kv", type=Number(0.0), metavar="N·m·s/rad", help="Wanted velocity gain.")
@click.option("--forcerange", "force_nm", type=POSITIVE, metavar="N·m", help="Wanted limit of torque.")
@click.option("--position-p", type=COUNTS, metavar="N", help="Register position_p_gain (84). Default: as delivered.")
@click.option("--position-i", type=COUNTS, metavar="N", help="Register position_i_gain (82). Default: as delivered.")
@click.option("--position-d", type=COUNTS, metavar="N", help="Register position_d_gain (80). Default: as delivered.")
@click.option(
    "--pwm-limit",
    type=COUNTS,
    metavar="N",
    help="Register pwm_limit (36), of 885. Default: as delivered.",
)
@click.option(
    "--back-emf", type=click.Choice(["kv", "joint"]), default="kv", show_default=True,
    help="Where the model has the servo's back-EMF: in kv, or in the joint's damping.",
)  # fmt: skip
@click.option(
    "--robot", type=click.Path(path_type=Path), metavar="DIR",
    help="Show what was identified of this robot beside; supply and PWM limit are its own where they are not given.",
)  # fmt: skip
@json_option
def gains_(
    motor: str,
    supply_v: float | None,
    kp: float | None,
    kv: float | None,
    force_nm: float | None,
    position_p: int | None,
    position_i: int | None,
    position_d: int | None,
    pwm_limit: int | None,
    back_emf: Literal["kv", "joint"],
    robot: Path | None,
    json_file: Path | None,
) -> None:
    """Dynamixel registers as numbers of an MJCF `<position>` actuator, and wanted numbers as registers.

    P gain ↔ kp, D gain ↔ kv, PWM limit ↔ forcerange, each from what is given, at the supply; what is not given is as the servo is
    delivered. Every constant is printed with where it comes from. Where the manual and a measurement differ both are printed,
    and which of them is used.

    \b
      openant servo gains --motor XM430-W350 --supply 12 --position-p 400 --pwm-limit 442
      openant servo gains --motor XL430-W250 --supply 11.1 --kp 8 --kv 0.4 --forcerange 1
      openant servo gains --motor XM430-W350 --robot my-ant            beside what was identified

    Writes nothing to a servo.
    """
    from openant_tools.files import json_text, write_text
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.robot.gain_models import Registers, gain_model
    from openant_tools.robot.kit import KITS
    from openant_tools.robot.registers import PWM_FULL
    from openant_tools.robot.servo_gains import Wanted, beside, conversion

    for wanted_option, wanted, register_option, register in (
        ("--kp", kp, "--position-p", position_p), ("--kv", kv, "--position-d", position_d),
        ("--forcerange", force_nm, "--pwm-limit", pwm_limit),
    ):  # fmt: skip
        if wanted is not None and register is not None:
            raise BadInput(
                f"{wanted_option} and {register_option} say the same", remedy="give one: the other comes out of it"
            )
    model = gain_model(motor)
    folder = RobotFolder.at(robot) if robot is not None else None
    config = folder.config() if folder else None
    own = config if config and any(one.model == model.name for one in config.motors.values()) else None
    supply, whose = supply_v, ""
    if supply is None and own:
        supply, whose = KITS[own.kit].supply_v, f", as the {own.kit} kit has"
    elif supply is None:
        supply, whose = model.nominal_voltage_v, ", as its maker recommends"
    factory = model.factory
    limit = factory.pwm_limit if own is None else round(own.bus.pwm_limit * PWM_FULL)
    base = Registers(
        factory.position_p if position_p is None else position_p,
        factory.position_i if position_i is None else position_i,
        factory.position_d if position_d is None else position_d,
        limit if pwm_limit is None else pwm_limit,
    )
    result = conversion(model, base, Wanted(kp, kv, force_nm), supply, back_emf)
    given = {"position_p": position_p, "position_i": position_i, "position_d": position_d, "pwm_limit": pwm_limit}
    origins = {name: "as delivered" if count is None else "given" for name, count in given.items()}
    if own is not None and pwm_limit is None:
        origins["pwm_limit"] = "the robot's"
    rows = beside(result, folder) if folder else []
    click.echo(f"{model.name} at {exact(supply, 'V')}{whose}")
    _show(result, origins)
    if folder and config:
        click.echo(f"beside what was identified of {folder.path}:")
        _show_beside(rows, model.name, {motor.model for motor in config.motors.values()})
    _show_constants(result)
    if json_file:
        content = result.as_json()
        if folder:
            content["joints"] = _by_joint(rows)
        write_text(json_file, json_text(content, indent=2))


def _show(result: Conversion, origins: dict[str, str]) -> None:
    from openant_tools.robot.registers import PWM_FULL

    registers, mjcf, wanted = result.registers, result.mjcf, result.wanted
    parts = f"{_for_mjcf(result.back_emf_damping)} back-EMF + {_for_mjcf(result.derivative_damping)} of the D gain"
    if result.back_emf == "joint":
        parts = f"of the D gain; back-EMF {_for_mjcf(mjcf.damping)} in the joint's damping"
    reached = "" if mjcf.saturates_at_rad is None else f"; kp reaches it at {number(mjcf.saturates_at_rad, 'rad')}"
    duty = f"{percent(registers.pwm_limit / PWM_FULL, decimals=1)} of full duty{reached}"
    integral = number(result.ki, "N·m/(rad·s)") if registers.position_i else "-"
    rows = (
        ("position_p", registers.position_p, wanted.kp, "kp", f"{_for_mjcf(mjcf.kp)} N·m/rad",
         f"by a P divisor of {exact(result.model.p_divisor)}"),
        ("position_d", registers.position_d, wanted.kv, "kv", f"{_for_mjcf(mjcf.kv)} N·m·s/rad", parts),
        ("position_i", registers.position_i, None, "", integral, "no counterpart in <position>"),
        ("pwm_limit", registers.pwm_limit, wanted.force_nm, "forcerange", f"±{_for_mjcf(mjcf.force_nm)} N·m", duty),
    )  # fmt: skip
    for register, count, asked, name, value, words in rows:
        origin = origins[register] if asked is None else f"for {exact(asked)}, rounded"
        click.echo(f"  {register:10} {count:6}  {origin:20}  {name:10} {value:18}  {words}")
    for line in mjcf.lines:
        click.echo(f"  {line}")
    if len(result.by_divisor) > 1:
        click.echo("the P divisor is told differently:")
        for k, (divisor, p, kp) in enumerate(result.by_divisor):
            used = "used above" if k == 0 else "not used"
            click.echo(
                f"  by {exact(divisor.value)} ({used}) position_p {p} is kp {_for_mjcf(kp)} N·m/rad; {divisor.source}"
            )


def _for_mjcf(value: float) -> str:
    """With the digits that are worth typing into a model."""
    return literal(value, 4)


def _show_constants(result: Conversion) -> None:
    from openant_tools.robot.servo_gains import constants

    told, before = constants(result.model, result.supply_v), ""
    for used, heading in ((True, "used:"), (False, "not used, for comparison:")):
        click.echo(heading)
        for one in told:
            if one.used == used:
                figure = one.figure
                words = _for_mjcf(figure.value)
                name = "" if one.quantity == before else one.quantity
                unit = "" if figure.unit == "1" else figure.unit
                click.echo(f"  {name:19} {words:>7} {unit:9} {figure.source}")
                before = one.quantity
    for note in result.notes:
        click.echo(f"note: {note}")


def _show_beside(rows: list[Beside], model: str, has: set[str]) -> None:
    units = {"kp": "N·m/rad", "kv": "N·m·s/rad", "forcerange": "N·m"}
    for row in rows:
        click.echo(
            f"  {row.joint:8} {row.name:10} data sheet {_for_mjcf(row.sheet):7} identified {number(row.value, low=row.low, high=row.high)} "
            f"{units[row.name]} ({row.how})"
        )
    if model not in has:
        click.echo(f"  no joint of it has an {model}; it has {', '.join(sorted(has))}")
    elif not rows:
        click.echo("  nothing yet: `openant sysid fit RUN --robot DIR` puts what it finds into robot.toml")
    else:
        click.echo(
            "  kv with all that brakes in proportion to speed, in the actuator or the joint; identified with the gains that "
            "the recording had"
        )


def _by_joint(rows: list[Beside]) -> dict[str, Any]:
    joints: dict[str, Any] = {}
    for row in rows:
        joints.setdefault(row.joint, {})[row.name] = {
            "data_sheet": row.sheet,
            "identified": row.value,
            "low": row.low,
            "high": row.high,
            "how": row.how,
        }
    return joints
