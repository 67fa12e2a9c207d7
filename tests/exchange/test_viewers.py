"""A builder opens a recording in Foxglove and in Rerun, and sees the robot where it was, with its simulation over it."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mcap.reader import make_reader

from openant_tools.cli import main
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.recording.telemetry import Cycle, RecordedAnswer, ServoChannel, message_classes
from openant_tools.recording.writer import RecordingWriter
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.mjcf import nominal_model_path

RAD = 2 * math.pi / 4096
ROWS = 60
JPEG = b"\xff\xd8 what no exporter looks into \xff\xd9"


def code_of(*words: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(str(ended.value.code))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a robot on its floor, in its folder: the joints swing, the body walks along x, one finding names the file."""
    folder = create_robot(tmp_path_factory.mktemp("robots") / "ant", "standard", "ant")
    channels = [ServoChannel(joint, "XL430-W250-T", k, 1, 0.0, {"pos": RAD}) for k, joint in enumerate(JOINTS)]
    path = folder.recordings / "walk.mcap"
    start = time.monotonic()
    with RecordingWriter(path, facts=Facts(tuple(JOINTS), setup="floor"), channels=channels) as writer:
        for k in range(ROWS):
            t = start + 0.02 * k
            goal = round(200 * math.sin(0.3 * k))
            answers = tuple(RecordedAnswer({"pos": goal - 20}, True) for _ in channels)
            writer.cycle(Cycle(t, (goal,) * 8, t + 1e-4, 0.0, answers, (True,) * 8))
            writer.imu(t, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81))
            writer.pose(t, position=(0.01 * k, 0.0, 0.12), quaternion=(1.0, 0.0, 0.0, 0.0))
            if k % 10 == 0:
                writer.picture(t - 0.05, JPEG)
        writer.event("question", words="is it on the floor?")
    folder.findings.mkdir(exist_ok=True)
    (folder.findings / "walk-1.json").write_text(
        '{"step": "walk", "ok": false, "what": "knee_fl lags", "evidence": [{"source": "recordings/walk.mcap"}]}'
    )
    return path


def test_a_recording_is_of_today_and_its_own_clock_stays_beside_it(recording: Path) -> None:
    with recording.open("rb") as stream:
        stamps = [message.log_time for _, _, message in make_reader(stream).iter_messages(topics=["/cycle"])]
    assert abs(stamps[0] * 1e-9 - time.time()) < 600
    t = read_recording(recording).run.t
    np.testing.assert_allclose(np.diff(stamps) * 1e-9, np.diff(t), atol=1e-6)
    assert t[0] < stamps[0] * 1e-9 / 2  # the monotonic clock


def test_foxglove_gets_joints_in_radians_the_robot_where_it_was_and_what_was_said(
    recording: Path, tmp_path: Path
) -> None:
    pytest.importorskip("foxglove")
    assert code_of("rec", "export", recording, "--to", "foxglove", "--out", tmp_path) == 0
    found: dict[str, list[tuple[int, Any]]] = {}
    with (tmp_path / "walk.foxglove.mcap").open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            decoded = message.data
            if channel.message_encoding == "protobuf" and schema is not None:
                decoded = message_classes(schema.data)[schema.name].FromString(message.data)
                assert schema.name.startswith("foxglove.")
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    run = read_recording(recording).run
    assert abs(found["/joint_states"][0][0] * 1e-9 - time.time()) < 600
    state = found["/joint_states"][30][1].joints
    assert [one.name for one in state] == list(run.joints)
    assert state[0].position == pytest.approx(run.columns[f"pos.{run.joints[0]}"][30])
    assert len(found["/joint_commands"]) == len(found["/imu"]) == len(found["/tracker"]) == ROWS
    pictures = found["/picture"]
    assert len(pictures) == ROWS // 10
    assert (pictures[0][1].data, pictures[0][1].format) == (JPEG, "jpeg")
    assert pictures[0][0] < found["/joint_states"][0][0] < pictures[1][0]  # in the file's order, 50 ms before its row
    said = [one[1].message for one in found["/log"]]
    assert any("on the floor?" in words for words in said)
    assert any("knee_fl lags" in words for words in said)
    model = mujoco.MjModel.from_xml_path(str(nominal_model_path()))
    data = mujoco.MjData(model)
    data.qpos[:3] = found["/tf"][-1][1].transforms[0].translation.x, 0.0, 0.12
    assert data.qpos[0] == pytest.approx(0.01 * (ROWS - 1), abs=0.011)
    data.qpos[7:] = [run.columns[f"pos.{joint}"][-1] for joint in JOINTS]
    mujoco.mj_kinematics(model, data)
    placed = {one.child_frame_id: one.translation for one in found["/tf"][-1][1].transforms}
    foot = placed["lower_leg_fl"]
    assert [foot.x - placed["torso"].x, foot.y, foot.z] == pytest.approx(
        [data.body("lower_leg_fl").xpos[0] - data.qpos[0], *data.body("lower_leg_fl").xpos[1:]], abs=0.005
    )
    assert {one.frame_id for one in found["/scene"][0][1].entities} == set(placed)


def test_rerun_shows_the_simulation_over_the_measurement_and_the_gap_as_curves(recording: Path, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun")
    assert code_of("rec", "view", recording, "--out", tmp_path / "walk.rrd") == 0
    curves: dict[str, list[float]] = {}
    pictures: list[bytes] = []
    for chunk in rerun.chunk.RrdReader(str(tmp_path / "walk.rrd")).store().stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith("Scalars:scalars"):
                curves.setdefault(chunk.entity_path, []).extend(value[0] for value in batch[name].to_pylist() if value)
            elif "EncodedImage:blob" in name:
                assert chunk.entity_path == "/camera"
                pictures += [bytes(one[0]) for one in batch[name].to_pylist()]
            elif "Transform3D:translation" in name:
                curves.setdefault(chunk.entity_path, []).append(batch.num_rows)
    run = read_recording(recording).run
    measured, simulated, gap = (
        curves[f"/{name}"] for name in ("joints/knee_fl/pos", "joints/knee_fl/simulated", "gap/knee_fl")
    )
    np.testing.assert_allclose(measured, run.columns["pos.knee_fl"])
    assert len(gap) == len(simulated) == ROWS
    assert pictures == [JPEG] * (ROWS // 10)
    np.testing.assert_allclose(np.array(measured) - simulated, gap, atol=1e-9)
    assert sum(curves["/robot/simulated/torso"]) == sum(curves["/robot/measured/lower_leg_fl"]) == ROWS


@pytest.mark.parametrize("asked", [("view",), ("export", "--to", "foxglove", "--out", "x")])
def test_a_table_that_names_no_robot_says_what_to_name(
    asked: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("swing.csv").write_text("t,cmd.a,pos.a\n0.0,0.1,0.0\n0.01,0.1,0.01\n")
    if asked[0] == "export":
        pytest.importorskip("foxglove")
    assert code_of("rec", asked[0], "swing.csv", *asked[1:]) == (2 if asked[0] == "view" else 0)
    printed = capsys.readouterr()
    assert "--model M.xml" in printed.out + printed.err
