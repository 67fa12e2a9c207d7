"""What the judge of the diagnosis reads off logs: by how much rows are late, whatever else differs."""

from __future__ import annotations

import numpy as np
import pytest

from openant_tools.gap.features import LATENESS, LEAST_LATE_S, SKIP_S, Layout
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


def late(seen: np.ndarray, unsure: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(joints + 1,) s that rows scatter by, and how much of that is in few of them, of one log against `moved`."""
    mine = layout(unsure)
    found = mine.features({"pos": seen}, {"pos": moved(T)})[0]
    at = np.concatenate([np.full(len(kinds), name == LATENESS) for name, kinds in mine.groups().items()])
    size, peak = found[at].reshape(2, JOINTS + 1)
    return 10**size - LEAST_LATE_S, 10**peak


@pytest.mark.parametrize("scatter_s", [0.002, 0.005])
def test_rows_that_are_all_late_together_say_by_how_much(scatter_s: float) -> None:
    rng = np.random.default_rng(1)
    size, _ = late(moved(T - scatter_s * rng.normal(size=ROWS)))
    # Slow rows say little, and each row is one of those that it is compared with.
    assert 0.55 * scatter_s < size[-1] < scatter_s


def test_a_few_rows_that_are_very_late_are_peaks() -> None:
    rng = np.random.default_rng(2)
    jitter, lost = (
        late(moved(T - 0.005 * rng.normal(size=ROWS)))[1][-1],
        late(moved(T - 0.02 * (rng.random(ROWS) < 0.04)))[1][-1],
    )
    assert lost > 1.25 * jitter


@pytest.mark.parametrize("rate_hz", [50, 200])
def test_a_command_that_is_lost_shows_at_any_rate(rate_hz: int) -> None:
    count = 10 * rate_hz
    t = np.arange(count) / rate_hz
    by = np.repeat(0.02 * (np.random.default_rng(6).random(500) < 0.05), rate_hz // 50)
    swing = [0.5 * np.sin(2 * np.pi * 0.9 * (t - late_s))[None, :, None].astype(np.float32) for late_s in (by, 0.0)]
    mine = Layout(t, Setup.STAND, 1, ("pos",), float(t[-1]), np.zeros((count, 1), bool))
    size = 10 ** mine.features({"pos": swing[0]}, {"pos": swing[1]})[0, -4]
    assert 0.55 * np.sqrt(np.mean(by**2)) < size < np.sqrt(np.mean(by**2))


def test_what_joints_do_each_for_itself_is_not_late_together() -> None:
    rng = np.random.default_rng(3)
    apart, _ = late(moved(T[:, None] - 0.005 * rng.normal(size=(ROWS, JOINTS))))
    together, _ = late(moved(T - 0.005 * rng.normal(size=ROWS)))
    assert apart[-1] < 0.5 * together[-1]
    assert apart[:-1].mean() > 0.8 * together[:-1].mean()


def test_one_joint_that_loses_its_commands_is_that_one() -> None:
    rng = np.random.default_rng(4)
    by = np.zeros((ROWS, JOINTS))
    by[:, 5] = 0.02 * (rng.random(ROWS) < 0.1)
    size, _ = late(moved(T[:, None] - by))
    assert int(size.argmax()) == 5


def test_missing_and_unsure_rows_do_not_count() -> None:
    rng = np.random.default_rng(5)
    seen = moved(T - 0.003 * rng.normal(size=ROWS))
    size, _ = late(seen)
    unsure = np.zeros((ROWS, JOINTS), bool)
    unsure[200:230, 2] = True
    odd = seen.copy()
    odd[0, 200:230, 2] += 1.0
    odd[0, 300:305] = np.nan
    found, _ = late(odd, unsure)
    np.testing.assert_allclose(found, size, rtol=0.15)


def test_features_of_a_signal_say_which_joint_they_are_of() -> None:
    mine = layout(signals=("pos", "gyro"))
    groups = mine.groups()
    for signal, kinds in groups.items():
        assert len(mine.joints_of(signal)) == len(kinds)
    assert mine.joints_of(LATENESS) == [*range(JOINTS), -1, *range(JOINTS), -1]
    assert set(mine.joints_of("gyro")) == {-1}
    assert mine.joints_of("pos")[:JOINTS] == list(range(JOINTS))
    count = sum(map(len, groups.values()))
    body = np.zeros((1, ROWS, 3), np.float32)
    assert mine.features({"pos": moved(T), "gyro": body}, {"pos": moved(T), "gyro": body}).shape == (1, count)
    assert mine.blocks("pos")[0] == SKIP_S
