"""Whoever doubts our numbers can check them: a run table, a written model, plain MuJoCo, and nothing of ours.

What is checked is formats, sections 1 and 5. The plain player (`plain.py`) gives a command to the step that begins
nearest to its time, where a rollout averages commands over each step, so that positions may differ by what a joint moves
in one step. Commands that leave on the beat of the steps leave nothing to average, and no such excuse: then positions must
be the same, and the gaps of fit.json with them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import plain
import plants
import pytest

from openant_tools.model.mjcf import write_model
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run, write_table
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import home_angles
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.identify import identify
from openant_tools.sysid.parameter import apply, choose
from openant_tools.sysid.result import write_fit

#: a command may come up to half a step early or late
STEPS_ALLOWED = 1

SERVO = plants.SERVO
BAR = 'forcerange="-1.5 1.5"'

#: what a builder's file may look like
PENDULUMS: dict[str, str] = {
    "position": plants.pendulum(),
    "kv in the servo": plants.pendulum(f'<position {SERVO} kp="8" kv="0.2" {BAR}/>', joint='armature="0.006"'),
    "dampratio": plants.pendulum(f'<position {SERVO} kp="8" dampratio="0.8" {BAR}/>', joint='armature="0.006"'),
    "timeconst": plants.pendulum(f'<position {SERVO} kp="8" timeconst="0.06" {BAR}/>'),
    "delay, held": plants.pendulum(f'<position {SERVO} kp="8" delay="0.03" nsample="40" interp="zoh" {BAR}/>'),
    "delay, linear": plants.pendulum(f'<position {SERVO} kp="8" delay="0.0305" nsample="40" interp="linear" {BAR}/>'),
    "delay and timeconst": plants.pendulum(
        f'<position {SERVO} kp="8" timeconst="0.04" delay="0.024" nsample="40" interp="linear" {BAR}/>'
    ),
    "pid": plants.pendulum(f'<pid {SERVO} kp="8" kv="0.1" slewmax="4" {BAR}/>'),
    "pid with an integral": plants.pendulum(f'<pid {SERVO} kp="8" ki="3" imax="0.2" slewmax="6" input="pos" {BAR}/>'),
    "general": plants.pendulum(f'<general {SERVO} gainprm="8" biastype="affine" biasprm="0 -8 -0.05" {BAR}/>'),
    "general with a filter": plants.pendulum(
        f'<general {SERVO} dyntype="filter" dynprm="0.05" gainprm="8" biastype="affine" biasprm="0 -8 -0.05" {BAR}/>'
    ),
    "degrees": plants.pendulum(
        joint='damping="0.12" armature="0.006" frictionloss="0.03" range="-80 80" ref="10"', compiler=""
    ),
    "RK4": plants.pendulum(option='timestep="0.002" integrator="RK4"'),
    "a name of its own": plants.pendulum(f'<position name="servo 7" joint="joint" kp="8" {BAR}/>'),
    "default classes": """\
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <default>
    <default class="servo">
      <joint damping="0.12" armature="0.006" frictionloss="0.03" axis="0 1 0"/>
      <position kp="8" forcerange="-1.5 1.5"/>
      <geom type="sphere" size="0.03" mass="0.3"/>
    </default>
  </default>
  <worldbody>
    <body childclass="servo">
      <joint name="joint"/>
      <geom pos="0 0 -0.1"/>
    </body>
  </worldbody>
  <actuator><position class="servo" name="joint" joint="joint"/></actuator>
  <sensor><jointvel name="old" joint="joint"/></sensor>
