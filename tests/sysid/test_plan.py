"""What a plan promises: expected intervals, verdicts, objections, and motions chosen to tell most."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from click.testing import CliRunner

from openant_tools.cli.sysid_plan import plan
from openant_tools.errors import BadInput
from openant_tools.model.plant import Setup, load_plant
from openant_tools.robot.mjcf import nominal_mjcf, nominal_model_path
from openant_tools.sysid import design as design_module
from openant_tools.sysid.dataset import Dataset
from openant_tools.sysid.design import design
from openant_tools.sysid.excitation import Rest, Steps
from openant_tools.sysid.forecast import ENCODER_RAD, forecast
from openant_tools.sysid.parameter import choose
from openant_tools.sysid.plan import Expectation, Plan, Planned, Residual, make_plan
from openant_tools.sysid.plan_file import read_plan
from openant_tools.sysid.problem import Problem
from openant_tools.sysid.protocols import CommandSpace, Protocol, protocol

MODEL = nominal_model_path("standard")
SPACE = CommandSpace.around_home()
ASKED = Planned(MODEL, SPACE)


def _of(plan: Plan, name: str) -> Expectation:
    return next(one for one in plan.expectations if one.name == name)


def test_only_a_release_shows_what_of_the_damping_is_electrical() -> None:
    asked = replace(ASKED, kinds=("damping", "electrical_damping"), tie="all")
    released = make_plan(asked, [protocol("releases", 6.0)])
    held = make_plan(replace(asked, kinds=("damping",)), [protocol("chirp", 6.0)])
    assert _of(released, "electrical_damping.all").verdict == "identified"
    assert [one.name for one in held.expectations] == ["damping.all"]
    assert _of(held, "damping.all").verdict == "identified"


def test_a_hips_zero_is_undetermined_since_its_axis_is_vertical_and_gains_are_found() -> None:
    made = make_plan(replace(ASKED, kinds=("stiffness", "zero_offset")), [protocol("holds", 8.0)])
    assert _of(made, "zero_offset.hip_fl").verdict == "not in the data"
    hip = _of(made, "stiffness.hip_fl")
    assert hip.prior_low < hip.low < hip.nominal < hip.high < hip.prior_high
    assert made.objections == []


def test_what_acts_alike_is_tied_and_named() -> None:
    # While torque neither saturates nor goes off, what brakes in the servo brakes as what brakes in the joint.
    slow = Protocol("slow", "", (Steps(5.0, largest_rad=0.05),))
    made = make_plan(replace(ASKED, kinds=("damping", "velocity_gain")), [slow])
    knee = _of(made, "damping.knee_fl")
    assert (knee.verdict, knee.tied_to) == ("tied", "velocity_gain.knee_fl")
    assert knee.correlation < -0.7


def test_a_model_that_brakes_in_joint_and_servo_is_planned_for_as_it_is_fitted(tmp_path: Path) -> None:
    both = tmp_path / "both.xml"
    both.write_text(nominal_mjcf("standard").replace('<position kp="', '<position kv="0.05" kp="'))
    made = make_plan(replace(ASKED, model=both, tie="all"), [Protocol("still", "", (Rest(1.0),))])
    names = {one.name for one in made.expectations}
    assert {"damping.all", "velocity_gain.all"} <= names
    assert "electrical_damping.all" not in names, "torque stays on"


def test_nothing_moves_and_nothing_is_known() -> None:
    made = make_plan(replace(ASKED, kinds=("damping",), tie="all"), [Protocol("still", "", (Rest(3.0),))])
    # Only the ways from home and back.
    moved = make_plan(replace(ASKED, kinds=("damping",), tie="all"), [protocol("chirp", 6.0)])
    assert moved.nats > made.nats > 0


def test_more_is_left_and_less_is_known() -> None:
    asked = replace(ASKED, kinds=("stiffness", "damping"), tie="all")
    fine = make_plan(asked, [protocol("chirp", 6.0)])
    coarse = make_plan(replace(asked, residual=Residual(rad=0.02, memory_s=0.3)), [protocol("chirp", 6.0)])
    for one in fine.expectations:
        other = _of(coarse, one.name)
        assert other.high - other.low > 2 * (one.high - one.low)


def test_intervals_are_those_that_a_fit_reports_of_such_data() -> None:
    """The same numbers by two ways: the plan's sum of sensitivities, and a fit of simulated positions with such noise."""
    residual = Residual(rad=2e-3, memory_s=0.0)
    asked = replace(ASKED, kinds=("stiffness", "coulomb_friction"), tie="all", residual=residual)
    made = make_plan(asked, [protocol("stand", 6.0)])
    plant = load_plant(MODEL, SPACE.joints, Setup.STAND)
    chance = np.random.default_rng(0)
    run = made.forecasts[0].run
    noisy = {
        name: values + chance.normal(0, residual.rad, len(values)) if name.startswith("pos.") else values
        for name, values in run.columns.items()
    }
    data = Dataset.prepare(plant, [replace(run, columns=noisy)])
    parameters = choose(plant, ["stiffness", "coulomb_friction"], "all")
    estimate = Problem([data], parameters, np.full(8, ENCODER_RAD / 12**0.5)).solve()
    for k, one in enumerate(made.expectations):
        # Before a fit widens its intervals by what time stamps and steps leave open.
        assert 0.5 < np.sqrt((1 - one.information) / (1 - estimate.information[k])) < 2.0


