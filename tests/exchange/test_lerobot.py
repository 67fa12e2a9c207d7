"""A builder has a LeRobot dataset of an arm, and wants runs of it: in radians, an episode each, and nothing guessed in silence."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lerobot_data import CALIBRATION, JOINTS, TURN, angles, calibrate, counts_of, make, written
from places import SHARED

from openant_tools.cli import main
from openant_tools.exchange.lerobot_units import MotorRange, Unit, joint_scale
from openant_tools.recording.run import Run
from openant_tools.recording.tables import read_run

Refused = Callable[..., str]
REALDATA = SHARED / "realdata" / "sage-so101"


def code_of(*words: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(str(ended.value.code))


def imported(capsys: pytest.CaptureFixture[str], root: Path, out: Path, *options: object) -> tuple[list[Run], str]:
    assert code_of("rec", "import", root, "--from", "lerobot", "--out", out, *options) == 0
    captured = capsys.readouterr()
    runs = [read_run(path) for path in sorted(out.glob("*.parquet"))]
    assert [line.partition(":")[0] for line in captured.out.splitlines()] == [str(run.path) for run in runs]
    return runs, captured.err


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Refused:
    def one(root: Path, *options: object) -> str:
        out = tmp_path / "refused"
        assert code_of("rec", "import", root, "--from", "lerobot", "--out", out, *options) == 2
        assert not out.exists(), "nothing is written of a dataset that is refused"
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert lines[0].startswith("openant: ")
        return lines[0]

    return one


@pytest.mark.parametrize("mode", ["degrees", "normalised"])
@pytest.mark.parametrize("robot", ["so101_follower", ""])
def test_an_arm_gives_the_same_angles_in_either_unit(
    mode: str, robot: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = make(tmp_path / "arm", mode=mode, info={"robot_type": robot})
    runs, said = imported(capsys, root, tmp_path / "runs", "--calibration", calibrate(tmp_path))
    assert [run.name for run in runs] == ["episode_000", "episode_001", "episode_002"]
    assert [len(run.t) for run in runs] == [30, 40, 20]
    for number, run in enumerate(runs):
        assert run.joints == JOINTS
        np.testing.assert_array_equal(run.t, np.arange(len(run.t)) / 30)
        for k, joint in enumerate(JOINTS):
            for signal, phase in (("pos", 0.0), ("cmd", 0.2)):
                counts = counts_of(len(run.t), k, CALIBRATION[joint], phase + number)
                # LeRobot's degrees are a 4096th part of a turn too large: less than a count anywhere.
                np.testing.assert_allclose(
                    run.column(f"{signal}.{joint}"), angles(counts, CALIBRATION[joint]), rtol=3e-4, atol=1e-5
                )
        assert f"swing {number}" in str(run.facts.notes)
        assert run.facts.resolution["pos"] == pytest.approx(2 * math.pi / TURN)
    assert said.splitlines() == [f"joints are in {'normalised units' if mode == 'normalised' else mode}"]


def test_degrees_need_no_calibration_but_for_the_gripper(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = make(tmp_path / "arm")
    runs, said = imported(
        capsys, root, tmp_path / "runs", "--joints", "elbow_flex=Elbow", "--joints", "shoulder_pan.pos=Rotation"
    )
    assert runs[0].joints == ("Rotation", "Elbow")
    theirs = pq.read_table(root / "data/chunk-000/file-000.parquet")["observation.state"].to_pylist()
    np.testing.assert_allclose(runs[0].column("pos.Elbow"), np.deg2rad([row[1] for row in theirs[:30]]))
    assert "gripper → --calibration FILE" in said


def test_an_episode_may_go_on_in_the_next_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, _ = imported(capsys, make(tmp_path / "whole"), tmp_path / "a")
    root = make(tmp_path / "cut")
    first, second = (root / f"data/chunk-000/file-00{k}.parquet" for k in (0, 1))
    table = pa.concat_tables([pq.read_table(first), pq.read_table(second)])
    pq.write_table(table.slice(0, 50), first)
    pq.write_table(table.slice(50), second)
    cut, _ = imported(capsys, root, tmp_path / "b")
    for one, other in zip(whole, cut, strict=True):
        np.testing.assert_array_equal(one.signal("pos"), other.signal("pos"))
        np.testing.assert_array_equal(one.t, other.t)


def test_names_lists_and_files_of_all_ages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """v2.1 as it was, names grouped, lists of a fixed length, one joint without its list, and numbers that are no joints."""
    old = make(tmp_path / "old", info={"codebase_version": "v2.1"})
    for path in (old / "meta" / "episodes").rglob("*.parquet"):
        path.unlink()
    assert len(imported(capsys, old, tmp_path / "a")[0]) == 3

    names = {"motors": ["main_shoulder_pan", "main_elbow_flex", "x.vel"]}
    feature = {"dtype": "float32", "shape": [3], "names": names}
    info = {"features": {"action": feature, "observation.state": feature}}
    runs, said = imported(
        capsys, make(tmp_path / "fixed", info=info, list_type=pa.list_(pa.float32(), 3)), tmp_path / "b"
    )
    assert runs[0].joints == ("main_shoulder_pan", "main_elbow_flex")
    assert "left out, no joint's position and command: x.vel" in said

    column = {name: pa.array(np.linspace(0, 170, 90), pa.float32()) for name in ("action", "observation.state")}
    single = make(tmp_path / "one", joints=["shoulder_pan"], files=((0, 1, 2),), column=column)
    runs, _ = imported(capsys, single, tmp_path / "c")
    assert runs[2].column("pos.shoulder_pan")[-1] == pytest.approx(math.radians(170))


def test_times_of_its_own_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stamps = np.arange(30) / 30 + 0.004 * (np.arange(30) % 3)
    column = {"timestamp": pa.array(stamps + 5.0)}
    (run,), _ = imported(capsys, make(tmp_path / "arm", lengths=(30,), files=((0,),), column=column), tmp_path / "runs")
    np.testing.assert_allclose(run.t, stamps)
    assert "not when a row was taken" not in str(run.facts.notes)


def test_units_that_the_numbers_do_not_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    rng = np.random.default_rng(1)

    def arm(name: str, reach: float, robot: str | None = None) -> Path:
        values = rng.uniform(-reach, reach, (90, 3)).astype(np.float32)
        values[:, 2] = np.abs(values[:, 2]) / reach
        column = {key: pa.array(values.tolist()) for key in ("action", "observation.state")}
        return make(tmp_path / name, files=((0, 1, 2),), column=column, info={"robot_type": robot})

    small = arm("small", 1.5)
    assert "radians or degrees → say which: --units radians|degrees" in refused(small)
    (run, *_), said = imported(capsys, small, tmp_path / "r", "--units", "radians")
    assert 1.4 < np.abs(run.signal("pos")).max() < 1.5
    assert run.joints == JOINTS, "a gripper in radians is an angle as it is"
    (run, *_), said = imported(capsys, arm("so101", 1.5, "so101_follower"), tmp_path / "d")
    assert np.abs(run.signal("pos")).max() < 0.03, "LeRobot has no radians of its own servos"
    assert "taken to be in degrees" in said

    large = arm("large", 80.0)
    calibration = calibrate(tmp_path)
    _, said = imported(capsys, large, tmp_path / "l")
    assert "taken to be in degrees, but their positions are no whole counts → --calibration" in said
    (run, *_), said = imported(capsys, large, tmp_path / "n", "--calibration", calibration)
    assert "taken to be in normalised units" in said
    assert "no whole counts by arm.json" in said
    half = (3430 - 746) / 2 * 2 * math.pi / TURN
    assert 0.7 * half < np.abs(run.column("pos.shoulder_pan")).max() < 0.81 * half
    (run, *_), said = imported(capsys, large, tmp_path / "s", "--calibration", calibration, "--units", "degrees")
    assert 1.3 < np.abs(run.column("pos.shoulder_pan")).max() < 1.4
    assert "taken" not in said

    wide = arm("wide", 150.0)
    _, said = imported(capsys, wide, tmp_path / "w", "--calibration", calibration)
    assert "joints are in degrees" in said, "normalised units end at 100"


def test_positions_that_lerobot_cut_off_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    def clipped(column: str) -> pa.Array:
        raw = {joint: counts_of(30, k, CALIBRATION[joint]) for k, joint in enumerate(JOINTS)}
        raw["elbow_flex"][10:14] += 4000
        modes = ("normalised", "normalised", "percent")
        values = [written(raw[joint], CALIBRATION[joint], mode) for joint, mode in zip(JOINTS, modes, strict=True)]
        return pa.array(np.stack(values, axis=1).astype(np.float32).tolist())

    column = {key: clipped(key) for key in ("action", "observation.state")}
    root = make(tmp_path / "arm", lengths=(30,), files=((0,),), column=column)
    _, said = imported(capsys, root, tmp_path / "runs", "--calibration", calibrate(tmp_path))
    assert "elbow_flex is at an end of its calibrated range in 13 % of rows" in said
    assert "exactly ±100: these are normalised units" in refused(root)


@pytest.mark.skipif(not REALDATA.exists(), reason="no ../shared here")
@pytest.mark.parametrize("mode", ["degrees", "normalised"])
def test_a_real_arm_comes_back_as_its_own_logger_has_it(
    mode: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An SO-101 that was recorded without LeRobot, its counts written as LeRobot would have: two episodes of two joints."""
    names = ("Rotation", "Wrist_Roll")
    recorded = [read_run(REALDATA / name) for name in ("multisine", "velocity_ramp")]
    entries = {
        name: CALIBRATION["shoulder_pan"] | {"range_min": 900, "range_max": 3195 + k} for k, name in enumerate(names)
    }
    column = {}
    for key, signal in (("observation.state", "pos"), ("action", "cmd")):
        angle = np.concatenate([run.signal(signal, names) for run in recorded])
        middle = [(entry["range_min"] + entry["range_max"]) / 2 for entry in entries.values()]
        counts = np.round(angle * TURN / (2 * math.pi) + middle)
        values = [written(counts[:, k], entries[name], mode) for k, name in enumerate(names)]
        column[key] = pa.array(np.stack(values, axis=1).astype(np.float32).tolist())
    rows = [len(run.t) for run in recorded]
    feature = {"shape": [2], "names": [f"{name}.pos" for name in names]}
    features = {"action": feature, "observation.state": feature}
    root = make(tmp_path / "arm", lengths=rows, files=((0, 1),), fps=50, column=column, info={"features": features})
    (tmp_path / "arm.json").write_text(json.dumps(entries))
    runs, said = imported(capsys, root, tmp_path / "runs", "--calibration", tmp_path / "arm.json")
    assert f"joints are in {'normalised units' if mode == 'normalised' else mode}" in said
    for run, own in zip(runs, recorded, strict=True):
        assert np.abs(run.signal("pos") - own.signal("pos", names)).max() < 1.01 * math.pi / TURN, "half a count"


