"""`openant sysid torque | scale | tilt`: the bench procedures of the Open Ant paper."""

from __future__ import annotations

import math
import re
import select
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.hardware import Moving, engine_config, may_move, port_option, robot_of, yes_option
from openant_tools.cli.options import POSITIVE, SECONDS, Number, json_option, report_option, robot_option, write_report
from openant_tools.cli.virtual_for_command import virtual_option

if TYPE_CHECKING:
    from openant_tools.procedure.finding import Finding
    from openant_tools.robot.folder import RobotFolder

__all__ = ["ANGLE", "scale", "tilt", "torque"]


class Angle(click.ParamType):  # type: ignore[type-arg]  # generic from click 8.5 on
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
@click.option(
    "--mass", "mass_kg", type=POSITIVE, metavar="KG", help="Of the whole robot. Default: the kit's, as weighed."
)
@click.option("--legs", type=int, multiple=True, metavar="N", help="In stance; repeatable. Default: 4, 3 and 2.")
@click.option(
    "--angle", "angles", type=ANGLE, multiple=True, metavar="RAD",
    help="Of the lower leg from the vertical, or 45deg; repeatable. Default: the home stand's 40° and the paper's 45°.",
)  # fmt: skip
@click.option(
    "--length", "length_m", type=POSITIVE, metavar="M", help="From the knee's axis to the ground. Default: 0.159."
)
@click.option("--supply", "supply_v", type=POSITIVE, metavar="V", help="At the servos. Default: the kit's.")
@click.option(
    "--pwm-limit",
    type=Number(0.0, 1.0, min_open=True),
    metavar="SHARE",
    help="Share of full duty. Default: the robot's, else 0.5.",
)
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


