"""`openant support`: one bundle for a bug report."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.hardware import need_terminal, robot_of
from openant_tools.cli.log import FILE, state_folder
from openant_tools.cli.options import json_option, robot_option

__all__ = ["support"]


@click.command()
@robot_option
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), required=True, metavar="FILE.zip", help="The bundle."
)
@click.option("--yes", is_flag=True, help="Pack without asking.")
@json_option
def support(robot: Path | None, out: Path, yes: bool, json_file: Path | None) -> int:
    """Pack versions, ports, robot.toml, the last findings and the end of the log into one file for a bug report.

    It lists what it packs, and asks. Serial numbers in port names, user, host and home folders are masked; recordings
    stay where they are. Nothing is sent anywhere.
    """
    from openant_tools.bringup.support import bundle, gather
    from openant_tools.files import json_text, write_text

    texts = gather(robot_of(robot, needed=False), [state_folder() / FILE])
    for name, text in texts.items():
        click.echo(f"  {name}  {len(text.encode())} bytes")
    if not yes:
        need_terminal("it would write a bundle")
        if not click.confirm(f"Pack this into {out}?", default=True, err=True):
            raise click.Abort
    bundle(texts, out)
    click.echo(f"wrote {out}: look through it before you hand it on")
    if json_file is not None:
        write_text(json_file, json_text({"bundle": str(out), "files": list(texts)}))
    return 0
