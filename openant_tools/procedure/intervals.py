"""The 95 % interval of a proportion, as findings and scores state it."""

from __future__ import annotations

import math

__all__ = ["Z_95", "wilson"]

#: standard deviations on either side of a normal distribution's mean that hold 95 % of it
Z_95 = 1.959964


def wilson(k: int, n: int) -> tuple[float, float]:
    """The 95 % interval of a proportion of which k of n were seen (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    if not n:
        return 0.0, 1.0
    share, z2 = k / n, Z_95**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = Z_95 / (1 + z2 / n) * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)
