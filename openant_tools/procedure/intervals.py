"""Intervals of 95 %, as findings and scores state them: of a figure, of a proportion."""

from __future__ import annotations

import math
from collections.abc import Sequence
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

    @classmethod
    def of_mean(cls, values: Sequence[float]) -> Interval:
        """The mean of (n,) independent values; of fewer than two nobody knows how far it is off."""
        mean, error, freedom = _mean(values)
        return cls._about(mean, error, freedom)

    @classmethod
    def of_difference(cls, values: Sequence[float], others: Sequence[float]) -> Interval:
        """The mean of (n,) independent values less that of (m,) others (Welch, Biometrika 34, 1947)."""
        (a, error_a, n), (b, error_b, m) = _mean(values), _mean(others)
        error = math.hypot(error_a, error_b)
        freedom = error**4 / (error_a**4 / n + error_b**4 / m) if error > 0.0 and n and m else math.nan
        return cls._about(a - b, error, freedom)

    @classmethod
    def _about(cls, value: float, error: float, freedom: float) -> Interval:
        from scipy.stats import t

        half = error * float(t.ppf(0.975, freedom)) if error > 0.0 else error
        return cls(value, value - half, value + half)

    def as_json(self) -> dict[str, float]:
        return {"value": self.value, "low": self.low, "high": self.high}


def _mean(values: Sequence[float]) -> tuple[float, float, int]:
    """Of (n,) values the mean, its standard error (NaN of a single one), and n − 1."""
    n = len(values)
    error = float(np.std(values, ddof=1)) / math.sqrt(n) if n > 1 else math.nan
    return float(np.mean(values)), error, n - 1


def wilson(k: int, n: int) -> tuple[float, float]:
    """The 95 % interval of a proportion of which k of n were seen (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    if not n:
        return 0.0, 1.0
    share, z2 = k / n, Z_95**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = Z_95 / (1 + z2 / n) * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)
