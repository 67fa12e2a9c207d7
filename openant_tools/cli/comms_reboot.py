"""`openant comms reboot`: clears a latched hardware error, after saying which."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click

from openant_tools.cli.hardware import need_terminal, port_option, robot_of
from openant_tools.cli.options import robot_option
from openant_tools.cli.virtual_for_command import clock_of_its_own, virtual_option, virtual_robot

__all__ = ["reboot"]


@click.command()
@port_option
@virtual_option
@robot_option
@click.option("--id", "servo", type=click.IntRange(0, 252), required=True, metavar="N", help="Which servo.")
@click.option("--baud", type=int, help="Its rate. Default: robot.toml's, else 1000000.")
@click.option("--yes", is_flag=True, help="Do it without a question. Needed where no terminal is attached.")
def reboot(
    port: str | None, virtual_source: str | None, robot: Path | None, servo: int, baud: int | None, yes: bool
) -> None:
    """Clear a servo's latched hardware error by starting it anew; its torque is off afterwards.

    Says first which error it is. Refused (exit code 1) while its cause stands: too hot, or a voltage out of range; exit code
    1, too, where the error comes back at once. Power off and on does the same.

    \b
      openant comms reboot --port /dev/ttyUSB0 --id 31
    """
    from openant_tools.comms.reboot import OTHER_REMEDY, latched
    from openant_tools.comms.reboot import reboot as start_anew
    from openant_tools.comms.setup import find_bus, open_bus

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
        standing = latched(bus, servo)
        if not standing.errors:
            click.echo(f"{name} has no hardware error: there is nothing to clear")
            return
        for error in standing.errors:
            click.echo(f"{name} has switched itself off after {error.name}: {error.advice}")
        if standing.refusal:
            click.echo(f"not rebooted, the error would come back: {standing.refusal}")
            raise SystemExit(1)
        click.echo(f"a reboot clears it, as does another way: {OTHER_REMEDY}; its torque is off afterwards")
        if not yes:
            need_terminal("a reboot lets go of this joint")
            click.confirm("Reboot it?", abort=True, err=True)
        left = start_anew(bus, servo)
        if left:
            names = " and ".join(error.name for error in left)
            click.echo(
                f"{name} reports {names} again at once → {left[0].advice}; where it stays so, {OTHER_REMEDY}, or replace the "
                "servo"
            )
            raise SystemExit(1)
        click.echo(f"{name} works again: {standing.names} is cleared, its torque is off")