</mujoco>
""",
}


def recorded(path: Path, seconds: float = 4.0, *, torque_off: bool = False, jitter_s: float = 0.002) -> Run:
    """A run of a pendulum that is not quite its model (more friction); its stamps jitter and its encoder is coarse."""
    model = plain.on_stand(path)
    model.dof_frictionloss[:] += 0.02
    model.dof_damping[:] += 0.02
    t = plants.jittering(seconds, 100.0, jitter_s)
    command = plants.sweep(t, 1)
    torque = np.ones_like(command)
    torque[(t > t[0] + 1.3) & (t < t[0] + 2.1)] = 0
    columns = plants.drive(
        model, ["joint"], t, command, quantum=plants.ENCODER_RAD, torque=torque if torque_off else None
    )
    return plants.run_of(columns, t, ["joint"])


def calibrated(source: Path, out: Path) -> Path:
    """A written model in which every value has moved."""
    plant = load_plant(source, setup=Setup.FLOOR)
    parameters = choose(plant, ["stiffness", "velocity_gain", "damping", "armature", "coulomb_friction", "zero_offset"])
    return write_model(source, apply(plant, parameters, np.full(len(parameters), 0.8)), out)


def agree(path: Path, model: Path, setup: Setup = Setup.STAND) -> None:
    """Rollouts and plain MuJoCo give the same positions for this table and this model, and the same gap."""
    run = read_run(path)
    plant = load_plant(model, run.joints, setup)
    ours = Rollouts(plant, [run])()
    table = plain.read_table(path)
    bare = plain.on_stand(model) if setup is Setup.STAND else plain.on_floor(model)
    theirs = plain.play(bare, table, list(run.joints))
    assert (np.ptp(theirs, axis=0) > 0.2).all(), "the run moves every joint"
    worst = np.abs(ours.pos[0] - theirs).max(axis=0)
    beats = np.diff(run.t) / plant.timestep
    if np.allclose(beats, np.round(beats), atol=1e-6):
        assert (worst < 1e-7).all(), worst
    else:
        fastest = np.abs(ours.vel[0]).max(axis=0)
        assert (worst <= STEPS_ALLOWED * plant.timestep * fastest).all(), (worst, fastest)


@pytest.mark.parametrize("kind", PENDULUMS)
def test_a_written_model_moves_in_plain_mujoco_as_it_does_in_a_rollout(kind: str, tmp_path: Path) -> None:
    source = plants.write(tmp_path / "given.xml", PENDULUMS[kind])
    model = calibrated(source, tmp_path / "calibrated.xml")
    write_table(recorded(source), tmp_path / "jittering.parquet")
    agree(tmp_path / "jittering.parquet", model)
    write_table(recorded(source, jitter_s=0.0), tmp_path / "on the beat.csv")
    agree(tmp_path / "on the beat.csv", model)


@pytest.mark.parametrize("kind", ["position", "kv in the servo", "timeconst", "delay, linear", "pid"])
def test_stretches_without_torque_agree(kind: str, tmp_path: Path) -> None:
    source = plants.write(tmp_path / "given.xml", PENDULUMS[kind])
    write_table(recorded(source, torque_off=True, jitter_s=0.0), tmp_path / "run.csv")
    agree(tmp_path / "run.csv", calibrated(source, tmp_path / "calibrated.xml"))


#: 8 vertices of a block, as a mesh file
BLOCK = "".join(f"v {x} {y} {z}\n" for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.02, 0.02)) + "\n".join(
    f"f {' '.join(map(str, face))}"
    for face in (
        (1, 2, 4), (1, 4, 3), (5, 7, 8), (5, 8, 6), (1, 5, 6), (1, 6, 2),
        (3, 4, 8), (3, 8, 7), (1, 3, 7), (1, 7, 5), (2, 6, 8), (2, 8, 4),
    )
)  # fmt: skip


def in_pieces(folder: Path) -> Path:
    """A model of several files: the arm and its servo are included, and its mesh lies in a folder of its own."""
    (folder / "parts" / "meshes").mkdir(parents=True)
    plants.write(folder / "parts" / "meshes" / "block.obj", BLOCK)
    plants.write(
        folder / "arm.xml",
        """\
<mujocoinclude>
  <body name="arm">
    <!-- the horn -->
    <joint name="joint" axis="0 1 0" damping="0.12" armature="0.006" frictionloss="0.03"/>
    <geom type="mesh" mesh="block" pos="0 0 -0.1" mass="0.3"/>
  </body>
</mujocoinclude>
""",
    )
    plants.write(
        folder / "servos.xml",
        f"""\
<mujocoinclude>
  <actuator><position {SERVO} kp="8" {BAR}/></actuator>
</mujocoinclude>
""",
    )
    return plants.write(
        folder / "robot.xml",
        """\
<mujoco>
  <compiler angle="radian" meshdir="parts/meshes"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <asset><mesh name="block" file="block.obj"/></asset>
  <worldbody><include file="arm.xml"/></worldbody>
  <include file="servos.xml"/>