@click.command(cls=Moving)
@click.option("--joint", default="knee_fl", show_default=True, help="Whose stiffness.")
@click.option(
    "--readings", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="CSV of deflection (rad), grams, instead of typing them; without --port or --virtual no robot is needed.",
)  # fmt: skip
@robot_option
@virtual_option
@port_option
@click.option("--pose", type=ANGLE, metavar="RAD", help="Joint angle where the foot just touches. Default: home.")
@click.option(
    "--step", "step_rad", type=ANGLE, default=0.02, show_default=True, metavar="RAD", help="Deflection a step."
)
@click.option("--steps", default=5, show_default=True, metavar="N", help="How many.")
@click.option("--up", is_flag=True, help="Press in the positive direction. Default: a knee presses its foot down.")
@click.option(
    "--length", "length_m", type=POSITIVE, metavar="M", help="Knee's axis to the foot's contact. Default: 0.159."
)
@click.option("--arm", "arm_m", type=POSITIVE, metavar="M", help="Lever arm of the force, if you measured it instead.")
@click.option("--servo", metavar="MODEL", help="Default: the robot's, else XM430-W350-T.")
@click.option("--p-gain", type=POSITIVE, metavar="P", help="position_p_gain, without a robot. Default: the factory's.")
@click.option("--supply", "supply_v", type=POSITIVE, metavar="V", help="Without a robot. Default: the servo's nominal.")
@click.option(
    "--pwm-limit",
    type=Number(0.0, 1.0, min_open=True),
    metavar="SHARE",
    help="Without a robot. Default: the robot's, else 0.5.",
)
@yes_option
@json_option
@report_option
def scale(
    joint: str,
    readings: Path | None,
    robot: Path | None,
    virtual_source: str | None,
    port: str | None,
    pose: float | None,
    step_rad: float,
    steps: int,
    up: bool,
    length_m: float | None,
    arm_m: float | None,
    servo: str | None,
    p_gain: float | None,
    supply_v: float | None,
    pwm_limit: float | None,
    yes: bool,
    json_file: Path | None,
    report: Path | None,
) -> int:
    """Measure a joint's stiffness with a kitchen scale, and by the servo's own duty.

    The robot sits fixed on its stand with a scale under one foot. Its goal goes down in steps; the scale holds the foot, you
    type grams. A line through them is the stiffness as the leg gives it; Present PWM over the position error is the
    stiffness as the controller asks for it, and tells the P divisor (the manual says 128, BAM found 256).

    \b
      openant sysid scale --robot my-ant --joint knee_fl            guided; an empty answer skips a weighing
      openant sysid scale --readings grams.csv --servo XL430-W250-T no robot: deflection,grams
      openant sysid scale --virtual blocked.toml --yes              the servo's part alone

    Hips turn about an upright axis: pull their foot sideways with a luggage scale, and give the lever --arm.
    Exit code 1: the estimators disagree, or neither divisor fits.
    """
    from openant_tools.errors import BadInput
    from openant_tools.robot.joints import JOINTS
    from openant_tools.robot.kit import HOME_RAD, PLATFORM_PWM_LIMIT
    from openant_tools.robot.servo import servo_model
    from openant_tools.sysid.bench.knee_torque import KNEE_TO_GROUND_M
    from openant_tools.sysid.bench.stiffness import (
        ARM_UNCERTAINTY,
        lever_arm,
        read_weighings,
        scale_line,
        servo_line,
        stiffness_finding,
    )

    kind = JOINTS[joint].kind if joint in JOINTS else "knee"
    touch = HOME_RAD[kind] if pose is None else pose
    length = KNEE_TO_GROUND_M if length_m is None else length_m
    typed = read_weighings(readings) if readings is not None else []

    def arm_at(angle: float) -> float:
        if arm_m is not None:
            return arm_m
        if kind == "hip":
            raise BadInput("a hip's lever arm is not known", remedy="measure it from axis to hook and give it by --arm")
        return lever_arm(length, angle)

    moves = virtual_source is not None or port is not None or readings is None
    folder = robot_of(robot, needed=moves and virtual_source is None)
    config = folder.config() if folder else None
    if config is not None and joint not in config.motors:
        raise BadInput(
            f"no joint {joint!r}",
            where=folder.config_file if folder else None,
            remedy=f"use {', '.join(config.motors)}",
        )
    kept = folder if robot is not None else None
    common: dict[str, Any] = {"command": _command(), "arm_m": arm_at(touch) if typed or kind == "knee" else arm_m}
    if not moves:
        own = servo_model(servo) if servo else config.motors[joint].servo if config else servo_model("XM430-W350-T")
        supply = own.nominal_voltage_v if supply_v is None else supply_v
        limit = pwm_limit if pwm_limit is not None else config.bus.pwm_limit if config else PLATFORM_PWM_LIMIT
        factory = own.register("position_p_gain").default
        line = scale_line(
            [w.deflection_rad for w in typed],
            [w.grams for w in typed],
            arm_at(touch),
            torque_limit_nm=own.stall_torque_at(supply, limit),
            arm_uncertainty_m=ARM_UNCERTAINTY * arm_at(touch),
        )
        finding = stiffness_finding(
            joint, own, p_gain=p_gain or float(factory or 0), supply_v=supply, pwm_limit=limit, scale=line, duty=None,
            measured_error=False, weighings=typed, **common,
        )  # fmt: skip
        _show_stiffness(finding, report, readings)
        return _conclude(finding, kept, json_file)

    from openant_tools.sysid.bench.press import Pressing, press

    talk = sys.stdin.isatty()
    by_step = {round(w.deflection_rad / step_rad): w.grams for w in typed}

    def grams(deflection: float) -> float | None:
        if typed:
            return by_step.get(round(deflection / step_rad))
        return _ask_grams(deflection) if talk else None

    pressing = Pressing(joint, touch, step_rad, steps, 1 if up or kind == "hip" else -1)
    with engine_config(folder, port, virtual_source) as engine:
        own = pressing.check(engine).model
        words = (
            f"{joint} goes to {touch:.2f} rad and presses {steps} × {step_rad:g} rad beyond; the others stand at home."
        )
        click.echo(f"{words} Fix the torso on its stand, feet free.", err=True)
        may_move(yes)
        result = press(
            engine,
            pressing,
            ready=_place_scale if talk else lambda: None,
            grams=grams,
            notice=lambda text: click.echo(text, err=True),
            progress=lambda words, share: click.echo(f"  {words}", err=True),
            journal=folder.journal if folder else None,
        )
    duty = servo_line(result.readings, result.pwm_limit)
    weighed = {w.deflection_rad: w.grams for w in result.weighings}
    pairs = [(r, weighed[r.deflection_rad]) for r in result.readings if r.deflection_rad in weighed]
    line_or_none = None
    if pairs:
        line_or_none = scale_line(
            [r.error_rad for r, _ in pairs],
            [g for _, g in pairs],
            [arm_at(r.position_rad) for r, _ in pairs],
            torque_limit_nm=own.stall_torque_at(result.volts, result.pwm_limit),
            arm_uncertainty_m=ARM_UNCERTAINTY * arm_at(touch),
        )
    finding = stiffness_finding(
        joint, own, p_gain=result.p_gain, i_gain=result.i_gain, supply_v=result.volts, pwm_limit=result.pwm_limit,
        scale=line_or_none, duty=duty, measured_error=True, weighings=result.weighings, readings=result.readings, **common,
    )  # fmt: skip
    _show_stiffness(finding, report)
    return _conclude(finding, kept, json_file)


