"""Causes at places, as fits try them: between which bounds their coordinates are sought, and where a fit has moved them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Cause, Quantity

__all__ = ["Hypothesis", "Part", "Refit", "bounds_of", "bounds_within", "extent", "quantities", "refit_at", "sizes"]

Array = NDArray[np.float64]

#: how far beyond `large` a size may go
BEYOND = 2.5
#: the largest share that anything may take
WHOLE = 0.98
#: times what it was found to be that a size may become
FARTHEST = 2.5


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


@dataclass(frozen=True)
class Refit:
    """A model re-fitted within tolerance, with causes.

    Attributes:
        x: of each part of the hypothesis, its coordinates. nuisance: what else moved, in tolerances, see `Windows.names`.
    """

    hypothesis: Hypothesis
    x: tuple[Mapping[str, float], ...]
    nuisance: Array


def bounds_within(quantity: Quantity, at: float, from_none: float) -> tuple[float, float]:
    """Between which a size may be polished that was found somewhere: it keeps its sign, and a shape its reason."""
    if quantity.shape:
        return bounds_of(quantity)
    far = FARTHEST * from_none
    return -far if at < 0 or (quantity.signed and not at) else 0.0, far if at > 0 or not at else 0.0


def extent(refit: Refit) -> Array:
    """(coordinates,) how far each is from none; of a vector what it would be if it had its part in how long that is."""
    out = []
    for part, x in zip(refit.hypothesis, refit.x, strict=True):
        amounts = [q for q in part.definition.quantities if not q.shape]
        long = max((abs(x[q.name]) / q.small for q in amounts), default=0.0) if part.definition.vector else 0.0
        out += [max(abs(x[q.name]), 0.0 if q.shape else q.small * long) for q in part.definition.quantities]
    return np.array(out)


def quantities(refit: Refit) -> list[Quantity]:
    """Of all its causes, in order."""
    return [q for part in refit.hypothesis for q in part.definition.quantities]


def sizes(refit: Refit) -> Array:
    """(coordinates,) of all its causes, in order."""
    return np.array(
        [x[q.name] for part, x in zip(refit.hypothesis, refit.x, strict=True) for q in part.definition.quantities]
    )


def refit_at(start: Refit, u: Array) -> Refit:
    """The same causes where a fit has come to: (coordinates and tolerances,)."""
    at, x = 0, []
    for part in start.hypothesis:
        names = [q.name for q in part.definition.quantities]
        x.append(dict(zip(names, map(float, u[at : at + len(names)]), strict=True)))
        at += len(names)
    return dataclasses.replace(start, x=tuple(x), nuisance=u[at:])
