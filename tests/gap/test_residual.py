"""What a diagnosis leaves: errors made by hand of a quantity that is known, and places of a gap that another model closes."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from plants import ENCODER_RAD, drive, pendulum, sweep, write

from openant_tools.gap.measure import measure
from openant_tools.gap.residual import places_left, residual_of
from openant_tools.model.plant import load_plant
from openant_tools.recording.run import Facts, Run

Array = NDArray[np.float64]
PERIOD_S = 0.02
T = np.arange(0.0, 12.0, PERIOD_S)
JOINTS = ("hip", "knee")


def moving(seed: int) -> tuple[Run, dict[str, Array]]:
    """A run, and how a model moves: all its quantities known, none of them alike."""
    rng = np.random.default_rng(seed)
    pos = np.stack([sum(rng.normal(0, 0.3 / f) * np.sin(2 * np.pi * f * T + rng.uniform(0, 6)) for f in (0.4, 0.9, 1.7, 2.9)) for _ in JOINTS], axis=1)  # fmt: skip
    velocity = np.gradient(pos, T, axis=0)
    torque = np.stack([np.convolve(rng.normal(0, 1, len(T)), np.ones(6) / 6, "same") for _ in JOINTS], axis=1)
    volts = 11 + np.convolve(rng.normal(0, 1, len(T)), np.ones(40) / 8, "same")
    columns = {f"{name}.{joint}": pos[:, j] for j, joint in enumerate(JOINTS) for name in ("cmd", "pos")}
    columns |= {f"volt.{joint}": volts for joint in JOINTS}
    return Run("run", Facts(joints=JOINTS), T, columns), {"pos": pos, "vel": velocity, "torque": torque}


def error_of(values: Array, joint: int, seed: int, noise: float = 2e-3) -> Array:
    """An error of one joint that follows a quantity late and faintly, in noise of both."""
    rng = np.random.default_rng(100 + seed)
    out = rng.normal(0, noise, (len(T), len(JOINTS)))
    late = np.convolve(values - values.mean(), [0, 0, 0.5, 0.5])[: len(T)]
    out[:, joint] += 0.02 * late / late.std()
    return out


def test_what_the_rest_follows_is_found_by_joint_and_by_band() -> None:
    runs, simulated = zip(*(moving(seed) for seed in range(2)), strict=True)
    turning = [error_of(np.tanh(one["vel"][:, 1] / 0.05), 1, n) for n, one in enumerate(simulated)]
    found = residual_of(runs, JOINTS, turning, simulated)
    assert found is not None
    assert (found.joint, found.regressor) == ("knee", "the direction in which it moves")
    assert found.coherence > 0.7
    assert 0.2 < found.low_hz < found.high_hz < 4
    sagging = [error_of(run.column("volt.hip"), 0, n) for n, run in enumerate(runs)]
    found = residual_of(runs, JOINTS, sagging, simulated)
    assert found is not None
    assert (found.joint, found.regressor) == ("hip", "the supply's voltage")
    assert found.high_hz < 2


def test_a_rest_that_follows_nothing_is_said_to() -> None:
    runs, simulated = zip(*(moving(seed) for seed in range(2)), strict=True)
    rng = np.random.default_rng(7)
    found = residual_of(runs, JOINTS, [rng.normal(0, 0.01, (len(T), 2)) for _ in runs], simulated)
    assert found is not None
    assert found.regressor is None


def test_a_rest_of_less_than_a_few_segments_says_nothing() -> None:
    run, simulated = moving(0)
    short = Run("short", run.facts, T[:80], {name: values[:80] for name, values in run.columns.items()})
    cut = {name: values[:80] for name, values in simulated.items()}
    assert residual_of([short], JOINTS, [np.zeros((80, 2))], [cut]) is None


def test_places_show_what_another_model_leaves_of_the_gap_there(tmp_path: Path) -> None:
    model = write(tmp_path / "pendulum.xml", pendulum())
    plant = load_plant(model)
    weak = copy.copy(plant.model)
    weak.actuator_forcerange[:] = np.array([-0.8, 0.8])
    t = np.arange(0.0, 6.0, 0.01)
    run = Run("weak", Facts(joints=plant.joints), t, drive(weak, plant.joints, t, sweep(t, 1), noise=0.0, quantum=ENCODER_RAD))  # fmt: skip
    found = measure([run], model)
    same = places_left(found, [found.played[0].simulated])
    assert [place["share_after"] for place in same] == pytest.approx([place["share"] for place in same])
    perfect = places_left(found, [{"pos": found.played[0].measured["pos"]}])
    left = [place["share_after"] for place in perfect if place["signal"] == "pos"]
    assert left == pytest.approx([0.0] * len(left))
    assert [p["share_after"] for p in perfect if p["signal"] == "vel"] == [
        p["share"] for p in perfect if p["signal"] == "vel"
    ]
