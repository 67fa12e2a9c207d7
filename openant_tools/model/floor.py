"""What no model could beat: the floor of the gap (formats, section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.model.gap import gap
from openant_tools.recording.run import Run

__all__ = ["floors", "resolution"]

Array = NDArray[np.float64]
#: smaller changes are rounding of the numbers, not steps of a sensor
LEAST_STEP = 1e-9


def resolution(run: Run, signal: str, joint: str) -> float:
    """The sensor's step, in the signal's unit: from the run's facts, else the smallest change in the data; 0 if there is none."""
    known = run.facts.resolution.get(f"{signal}.{joint}", run.facts.resolution.get(signal))
    if known is not None:
        return known
    steps = np.abs(np.diff(run.column(f"{signal}.{joint}")))
    steps = steps[np.isfinite(steps) & (steps > LEAST_STEP)]
    return float(steps.min()) if len(steps) else 0.0


def floors(runs: Sequence[Run], joints: Sequence[str], signal: str = "pos") -> tuple[Array, bool]:
    """(joints,) rms that remains with any model, and whether repeats of the same commands have shown it.

    A joint of which no repeat says anything has what its sensor's resolution leaves: the coarsest step / √12.
    """
    by_resolution = np.array([max(resolution(run, signal, joint) for run in runs) for joint in joints]) / math.sqrt(12)
    by_name = {run.name: run for run in runs}
    pairs = [(run, by_name[run.facts.repeat_of]) for run in runs if run.facts.repeat_of in by_name]
    squares = np.full((len(pairs), len(joints)), np.nan)
    for k, (again, once) in enumerate(pairs):
        second, first = again.signal(signal, joints), once.signal(signal, joints)
        t = again.t - again.t[0] + once.t[0]
        for j in range(len(joints)):
            seen = np.isfinite(first[:, j])
            if seen.sum() > 1:
                # Two repeats differ by both their noises, so that each has half of the squared difference.
                squares[k, j] = gap(second[:, j], np.interp(t, once.t[seen], first[seen, j])) ** 2 / 2
    known = np.isfinite(squares)
    mean = np.where(known, squares, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), np.sqrt(mean), by_resolution), bool(known.any())
