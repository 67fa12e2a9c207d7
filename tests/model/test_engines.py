"""Somebody steps a written model in another engine, and is told what becomes of it there before it does so in silence."""

from __future__ import annotations

import runpy
from pathlib import Path

import mujoco
import pytest
import tomlkit
from places import ROOT
from plants import pendulum, write

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.apply import apply
from openant_tools.gap.diagnosis import Diagnosis, Found, Span
from openant_tools.model.engines import EFFECTS, FEATURES, engines, features_of
from openant_tools.model.mjcf import write_model
from openant_tools.model.plant import Setup, load_plant

BENCHMARK = runpy.run_path(str(ROOT / "benchmarks" / "engines.py"))


@pytest.mark.parametrize("feature", FEATURES)
def test_each_feature_is_known_by_the_model_that_every_engine_was_run_with(feature: str) -> None:
    with_it, without = (mujoco.MjModel.from_xml_string(xml) for xml in BENCHMARK["MODELS"][feature])
    assert feature in features_of(with_it)
    assert feature not in features_of(without)
    assert {table[feature] for table in engines().values()} <= {"carries", "drops", "refuses"}


def test_the_table_is_of_this_engine_and_every_effect_of_it_is_in_the_catalogue() -> None:
    ours = next(iter(engines()))
    assert ours.startswith("MuJoCo 4")
    assert set(engines()[ours].values()) == {"carries"}
    assert set(EFFECTS) <= set(catalogue())


def test_the_page_has_the_table_as_it_was_measured() -> None:
    page = (ROOT / "docs" / "gap.md").read_text()
    assert f"| written as | {' | '.join(engines())} |" in page
    for feature in FEATURES:
        assert f"| {feature} | {' | '.join(table[feature] for table in engines().values())} |" in page


def head(path: Path) -> str:
    """The first comment of a model."""
    return path.read_text().partition("<!--")[2].partition("-->")[0]


def late(model: Path, *, calibrated: float = 0.0) -> Diagnosis:
    found = [
        Found(name, ("joint",), {parameter: Span(value, value, value)}, 0.9, 0.8, 0.7, 0.9, True)
        for name, parameter, value in (("action_delay", "delay_s", 0.02), ("coulomb_friction", "torque_nm", 0.05))
    ]
    return Diagnosis(
        model=str(model), runs=("a",), held_out=(), verdict="action_delay", confidence=0.9, effects=tuple(found),
        selected=("action_delay", "coulomb_friction"), ambiguous_with=(), next_experiment=None,
        gap={"before": 0.02, "after": 0.004, "floor": 0.001}, where=[],
        calibration={"delay": {"joint": calibrated}} if calibrated else {},
    )  # fmt: skip


def test_a_model_for_mjx_leaves_beside_it_what_mjx_does_not_carry(tmp_path: Path) -> None:
    model = write(tmp_path / "given.xml", pendulum())
    whole = apply(late(model), model, tmp_path / "whole.xml")
    plant = load_plant(tmp_path / "whole.xml", None, Setup.FLOOR)
    assert plant.model.actuator_delay[0] == pytest.approx(0.02)
    assert "MJX" in whole.carried[0]  # said at the effect itself, on the terminal
    assert "MJX" not in whole.carried[1]
    said = head(tmp_path / "whole.xml")
    assert "drops delayed commands" in said or "refuses delayed commands" in said
    assert "MuJoCo 4.0.0 carries it as written" in said
    for calibrated in (0.0, 0.01):
        apply(late(model, calibrated=calibrated), model, tmp_path / "mjx.xml", engine="mjx")
        plant = load_plant(tmp_path / "mjx.xml", None, Setup.FLOOR)
        assert not plant.model.actuator_delay.any()
        assert plant.model.dof_frictionloss[0] > 0.05
        assert "MJX" in head(tmp_path / "mjx.xml")
        assert "delayed" not in head(tmp_path / "mjx.xml")
        entries = tomlkit.parse((tmp_path / "mjx.effects.toml").read_text()).unwrap()["effect"]
        assert entries[0]["effect"] == "action_delay"
        assert sum(entry["parameters"]["delay_s"] for entry in entries) == pytest.approx(0.02 + calibrated)


def test_a_model_that_is_written_again_says_it_once(tmp_path: Path) -> None:
    source = write(tmp_path / "given.xml", pendulum())
    for name in ("once.xml", "twice.xml"):
        plant = load_plant(source, None, Setup.FLOOR)
        source = write_model(source, plant.model, tmp_path / name, note="Fitted.")
    assert (tmp_path / "twice.xml").read_text().count("Engines: ") == 1
    assert head(tmp_path / "twice.xml").strip().startswith("Fitted. Engines: ")