def _show_stiffness(finding: Finding, report: Path | None, read: Path | None = None) -> None:
    if report:
        from openant_tools.sysid.bench.report import stiffness_report

        write_report(stiffness_report(finding), report, [read] if read else ())
    for reading in finding.data["servo_readings"]:
        click.echo(
            f"{reading['deflection_rad']:.3f} rad pressed: error {reading['error_rad']:.4f} rad, "
            f"duty {reading['duty']:.3f}, {reading['volts']:.1f} V"
        )
    for evidence in finding.evidence:
        interval = "" if evidence.low is None else f"  [{evidence.low:.2f}, {evidence.high:.2f}]"
        unit = "" if evidence.unit == "1" else f" {evidence.unit}"
        click.echo(f"{evidence.name:42}  {evidence.value:8.2f}{interval}{unit}")


@click.command(cls=Moving)
@click.option(
    "--static", "static", type=ANGLE, multiple=True, metavar="RAD", help="Angle where it began to slide; 31deg."
)
@click.option(
    "--kinetic", "kinetic", type=ANGLE, multiple=True, metavar="RAD", help="Angle where, tapped, it kept sliding."
)
@click.option("--readings", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="CSV of angle,kind.")
@click.option("--imu", is_flag=True, help="Read the angle off the robot's accelerometer; it stands on the plate.")
@click.option(
    "--trials", type=click.IntRange(1), default=5, show_default=True, metavar="N", help="With --imu: how often."
)
@click.option(
    "--seconds",
    type=SECONDS,
    default=3.0,
    show_default=True,
    metavar="S",
    help="With --imu, without a terminal: a trial.",
)
@click.option("--held", is_flag=True, help="It did not slide at these angles: they bound the coefficient from below.")
@click.option(
    "--resolution", type=ANGLE, default=math.radians(0.5), metavar="RAD", help="Of your protractor. Default: 0.5deg."
)
@robot_option
@virtual_option
@port_option
@yes_option
@json_option
def tilt(
    static: tuple[float, ...],
    kinetic: tuple[float, ...],
    readings: Path | None,
    imu: bool,
    trials: int,
    seconds: float,
    held: bool,
    resolution: float,
    robot: Path | None,
    virtual_source: str | None,
    port: str | None,
    yes: bool,
    json_file: Path | None,
) -> int:
    """Measure the floor's friction on a tilted plate: μ = tan(angle) where the robot begins to slide.

    Put a plate of the floor's material under the robot, tilt it slowly, note the angle; turn the robot and repeat.

    \b
      openant sysid tilt --static 32deg --static 31.5deg --static 33deg --kinetic 29deg --kinetic 30deg --robot my-ant
      openant sysid tilt --imu --robot my-ant       it stands on the plate, its accelerometer reads the angle

    Exit code 1: one reading only, or none slid.
    """
    from openant_tools.errors import BadInput
    from openant_tools.sysid.bench.friction import Slope, checked, friction_finding, read_slopes

    slopes = [Slope(checked(angle, "--static"), "static") for angle in static]
    slopes += [Slope(checked(angle, "--kinetic"), "kinetic") for angle in kinetic]
    slopes += read_slopes(readings) if readings is not None else []
    live = imu or virtual_source is not None or port is not None
    if live and slopes:
        raise BadInput("angles are both typed and to be measured", remedy="leave out --imu, or the angles")
    if not live and not slopes:
        raise BadInput("no angles", remedy="give --static 31deg for each trial, --readings FILE, or --imu")
    folder = robot_of(robot, needed=live and virtual_source is None)
    source = "protractor"
    if live:
        from openant_tools.sysid.bench.tilt import tilt_trials

        source = "accelerometer"
        talk = sys.stdin.isatty()
        with engine_config(folder, port, virtual_source, imu=True) as engine:
            click.echo("The robot stands up at home on the plate and holds itself there.", err=True)
            may_move(yes)
            angles = tilt_trials(
                engine,
                trials,
                level=lambda: talk and _enter("Hold the plate level and still"),
                begin=lambda trial: _begin(trial, trials) if talk else None,
                ended=lambda so_far: _key_pressed() if talk else so_far >= seconds,
                notice=lambda text: click.echo(text, err=True),
                journal=folder.journal if folder else None,
            )
        for angle in angles:
            click.echo(f"{angle:.3f} rad ({math.degrees(angle):.1f}°), μ = {math.tan(angle):.3f}")
        slopes = [Slope(checked(angle, "the accelerometer"), "static") for angle in angles]
    finding = friction_finding(slopes, _command(), source=source, resolution_rad=resolution, slid=not held)
    for evidence in finding.evidence:
        interval = "" if evidence.low is None else f"  [{evidence.low:.3f}, {evidence.high:.3f}]"
        click.echo(f"{evidence.name:20} {evidence.value:.3f}{interval}")
    return _conclude(finding, folder if robot is not None else None, json_file)


