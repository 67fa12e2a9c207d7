"""Identification against robots whose values are known, simulated otherwise than the fit simulates; and on real servos."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import plain
import plants
import pytest
from places import SHARED

from openant_tools.errors import BadInput
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run, write_table
from openant_tools.robot.joints import JOINT_NAMES, JOINTS
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT_COUNTS
from openant_tools.robot.kit import kit as kit_by_name
from openant_tools.robot.mjcf import nominal_mjcf
from openant_tools.sysid.choice import helps, lacking
from openant_tools.sysid.data_sheet import data_sheet_model
from openant_tools.sysid.estimate import Posterior
from openant_tools.sysid.identify import Identification, Value, calibrated, identify
from openant_tools.sysid.protocols import CommandSpace, protocol
from openant_tools.sysid.result import write_fit
from openant_tools.sysid.weights import autocorrelation_time

REAL = SHARED / "realdata" / "bam-xl330"

NOISE = 3e-4
#: what no model can beat: an encoder of 4096 steps a turn, and the noise before it
FLOOR = math.hypot(plants.ENCODER_RAD / math.sqrt(12), NOISE)
#: the fit's step; the robots below are stepped sixteen times as finely, by another integrator
MODEL = plants.pendulum(option=plants.COARSE)
GIVEN = {"stiffness": 8.0, "damping": 0.12, "armature": 0.006, "coulomb_friction": 0.03, "zero_offset": 0.0}


@dataclass(frozen=True)
class Robot:
    """A pendulum on a servo, with values of its own."""

    stiffness: float = 8.0
    damping: float = 0.12
    armature: float = 0.006
    coulomb_friction: float = 0.03
    zero_offset: float = 0.0
    delay_s: float = 0.0
    electrical: bool = False
    #: how much more friction there is at rest than in motion, which no model here knows
    stribeck: float = 0.0

    @property
    def values(self) -> Mapping[str, float]:
        return {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "armature": self.armature,
            "coulomb_friction": self.coulomb_friction,
            "zero_offset": self.zero_offset,
            "action_delay": self.delay_s,
        }

    def record(
        self, name: str, seconds: float = 4.0, seed: int = 0, *, falls: bool = False, time: int = 1, **facts: Any
    ) -> Run:
        """What its bus logs: jittering stamps, a coarse and noisy encoder; `seed` decides what is commanded.

        Args:
            falls: torque is off for a fifth of it. Its stamps are even then: a rollout switches torque between two steps.
            time: which time it is that these commands are played; the noise is another each time.
        """
        model = mujoco.MjModel.from_xml_string(MODEL)
        model.opt.timestep, model.opt.integrator = 0.000125, mujoco.mjtIntegrator.mjINT_IMPLICIT
        model.geom_contype[0] = model.geom_conaffinity[0] = 0  # the bench
        model.actuator_gainprm[0, 0], model.actuator_biasprm[0, 1] = self.stiffness, -self.stiffness
        model.dof_damping[0], model.dof_armature[0] = self.damping, self.armature
        model.dof_frictionloss[0], model.qpos0[0] = self.coulomb_friction, self.zero_offset
        mujoco.mj_setConst(model, mujoco.MjData(model))
        t = plants.jittering(seconds, 100.0, 0.0 if falls else 0.001, seed=seed)
        command = plants.sweep(t, 1, reach=0.5 + 0.05 * (seed % 4), high_hz=2.0 + 0.2 * (seed % 3))
        off = falls & (t > t[0] + 0.7 * seconds) & (t < t[0] + 0.9 * seconds)
        if falls:
            command[(t > t[0] + 0.55 * seconds) & (t < t[0] + 0.9 * seconds)] = 1.3
        # A command acts `delay_s` after its row: as if there were a row of its own then.
        rows = np.unique(np.concatenate([t, t + self.delay_s]))
        rows = rows[rows <= t[-1]]
        acting = np.maximum(np.searchsorted(t + self.delay_s, rows + 1e-9, side="right") - 1, 0)
        limp = off[np.maximum(np.searchsorted(t, rows + 1e-9, side="right") - 1, 0)]
        data = mujoco.MjData(model)
        data.qpos[0] = command[0, 0]
        position = np.empty(len(rows))
        for k in range(len(rows)):
            position[k] = data.qpos[0]
            data.ctrl[0] = command[acting[k], 0]
            model.actuator_group[0] = 30 if limp[k] else 0
            model.opt.disableactuator = 1 << 30
            model.dof_damping[0] = 0.0 if self.electrical and limp[k] else self.damping
            if self.stribeck:
                slow = math.exp(-((float(data.qvel[0]) / 0.4) ** 2))
                model.dof_frictionloss[0] = self.coulomb_friction * (1 + self.stribeck * slow)
            if k + 1 < len(rows):
                steps = math.ceil((rows[k + 1] - rows[k]) / 0.000125)
                model.opt.timestep = (rows[k + 1] - rows[k]) / steps
                mujoco.mj_step(model, data, steps)
        measured = position[np.searchsorted(rows, t)]
        measured = measured + NOISE * np.random.default_rng([seed, time]).standard_normal(len(t))
        columns = {
            "cmd.joint": command[:, 0],
            "pos.joint": np.round(measured / plants.ENCODER_RAD) * plants.ENCODER_RAD,
        }
        if falls:
            columns["torque.joint"] = (~off).astype(float)
        return plants.run_of(columns, t, ["joint"], name, **facts)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return plants.write(tmp_path_factory.mktemp("model") / "pendulum.xml", MODEL)


def value(result: Identification, name: str) -> Value:
    return next(value for value in result.values if value.name == name)


def holds(result: Identification, truth: Mapping[str, float]) -> None:
    """Every value that is reported as identified has the truth in its interval, and the interval says something."""
    for found in result.values:
        kind = found.name.partition(".")[0]
        if kind in truth and found.accepted:
            assert found.low - 1e-12 <= truth[kind] <= found.high + 1e-12, (found, truth[kind])
            assert found.low <= found.value <= found.high


# --- what is known is recovered ----------------------------------------------------------------------------------------


def test_a_pendulum_gives_its_values_away(model: Path) -> None:
    robot = Robot(7.3, 0.145, 0.0072, 0.055, 0.012, delay_s=0.012)
    result = identify([robot.record("a")], model, [robot.record("b", seed=1)])
    holds(result, robot.values)
    assert {found.verdict for found in result.values} == {"identified"}
    assert result.after.full < 2.5 * FLOOR < 10 * FLOOR < result.before.full
    assert result.after.horizon < 4 * FLOOR
    assert value(result, "stiffness.joint").value == pytest.approx(7.3, rel=0.03)
    assert value(result, "coulomb_friction.joint").value == pytest.approx(0.055, abs=0.004)
    assert result.judged_on == ("b",)
    assert not result.in_turn


def test_a_robot_far_from_its_data_sheet_is_found_all_the_same(model: Path) -> None:
    """Each value two prior deviations off: the misfit must not talk the fit into distrusting the data."""
    robot = Robot(6.9, 0.095, 0.0045, 0.03, -0.022)
    result = identify([robot.record("a", 5.0)], model, [robot.record("b", seed=1)])
    holds(result, robot.values)
    assert result.after.full < 2.5 * FLOOR
    assert result.correlation_s["joint"] < 0.05


@pytest.mark.parametrize(
    ("robot", "contradicted"),
    [
        (Robot(zero_offset=0.2), {"zero_offset.joint"}),
        (Robot(zero_offset=-0.2, delay_s=0.01), {"zero_offset.joint"}),
        (Robot(stiffness=4.8), {"stiffness.joint"}),
        (Robot(stiffness=11.2, zero_offset=0.1), {"stiffness.joint", "zero_offset.joint"}),
    ],
)
def test_data_that_contradict_the_given_model_win_and_it_is_said(
    model: Path, robot: Robot, contradicted: set[str]
) -> None:
    """A horn that sits almost a tooth off, a gain that somebody has changed: far beyond any tolerance, and plain to see."""
    result = identify([robot.record("a")], model, [robot.record("b", seed=1)])
    holds(result, robot.values)
    assert {found.name for found in result.values if found.verdict == "conflict"} == contradicted
    for name in contradicted:
        found = value(result, name)
        assert not found.prior_low <= robot.values[name.partition(".")[0]] <= found.prior_high
        assert "the prior says" in found.words
    assert value(result, "zero_offset.joint").value == pytest.approx(robot.zero_offset, abs=0.005)
    assert result.after.full < 4 * FLOOR < result.before.full


def test_a_zero_that_is_off_by_a_sixth_of_a_turn_is_found(model: Path) -> None:
    robot = Robot(zero_offset=1.0)
    result = identify([robot.record("a")], model, [robot.record("b", seed=1)])
    holds(result, robot.values)
    zero = value(result, "zero_offset.joint")
    assert zero.verdict == "conflict"
    assert zero.value == pytest.approx(1.0, abs=0.02), "gravity tells it half as well there as where a leg hangs"
    assert result.after.full < 4 * FLOOR < result.before.full


def test_runs_of_two_gains_are_one_servo(tmp_path: Path) -> None:
    """Its registers set the stiffness, each file's own; friction, inertia and zero are the servo's, and told by both."""
    files = {kp: plants.write(tmp_path / f"p{kp:g}.xml", MODEL.replace('kp="8"', f'kp="{kp:g}"')) for kp in (8.0, 4.0)}
    robots = {8.0: Robot(7.3, coulomb_friction=0.05, zero_offset=0.01)}
    robots[4.0] = replace(robots[8.0], stiffness=4.4)
    runs = [
        robots[kp].record(f"{name}-{kp:g}", 3.0, seed, model=str(path)) for kp, path in files.items()
        for seed, name in enumerate(("a", "b"))
    ]  # fmt: skip
    result = identify(runs[::2], files[8.0], runs[1::2])
    found = {one.name: one for one in result.values}
    assert found["stiffness.joint.p8"].low <= 7.3 <= found["stiffness.joint.p8"].high
    assert found["stiffness.joint.p4"].low <= 4.4 <= found["stiffness.joint.p4"].high
    assert "coulomb_friction.joint" in found
    assert "stiffness.joint" not in found
    holds(result, {kind: value for kind, value in robots[8.0].values.items() if kind != "stiffness"})
    out = tmp_path / "fit"
    write_fit(result, out)
    assert not (out / "calibrated.xml").exists()
    figures = json.loads((out / "fit.json").read_text())
    assert [entry["written"] for entry in figures["models"]] == ["calibrated-p8.xml", "calibrated-p4.xml"]
    for kp, name, stiffness in ((8.0, "calibrated-p8.xml", 7.3), (4.0, "calibrated-p4.xml", 4.4)):
        plant = load_plant(out / name)
        assert -plant.model.actuator_biasprm[0, 1] == pytest.approx(stiffness, rel=0.03)
        measured = next(run for run in runs[1::2] if run.name == f"b-{kp:g}")
        left = Rollouts(plant, [measured])().pos[0] - measured.signal("pos", plant.joints)
        assert math.sqrt(np.nanmean(left**2)) < 6 * FLOOR
    # Left out in turn, a gain's only run is judged by the friction that the other gain's shows.
    assert "coulomb_friction.joint" in identify(runs[::2], files[8.0]).accepted
    # What an earlier fit wrote here would pass for a part of the next one.
    write_fit(identify([runs[0]], files[8.0], [runs[1]], kinds=["stiffness"]), out)
    assert sorted(path.name for path in out.glob("*.xml")) == ["calibrated.xml"]


def test_one_file_is_one_model_and_two_of_one_name_are_two(tmp_path: Path) -> None:
    """A folder of recordings for each day, and a folder for each gain."""
    for gain in (8, 4):
        (tmp_path / f"gain{gain}").mkdir()
        plants.write(tmp_path / f"gain{gain}" / "arm.xml", MODEL.replace('kp="8"', f'kp="{gain}"'))
    runs = []
    for seed, (day, gain) in enumerate((("monday", 8), ("friday", 8), ("friday", 4), ("sunday", 8))):
        (tmp_path / day).mkdir(exist_ok=True)
        robot = Robot(0.9 * gain, coulomb_friction=0.05)
        run = robot.record(f"{day} {gain}", 2.0, seed, model=f"../gain{gain}/arm.xml")
        runs.append(replace(run, path=tmp_path / day / f"{gain}.parquet"))
    kinds = ["stiffness", "coulomb_friction"]
    given = tmp_path / "gain8" / "arm.xml"
    same = identify(runs[:2], given, [runs[3]], kinds=kinds)
    assert value(same, "stiffness.joint").value == pytest.approx(7.2, rel=0.02)
    result = identify([runs[0], runs[2]], given, [runs[3]], kinds=kinds)
    assert result.after.full < 0.2 * result.before.full
    assert value(result, "stiffness.joint.gain8-arm").value == pytest.approx(7.2, rel=0.02)
    assert value(result, "stiffness.joint.gain4-arm").value == pytest.approx(3.6, rel=0.02)
    write_fit(result, tmp_path / "fit")
    written = {path.name for path in (tmp_path / "fit").glob("*.xml")}
    assert written == {"calibrated-gain8-arm.xml", "calibrated-gain4-arm.xml"}


@pytest.fixture(scope="module")
def ant(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, dict[str, float]], Identification]:
    """The nominal Ant's file (with a coarser step), an Ant's true values by kind and joint, and what is found of them."""
    text = nominal_mjcf().replace('timestep="0.001"', 'timestep="0.002"')
    path = plants.write(tmp_path_factory.mktemp("ant") / "ant.xml", text)
    model = plain.on_stand(path)
    model.opt.timestep, model.opt.integrator = 0.0005, mujoco.mjtIntegrator.mjINT_IMPLICIT
    chance = np.random.default_rng(7)
    truth: dict[str, dict[str, float]] = {kind: {} for kind in GIVEN}
    for k, joint in enumerate(JOINT_NAMES):
        dof, adr = model.joint(joint).dofadr[0], model.joint(joint).qposadr[0]
        scale = math.exp(0.075 * chance.standard_normal())
        model.actuator_gainprm[k, 0] *= scale
        model.actuator_biasprm[k, 1] *= scale
        model.dof_damping[dof] *= math.exp(0.125 * chance.standard_normal())
        model.dof_armature[dof] *= math.exp(0.15 * chance.standard_normal())
        model.dof_frictionloss[dof] = 0.02 + 0.05 * chance.random()
        model.qpos0[adr] = 0.008 * chance.standard_normal()
        truth["stiffness"][joint] = float(model.actuator_gainprm[k, 0])
        truth["damping"][joint] = float(model.dof_damping[dof])
        truth["armature"][joint] = float(model.dof_armature[dof])
        truth["coulomb_friction"][joint] = float(model.dof_frictionloss[dof])
        truth["zero_offset"][joint] = float(model.qpos0[adr])
    mujoco.mj_setConst(model, mujoco.MjData(model))

    def record(name: str, seed: int) -> Run:
        command = protocol("stand", 5.0).commands(CommandSpace.around_home(), 100.0, seed)
        t = plants.jittering(len(command) / 100.0, 100.0, 0.001, seed=seed)
        columns = plants.drive(model, JOINT_NAMES, t, command, noise=NOISE, quantum=plants.ENCODER_RAD, seed=seed)
        return plants.run_of(columns, t, JOINT_NAMES, name, setup="stand")

    return path, truth, identify([record("a", 0)], path, [record("b", 1)], kinds=tuple(GIVEN))


def test_an_ant_on_its_stand_gives_its_values_away(
    ant: tuple[Path, dict[str, dict[str, float]], Identification],
) -> None:
    _, truth, result = ant
    told = [found for found in result.values if found.verdict in ("identified", "weak")]
    inside = [
        found.low <= truth[kind][joint] <= found.high
        for found in told
        for kind, _, joint in [found.name.partition(".")]
    ]
    assert len(told) >= 28, "all but the zeros, of eight joints"
    # Of some thirty intervals at 95 %, more than three outside would be a wonder.
    assert inside.count(False) <= 3
    assert result.after.full < 1.5 * FLOOR < 4 * FLOOR < result.before.full


def test_what_the_data_cannot_tell_is_named_and_left_where_it_was(
    ant: tuple[Path, dict[str, dict[str, float]], Identification],
) -> None:
    """On a level stand a hip's axis is vertical: its command and its encoder shift alike, and nothing else changes."""
    path, _, result = ant
    for joint in JOINT_NAMES:
        if joint.startswith("hip"):
            zero = value(result, f"zero_offset.{joint}")
            assert zero.verdict == "not in the data"
            assert zero.value == zero.given == 0.0
            assert not zero.accepted
            assert zero.information < 0.1
            assert zero.low is zero.high is None, "what is written is no statement of the data"
            assert zero.prior_high == -zero.prior_low == pytest.approx(math.radians(0.98), rel=0.01)
    written, given = calibrated(result), load_plant(path, setup=Setup.FLOOR).model
    hips = [written.joint(joint).qposadr[0] for joint in JOINT_NAMES if joint.startswith("hip")]
    assert np.array_equal(written.qpos0[hips], given.qpos0[hips])


