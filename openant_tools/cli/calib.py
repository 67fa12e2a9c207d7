"""`openant calib`: every step of bringing a robot up, as a command."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from openant_tools.bringup.walk import WALK
from openant_tools.cli.hardware import Moving, adapter_option, camera_option, imu_option
from openant_tools.cli.options import driver_option, joint_option, json_option, robot_option
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.procedure.step import Bench, Procedure, Step

if TYPE_CHECKING:
    from openant_tools.procedure.finding import Finding
    from openant_tools.robot.folder import RobotFolder

__all__ = ["bench_of", "calib", "run_and_keep", "show_finding", "step_options"]


class _InOrder(click.Group):
    """Lists its commands in the order in which one builds."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)


@click.group(cls=_InOrder)
def calib() -> None:
    """Bring a robot up, step by step: what each will do is said before it is done.

    What was found is kept in the robot's findings/, every write to a servo's memory in journal.jsonl: `openant calib undo`
    takes the last step's writes back. `openant bringup` walks through all steps.
    """


def step_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """What every step takes."""
    for option in reversed(
        (
            robot_option,
            adapter_option,
            imu_option,
            camera_option,
            virtual_option,
            click.option(
                "--yes", is_flag=True, help="Grant everything and take every default; hands are the virtual robot's."
            ),
            json_option,
        )
    ):
        function = option(function)
    return function


def _folder_of(robot: Path | None) -> RobotFolder:
    """The robot's folder; made, with the standard kit's nominal values, where it is named and empty."""
    from openant_tools.cli.log import mention
    from openant_tools.cli.options import robot_folder
    from openant_tools.robot.folder import RobotFolder, create_robot

    path = robot_folder(robot, must_exist=robot is None)
    if (path / "robot.toml").is_file():
        return RobotFolder.at(path)
    made = create_robot(path)
    mention(f"there was no robot in {path}: made {made.config_file} for one (standard kit)")
    return made


@contextlib.contextmanager
def bench_of(
    robot: Path | None, port: str | None, imu: str | None, camera: str | None, virtual_source: str | None, yes: bool,
    joints: tuple[str, ...] = (), *, sees: bool = False, clock: str | None = None,
) -> Iterator[tuple[Bench, Any]]:  # fmt: skip
    """The bench and the face that a step runs with; a virtual robot started for it, with a camera where the step `sees`,
    ends with the block. No other program moves the robot or writes into its folder meanwhile."""
    from openant_tools.bringup.simulated_builder import SimulatedBuilder
    from openant_tools.cli.face import CommandFace
    from openant_tools.virtual.process import clock_of_its_own, virtual_robot

    folder = _folder_of(robot)
    with contextlib.ExitStack() as stack:
        stack.enter_context(folder.hold())
        if virtual_source is None:
            yield Bench(folder, port, imu, camera, None, joints), CommandFace(yes=yes)
            return
        found = stack.enter_context(
            virtual_robot(virtual_source, clock=clock or clock_of_its_own(virtual_source), camera=sees)
        )
        control = str(found["control"])
        hands = SimulatedBuilder(control)
        stack.callback(hands.close)
        bench = Bench(folder, port or found["bus"], imu or found["imu"], camera or found["camera"], control, joints)
        yield bench, CommandFace(yes=yes, hands=hands.do)


def run_and_keep(procedure: Procedure, bench: Bench, face: Any) -> Finding:
    """Run a procedure and keep its finding in the robot's folder."""
    from openant_tools.procedure.finding import keep
    from openant_tools.procedure.step import drive

    finding = drive(procedure, face)
    keep(finding, bench.folder, virtual=bench.virtual)
    return finding


def show_finding(finding: Finding, json_file: Path | None) -> int:
    """Print a finding, write its JSON where it was asked for; the exit code."""
    from openant_tools.cli.face import echo_finding
    from openant_tools.files import json_text, write_text

    echo_finding(finding)
    if json_file is not None:
        write_text(json_file, json_text(finding.as_json()))
    return 0 if finding.ok else 1


def _command(step: Step) -> click.Command:
    @click.command(
        step.name, cls=Moving if step.moves or step.holds else click.Command, help=_help(step), short_help=step.does
    )
    @joint_option
    @step_options
    def command(
        robot: Path | None,
        port: str | None,
        imu: str | None,
        camera: str | None,
        virtual_source: str | None,
        yes: bool,
        json_file: Path | None,
        joints: tuple[str, ...],
        driver: str = "own",
    ) -> int:
        from openant_tools.errors import BadInput
        from openant_tools.robot.joints import JOINT_NAMES

        for joint in joints:
            if joint not in JOINT_NAMES:
                raise BadInput(f"there is no joint {joint!r}", remedy=f"the joints are {', '.join(JOINT_NAMES)}")
        clock = "real" if driver == "sdk" else None  # the SDK waits by the machine's own clock
        with bench_of(robot, port, imu, camera, virtual_source, yes, joints, sees=step.sees, clock=clock) as (
            bench,
            face,
        ):
            if driver == "sdk":
                from openant_tools.calib.inventory import inventory_by_sdk
                from openant_tools.procedure.step import drive

                finding = drive(inventory_by_sdk(bench), face)
            else:
                finding = run_and_keep(step.start(bench), bench, face)
        return show_finding(finding, json_file)

    return driver_option(command) if step.name == "inventory" else command


def _help(step: Step) -> str:
    lines = [
        step.does,
        "",
        f"On the table: {step.table or 'nothing more'}.",
        f"It changes: {step.changes or 'nothing'}.",
    ]
    lines.append("The robot moves." if step.moves else "Nothing moves.")
    needs = ", ".join(WALK[name].title for name in step.needs)
    return "\n".join([*lines, f"Before it: {needs}." if needs else ""])


for _name in WALK:
    calib.add_command(_command(WALK[_name]))


@calib.command()
@click.option(
    "--all", "everything", is_flag=True, help="Every write that stands in the journal, not only the last step's."
)
@step_options
def undo(
    robot: Path | None,
    port: str | None,
    imu: str | None,
    camera: str | None,
    virtual_source: str | None,
    yes: bool,
    json_file: Path | None,
    everything: bool,
) -> int:
    """Take back the last step's writes to the servos' memory, newest first, as journal.jsonl has them.

    A servo that has lost its id and baud rate again must be alone on the cable, as it was when they were given.
    """
    from openant_tools.calib.undo import undo as undoing

    with bench_of(robot, port, imu, camera, virtual_source, yes) as (bench, face):
        finding = run_and_keep(undoing(bench, everything=everything), bench, face)
    return show_finding(finding, json_file)
