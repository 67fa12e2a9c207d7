"""The solver by itself: two decays that nobody simulates, one unknown held at its bound, beside scipy's answer."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from openant_tools.sysid.solve import Derive, Look, Point, Prior, Steps, Tangent, descend, side_by_side

Array = NDArray[np.float64]

T = np.linspace(0.0, 3.0, 80)
#: each channel's height and rate; the second rate lies beyond its bound
TRUTH = np.array([2.0, 1.0, 1.5, 3.0])
PRIOR = Prior(np.zeros(4), np.full(4, 0.01), np.full(4, -1.0), np.array([9.0, 9.0, 9.0, 2.5]))
#: each channel has its own two unknowns, so that a height of each shares a colour, and a rate of each
MOVERS = [(np.array([0, 1]), np.array([0, 1])), (np.array([2, 3]), np.array([0, 1]))]
NOISE = 0.05


def decays(u: Array) -> Array:
    """(rows, 2)"""
    return np.stack([u[k] * np.exp(-u[k + 1] * T) for k in (0, 2)], axis=1)


MEASURED = decays(TRUTH) + NOISE * np.random.default_rng(1).standard_normal((len(T), 2))


class Simulation:
    """Answers descents, and remembers how many asked at a time."""

    def __init__(self) -> None:
        self.looks: list[int] = []
        self.derivatives: list[int] = []

    def look(self, asked: Mapping[int, Look]) -> list[Point]:
        self.looks.append(len(asked))
        return [Point(one.u, MEASURED - decays(one.u), np.zeros_like(MEASURED)) for one in asked.values()]

    def derive(self, asked: Mapping[int, Derive]) -> list[Tangent]:
        self.derivatives.append(len(asked))
        out = []
        for one in asked.values():
            u = one.point.u
            heights = np.stack([-np.exp(-u[k + 1] * T) for k in (0, 2)], axis=1)
            rates = np.stack([u[k] * T * np.exp(-u[k + 1] * T) for k in (0, 2)], axis=1)
            out.append(Tangent(u, MOVERS, np.stack([heights, rates]).astype(np.float32)))
        return out


def from_(u: Array, held: NDArray[np.bool_] | None = None) -> Steps:
    point = yield Look(u)
    return (yield from descend(point, PRIOR, lambda there: np.full((len(T), 2), 1 / NOISE), held=held))


STARTS = [np.ones(4), np.array([0.2, 3.0, 4.0, 0.1]), np.array([6.0, 0.5, 0.5, 2.5])]


def test_many_descents_side_by_side_end_where_scipy_does_and_ask_together() -> None:
    def rows(u: Array) -> Array:
        return np.concatenate([((MEASURED - decays(u)) / NOISE).ravel(), np.sqrt(PRIOR.precision) * (u - PRIOR.centre)])

    best = least_squares(rows, STARTS[0], bounds=(PRIOR.low, PRIOR.high)).x
    together = Simulation()
    ends = side_by_side([from_(u) for u in STARTS], together.look, together.derive)
    for end in ends:
        assert end.converged
        assert end.point.u == pytest.approx(best, abs=3e-3)
        assert end.point.u[3] == PRIOR.high[3]
    assert together.looks[0] == together.derivatives[0] == len(STARTS)
    alone = Simulation()
    for start, end in zip(STARTS, ends, strict=True):
        (again,) = side_by_side([from_(start)], alone.look, alone.derive)
        assert np.array_equal(again.point.u, end.point.u)
    assert sum(alone.looks) == sum(together.looks)
    assert len(together.looks) < len(alone.looks)


def test_what_is_held_stays_and_derivatives_that_keep_their_promise_are_kept() -> None:
    simulation = Simulation()
    held = np.array([True, False, False, False])
    (end,) = side_by_side([from_(np.array([2.0, 1.2, 1.4, 2.2]), held)], simulation.look, simulation.derive)
    assert end.converged
    assert end.point.u[0] == 2.0
    assert end.point.u[1] == pytest.approx(TRUTH[1], abs=0.05)
    assert len(simulation.derivatives) < len(simulation.looks)