@pytest.mark.parametrize(
    ("changes", "options", "words"),
    [
        ({"shoulder_pan": None}, (), "there is no joint shoulder_pan, which the dataset has"),
        ({"elbow_flex": {"range_max": 851}}, (), "elbow_flex: the range 851 … 851"),
        ({"elbow_flex": {"range_max": "high"}}, (), "elbow_flex: `range_max` is high, not a whole number"),
        ({"gripper": {"drive_mode": 3}}, (), "drive mode 3 cannot be"),
        ({}, ("--joints", "shoulder_pen=Rotation"), "no joint shoulder_pen → did you mean shoulder_pan?"),
        ({}, ("--joints", "shoulder_pan=gripper"), "two joints are called gripper"),
        ({}, ("--joints", "shoulder_pan"), "write THEIRS=OURS"),
        ({}, ("--joints", "shoulder_pan=a,elbow_flex=b"), "repeat the option"),
    ],
)
def test_a_calibration_or_a_name_of_another_arm(
    changes: dict[str, Any], options: tuple[str, ...], words: str, tmp_path: Path, refused: Refused
) -> None:
    root = make(tmp_path / "arm", mode="normalised")
    assert words in refused(root, "--calibration", calibrate(tmp_path, **changes), *options)


def rows(**columns: Any) -> Callable[[Path], None]:
    """Another column in the first file; a function makes it of what stands there, None takes it out."""

    def spoil(root: Path) -> None:
        path = root / "data/chunk-000/file-000.parquet"
        table = pq.read_table(path)
        for key, value in columns.items():
            name = key.replace("__", ".")
            old = table[name]
            table = table.drop_columns(name)
            if value is not None:
                table = table.append_column(name, pa.array(value(old.to_pylist())))
        pq.write_table(table, path)

    return spoil


