"""Robots with two causes that nobody simulated: one simulated with a cause, and a template of another laid over it."""

from __future__ import annotations

import numpy as np
import pytest

from openant_tools.gap.features import Layout
from openant_tools.gap.networks import teach
from openant_tools.gap.superposed import superposed
from openant_tools.gap.templates import Template
from openant_tools.model.plant import Setup

BANK: list[Template] = [("late", (0,), {"x": 1.0}), ("late", (1,), {"x": 1.0}), ("rough", (0,), {"x": 1.0})]


@pytest.fixture
def layout() -> Layout:
    t = np.arange(0, 3, 0.02)
    return Layout(t, Setup.STAND, 2, ("pos",), 3.0, np.zeros((len(t), 2), bool))


def features(layout: Layout, *motions: np.ndarray) -> np.ndarray:
    """(motions, features) of differences from a model that does not move, (rows, joints) each."""
    return layout.features({"pos": np.stack(motions).astype(np.float32)})


def test_features_of_a_sum_are_those_of_the_motion_that_is_the_sum(layout: Layout) -> None:
    rng = np.random.default_rng(3)
    phase = 2 * np.pi * layout.t[:, None]
    one = np.hstack([0.1 * np.sin(phase), np.zeros_like(phase)]) + rng.normal(0, 0.02, (len(phase), 2))
    other = np.hstack([np.zeros_like(phase), 0.2 * np.cos(phase)]) + rng.normal(0, 0.01, (len(phase), 2))
    x, y = features(layout, one, other)
    made = superposed(x[None], [{"rough": ((0,), {})}], y[None], BANK[:1], layout.least(), 0)
    means = layout.least() == 0
    share = (made.x[:, means] - x[means]) @ y[means] / (y[means] @ y[means])
    for row, size in zip(made.x, share, strict=True):
        (wanted,) = features(layout, one + size * other)
        assert row[means] == pytest.approx(wanted[means], abs=1e-5)
        assert row[~means] == pytest.approx(wanted[~means], abs=0.05), "logarithms of sizes that add up in squares"


def test_each_has_one_cause_more_and_knows_what_it_was_made_of(layout: Layout) -> None:
    x = np.zeros((4, len(layout.least())), np.float32)
    cases = [{}, {"late": ((0,), {"x": 2.0})}, {"rough": ((1,), {"x": 2.0})}, {"late": ((0,), {}), "rough": ((1,), {})}]
    made = superposed(x, cases, np.ones((3, x.shape[1]), np.float32), BANK, layout.least(), 0)
    assert set(made.origin) == {1, 2}, "of healthy robots there are enough, and of two causes the next one hardly shows"
    for causes, row in zip(made.causes, made.origin, strict=True):
        assert cases[row].items() <= causes.items()
        assert len(causes) == 2
    assert {joints for causes in made.causes for name, (joints, _) in causes.items() if name == "late"} == {(0,), (1,)}
    again = superposed(x, cases, np.ones((3, x.shape[1]), np.float32), BANK, layout.least(), 0)
    assert np.array_equal(again.x, made.x)


def test_nothing_is_made_where_no_robot_has_one_cause_alone(layout: Layout) -> None:
    x = np.zeros((1, len(layout.least())), np.float32)
    made = superposed(x, [{}], np.ones((3, x.shape[1]), np.float32), BANK, layout.least(), 0)
    assert made.x.shape == (0, x.shape[1])
    assert not made.causes


def test_who_has_not_seen_a_robot_has_not_seen_what_was_made_of_it() -> None:
    """Labels without any reason: to know them is to have seen them."""
    rng = np.random.default_rng(1)
    x = np.repeat(rng.normal(size=(40, 30)), 4, axis=0).astype(np.float32)
    labels = np.repeat(rng.integers(0, 2, (40, 2)), 4, axis=0)
    usual = {"shares": 4, "neurons": 16, "rounds": 200, "portion": 64, "seed": 0}
    right = []
    for origin in (np.arange(160), np.repeat(np.arange(40), 4)):
        _, unseen = teach(x, labels, origin, **usual)
        right.append(float(np.mean((unseen > 0) == labels)))
    assert right[0] > 0.9
    assert right[1] < 0.7
