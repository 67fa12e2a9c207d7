"""A run: what was commanded and what was measured, as columns in SI units (formats, section 1)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BODY_COLUMNS", "JOINT_SIGNALS", "Facts", "Run"]

Array = NDArray[np.float64]

#: signal → unit, one column `signal.joint` per joint. `err` holds words, all others numbers.
JOINT_SIGNALS: Mapping[str, str] = {
    "cmd": "rad", "pos": "rad", "vel": "rad/s", "cur": "A", "pwm": "1", "load": "1", "torque": "1", "volt": "V",
    "temp": "°C", "ok": "1", "err": "", "rtt": "s", "tick": "ms",
}  # fmt: skip

#: column of the body or of the host's loop → unit.
BODY_COLUMNS: Mapping[str, str] = {
    "gyro.x": "rad/s", "gyro.y": "rad/s", "gyro.z": "rad/s",
    "acc.x": "m/s²", "acc.y": "m/s²", "acc.z": "m/s²",
    "base.x": "m", "base.y": "m", "base.z": "m", "base.yaw": "rad",
    "base.qw": "1", "base.qx": "1", "base.qy": "1", "base.qz": "1",
    "cmd_t": "s", "wake": "s",
}  # fmt: skip


@dataclass(frozen=True)
class Facts:
    """What is known about a run besides its samples; the JSON beside a table. All optional but `joints`."""

    joints: tuple[str, ...]
    motors: Mapping[str, str] = field(default_factory=dict)
    setup: str | None = None
    protocol: str | None = None
    registers: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    repeat_of: str | None = None
    heading_rad: float | None = None
    model: str | None = None
    supply_v: float | None = None
    ambient_c: float | None = None
    resolution: Mapping[str, float] = field(default_factory=dict)
    notes: str | None = None
    #: every other key, kept as found
    extra: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """One recording as columns over a common time axis.

    Attributes:
        name: what the run is called in reports and in `repeat_of`.
        facts: what is known besides the samples.
        t: (n,) s, host monotonic clock, strictly increasing; the spacing may jitter.
        columns: name → (n,) values. A missing sample is NaN (or "" in `err.J`); a missing column is absent.
        path: the file it was read from, if any.

    Timing: at `t` the row is sampled; its `cmd` leaves at `cmd_t`, or right after `t`, and holds until the next.
    """

    name: str
    facts: Facts
    t: Array
    columns: Mapping[str, NDArray[Any]]
    path: Path | None = None

    @property
    def joints(self) -> tuple[str, ...]:
        return self.facts.joints

    @property
    def model_path(self) -> Path | None:
        """The MJCF that the run names; a relative path leads from the run's own folder."""
        if self.facts.model is None:
            return None
        return (self.path.parent if self.path else Path()) / self.facts.model

    def facts_at(self, folder: Path) -> Facts:
        """The facts as they read in another folder: a relative `model` still leads to the same file."""
        if self.model_path is None or Path(str(self.facts.model)).is_absolute():
            return self.facts
        return replace(self.facts, model=os.path.relpath(self.model_path, folder))

    @property
    def duration_s(self) -> float:
        return float(self.t[-1] - self.t[0]) if len(self.t) else 0.0

    def has(self, signal: str, joints: Iterable[str] | None = None) -> bool:
        """Whether `signal` is there with at least one valid sample for any of the joints (default: all)."""
        for joint in self.joints if joints is None else joints:
            values = self.columns.get(f"{signal}.{joint}")
            if values is not None and bool((values != "" if values.dtype.kind in "OU" else np.isfinite(values)).any()):
                return True
        return False

    def signal(self, signal: str, joints: Sequence[str] | None = None, default: float = np.nan) -> Array:
        """The columns `signal.J` side by side, (n, joints); `default` stands where a joint has no such column."""
        joints = self.joints if joints is None else joints
        out = np.full((len(self.t), len(joints)), default)
        for k, joint in enumerate(joints):
            column = self.columns.get(f"{signal}.{joint}")
            if column is not None:
                out[:, k] = column
        return out

    def column(self, name: str) -> Array:
        """One column, (n,), NaN throughout where the run has none of that name."""
        values = self.columns.get(name)
        return np.full(len(self.t), np.nan) if values is None else np.asarray(values, float)

    @property
    def command_times(self) -> Array:
        """(n,) s, when each row's command takes effect: `cmd_t`, or `t` where that is missing."""
        cmd_t = self.column("cmd_t")
        return np.where(np.isfinite(cmd_t), cmd_t, self.t)

    def select(self, joints: Sequence[str]) -> Run:
        """The same run without the columns of its other joints."""
        dropped = set(self.joints) - set(joints)
        kept = {name: values for name, values in self.columns.items() if name.partition(".")[2] not in dropped}
        return replace(self, facts=replace(self.facts, joints=tuple(joints)), columns=kept)

    def between(self, start: float, stop: float) -> Run:
        """The rows with start ≤ t < stop (s)."""
        rows = (self.t >= start) & (self.t < stop)
        return replace(self, t=self.t[rows], columns={name: values[rows] for name, values in self.columns.items()})
