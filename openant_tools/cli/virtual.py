"""`openant virtual`: start a virtual Open Ant that speaks the real protocols."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import click

from openant_tools.cli.log import mention

__all__ = ["virtual"]


@click.group()
def virtual() -> None:
    """A virtual Open Ant that speaks the real protocols."""


key_file_option = click.option(
    "--key-file",
    type=click.Path(path_type=Path, dir_okay=False),
    envvar="OPENANT_SCENARIO_KEY",
    metavar="FILE",
    help="The key of a sealed scenario. Default: the file that OPENANT_SCENARIO_KEY names.",
)


@virtual.command()
@click.option(
    "--scenario",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="A TOML file that says what this robot is and what is wrong with it. Default: a healthy standard Ant on its "
    "stand.",
)
@click.option(
    "--ready-file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write where to connect, as JSON, once everything is ready.",
)
@click.option(
    "--clock",
    type=click.Choice(["real", "stepped"]),
    help="Real time, or time that moves only by the control socket. Default: what the scenario says, else real.",
)
@key_file_option
@click.option("--no-camera", is_flag=True, help="Leave the camera out, whatever the scenario says.")
@click.option("--until-eof", is_flag=True, hidden=True, help="End when standard input does, with who started it.")
@click.option("--tcp", is_flag=True, help="Put the bus on a TCP port (pyserial's socket://) instead of a terminal.")
def start(
    scenario: Path | None,
    ready_file: Path | None,
    clock: str | None,
    key_file: Path | None,
    no_camera: bool,
    until_eof: bool,
    tcp: bool,
) -> None:
    """Run until interrupted; prints where to connect.

    \b
    A client opens the bus as any serial port, at 1,000,000 baud unless the scenario says otherwise:
      openant virtual start --ready-file ant.json
      openant comms scan --port $(jq -r .bus ant.json)
    """
    from openant_tools.optional import installed
    from openant_tools.signals import TOLD_TO_GO
    from openant_tools.virtual.start import serve

    # Interrupting is how one ends it (formats, section 6): no failure. A flag, since an exception that is raised
    # wherever the loop happens to be can be swallowed there.
    ended = threading.Event()
    if until_eof:
        threading.Thread(target=_await_eof, args=(ended,), daemon=True).start()
    if not no_camera and not installed("cv2"):
        click.echo("no camera: OpenCV is not installed → pip install 'openant-tools[camera]'", err=True)
    with serve(scenario, clock=clock, tcp=tcp, key_file=key_file, camera=False if no_camera else None) as server:
        for name, value in server.addresses.items():
            if value is not None:
                click.echo(f"{name:8} {value}")
        before = {number: signal.signal(number, lambda *_: ended.set()) for number in (signal.SIGINT, *TOLD_TO_GO)}
        try:
            if ready_file is not None:
                server.announce(ready_file)
            server.run(ended.is_set)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        mention("stopped")


def _await_eof(ended: threading.Event) -> None:
    while os.read(0, 4096):
        pass
    ended.set()


@virtual.command()
@click.argument("scenario", type=click.Path(path_type=Path, dir_okay=False))
@key_file_option
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, dir_okay=False), metavar="FILE", help="The sealed scenario."
)
def seal(scenario: Path, key_file: Path | None, out: Path) -> None:
    """Hide what is wrong with a robot: only the virtual robot that has the key reads it.

    Prints the commitment, a hash that proves later that nothing was changed. A key file that is not there yet is made.
    """
    from openant_tools.errors import BadInput
    from openant_tools.virtual.scenario import check_sealable, seal_scenario
    from openant_tools.virtual.seal import make_key, read_key

    if key_file is None:
        raise BadInput("no key file is named", remedy="--key-file FILE; it is made where there is none")
    check_sealable(scenario)  # no key for a file that is not good
    commitment = seal_scenario(scenario, read_key(key_file) if key_file.exists() else make_key(key_file), out)
    click.echo(f"{out}: commitment {commitment}")