@pytest.mark.parametrize("electrical", [True, False])
def test_a_fall_without_torque_tells_whose_the_damping_is(electrical: bool, model: Path) -> None:
    robot = Robot(8.4, 0.13, coulomb_friction=0.025, electrical=electrical)
    kinds = ["stiffness", "damping", "coulomb_friction", "electrical_damping"]
    runs = [robot.record("a", 3.0, falls=True), robot.record("b", 3.0, seed=1, falls=True)]
    result = identify(runs[:1], model, runs[1:], kinds=kinds)
    share = value(result, "electrical_damping.joint")
    assert share.low <= float(electrical) <= share.high
    assert abs(share.value - float(electrical)) < 0.05
    holds(result, robot.values)
    # A falling leg is fast: here it is the model's step of 2 ms that leaves some milliradians.
    assert result.after.full < 0.3 * result.before.full
    motor = calibrated(result).actuator_biastype[0] == mujoco.mjtBias.mjBIAS_DCMOTOR
    assert motor == electrical or share.value > 0


def test_without_torque_off_nothing_is_said_about_back_emf(model: Path) -> None:
    """Neither where the run that judges was without torque: it has no part in what is fitted."""
    robot = Robot(7.5)
    result = identify([robot.record("a", 2.0)], model, [robot.record("b", 2.0, seed=1, falls=True)])
    assert not [found for found in result.values if found.name.startswith("electrical")]


