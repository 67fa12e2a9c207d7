"""Intervals of 95 %, as findings and scores state them: of a figure, of a proportion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Z_95", "Interval", "wilson"]

#: standard deviations on either side of a normal distribution's mean that hold 95 % of it
Z_95 = 1.959964


@dataclass(frozen=True)
class Interval:
    """A figure and its interval of 95 %."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, draws: NDArray[np.float64]) -> Interval:
        """Median and the middle 95 % of (b,) draws."""
        low, value, high = np.quantile(draws, [0.025, 0.5, 0.975])
        return cls(float(value), float(low), float(high))

    def as_json(self) -> dict[str, float]:
        return {"value": self.value, "low": self.low, "high": self.high}


def wilson(k: int, n: int) -> tuple[float, float]:
    """The 95 % interval of a proportion of which k of n were seen (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    if not n:
        return 0.0, 1.0
    share, z2 = k / n, Z_95**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = Z_95 / (1 + z2 / n) * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)
