"""What a run's numbers can be: time that runs forward, units that are SI, signals that an analysis needs.

The limits are wide, so that no honest log of any position-controlled robot is refused, and still tell degrees from
radians, milliamperes from amperes, percent from fractions and raw counts from SI.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import literal, number
from openant_tools.recording.run import BODY_COLUMNS, JOINT_SIGNALS, Array, Run

__all__ = ["LIMITS", "Limit", "check_names", "check_run", "check_time", "need_signals", "problems"]


@dataclass(frozen=True)
class Limit:
    """What a signal cannot exceed, and the likeliest slip where it does."""

    low: float
    high: float
    remedy: str


_ANGLE = Limit(-8 * np.pi, 8 * np.pi, "angles are in rad (degrees × π/180), a joint's within four turns")
_GYRO = Limit(-100.0, 100.0, "turn rates are in rad/s (deg/s × π/180)")
_ACC = Limit(-400.0, 400.0, "accelerations are in m/s² (g × 9.81, counts × their scale)")
_BASE = Limit(-100.0, 100.0, "the body's place is in m (mm × 0.001)")
_UNIT = Limit(-1.05, 1.05, "a quaternion has norm 1")
_FRACTION = Limit(-1.1, 1.1, "duty and load are fractions of full, −1…1 (percent × 0.01, PWM counts ÷ 885)")
_FLAG = Limit(0.0, 1.0, "this column is a flag: 1 or 0")

#: signal (of a joint) or column (of the body) → limit
LIMITS: Mapping[str, Limit] = {
    "cmd": _ANGLE,
    "pos": _ANGLE,
    "vel": Limit(-100.0, 100.0, "velocities are in rad/s (rpm × 2π/60, deg/s × π/180)"),
    "cur": Limit(-100.0, 100.0, "currents are in A (mA × 0.001)"),
    "pwm": _FRACTION,
    "load": _FRACTION,
    "torque": Limit(0.0, 1.0, "`torque` is 1 while torque is enabled, else 0; a torque in N·m goes under another name"),
    "volt": Limit(0.0, 60.0, "voltages are in V (servo registers count 0.1 V)"),
    "temp": Limit(-40.0, 150.0, "temperatures are in °C (K − 273.15)"),
    "ok": _FLAG,
    "rtt": Limit(0.0, 10.0, "round trips are in s (ms × 0.001)"),
    "tick": Limit(0.0, 32767.0, "ticks are the servo's register 120, in ms, 0…32767"),
    "gyro.x": _GYRO, "gyro.y": _GYRO, "gyro.z": _GYRO,
    "acc.x": _ACC, "acc.y": _ACC, "acc.z": _ACC,
    "base.x": _BASE, "base.y": _BASE, "base.z": _BASE,
    "base.yaw": Limit(-40 * np.pi, 40 * np.pi, "headings are in rad (degrees × π/180)"),
    "base.qw": _UNIT, "base.qx": _UNIT, "base.qy": _UNIT, "base.qz": _UNIT,
    "wake": Limit(-60.0, 60.0, "`wake` is in s"),
}  # fmt: skip

#: s; rows of a motion further apart than this are in another unit of time
_SLOWEST_ROW = 10.0


def check_names(names: Sequence[str], where: str) -> None:
    """Raise where a column has no name, one that cannot be printed, or one that another has."""
    for name in names:
        if not name or not name.isprintable():
            raise BadInput(
                f"a column is named {name[:40]!r}", where=where, remedy="name it, and close the quotes of the header"
            )
        if list(names).count(name) > 1:
            raise BadInput(f"column {name} is there twice", where=where, remedy="keep one of them")


def check_run(run: Run, where: str) -> None:
    """Raise the first of `problems` that a run has."""
    for problem in problems(run, where):
        raise problem


def problems(run: Run, where: str) -> Iterator[BadInput]:
    """Everything that cannot be in a run: columns of joints that it has not, time that does not run forward, values that
    cannot be in the unit that they should be in; of each, the first place."""
    yield from _column_problems([*run.columns], run.joints, where)
    yield from _time_problems(run.t, where)
    for name, values in run.columns.items():
        limit = LIMITS.get(name) or LIMITS.get(name.partition(".")[0])
        if limit is not None and values.dtype.kind in "fiub":
            yield from _value_problems(name, np.asarray(values, float), limit, run.t, where)
    quaternion = run.signal("base", ("qw", "qx", "qy", "qz"))
    with np.errstate(invalid="ignore"):
        wrong = np.flatnonzero(np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > 0.05)
    if len(wrong):
        norm = float(np.linalg.norm(quaternion[wrong[0]]))
        place = _place(where, "base.qw|qx|qy|qz", int(wrong[0]), run.t)
        yield BadInput(f"a quaternion of norm {number(norm)} is no orientation", where=place, remedy="normalise it")
    # At rest and on average when walking, an accelerometer shows 9.81 m/s²; a median of 1 is the same in g.
    with np.errstate(invalid="ignore"):
        norm_acc = np.linalg.norm(run.signal("acc", ("x", "y", "z")), axis=1)
    if np.isfinite(norm_acc).any() and 0.8 < float(np.nanmedian(norm_acc)) < 1.25:
        yield BadInput(
            f"the body's specific force is {number(float(np.nanmedian(norm_acc)))} in the median",
            where=f"{where}, columns acc.x|y|z",
            remedy="accelerations are in m/s² (g × 9.81)",
        )
    command = run.columns.get("cmd_t")
    if command is not None:
        away = np.flatnonzero((command < run.t[0] - 3600.0) | (command > run.t[-1] + 3600.0))
        if len(away):
            yield BadInput(
                f"cmd_t = {literal(command[away[0]])} s is not on the clock of t",
                where=_place(where, "cmd_t", int(away[0]), run.t),
                remedy="give both on the host's monotonic clock, in s",
            )


def _column_problems(names: Sequence[str], joints: Sequence[str], where: str) -> Iterator[BadInput]:
    """Columns that speak of a joint that is not among `joints`, and joints that have none.

    Columns of signals that the format does not know are welcome.
    """
    body = {name.partition(".")[0] for name in BODY_COLUMNS if "." in name}
    for name in names:
        signal, dot, joint = name.partition(".")
        if dot and signal in JOINT_SIGNALS and joint not in joints:
            yield BadInput(
                f"no such joint: {joint}",
                where=f"{where}, column {name}",
                remedy=_nearest(joint, joints) or f"the run's `joints` are {', '.join(joints)}",
            )
        if dot and signal in body and name not in BODY_COLUMNS:
            known = [column for column in BODY_COLUMNS if column.startswith(f"{signal}.")]
            yield BadInput(
                f"no such column: {name}",
                where=where,
                remedy=f"the columns of {signal} are {', '.join(known)}",
            )
    signals = {(name.partition(".")[0], name.partition(".")[2]) for name in names}
    for joint in joints:
        if not any((signal, joint) in signals for signal in JOINT_SIGNALS):
            columns = [name for name in names if name != "t"]
            yield BadInput(
                f"joint {joint} has no column",
                where=where,
                remedy=_nearest(f"pos.{joint}", columns) or f"add pos.{joint} or take it out of `joints`",
            )


def check_time(t: Array, where: str) -> None:
    """Raise unless `t` (n,) s has rows, is finite and strictly increasing."""
    for problem in _time_problems(t, where):
        raise problem


def _time_problems(t: Array, where: str) -> Iterator[BadInput]:
    if not len(t):
        yield BadInput("the run is empty: no rows", where=where, remedy="record again, or export the rows you mean")
        return
    wrong = np.flatnonzero(~np.isfinite(t))
    if len(wrong):
        row = int(wrong[0])
        yield BadInput(
            f"t is {t[row]}", where=f"{where}, column t, row {row + 1}", remedy="give every row its time, in s"
        )
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if len(back):
        row = int(back[0]) + 1
        how = "repeats" if t[row] == t[row - 1] else "runs backwards"
        yield BadInput(
            f"time {how}: t = {literal(t[row], 12)} s after {literal(t[row - 1], 12)} s",
            where=f"{where}, column t, row {row + 1}",
            remedy="sort the rows by time and keep one of each",
        )


def need_signals(run: Run, signals: Sequence[str], where: str) -> None:
    """Raise unless the run has each signal, with a valid sample, for at least one joint."""
    for signal in signals:
        if run.has(signal):
            continue
        wanted = f"{signal}.{run.joints[0]}"
        if any(f"{signal}.{joint}" in run.columns for joint in run.joints):
            what, remedy = f"{signal} has no valid sample", "every value of it is missing; record again"
        else:
            what = f"there is no {signal} column"
            remedy = _nearest(wanted, list(run.columns)) or f"needed are {' and '.join(f'{s}.JOINT' for s in signals)}"
        raise BadInput(what, where=where, remedy=remedy)
    if "cmd" in signals and len(run.t) > 1 and float(np.median(np.diff(run.t))) > _SLOWEST_ROW:
        raise BadInput(
            f"rows are {number(float(np.median(np.diff(run.t))), 's')} apart",
            where=f"{where}, column t",
            remedy="t is in s (ms × 0.001, µs × 1e-6, ns × 1e-9)",
        )


def _value_problems(name: str, values: Array, limit: Limit, t: Array, where: str) -> Iterator[BadInput]:
    infinite = np.isinf(values)
    if infinite.any():
        row = int(np.flatnonzero(infinite)[0])
        yield BadInput(
            f"{values[row]} is no measurement", where=_place(where, name, row, t), remedy="leave a missing sample empty"
        )
    flag = limit.low == 0.0 and limit.high == 1.0
    wrong: NDArray[np.bool_] = (values < limit.low) | (values > limit.high)
    if flag:
        wrong |= np.isfinite(values) & (values != 0.0) & (values != 1.0)
    if wrong.any():
        # The farthest value is the one that a reader sees at once to be wrong.
        row = int(np.flatnonzero(wrong)[0])
        unit = JOINT_SIGNALS.get(name.partition(".")[0]) or BODY_COLUMNS.get(name, "")
        shown = literal(values[row]) + (f" {unit}" if unit not in ("", "1") else "")
        yield BadInput(f"{shown} cannot be", where=_place(where, name, row, t), remedy=limit.remedy)


def _place(where: str, column: str, row: int, t: Array) -> str:
    return f"{where}, column {column}, row {row + 1} (t = {literal(t[row])} s)"


def _nearest(name: str, known: Sequence[str]) -> str | None:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"did you mean {near[0]}?" if near else None
