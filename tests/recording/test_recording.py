"""Recordings: a builder records, pulls plugs, fills disks, and gets back every whole record."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import textwrap
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from places import SHARED, TESTS

from openant_tools.cli import main
from openant_tools.cli.rec import rec
from openant_tools.errors import BadInput
from openant_tools.recording import writer as writer_module
from openant_tools.recording.convert import import_run
from openant_tools.recording.pictures import read_pictures
from openant_tools.recording.reader import Samples, merge_nearest, read_recording
from openant_tools.recording.repair import repair
from openant_tools.recording.resume import continuation
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.summary import words_of_pictures
from openant_tools.recording.tables import read_run, read_table, write_table
from openant_tools.recording.telemetry import Cycle, RecordedAnswer, ServoChannel, Telemetry
from openant_tools.recording.writer import RecordingStopped, RecordingWriter

REALDATA = SHARED / "realdata"
RAD = 2 * math.pi / 4096
SCALES = {"pos": RAD, "vel": 0.0239691, "load": 1e-3, "volt": 0.1, "temp": 1.0, "tick": 1.0}
CHANNELS = (
    ServoChannel("hip_rr", "XL430-W250-T", 10, +1, math.pi / 4, SCALES),
    ServoChannel("knee_rr", "XL430-W250-T", 11, -1, -math.pi / 4, SCALES),
)
FACTS = Facts(joints=("hip_rr", "knee_rr"), setup="stand", protocol="steps")


def answer(k: int, servo: int) -> RecordedAnswer:
    if k % 10 == 7 and servo == 1:
        return RecordedAnswer(None, False, "timeout")
    raw = {"pos": 512 + k % 100, "vel": -k % 50, "load": 40, "volt": 118, "temp": 31, "tick": 20 * k % 32768}
    return RecordedAnswer(raw, True, "alert" if (k, servo) == (3, 0) else "", 0.0011 + 1e-4 * servo)


def cycle(k: int, goals: tuple[int | None, ...] | None = None, torque: bool = True) -> Cycle:
    t = 50.0 + 0.02 * k
    goals = (512 + k, 1024 - k) if goals is None else goals
    sent = any(goal is not None for goal in goals)
    return Cycle(t, goals, t - 0.0004 if sent else None, 1e-5 * k, (answer(k, 0), answer(k, 1)), (torque, torque))


def record(path: Path, cycles: int = 60, sync_every: int = 20, **options: Any) -> Path:
    with RecordingWriter(path, facts=FACTS, channels=CHANNELS, **options) as writer:
        for k in range(cycles):
            writer.cycle(cycle(k))
            writer.imu(50.0 + 0.02 * k + 0.004, (0.0, 0.0, 0.01 * k), (0.0, 0.0, 9.81))
            if k % sync_every == sync_every - 1:
                writer.sync()  # ends a chunk, as a second of a real recording does
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("whole") / "run.mcap", config='name = "ant12"\n')


def test_counts_become_angles_of_the_joint(whole: Path) -> None:
    run = read_run(whole)
    assert run.joints == ("hip_rr", "knee_rr")
    assert len(run.t) == 60
    np.testing.assert_allclose(run.t, 50.0 + 0.02 * np.arange(60), atol=1e-12)
    # joint = direction · (servo − zero offset): 512 counts are π/4, the hip's zero; the knee's servo turns backwards.
    assert run.columns["pos.hip_rr"][0] == pytest.approx(0.0)
    assert run.columns["pos.knee_rr"][0] == pytest.approx(-(math.pi / 4 + math.pi / 4))
    assert run.columns["cmd.hip_rr"][5] == pytest.approx(5 * RAD)
    assert run.columns["cmd.knee_rr"][0] == pytest.approx(-(math.pi / 2 + math.pi / 4))
    assert run.columns["vel.hip_rr"][1] == pytest.approx(0.0239691 * 49)
    assert run.columns["vel.knee_rr"][1] == pytest.approx(-0.0239691 * 49)
    assert run.columns["load.knee_rr"][0] == pytest.approx(-0.04)
    assert run.columns["volt.knee_rr"][0] == pytest.approx(11.8)
    assert run.columns["torque.hip_rr"].tolist() == [1.0] * 60
    assert run.columns["cmd_t"][4] == pytest.approx(run.t[4] - 0.0004)
    assert run.columns["wake"][3] == pytest.approx(3e-5)
    assert run.facts.motors["knee_rr"] == "XL430-W250-T"
    assert run.facts.resolution["pos"] == pytest.approx(RAD)


def test_what_was_not_answered_is_missing_and_says_why(whole: Path) -> None:
    run = read_run(whole)
    assert math.isnan(run.columns["pos.knee_rr"][7])
    assert math.isnan(run.columns["rtt.knee_rr"][7])
    assert run.columns["ok.knee_rr"][7] == 0.0
    assert run.columns["err.knee_rr"][7] == "timeout"
    assert run.columns["ok.hip_rr"][3] == 1.0
    assert run.columns["err.hip_rr"][3] == "alert"
    assert run.columns["err.hip_rr"][4] == ""


@given(st.integers(-10_000, 10_000), st.sampled_from([1, -1]), st.floats(-4.0, 4.0))
def test_a_goal_is_an_angle_of_its_joint(counts: int, direction: int, offset: float) -> None:
    channel = ServoChannel("j", "XL430-W250-T", 1, direction, offset, {"pos": RAD})
    angle = float(channel.to_si("goal", np.array(float(counts))))
    assert round((direction * angle + offset) / RAD) == counts


def test_the_body_keeps_its_own_times_and_is_merged_to_the_nearest_rows(whole: Path) -> None:
    recording = read_recording(whole)
    assert len(recording.imu.t) == 60
    np.testing.assert_allclose(recording.imu.t - recording.run.t, 0.004, atol=1e-9)
    np.testing.assert_allclose(recording.run.columns["imu_t"], recording.imu.t)
    np.testing.assert_allclose(recording.run.columns["gyro.z"], 0.01 * np.arange(60))
    assert recording.config == 'name = "ant12"\n'


@given(
    st.lists(st.integers(-100, 1200), min_size=1, max_size=40, unique=True),
    st.lists(st.integers(0, 1000), min_size=2, max_size=30, unique=True),
)
def test_each_sample_goes_to_its_nearest_row_or_nowhere(samples: list[int], rows: list[int]) -> None:
    # Rows on even numbers and samples a little off, so that no sample is as near to one row as to another.
    times, t = 2.0 * np.sort(np.array(samples)) + 0.1, 4.0 * np.sort(np.array(rows))
    merged = merge_nearest(Samples(times, {"x": times}), t)
    reach = float(np.median(np.diff(t)))
    for k, row in enumerate(t):
        near = [s for s in times if np.argmin(np.abs(t - s)) == k and abs(s - row) <= reach]
        assert np.array_equal(merged["x"][k], min(near, key=lambda s: abs(s - row), default=math.nan), equal_nan=True)
        assert np.array_equal(merged["t"][k], merged["x"][k], equal_nan=True)


def test_a_command_holds_until_the_next_while_torque_is_on(tmp_path: Path) -> None:
    held: tuple[None, None] = (None, None)
    with RecordingWriter(tmp_path / "r.mcap", facts=FACTS, channels=CHANNELS) as writer:
        writer.cycle(cycle(0, held))
        writer.cycle(cycle(1, (600, 600)))
        writer.cycle(cycle(2, held))
        writer.cycle(cycle(3, held, torque=False))
        writer.cycle(cycle(4, held))
    run = read_run(tmp_path / "r.mcap")
    command = run.columns["cmd.hip_rr"]
    assert np.isnan(command).tolist() == [True, False, False, True, True]
    assert command[2] == command[1]
    assert run.columns["cmd_t"][2] == run.columns["cmd_t"][1]
    assert math.isnan(run.columns["cmd_t"][0])


def test_events_registers_and_facts_are_inside(tmp_path: Path) -> None:
    with RecordingWriter(
        tmp_path / "r.mcap",
        facts=FACTS,
        channels=CHANNELS,
        registers={"hip_rr": {"position_p_gain": 640}},
        clock=lambda: 51.5,
    ) as writer:
        writer.cycle(cycle(0))
        writer.event("answered", question="may the robot move?", answer="yes")
        writer.pose(50.0, position=(0.1, 0.2, 0.14), yaw=0.5, quaternion=(1, 0, 0, 0))
    recording = read_recording(tmp_path / "r.mcap")
    assert recording.events == ({"t": 51.5, "kind": "answered", "question": "may the robot move?", "answer": "yes"},)
    assert recording.registers == {"hip_rr": {"position_p_gain": 640}}
    assert recording.run.facts.registers == recording.registers
    assert recording.run.facts.protocol == "steps"
    assert recording.run.columns["base.yaw"].tolist() == [0.5]
    assert recording.started["clock"] == 51.5


def test_viewers_decode_the_file_by_its_own_schema(whole: Path) -> None:
    from google.protobuf import descriptor_pb2

    with whole.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 120
        topics = {channel.topic: channel for channel in summary.channels.values()}
        assert {"/cycle", "/imu", "/pose", "/event"} <= set(topics)
        schema = summary.schemas[topics["/cycle"].schema_id]
    assert (schema.name, schema.encoding) == ("openant.Cycle", "protobuf")
    (file,) = descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
    cycle_type = next(message for message in file.message_type if message.name == "Cycle")
    names = [field.name for field in cycle_type.field]
    assert set(names) == {"t", "cmd_t", "wake", "hip_rr", "knee_rr", "obs_t", "act_t"}


@given(st.lists(st.text(min_size=1, max_size=12), min_size=1, max_size=5, unique=True))
@settings(max_examples=40)
def test_any_joint_names_make_a_schema(names: list[str]) -> None:
    channels = [ServoChannel(name, "m", k, scales={"pos": RAD}) for k, name in enumerate(names)]
    telemetry = Telemetry(channels)
    assert len(set(telemetry.joint_fields.values())) == len(names)
    answers = [RecordedAnswer({"pos": k}, True) for k in range(len(names))]
    assert telemetry.cycle(Cycle(1.0, [None] * len(names), None, None, answers, [True] * len(names)))


# -- torn files ------------------------------------------------------------------------------------------------------


def assert_exact_prefix(torn: Run, original: Run) -> int:
    rows = len(torn.t)
    np.testing.assert_array_equal(torn.t, original.t[:rows])
    for name, values in torn.columns.items():
        np.testing.assert_array_equal(values, original.columns[name][:rows])
    return rows


def rows_after(whole: Path, data: bytes, folder: Path) -> int:
    """How many rows a damaged copy gives; all of them must be the original's first rows."""
    path = folder / "torn.mcap"
    path.write_bytes(data)
    try:
        recording = read_recording(path)
    except BadInput as refused:
        line = str(refused)
        assert str(path) in line
        return 0
    # IMU samples of a chunk that was lost may be missing at the last row: rows are of the bus.
    bus = {
        name: values for name, values in recording.run.columns.items() if not name.startswith(("gyro", "acc", "imu"))
    }
    torn = Run("torn", recording.run.facts, recording.run.t, bus)
    return assert_exact_prefix(torn, read_recording(whole).run)


