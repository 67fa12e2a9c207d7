"""How late a log's velocities are by the log's own word: no simulation has a part in it.

A servo filters its velocity register, and some read it before the position. The shift that makes velocities the slope of the
same log's positions says by how much, run by run; how runs differ says how well that is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.recording.run import Run

__all__ = ["velocity_delay"]

Array = NDArray[np.float64]

#: s: shifts that are tried, their spacing, and over how long a slope is taken
SHIFTS, SPACING_S, SPAN_S = (-0.02, 0.1), 0.001, 0.02
#: share of the velocities' own size that may be left where the two are compared at all, and samples needed
ALIKE, LEAST_ROWS = 0.5, 50
#: s, no log tells it better
LEAST_STD_S = 0.001


@dataclass(frozen=True)
class VelocityDelay:
    """By how much velocities lag positions, s, and its standard deviation."""

    delay_s: float
    std_s: float

    def beyond(self, delay_s: float) -> float:
        """Probability that it is more."""
        return 0.5 * (1 + math.erf((self.delay_s - delay_s) / self.std_s / math.sqrt(2)))


def velocity_delay(runs: Sequence[Run], joints: Sequence[str]) -> VelocityDelay | None:
    """The lag of all runs' velocities behind the slopes of their positions; None where nothing tells.

    Rows that are too far apart for a slope tell less, but they tell: both ends of it lie around the row.
    """
    found = [late for run in runs for joint in joints if (late := _delay_s(run, joint)) is not None]
    if not found:
        return None
    spread = float(np.std(found, ddof=1)) / math.sqrt(len(found)) if len(found) > 1 else math.inf
    return VelocityDelay(float(np.mean(found)), max(spread, LEAST_STD_S)) if math.isfinite(spread) else None


def _delay_s(run: Run, joint: str) -> float | None:
    if not run.has("pos", [joint]) or not run.has("vel", [joint]):
        return None
    pos, vel = run.column(f"pos.{joint}"), run.column(f"vel.{joint}")
    seen = np.isfinite(pos) & np.isfinite(vel)
    t, pos, vel = run.t[seen], pos[seen], vel[seen]
    if len(t) < LEAST_ROWS:
        return None
    half = max(SPAN_S / 2, float(np.median(np.diff(t))))
    shifts = np.arange(*SHIFTS, SPACING_S)
    inside = (t > t[0] + SHIFTS[1] + half) & (t < t[-1] + SHIFTS[0] - half)
    at = t[inside][:, None] - shifts
    slope = (np.interp(at + half, t, pos) - np.interp(at - half, t, pos)) / (2 * half)
    left: Array = np.mean(np.square(vel[inside, None] - slope), axis=0)
    best = int(np.argmin(left))
    told = left[best] < ALIKE**2 * float(np.mean(vel[inside] ** 2)) and 0 < best < len(shifts) - 1
    return float(shifts[best]) if told else None
