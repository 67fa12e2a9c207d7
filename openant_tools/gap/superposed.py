"""Simulated robots with one cause more, which nobody simulated: beside another, a cause does nearly what it does alone.

Two causes at once are rare among robots drawn at random, and each pair of them is rarer still. Differences from the model add up as
long as neither cause changes what the other does, so that a robot with one cause and a template of another make a robot with both.
That is nearly free, and worth as much to a judge of two causes as twice the robots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.features import Floats
from openant_tools.gap.templates import Template

__all__ = ["Superposed", "superposed"]

Ints = NDArray[np.int64]
Some = TypeVar("Some")
#: where a cause sits, and its coordinates
Place = tuple[tuple[int, ...], dict[str, float]]

#: robots made of each with one cause, and of all of them together at most
OF_EACH, MOST = 4, 5000
#: shares of a template that is laid over a robot: between those of its sizes there are others
SHARES = (0.5, 1.3)


@dataclass(frozen=True)
class Superposed:
    """Robots of one cause with another laid over each.

    Attributes:
        x: (robots, features). causes: of each, those it has. origin: (robots,) which robot each was made of.
    """

    x: Floats
    causes: list[dict[str, Place]]
    origin: Ints


def superposed(
    x: Floats, cases: Sequence[Mapping[str, Place]], vectors: Floats, bank: Sequence[Template], least: Floats, seed: int
) -> Superposed:
    """Lay templates over robots at random: each cause as often as any other, then each of its places.

    Args:
        x: (robots, features). cases: of each, the causes that it has.
        vectors: (templates, features). bank: what each of those is of.
        least: (features,) as `features.Layout.least`.
    """
    rng = np.random.default_rng((271, seed))
    single = [k for k, case in enumerate(cases) if len(case) == 1]
    at: dict[str, dict[tuple[int, ...], list[int]]] = {}
    for k, (name, joints, _) in enumerate(bank):
        at.setdefault(name, {}).setdefault(joints, []).append(k)
    below: list[int] = []
    above: list[int] = []
    causes: list[dict[str, Place]] = []
    for row in rng.permutation(np.repeat(np.array(single, np.int64), OF_EACH))[:MOST]:
        mine = cases[int(row)]
        places = at[_any(rng, sorted(at.keys() - mine.keys()))]
        k = _any(rng, places[_any(rng, sorted(places))])
        name, joints, point = bank[k]
        below.append(int(row))
        above.append(k)
        causes.append({**mine, name: (joints, point)})
    share = np.exp(rng.uniform(np.log(SHARES[0]), np.log(SHARES[1]), len(above))).astype(np.float32)
    return Superposed(_sum(x[below], vectors[above], share, least), causes, np.array(below, np.int64))


def _any(rng: np.random.Generator, some: Sequence[Some]) -> Some:
    return some[int(rng.integers(len(some)))]


def _sum(x: Floats, y: Floats, share: Floats, least: Floats) -> Floats:
    """(robots, features) of x and so much of y: means add up; sizes, of which there are logarithms, do so in squares."""
    out = x + share[:, None] * y
    logs = np.flatnonzero(least)
    under = least[logs]
    own, other = (np.maximum(10.0 ** one[:, logs] - under, 0.0) for one in (x, y))
    out[:, logs] = np.log10(np.hypot(own, share[:, None] * other) + under)
    return out.astype(np.float32)
