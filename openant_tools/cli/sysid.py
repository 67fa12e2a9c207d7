"""`openant sysid`: from excitation to a calibrated model."""

from __future__ import annotations

import click

from openant_tools.cli.sysid_bench import scale, tilt, torque
from openant_tools.cli.sysid_compare import compare
from openant_tools.cli.sysid_fit import fit
from openant_tools.cli.sysid_plan import plan
from openant_tools.cli.sysid_record import record
from openant_tools.cli.sysid_twitch import twitch

__all__ = ["sysid"]


@click.group()
def sysid() -> None:
    """Record excitations of the robot and fit a calibrated model to them."""


sysid.add_command(plan)
sysid.add_command(record)
sysid.add_command(fit)
for command in (compare, torque, scale, tilt, twitch):
    sysid.add_command(command)
