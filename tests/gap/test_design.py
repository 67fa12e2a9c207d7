"""Slopes and scatter from robots that differ in all of their coordinates at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openant_tools.gap.design import design, scatter, slopes


@given(coordinates=st.integers(1, 120), seed=st.integers(0, 2**32 - 1))
def test_what_is_linear_is_found_exactly_and_what_is_even_is_in_no_slope(coordinates: int, seed: int) -> None:
    moved, rng = design(coordinates), np.random.default_rng(seed)
    assert moved.shape == (2 * (coordinates + 1), coordinates)
    assert np.square(moved).mean(axis=0) == pytest.approx(np.ones(coordinates))
    truth, pairs = rng.normal(size=(coordinates, 3, 2)), rng.normal(size=(coordinates, coordinates))
    plain = 5.0 + np.tensordot(moved, truth, 1)
    assert slopes(plain, moved) == pytest.approx(truth, abs=1e-9)
    assert scatter(plain, moved) == pytest.approx(np.zeros((3, 2)), abs=1e-9)
    bent = plain + np.einsum("np,pq,nq->n", moved, pairs, moved)[:, None, None]
    assert slopes(bent, moved) == pytest.approx(truth, abs=1e-9)


def test_scatter_is_what_robots_differ_by_that_hardly_differ_and_slopes_have_an_nth_of_it() -> None:
    moved, rng = design(60), np.random.default_rng(1)
    seen = 0.3 * rng.normal(size=(len(moved), 400, 2))
    assert np.sqrt(scatter(seen, moved).mean()) == pytest.approx(0.3, rel=0.02)
    assert np.sqrt(np.square(slopes(seen, moved)).mean()) == pytest.approx(0.3 / np.sqrt(len(moved)), rel=0.02)
