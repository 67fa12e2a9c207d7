"""`openant comms reboot`: clears a latched hardware error, after saying which."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click

from openant_tools.cli.hardware import port_option, robot_of
from openant_tools.cli.log import command_line
from openant_tools.cli.options import json_option, robot_option
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.virtual.process import clock_of_its_own, virtual_robot

__all__ = ["reboot"]


@click.command()
@port_option
@virtual_option
@robot_option
@click.option("--id", "servo", type=click.IntRange(0, 252), required=True, metavar="N", help="Which servo.")
@click.option("--baud", type=int, help="Its rate. Default: robot.toml's, else 1000000.")
@click.option("--yes", is_flag=True, help="Do it without a question. Needed where no terminal is attached.")
@json_option
def reboot(
    port: str | None, virtual_source: str | None, robot: Path | None, servo: int, baud: int | None, yes: bool,
    json_file: Path | None,
) -> None:  # fmt: skip
    """Clear a servo's latched hardware error by starting it anew; its torque is off afterwards.

    Says first which error it is. Refused (exit code 1) while its cause stands: too hot, or a voltage out of range; exit code
    1, too, where the error comes back at once. Power off and on does the same.

    \b
      openant comms reboot --port /dev/ttyUSB0 --id 31
    """
    from openant_tools.cli.calib import show_finding
    from openant_tools.cli.face import CommandFace
    from openant_tools.comms.reboot import reboot as start_anew
    from openant_tools.comms.setup import find_bus, open_bus
    from openant_tools.procedure.step import drive

    folder = robot_of(robot, needed=False)
    config = None if folder is None else folder.config()
    with contextlib.ExitStack() as stack:
        control = None
        if virtual_source is not None:
            clock = clock_of_its_own(virtual_source)
            found = stack.enter_context(virtual_robot(virtual_source, clock=clock, camera=False))
            port, control = port or str(found["bus"]), found["control"]
        rate = baud or (config.bus.baud if config is not None else 1_000_000)
        bus = open_bus(find_bus(port, config), rate, control)
        stack.callback(bus.close)
        motor = None if config is None else config.motor_with_id(servo)
        name = f"servo {servo}" if motor is None else f"{motor.joint} (id {servo})"
        if motor is not None:
            bus.names = {servo: motor.joint}
        finding = drive(start_anew(bus, servo, name, command_line()), CommandFace(yes=yes))
    click.get_current_context().exit(show_finding(finding, json_file))
