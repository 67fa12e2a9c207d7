"""Bad recordings are named before any number is given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, load_plant
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.quality import check_runs

JOINTS = ("hip_rr", "knee_rr", "hip_fr", "knee_fr")
QUANTUM = 2 * np.pi / 4096


@pytest.fixture(scope="module")
def plant() -> Plant:
    return load_plant(nominal_model_path("standard"), JOINTS)


def good_run(seconds: float = 6.0) -> Run:
    """Four joints, each on a motion of its own, followed as a servo follows: late and in steps of its encoder."""
    t = np.arange(0.0, seconds, 0.02)
    columns = {}
    for k, joint in enumerate(JOINTS):

        def angle(at: np.ndarray, k: int = k) -> np.ndarray:
            return (-0.8 if k % 2 else 0.0) + 0.3 * np.sin(2 * np.pi * (0.4 + 0.27 * k) * at)

        columns[f"cmd.{joint}"] = angle(t)
        columns[f"pos.{joint}"] = np.round(angle(t - 0.05) / QUANTUM) * QUANTUM
    return Run("good", Facts(JOINTS, resolution={"pos": QUANTUM}), t, columns, Path("good.parquet"))


def with_columns(**changed: np.ndarray) -> Run:
    run = good_run()
    return replace(run, columns={**run.columns, **{name.replace("__", "."): v for name, v in changed.items()}})


def refused(run: Run, plant: Plant) -> str:
    with pytest.raises(BadInput) as caught:
        check_runs([good_run(), run], plant)
    assert "good.parquet" in str(caught.value)
    return str(caught.value)


def test_a_good_run_passes(plant: Plant) -> None:
    check_runs([good_run()], plant)


def test_too_short(plant: Plant) -> None:
    assert "too short to fit: 0.48 s" in refused(good_run(0.5), plant)


def test_nothing_moves(plant: Plant) -> None:
    still = {f"pos__{joint}": np.full(300, -0.4) for joint in JOINTS}
    assert "nothing moves" in refused(with_columns(**still), plant)


def test_a_dead_joint_is_named(plant: Plant) -> None:
    message = refused(with_columns(pos__knee_rr=np.full(300, -0.8)), plant)
    assert "knee_rr is commanded over 0.60 rad and does not move" in message
    assert "--joint" in message


def test_swapped_columns_are_named(plant: Plant) -> None:
    run = good_run()
    swapped = with_columns(pos__hip_rr=run.columns["pos.hip_fr"], pos__hip_fr=run.columns["pos.hip_rr"])
    assert "pos.hip_rr follows cmd.hip_fr, and pos.hip_fr follows cmd.hip_rr" in refused(swapped, plant)


def test_a_reversed_joint_is_named(plant: Plant) -> None:
    assert "hip_fr moves against its command" in refused(
        with_columns(pos__hip_fr=-good_run().column("pos.hip_fr")), plant
    )


def test_degrees_are_named(plant: Plant) -> None:
    run = good_run()
    message = refused(with_columns(pos__knee_fr=np.degrees(run.column("pos.knee_fr"))), plant)
    assert "pos.knee_fr is around -45" in message
    assert "unit (rad)" in message


def test_a_servo_that_is_saturated_throughout_is_named(plant: Plant) -> None:
    run = good_run()
    limited = replace(run, facts=replace(run.facts, registers={"hip_rr": {"pwm_limit": 442}}))
    duty = np.full(len(run.t), 442 / 885)
    limited = replace(limited, columns={**limited.columns, "pwm.hip_rr": duty})
    assert "hip_rr works at its torque limit in 100 % of the samples" in refused(limited, plant)


def test_saturation_shows_without_duty_too(plant: Plant) -> None:
    run = good_run()
    held = np.where(np.arange(len(run.t)) % 2 == 0, 0.01, -0.01)
    message = refused(with_columns(cmd__hip_rr=run.column("cmd.hip_rr") + 2.0, pos__hip_rr=held), plant)
    assert "hip_rr works at its torque limit" in message


def test_joints_that_are_commanded_alike_are_not_called_swapped(plant: Plant) -> None:
    run = good_run()
    check_runs([with_columns(cmd__hip_fr=run.column("cmd.hip_rr"), pos__hip_fr=run.column("pos.hip_rr"))], plant)
