"""Causes at places, as fits try them, and between which bounds their coordinates are sought."""

from __future__ import annotations

from dataclasses import dataclass

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Cause, Quantity

__all__ = ["Hypothesis", "Part", "bounds_of"]

#: how far beyond `large` a size may go
BEYOND = 2.5
#: the largest share that anything may take
WHOLE = 0.98


@dataclass(frozen=True)
class Part:
    """One cause at one place."""

    cause: str
    joints: tuple[int, ...]

    @property
    def definition(self) -> Cause:
        return catalogue()[self.cause]


#: causes at places
Hypothesis = tuple[Part, ...]


def bounds_of(q: Quantity) -> tuple[float, float]:
    """Between which a coordinate is sought."""
    if q.share:
        return 0.0, 1.0
    if q.shape:
        return q.small / 2, q.large * 2
    # A share cannot be more than all.
    share = q.unit == "1" and not q.signed
    return -q.large * BEYOND if q.signed else 0.0, min(q.large * BEYOND, WHOLE) if share else q.large * BEYOND
