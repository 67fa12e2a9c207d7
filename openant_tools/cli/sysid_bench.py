"""`openant sysid torque | scale | tilt`: the bench procedures of the Open Ant paper."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.cli.hardware import Moving, engine_config, port_option, robot_of, yes_option
from openant_tools.cli.log import mention
from openant_tools.cli.options import POSITIVE, SECONDS, Number, json_option, report_option, robot_option, write_report
from openant_tools.cli.virtual_for_command import virtual_option

if TYPE_CHECKING:
    from openant_tools.cli.face import CommandFace
    from openant_tools.comms.messages import EngineConfig
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
    from openant_tools.robot.kit import kit as kit_by_name
    from openant_tools.robot.servo import servo_model
    from openant_tools.sysid.bench.knee_torque import KNEE_TO_GROUND_M, torque_table

    folder = None if kit else robot_of(robot, needed=robot is not None)
    config = folder.config() if folder else None
    finding = torque_table(
        kit_by_name(kit or (config.kit if config else "standard")), config, servo=servo_model(servo) if servo else None,
        mass_kg=mass_kg, legs=legs, angles_rad=angles, length_m=length_m or KNEE_TO_GROUND_M, supply_v=supply_v,
        pwm_limit=pwm_limit, command=_command(),
    )  # fmt: skip
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
    from openant_tools.procedure.step import drive
    from openant_tools.robot.joints import JOINTS
    from openant_tools.robot.kit import HOME_RAD, PLATFORM_PWM_LIMIT
    from openant_tools.robot.servo import servo_model
    from openant_tools.sysid.bench import scale as bench
    from openant_tools.sysid.bench.knee_torque import KNEE_TO_GROUND_M
    from openant_tools.sysid.bench.stiffness import Lever, read_weighings, weighed_finding

    kind = JOINTS[joint].kind if joint in JOINTS else "knee"
    touch = HOME_RAD[kind] if pose is None else pose
    lever = Lever(joint, length_m or KNEE_TO_GROUND_M, arm_m)
    typed = read_weighings(readings) if readings is not None else []
    moves = virtual_source is not None or port is not None or readings is None
    folder = robot_of(robot, needed=moves and virtual_source is None)
    config = folder.config() if folder else None
    if config is not None and joint not in config.motors:
        raise BadInput(
            f"no joint {joint!r}",
            where=folder.config_file if folder else None,
            remedy=f"use {', '.join(config.motors)}",
        )
    if moves:
        pressing = bench.Pressing(joint, touch, step_rad, steps, 1 if up or kind == "hip" else -1)
        with engine_config(folder, port, virtual_source) as engine, _face(engine, virtual_source, yes) as face:
            procedure = bench.stiffness(
                engine, pressing, lever, weighings=typed, weigh=not yes and not typed, held=yes and virtual_source is None,
                command=_command(),
            )  # fmt: skip
            finding = drive(procedure, face)
    else:
        own = servo_model(servo) if servo else config.motors[joint].servo if config else servo_model("XM430-W350-T")
        limit = pwm_limit if pwm_limit is not None else config.bus.pwm_limit if config else PLATFORM_PWM_LIMIT
        finding = weighed_finding(
            joint, own, typed, lever, pose_rad=touch, p_gain=p_gain, supply_v=supply_v, pwm_limit=limit,
            command=_command(),
        )  # fmt: skip
    if report:
        from openant_tools.sysid.bench.report import stiffness_report

        write_report(stiffness_report(finding), report, [readings] if readings else ())
    return _conclude(finding, folder if robot is not None else None, json_file, virtual=virtual_source is not None)


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
    help="With --yes: a trial.",
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
    if live:
        from openant_tools.procedure.step import drive
        from openant_tools.sysid.bench.tilt import LONGEST_S, floor_friction

        with (
            engine_config(folder, port, virtual_source, imu=True) as engine,
            _face(engine, virtual_source, yes) as face,
        ):
            procedure = floor_friction(
                engine, trials, by_hand=not yes, seconds=seconds if yes else LONGEST_S, slid=not held,
                resolution_rad=resolution, command=_command(),
            )  # fmt: skip
            finding = drive(procedure, face)
    else:
        finding = friction_finding(slopes, _command(), source="protractor", resolution_rad=resolution, slid=not held)
    return _conclude(finding, folder if robot is not None else None, json_file, virtual=virtual_source is not None)


@contextlib.contextmanager
def _face(engine: EngineConfig, virtual_source: str | None, yes: bool) -> Iterator[CommandFace]:
    """Who answers: the terminal; and a virtual robot's own hands, where nobody is asked."""
    from openant_tools.bringup.simulated_builder import SimulatedBuilder
    from openant_tools.cli.face import CommandFace

    if virtual_source is None or engine.control is None:
        yield CommandFace(yes=yes)
        return
    hands = SimulatedBuilder(engine.control)
    try:
        yield CommandFace(yes=yes, hands=hands.do)
    finally:
        hands.close()


def _command() -> str:
    return "openant sysid " + str(click.get_current_context().info_name)


def _conclude(finding: Finding, folder: RobotFolder | None, json_file: Path | None, *, virtual: bool = False) -> int:
    """Print what was found, write it where it belongs, and say by the exit code whether it is well."""
    from openant_tools.cli.calib import show_finding
    from openant_tools.cli.face import echo_numbers
    from openant_tools.procedure.finding import keep

    echo_numbers(finding)
    if folder is not None:
        mention(f"wrote {keep(finding, folder, virtual=virtual)}")
    return show_finding(finding, json_file)