@settings(max_examples=100)
@given(share=st.floats(0.0, 1.0))
def test_a_file_cut_anywhere_gives_every_whole_record_before(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, share: float
) -> None:
    data = whole.read_bytes()
    cut = int(share * (len(data) - 1))
    rows = rows_after(whole, data[:cut], tmp_path_factory.mktemp("cut"))
    assert rows == max([count for end, count in chunk_ends(whole) if end <= cut], default=0)


@settings(max_examples=100)
@given(share=st.floats(0.0, 1.0))
def test_a_zeroed_tail_gives_every_whole_record_before(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, share: float
) -> None:
    data = whole.read_bytes()
    start = int(share * (len(data) - 1))
    zeroed = data[:start] + bytes(len(data) - start)
    rows = rows_after(whole, zeroed, tmp_path_factory.mktemp("zeroed"))
    # A byte that was zero before is not lost by zeroing it.
    touched = next(k for k in range(start, len(data)) if data[k])
    assert rows == max([count for end, count in chunk_ends(whole) if end <= touched], default=0)


def test_a_file_from_before_wall_clocks_is_read_and_gone_on_with(whole: Path, tmp_path: Path) -> None:
    """Its time stamps are those of the rows themselves, and nothing in it says otherwise."""
    old = tmp_path / "old.mcap"
    with whole.open("rb") as source, old.open("wb") as stream:
        writer, reader = Writer(stream), make_reader(source)
        writer.start(profile="openant")
        (metadata,) = reader.iter_metadata()
        content = json.loads(metadata.metadata["content"])
        offset = content.pop("stamp_offset_ns")
        text = json.dumps(content)
        writer.add_metadata(metadata.name, {"content": text, "crc32": f"{zlib.crc32(text.encode()):08x}"})
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels and schema is not None:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            stamp = message.log_time - offset
            writer.add_message(channels[channel.id], stamp, message.data, stamp)
        writer.finish()
    assert read_run(old).columns.keys() == read_run(whole).columns.keys()
    np.testing.assert_array_equal(read_run(old).t, read_run(whole).t)
    for path in (old, record(tmp_path / "new.mcap")):
        going_on = continuation(path, CHANNELS, now=52.0, wall_counts=False)
        assert going_on.last_s == pytest.approx(50.0 + 0.02 * 59)
        with RecordingWriter(path, facts=FACTS, channels=CHANNELS, continued=going_on) as again:
            again.cycle(cycle(100))
        assert read_run(path).t[-1] == pytest.approx(52.0)
        with path.open("rb") as stream:
            stamps = [message.log_time for _, _, message in make_reader(stream).iter_messages(topics=["/cycle"])]
        assert (stamps[-1] - stamps[0]) * 1e-9 == pytest.approx(2.0)