def test_tied_joints_share_a_value(tmp_path: Path) -> None:
    """Two arms of the same servo: one value for both, whose interval is narrower than that of the arm which tells less.

    In small steps: what a model's step leaves open, both arms share.
    """
    arm = '<joint name="{0}" axis="0 1 0" damping="0.12" armature="0.006" frictionloss="0.03"/>'
    body = f'<body pos="0 {{1}} 0">{arm}<geom size="0.03" mass="0.3" pos="0 0 -0.1"/></body>'
    text = f"""\
<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast"/>
  <worldbody>{body.format("left", 0)}{body.format("right", 1)}</worldbody>
  <actuator>
    <position name="left" joint="left" kp="8" forcerange="-2 2"/>
    <position name="right" joint="right" kp="8" forcerange="-2 2"/>
  </actuator>
</mujoco>"""
    path = plants.write(tmp_path / "two.xml", text)
    robot = plain.on_stand(path)
    robot.dof_frictionloss[:] = 0.05
    t = plants.jittering(3.0, 100.0)
    both = ["left", "right"]

    def record(name: str, seed: int) -> Run:
        command = plants.sweep(t, 2, reach=0.4 + 0.1 * seed)
        columns = plants.drive(robot, both, t, command, noise=NOISE, quantum=plants.ENCODER_RAD, seed=seed)
        return plants.run_of(columns, t, both, name, motors={"left": "XL430-W250-T", "right": "XL430-W250-T"})

    kinds = ["coulomb_friction", "stiffness"]
    runs = [record("a", 0), record("b", 1)]
    apart = identify(runs[:1], path, runs[1:], kinds=kinds)
    servo = identify(runs[:1], path, runs[1:], kinds=kinds, tie="servo")
    assert [found.name for found in servo.values] == ["stiffness.XL430-W250-T", "coulomb_friction.XL430-W250-T"]
    tied = value(servo, "coulomb_friction.XL430-W250-T")
    assert tied.joints == ("left", "right")
    assert tied.low <= 0.05 <= tied.high
    alone = [value(apart, f"coulomb_friction.{joint}") for joint in both]
    assert tied.high - tied.low < max(one.high - one.low for one in alone)
    assert np.ptp(calibrated(servo).dof_frictionloss) == 0