def test_the_forecast_shows_the_torque_limit_and_releases_as_the_engine_will_play_them() -> None:
    plant = load_plant(MODEL, SPACE.joints, Setup.STAND, electrical=True)
    made = protocol("releases", 6.0)
    seen = forecast(plant, made, SPACE, made.commands(SPACE, 100.0), made.limp(SPACE, 100.0), 100.0, "run")
    torque = seen.run.signal("torque", SPACE.joints)
    assert (torque == 0).any()
    cmd, pos = seen.run.signal("cmd", SPACE.joints), seen.run.signal("pos", SPACE.joints)
    first = int(np.flatnonzero(torque[:, 0] == 0)[-1]) + 1
    assert np.abs(cmd[first] - pos[first]).max() < ENCODER_RAD
    assert seen.clearance_m > 0.02
    assert seen.lean_rad == 0
    steps = protocol("saturating-steps", 6.0)
    hard = forecast(plant, steps, SPACE, steps.commands(SPACE, 100.0), steps.limp(SPACE, 100.0), 100.0, "run")
    assert max(peak.saturated for peak in hard.peaks) > 0.03
    assert all(peak.speed_rad_s < 1.2 * peak.no_load_rad_s for peak in hard.peaks)


def test_no_corner_of_the_space_lets_legs_touch() -> None:
    plant = load_plant(MODEL, SPACE.joints, Setup.STAND)
    data = mujoco.MjData(plant.model)
    # Two neighbouring legs say it for all; a knee without torque may hang at its stop.
    names = ("hip_fl", "knee_fl", "hip_fr", "knee_fr")
    columns = [SPACE.joints.index(name) for name in names]
    ends = [
        (SPACE.low[k] if name.startswith("hip") else -1.22, SPACE.high[k])
        for k, name in zip(columns, names, strict=True)
    ]
    for corner in itertools.product(*(np.linspace(low, high, 4) for low, high in ends)):
        pose = SPACE.home.copy()
        pose[columns] = corner
        data.qpos[plant.qpos] = pose
        mujoco.mj_kinematics(plant.model, data)
        mujoco.mj_collision(plant.model, data)
        assert data.ncon == 0


def test_a_robot_that_would_touch_itself_or_fall_is_not_to_be_moved(tmp_path: Path) -> None:
    fat = tmp_path / "fat.xml"
    fat.write_text(nominal_mjcf("standard").replace('type="capsule" size="0.024"', 'type="capsule" size="0.06"'))
    arguments = ["--model", str(fat), "--protocol", "chirp", "--seconds", "5", "--kinds", "damping"]
    result = CliRunner().invoke(plan, arguments, standalone_mode=False)
    assert result.return_value == 1, result.output
    assert "do not play it: on the stand" in result.output
    assert "touch each other" in result.output


