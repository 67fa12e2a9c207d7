"""One recording, whatever its motion, is diagnosed at once: nothing was prepared for it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from openant_tools.effects.catalogue import enter
from openant_tools.effects.robot import Robot
from openant_tools.errors import BadInput
from openant_tools.gap import cache
from openant_tools.gap.cache import CACHE_VARIABLE
from openant_tools.gap.diagnose import diagnose
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.simulation import simulate
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run

PENDULUM = """
<mujoco model="pendulum"><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body pos="0 0 1"><inertial pos="0 0 -0.1" mass="0.1" diaginertia="1e-4 1e-4 1e-5"/>
    <joint name="hinge" axis="0 1 0" damping="0.03" armature="0.002" frictionloss="0.01"/></body></worldbody>
  <actuator><position name="hinge" joint="hinge" kp="1.5" forcerange="-0.5 0.5"/></actuator>
</mujoco>"""
ENCODER_RAD = 0.0015


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "pendulum.xml"
    path.write_text(PENDULUM)
    return path


@pytest.fixture(autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))


def _recorded(model: Path, cause: str | None = None, x: dict[str, float] | None = None, seconds: float = 6.0) -> Run:
    """What a pendulum logged: steps and swings, at 80 Hz."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 1 / 80)
    wave = 0.5 * np.sin(2 * np.pi * 0.7 * t) + 0.3 * np.sign(np.sin(2 * np.pi * 0.4 * t)) * (t > 1)
    asked = Run("swing", Facts(joints=("hinge",), setup="stand"), t, {"cmd.hinge": wave, "pos.hinge": wave})
    played = RunSet.of([asked], model, ["hinge"], [None])
    robot = Robot(1, played.reference.low, played.reference.high)
    if cause is not None:
        enter(robot, played.reference, [(cause, (0,), x or {})])
    one = played.runs[0]
    found = simulate(Rollouts(one.plant, [one.run], nthread=1), [robot], 0, ["pos", "vel"]).signals
    pos = found["pos"][0, :, 0] + 3e-4 * rng.standard_normal(len(t))
    columns = {
        **asked.columns,
        "pos.hinge": np.round(pos / ENCODER_RAD) * ENCODER_RAD,
        "vel.hinge": found["vel"][0, :, 0].astype(float),
    }
    return replace(asked, columns=columns)


@pytest.mark.slow
def test_one_run_of_a_robot_that_is_late_names_what_is_late(model: Path) -> None:
    found = diagnose([_recorded(model, "action_delay", {"delay_s": 0.05})], model)
    alike = {"action_delay", "sensor_delay", "actuator_lag"}  # a stand by itself can hardly tell these
    assert {found.effects[0].effect, found.verdict, *(name for group in found.ambiguous_with for name in group)} & alike
    assert len(found.held_out) >= 4, "parts of the one run are held out in turn"
    assert all("swing[" in part for part in found.held_out)


@pytest.mark.slow
def test_one_run_of_a_robot_as_its_model_says_names_nothing(model: Path) -> None:
    found = diagnose([_recorded(model)], model)
    assert found.verdict == "none"
    assert found.selected == ()


def test_what_is_too_short_to_hold_anything_out_is_refused_in_one_line(model: Path) -> None:
    with pytest.raises(BadInput, match="too little to hold parts of it out"):
        diagnose([_recorded(model, seconds=2.0)], model)


def test_recordings_that_were_looked_at_long_ago_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "LARGEST_BYTES", 25)
    place = cache.cache_folder()
    for age, name in enumerate(("recording-new.npz", "recording-used.npz", "recording-old.npz")):
        (place / name).write_bytes(bytes(10))
        os.utime(place / name, (1e9 - age, 1e9 - age))
    cache.keep_small(place / "recording-new.npz")
    assert sorted(path.name for path in place.iterdir()) == ["recording-new.npz", "recording-used.npz"]
