"""`openant check`: the daily check of a robot that has its passport."""

from __future__ import annotations

import json
from pathlib import Path

import click

from openant_tools.cli.calib import bench_of, step_options

__all__ = ["check"]


@click.command()
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
    from openant_tools.cli.face import echo_finding
    from openant_tools.files import write_text
    from openant_tools.procedure.finding import keep
    from openant_tools.procedure.step import drive

    with bench_of(robot, port, imu, camera, virtual_source, yes) as (bench, face):
        finding = drive(checking(bench), face)
        keep(finding, bench.folder)
    echo_finding(finding)
    if json_file is not None:
        write_text(json_file, json.dumps(finding.as_json(), indent=1, ensure_ascii=False) + "\n")
    return 0 if finding.ok else 1