</mujoco>
""",
    )


def test_a_model_of_several_files_becomes_one_that_stands_on_its_own(tmp_path: Path) -> None:
    (tmp_path / "given").mkdir()
    source = in_pieces(tmp_path / "given")
    write_table(recorded(source), tmp_path / "run.parquet")
    out = tmp_path / "elsewhere" / "calibrated.xml"
    out.parent.mkdir()
    agree(tmp_path / "run.parquet", calibrated(source, out))
    assert "<include" not in out.read_text()


@pytest.fixture(scope="module")
def ant_on_stand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run table of an Ant on its stand that is a little stiffer and rougher than the nominal one."""
    folder = tmp_path_factory.mktemp("ant")
    model = plain.on_stand(nominal_model_path("standard"))
    model.actuator_gainprm[:, 0] *= 0.93
    model.actuator_biasprm[:, 1] *= 0.93
    model.dof_frictionloss[:] += 0.02
    t = plants.jittering(5.0, 100.0)
    joints = list(JOINT_NAMES)
    command = home() + plants.sweep(t, 8, reach=0.4, high_hz=1.5)
    command[:30] = home()
    columns = plants.drive(model, joints, t, command, quantum=plants.ENCODER_RAD)
    run = plants.run_of(columns, t, joints, "stand", setup="stand").between(t[20], t[-1])  # once it has come to rest
    write_table(run, folder / "stand.parquet")
    return folder / "stand.parquet"


def home() -> Any:
    return np.array(home_angles())


def test_the_ant_on_its_stand_agrees(ant_on_stand: Path, tmp_path: Path) -> None:
    agree(ant_on_stand, calibrated(nominal_model_path("standard"), tmp_path / "calibrated.xml"))


def test_the_ant_on_the_floor_agrees_while_its_base_was_measured(tmp_path: Path) -> None:
    source = nominal_model_path("standard")
    bare = plain.on_floor(source)
    data = mujoco.MjData(bare)
    mujoco.mj_resetDataKeyframe(bare, data, 0)
    mujoco.mj_step(bare, data, 1000)
    t = 5.0 + np.arange(150) / 100.0
    columns = {f"base.{name}": np.full(len(t), np.nan) for name in ("x", "y", "z", "qw", "qx", "qy", "qz")}
    for name, value in zip(columns, data.qpos[:7], strict=True):
        columns[name][0] = value
    ramp = np.clip((t - t[0] - 0.3) / 0.5, 0, 1)[:, None]
    command = home() + ramp * np.array([0.1, -0.2] * 4)
    for j, joint in enumerate(JOINT_NAMES):
        columns[f"cmd.{joint}"] = command[:, j]
        columns[f"pos.{joint}"] = data.joint(joint).qpos[0] + command[:, j] - command[0, j]
    run = plants.run_of(columns, t, JOINT_NAMES, "floor", setup="floor")
    write_table(run, tmp_path / "floor.parquet")
    model = calibrated(source, tmp_path / "calibrated.xml")
    ours = Rollouts(load_plant(model, JOINT_NAMES, Setup.FLOOR), [run])()
    theirs = plain.play(plain.on_floor(model), plain.read_table(tmp_path / "floor.parquet"), list(JOINT_NAMES))
    assert np.ptp(theirs, axis=0).min() > 0.05
    assert np.abs(ours.pos[0] - theirs).max() < 1e-7


@pytest.mark.parametrize("torque_off", [False, True], ids=["driven", "partly without torque"])
def test_the_figures_of_a_fit_can_be_had_without_us(torque_off: bool, tmp_path: Path) -> None:
    """`gap_full_rad` of fit.json, from calibrated.xml and the held-out table alone."""
    source = plants.write(tmp_path / "pendulum.xml", plants.pendulum(option='timestep="0.002"'))
    fitted = recorded(source, 3.0, torque_off=torque_off, jitter_s=0.0)
    held_out = recorded(source, 4.0, torque_off=torque_off, jitter_s=0.0)
    write_table(held_out, tmp_path / "held-out.csv")
    result = identify([fitted], source, [read_run(tmp_path / "held-out.csv")])
    write_fit(result, tmp_path / "fit")
    figures = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert figures["accepted"]
    bare = plain.on_stand(tmp_path / "fit" / "calibrated.xml")
    table = plain.read_table(tmp_path / "held-out.csv")
    theirs = plain.gap(table, plain.play(bare, table, ["joint"]), ["joint"])
    after, before = figures["held_out"]["after"]["gap_full_rad"], figures["held_out"]["before"]["gap_full_rad"]
    assert theirs == pytest.approx(after, rel=0.01)
    assert after < 0.5 * before
