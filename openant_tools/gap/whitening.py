"""The measure of how far a robot is from the model: what healthy robots of one build differ by counts little.

Each tolerance first takes of a difference what it may, within its bounds; chatter, numerical form and sensors are in one covariance, by
which the rest is whitened.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Reference
from openant_tools.gap.features import Floats
from openant_tools.gap.population import WIDTH, Case

__all__ = ["CLIP", "Whitening", "whiten"]

Array = NDArray[np.float64]

#: share by which what healthy robots show beyond their tolerances is taken for independent noise
SHRUNK = 0.5
#: deviations beyond which a difference says no more
CLIP = 40.0
#: standard deviation of robots within a tolerance, in tolerances, and how many of these it ends at: `tolerance.scatter` draws evenly
SPREAD, END = WIDTH / math.sqrt(3), math.sqrt(3)
#: how often each tolerance takes what the others leave, at most, and the share of a deviation that matters no more
SWEEPS, SETTLED = 200, 1e-2


@dataclass(frozen=True)
class Whitening:
    """What is left of a robot's differences once every tolerance has taken what it may, in deviations of what else healthy robots show.

    Tolerances end: a parameter that is four times as far off as robots of one build are is not one that rarely happens.

    Attributes:
        centre, scale: (features,) of the differences; the scale of a feature that never differs is infinite.
        basis: (features, directions). gains: (directions,) on top of 1/rest. rest: σ. Of Σ = M Mᵀ + σ², by its eigenvectors.
        tolerances: (features, nuisances) what a deviation within each tolerance does, scaled.
    """

    centre: Array
    scale: Array
    basis: Floats
    gains: Floats
    rest: float
    tolerances: Floats

    def __call__(self, x: Floats) -> Floats:
        """(robots, features) of differences."""
        return self._measured(np.clip((x - self.centre) / self.scale, -CLIP, CLIP).astype(np.float32))

    def of_templates(self, x: Floats) -> Floats:
        """(templates, features) of robots without scatter: their differences count from the model, not from the median robot."""
        return self._measured(np.clip(x / self.scale, -CLIP, CLIP).astype(np.float32))

    def _measured(self, d: Floats) -> Floats:
        return self._whitened((d - self.within(d) @ self.tolerances.T).astype(np.float32))

    def _whitened(self, d: Floats) -> Floats:
        out: Floats = (d / self.rest + ((d @ self.basis) * self.gains) @ self.basis.T).astype(np.float32)
        return out

    def within(self, d: Floats) -> Floats:
        """(robots, nuisances) where within each tolerance robots most likely are, in its deviations, by differences already scaled."""
        own = self._own
        gram = (own @ own.T).astype(np.float64) + np.eye(len(own))
        along = (own @ self._whitened(d).T).astype(np.float64)
        u = np.clip(np.linalg.solve(gram, along), -END, END)
        # A box has no formula: each coordinate in turn, the others as they are (coordinate descent), for all robots at once.
        for _ in range(SWEEPS):
            before = u.copy()
            for k, row in enumerate(gram):
                u[k] = np.clip(u[k] + (along[k] - row @ u) / row[k], -END, END)
            if np.abs(u - before).max(initial=0.0) < SETTLED:
                break
        out: Floats = u.T.astype(np.float32)
        return out

    @cached_property
    def _own(self) -> Floats:
        return self._whitened(self.tolerances.T)


def whiten(x: Floats, templates: Floats, bank: Sequence[Case], reference: Reference) -> Whitening:
    """The measure of healthy robots: what tolerances do, by the templates' directions, and what else they show.

    Args:
        x: (robots, features) of healthy ones. templates: (templates, features) of the bank's.
    """
    centre = np.median(x, axis=0).astype(np.float64)
    scale = np.std(x, axis=0).astype(np.float64)
    # What no simulated robot ever showed (a block that lay beyond its run's end, or all around a switch of torque) says nothing.
    scale = np.where(np.ptp(x, axis=0) > 0, np.maximum(scale, 1e-3 * float(np.median(scale))), np.inf)
    d = np.clip((x - centre) / scale, -CLIP, CLIP).astype(np.float32)
    tolerances = _tolerances(templates / scale, bank, reference)
    inner = np.linalg.solve(tolerances.T @ tolerances + np.eye(tolerances.shape[1]), tolerances.T @ d.T)
    rest = d - (tolerances @ inner).T
    # Few robots and many features: their covariance, shrunk a little towards independence (Ledoit and Wolf 2004).
    squares, vectors = np.linalg.eigh(rest @ rest.T / len(rest))
    keep = squares > 1e-6 * squares[-1]
    variance = SHRUNK * float(np.mean(rest**2))
    # Along each direction as long as the robots scatter there.
    basis = rest.T @ (vectors[:, keep] / np.sqrt(len(rest) * squares[keep]))
    gains = 1 / np.sqrt((1 - SHRUNK) * squares[keep] + variance) - 1 / np.sqrt(variance)
    return Whitening(
        centre, scale, basis.astype(np.float32), gains.astype(np.float32), float(np.sqrt(variance)), tolerances
    )


def _tolerances(templates: Array, bank: Sequence[Case], reference: Reference) -> Floats:
    """(features, nuisances): how a robot moves that is one deviation within each tolerance, of each joint where joints have their own."""
    out = [np.zeros(templates.shape[1])]
    taken = set()
    single = {name for case in bank for name, (joints, _) in case.causes.items() if len(joints) == 1}
    every = len(reference.torque)
    for template, case in zip(templates, bank, strict=True):
        ((name, (joints, x)),) = case.causes.items()
        main = max((q for q in catalogue()[name].quantities if not q.shape), key=lambda q: abs(x[q.name]) / q.small)
        key = (name, joints, main.name)
        # The first of a place is the smallest: the nearest to a derivative.
        if main.tolerance > 0 and key not in taken and len(joints) == (1 if name in single else every):
            taken.add(key)
            out.append(template * (SPREAD * main.allowed(reference, np.array(joints)) / x[main.name]))
    found: Floats = np.array(out).T.astype(np.float32)
    return found
