"""What commands share that let a robot walk, simulated or real: which one, whether it may move, the key that pauses it."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_agents.places import HARDWARE_ID
from openant_tools.cli.hardware import may_move, record_pictures_option
from openant_tools.cli.learning import robot_argument
from openant_tools.cli.log import mention
from openant_tools.cli.streams import has_terminal
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.errors import BadInput

if TYPE_CHECKING:
    from openant_env.hardware import AntHardware

__all__ = ["environment", "hardware_options", "hardware_robot", "may_walk"]


def hardware_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """`--virtual`, `--clock`, `--yes`, `--record-pictures`, of commands that may let a robot walk."""
    for option in (
        click.option("--yes", is_flag=True, help="The robot may move: do not ask."),
        click.option(
            "--clock", type=click.Choice(["real", "stepped"]),
            help="Time of a virtual robot that is started here. Default: stepped, unless its scenario says otherwise.",
        ),
        virtual_option,
        record_pictures_option,
    ):  # fmt: skip
        command = option(command)
    return command


def hardware_robot(
    robot: Path | None, kit: str | None, virtual_source: str | None, clock: str | None
) -> dict[str, Any]:
    """How `openant/AntHardware-v0` is told which robot."""
    if kit is not None:
        raise BadInput("--kit is a simulated robot", remedy="name the robot with --robot, or use --virtual")
    options: dict[str, Any] = {}
    if virtual_source is None or robot is not None or "OPENANT_ROBOT" in os.environ or Path("robot.toml").is_file():
        options |= robot_argument(robot, None)
    if virtual_source is not None:
        options["virtual"] = virtual_source if not Path(virtual_source).exists() else os.path.abspath(virtual_source)
    if clock is not None:
        if virtual_source is None:
            raise BadInput("--clock is for virtual robots", remedy="leave it out")
        options["clock"] = clock
    return options


def may_walk(options: Mapping[str, Any], yes: bool, unattended: bool = False) -> None:
    """Ask whether the robot may walk, after telling what it will do alone.

    Raises:
        BadInput: nobody is there to ask.
    """
    which = "The virtual robot" if "virtual" in options else f"The robot of {options['robot']}"
    if unattended:
        from openant_tools.comms.restart import unattended_words

        click.echo("\n".join(unattended_words()), err=True)
    place = "it must be on the floor, in the camera's view, with room around it."
    may_move(yes, move="walk", question=f"{which} will stand up and walk: {place}\nMay it?")


def _notice(words: str) -> None:
    """A line about the robot, on stderr."""
    click.echo(f"openant: {words}", err=True)


@contextlib.contextmanager
def environment(
    name: str,
    options: Mapping[str, Any],
    recordings: Path,
    *,
    unattended: bool = False,
    said: Callable[[str], None] | None = None,
    **more: Any,
) -> Iterator[Any]:
    """An environment by its id, closed in the end; a robot can be paused meanwhile.

    Args:
        options: what a run's `run.json` keeps, to make it again.
        recordings: where a robot's runs go. unattended: nobody looks after it. said: also told what the user is.
        more: for the simulated one.
    """
    import gymnasium

    import openant_env  # noqa: F401  (registers the environments)

    if name != HARDWARE_ID:
        env = gymnasium.make(name, max_episode_steps=-1, **options, **more)
        if not env.unwrapped.robot.identified:
            mention(
                f"openant: {options['robot']} was never identified: this is the kit's nominal model, not that robot "
                "(`openant sysid fit … --robot DIR` makes it one)"
            )
        try:
            yield env
        finally:
            env.close()
        return

    # With a terminal the space bar is the word that motion may go on where it has ended for good; without one nobody gives it.
    def notice(words: str) -> None:
        _notice(words)
        if said is not None:
            said(words)

    attended = has_terminal() and not unattended
    env = gymnasium.make(
        name, **options, recordings=recordings, notice=notice, attended=attended, unattended=unattended
    )
    try:
        with _pause_key(env.unwrapped):
            yield env
    finally:
        env.close()


@contextlib.contextmanager
def _pause_key(env: AntHardware) -> Iterator[None]:
    """While a terminal is attached, the space bar pauses the robot and lets it go on."""
    if not has_terminal():
        yield
        return
    import select
    import termios
    import tty

    fd = sys.stdin.fileno()
    before = termios.tcgetattr(fd)
    ended = threading.Event()

    def listen() -> None:
        while not ended.is_set():
            if not select.select([fd], [], [], 0.1)[0] or os.read(fd, 1) != b" ":
                continue
            if env.paused:
                env.resume()
            else:
                env.pause("paused; the space bar goes on")

    thread = threading.Thread(target=listen, name="pause-key", daemon=True)
    tty.setcbreak(fd)
    _notice("the space bar pauses the robot; Ctrl-C saves and stops")
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(1.0)
        with contextlib.suppress(termios.error):  # the terminal has gone
            termios.tcsetattr(fd, termios.TCSADRAIN, before)