def test_the_data_sheet_says_what_the_nominal_ant_is_and_what_registers_change(tmp_path: Path) -> None:
    plant = load_plant(plants.write(tmp_path / "ant.xml", nominal_mjcf("lite")), list(JOINT_NAMES), Setup.STAND)
    kit = kit_by_name("lite")
    motors = {name: kit.servo(joint.kind).name for name, joint in JOINTS.items()}
    registers = {name: {"pwm_limit": PLATFORM_PWM_LIMIT_COUNTS} for name in motors}
    t = np.arange(2.0)
    columns = {f"{signal}.{name}": t for signal in ("cmd", "pos") for name in motors}

    def of(**facts: Any) -> mujoco.MjModel | None:
        return data_sheet_model(plant, [plants.run_of(columns, t, list(motors), supply_v=kit.supply_v, **facts)])

    same = of(motors=motors, registers=registers)
    assert same is not None
    for field in ("actuator_gainprm", "actuator_biasprm", "dof_damping"):
        assert getattr(same, field) == pytest.approx(getattr(plant.model, field), rel=1e-4), field
    assert same.actuator_forcerange == pytest.approx(plant.model.actuator_forcerange, rel=2e-3)  # whole counts of PWM
    # A softer P gain in one servo is half the stiffness there, and nothing elsewhere.
    soft = of(motors=motors, registers=registers | {"knee_fl": {"position_p_gain": 320.0}})
    assert soft is not None
    factory = kit.servo("knee").register("position_p_gain").default
    assert factory is not None
    j = plant.joints.index("knee_fl")
    stiff = -plant.model.actuator_biasprm[plant.actuator, 1]
    assert -soft.actuator_biasprm[plant.actuator, 1] / stiff == pytest.approx(
        [320.0 / factory if k == j else 1.0 for k in range(8)], rel=1e-4
    )
    assert of(motors=dict.fromkeys(motors, "SG90")) is None


