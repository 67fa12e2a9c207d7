"""Improved models: what simulated robots do between steps, plain MuJoCo does from the written file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import plain
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from places import ROOT
from plants import pendulum, sweep, write

from openant_tools.cli.gap import gap
from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Cause, Scope
from openant_tools.effects.entries import values_of
from openant_tools.effects.robot import Form, Reference, Robot, Seen
from openant_tools.effects.rollout import rollout
from openant_tools.effects.stribeck_friction import BRISTLE_RAD
from openant_tools.errors import BadInput
from openant_tools.gap.apply import apply, robot_of, write_robot
from openant_tools.gap.diagnosis import Diagnosis, Found, Span, read_diagnosis
from openant_tools.gap.report import diagnosis_report
from openant_tools.gap.simulation import simulate
from openant_tools.gap.words import sentence
from openant_tools.model.mjcf import write_model
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.config import EffectEntry
from openant_tools.robot.folder import create_robot
from openant_tools.robot.pair import PLAIN, mark_of

Array = NDArray[np.float64]

ANT = ROOT / "openant_tools" / "robot" / "assets" / "ant_standard.xml"
T = np.arange(0.0, 2.5, 0.01)
#: of the motion that an effect changes, and rad beside it, by which the replay may differ: rows of the population are at
#: steps of the same length, but its friction, stops and filters are other code
SHARE, BESIDE = 0.05, 1.0e-3
#: rad, where more stands beside: MuJoCo's bristles do not damp as those of the population do
LOOSE = {"stribeck_friction": 3.5e-3}
#: the form of simulation that a written model has: MuJoCo's servos measure their own joint, and friction that falls with
#: speed stands on bristles
FORMS = {
    "backlash": Form(loop_behind=False),
    "joint_compliance": Form(loop_behind=False),
    "stribeck_friction": Form(bristle=BRISTLE_RAD),
}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "pendulum.xml", pendulum())


def commanded(plant: Plant, commands: Array, setup: str = "stand", more: Mapping[str, Array] | None = None) -> Run:
    columns = {f"cmd.{joint}": commands[:, j] for j, joint in enumerate(plant.joints)}
    columns |= {f"pos.{joint}": np.full(len(commands), commands[0, j]) for j, joint in enumerate(plant.joints)}
    t = 0.01 * np.arange(len(commands), dtype=np.float64)
    return Run("run", Facts(joints=plant.joints, setup=setup), t, {**columns, **(more or {})})


def reference(plant: Plant) -> Reference:
    n = len(plant.joints)
    return Reference.of(
        plant, floor=True, imu=True, tracker=True, seen=Seen(np.full(n, 4.0), np.full(n, -0.6), np.full(n, 0.6), 0.0)
    )


def with_cause(plant: Plant, cause: Cause, strength: float = 0.5) -> Robot:
    known = reference(plant)
    robot = Robot(len(plant.joints), known.low, known.high)
    joints = np.arange(len(plant.joints))
    cause.enter(robot, joints, cause.values(cause.starts(strength)[0], known, joints))
    return robot


def of_joints() -> list[str]:
    return [name for name, cause in catalogue().items() if cause.native and Scope.BODY not in cause.scopes]


def replayed(path: Path, run: Run, setup: Setup) -> Array:
    compiled = plain.on_stand(path) if setup is Setup.STAND else plain.on_floor(path)
    table = plain.Table({"t": run.t, **run.columns}, {})
    return plain.play(compiled, table, list(run.facts.joints or ()))


@pytest.mark.parametrize("name", of_joints())
def test_plain_mujoco_does_what_the_diagnosis_simulated(name: str, model: Path, tmp_path: Path) -> None:
    plant = load_plant(model)
    run = commanded(plant, sweep(T, 1))
    robot = with_cause(plant, catalogue()[name])
    robot.form = FORMS.get(name)
    given, simulated = simulate(
        Rollouts(plant, [run]), [Robot(1), robot], signals=["pos"]
    ).signals["pos"].astype(float)  # fmt: skip
    write_robot(model, robot, tmp_path / "improved.xml", note="a test")
    off = replayed(tmp_path / "improved.xml", run, Setup.STAND) - simulated
    effect = float(np.sqrt(np.mean((simulated - given) ** 2)))
    assert float(np.sqrt(np.mean(off**2))) < SHARE * effect + LOOSE.get(name, BESIDE)


def test_electrical_damping_goes_with_the_torque(model: Path, tmp_path: Path) -> None:
    plant = load_plant(model)
    torque = np.where((T > 0.8) & (T < 1.4), 0.0, 1.0)
    run = commanded(plant, sweep(T, 1), more={"torque.joint": torque})
    robot = with_cause(plant, catalogue()["electrical_damping"], 1.0)
    given, simulated = simulate(
        Rollouts(plant, [run]), [Robot(1), robot], signals=["pos"]
    ).signals["pos"].astype(float)  # fmt: skip
    write_robot(model, robot, tmp_path / "improved.xml", note="a test")
    off = replayed(tmp_path / "improved.xml", run, Setup.STAND) - simulated
    assert np.sqrt(np.mean((simulated - given) ** 2)) > 0.02
    assert np.sqrt(np.mean(off**2)) < 0.002


@pytest.mark.parametrize("electrical", [0.0, 1.0])
def test_gears_carry_what_back_emf_leaves(electrical: float, model: Path, tmp_path: Path) -> None:
    """Both effects at once: the file has the damping in its servo, what stands beside it the friction."""
    plant = load_plant(model)
    run = commanded(plant, sweep(T, 1))
    robot, bare = Robot(1), Robot(1)
    robot.electrical[:] = bare.electrical[:] = 0.8
    robot.law("load_friction", "coefficient")[:] = 0.4
    robot.law("load_friction", "electrical")[:] = electrical
    without, simulated = simulate(Rollouts(plant, [run]), [bare, robot], signals=["pos"]).signals["pos"].astype(float)
    write_robot(model, robot, tmp_path / "improved.xml", note="a test")
    written = load_plant(tmp_path / "improved.xml")
    (played,) = rollout(Rollouts(written, [run]), [written.model], [robot.laws]).pos
    assert np.sqrt(np.mean((simulated - without) ** 2)) > 0.01
    assert np.sqrt(np.mean((played - simulated) ** 2)) < 1e-3


@pytest.fixture(scope="module")
def walk() -> tuple[Plant, Run]:
    """The Ant on the floor, from rest, swaying."""
    plant = load_plant(ANT, None, Setup.FLOOR)
    data = mujoco.MjData(plant.model)
    home = np.array([0.0 if joint.startswith("hip") else -0.6 for joint in plant.joints])
    data.qpos[plant.qpos] = home
    data.ctrl[plant.ctrl] = home
    for _ in range(1500):
        mujoco.mj_step(plant.model, data)
    t = np.arange(0.0, 1.2, 0.01)
    sway = np.array([0.25 if joint.startswith("hip") else 0.1 for joint in plant.joints])
    commands = home + sway * np.sin(2 * np.pi * 1.2 * t)[:, None] * np.sign(np.arange(8) % 3 - 0.5)
    base = dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), data.qpos[:7], strict=True))
    more = {f"base.{axis}": np.full(len(t), value) for axis, value in base.items()}
    run = commanded(plant, commands, "floor", more)
    for j, joint in enumerate(plant.joints):
        run.columns[f"pos.{joint}"][:] = data.qpos[plant.qpos[j]]
    return plant, run


def moved_and_off(robot: Robot, walk: tuple[Plant, Run], folder: Path) -> tuple[float, float]:
    """rad: by how much a robot moves otherwise than the model, and its written file otherwise than it."""
    plant, run = walk
    given, simulated = simulate(Rollouts(plant, [run]), [Robot(8), robot], signals=["pos"]).signals["pos"].astype(float)
    write_robot(ANT, robot, folder / "improved.xml", note="a test")
    off = replayed(folder / "improved.xml", run, Setup.FLOOR) - simulated
    return float(np.sqrt(np.mean((simulated - given) ** 2))), float(np.sqrt(np.mean(off**2)))


@pytest.mark.parametrize("name", ["payload", "floor_friction", "contact_softness", "floor_tilt", "cable_drag"])
def test_body_and_floor_are_in_the_file(name: str, walk: tuple[Plant, Run], tmp_path: Path) -> None:
    effect, off = moved_and_off(with_cause(walk[0], catalogue()[name], 0.8), walk, tmp_path)
    assert effect > 2e-4
    # Feet that slip and stick part ways from rounding on.
    assert off < 0.25 * effect + 2e-4


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("impratio", 0.1),
        ("contact_damping", 1.5),
        ("contact_give", 0.6),
        ("contact_depth", 1.8),
        ("softness", 1.3),
        ("floor_friction", 0.85),
        ("torso_kg", 0.1),
        ("tilt_y", 0.02),
    ],
)
def test_what_contacts_are_like_is_in_the_file(
    kind: str, value: float, walk: tuple[Plant, Run], tmp_path: Path
) -> None:
    effect, off = moved_and_off(robot_of(walk[0], [], {kind: {"body": value}}), walk, tmp_path)
    assert effect > 3e-5
    assert off < 0.25 * effect + 2e-5


def test_feet_stick_by_what_decides_at_the_floor(walk: tuple[Plant, Run], tmp_path: Path) -> None:
    robot = with_cause(walk[0], catalogue()["foot_adhesion"])
    write_robot(ANT, robot, tmp_path / "improved.xml", note="a test")
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "improved.xml"))
    assert written.geom_adhesion[written.geom("floor").id] == pytest.approx(robot.adhesion_n)


def test_a_turned_and_late_imu(tmp_path: Path) -> None:
    robot = Robot(8)
    robot.imu_rotation[:] = 0.0, 0.2, 0.0
    robot.log_delay["imu"] = 0.015
    write_robot(ANT, robot, tmp_path / "improved.xml", note="a test")
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "improved.xml"))
    assert written.sensor("gyro").id >= 0
    assert written.sensor_delay[written.sensor("accelerometer").id] == pytest.approx(0.015)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, written.site("imu_location").quat)
    # What points up reads on the sensor's x as far as that leans.
    assert pytest.approx([-np.sin(0.2), 0, np.cos(0.2)], abs=1e-9) == turn.reshape(3, 3).T @ [0, 0, 1]


def found(effect: str, joints: tuple[str, ...] | str, **values: float) -> Found:
    spans = {name: Span(value, 0.9 * value, 1.1 * value) for name, value in values.items()}
    return Found(effect, joints, spans, 0.95, 0.8, 0.7, 0.9, catalogue()[effect].native)


def diagnosis(model: Path, *effects: Found, selected: bool = True, verdict: str | None = None) -> Diagnosis:
    return Diagnosis(
        model=str(model), runs=("a", "b"), held_out=(), verdict=verdict or effects[0].effect, confidence=0.95, effects=effects,
        selected=tuple(one.effect for one in effects) if selected else (), ambiguous_with=(), next_experiment=None,
        gap={"before": 0.02, "after": 0.004, "floor": 0.001},
        where=[{"signal": "pos", "joint": "joint", "regime": "reversal", "share": 1.0, "gap": 0.02}],
    )  # fmt: skip


def saved(diagnosed: Diagnosis, path: Path) -> Path:
    path.write_text(json.dumps(diagnosed.as_json()), encoding="utf-8")
    return path


def test_what_mujoco_cannot_carry_stands_beside_the_model(model: Path, tmp_path: Path) -> None:
    diagnosed = diagnosis(
        model, found("load_friction", ("joint",), coefficient=0.2), found("action_delay", "all", delay_s=0.02),
        found("clock_jitter", "all", std_s=0.004),
    )  # fmt: skip
    out = tmp_path / "improved.xml"
    run = CliRunner().invoke(
        gap, ["apply", str(saved(diagnosed, tmp_path / "gap.json")), "--model", str(model), "--out", str(out)]
    )
    assert run.exit_code == 0, run.output
    assert mujoco.MjModel.from_xml_path(str(out)).actuator_delay[0] == pytest.approx(0.02)
    import tomllib

    beside = tomllib.loads((tmp_path / "improved.effects.toml").read_text(encoding="utf-8"))["effect"]
    assert [(entry["effect"], entry["enabled"]) for entry in beside] == [
        ("load_friction", True),
        ("clock_jitter", True),
    ]
    # What was calibrated together goes together: a late command says nothing of the model.
    assert [entry.get("pair") for entry in beside] == [mark_of(load_plant(out).model), None]


def test_what_a_diagnosis_says_nothing_of_goes_along_with_the_robots_model(tmp_path: Path) -> None:
    robot = create_robot(tmp_path / "ant")
    nominal = robot.path / "nominal.xml"
    write_model(
        nominal, load_plant(nominal, None, Setup.FLOOR).model, robot.path / "calibrated.xml", pair="0123456789ab"
    )
    here, strange = (
        EffectEntry("load_friction", ("knee_fl",), {"coefficient": 0.2}, pair=pair)
        for pair in ("0123456789ab", "fedcba987654")
    )
    robot.update({"model": "calibrated.xml"}, effects=[here, replace(strange, joints=("knee_fr",))])
    late = diagnosis(robot.model_path(), found("action_delay", "all", delay_s=0.02))
    apply(late, robot.model_path(), robot.path / "improved.xml", robot=robot.path)
    (kept,) = robot.config().effects
    assert kept.joints == ("knee_fl",)
    assert kept.pair == mark_of(load_plant(robot.model_path()).model) != "0123456789ab"
    # Another model, of which the entry says nothing: it goes with the model that it was fitted with.
    apply(late, nominal, robot.path / "improved.xml", robot=robot.path)
    assert robot.config().effects == ()
    assert mark_of(load_plant(robot.model_path()).model) == PLAIN


def test_the_environment_takes_what_stands_beside(model: Path, tmp_path: Path) -> None:
    plant = load_plant(model)
    robot = robot_of(plant, [found("load_friction", ("joint",), coefficient=0.2)], {})
    from openant_tools.effects.entries import entries_of

    again = values_of(entries_of(robot.laws, plant.joints), plant.joints)
    assert again["load_friction", "coefficient"] == pytest.approx(robot.laws["load_friction", "coefficient"])


def test_an_older_file_of_effects_does_not_stay_beside(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "improved.xml"
    apply(diagnosis(model, found("load_friction", "all", coefficient=0.2)), model, out)
    assert out.with_name("improved.effects.toml").is_file()
    apply(diagnosis(model, found("action_delay", "all", delay_s=0.01)), model, out)
    assert not out.with_name("improved.effects.toml").exists()


def test_calibration_goes_into_the_model(model: Path, tmp_path: Path) -> None:
    plant = load_plant(model)
    robot = robot_of(
        plant, [], {"stiffness": {"joint": 1.1}, "coulomb_friction": {"joint": 0.01}, "delay": {"joint": -0.001}}
    )
    write_robot(model, robot, tmp_path / "improved.xml", note="a test")
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "improved.xml"))
    assert -written.actuator_biasprm[0, 1] == pytest.approx(8.8)
    assert written.dof_frictionloss[0] == pytest.approx(0.04)
    assert written.actuator_delay[0] == 0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_stop_stands_where_the_diagnosis_says(side: float, model: Path) -> None:
    one = dataclasses.replace(found("blocked_joint", ("joint",), angle_rad=0.1), coordinates={"inside": 0.5 * side})
    robot = robot_of(load_plant(model), [one], {})
    assert (robot.stop_high if side > 0 else robot.stop_low)[0] == pytest.approx(0.1)
    assert not np.isfinite((robot.stop_low if side > 0 else robot.stop_high)[0])


def test_every_cause_comes_back_from_what_a_diagnosis_states(model: Path) -> None:
    plant = load_plant(model)
    known, joints = reference(plant), np.array([0])
    for cause in catalogue().values():
        x = cause.starts(0.5)[0]
        values = cause.values(x, known, joints)
        again = cause.restored(cause.stated(values, known, joints), x, known, joints)
        for quantity in cause.quantities:
            assert again[quantity.name] == pytest.approx(values[quantity.name], abs=1e-9), cause.name


def test_a_foreign_model_gets_one_clear_line(model: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="'knee_fl', which the model does not have"):
        apply(diagnosis(model, found("stiffness_error", ("knee_fl",), scale=0.5)), model, tmp_path / "out.xml")
    assert not (tmp_path / "out.xml").exists()


def test_a_json_that_is_no_diagnosis(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("{}", encoding="utf-8")
    with pytest.raises(BadInput, match="is no diagnosis"):
        read_diagnosis(tmp_path / "x.json")


def test_one_page_says_it_all(model: Path, tmp_path: Path) -> None:
    plant = load_plant(model)
    runs = [commanded(plant, sweep(T, 1))]
    diagnosed = diagnosis(model, found("action_delay", "all", delay_s=0.02))
    unfitted = Found("backlash", "all", {}, 0.02, None, None, None, True)
    diagnosed = dataclasses.replace(diagnosed, effects=(*diagnosed.effects, unfitted))
    page = diagnosis_report(diagnosed, runs, [], model).html()
    assert "None" not in page  # a cause that was not fitted closes nothing that anybody knows
    for words in (
        "action_delay (all)",
        "confidence 95\u00a0%",
        "floor",
        "What to do next",
        "Where",
        "improved model",
        "starts again from what was measured",
    ):
        assert words in page
    assert sentence(dataclasses.replace(diagnosed, verdict="none", selected=())).startswith("Nothing beyond the floor")
    assert "closest is action_delay" in sentence(dataclasses.replace(diagnosed, verdict="unexplained", selected=()))
