"""What comes back at the same angles, and what does not: gears and lost commands made by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from openant_tools.gap.returning import returning

Array = NDArray[np.float64]
T = np.arange(0.0, 12.0, 0.02)
#: Hz of a motion that never comes back to where it was, and of one that does
ODD, PERIODIC = (0.31, 0.83, 1.27), (0.5, 1.0, 1.5)


def moving(seed: int, t: Array = T, hertz: tuple[float, ...] = ODD) -> Array:
    """(rows, 2) rad."""
    rng = np.random.default_rng(seed)
    return np.stack(
        [sum(rng.normal(0, 0.2 / f) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in hertz) for _ in "ab"],
        axis=1,
    )


def share(seen: list[Array], simulated: list[Array]) -> float:
    return returning(
        [T] * len(seen), [one.astype(np.float32) for one in seen], [one.astype(np.float32) for one in simulated]
    )


def noise(seed: int) -> Array:
    return np.random.default_rng(50 + seed).normal(0, 1e-3, (len(T), 2))


@pytest.mark.parametrize("hertz", [ODD, PERIODIC], ids=["odd", "periodic"])
def test_commands_that_are_lost_do_not_come_back(hertz: tuple[float, ...]) -> None:
    made = [moving(seed, hertz=hertz) for seed in range(3)]
    lost = [0.02 * (np.random.default_rng(seed).random(len(T)) < 0.1) for seed in range(3)]
    seen = [moving(seed, T - lost[seed], hertz) + noise(seed) for seed in range(3)]
    assert abs(share(seen, made)) < 0.08


def test_a_tooth_that_is_missing_comes_back() -> None:
    made = [moving(seed) for seed in range(3)]
    behind = [np.sign(np.gradient(one, T, axis=0)) * ((one % 0.25) < 0.04) for one in made]
    seen = [one - 0.01 * tooth + noise(seed) for seed, (one, tooth) in enumerate(zip(made, behind, strict=True))]
    assert share(seen, made) > 0.4


def test_half_of_it_comes_back_where_both_are_there() -> None:
    made = [moving(seed) for seed in range(4)]
    seen = []
    for seed, one in enumerate(made):
        tooth = np.sign(np.gradient(one, T, axis=0)) * ((one % 0.25) < 0.04)
        lost = 0.02 * (np.random.default_rng(seed).random(len(T)) < 0.1)
        seen.append(moving(seed, T - lost) - 0.01 * tooth + noise(seed))
    assert 0.1 < share(seen, made) < 0.6


def test_joints_that_rest_and_rows_that_nobody_measured_say_nothing() -> None:
    still = [np.zeros((len(T), 2))] * 2
    assert share([one + noise(seed) for seed, one in enumerate(still)], still) == 0.0
    made = [moving(seed) for seed in range(3)]
    seen = [one + noise(seed) for seed, one in enumerate(made)]
    for one in seen:
        one[100:150] = np.nan
    assert abs(share(seen, made)) < 0.08