@pytest.mark.parametrize("name", ["XL330-M288-T", "xl330-m288"])
def test_the_data_sheet_of_a_servo_that_no_open_ant_has_is_read_too(name: str, tmp_path: Path) -> None:
    """As `openant servo gains` says it: by the measured divisor, at the run's supply."""
    plant = load_plant(plants.write(tmp_path / "one.xml", MODEL))
    t = np.arange(2.0)
    facts = {"supply_v": 7.4, "registers": {"joint": {"position_p_gain": 400.0}}}
    run = plants.run_of({"cmd.joint": t, "pos.joint": t}, t, ["joint"], motors={"joint": name}, **facts)
    sheet = data_sheet_model(plant, [run])
    assert sheet is not None
    stall = 0.60 * 7.4 / 6.0
    assert sheet.actuator_gainprm[0, 0] == pytest.approx(400 / 256 / 885 * 4096 / (2 * np.pi) * stall)
    assert sheet.actuator_forcerange[0, 1] == pytest.approx(stall)


def test_each_run_is_simulated_with_the_model_that_it_names(model: Path, tmp_path: Path) -> None:
    """Two gains, two files: what is fitted is what they have in common, and each keeps its own gain."""
    soft = plants.write(tmp_path / "soft.xml", MODEL.replace('kp="8"', 'kp="4"'))
    robots = {8.0: Robot(7.4, coulomb_friction=0.05), 4.0: Robot(3.7, coulomb_friction=0.05)}
    runs = []
    for k, (gain, robot) in enumerate(robots.items()):
        for j in range(2):
            run = robot.record(f"{gain:g} {j}", 2.5, seed=2 * k + j)
            runs.append(replace(run, facts=replace(run.facts, model=str(soft if gain == 4.0 else model))))
    result = identify([runs[0], runs[2]], model, [runs[1], runs[3]], kinds=["stiffness", "coulomb_friction"])
    assert value(result, f"stiffness.joint.{model.stem}").value == pytest.approx(7.4, rel=0.02)
    assert value(result, "stiffness.joint.soft").value == pytest.approx(3.7, rel=0.02)
    assert value(result, "coulomb_friction.joint").value == pytest.approx(0.05, abs=0.003)
    assert result.after.full < 4 * FLOOR
    assert len(result.datasets) == 2


# --- what is better is measured on what was not seen -------------------------------------------------------------------


def test_a_fit_that_beats_nothing_goes_back(model: Path) -> None:
    """Fitted to one robot and judged on another that is just like the given model."""
    result = identify([Robot(6.6, 0.15).record("a", 2.0)], model, [Robot().record("b", 2.0, seed=1)])
    assert result.accepted == ()
    assert {found.verdict for found in result.values} == {"fell back"}
    assert all(found.value == found.given for found in result.values)
    assert result.after == result.before
    plant = load_plant(model, setup=Setup.FLOOR)
    written = calibrated(result)
    for field in ("actuator_gainprm", "actuator_biasprm", "dof_damping", "dof_armature", "dof_frictionloss", "qpos0"):
        assert np.array_equal(getattr(written, field), getattr(plant.model, field))
    assert value(result, "stiffness.joint").low is None, "the value is not what the data said"


def test_held_out_runs_judge_and_choose_nothing(model: Path) -> None:
    """As stiff as the given model, rubbing as the fitted one: the stiffness alone would serve it better given back. That is no
    choice of theirs: they see the outcome once, and let it stand while it is better than the given model as a whole."""
    kinds = ["stiffness", "damping", "coulomb_friction"]
    runs = [Robot(7.4, 0.15, coulomb_friction=0.06).record("a", 3.0)]
    alike = identify(runs, model, [Robot(7.4, 0.15, coulomb_friction=0.06).record("b", 3.0, seed=1)], kinds=kinds)
    stiffer = identify(runs, model, [Robot(8.0, 0.15, coulomb_friction=0.06).record("b", 3.0, seed=1)], kinds=kinds)
    assert [(one.value, one.verdict) for one in stiffer.values] == [(one.value, one.verdict) for one in alike.values]
    assert value(stiffer, "stiffness.joint").verdict == "identified"
    assert stiffer.choice.after == alike.choice.after
    assert alike.after.full < stiffer.after.full < stiffer.before.full


def test_what_one_run_promises_and_another_breaks_is_not_kept(model: Path) -> None:
    """Thick grease on one day, thin on the next. Who has one of the runs alone cannot know: a turn is judged without its run."""
    runs = [Robot(8.0, damping, 0.006, 0.04).record(f"{k}", 2.0, seed=k) for k, damping in enumerate((0.08, 0.18))]
    result = identify(runs, model, kinds=["damping", "coulomb_friction"])
    for turn in result.turns:
        assert turn.chosen.after.full < 0.3 * turn.before.full < 0.3 * turn.after.full
    assert {found.verdict for found in result.values} == {"fell back"}
    assert result.after == result.before, "it is the given model that is written"


