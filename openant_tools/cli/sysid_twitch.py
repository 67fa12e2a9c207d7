"""`openant sysid twitch`: whether a simulated robot stays where it is when it twitches."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.options import Number, json_option, model_option, robot_option
from openant_tools.numbers import exact, number

__all__ = ["twitch"]


@click.command()
@model_option
@robot_option
@click.option("--seconds", type=Number(1.0, 600.0), default=6.0, show_default=True, help="Of twitching.")
@json_option
def twitch(model: Path | None, robot: Path | None, seconds: float, json_file: Path | None) -> int:
    """Twitch fast on the simulated floor and see whether the robot travels, as a real one would not.

    Contacts that are too hard let a simulated robot slide by high-frequency commands, which an agent finds and a real floor
    does not give. Exit code 1: it travels; the softness with which the paper's robot stays is tried and named.

    \b
      openant sysid twitch --robot my-ant
      openant sysid twitch --model calibrated.xml
    """
    from openant_tools.cli.options import robot_folder
    from openant_tools.files import json_text, write_text
    from openant_tools.model.plant import Setup, load_plant
    from openant_tools.robot.folder import RobotFolder
    from openant_tools.robot.joints import JOINT_NAMES
    from openant_tools.sysid.excitation import CommandSpace
    from openant_tools.sysid.twitch import PAPER_SOLIMP, PAPER_SOLREF, STAYS_M_S, travel, with_paper_contacts

    limits = None
    if model is None:
        folder = RobotFolder.at(robot_folder(robot, must_exist=True))
        configuration = folder.config()
        model = folder.model_path(configuration)
        limits = {motor.joint: (motor.min_rad, motor.max_rad) for motor in configuration.motors.values()}
    plant = load_plant(model, JOINT_NAMES, Setup.FLOOR)
    space = CommandSpace.around_home(limits)
    found = travel(plant, space, seconds=seconds)
    result = {"model": str(model), "speed_m_s": found.speed, "turn_rad": found.turn_rad, "stays": found.stays}
    click.echo(
        f"{model}: twitching for {exact(seconds, 's')} moves it {number(1e3 * found.distance_m, 'mm', decimals=1)} "
        f"({number(1e3 * found.speed, 'mm/s', decimals=1)}) and "
        f"turns it {number(found.turn_rad, 'rad', sign=True)}; below {exact(1e3 * STAYS_M_S, 'mm/s')} it stays"
    )
    if not found.stays:
        softer = travel(with_paper_contacts(plant), space, seconds=seconds)
        result["speed_with_paper_contacts_m_s"] = softer.speed
        values = " ".join(map(exact, PAPER_SOLREF)), " ".join(map(exact, PAPER_SOLIMP[:3]))
        click.echo(
            f'it travels: with solref="{values[0]}" solimp="{values[1]}" on floor and feet it moves '
            f"{number(1e3 * softer.speed, 'mm/s', decimals=1)}"
            + (", so set these" if softer.stays else ", too: look at friction, masses and the time step")
        )
    if json_file:
        write_text(json_file, json_text(result))
    return 0 if found.stays else 1
