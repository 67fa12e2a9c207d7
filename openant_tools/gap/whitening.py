"""The measure of how far a robot is from the model: what healthy robots of one build differ by counts little.

Tolerances, chatter, numerical form and sensors are in one covariance, by which differences are whitened.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Reference
from openant_tools.gap.features import Floats
from openant_tools.gap.population import Case

__all__ = ["CLIP", "Whitening", "whiten"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: share by which what healthy robots show beyond their tolerances is taken for independent noise
SHRUNK = 0.5
#: deviations beyond which a difference says no more
CLIP = 40.0
#: standard deviation of a robot within a tolerance, as a share of it
SPREAD = 0.6


@dataclass(frozen=True)
class Whitening:
    """What healthy robots do, taken out of the measure: Σ = M Mᵀ + σ², by its eigenvectors.

    Attributes:
        centre, scale: (features,) of the differences; the scale of a feature that never differs is infinite.
        basis: (features, directions). gains: (directions,) on top of 1/rest. rest: σ.
    """

    centre: Array
    scale: Array
    basis: Floats
    gains: Floats
    rest: float

    def __call__(self, x: Floats) -> Floats:
        """(robots, features) of differences."""
        return self.measure(np.clip((x - self.centre) / self.scale, -CLIP, CLIP).astype(np.float32))

    def measure(self, d: Floats) -> Floats:
        """(robots, features) of differences already scaled."""
        out: Floats = (d / self.rest + ((d @ self.basis) * self.gains) @ self.basis.T).astype(np.float32)
        return out

    def of_templates(self, x: Floats) -> Floats:
        """(templates, features) of robots without scatter: their differences count from the model, not from the median robot."""
        return self.measure(np.clip(x / self.scale, -CLIP, CLIP).astype(np.float32))


def whiten(x: Floats, templates: Floats, bank: Sequence[Case], reference: Reference) -> Whitening:
    """Σ of healthy robots: what tolerances do, by the templates' directions, and what else healthy robots show.

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
    real = squares > 1e-6 * squares[-1]
    own = rest.T @ (vectors[:, real] / np.sqrt(len(rest)))  # as long as the robots scatter along it
    variance = SHRUNK * float(np.mean(rest**2))
    both = np.hstack([tolerances, own * np.float32(math.sqrt(1 - SHRUNK))])
    squares, vectors = np.linalg.eigh(both.T @ both)
    keep = squares > 1e-6 * squares.max()
    basis = (both @ vectors[:, keep]) / np.sqrt(squares[keep])
    gains = 1 / np.sqrt(squares[keep] + variance) - 1 / np.sqrt(variance)
    return Whitening(centre, scale, basis.astype(np.float32), gains.astype(np.float32), float(np.sqrt(variance)))


def _tolerances(templates: Array, bank: Sequence[Case], reference: Reference) -> Floats:
    """(features, nuisances): how a robot moves that is one deviation within each tolerance."""
    out = [np.zeros(templates.shape[1])]
    taken = set()
    for template, case in zip(templates, bank, strict=True):
        ((name, (joints, x)),) = case.causes.items()
        main = max((q for q in catalogue()[name].quantities if not q.shape), key=lambda q: abs(x[q.name]) / q.small)
        key = (name, joints, main.name)
        # The first of a place is the smallest: the nearest to a derivative.
        if main.tolerance > 0 and key not in taken:
            taken.add(key)
            out.append(template * (SPREAD * main.allowed(reference, np.array(joints)) / x[main.name]))
    found: Floats = np.array(out).T.astype(np.float32)
    return found