def test_what_is_chosen_is_chosen_by_motion_and_by_gain_and_anew_without_each_turn(tmp_path: Path) -> None:
    files = {kp: plants.write(tmp_path / f"p{kp:g}.xml", MODEL.replace('kp="8"', f'kp="{kp:g}"')) for kp in (8.0, 4.0)}
    runs = [
        Robot(0.9 * kp, coulomb_friction=0.06).record(f"{motion} {kp:g}", 1.5, seed, model=str(path))
        for kp, path in files.items() for seed, motion in enumerate(("a", "b"))
    ]  # fmt: skip
    kinds = ["stiffness", "coulomb_friction"]
    result = identify(runs, files[8.0], kinds=kinds)
    assert result.folds == (("a 8",), ("b 8",), ("a 4",), ("b 4",), ("a 8", "b 8"), ("a 4", "b 4"))
    assert [turn.runs for turn in result.turns] == [("a 8",), ("b 8",), ("a 4",), ("b 4",)]
    assert result.choice.after.full < 0.2 * result.choice.before.full
    told = result.as_json()
    assert told["held_out"]["in_turn"] is told["held_out"]["nested"] is True
    assert told["chosen"]["folds"][-1] == ["a 4", "b 4"]
    # A turn is judged by what never saw it: the same as if it had not been there at all.
    blind = identify(runs[:3], files[8.0], [runs[3]], kinds=kinds)
    assert result.turns[3].after.full == pytest.approx(blind.after.full, rel=0.02)
    for one, words in (
        (result, "without each the fit was made and what is kept was chosen anew"),
        (blind, "judged it once"),
    ):
        write_fit(one, tmp_path / "fit")
        assert words in (tmp_path / "fit" / "report.html").read_text()


def test_without_held_out_runs_each_motion_is_left_out_in_turn(model: Path) -> None:
    robot = Robot(7.3, 0.14, coulomb_friction=0.05)
    a, b = robot.record("a", 2.0), robot.record("b", 2.0, seed=1)
    again = robot.record("a again", 2.0, time=2, repeat_of="a")
    result = identify([a, b, again], model, kinds=["stiffness", "damping", "coulomb_friction"])
    assert result.in_turn
    assert sorted(result.judged_on) == ["a", "a again", "b"]
    assert result.after.full < 0.3 * result.before.full
    assert result.accepted
    # Two recordings of the same commands differ by what no model can know.
    assert result.floor == pytest.approx(FLOOR, rel=0.5)


@pytest.mark.parametrize(
    ("gains", "goes"),
    [([0.7, 0.7], True), ([1.6, 0.01], False), ([1.6, -0.2], False), ([0.9, 0.7, 0.5], True), ([0.005, 0.005], False)],
    ids=["alike on both", "on one", "at the other's cost", "on all of three", "not worth it"],
)
def test_of_few_motions_each_must_agree_that_a_parameter_goes_back(gains: list[float], goes: bool) -> None:
    """By how much each left-out motion is followed better without it."""
    assert helps(gains) == goes


def test_what_a_model_lacks_stays_away_unless_the_data_tell_it_from_none() -> None:
    """Of two that only together are known the likelier one stays; what the model has stays in any case."""
    precision = np.linalg.inv(np.array([[0.25, -0.24, 0.0], [-0.24, 0.25, 0.0], [0.0, 0.0, 0.25]])) - np.eye(3)
    fit = Posterior(
        u=np.array([0.7, 0.8, 0.5]),
        covariance=np.eye(3),
        centre=np.zeros(3),
        low=np.array([0.0, 0.0, -np.inf]),
        high=np.full(3, np.inf),
        precision=precision,
        prior_precision=np.ones(3),
    )
    assert lacking(fit).tolist() == [True, False, False]
    assert lacking(replace(fit, u=np.array([0.1, 0.1, 0.5]))).tolist() == [True, True, False]


def test_a_single_run_is_cut_in_three(model: Path) -> None:
    robot = Robot(7.3, 0.14)
    result = identify([robot.record("only", 4.5)], model, kinds=["stiffness", "damping"])
    assert result.judged_on == ("only[1/3]", "only[2/3]", "only[3/3]")
    assert result.after.full < 0.5 * result.before.full
    assert "damping.joint" in result.accepted


def test_progress_runs_from_start_to_end(model: Path) -> None:
    seen: list[float] = []
    robot = Robot(7.3)
    runs = [robot.record("a", 1.5), robot.record("b", 1.5, seed=1)]
    said: list[str] = []

    def tell(done: float, what: str) -> None:
        said.append(what)
        seen.append(done)

    identify(runs, model, kinds=["stiffness"], progress=tell)
    assert said.count("choosing what is kept") >= 2
    assert seen
    assert all(a <= b + 1e-9 for a, b in itertools.pairwise(seen))
    assert 0 <= seen[0] <= seen[-1] <= 1


def test_the_result_as_json_has_what_scripts_rely_on(model: Path) -> None:
    robot = Robot(7.3, 0.14)
    result = identify([robot.record("a", 1.5)], model, [robot.record("b", 1.5, seed=1)], kinds=["stiffness", "damping"])
    told = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert set(told["parameters"]) == {"stiffness.joint", "damping.joint"}
    for parameter in told["parameters"].values():
        assert {"value", "low", "high", "verdict"} <= set(parameter)
    assert told["held_out"]["runs"] == ["b"]
    assert told["held_out"]["before"]["gap_full_rad"] == result.before.full
    assert told["held_out"]["after"]["gap_0.5_s_rad"] == result.after.horizon
    assert told["accepted"] == list(result.accepted) != []


