"""What a run holds, at a glance: signals, rate and jitter, gaps, loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from openant_tools.numbers import number
from openant_tools.recording.run import BODY_COLUMNS, JOINT_SIGNALS, Run

__all__ = ["JointSummary", "RowGap", "RunSummary", "summarize", "words_of_pictures"]

#: a gap is longer than this many median rows
GAP_ROWS = 3.0


@dataclass(frozen=True)
class RowGap:
    """A stretch without rows: the row before it, its start (s) and its length (s)."""

    row: int
    t: float
    duration_s: float


@dataclass(frozen=True)
class JointSummary:
    """One joint: its servo, the signals it has, the share of rows without an answer, and the words why."""

    joint: str
    motor: str | None
    signals: tuple[str, ...]
    lost: float
    errors: Mapping[str, int]
    pos_low: float | None
    pos_high: float | None


@dataclass(frozen=True)
class RunSummary:
    """The figures of `openant rec info`; times in s, rates in Hz."""

    rows: int
    start_s: float
    duration_s: float
    rate_hz: float
    period_s: float
    period_low_s: float
    period_high_s: float
    period_longest_s: float
    gaps: tuple[RowGap, ...]
    joints: tuple[JointSummary, ...]
    body: tuple[str, ...]
    other: tuple[str, ...]


def summarize(run: Run) -> RunSummary:
    """The figures of a run.

    The period is the median spacing of rows, low and high its 1 % and 99 % quantiles. A row of a joint is lost where
    `ok` is 0, or, in a run without `ok`, where `pos` is missing.
    """
    spacing = np.diff(run.t) if len(run.t) > 1 else np.array([np.nan])
    period = float(np.median(spacing))
    wide = np.flatnonzero(spacing > GAP_ROWS * period)
    joints = []
    for joint in run.joints:
        signals = tuple(signal for signal in JOINT_SIGNALS if run.has(signal, [joint]))
        ok, pos = run.column(f"ok.{joint}"), run.column(f"pos.{joint}")
        lost = 1.0 - float(np.nanmean(ok)) if np.isfinite(ok).any() else float(np.isnan(pos).mean())
        joints.append(
            JointSummary(
                joint=joint,
                motor=run.facts.motors.get(joint),
                signals=signals,
                lost=lost,
                errors=_counts(run, f"err.{joint}"),
                pos_low=float(np.nanmin(pos)) if np.isfinite(pos).any() else None,
                pos_high=float(np.nanmax(pos)) if np.isfinite(pos).any() else None,
            )
        )
    of_joints = {f"{signal}.{joint}" for signal in JOINT_SIGNALS for joint in run.joints}
    return RunSummary(
        rows=len(run.t),
        start_s=float(run.t[0]),
        duration_s=run.duration_s,
        rate_hz=1.0 / period,
        period_s=period,
        period_low_s=float(np.quantile(spacing, 0.01)),
        period_high_s=float(np.quantile(spacing, 0.99)),
        period_longest_s=float(spacing.max()),
        gaps=tuple(RowGap(int(row), float(run.t[row]), float(spacing[row])) for row in wide),
        joints=tuple(joints),
        body=tuple(name for name in BODY_COLUMNS if name in run.columns),
        other=tuple(name for name in run.columns if name not in of_joints and name not in BODY_COLUMNS),
    )


def _counts(run: Run, column: str) -> dict[str, int]:
    words: Any = run.columns.get(column, np.array([], dtype=object))
    names, counts = np.unique(np.array([word for word in words if word], dtype=str), return_counts=True)
    return {str(name): int(count) for name, count in zip(names, counts, strict=True)}


def words_of_pictures(count: int, size: float, seconds: float) -> str:
    """So many pictures of `size` bytes in all, and what an hour of them would weigh."""
    an_hour = f", {number(size / 1e6 * 3600 / seconds, decimals=0)} MB an hour" if count and seconds else ""
    return f"{count} pictures, {number(size / 1e6)} MB{an_hour}"
