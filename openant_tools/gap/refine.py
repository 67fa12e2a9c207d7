"""Templates of the likeliest causes, made anew where they fit one recording best.

A bank has a few sizes of each cause. What a limit, a delay or a load does grows otherwise than in proportion to it, and where
a payload sits is a coordinate of its own, so that the right cause may fit worse than a wrong one for no other reason than its size.
Here sizes and shapes of the causes that fit best are sought by Levenberg–Marquardt in the measure of healthy robots, over all signals;
after the first round slopes follow from what steps show (Broyden 1965).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Quantity
from openant_tools.gap.evidence import Scale
from openant_tools.gap.features import Floats
from openant_tools.gap.hypothesis import bounds_of
from openant_tools.gap.population import Case
from openant_tools.gap.templates import Template

__all__ = ["refined"]

Array = NDArray[np.float64]

#: causes that are refined, and how often their coordinates are moved
CAUSES, ROUNDS = 8, 4
#: times the largest that sizes are first tried at, beside what the bank's template comes to: where a limit is not reached yet
#: nothing says how far it is
TRIED = 0.3, 0.6, 1.0
#: of a slope: share of a size, of the least that matters where it is none, and of a shape's range
STEP, STEP_OF_NONE, STEP_OF_SHAPE = 0.15, 0.5, 0.15
#: share of its curvature by which each coordinate is held back
DAMPED = 0.03
#: deviation of coordinates: of sizes in times the largest, of shapes in their range
WIDE = 1.0
#: times the least that matters below which no size goes: what is not there has no slope
LEAST = 0.2


@dataclass
class _Search:
    """One cause at one place.

    Attributes:
        u: coordinates to look at next: a size in times its `large`, a shape in shares of its range.
        best: where most was explained; gain: how much, in halves of squared deviations; found: what it does there.
        slopes: (coordinates, features) there.
    """

    cause: str
    joints: tuple[int, ...]
    u: list[Array]
    best: Array
    gain: float = -math.inf
    found: Floats | None = None
    slopes: Floats | None = None

    @classmethod
    def of(cls, template: Template, amplitude: float) -> _Search:
        """From so many times a template, and from other sizes that go the same way."""
        name, joints, x = template
        quantities = catalogue()[name].quantities
        main = max((q for q in quantities if not q.shape), key=lambda q: abs(x[q.name]) / q.large)
        times = [amplitude, *(size * main.large / abs(x[main.name]) for size in TRIED)]
        u = [
            np.array(
                [_way(q, x[q.name]) if q.shape else np.clip(n * x[q.name] / q.large, *_ends(q)) for q in quantities]
            )
            for n in times
        ]
        return cls(name, joints, u, u[0])

    def asked(self) -> list[Case]:
        """What is to be simulated."""
        return [self._case(u) for u in self.u]

    def told(self, z: Floats, found: Floats) -> None:
        """What that showed: go where it leads."""
        if self.found is None:
            self._look(z, found)
            self.u = [self.best + step for step in np.diag(self._steps)]
            return
        if self.slopes is None:
            self.slopes = ((found - self.found) / self._steps[:, None]).astype(np.float32)
        elif (moved := self.u[0] - self.best).any():
            missed = found[0] - self.found - moved.astype(np.float32) @ self.slopes
            more: Floats = np.outer(moved / (moved @ moved), missed).astype(np.float32)
            self.slopes = (self.slopes + more).astype(np.float32)
        self._look(z, found)
        self.u = [self._moved(z)]

    def _look(self, z: Floats, found: Floats) -> None:
        left = z - found
        gains = 0.5 * (z @ z - np.square(left).sum(axis=1))
        k = int(gains.argmax())
        if gains[k] > self.gain:
            self.best, self.gain, self.found = self.u[k], float(gains[k]), found[k]

    def _moved(self, z: Floats) -> Array:
        assert self.slopes is not None
        assert self.found is not None
        left = z - self.found
        # No cause explains all: errors are as large as what is left of them.
        inflation = max(1.0, float(left @ left) / len(left))
        curvature = (self.slopes @ self.slopes.T).astype(np.float64) / inflation
        damped = curvature + np.diag(DAMPED * np.diag(curvature) + 1 / WIDE**2)
        step = np.linalg.solve(damped, (self.slopes @ left).astype(np.float64) / inflation)
        low, high = np.array([_ends(q) for q in self._quantities]).T
        out: Array = np.clip(self.best + step, low, high)
        return out

    @property
    def _quantities(self) -> tuple[Quantity, ...]:
        return catalogue()[self.cause].quantities

    @property
    def _steps(self) -> Array:
        out = []
        for q, u in zip(self._quantities, self.best, strict=True):
            step = STEP_OF_SHAPE if q.shape else max(STEP * abs(u), STEP_OF_NONE * q.small / q.large)
            # Inwards where there is nothing outwards.
            out.append(step if u + step <= _ends(q)[1] else -step)
        return np.array(out)

    def _case(self, u: Array) -> Case:
        x = {
            q.name: q.between(float(v)) if q.shape else float(v) * q.large
            for q, v in zip(self._quantities, u, strict=True)
        }
        return Case({self.cause: (self.joints, x)}, -1)


def refined(scale: Scale, features: Floats, simulated: Callable[[Sequence[Case]], Floats]) -> tuple[list[Case], Floats]:
    """More templates of the causes that fit one robot best.

    Args:
        features: (features,) what was seen. simulated: the features of cases, (cases, features).

    Returns:
        cases and their features.
    """
    z, t = scale.whitened(features[None]), scale.templates
    fit = t.fits(z)[0]
    length = np.linalg.norm(t.vectors, axis=1)
    best = [int(some[fit[some].argmax()]) for some in t.of_cause]
    # What acts at random times no simulation repeats.
    best = [k for k in sorted(best, key=lambda k: -fit[k]) if not catalogue()[t.bank[k][0]].random][:CAUSES]
    searches = [_Search.of(t.bank[k], float(fit[k] / length[k])) for k in best]
    cases: list[Case] = []
    found: list[Floats] = []
    for _ in range(ROUNDS):
        asked = [search.asked() for search in searches]
        cases += (every := [case for some in asked for case in some])
        found.append(simulated(every))
        vectors = scale.vectors(found[-1])
        for search, mine in zip(
            searches, np.split(vectors, np.cumsum([len(some) for some in asked])[:-1]), strict=True
        ):
            search.told(z[0], mine)
    return cases, np.concatenate(found)


def _ends(q: Quantity) -> tuple[float, float]:
    if q.shape:
        return 0.0, 1.0
    low, high = bounds_of(q)
    return (low / q.large if q.signed else LEAST * q.small / q.large), high / q.large


def _way(q: Quantity, x: float) -> float:
    """How far a shape is between its ends: `Quantity.between` the other way round."""
    way = (x - q.small) / (q.large - q.small) if q.share else math.log(x / q.small) / math.log(q.large / q.small)
    return min(max(way, 0.0), 1.0)
