"""The catalogue: complete, consistent with effects.md, and extensible by one file."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from places import ROOT, SHARED
from plants import pendulum, sweep, write
from test_gap_apply import diagnosis, found

from openant_tools import effects
from openant_tools.effects.catalogue import acting, action, catalogue
from openant_tools.effects.effect import Cause
from openant_tools.effects.entries import entries_of, values_of
from openant_tools.effects.robot import Reference, Robot, Seen
from openant_tools.effects.rollout import rollout
from openant_tools.gap.next import experiments
from openant_tools.gap.simulation import simulate
from openant_tools.model.plant import load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run

CATALOGUE = SHARED / "effects.md"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "pendulum.xml", pendulum())


def reference(model: Path) -> Reference:
    one = np.ones(1)
    return Reference.of(load_plant(model), floor=True, imu=True, tracker=True, seen=Seen(4 * one, -one, one, 0.0))


@pytest.mark.skipif(not CATALOGUE.is_file(), reason="shared/ is not here")
def test_every_effect_of_the_catalogue_is_a_cause_with_its_family_and_scope() -> None:
    rows = re.findall(
        r"^\| ([a-z ]+) \| `(\w+)` \|.*\| ([jgab ]+) \|.*\|$", CATALOGUE.read_text(encoding="utf-8"), re.M
    )
    assert {name for _, name, _ in rows} == set(catalogue())
    for family, name, scopes in rows:
        cause = catalogue()[name]
        assert cause.family == family
        assert {str(scope) for scope in cause.scopes} <= set(scopes.split())


@pytest.mark.parametrize("cause", list(catalogue().values()), ids=list(catalogue()))
def test_a_cause_changes_a_robot_and_only_where_it_sits(cause: Cause, model: Path) -> None:
    known = reference(model)
    for x in cause.starts(0.5):
        robot, healthy = Robot(1, known.low, known.high), Robot(1, known.low, known.high)
        cause.enter(robot, np.array([0]), cause.values(x, known, np.array([0])))
        assert repr(robot) != repr(healthy)


@pytest.mark.parametrize("cause", list(catalogue().values()), ids=list(catalogue()))
def test_a_coordinate_is_the_value_and_back(cause: Cause, model: Path) -> None:
    known, joints = reference(model), np.array([0])
    for quantity in cause.quantities:
        scale = quantity.scale(known, joints)
        for x in (quantity.small, quantity.large):
            assert quantity.back(quantity.value(x, scale), scale) == pytest.approx(x)


def test_what_mujoco_does_not_carry_acts_between_steps_or_on_the_log() -> None:
    befalls = {name for name, cause in catalogue().items() if cause.acts_on is not None}
    assert befalls == {"clock_jitter", "command_dropout", "imu_bias", "tracker_scale"}
    assert {name for name, cause in catalogue().items() if not cause.native} <= set(acting()) | befalls


def test_what_tells_two_effects_apart_is_said_once_and_whichever_is_asked_first() -> None:
    for name, cause in catalogue().items():
        for other in cause.told_from:
            assert other in catalogue()
            assert name not in catalogue()[other].told_from
            assert action(name, other) is action(other, name) is cause.told_from[other]
    assert action("backlash", "payload") is None


def test_delay_in_the_log_or_in_the_command_is_no_matter_of_motion(model: Path) -> None:
    open_ = diagnosis(
        model, found("action_delay", "all", delay_s=0.02), found("sensor_delay", "all", **{"pos.delay_s": 0.02}),
        selected=False, verdict="ambiguous",
    )  # fmt: skip
    answer = experiments(open_, model, names=["steps"])
    assert "tap the robot" in answer.sentence
    assert answer.experiments[0].apart is not None
    assert answer.experiments[0].apart < 0.1


def test_joint_positions_do_not_show_that_another_sensor_is_late() -> None:
    late = catalogue()["sensor_delay"]
    assert late.unseen_in_joints_at({"pos": 0.001, "vel": 0.0, "imu": 0.02})
    assert not late.unseen_in_joints_at({"pos": 0.02, "vel": 0.0, "imu": 0.02})
    assert not late.unseen_in_joints_at({"pos": 0.001, "vel": 0.0, "imu": 0.001})
    assert catalogue()["payload"].unseen_in_joints_at(catalogue()["payload"].starts(0.5)[0])
    assert not catalogue()["backlash"].unseen_in_joints_at(catalogue()["backlash"].starts(0.5)[0])


def test_a_large_motion_tells_a_limit_from_stiffness(model: Path) -> None:
    open_ = diagnosis(
        model, found("stiffness_error", "all", scale=0.6), found("torque_limit", "all", limit=0.3),
        selected=False, verdict="ambiguous",
    )  # fmt: skip
    answer = experiments(open_, model, names=["holds", "saturating-steps"])
    assert answer.experiments[0].name == "saturating-steps"
    assert "Record `saturating-steps`" in answer.sentence


def test_nothing_is_open_where_nothing_was_found(model: Path) -> None:
    healthy = diagnosis(model, found("stiffness_error", "all", scale=0.9), selected=False, verdict="none")
    assert experiments(healthy, model).experiments == ()


@pytest.fixture
def rubbing_cable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The effect that docs/new-effect.md adds, as a file of the package."""
    page = (ROOT / "docs" / "new-effect.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.S)
    assert code is not None
    write(tmp_path / "rubbing_cable.py", code[1])
    monkeypatch.setattr(effects, "__path__", [*effects.__path__, str(tmp_path)])
    for known in (catalogue, acting):
        known.cache_clear()
    yield "rubbing_cable"
    monkeypatch.undo()
    sys.modules.pop("openant_tools.effects.rubbing_cable", None)
    for known in (catalogue, acting):
        known.cache_clear()


def test_one_file_adds_an_effect_to_the_diagnosis_the_environment_and_what_to_do_next(
    rubbing_cable: str, model: Path
) -> None:
    plant = load_plant(model)
    cause, known, joints = catalogue()[rubbing_cable], reference(model), np.array([0])
    robot = Robot(1, known.low, known.high)
    cause.enter(robot, joints, cause.values(cause.starts(1.0)[0], known, joints))
    t = np.arange(0.0, 2.0, 0.01)
    command = sweep(t, 1)[:, 0]
    run = Run("sweep", Facts(joints=("joint",)), t, {"cmd.joint": command, "pos.joint": np.zeros_like(t)})
    rollouts = Rollouts(plant, [run])
    given, diagnosed = simulate(rollouts, [Robot(1), robot], signals=["pos"]).signals["pos"]
    assert np.abs(diagnosed - given).max() > 1e-3
    values = values_of(entries_of(robot.laws, plant.joints), plant.joints)
    (played,) = rollout(rollouts, [robot.model(plant)], [values]).pos
    assert played == pytest.approx(diagnosed, abs=1e-4)
    told = action("coulomb_friction", rubbing_cable)
    assert told is not None
    assert told.name == "hold the cable"