def test_how_long_a_residual_remembers_itself() -> None:
    chance = np.random.default_rng(0)
    white = chance.standard_normal(4000)
    assert autocorrelation_time(white, 500) == pytest.approx(1.0, abs=0.15)
    slow = np.convolve(white, np.ones(20) / 20, "same")
    assert autocorrelation_time(slow, 500) == pytest.approx(20, rel=0.25)
    holed = slow.copy()
    holed[::7] = np.nan
    assert autocorrelation_time(holed, 500) == pytest.approx(17, rel=0.3)
    assert autocorrelation_time(np.full(100, 0.3), 50) > 30, "a bias is model error for ever"
    assert autocorrelation_time(np.zeros(100), 50) == 1.0
    assert autocorrelation_time(np.full(5, np.nan), 50) == 1.0


# --- bad telemetry, and models that lack something ------------------------------------------------------------------------


def spoilt(run: Run, seed: int) -> Run:
    """Fifteen positions of a run that were misread, a tenth that was not read, and a tenth more that holds the last one."""
    chance = np.random.default_rng(seed)
    pos, ok = run.column("pos.joint").copy(), np.ones(len(run.t))
    pos[chance.random(len(pos)) < 0.1] = np.nan
    stale = np.flatnonzero(chance.random(len(pos)) < 0.1)
    ok[stale], pos[stale] = 0, pos[stale - 1]
    alone = 10 + 20 * np.arange(15)
    pos[alone] = run.column("pos.joint")[alone] + chance.choice([-1, 1], 15) * chance.uniform(0.1, 3.0, 15)
    ok[alone] = 1
    return replace(run, columns={**run.columns, "pos.joint": pos, "ok.joint": ok})


def test_misread_and_unread_positions_are_left_out_and_told(model: Path) -> None:
    robot = Robot(7.3, 0.145, coulomb_friction=0.055)
    runs = [robot.record("a"), robot.record("b", seed=1)]
    result = identify([spoilt(runs[0], 5)], model, [spoilt(runs[1], 6)])
    holds(result, robot.values)
    assert value(result, "stiffness.joint").value == pytest.approx(7.3, rel=0.03)
    assert result.after.full < 3 * FLOOR, "the held-out run's errors are left out too"
    spikes, missing = result.notes[:2]
    assert "errors of telemetry and left out" in spikes
    assert int(spikes.split(": ")[1].split()[0]) >= 13, spikes
    assert "Samples are missing" in missing
    assert "openant comms diagnose" in missing


def test_the_error_of_time_stamps_is_estimated(model: Path) -> None:
    robot = Robot(7.3, 0.145, coulomb_friction=0.055)

    def late(run: Run, seed: int) -> Run:
        return replace(run, t=run.t + np.random.default_rng(seed).uniform(-0.003, 0.003, len(run.t)))

    result = identify([late(robot.record("a", 6.0), 1)], model, [late(robot.record("b", seed=1), 2)])
    holds(result, robot.values)
    assert result.stamp_error_s == pytest.approx(0.006 / math.sqrt(12), rel=0.3)
    assert any("Time stamps miss the moments of sampling by 1." in note for note in result.notes)
    assert result.as_json()["stamp_error_s"] == result.stamp_error_s
    still = identify([robot.record("a", 6.0)], model, [robot.record("b", seed=1)], kinds=["stiffness", "damping"])
    assert still.stamp_error_s < 0.5e-3


def test_intervals_widen_where_the_model_lacks_something(model: Path) -> None:
    """A robot whose friction is thrice as high at rest: no value of the model's friction is right everywhere."""
    plain_robot = Robot(7.3, 0.14, coulomb_friction=0.05)
    stribeck = replace(plain_robot, stribeck=2.0)
    kinds = ["stiffness", "damping", "armature", "coulomb_friction"]
    right, wrong = (
        identify([robot.record("a", 6.0)], model, [robot.record("b", seed=1)], kinds=kinds)
        for robot in (plain_robot, stribeck)
    )
    for name in ("stiffness.joint", "damping.joint", "armature.joint", "coulomb_friction.joint"):
        widths = [value(result, name).high - value(result, name).low for result in (right, wrong)]
        assert widths[1] > 1.5 * widths[0], name
    assert any("what is left there is model error" in note for note in wrong.notes)
    friction = value(wrong, "coulomb_friction.joint")
    assert 0.05 < friction.value < 0.15
    stiffness = value(wrong, "stiffness.joint")
    assert stiffness.low < 7.3 < stiffness.high


def test_halves_of_the_data_that_disagree_raise_an_alarm(model: Path) -> None:
    """Between two runs the robot's supply fell, and its stiffness with it."""
    before, after = Robot(7.6, 0.14), Robot(6.8, 0.14)
    kinds = ["stiffness", "damping", "coulomb_friction"]
    low = after.record("b", seed=1)
    volts = np.full(low.t.size, 10.7)
    low = replace(low, columns={**low.columns, "volt.joint": volts}, facts=replace(low.facts, supply_v=12.0))
    torn = identify([before.record("a"), low], model, [before.record("c", seed=2)], kinds=kinds)
    assert any("fell to 10.7 of 12 V in b" in note and "--measured-supply" in note for note in torn.notes)
    found = value(torn, "stiffness.joint")
    assert found.halves is not None
    assert found.halves == (pytest.approx(7.6, rel=0.03), pytest.approx(6.8, rel=0.03))
    assert found.low <= min(found.halves) < max(found.halves) <= found.high
    alarm = next(note for note in torn.notes if "contradict each other about" in note)
    assert "stiffness of joint (7." in alarm
    whole = identify([before.record("a"), before.record("b", seed=1)], model, [before.record("c", seed=2)], kinds=kinds)
    assert all(one.halves is None for one in whole.values)


