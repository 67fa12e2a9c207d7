"""A table becomes a native recording, value for value."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.recording.run import BODY_COLUMNS, JOINT_SIGNALS, Run
from openant_tools.recording.telemetry import IMU_FIELDS, POSE_FIELDS, ServoChannel, Telemetry
from openant_tools.recording.writer import RecordingWriter, recording_path

__all__ = ["import_run"]

#: signal → field of `Servo`, where they differ
_FIELDS = {"cmd": "goal"}
_FLAGS = ("ok", "torque")
_NOT_REGISTERS = ("cmd", "torque", "ok", "err", "rtt")


def import_run(
    run: Run, path: str | Path, *, progress: Callable[[float, str], None] = lambda share, words: None
) -> Path:
    """Write `run` as a native recording, its values in SI as they are; returns the file's path.

    The file appears when it is whole. Reading it gives the same rows and columns again.

    Raises:
        BadInput: there is such a file already.
    """
    path = recording_path(path)
    if path.exists():
        raise BadInput("there is a recording already", where=path, remedy="name another file with --out")
    extra = {
        name: float if values.dtype.kind in "fiub" else str
        for name, values in run.columns.items()
        if name not in BODY_COLUMNS and not _of_a_joint(name, run)
    }
    channels = [
        ServoChannel(
            joint,
            run.facts.motors.get(joint, ""),
            id=-1,
            scales={
                signal: 1.0
                for signal in JOINT_SIGNALS
                if signal not in _NOT_REGISTERS and f"{signal}.{joint}" in run.columns
            },
        )
        for joint in run.joints
    ]
    telemetry = Telemetry(channels, counts=False, extra=extra)
    unfinished = path.with_name(f".{path.stem}.part.mcap")
    try:
        with RecordingWriter(
            unfinished, facts=run.facts_at(path.parent), channels=channels, telemetry=telemetry, overwrite=True,
            clock=lambda: float(run.t[0]),
        ) as writer:  # fmt: skip
            _write_rows(run, list(extra), telemetry, writer, progress)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)
    return path


def _of_a_joint(name: str, run: Run) -> bool:
    signal, _, joint = name.partition(".")
    return signal in JOINT_SIGNALS and joint in run.joints


def _write_rows(
    run: Run, extra: list[str], telemetry: Telemetry, writer: RecordingWriter, progress: Callable[[float, str], None]
) -> None:
    signals = {
        joint: [
            (signal, run.columns[f"{signal}.{joint}"]) for signal in JOINT_SIGNALS if f"{signal}.{joint}" in run.columns
        ]
        for joint in run.joints
    }
    rest = [(name, run.columns[name]) for name in ("cmd_t", "wake", *extra) if name in run.columns]
    imu = run.signal("gyro", ("x", "y", "z")), run.signal("acc", ("x", "y", "z"))
    pose = {field: run.column(name) for field, name in POSE_FIELDS.items()}
    has_imu = any(name in run.columns for name in IMU_FIELDS.values())
    has_pose = any(name in run.columns for name in POSE_FIELDS.values())
    for row, t in enumerate(run.t.tolist()):
        if row % 1000 == 0:
            progress(row / len(run.t), f"importing {run.name}")
        joints = {
            joint: {_FIELDS.get(signal, signal): value for signal, value in _valid(columns, row)}
            for joint, columns in signals.items()
        }
        writer.row(t, telemetry.row(t, joints, dict(_valid(rest, row))))
        if has_imu and any(np.isfinite(part[row]).any() for part in imu):
            writer.imu(t, imu[0][row].tolist(), imu[1][row].tolist())
        if has_pose:
            values = {field: float(column[row]) for field, column in pose.items()}
            if any(value == value for value in values.values()):
                writer.pose_fields(t, values)


def _valid(columns: list[tuple[str, Any]], row: int) -> list[tuple[str, Any]]:
    """Name and value of the columns that have one in this row, as Python's own numbers and words."""
    found: list[tuple[str, Any]] = []
    for name, values in columns:
        value = values[row]
        if isinstance(value, str):
            if value:
                found.append((name, value))
        elif value == value:  # not NaN
            found.append((name, bool(value) if name in _FLAGS else float(value)))
    return found
