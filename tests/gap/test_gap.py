"""How far a simulation is from its robot, and where: on robots whose error was put in by hand."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from plants import ENCODER_RAD, drive, pendulum, sweep, write

from openant_tools.cli.gap import gap
from openant_tools.errors import BadInput
from openant_tools.gap.measure import Measurement, measure
from openant_tools.gap.regime import Regime, regimes
from openant_tools.gap.words import part_words
from openant_tools.model.plant import load_plant
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table

T = np.arange(0.0, 6.0, 0.01)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write(tmp_path / "pendulum.xml", pendulum())


def recorded(model: Path, name: str = "run", *, seed: int = 0, repeat_of: str | None = None, **changed: float) -> Run:
    """What the model would record if some of its numbers were others, with encoder and noise."""
    plant = load_plant(model)
    real = copy.copy(plant.model)
    for field, value in changed.items():
        getattr(real, field)[:] = value
    columns = drive(real, plant.joints, T, sweep(T, 1), noise=5e-4, quantum=ENCODER_RAD, seed=seed)
    return Run(name, Facts(joints=plant.joints, repeat_of=repeat_of), T, columns)


def where(found: Measurement, signal: str = "pos") -> dict[Regime, float]:
    return {place.regime: place.share for place in found.places if place.signal == signal}


def test_a_right_model_is_as_good_as_the_repeat(model: Path) -> None:
    runs = [recorded(model, "a"), recorded(model, "b", seed=1, repeat_of="a")]
    found = measure(runs, model)
    assert found.from_repeats
    # The start of each segment is measured too, so that its noise comes on top.
    assert found.gaps["pos"] < 2 * found.floors["pos"]


def test_repeats_that_disagree_are_no_floor_to_judge_by(model: Path, tmp_path: Path) -> None:
    runs = [recorded(model, "a"), recorded(model, "b", seed=1, repeat_of="a")]
    assert measure(runs, model).doubt == ""
    # Between the two plays of one motion its load has doubled: the floor that they would give hides every gap.
    runs[1] = recorded(model, "b", seed=1, repeat_of="a", body_mass=2.0, dof_damping=0.3)
    found = measure(runs, model)
    assert found.doubt.startswith("the repeats disagree: two plays of one motion differ by")
    assert "most at joint" in found.doubt
    assert found.as_json()["doubt"] == found.doubt
    paths = []
    for run in runs:
        paths.append(tmp_path / f"{run.name}.parquet")
        write_table(run, paths[-1])
    asked = ["measure", *map(str, paths), "--model", str(model), "--report", str(tmp_path / "report")]
    answer = CliRunner().invoke(gap, asked, standalone_mode=False)
    assert answer.return_value == 1
    assert "Cannot judge the gap: the repeats disagree" in answer.output
    assert "Cannot judge the gap" in (tmp_path / "report" / "report.html").read_text()


def test_the_gap_of_a_servo_that_is_too_weak_lies_where_it_gives_all(model: Path) -> None:
    plant = load_plant(model)
    weak = recorded(model, actuator_forcerange=np.array([-0.8, 0.8]))  # type: ignore[arg-type]
    found = measure([weak], model)
    assert not found.from_repeats
    assert found.gaps["pos"] > 10 * found.floors["pos"]
    told = where(found)
    assert sum(told.values()) == pytest.approx(1.0)
    rows = regimes(weak, plant)[:, 0]
    assert Regime.SATURATED.value in rows
    # What it lost in saturation it makes up for while it moves; none of it lies in rest.
    assert told[Regime.SATURATED] > 3 * told.get(Regime.HOLD, 0.0)


def test_rows_without_torque_are_their_own_regime(model: Path) -> None:
    run = recorded(model)
    limp = Run(run.name, run.facts, run.t, {**run.columns, "torque.joint": (T < 3).astype(float)})
    rows = regimes(limp, load_plant(model))[:, 0]
    assert set(rows[T >= 3]) == {Regime.RELEASED.value}
    assert Regime.RELEASED.value not in rows[T < 3]
    assert {Regime.REVERSAL.value, Regime.HOLD.value} <= set(rows)


def test_the_command_tells_shows_and_writes(model: Path, tmp_path: Path) -> None:
    table = tmp_path / "run.parquet"
    write_table(recorded(model, dof_damping=0.3), table)
    arguments = [str(table), "--model", str(model), "--json", str(tmp_path / "g.json"), "--report", str(tmp_path / "r")]
    ran = CliRunner().invoke(gap, ["measure", *arguments], standalone_mode=False)
    assert ran.exception is None
    assert "The simulation is off by" in ran.output
    told = json.loads((tmp_path / "g.json").read_text())
    assert told["signals"]["pos"]["gap"] > told["signals"]["pos"]["floor"]
    assert sum(place["share"] for place in told["where"] if place["signal"] == "pos") == pytest.approx(1.0)
    page = (tmp_path / "r" / "report.html").read_text()
    assert "position is farthest off" in page
    assert "Every 0.5\u00a0s the simulation starts again from what was measured" in page
    assert Regime.REVERSAL.words in page
    assert Regime.REVERSAL.words in ran.output
    for never in (Regime.RELEASED.words, Regime.RELEASED.value):
        assert never not in page, "what no joint was seen in has no column"


def test_what_is_called_most_of_a_gap_is_more_than_its_half() -> None:
    assert (
        part_words(0.79, "hip_rl", Regime.SATURATED)
        == "most of it (79 %) lies at hip_rl while the servo gives all it may"
    )
    assert part_words(0.06, "knee_fl", Regime.HOLD) == "its largest part (6 %) lies at knee_fl while it stands"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--horizon", "soon"], "--horizon soon is no time → give seconds"),
        (["--joint", "elbow"], "no position-controlled joint 'elbow'"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], words: str, model: Path, tmp_path: Path) -> None:
    table = tmp_path / "run.parquet"
    write_table(recorded(model), table)
    ran = CliRunner().invoke(gap, ["measure", str(table), "--model", str(model), *arguments], standalone_mode=False)
    assert isinstance(ran.exception, BadInput)
    assert words in str(ran.exception)


def test_runs_of_another_robot_are_refused(model: Path) -> None:
    other = Run("x", Facts(joints=("a",)), T, {"cmd.a": np.zeros_like(T), "pos.a": np.zeros_like(T)})
    with pytest.raises(BadInput, match=r"the model's joints \(joint\) are not those of the runs \(a\)"):
        measure([other], model)