def test_pictures_outlive_a_cut_a_repair_and_a_recording_that_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "seen.mcap"
    with RecordingWriter(path, facts=FACTS, channels=CHANNELS) as writer:
        for k in range(60):
            writer.cycle(cycle(k))
            if k % 10 == 0:
                writer.picture(50.0 + 0.02 * k - 0.05, bytes([k]) * 20_000)
    with path.open("r+b") as stream:
        stream.truncate(path.stat().st_size - 30)
    repair(path)
    going_on = continuation(path, CHANNELS, now=52.0, wall_counts=False)
    with RecordingWriter(path, facts=FACTS, channels=CHANNELS, continued=going_on) as again:
        again.cycle(cycle(100))
        again.picture(51.95, b"last")
    kept = list(read_pictures(path))
    assert [one.jpeg[:1] for one in kept] == [bytes([k]) for k in range(0, 60, 10)] + [b"l"]
    assert [one.t for one in kept] == pytest.approx([*(49.95 + 0.02 * k for k in range(0, 60, 10)), 51.95])
    seen = read_recording(path).pictures
    assert seen.t.tolist() == pytest.approx([one.t for one in kept])
    assert words_of_pictures(len(seen.t), 2.5e6, 10.0) == "7 pictures, 2.50 MB, 900 MB an hour"


