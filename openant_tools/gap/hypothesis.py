"""Causes at places, as fits try them: between which bounds their coordinates are sought, and where a fit has moved them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Cause, Quantity

__all__ = [
    "Hypothesis",
    "Part",
    "Refit",
    "bounds_of",
    "prior_of",
    "quantities",
    "refit_at",
    "sized",
    "sizes",
    "without_last",
]

Array = NDArray[np.float64]

#: how far beyond `large` a size may go
BEYOND = 2.5
#: the largest share that anything may take
WHOLE = 0.98
#: standard deviation that shapes keep from where they were found, as a share
POLISH = 0.3


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


def sized(cause: str, x: Mapping[str, float], times: float) -> dict[str, float]:
    """A cause so many times as large as at these coordinates, within bounds; its shapes as they are."""
    out = {}
    for q in catalogue()[cause].quantities:
        low, high = bounds_of(q)
        out[q.name] = x[q.name] if q.shape else float(np.clip(times * x[q.name], low, high))
    return out


@dataclass(frozen=True)
class Refit:
    """A model re-fitted within tolerance, with causes.

    Attributes:
        x: of each part of the hypothesis, its coordinates. nuisance: what else moved, in tolerances, see `Predictions.names`.
    """

    hypothesis: Hypothesis
    x: tuple[Mapping[str, float], ...]
    nuisance: Array


def prior_of(refit: Refit) -> tuple[Array, Array]:
    """(coordinates,) around what each is sought, and how widely: a size around none, a shape around what was found."""
    centre, deviation = [], []
    for q, x in zip(quantities(refit), sizes(refit), strict=True):
        centre.append(float(x) if q.shape else 0.0)
        deviation.append(q.large if not q.shape else POLISH if q.share else POLISH * float(x))
    return np.array(centre), np.array(deviation)


def without_last(start: Refit, found: Refit) -> Refit:
    """The hypothesis of a start where one that lacks its last cause has come to: of that cause there is nothing."""
    sized = {q.name for q in start.hypothesis[-1].definition.quantities if not q.shape}
    x = {name: 0.0 if name in sized else value for name, value in start.x[-1].items()}
    return Refit(start.hypothesis, (*found.x, x), found.nuisance)


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
