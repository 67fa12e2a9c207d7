"""Effects between steps: that they change nothing where they are absent, act as they say, and act alike everywhere."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from click.testing import CliRunner
from plants import COARSE, ENCODER_RAD, drive, pendulum, sweep, write

from openant_tools.cli.sysid_fit import fit
from openant_tools.effects.acting import Acting
from openant_tools.effects.catalogue import acting, effect
from openant_tools.effects.entries import as_toml, entries_of, values_of
from openant_tools.effects.rollout import rollout
from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.model.servo import read_electrical, usual_torque, write_electrical
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table
from openant_tools.robot.config import EffectEntry as Entry
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.robot.pair import mark_of
from openant_tools.sysid import rules
from openant_tools.sysid.parameter import apply, choose, colours, unloaded

#: a size of each parameter that shows
SHOWING = {
    ("asymmetric_friction", "positive_nm"): 0.2,
    ("cogging", "amplitude_nm"): 0.2,
    ("dead_zone", "width_rad"): 0.1,
    ("load_friction", "coefficient"): 0.3,
    ("stribeck_friction", "static_nm"): 0.2,
    ("thermal_derating", "loss_per_c"): 0.05,
    ("viscous_nonlinear", "coefficients"): 0.05,
    ("voltage_sag", "resistance_ohm"): 2.0,
}


def recorded(plant: Plant, seconds: float = 2.0, limp: bool = False) -> Run:
    """What the plant itself does, its first joint without torque from some time on if wanted."""
    t, joints = np.arange(0.0, seconds, 0.01), plant.joints
    torque = np.ones((len(t), len(joints)))
    torque[t > 1.2, 0] = 0.0 if limp else 1.0
    columns = drive(copy.copy(plant.model), joints, t, sweep(t, len(joints), 0.4), torque=torque)
    return Run("drive", Facts(joints=joints), t, columns)


@pytest.fixture
def servo(tmp_path: Path) -> Plant:
    return load_plant(write(tmp_path / "pendulum.xml", pendulum()))


@pytest.mark.parametrize("horizon", [None, 0.5])
@pytest.mark.parametrize("kind", ["pendulum", "motor", "ant"])
def test_without_effects_every_sample_is_that_of_the_plain_rollout(
    kind: str, horizon: float | None, tmp_path: Path
) -> None:
    path = nominal_model_path("standard") if kind == "ant" else write(tmp_path / "pendulum.xml", pendulum())
    plant = load_plant(path, JOINT_NAMES if kind == "ant" else None, Setup.STAND, electrical=kind == "motor")
    rollouts = Rollouts(plant, [recorded(plant, limp=True), recorded(plant, 1.3)], horizon)
    stiffer = rollouts.lean(plant.model)
    stiffer.opt.disableflags = plant.model.opt.disableflags
    stiffer.dof_damping[plant.dof] *= 1.3
    delays = np.array([np.zeros(len(plant.joints)), np.full(len(plant.joints), 0.013)])
    plain = rollouts([plant.model, stiffer], delays)
    stepped = rollout(rollouts, [plant.model, stiffer], [{}, {}], delays)
    # Delayed commands are averaged in other portions, which moves the last digit.
    np.testing.assert_allclose(stepped.pos, plain.pos, rtol=0, atol=1e-10)
    np.testing.assert_allclose(stepped.vel, plain.vel, rtol=0, atol=1e-8)


@pytest.mark.parametrize("key", SHOWING, ids=lambda key: key[0])
def test_one_simulation_steps_as_a_batch_does(key: tuple[str, str], servo: Plant) -> None:
    """An environment behaves as the fit and the diagnosis have simulated, to the last bit."""
    run = recorded(servo, 1.0)
    rollouts = Rollouts(servo, [run])
    values = {key: np.array([SHOWING[key]])}
    batch = rollout(rollouts, [servo.model] * 2, [values, {}])
    assert np.abs(batch.pos[0] - batch.pos[1]).max() > 1e-4, "the effect does not show"

    model = rollouts.lean(servo.model)
    data = mujoco.MjData(model)
    segment = rollouts.segments[0]
    mujoco.mj_setState(model, data, segment.state, int(mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_forward(model, data)
    acting = Acting(Plant(**{**vars(servo), "model": model}), data, values)
    path = [data.qpos[0]]
    for control in segment.control:
        data.ctrl[:] = control
        acting.step(1)
        path.append(data.qpos[0])
    at = np.array(path)
    sampled = at[segment.step] * (1 - segment.fraction) + at[segment.step + 1] * segment.fraction
    np.testing.assert_array_equal(sampled, batch.pos[0, :, 0])


def held_up(servo: Plant, values: dict[tuple[str, str], float]) -> float:
    """rad by which the servo sags under its load when it comes slowly from below and stays."""
    t = np.arange(0.0, 4.0, 0.01)
    command = np.clip(t / 3.0, 0.0, 1.0)
    run = Run("step", Facts(joints=servo.joints), t, {"cmd.joint": command, "pos.joint": np.zeros_like(t)})
    found = rollout(Rollouts(servo, [run]), [servo.model], [{key: np.array([value]) for key, value in values.items()}])
    return float(1.0 - found.pos[0, -1, 0])


@pytest.mark.parametrize(
    ("quantity", "stiff", "loaded"),
    [("coefficient", 0.5, 0.5), ("motor_side", 1.0, 0.0), ("link_side", 0.0, 1.0), ("greater_side", 1.0, 0.0)],
)
def test_loaded_gears_hold_what_the_motor_does_not(servo: Plant, quantity: str, stiff: float, loaded: float) -> None:
    """At rest, coming from below: kp · sag = load + friction, of which each form takes its share from either side."""
    free = held_up(servo, {})
    rubbed = held_up(servo, {("load_friction", quantity): 0.3})
    load = 9.81 * (0.3 * 0.1 + 0.02 * 0.05) * np.sin(1.0)
    dry = float(servo.model.dof_frictionloss[0])
    most = (load * (1 + 0.3 * loaded) + dry) / (8.0 * (1 - 0.3 * stiff))
    assert free < rubbed <= 1.02 * most


@pytest.mark.parametrize(("at_rest", "moves"), [(0.0, True), (0.8, False)])
def test_loaded_gears_stick(servo: Plant, at_rest: float, moves: bool) -> None:
    """Held up at 1 rad and told to go 0.05 rad higher: 0.4 N·m of the motor, 0.26 N·m of load, 0.33 N·m between them.

    (MuJoCo's dry friction creeps where it holds, here by 0.01 rad/s.)
    """
    t = np.arange(0.0, 0.3, 0.01)
    run = Run("hold", Facts(joints=servo.joints), t, {"cmd.joint": np.full_like(t, 1.05), "pos.joint": np.ones_like(t)})
    found = rollout(Rollouts(servo, [run]), [servo.model], [{("load_friction", "at_rest"): np.array([at_rest])}])
    assert (abs(found.pos[0, -1, 0] - 1.0) > 0.01) == moves


def test_gears_do_not_carry_what_back_emf_takes(servo: Plant) -> None:
    """A servo that has to follow a ramp gives its damping's torque; if that is back-EMF, no gear feels it."""
    t = np.arange(0.0, 1.0, 0.01)
    run = Run("ramp", Facts(joints=servo.joints), t, {"cmd.joint": 2 * t - 1, "pos.joint": np.full_like(t, -1.0)})
    plain = {("load_friction", "coefficient"): np.array([0.5])}
    values = [{}, plain, {**plain, ("load_friction", "electrical"): np.array([1.0])}]
    free, geared, electrical = rollout(Rollouts(servo, [run]), [servo.model] * 3, values).pos[:, :, 0]
    behind = [float(np.mean(2 * t - 1 - path)) for path in (free, geared, electrical)]
    assert behind[0] < behind[2] < behind[1] - 0.1 * (behind[1] - behind[0])


def test_a_dead_zone_leaves_its_half_width_open(servo: Plant) -> None:
    assert held_up(servo, {("dead_zone", "width_rad"): 0.1}) - held_up(servo, {}) == pytest.approx(0.05, abs=0.01)


def test_gains_follow_the_logged_voltage(servo: Plant) -> None:
    """With the nominal supply everywhere nothing changes; with half of it the servo sags twice as far."""
    t = np.arange(0.0, 3.0, 0.01)

    def sag(volts: float) -> float:
        columns = {
            "cmd.joint": np.full_like(t, 0.8),
            "pos.joint": np.zeros_like(t),
            "volt.joint": np.full_like(t, volts),
        }
        run = Run("hold", Facts(joints=servo.joints, supply_v=12.0), t, columns)
        found = rollout(Rollouts(servo, [run]), [servo.model], [{}], measured_supply=True)
        return float(0.8 - found.pos[0, -1, 0])

    model = servo.model
    friction = float(model.dof_frictionloss[0]) / 8.0
    assert sag(6.0) + friction == pytest.approx(2 * (sag(12.0) + friction), rel=0.15)


def test_every_effect_says_what_it_is() -> None:
    assert {name for name, _ in SHOWING} == set(acting())
    for one in acting().values():
        assert one.words
        assert one.parameters
    with pytest.raises(BadInput, match="no effect is called 'load_fricton' → did you mean 'load_friction'"):
        effect("load_fricton")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (Entry("action_delay", "all", {}), "action_delay does not act as an entry: MuJoCo carries it"),
        (
            Entry("load_friction", "all", {"share": 0.1}),
            "load_friction has no parameter 'share' → it has coefficient, motor_side, link_side, greater_side",
        ),
        (Entry("load_friction", "all", {"coefficient": "much"}), "load_friction.coefficient is no number: 'much'"),
        (Entry("load_friction", "all", {"coefficient": -0.1}), "= -0.1 .* is not physical → it lies between 0 and 0.9"),
    ],
)
def test_entries_that_mean_nothing_are_named(entry: Entry, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        values_of([entry], ["a", "b"])


def test_entries_act_where_they_say() -> None:
    entries = [
        Entry("load_friction", ("b",), {"coefficient": 0.1}),
        Entry("dead_zone", "all", {"width_rad": 0.02}),
        Entry("cogging", "all", {"amplitude_nm": 1.0}, enabled=False),
    ]
    values = values_of(entries, ["a", "b"])
    assert {key: value.tolist() for key, value in values.items()} == {
        ("load_friction", "coefficient"): [0.0, 0.1],
        ("dead_zone", "width_rad"): [0.02, 0.02],
    }


def rubbing_pendulum(t: np.ndarray, command: np.ndarray, coefficient: float) -> np.ndarray:
    """Positions (n,) of the pendulum of `plants` with 0.2 ms steps and friction as a torque budget: nothing of MuJoCo."""
    inertia, weight = 0.006 + 0.3 * 0.01 + 0.4 * 0.3 * 0.04**2 + 0.02 * 0.1**2 / 3, 9.81 * (0.3 * 0.1 + 0.02 * 0.05)
    h, q, v, out = 2e-4, float(command[0]), 0.0, []
    for k in range(len(t)):
        out.append(q)
        for _ in range(round(0.01 / h)):
            motor = float(np.clip(8.0 * (command[k] - q), -1.5, 1.5))
            load = weight * np.sin(q)
            budget = 0.03 + coefficient * (abs(motor) + abs(load)) / 2
            free = motor - load - 0.12 * v
            stop = -(inertia * v / h + free)  # what would bring it to rest within this step
            v += h * (free + float(np.clip(stop, -budget, budget))) / inertia
            q += h * v
    return np.array(out)


def test_load_friction_of_another_simulation_is_found_unasked_and_written_beside_the_plain_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: list[str] = []
    findings = rules.findings
    monkeypatch.setattr(rules, "findings", lambda run, *rest: (judged.append(run.name), findings(run, *rest))[1])
    path = write(tmp_path / "pendulum.xml", pendulum(option=COARSE))
    t = np.arange(0.0, 4.0, 0.01)
    tables = []
    for k in range(3):
        command = sweep(t, 1 + k, 0.9)[:, -1:]
        position = rubbing_pendulum(t, command[:, 0], 0.25)
        position = np.round(position / ENCODER_RAD) * ENCODER_RAD
        run = Run(f"run{k}", Facts(joints=("joint",)), t, {"cmd.joint": command[:, 0], "pos.joint": position})
        tables.append(tmp_path / f"run{k}.parquet")
        write_table(run, tables[-1])
    out = tmp_path / "fit"
    asked = [*tables[:2], "--hold-out", tables[2], "--model", path, "--out", out]
    shown = tmp_path / "shown"
    ran = CliRunner().invoke(fit, [str(word) for word in (*asked, "--report", shown)], standalone_mode=False)
    assert ran.exception is None
    assert judged == ["run0", "run1", "run2"]  # by the rules, once for both fits
    for folder in (shown, shown / "with-effects"):
        pictures = re.findall(r"\]\((figures/.*?)\)", (folder / "report.md").read_text())
        assert len(pictures) == 3
        assert all((folder / name).stat().st_size for name in pictures)
    assert "More is explained by what plain MuJoCo has no feature for, load friction of joint 0.2" in ran.output

    plain, richer = (json.loads((folder / "fit.json").read_text()) for folder in (out, out / "with-effects"))
    assert richer["held_out"]["after"]["gap_full_rad"] < 0.6 * plain["held_out"]["after"]["gap_full_rad"]
    assert "load_friction.joint" in richer["accepted"]
    assert not any(name.startswith("load_friction") for name in plain["parameters"])
    # Torque was never off: that a motor's damping goes with it the plain model has from the other one.
    assert plain["parameters"]["electrical_damping.joint"]["verdict"] == "not in the data"
    value = richer["parameters"]["load_friction.joint"]["value"]
    # Another law of friction at rest: near, if not within an interval that knows this one only.
    assert value == pytest.approx(0.25, abs=0.06)
    assert (out / "calibrated.xml").exists()
    assert not (out / "calibrated.effects.toml").exists()
    entries = tomllib.loads((out / "with-effects" / "calibrated.effects.toml").read_text())["effect"]
    assert entries == [
        {"effect": "load_friction", "joints": ["joint"], "enabled": True,
         "pair": mark_of(load_plant(out / "with-effects" / "calibrated.xml").model),
         "parameters": {"coefficient": pytest.approx(value, rel=1e-5)}}
    ]  # fmt: skip
    both = r"plain \d+(\.\d+)?\smrad, with effects \d+(\.\d+)?\smrad"
    assert len(re.findall(both, ran.output)) == 2  # over full runs, and at 0.5 s
    assert any(re.search(both, note) for note in plain["notes"])
    assert re.search(both, (out / "report.html").read_text())
    # Said not to want them, nothing of theirs is left.
    ran = CliRunner().invoke(fit, [*(str(word) for word in asked), "--no-effects", "--kind", "stiffness"],
                             standalone_mode=False)  # fmt: skip
    assert ran.exception is None
    assert sorted(file.name for file in out.iterdir()) == ["calibrated.xml", "fit.json", "report.html"]


def test_beside_load_friction_a_gear_rubs_a_little_unloaded_unless_the_model_says_how_much(tmp_path: Path) -> None:
    """Motions with torque on hardly tell; without any friction of its own a hanging joint would swing for ever."""
    for rubs, share in ((0.0, 0.03), (0.05, None)):
        plant = load_plant(write(tmp_path / f"{rubs}.xml", pendulum(joint=f'damping="0.12" frictionloss="{rubs}"')))
        (given,) = choose(plant, ["coulomb_friction"])
        beside, limit = unloaded(given, plant), usual_torque(plant.model, plant, 0)
        if share is None:
            assert beside == given
        else:
            assert beside.value(rubs, beside.centre) == pytest.approx(share * limit)
            assert beside.value(rubs, 0.0) == 0.0, "what falls back goes to the given model"


def test_beside_load_friction_not_all_of_the_damping_goes_with_the_torque(tmp_path: Path) -> None:
    """Grease brakes, too; and a model that was fitted so before is not sent beyond all of it when it is fitted again."""
    plant = load_plant(write(tmp_path / "m.xml", pendulum(joint='damping="0.12"')), electrical=True)
    for share in (None, 0.6):
        if share is not None:
            write_electrical(plant.model, plant, 0, share)
        (alone,) = choose(plant, ["electrical_damping"])
        given = read_electrical(plant.model, plant, 0)
        assert alone.value(given, alone.centre) == pytest.approx(1.0)
        beside = unloaded(alone, plant)
        assert beside.value(given, beside.centre) == pytest.approx(0.92)


def test_a_gear_that_rubs_under_load_holds_and_the_given_model_stays_as_it_is(tmp_path: Path) -> None:
    """MuJoCo's dry friction creeps by default; real gears do not, so that load friction found with it would be another's."""
    plant = load_plant(write(tmp_path / "m.xml", pendulum(joint='damping="0.12"')))
    for kinds, holds in ((["coulomb_friction"], False), (["coulomb_friction", "load_friction"], True)):
        parameters = choose(plant, kinds)
        given, moved = (apply(plant, parameters, u) for u in np.array([np.zeros(len(kinds)), np.ones(len(kinds))]))
        assert (given.dof_solimp == plant.model.dof_solimp).all()
        assert (moved.dof_solimp != given.dof_solimp).any() == holds


def test_entries_and_values_say_the_same() -> None:
    joints = ["a", "b", "c"]
    values = {
        ("dead_zone", "width_rad"): np.array([0.02, 0.0, 0.02]),
        ("load_friction", "coefficient"): np.full(3, 0.1),
    }
    entries = entries_of(values, joints)
    assert [(entry.effect, entry.joints) for entry in entries] == [
        ("dead_zone", ("a", "c")),
        ("load_friction", ("a", "b", "c")),
    ]
    again = values_of(entries, joints)
    assert {key: value.tolist() for key, value in again.items()} == {k: v.tolist() for k, v in values.items()}
    assert "dead_zone" in as_toml(entries)


def test_what_all_joints_share_is_one_value_that_moves_all_of_them() -> None:
    """A sagging supply couples legs that a stand keeps apart: no rollout may serve two parameters then."""
    plant = load_plant(nominal_model_path("standard"), JOINT_NAMES, Setup.STAND)
    apart = choose(plant, ["stiffness"])
    assert len(colours(plant, apart, coupled=False)) == 2
    shared = choose(plant, ["stiffness", "voltage_sag"])
    assert [parameter.name for parameter in shared if parameter.kind == "voltage_sag"] == ["voltage_sag.body"]
    for members, masks in colours(plant, shared, coupled=False):
        assert len(members) == 1
        assert masks[0].all()


def test_a_fit_goes_around_the_effects_that_a_robot_has(tmp_path: Path) -> None:
    """What robot.toml says acts in every simulation of the fit, so that nothing else is bent to stand for it."""
    path, t = write(tmp_path / "pendulum.xml", pendulum(option=COARSE)), np.arange(0.0, 2.5, 0.01)
    plant = load_plant(path)
    stiffer = copy.copy(plant.model)
    stiffer.actuator_gainprm[:, 0], stiffer.actuator_biasprm[:, 1] = 8.8, -8.8
    tables = []
    for k in range(2):
        command = sweep(t, 1 + k)[:, -1]
        run = Run(f"run{k}", Facts(joints=("joint",)), t, {"cmd.joint": command, "pos.joint": np.zeros_like(t)})
        made = rollout(Rollouts(plant, [run]), [stiffer], [{("dead_zone", "width_rad"): np.array([0.08])}])
        position = np.round(made.pos[0, :, 0] / ENCODER_RAD) * ENCODER_RAD
        tables.append(str(tmp_path / f"run{k}.parquet"))
        write_table(replace(run, columns={"cmd.joint": command, "pos.joint": position}), Path(tables[-1]))
    robot = create_robot(tmp_path / "ant")
    entries = [
        Entry("dead_zone", "all", {"width_rad": 0.08}),
        Entry("load_friction", ("knee_fl",), {"coefficient": 0.1}),
        Entry("cogging", "all", {"amplitude_nm": 0.3}, enabled=False),
    ]
    robot.update(effects=entries)
    arguments = [tables[0], "--hold-out", tables[1], "--model", str(path), "--out", str(tmp_path / "fit")]
    ran = CliRunner().invoke(fit, [*arguments, "--kind", "stiffness", "--also", "load_friction", "--robot", str(robot.path)],
                             standalone_mode=False)  # fmt: skip
    assert ran.exception is None
    assert "What robot.toml says of dead_zone acted in every simulation" in ran.output
    found = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert found["parameters"]["stiffness.joint"]["value"] == pytest.approx(8.8, rel=0.01)
    assert found["acting"] == [{"effect": "dead_zone", "joints": ["joint"], "parameters": {"width_rad": 0.08}}]
    # What was not fitted stays as it was, and of an effect that was fitted the joints that were not.
    assert [entry for entry in robot.config().effects if entry.joints != ("joint",)] == entries
