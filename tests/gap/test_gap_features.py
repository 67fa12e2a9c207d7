"""What evidence is read off logs: block means of how they differ from the model."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.features import SKIP_S, Layout
from openant_tools.model.plant import Setup

JOINTS, ROWS, PERIOD_S = 8, 500, 0.02
T = np.arange(ROWS) * PERIOD_S


def layout(unsure: np.ndarray | None = None, signals: tuple[str, ...] = ("pos",)) -> Layout:
    none = np.zeros((ROWS, JOINTS), bool)
    return Layout(T, Setup.STAND, JOINTS, signals, float(T[-1]), none if unsure is None else unsure)


def moved(t: np.ndarray) -> np.ndarray:
    """(1, rows, joints) rad: each joint at its own frequency; t: (rows,) or (rows, joints) s."""
    t = np.broadcast_to(t.reshape(ROWS, -1), (ROWS, JOINTS))
    return (0.5 * np.sin(2 * np.pi * np.linspace(0.6, 1.4, JOINTS) * t + np.arange(JOINTS)))[None].astype(np.float32)


def test_missing_and_unsure_rows_do_not_count() -> None:
    rng = np.random.default_rng(5)
    seen = moved(T - 0.003 * rng.normal(size=ROWS))
    unsure = np.zeros((ROWS, JOINTS), bool)
    unsure[200:203, 2] = True
    wrong = seen.copy()
    wrong[0, 200:203, 2] += 1.0
    wrong[0, 300:302] = np.nan
    plain, found = (
        layout(some).features({"pos": log}, {"pos": moved(T)})[0] for some, log in ((None, seen), (unsure, wrong))
    )
    np.testing.assert_allclose(found, plain, atol=0.03)


def test_a_block_of_which_nothing_was_logged_is_not_known() -> None:
    seen = moved(T).copy()
    seen[0, 100:200, 3] = np.nan
    known = layout().known({"pos": seen}).reshape(-1, JOINTS)
    assert not known[:, 3].all()
    assert np.delete(known, 3, axis=1).all()


def test_features_of_a_signal_say_which_joint_they_are_of() -> None:
    mine = layout(signals=("pos", "gyro"))
    assert set(mine.joints_of("gyro")) == {-1}
    assert mine.joints_of("pos")[:JOINTS] == list(range(JOINTS))
    count = len(mine.joints_of("pos")) + len(mine.joints_of("gyro"))
    body = np.zeros((1, ROWS, 3), np.float32)
    assert mine.features({"pos": moved(T), "gyro": body}, {"pos": moved(T), "gyro": body}).shape == (1, count)
    assert mine.blocks("pos")[0] == SKIP_S
