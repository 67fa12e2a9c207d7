"""A builder hands on what was recorded, learned and calibrated: as datasets and as a URDF, each with a card."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from openant_tools.cli import main
from openant_tools.exchange.urdf import write_urdf
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run, write_table
from openant_tools.robot.folder import create_robot

#: all that makes a URDF hard: an anchor off the body's frame, a zero that is not the file's pose, two joints in one body, a
#: slide, a turned inertia, a mesh, a body that is only screwed on
HARD = """
<mujoco>
  <compiler angle="radian"/>
  <asset><mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.05 0  0 0 0.03"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="base" pos="0 0 1" quat="0.9 0.1 0.2 0.3">
      <freejoint/>
      <inertial pos="0.01 0.02 0.03" mass="2" fullinertia="0.02 0.03 0.04 0.001 0.002 0.003"/>
      <geom type="box" size="0.1 0.05 0.03"/>
      <body name="plate" pos="0 0.1 0" euler="0.3 0 0"><geom type="cylinder" size="0.03 0.01" mass="0.2"/></body>
      <body name="upper" pos="0.2 0 0" euler="0 0.4 0.1">
        <joint name="roll" axis="1 0 0" pos="0.05 0.02 0" range="-1 1" damping="0.3" frictionloss="0.04" armature="0.02"/>
        <joint name="pitch" axis="0 1 0" pos="0.01 0 0.02" ref="0.4"/>
        <geom type="capsule" size="0.02 0.1" pos="0.1 0 0" euler="0 1.2 0" mass="0.5"/>
        <body name="lower" pos="0.3 0 0">
          <joint name="reach" type="slide" axis="0 0 1" range="-0.2 0.2" ref="0.05"/>
          <geom type="mesh" mesh="wedge" mass="0.3" euler="0.1 0.2 0.3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="roll" kp="5" forcerange="-1.5 1.5"/><position joint="pitch" kp="5"/></actuator>
