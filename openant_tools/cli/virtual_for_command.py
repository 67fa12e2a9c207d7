"""`--virtual [SCENARIO | READY_FILE]` on commands that touch hardware: a virtual robot for this command, or a running
one."""

from __future__ import annotations

import click

from openant_tools.virtual.process import VIRTUAL_DEFAULT

__all__ = ["virtual_option"]

virtual_option = click.option(
    "--virtual",
    "virtual_source",
    is_flag=False,
    flag_value=VIRTUAL_DEFAULT,
    metavar="[SCENARIO|READY_FILE]",
    help="Use a virtual robot: started for this command (from a scenario .toml, or a healthy one; in stepped time, unless "
    "the scenario says otherwise), or running (its ready file).",
)
