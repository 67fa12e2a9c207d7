"""`openant thermal`: soak the robot, fit its heat, forecast, compare."""

from __future__ import annotations

import click

from openant_tools.cli.thermal_analysis import compare, fit, forecast
from openant_tools.cli.thermal_soak import soak

__all__ = ["thermal"]


@click.group()
def thermal() -> None:
    """Heat: how warm each servo gets, when it would shut down, and what it can bear for ever.

    \b
      openant thermal soak --robot my-ant --load stand --minutes 30 --out soak.mcap
      openant thermal fit soak.mcap --robot my-ant
      openant thermal forecast soak.mcap --at 10
      openant thermal compare bare.mcap finned.mcap
    """


for command in (soak, fit, forecast, compare):
    thermal.add_command(command)
