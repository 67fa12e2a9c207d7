"""`openant check`: the daily check of a robot that has its passport."""

from __future__ import annotations

from pathlib import Path

import click

from openant_tools.cli.calib import bench_of, run_and_keep, show_finding, step_options
from openant_tools.cli.hardware import Moving

__all__ = ["check"]


@click.command(cls=Moving)
@step_options
def check(
    robot: Path | None,
    port: str | None,
    imu: str | None,
    camera: str | None,
    virtual_source: str | None,
    yes: bool,
    json_file: Path | None,
) -> int:
    """Two minutes before a session: is the robot as its passport has it?

    Bus, supply, temperatures and IMU at rest; then, on the stand, a slow sweep of every joint and a 20 s twitch against the
    calibrated model. Exit code 1 names the joint and the likely part: screw, gear, foot, cable.
    """
    from openant_tools.bringup.check import check as checking

    with bench_of(robot, port, imu, camera, virtual_source, yes) as (bench, face):
        finding = run_and_keep(checking(bench), bench, face)
    return show_finding(finding, json_file)
