"""The gap between a robot and its simulation, as a number: the one definition (formats, section 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.numbers import literal

__all__ = ["HORIZON_S", "Gap", "excess", "gap", "share_closed"]

Array = NDArray[np.float64]

#: seconds between re-initialisations from measurement, where nothing else is said
HORIZON_S = 0.5


@dataclass(frozen=True)
class Gap:
    """Root mean square of measured minus simulated position, rad: re-initialised every HORIZON_S, and over full runs."""

    horizon: float
    full: float

    def as_json(self) -> dict[str, float]:
        return {f"gap_{literal(HORIZON_S)}_s_rad": self.horizon, "gap_full_rad": self.full}


def gap(measured: Array, simulated: Array) -> float:
    """Root mean square of measured minus simulated over all joints and samples, in their unit; NaN where none compare.

    Args:
        measured, simulated: (rows, joints); a row and joint counts where both are finite.
    """
    error = measured - simulated
    error = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(error**2))) if error.size else math.nan


def excess(gap: float, floor: float) -> float:
    """√(gap² − floor²), 0 inside the floor."""
    return math.sqrt(max(0.0, gap**2 - floor**2))


def share_closed(before: float, after: float, floor: float) -> float:
    """The share of the excess gap that is gone: 1 − excess after / excess before; NaN where there was none."""
    there = excess(before, floor)
    return 1.0 - excess(after, floor) / there if there > 0 else math.nan