def info(**changes: Any) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = root / "meta/info.json"
        said = json.loads(path.read_text())
        for key, value in changes.items():
            place = said
            *outer, last = key.replace("__", ".").split("/")
            for part in outer:
                place = place[part]
            if value is None:
                del place[last]
            else:
                place[last] = value
        path.write_text(json.dumps(said))

    return spoil


def gone(name: str) -> Callable[[Path], None]:
    return lambda root: (root / name).unlink()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (gone("meta/info.json"), "meta/info.json is missing → name the folder that holds meta/ and data/"),
        (gone("data/chunk-000/file-001.parquet"), "data/chunk-000/file-001.parquet is missing, with episode 2"),
        (lambda root: (root / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1 cut"), "not a whole parquet file"),
        (
            lambda root: (root / "data/chunk-000/file-000.parquet").write_text("version https://git-lfs.github.com/spec/v1\n"),
            "git lfs pull",
        ),
        (info(codebase_version="v1.6"), "`codebase_version` is v1.6 → read are v2.0, v2.1, v3.0; convert it with LeRobot"),
        (info(fps=0), "`fps` is 0"),
        (info(fps=50), "rows are 33.3 ms apart where meta/info.json says 50 a second"),
        (info(**{"features/action": None}), "there is no action among the features"),
        (info(**{"features/action/names": []}), "the numbers of action have no names"),
        (info(**{"features/action/names": ["a.pos", "b.pos", "c.pos"]}), "no joint is in observation.state"),
        (info(**{"features/action/names": ["a.pos", "b.pos"]}), "2 names for the shape [3]"),
        (rows(action=None), "there is no column action"),
        (rows(action=lambda old: [*old[:7], old[7][:2], *old[8:]]), "row 8 has 2 values where meta/info.json names 3"),
        (rows(observation__state=lambda old: [*old[:4], None, *old[5:]]), "row 5 has no value"),
        (rows(observation__state=lambda old: [[0.0, math.nan, 0.0], *old[1:]]), "row 1 holds nan"),
        (rows(action=lambda old: [[0.0, math.inf, 0.0], *old[1:]]), "row 1 holds inf"),
        (rows(action=lambda old: [[0.0, 1e9, 0.0], *old[1:]]), "elbow_flex, read in degrees, reaches 1000000000°"),
        (rows(action=lambda old: [["a", "b", "c"]] * len(old)), "the values are string, not numbers"),
        (rows(timestamp=lambda old: [1000 * t for t in old]), "rows are 33.3 s apart"),
        (rows(timestamp=lambda old: [0.0, *old[:-1]]), "time repeats"),
        (rows(episode_index=lambda old: [0] * 30 + [1] * 20 + [4] * 20), "episode 1: it has 20 rows where meta/episodes says 40"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_dataset_is_one_line(
    spoil: Callable[[Path], Any], words: str, tmp_path: Path, refused: Refused
) -> None:
    root = make(tmp_path / "arm")
    spoil(root)
    assert words in refused(root)


def test_a_folder_that_lacks_episodes(tmp_path: Path, refused: Refused) -> None:
    root = make(tmp_path / "arm", info={"total_episodes": 5})
    (root / "meta/episodes/chunk-000/file-000.parquet").unlink()
    assert "episode 3, 4 is missing: 3 of 5 are there" in refused(root)
    rows(episode_index=lambda old: [0] * 20 + [1] * 10 + [0] * 40)(root)
    assert "the rows of episode 0 lie apart" in refused(root)
    assert "meta/info.json is missing" in refused(tmp_path)
    assert "meta/info.json is missing" in refused(tmp_path / "nowhere")


def test_options_of_lerobot_without_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("rec", "import", "a.csv", "--joints", "a=b", "--out", tmp_path / "a.mcap") == 2
    assert "add --from lerobot" in capsys.readouterr().err


@given(
    low=st.integers(-5000, 5000),
    span=st.integers(1, 8000),
    turned=st.booleans(),
    unit=st.sampled_from(["degrees", "normalised", "percent"]),
    share=st.floats(0.0, 1.0),
)
def test_counts_survive_what_lerobot_makes_of_them(low: int, span: int, turned: bool, unit: Unit, share: float) -> None:
    entry = {"range_min": low, "range_max": low + span, "drive_mode": int(turned)}
    counts = np.array([low, round(low + share * span), low + span], float)
    scale = joint_scale(unit, MotorRange(low, low + span, turned), "so101_follower")
    assert scale is not None
    angle = scale(written(counts, entry, unit))
    np.testing.assert_allclose(angle, angles(counts, entry), rtol=1 / 4000, atol=1e-9)
    back = angle * TURN / (2 * math.pi) + low + span / 2
    np.testing.assert_allclose(back, counts, atol=1e-6 * span if unit != "degrees" else span / 8000)
    assert (np.diff(angle) >= 0).all(), "angles count as the servo counts, whatever its drive mode"
