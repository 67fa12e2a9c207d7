"""`openant bringup`: the whole walk, from loose motors to a passport."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import click

from openant_tools.cli.hardware import Moving, adapter_option, camera_option, imu_option
from openant_tools.cli.log import mention
from openant_tools.cli.options import json_option
from openant_tools.cli.virtual_for_command import virtual_option
from openant_tools.numbers import number

__all__ = ["bringup"]


@click.command(cls=Moving)
@click.option(
    "--robot",
    type=click.Path(path_type=Path),
    required=True,
    metavar="DIR",
    help="The robot's folder; made where it is missing.",
)
@click.option(
    "--kit", type=click.Choice(["standard", "lite"]), help="Of a new robot. Default: standard, or the scenario's."
)
@adapter_option
@imu_option
@camera_option
@virtual_option
@click.option("--yes", is_flag=True, help="No questions: grant everything, take every default.")
@click.option("--again", is_flag=True, help="Do every step, also those that stand.")
@json_option
def bringup(
    robot: Path,
    kit: str | None,
    port: str | None,
    imu: str | None,
    camera: str | None,
    virtual_source: str | None,
    yes: bool,
    again: bool,
    json_file: Path | None,
) -> int:
    """Walk from loose motors to a robot with a passport, step by step; what stands is not done again.

    After Ctrl-C the same command goes on. With --virtual it happens on a virtual robot in its box (or the one of a
    scenario), in stepped time, whose hands do what hands must do. Exit code 1: a step is not green; its finding says why.

    \b
      openant bringup --robot my-ant
      openant bringup --robot try-ant --virtual --yes
    """
    from openant_tools.bringup.walk import WALK, next_step, standing, walk
    from openant_tools.cli.face import CommandFace
    from openant_tools.files import json_text, write_text
    from openant_tools.procedure.step import Bench, Declined
    from openant_tools.robot.folder import RobotFolder, create_robot

    began = time.monotonic()
    with contextlib.ExitStack() as stack:
        hands = None
        control: str | None = None
        if virtual_source is not None:
            from openant_tools.bringup.persistent_robot import persistent_robot

            box = stack.enter_context(persistent_robot(virtual_source, robot))
            hands, control = box.builder, box.control
            port, imu, camera, kit = port or box.bus, imu or box.imu, camera or box.camera, kit or box.kit
        folder = RobotFolder.at(robot) if (robot / "robot.toml").is_file() else create_robot(robot, kit or "standard")
        face = CommandFace(yes=yes, hands=None if hands is None else hands.do)
        if hands is not None:
            hands.resume(standing(folder)["legs"].state == "ok")
        bench = Bench(folder, port, imu, camera, control)
        try:
            walk(bench, face, again=again)
        except (Declined, KeyboardInterrupt):
            left = next_step(folder, real=not bench.virtual)
            if left is not None:
                part = "" if left.left is None else f", {left.left.words} done"
                mention(f"\nleft at {left.step.title}{part}; torque is off, and the same command goes on there")
            raise
        states = standing(folder, real=not bench.virtual)
    red = [name for name, now in states.items() if now.state != "ok"]
    result: dict[str, Any] = {
        "ok": not red,
        "seconds": round(time.monotonic() - began, 1),
        "steps": {
            name: {"state": now.state, "finding": None if now.finding is None else now.finding.as_json()}
            for name, now in states.items()
        },
    }
    if json_file is not None:
        write_text(json_file, json_text(result))
    if red:
        click.echo(f"not passed: {', '.join(WALK[name].title for name in red)}; the findings are in {folder.findings}")
        return 1
    click.echo(f"{folder.passport}: every step says yes ({number(time.monotonic() - began, 's', decimals=0)})")
    return 0
