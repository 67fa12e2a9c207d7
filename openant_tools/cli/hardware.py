"""What commands share that reach a robot over its bus: which robot, which port, and whether it may move."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.leaving import MOVES, end_with_the_terminal
from openant_tools.cli.streams import has_terminal
from openant_tools.errors import BadInput
from openant_tools.virtual.process import clock_of_its_own, virtual_robot

if TYPE_CHECKING:
    from openant_tools.comms.messages import EngineConfig
    from openant_tools.robot.folder import RobotFolder

__all__ = [
    "Moving", "adapter_option", "anyway_option", "camera_option", "engine_config", "imu_option", "may_move", "need_moving", "need_terminal",
    "port_option", "record_pictures_option", "robot_of", "yes_option",
]  # fmt: skip


class Moving(click.Command):
    """A command that lets a robot move, or hold a pose: the one place where that is said.

    Only such a command may ask for it (`may_move`, an `Intent` that moves), and only its engine gives torque
    (`engine_config`). Ctrl-Z ends it as Ctrl-C does, and the tests kill every one of them on its way.
    """


port_option = click.option("--port", metavar="PATH", help="The bus. Default: robot.toml's, else the one plugged in.")
adapter_option = click.option(
    "--port", metavar="PATH", help="The servos' adapter. Default: robot.toml's, else the one plugged in."
)
imu_option = click.option("--imu", metavar="PATH", help="The flight controller. Default: robot.toml's.")
camera_option = click.option("--camera", metavar="SOURCE", help="The overhead camera. Default: robot.toml's.")
yes_option = click.option(
    "--yes", is_flag=True, help="The robot may move: do not ask. Needed where no terminal is attached."
)

record_pictures_option = click.option(
    "--record-pictures", is_flag=True,
    help="The recording holds the camera's pictures, too: JPEG, 640 px wide, 5 a second at most; some 400 MB an hour.",
)  # fmt: skip
anyway_option = click.option(
    "--anyway",
    is_flag=True,
    help="Move although servos' registers differ from what is expected, or joints do not follow; the recording says so.",
)


def robot_of(robot: Path | None, *, needed: bool) -> RobotFolder | None:
    """The robot's folder by `--robot`, $OPENANT_ROBOT or the working directory; None where none is meant nor needed."""
    from openant_tools.robot.config import CONFIG_NAME
    from openant_tools.robot.folder import RobotFolder

    path = robot or Path(os.environ.get("OPENANT_ROBOT", "."))
    meant = robot is not None or "OPENANT_ROBOT" in os.environ or (path / CONFIG_NAME).is_file()
    return RobotFolder.at(path) if meant or needed else None


@contextlib.contextmanager
def engine_config(
    folder: RobotFolder | None,
    port: str | None,
    virtual_source: str | None,
    *,
    clock: str | None = None,
    imu: bool = False,
    camera: bool = False,
    **more: object,
) -> Iterator[EngineConfig]:
    """The robot meant, as the engine wants it; a virtual one that is started for this command ends with the block, in which
    no other program works on the robot.

    Args:
        folder: None for an Ant that nobody has described.
        port: of the bus, where it is not the virtual robot's or robot.toml's.
        clock: "real" or "stepped" for a virtual robot; None for its own.
        imu, camera: whether they are to be read, where there are any.
        more: to `EngineConfig`; torque is refused where the command is no `Moving` one.
    """
    from openant_tools.comms.setup import (
        camera_of_robot,
        config_of_robot,
        config_of_unknown_robot,
        find_bus,
        imu_of_robot,
    )
    from openant_tools.comms.state import passport_registers

    with contextlib.ExitStack() as stack:
        if folder is not None:
            stack.enter_context(folder.hold())
        found: Mapping[str, str | None] = {}
        if virtual_source is not None:
            clock = clock or clock_of_its_own(virtual_source)
            found = stack.enter_context(virtual_robot(virtual_source, clock=clock, camera=camera))
        more.setdefault("still", not _moving())
        port, control = port or found.get("bus"), found.get("control")
        described = None if folder is None else folder.config()
        if imu:
            more["imu"] = imu_of_robot(described, found.get("imu"))
        if camera:
            more["camera"] = camera_of_robot(described, found.get("camera"))
        if described is not None:
            assert folder is not None
            more.setdefault("journal", str(folder.journal))
            yield config_of_robot(
                described, port, control=control, passport=passport_registers(folder, real=control is None), **more
            )
        else:
            yield config_of_unknown_robot(find_bus(port), control, **more)


def need_terminal(why: str, remedy: str = "add --yes if it may") -> None:
    """Go on only where somebody can be asked; raises BadInput."""
    if not has_terminal():
        raise BadInput(f"{why} and nobody is there to ask", remedy=remedy)


def _moving() -> bool:
    context = click.get_current_context(silent=True)
    return context is None or isinstance(context.command, Moving)


def need_moving() -> None:
    """From here on the command moves; raises RuntimeError in one that is not declared as one that does."""
    context = click.get_current_context(silent=True)
    if context is None:
        return
    if not isinstance(context.command, Moving):
        raise RuntimeError(f"`{context.command_path}` moves: it must be a `Moving` command")
    if not context.meta.get(MOVES):
        context.meta[MOVES] = True
        end_with_the_terminal()


def may_move(
    yes: bool, *, move: str = "move", question: str = "May it move?", remedy: str = "add --yes if it may"
) -> None:
    """Go on only where the robot may move: `yes` says so, or whoever sits at the terminal.

    Args:
        move: what it would do, in a word. question: in the terminal.

    Raises:
        BadInput: nobody is there to ask.
        click.Abort: it may not.
    """
    need_moving()
    if yes:
        return
    need_terminal(f"the robot would {move}", remedy)
    click.confirm(question, abort=True, err=True)