def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """(byte after a chunk, rows up to it), by mcap's own index."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    cycle_id = next(channel.id for channel in summary.channels.values() if channel.topic == "/cycle")
    ends, rows = [], 0
    with path.open("rb") as stream:
        times = [
            message.log_time for _, channel, message in make_reader(stream).iter_messages() if channel.id == cycle_id
        ]
    for chunk in summary.chunk_indexes:
        rows += sum(chunk.message_start_time <= stamp <= chunk.message_end_time for stamp in times)
        ends.append((chunk.chunk_start_offset + chunk.chunk_length, rows))
    return ends


@settings(max_examples=100)
@given(share=st.floats(0.0, 0.999), payload=st.binary(min_size=1, max_size=40))
def test_garbage_anywhere_never_becomes_a_row(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, share: float, payload: bytes
) -> None:
    data = bytearray(whole.read_bytes())
    at = int(share * len(data))
    data[at : at + len(payload)] = payload[: len(data) - at]
    path = tmp_path_factory.mktemp("garbage") / "r.mcap"
    path.write_bytes(data)
    original = read_run(whole)
    try:
        run = read_run(path)
    except BadInput as refused:
        line = str(refused)
        assert line.startswith(str(path))
        return
    rows = np.searchsorted(original.t, run.t)
    np.testing.assert_array_equal(original.t[rows], run.t)
    for name in ("cmd.hip_rr", "pos.knee_rr", "err.knee_rr", "rtt.hip_rr"):
        np.testing.assert_array_equal(original.columns[name][rows], run.columns[name])


def test_a_torn_page_in_the_middle_loses_its_chunk_only(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    ends = [end for end, _ in chunk_ends(whole)]
    data[ends[1] - 40 : ends[1] - 8] = bytes(32)
    (tmp_path / "r.mcap").write_bytes(data)
    recording = read_recording(tmp_path / "r.mcap")
    assert recording.damage == "1 chunk with a wrong checksum left out"
    original = read_run(whole).t
    np.testing.assert_array_equal(recording.run.t, np.concatenate([original[:20], original[40:]]))


def test_repair_makes_a_torn_file_whole_and_keeps_the_old_one(whole: Path, tmp_path: Path) -> None:
    torn = tmp_path / "run.mcap"
    torn.write_bytes(whole.read_bytes()[: chunk_ends(whole)[1][0] + 5])
    before = torn.read_bytes()
    done = repair(torn)
    assert done.damage is not None
    assert done.original == tmp_path / "run.mcap.damaged"
    assert done.original.read_bytes() == before
    recording = read_recording(torn)
    assert recording.damage is None
    assert recording.config == 'name = "ant12"\n'
    assert assert_exact_prefix(recording.run, read_run(whole)) == 40
    with torn.open("rb") as stream:
        assert make_reader(stream).get_summary() is not None
    assert repair(torn).damage is None


def test_repair_does_not_overwrite_an_earlier_rescue(whole: Path, tmp_path: Path) -> None:
    torn = tmp_path / "run.mcap"
    torn.write_bytes(whole.read_bytes()[:-20])
    torn.with_name("run.mcap.damaged").write_bytes(b"precious")
    with pytest.raises(BadInput, match="an earlier damaged file stands there"):
        repair(torn)
    assert repair(torn, tmp_path / "new.mcap").path == tmp_path / "new.mcap"


CHILD = """
    import sys, time
    sys.path[:0] = {folders!r}
    from test_recording import CHANNELS, FACTS, RecordingWriter, cycle
    writer = RecordingWriter({path!r}, facts=FACTS, channels=CHANNELS)
    for k in range(100000):
        writer.cycle(cycle(k))
        if k == 149:
            writer.sync()
            print("on disk", flush=True)
        time.sleep(0.001)