</mujoco>
"""


def code_of(*words: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(str(ended.value.code))


def loaded(path: Path) -> mujoco.MjModel:
    """A URDF in MuJoCo, its root free, which URDF leaves to who loads it."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.first_body().add_freejoint()
    return spec.compile()


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def check_same(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> None:
    """Every body is where it was and every motion as heavy, at any angles."""
    ours.dof_armature[:] = 0.0
    names = [ours.joint(j).name for j in range(ours.njnt) if ours.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
    assert names == [theirs.joint(j).name for j in range(1, theirs.njnt)]
    random = np.random.default_rng(0)
    for _ in range(3):
        quaternion = random.normal(size=4)
        angles = random.uniform(-0.9, 0.9, len(names))
        both = []
        for model in (ours, theirs):
            data = mujoco.MjData(model)
            data.qpos[:3], data.qpos[3:7] = (0.1, 0.2, 0.9), quaternion / np.linalg.norm(quaternion)
            data.qpos[7:] = angles
            mujoco.mj_forward(model, data)
            both.append(data)
        for k in range(1, ours.nbody):
            name = ours.body(k).name
            np.testing.assert_allclose(both[0].body(name).xipos, both[1].body(name).xipos, atol=1e-9)
        one, other = (mass_matrix(model, data) for model, data in zip((ours, theirs), both, strict=True))
        np.testing.assert_allclose(one, other, atol=1e-7)


def test_a_urdf_moves_and_weighs_as_the_model_that_it_was_made_of(tmp_path: Path) -> None:
    (tmp_path / "hard.xml").write_text(HARD)
    missing = write_urdf(tmp_path / "hard.xml", tmp_path / "hard.urdf")
    ours, theirs = mujoco.MjModel.from_xml_string(HARD), loaded(tmp_path / "hard.urdf")
    check_same(ours, theirs)
    roll = theirs.joint("roll")
    assert roll.range.tolist() == [-1.0, 1.0]
    assert (roll.damping[0], roll.frictionloss[0]) == (0.3, 0.04)
    head = (tmp_path / "hard.urdf").read_text().partition("<robot")[0]
    assert any("armature" in line for line in missing)
    assert all(line in head for line in missing)
    assert [path.name for path in (tmp_path / "meshes").iterdir()] == ["wedge.stl"]


def test_a_robots_folder_becomes_a_urdf_with_its_card(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "ant", "standard", "lucy")
    assert code_of("config", "export", "--robot", folder.path, "--to", "urdf", "--out", tmp_path / "lucy.urdf") == 0
    check_same(mujoco.MjModel.from_xml_path(str(folder.model_path())), loaded(tmp_path / "lucy.urdf"))
    written = (tmp_path / "lucy.md").read_text()
    assert "lucy, standard kit" in written
    assert "nominal: nothing was fitted" in written
    assert "diagnosis**: none" in written
    assert code_of("config", "export", "--robot", folder.path, "--to", "urdf") == 2


def walk(folder: Path, name: str, rows: int = 80) -> Path:
    t = 5.0 + 0.02 * np.arange(rows) + np.tile([0.0, 0.003], rows // 2)
    swing = 0.4 * np.sin(np.arange(rows) * 0.2)
    columns: dict[str, Any] = {
        "cmd.hip": swing, "pos.hip": np.roll(swing, 1), "cmd.knee": -swing, "pos.knee": -np.roll(swing, 1),
        "vel.hip": np.gradient(swing, t), "vel.knee": -np.gradient(swing, t), "cmd_t": t + 0.001,
        "base.x": 0.01 * np.arange(rows), "base.y": np.zeros(rows),
    }  # fmt: skip
    columns["pos.knee"][7] = math.nan
    path = folder / f"{name}.csv"
    write_table(Run(name, Facts(("hip", "knee"), setup="floor", protocol="walk"), t, columns), path)
    return path


def test_runs_become_a_lerobot_dataset_that_comes_back_as_it_was(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    runs = [walk(tmp_path, "one"), walk(tmp_path, "two", 60)]
    assert code_of("rec", "export", *runs, "--to", "lerobot", "--out", tmp_path / "set") == 0
    assert code_of("rec", "import", tmp_path / "set", "--from", "lerobot", "--out", tmp_path / "back") == 0
    for k, path in enumerate(runs):
        before, after = read_run(path), read_run(tmp_path / "back" / f"episode_{k:03d}.parquet")
        assert after.joints == before.joints
        assert after.duration_s == pytest.approx(before.duration_s, abs=0.03)
        position = np.interp(after.t + before.t[0], before.t, before.columns["pos.hip"])
        np.testing.assert_allclose(after.columns["pos.hip"], position, atol=1e-5)
        assert set(np.round(after.columns["cmd.hip"], 5)) <= set(np.round(before.columns["cmd.hip"], 5))
    assert "episode 1: `two`" in (tmp_path / "set" / "README.md").read_text()
    assert code_of("rec", "export", *runs, "--to", "lerobot", "--out", tmp_path / "set") == 2


def episodes_of(root: Path) -> tuple[dict[str, Any], list[dict[str, np.ndarray]]]:
    """A Minari dataset as Minari reads its `parquet` storage."""
    import pyarrow.parquet as pq

    metadata = json.loads((root / "data" / "metadata.json").read_text())
    episodes = []
    for k in range(metadata["total_episodes"]):
        table = pq.read_table(root / "data" / str(k) / "part-0.parquet").to_pydict()
        episodes.append(
            {name: np.array(values if name == "observations" else values[:-1]) for name, values in table.items()}
        )
    return metadata, episodes


def test_a_hardware_run_becomes_a_minari_dataset(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    runs = [walk(tmp_path, "one"), walk(tmp_path, "two", 10)]  # the second goes less far
    assert code_of("rec", "export", *runs, "--to", "minari", "--out", tmp_path / "set") == 0
    metadata, (episode, _) = episodes_of(tmp_path / "set")
    assert metadata["total_steps"] == 79 + 9
    space = json.loads(metadata["action_space"])
    assert (episode["actions"] <= np.array(space["high"])).all()
    assert (episode["actions"] >= np.array(space["low"])).all()
    assert metadata["action_names"] == ["cmd.hip", "cmd.knee"]
    assert episode["observations"].shape == (80, len(metadata["observation_names"]))
    np.testing.assert_allclose(episode["rewards"], 0.01, atol=1e-9)
    assert np.isfinite(episode["observations"]).all()
    assert not episode["terminations"].any()
    assert episode["truncations"].tolist() == [False] * 78 + [True]


def test_a_training_run_becomes_episodes_that_end_where_someone_helped(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    run = tmp_path / "sac-1"
    run.mkdir()
    robot = create_robot(tmp_path / "ant", "standard", "lucy").path
    facts = {
        "schema": "openant.train/1", "agent": "sac", "observations": 2, "actions": 1,
        "env": {"id": "openant/Ant-v0", "options": {"robot": str(robot)}},
        "trained_on": {"observation_names": ["pos.a", "vel.a"], "action_names": ["a"]},
    }  # fmt: skip
    (run / "run.json").write_text(json.dumps(facts))
    seen = np.arange(12, dtype=np.float32).reshape(6, 2)
    rows = [[*seen[k], 0.5, 0.1 * k, 0.12, 0.0, *seen[k + 1]] for k in range(3)]
    rows += [[*seen[k] * 10, -0.5, 1.0, 0.12, float(k == 1), *seen[k + 1] * 10] for k in range(2)]
    np.array(rows, np.float32).tofile(run / "transitions.f32")
    assert code_of("rec", "export", run, "--to", "minari", "--out", tmp_path / "set") == 0
    metadata, (first, second) = episodes_of(tmp_path / "set")
    assert metadata["observation_names"] == ["pos.a", "vel.a"]
    np.testing.assert_array_equal(first["observations"], seen[:4])
    np.testing.assert_allclose(first["rewards"], [0.0, 0.1, 0.2], atol=1e-7)
    assert first["truncations"][-1]
    assert second["terminations"][-1]
    assert second["actions"].ravel().tolist() == [-0.5, -0.5]
    assert "lucy, standard kit" in (tmp_path / "set" / "README.md").read_text()