def test_on_the_floor_it_stands_and_floor_friction_shows() -> None:
    asked = replace(ASKED, kinds=("floor_friction",))
    made = make_plan(asked, [protocol("scrub", 5.0)])
    assert made.objections == []
    assert made.forecasts[0].lean_rad < 0.2
    assert made.forecasts[0].travel_m < 0.03
    assert made.expectations[0].information > 0.5


def test_chosen_motions_say_more_than_the_protocol_in_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(design_module, "CANDIDATES", 8)
    asked = replace(ASKED, kinds=("stiffness", "damping", "coulomb_friction"), tie="all")
    found = design(asked, 15.0)
    assert found == design(asked, 15.0)
    assert len(found.protocol.segments) == 3
    assert found.protocol.seconds <= 15.0
    kinds = {type(getattr(segment, "of", segment)).__name__ for segment in found.protocol.segments}
    assert len(kinds) == 3
    assert make_plan(asked, [found.protocol]).nats > make_plan(asked, [protocol("stand", 15.0)]).nats
    with pytest.raises(BadInput, match="6 s hold no two motions → give it 11 s or more"):
        design(asked, 6.0)


def test_the_command_writes_plan_json_and_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(design_module, "CANDIDATES", 4)
    out, figures = tmp_path / "best.toml", tmp_path / "plan.json"
    result = CliRunner().invoke(
        plan,
        [
            "--protocol", "stand", "--seconds", "12", "--tie", "all", "--optimise", "--out", str(out),
            "--json", str(figures), "--report", str(tmp_path / "report"),
        ],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    content = json.loads(figures.read_text())
    assert content["schema"] == "openant.plan-forecast/1"
    assert content["parameters"]["damping.all"]["verdict"] == "identified"
    assert content["objections"] == []
    assert set(content["recordings"][0]["peaks"]) == set(SPACE.joints)
    assert read_plan(out)[0].setup == "stand"
    page = (tmp_path / "report" / "report.html").read_text()
    assert "What will be known" in page
    assert re.search(r"It (settles everything|does not settle \w+)", page), "kind by kind, not joint by joint"
    assert "of 4 motions" in result.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--kinds", "stifness"], "no such parameter: stifness"),
        (["--model", "none.xml"], "no such model file"),
        (["--protocol", "chrip"], "there is no protocol 'chrip'"),
        (["--rate", "nan"], "--rate is nan → give it a number"),
        (["--noise", "nan"], "--noise is nan → give it a number"),
        (["--seconds", "inf"], "--seconds is inf → give it a number"),
        (["--protocol", "chirp", "--seconds", "9999"], "9999 s is too long for chirp"),
        (["--plan", "none.toml"], "No such file or directory"),
        (["--plan", "p.toml", "--protocol", "chirp"], "a plan says what to play"),
        (["--protocol", "gait", "--optimise", "--kinds", "damping"], "there is nothing on the stand to optimise"),
    ],
)
def test_what_cannot_be_planned_is_refused(arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(plan, arguments)
    assert isinstance(result.exception, BadInput)
    assert words in str(result.exception)


def test_a_model_without_free_joint_or_without_the_joints_is_refused(tmp_path: Path) -> None:
    fixed = tmp_path / "fixed.xml"
    fixed.write_text(
        nominal_mjcf("standard")
        .replace('<freejoint name="root"/>', "")
        .replace("<keyframe>", "<keyframe><!--")
        .replace("</keyframe>", "--></keyframe>")
    )
    with pytest.raises(BadInput, match="the model has no free joint: it cannot stand on the floor"):
        make_plan(replace(ASKED, model=fixed), [protocol("gait", 5.0)])
    with pytest.raises(BadInput, match="has no position-controlled joint 'shoulder'"):
        make_plan(Planned(MODEL, replace(SPACE, joints=("shoulder",))), [protocol("chirp", 5.0)])