def _enter(words: str) -> bool:
    click.prompt(f"{words}, then press Enter", default="", show_default=False, err=True)
    return True


def _place_scale() -> None:
    _enter("Slide the scale under the foot until it just touches, and tare it")


def _begin(trial: int, trials: int) -> None:
    _enter(f"Trial {trial + 1} of {trials}: turn the robot a little, plate level")
    click.echo("Tilt slowly until it slides; then press Enter.", err=True)


def _key_pressed() -> bool:
    if not select.select([sys.stdin], [], [], 0)[0]:
        return False
    sys.stdin.readline()
    return True


def _ask_grams(deflection: float) -> float | None:
    """What the scale shows; an empty answer skips this weighing."""
    while True:
        answer = click.prompt(f"{deflection:.3f} rad: grams", default="", show_default=False, err=True).strip()
        if not answer:
            return None
        try:
            return float(answer.removesuffix("g").replace(",", "."))
        except ValueError:
            click.echo(f"{answer!r} is no number of grams", err=True)


def _command() -> str:
    return "openant sysid " + str(click.get_current_context().info_name)


def _conclude(finding: Finding, folder: RobotFolder | None, json_file: Path | None) -> int:
    """Print what was found, write it where it belongs, and say by the exit code whether it is well."""
    from openant_tools.files import json_text, write_text
    from openant_tools.procedure.finding import keep

    click.echo(finding.what)
    for words in finding.lines:
        click.echo(f"  {words}")
    if finding.next_action:
        click.echo(f"→ {finding.next_action}")
    if folder is not None:
        click.echo(f"wrote {keep(finding, folder)}", err=True)
    if json_file:
        content: Mapping[str, Any] = finding.as_json()
        write_text(json_file, json_text(content))
    return 0 if finding.ok else 1
