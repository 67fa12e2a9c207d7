"""Between which values the size of a cause lies, 95 %, as robots whose answers were opened have shown.

How exactly a fit is known by its own curvature says little: tolerances can do a part of what most causes do, and a fit leaves it to
them. What of the gap a cause leaves where tolerances alone leave some says how unlike theirs it is, and so how well its size is known.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

from openant_tools.effects.effect import Quantity
from openant_tools.gap.descent import SPREAD
from openant_tools.sysid.intervals import TWO_SIDED_95

__all__ = ["FILE", "KINDS", "Known", "ends", "spread", "spreads"]

#: what is learned: how far logarithms of sizes are off where a cause leaves as much as tolerances alone, of causes at random times, and of
#: shapes
KINDS = ("size", "random", "shape")
#: where they lie in this package
FILE = "size_interval.json"
#: errors of them are wider than a normal distribution's: Student's with 4 degrees of freedom, and of that the 97.5 % quantile
FREEDOM, QUANTILE = 4, 2.776


@dataclass(frozen=True)
class Known:
    """What is known of one coordinate of a cause that was fitted.

    Attributes:
        x: it. largest: of all coordinates of the cause that are sizes, in what is large of each. std: by the fit. tolerance: |x| within
            which robots of one build differ.
        support: logarithm of how much less the cause leaves than a re-fit within tolerance on held-out folds, for each of its joints;
            None where it acts at random times.
    """

    x: float
    largest: float
    std: float
    tolerance: float
    support: float | None

    @classmethod
    def of(
        cls, quantity: Quantity, x: Mapping[str, float], quantities: tuple[Quantity, ...], std: float, tolerance: float,
        support: float | None, joints: int,
    ) -> Known:  # fmt: skip
        """
        Args:
            x: coordinates of the cause by name. support: over all its joints together, of which there are so many.
        """
        largest = max((abs(x[q.name]) / q.large for q in quantities if not q.shape), default=0.0)
        each = None if support is None else max(support, 0.0) / joints
        return cls(x[quantity.name], largest * quantity.large, std, tolerance, each)


@cache
def spreads() -> Mapping[str, float]:
    """Those that were learned (benchmarks/gap_training/sizes.py)."""
    text = json.loads((files("openant_tools.gap") / FILE).read_text())
    return {name: float(text[name]) for name in KINDS}


def spread(quantity: Quantity, known: Known, learned: Mapping[str, float]) -> float:
    """By how much the logarithm of a coordinate is off, as large as it usually is."""
    if quantity.shape:
        return learned["shape"]
    if known.support is None:
        return learned["random"]
    return learned["size"] / (1 + known.support)


def ends(quantity: Quantity, known: Known, learned: Mapping[str, float] | None = None) -> tuple[float, float]:
    """Between which coordinates it lies, 95 %."""
    wide = QUANTILE * spread(quantity, known, learned or spreads())
    if quantity.shape:
        return (0.0, 1.0) if quantity.share else (known.x * math.exp(-wide), known.x * math.exp(wide))
    size = max(abs(known.x), known.largest)
    own = math.hypot(TWO_SIDED_95 * known.std, TWO_SIDED_95 * SPREAD * known.tolerance)
    less, more = math.hypot(own, size * -math.expm1(-wide)), math.hypot(own, size * math.expm1(wide))
    low, high = (known.x - less, known.x + more) if known.x >= 0 else (known.x - more, known.x + less)
    return (low if quantity.signed else max(low, 1e-6)), high
