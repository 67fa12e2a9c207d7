"""How far rows lie off those about them: what is left of a log when everything slow is taken out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

__all__ = ["against_neighbours"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]

#: s about a row that it is compared with
ABOUT_S = 0.1


def against_neighbours(x: Floats, t: Array) -> Array:
    """(robots, rows, columns) how far each row lies off the mean of those `ABOUT_S` about it; 0 where nobody knows."""
    known = np.isfinite(x)
    values = np.where(known, x, np.float32(0))
    rows = max(3, round(ABOUT_S / float(np.median(np.diff(t)))) | 1)
    usual = _about(values, rows) / np.maximum(_about(known, rows), 1e-6)
    return np.where(known, values - usual, 0)


def _about(x: Floats | Bools, rows: int) -> Array:
    """(robots, rows, columns) means over so many rows about each, of nothing beyond the first and the last."""
    out: Array = uniform_filter1d(x.astype(np.float64), rows, axis=1, mode="constant")
    return out