def test_what_is_tied_is_named_with_the_experiment_that_unties_it(tmp_path: Path) -> None:
    """Damping in the joint and in the servo are one, as long as torque is on and below its limit."""
    text = MODEL.replace('kp="8"', 'kp="8" kv="0.1"')
    assert text != MODEL
    path = plants.write(tmp_path / "both.xml", text)
    robot = plain.on_stand(path)
    robot.dof_damping[:] = 0.15
    runs = []
    for k in range(2):
        t = plants.jittering(4.0, 100.0, seed=k)
        command = plants.sweep(t, 1, reach=0.12 + 0.02 * k)
        columns = plants.drive(robot, ["joint"], t, command, noise=NOISE, quantum=plants.ENCODER_RAD, seed=k)
        runs.append(plants.run_of(columns, t, ["joint"], f"run {k}"))
    result = identify(runs[:1], path, runs[1:], kinds=["stiffness", "velocity_gain", "damping", "coulomb_friction"])
    for one, other in (("velocity_gain", "damping"), ("damping", "velocity_gain")):
        found = value(result, f"{one}.joint")
        assert found.verdict == "tied"
        assert found.words == f"tied to {other.replace('_', ' ')} of joint"
        assert "saturating-steps" in found.record_next
        assert "drops" in found.record_next
        assert found.accepted
    assert value(result, "stiffness.joint").tied_to is None
    told = result.as_json()["parameters"]["damping.joint"]
    assert told["tied_to"] == "velocity_gain.joint"
    together = value(result, "damping.joint").value + value(result, "velocity_gain.joint").value
    assert together == pytest.approx(0.25, rel=0.03)


# --- bad input ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run() -> Run:
    return Robot().record("mine", 2.0)


def test_no_runs_are_refused(model: Path) -> None:
    with pytest.raises(BadInput, match="no runs to fit → name at least one recording"):
        identify([], model)


def test_holding_out_what_is_fitted_is_refused(run: Run, model: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="a held-out run is also fitted → hold out runs that are not among those to fit"):
        identify([run], model, [run])
    write_table(run, tmp_path / "mine.parquet")
    twice = [read_run(tmp_path / "mine.parquet") for _ in range(2)]
    with pytest.raises(BadInput, match="a held-out run is also fitted"):
        identify(twice[:1], model, twice[1:])


def test_too_short_a_run_is_refused(run: Run, model: Path) -> None:
    with pytest.raises(BadInput, match=r"mine: too short to fit: 0\.\d\d s → record at least a few seconds"):
        identify([run.between(run.t[0], run.t[0] + 0.5)], model)


def test_a_run_in_which_nothing_moves_is_refused(run: Run, model: Path) -> None:
    still = replace(run, columns={"cmd.joint": np.zeros(len(run.t)), "pos.joint": np.full(len(run.t), 0.01)})
    with pytest.raises(BadInput, match="mine: nothing moves in this run → record a protocol that moves the joints"):
        identify([still], model)


def test_a_joint_that_no_run_has_is_refused(run: Run, model: Path) -> None:
    with pytest.raises(BadInput, match="no position-controlled joint 'elbow' → "):
        identify([run], model, joints=["elbow"])
    other = replace(run, columns={"cmd.knee": run.columns["cmd.joint"], "pos.knee": run.columns["pos.joint"]})
    other = replace(other, facts=replace(run.facts, joints=("knee",)))
    with pytest.raises(
        BadInput, match=r"the model's joints \(joint\) are not those of the runs \(knee\) → give the model"
    ):
        identify([other], model)
    blind = replace(run, columns={"cmd.joint": run.columns["cmd.joint"]})
    with pytest.raises(BadInput, match=r"mine has no pos\.joint → choose joints that every run commands and measures"):
        identify([blind], model, joints=["joint"])


def test_an_unknown_parameter_gets_the_list(run: Run, model: Path) -> None:
    with pytest.raises(BadInput, match="no such parameter: stifness → choose from stiffness, velocity_gain, damping"):
        identify([run], model, kinds=["stifness"])


def test_a_model_that_does_not_load_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="MuJoCo cannot load it"):
        identify([run], plants.write(tmp_path / "broken.xml", "<mujoco"))


# --- a real servo ------------------------------------------------------------------------------------------------------

MOTIONS = ("lift_and_drop", "sin_sin", "sin_time_square")


@pytest.mark.skipif(not REAL.exists(), reason="the recordings lie beside the repository, not in it")
@pytest.mark.parametrize("held_out", MOTIONS)
def test_a_real_servo_is_never_modelled_worse_than_it_was(held_out: str, tmp_path: Path) -> None:
    """With a coarser step than the recordings' own model has, for time's sake."""
    text = (REAL / "pendulum_kp400.xml").read_text()
    model = plants.write(tmp_path / "pendulum.xml", text.replace('timestep="0.001"', 'timestep="0.004"'))
    runs = {motion: read_run(REAL / f"kp400_{motion}.parquet") for motion in MOTIONS}
    runs = {motion: replace(run, facts=replace(run.facts, model=None)) for motion, run in runs.items()}
    fitted = [run for motion, run in runs.items() if motion != held_out]
    result = identify(fitted, model, [runs[held_out]])
    assert result.after.full <= result.before.full
    assert result.after.horizon <= result.before.horizon
