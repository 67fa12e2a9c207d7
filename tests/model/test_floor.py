"""What no model could beat: from repeats, from what sensors do at rest, and from time stamps that are off."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openant_tools.model.floor import floors, noise, stamp_error
from openant_tools.recording.run import Facts, Run

JOINTS = tuple(f"joint_{k}" for k in range(8))
STEP = 0.00153


def moving(*, stamp_s: float = 0.0, apart_s: float = 0.0006, hz: float = 2.0, seed: int = 0, joints: int = 8) -> Run:
    """Ten seconds of joints that all move; rows come when they will, and their stamps are off by some more (standard deviations)."""
    rng = np.random.default_rng(seed)
    sampled = np.sort(np.arange(500) / 50 + rng.normal(0, apart_s, 500))
    phases, ways = rng.uniform(0, 6, joints), rng.uniform(0.2, 0.5, joints)
    pos = np.sum(
        [ways * np.sin(2 * np.pi * f * sampled[:, None] + phases) / n for n, f in enumerate((0.7, hz), 1)], axis=0
    )
    seen = np.round(pos / STEP) * STEP
    columns = {f"pos.{name}": seen[:, j] for j, name in enumerate(JOINTS[:joints])}
    columns |= {f"cmd.{name}": pos[:, j] for j, name in enumerate(JOINTS[:joints])}
    return Run("moving", Facts(JOINTS[:joints]), sampled + rng.normal(0, stamp_s, 500), columns)


@pytest.mark.parametrize("stamp_s", [0.0003, 0.0007, 0.002])
def test_the_error_of_stamps_is_found_whatever_the_encoders_resolution(stamp_s: float) -> None:
    runs = [moving(stamp_s=stamp_s, seed=seed) for seed in range(3)]
    assert stamp_error(runs, JOINTS) == pytest.approx(stamp_s, rel=0.25)


@pytest.mark.parametrize("seed", range(6))
def test_stamps_that_are_right_are_not_called_wrong(seed: int) -> None:
    assert stamp_error([moving(seed=seed)], JOINTS) < 0.00012, "rows that come when they will are no error"


def test_of_one_joint_nobody_can_tell_stamps_from_noise() -> None:
    assert stamp_error([moving(stamp_s=0.002, joints=1)], JOINTS[:1]) == 0.0


def test_too_few_rows_say_nothing() -> None:
    run = moving(stamp_s=0.002)
    short = Run("short", run.facts, run.t[:9], {name: values[:9] for name, values in run.columns.items()})
    assert stamp_error([short], JOINTS) == 0.0


def test_the_floor_is_what_joints_move_within_the_error_of_a_stamp() -> None:
    run = moving(stamp_s=0.002)
    found, from_repeats = floors([run], JOINTS)
    speed = [float(np.sqrt(np.mean(np.square(np.gradient(run.column(f"cmd.{name}"), run.t))))) for name in JOINTS]
    assert not from_repeats
    assert found == pytest.approx(np.hypot(STEP / math.sqrt(12), 0.002 * np.array(speed)), rel=0.3)
    still, _ = floors([moving()], JOINTS)
    assert still == pytest.approx(np.full(8, STEP / math.sqrt(12)), rel=0.1)


def test_noise_is_what_scatters_where_nothing_moves() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(400) / 50
    command = np.where(t < 4, 0.0, 0.5 * np.sin(3 * t))
    values = command + rng.normal(0, 0.01, 400)
    run = Run("noisy", Facts(("joint",)), t, {"cmd.joint": command, "pos.joint": values})
    assert noise(run, "pos", ["joint"]) == pytest.approx([0.01], rel=0.15)
    assert floors([run], ["joint"])[0] == pytest.approx([0.01], rel=0.15)
    never = Run("moves", run.facts, t, {"cmd.joint": np.sin(t), "pos.joint": values})
    assert noise(never, "pos", ["joint"]) == [0.0]
