"""How late a body is behind its legs, of bodies whose turning is made of their joints' speeds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.gap.imu_delay import LAG_S, ImuDelay

JOINTS, ROWS, PERIOD_S = 8, 450, 0.02
T = np.arange(ROWS) * PERIOD_S


def legs(t: np.ndarray) -> np.ndarray:
    """(rows, joints) rad at these times: each joint swings in its own two rhythms."""
    phase = np.arange(JOINTS)
    return 0.3 * np.sin(2 * np.pi * np.linspace(0.5, 1.2, JOINTS) * t[:, None] + phase) + 0.1 * np.sin(
        2 * np.pi * np.linspace(2.0, 2.9, JOINTS) * t[:, None] + 2 * phase
    )


def turning(t: np.ndarray, seed: int = 0, noise: float = 0.0) -> np.ndarray:
    """(1, rows, 3) rad/s of a body that turns as its legs do at these times."""
    rng = np.random.default_rng(seed)
    speed = (legs(t + 1e-4) - legs(t - 1e-4)) / 2e-4
    clean = speed @ rng.normal(0, 0.2, (JOINTS, 3))
    return (clean + noise * clean.std() * rng.normal(size=clean.shape))[None].astype(np.float32)


def said(pos: np.ndarray, gyro: np.ndarray) -> np.ndarray:
    following = ImuDelay.of(T)
    assert following is not None
    out: np.ndarray = following(pos.astype(np.float32), gyro)[0]
    return out


@settings(max_examples=25)
@given(late_s=st.floats(-0.04, 0.06), seed=st.integers(0, 100))
def test_it_tells_how_late_a_body_is(late_s: float, seed: int) -> None:
    lag = said(legs(T)[None], turning(T - late_s, seed, noise=0.1))[0]
    assert lag * LAG_S == pytest.approx(late_s, abs=0.003)


def test_neither_a_late_actuator_nor_its_size_is_a_late_body() -> None:
    late = T - 0.03
    assert said(0.7 * legs(late)[None], turning(late))[0] == pytest.approx(said(legs(T)[None], turning(T))[0], abs=0.2)


def test_a_body_that_follows_loosely_leaves_more_unexplained() -> None:
    firm, loose = (said(legs(T)[None], turning(T, noise=share))[1] for share in (0.1, 1.0))
    assert loose > firm + 0.5
    # Half of its turning is its own.
    assert 10**loose == pytest.approx(0.5, abs=0.1)


def test_the_best_shift_is_the_best() -> None:
    assert (said(legs(T)[None], turning(T - 0.015, noise=0.2))[2:] >= 0).all()


def test_rows_that_nobody_knows_change_little() -> None:
    pos, gyro = legs(T)[None], turning(T - 0.02)
    rng = np.random.default_rng(7)
    gyro[:, rng.random(ROWS) < 0.03] = np.nan
    assert said(pos, gyro)[0] * LAG_S == pytest.approx(0.02, abs=0.003)


def test_without_a_gyroscope_or_time_enough_nothing_is_claimed() -> None:
    assert ImuDelay.of(T[:40]) is None
    # A body that never turns, or a column without a value: finite, and nothing is explained.
    for dead in (np.zeros((1, ROWS, 3)), np.full((1, ROWS, 3), np.nan)):
        out = said(legs(T)[None], dead.astype(np.float32))
        assert np.isfinite(out).all()
        assert out[1] == pytest.approx(0.0, abs=1e-6)