"""


def test_kill_minus_nine_keeps_all_that_was_synced(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    code = textwrap.dedent(CHILD).format(path=str(path), folders=[str(Path(__file__).parent), str(TESTS)])
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        assert child.stdout.readline().strip() == "on disk"
    finally:
        child.send_signal(signal.SIGKILL)
        child.communicate()
    recording = read_recording(path)
    assert recording.damage is not None
    assert len(recording.run.t) >= 150
    np.testing.assert_allclose(recording.run.t, 50.0 + 0.02 * np.arange(len(recording.run.t)), atol=1e-9)


def test_within_a_second_a_recording_is_on_the_disk_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "SYNC_PERIOD", 0.05)
    writer = RecordingWriter(tmp_path / "run.mcap", facts=FACTS, channels=CHANNELS)
    try:
        writer.cycle(cycle(0))
        deadline = time.monotonic() + 20.0
        while time.monotonic() < deadline:
            try:
                if len(read_recording(tmp_path / "run.mcap").run.t) == 1:
                    break
            except BadInput:
                time.sleep(0.01)
        else:
            pytest.fail("nothing reached the disk")
    finally:
        writer.close()


# -- disks that refuse -----------------------------------------------------------------------------------------------


def full_after(budget: int) -> Callable[[int, Any], int]:
    """An os.write that takes `budget` bytes and then, like a full disk, a part and then none."""
    written = [0]
    real = os.write

    def write(descriptor: int, data: Any) -> int:
        room = budget - written[0]
        if room <= 0:
            raise OSError(28, "No space left on device")
        count = real(descriptor, bytes(data)[:room])
        written[0] += count
        return count

    return write


def test_a_full_disk_stops_the_recording_and_keeps_what_there_is(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    monkeypatch.setattr(writer_module.os, "write", full_after(chunk_ends(whole)[1][0] + 300))
    with pytest.raises(RecordingStopped) as stopped:
        record(path)
    monkeypatch.undo()
    line = str(stopped.value)
    assert line.startswith(
        f"{path}: the disk is full, the recording stopped; what was recorded until t = 50.380 s is kept"
    )
    assert "free space" in line
    recording = read_recording(path)
    assert assert_exact_prefix(recording.run, read_run(whole)) == 40
    assert repair(path).messages == 80


def test_a_disk_full_from_the_start_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module.os, "write", full_after(100))
    with pytest.raises(RecordingStopped, match="the disk is full"):
        record(tmp_path / "run.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_device_that_is_always_full(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").symlink_to("/dev/full")
    with pytest.raises(RecordingStopped, match="the disk is full"):
        record(tmp_path / "run.mcap", overwrite=True)


def test_an_error_of_the_robot_is_not_hidden_by_one_of_the_disk(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module.os, "write", full_after(chunk_ends(whole)[0][0]))

    def lose_a_servo() -> None:
        with RecordingWriter(tmp_path / "run.mcap", facts=FACTS, channels=CHANNELS) as writer:
            for k in range(60):
                writer.cycle(cycle(k))
            raise RuntimeError("servo 11 is gone")

    with pytest.raises(RuntimeError, match="servo 11 is gone"):
        lose_a_servo()


def test_a_cycle_that_does_not_fit_stops_the_recording(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", facts=FACTS, channels=CHANNELS)
    writer.cycle(Cycle(0.0, (1,), None, None, (), (True,)))
    with pytest.raises(RecordingStopped, match="could not be encoded"):
        writer.sync()
    writer.close()


def test_a_recording_never_takes_another_ones_place(whole: Path) -> None:
    before = whole.read_bytes()
    with pytest.raises(BadInput, match="there is a recording already"):
        record(whole)
    assert whole.read_bytes() == before


def test_names_of_recordings(tmp_path: Path) -> None:
    assert RecordingWriter(tmp_path / "a.b", facts=FACTS, channels=CHANNELS).path.name == "a.b.mcap"
    with pytest.raises(BadInput, match=r"a recording is a \.mcap file"):
        RecordingWriter(tmp_path / "run.parquet", facts=FACTS, channels=CHANNELS)


def test_a_robot_folder_that_is_not_there_is_made(tmp_path: Path) -> None:
    assert record(tmp_path / "ant12" / "recordings" / "run", cycles=2).with_suffix(".mcap").exists()


def test_files_that_are_no_recordings(tmp_path: Path, whole: Path) -> None:
    cases = {"empty": b"", "zeros": bytes(500), "text": b"hello, world\n" * 9, "magic": whole.read_bytes()[:8]}
    for name, data in cases.items():
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(data)
        with pytest.raises(BadInput) as refused:
            read_run(path)
        assert str(refused.value).startswith(f"{path}: ")
        with pytest.raises(BadInput):
            repair(path)
    with RecordingWriter(tmp_path / "none.mcap", facts=FACTS, channels=CHANNELS):
        pass
    with pytest.raises(BadInput, match="the run is empty"):
        read_run(tmp_path / "none.mcap")


def test_rows_of_the_past_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with RecordingWriter(tmp_path / "r.mcap", facts=FACTS, channels=CHANNELS) as writer:
        for k in (0, 1, 1, 0, 2):
            writer.cycle(cycle(k))
    assert len(read_run(tmp_path / "r.mcap").t) == 3
    assert "2 rows whose time does not run forward" in caplog.text


# -- tables and the command line -------------------------------------------------------------------------------------


def same_run(one: Run, other: Run) -> None:
    np.testing.assert_array_equal(one.t, other.t)
    assert set(one.columns) == set(other.columns)
    for name, values in one.columns.items():
        np.testing.assert_array_equal(other.columns[name], values, err_msg=name)
    assert one.facts.joints == other.facts.joints


@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_export_and_import_give_the_same_run(whole: Path, tmp_path: Path, suffix: str) -> None:
    out = CliRunner().invoke(
        rec, ["export", str(whole), "--to", suffix, "--out", str(tmp_path)], catch_exceptions=False
    )
    assert "60 rows" in out.output
    table = tmp_path / f"run.{suffix}"
    same_run(read_run(whole), read_table(table))
    CliRunner().invoke(rec, ["import", str(table), "--out", str(tmp_path / "back")], catch_exceptions=False)
    back = read_run(tmp_path / "back.mcap")
    same_run(read_run(whole), back)
    assert back.facts == read_table(table).facts
    assert not list(tmp_path.glob(".*"))


cells = st.one_of(st.just(math.nan), st.floats(-3.0, 3.0))


@settings(max_examples=25)
@given(rows=st.lists(st.tuples(cells, cells, cells, cells), min_size=2, max_size=8))
def test_any_table_survives_import(tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, ...]]) -> None:
    columns = np.array(rows).T
    names = ("cmd.a b", "pos.a b", "gyro.y", "my own")
    # A column without a single sample says nothing and does not come back.
    kept = {name: values for name, values in zip(names, columns, strict=True) if np.isfinite(values).any()}
    run = Run("r", Facts(joints=("a b",)), 0.1 * np.arange(len(rows)) - 0.3, kept)
    path = import_run(run, tmp_path_factory.mktemp("import") / "r")
    same_run(run, read_run(path, need=()))


def test_import_leaves_nothing_behind_on_a_full_disk(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module.os, "write", full_after(3000))
    with pytest.raises(RecordingStopped):
        import_run(read_run(whole), tmp_path / "r.mcap")
    assert list(tmp_path.iterdir()) == []


def test_info_tells_what_a_recording_holds(tmp_path: Path, whole: Path) -> None:
    out = (
        CliRunner().invoke(rec, ["info", str(whole), "--json", str(tmp_path / "i.json")], catch_exceptions=False).output
    )
    assert "60 rows over 1.18 s, 50.0 Hz" in out
    assert "knee_rr" in out
    assert "10.00 % lost (6 timeout)" in out
    result = json.loads((tmp_path / "i.json").read_text())
    assert result["rows"] == 60
    assert result["rate_hz"] == pytest.approx(50.0)
    assert result["joints"][1]["errors"] == {"timeout": 6}
    assert result["damage"] is None
    assert result["facts"]["setup"] == "stand"


def test_info_tells_gaps_and_damage(tmp_path: Path, whole: Path) -> None:
    (tmp_path / "torn.mcap").write_bytes(whole.read_bytes()[:-30])
    assert (
        "DAMAGED: cut" in CliRunner().invoke(rec, ["info", str(tmp_path / "torn.mcap")], catch_exceptions=False).output
    )
    run = read_run(whole)
    late = Run("late", run.facts, run.t + np.where(np.arange(60) >= 30, 0.5, 0.0), run.columns)
    write_table(late, tmp_path / "late.parquet")
    out = CliRunner().invoke(rec, ["info", str(tmp_path / "late.parquet")], catch_exceptions=False).output
    assert "gap of 0.520 s at t = 50.580 s (row 30)" in out


def test_repair_on_the_command_line(tmp_path: Path, whole: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(whole.read_bytes()[:-30])
    out = CliRunner().invoke(rec, ["repair", str(tmp_path / "run.mcap")], catch_exceptions=False).output
    assert "whole again, 120 records kept" in out
    out = CliRunner().invoke(rec, ["repair", str(tmp_path / "run")], catch_exceptions=False).output
    assert "whole already" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rec", "info", "nowhere.mcap"], "nowhere.mcap: there is no such file"),
        (["rec", "export", "cut.mcap", "--out", "tables"], "cut.mcap: the recording was cut at its start"),
        (["rec", "repair", "table.csv"], "table.csv: this is not a recording"),
        (["rec", "import", "table.csv", "--out", "x.mcap"], "table.csv, column t, row 2: time runs backwards"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    tmp_path: Path,
    whole: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    (tmp_path / "cut.mcap").write_bytes(whole.read_bytes()[:60])
    (tmp_path / "table.csv").write_text("t,cmd.j,pos.j\n1,0,0\n0,0,0\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"openant: {message}")
    assert captured.err.count("\n") == 1
    assert sorted(file.name for file in tmp_path.iterdir()) == ["cut.mcap", "table.csv"]


@pytest.mark.skipif(not REALDATA.is_dir(), reason="the shared recordings are not here")
def test_real_tables_become_recordings_value_for_value(tmp_path: Path) -> None:
    source = REALDATA / "bam-xl330" / "kp400_lift_and_drop.parquet"
    path = import_run(read_run(source), tmp_path / "r.mcap")
    same_run(read_run(source), read_run(path))
    assert read_run(path).model_path is not None
