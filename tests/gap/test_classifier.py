"""Boosted trees as plain arrays: the same judgement as the library that taught them, from a file that holds nothing but numbers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from places import ROOT
from scipy.stats import binomtest
from sklearn.ensemble import HistGradientBoostingClassifier

from openant_tools.arrays import read_arrays, write_arrays
from openant_tools.gap.classifier import LEAF, Classifier, classifier, weights
from openant_tools.gap.evidence import COLUMN_NAMES
from openant_tools.gap.posterior import COLUMNS, NONE, OUTSIDE, WEIGHTS, features_of, log_posterior


@pytest.fixture(scope="module")
def taught() -> tuple[HistGradientBoostingClassifier, Classifier, np.ndarray]:
    sys.path.insert(0, str(ROOT))
    from benchmarks.gap_training.train import exported

    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 6)).astype(np.float16).astype(np.float32)
    y = x[:, 0] * x[:, 1] + 0.3 * rng.normal(size=400) > 0
    model = HistGradientBoostingClassifier(max_iter=20, max_leaf_nodes=8, random_state=0).fit(x, y)
    return model, exported(model), x


def test_arrays_judge_as_the_library_does(
    taught: tuple[HistGradientBoostingClassifier, Classifier, np.ndarray],
) -> None:
    model, arrays, x = taught
    np.testing.assert_allclose(arrays(x), model.decision_function(x), atol=1e-4)
    assert arrays(x.reshape(20, 20, 6)).shape == (20, 20)


def test_a_file_of_numbers_brings_it_back(
    taught: tuple[HistGradientBoostingClassifier, Classifier, np.ndarray], tmp_path: Path
) -> None:
    _, arrays, x = taught
    write_arrays(tmp_path / "trees.npz", arrays.arrays())
    again = Classifier.of(read_arrays(tmp_path / "trees.npz"))
    np.testing.assert_array_equal(again(x), arrays(x))


def test_nothing_a_cause_or_something_unknown_share_what_is_likely() -> None:
    weights = dict.fromkeys(WEIGHTS, 0.0) | {"odds": 1.0, "none": 1.0, "none: size": -8.0, "outside: left": 4.0}
    rows = np.zeros((3, 2, len(COLUMN_NAMES) + 1), np.float32)
    rows[:, :, COLUMN_NAMES.index("size")] = np.array([0.0, 0.8, 0.8])[:, None]
    rows[:, :, COLUMN_NAMES.index("left after 1")] = np.array([0.0, 0.0, 0.8])[:, None]
    odds = np.array([[-5, -6], [4, -5], [-3, -3]], np.float32)
    p = log_posterior(features_of(rows, odds), weights)
    np.testing.assert_allclose(np.exp(p).sum(axis=1), 1.0)
    assert p.argmax(axis=1).tolist() == [NONE, 2, OUTSIDE]
    assert set(COLUMNS) < set(WEIGHTS)


def test_what_comes_with_the_package_is_whole_and_small() -> None:
    found = classifier()
    inner = found.column != LEAF
    assert found.column[inner].max() <= len(COLUMN_NAMES), "a column, or the cause's number after them"
    for way in (found.left, found.right):
        assert (way[inner] > np.flatnonzero(inner)).all(), "every tree ends"
    assert set(weights()) == set(WEIGHTS)
    size = sum((ROOT / "openant_tools" / "gap" / name).stat().st_size for name in ("classifier.npz", "posterior.json"))
    assert size < 10e6


def test_a_current_that_is_logged_hurts_nothing() -> None:
    """On robots of experiments that taught nothing: fewer right names or more false alarms with that column are chance."""
    kept, worse, better, alarms, quiet, robots = read_arrays(Path(__file__).parent / "rows.npz"), 0, 0, 0, 0, 0
    for seed in sorted({name.split()[0] for name in kept}):
        true, count = kept[f"{seed} true"].astype(bool), kept[f"{seed} count"]
        right, alarm = [], []
        for which in ("with", "without"):
            rows = kept[f"{seed} {which}"].astype(np.float32)
            p = log_posterior(features_of(rows, classifier()(rows)), weights())
            right.append(np.take_along_axis(true, p[:, 2:].argmax(axis=1)[:, None], axis=1)[:, 0] & (count > 0))
            alarm.append((p.argmax(axis=1) != NONE) & (count == 0))
        worse += int((right[1] & ~right[0]).sum())
        better += int((right[0] & ~right[1]).sum())
        alarms += int((alarm[0] & ~alarm[1]).sum())
        quiet += int((alarm[1] & ~alarm[0]).sum())
        robots += len(true)
    assert robots >= 60
    # Of pairs that differ, as many may be worse as a fair coin gives (one-sided, 5 %).
    assert worse + better == 0 or binomtest(worse, worse + better, alternative="greater").pvalue > 0.05
    assert alarms + quiet == 0 or binomtest(alarms, alarms + quiet, alternative="greater").pvalue > 0.05
