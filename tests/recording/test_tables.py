"""Run tables: a builder brings logs of any software, some of them wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from places import SHARED

from openant_tools.errors import BadInput
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import find_run, read_run, write_table

REALDATA = SHARED / "realdata"


def a_run(rows: int = 50, **columns: Any) -> Run:
    t = 100.0 + 0.02 * np.arange(rows)
    sway = 0.3 * np.sin(t)
    return Run(
        name="sway",
        facts=Facts(joints=("hip", "knee"), motors={"hip": "XC430-W240-T"}, setup="stand"),
        t=t,
        columns={"cmd.hip": sway, "pos.hip": sway, "cmd.knee": sway, "pos.knee": sway} | columns,
    )


def written(folder: Path, suffix: str = ".csv", **columns: Any) -> Path:
    """A table with these columns added or replaced, written without any check of ours."""
    run = a_run(**columns)
    path = folder / f"sway{suffix}"
    write_table(run, path)
    return path


def refusal(path: Path, **options: Any) -> str:
    with pytest.raises(BadInput) as refused:
        read_run(path, **options)
    line = str(refused.value)
    assert "\n" not in line
    assert refused.value.exit_code == 2
    assert refused.value.remedy
    return line


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_comes_back_as_it_was_written(tmp_path: Path, suffix: str) -> None:
    gaps = np.where(np.arange(50) % 7 == 3, np.nan, 0.1)
    words = np.array(["timeout" if k % 7 == 3 else "" for k in range(50)], dtype=object)
    notes = np.array([f"step {k}, slowly" for k in range(50)], dtype=object)
    run = a_run(**{"vel.knee": gaps, "err.knee": words, "gyro.x": gaps, "trial": np.arange(50.0), "said": notes})
    write_table(run, tmp_path / f"sway{suffix}")
    back = read_run(tmp_path / f"sway{suffix}")
    assert back.name == "sway"
    assert back.facts == run.facts
    np.testing.assert_array_equal(back.t, run.t)
    assert set(back.columns) == set(run.columns)
    for name, values in run.columns.items():
        np.testing.assert_array_equal(back.columns[name], values)
    assert {file.name for file in tmp_path.iterdir()} == {"sway.json", f"sway{suffix}"}


samples = hnp.arrays(float, 6, elements=st.one_of(st.just(np.nan), st.floats(-20.0, 20.0)))


@settings(max_examples=50)
@given(
    pos=samples,
    words=st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\r\n\0")), min_size=6, max_size=6),
)
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_any_values_survive_the_round_trip(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, pos: Any, words: list[str]
) -> None:
    path = tmp_path_factory.mktemp("run") / f"r{suffix}"
    errors = np.array([word.strip() for word in words], dtype=object)
    write_table(Run("r", Facts(joints=("j",)), np.arange(6.0), {"pos.j": pos, "err.j": errors}), path)
    back = read_run(path, need=())
    np.testing.assert_array_equal(back.columns["pos.j"], pos)
    assert back.columns["err.j"].tolist() == errors.tolist()


def test_a_missing_sample_is_empty_in_csv_and_nan_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("t,cmd.a,pos.a,err.a\n0,0.1,,timeout\n0.1,0.2,0.15,\n")
    run = read_run(path)
    assert np.isnan(run.columns["pos.a"][0])
    assert run.columns["err.a"].tolist() == ["timeout", ""]
    write_table(run, path)
    assert path.read_text().splitlines()[1] == "0,0.1,,timeout"


def test_without_facts_the_joints_are_those_with_a_position(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("t,cmd.b,cmd.a,pos.b,pos.a\n0,0,0,0,0\n1,0,0,0,0\n")
    assert read_run(path).joints == ("b", "a")


def test_a_run_is_found_without_its_suffix_and_by_its_facts(tmp_path: Path) -> None:
    path = written(tmp_path, ".parquet")
    assert read_run(tmp_path / "sway").path == path
    assert read_run(tmp_path / "sway.json").path == path


def test_the_model_is_found_beside_the_table_wherever_it_is_written(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "ant.xml").write_text("<mujoco/>")
    source = tmp_path / "a" / "r.csv"
    source.write_text("t,cmd.j,pos.j\n0,0,0\n1,0,0\n")
    source.with_suffix(".json").write_text('{"joints": ["j"], "model": "ant.xml"}')
    write_table(read_run(source), tmp_path / "b" / "r.parquet")
    model = read_run(tmp_path / "b" / "r.parquet").model_path
    assert model is not None
    assert model.read_text() == "<mujoco/>"


def test_keys_that_are_not_ours_stay(tmp_path: Path) -> None:
    path = written(tmp_path)
    facts = json.loads(path.with_suffix(".json").read_text()) | {
        "baud": 1000000,
        "chain": [["hip", "knee"]],
        "mood": "good",
    }
    path.with_suffix(".json").write_text(json.dumps(facts))
    write_table(read_run(path), path)
    assert json.loads(path.with_suffix(".json").read_text()) == facts


def test_flags_may_be_words(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("t,cmd.j,pos.j,torque.j\n0,0,0,True\n1,0,0,False\n")
    assert read_run(path).columns["torque.j"].tolist() == [1.0, 0.0]


def test_an_index_and_a_comma_at_each_end_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text(",t,cmd.j,pos.j,\n0,0.0,1,1,\n1,0.1,1,1,\n")
    assert set(read_run(path).columns) == {"cmd.j", "pos.j"}


def test_a_log_of_the_bus_needs_no_positions(tmp_path: Path) -> None:
    path = tmp_path / "bus.csv"
    path.write_text("t,ok.j,rtt.j\n0,1,0.001\n1,0,\n")
    assert read_run(path, need=()).joints == ("j",)
    assert "there is no cmd column" in refusal(path)


UNITS = [
    ("pos.knee", 300.0, "300 rad cannot be", "degrees"),
    ("cmd.knee", -90.0, "-90 rad cannot be", "degrees"),
    ("vel.knee", 265.0, "265 rad/s cannot be", "rpm"),
    ("cur.knee", 540.0, "540 A cannot be", "mA"),
    ("pwm.knee", 50.0, "50 cannot be", "percent"),
    ("load.knee", -400.0, "-400 cannot be", "fractions"),
    ("torque.knee", 0.8, "0.8 cannot be", "enabled"),
    ("volt.knee", 121.0, "121 V cannot be", "0.1 V"),
    ("temp.knee", 400.0, "400 °C cannot be", "°C"),
    ("ok.knee", 2.0, "2 cannot be", "1 or 0"),
    ("rtt.knee", 20.0, "20 s cannot be", "ms"),
    ("tick.knee", 40000.0, "40000 ms cannot be", "32767"),
    ("gyro.z", 1998.0, "1998 rad/s cannot be", "deg/s"),
    ("acc.z", 2048.0, "2048 m/s² cannot be", "counts"),
    ("base.x", 750.0, "750 m cannot be", "mm"),
    ("pos.knee", np.inf, "inf is no measurement", "empty"),
]


@pytest.mark.parametrize(("column", "value", "what", "remedy"), UNITS)
def test_a_unit_that_cannot_be(tmp_path: Path, column: str, value: float, what: str, remedy: str) -> None:
    values = np.where(np.arange(50) == 16, value, 0.0)
    path = written(tmp_path, ".parquet", **{column: values})
    line = refusal(path)
    assert what in line
    assert remedy in line
    assert f"{path}, column {column}, row 17 (t = 100.32 s)" in line


def test_a_gravity_of_one(tmp_path: Path) -> None:
    flat, up = np.zeros(50), np.ones(50)
    assert "g × 9.81" in refusal(written(tmp_path, **{"acc.x": flat, "acc.y": flat, "acc.z": up}))


def test_a_quaternion_that_is_none(tmp_path: Path) -> None:
    zero = np.zeros(50)
    line = refusal(written(tmp_path, **{f"base.{axis}": zero for axis in ("qw", "qx", "qy", "qz")}))
    assert "norm 0" in line


def test_a_command_time_of_another_clock(tmp_path: Path) -> None:
    assert "not on the clock of t" in refusal(written(tmp_path, cmd_t=1.7e9 + np.arange(50.0)))


def test_time_in_milliseconds(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("t,cmd.j,pos.j\n" + "".join(f"{20 * k},0,0\n" for k in range(9)))
    assert "rows are 20 s apart" in refusal(path)


@pytest.mark.parametrize(
    ("times", "what"),
    [
        ([0, 0.1, 0.05, 0.2], "time runs backwards: t = 0.05 s after 0.1 s"),
        ([0, 0.1, 0.1, 0.2], "time repeats: t = 0.1 s after 0.1 s"),
        ([0, 0.1, "", 0.2], "t is nan"),
    ],
)
def test_time_that_does_not_run_forward(tmp_path: Path, times: list[object], what: str) -> None:
    path = tmp_path / "r.csv"
    path.write_text("t,cmd.j,pos.j\n" + "".join(f"{t},0,0\n" for t in times))
    line = refusal(path)
    assert what in line
    assert "row 3" in line


def facts_beside(path: Path, text: str) -> Path:
    path.with_suffix(".json").write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("{", "this is not JSON"),
        ("[1]", "JSON object"),
        ("{}", "`joints` is missing"),
        ('{"joints": "hip"}', "not a list of names"),
        ('{"joints": ["hip", "hip"]}', "hip twice"),
        ('{"joints": ["hip"]}', "no such joint: knee"),
        ('{"joints": ["hip", "knee", "ankle"]}', "joint ankle has no column"),
        ('{"joints": ["hip", "knee"], "supply_v": "12 V"}', "`supply_v` is"),
        ('{"joints": ["hip", "knee"], "motors": ["XL430"]}', "`motors` is"),
        (
            '{"joints": ["hip", "knee"], "registers": {"hip": {"position_p_gain": "low"}}}',
            "`registers.hip.position_p_gain`",
        ),
        ('{"joints": ["hip", "knee"], "model": 3}', "`model` is 3"),
    ],
)
def test_facts_that_cannot_be(tmp_path: Path, text: str, what: str) -> None:
    line = refusal(facts_beside(written(tmp_path), text))
    assert what in line
    assert "sway." in line


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "the run is empty"),
        ("t,cmd.j,pos.j\n", "the run is empty: no rows"),
        ("time,cmd.j,pos.j\n0,0,0\n", "there is no column t"),
        ("t,a,b\n0,0,0\n", "there is no column of a joint"),
        ("t,cmd.j,position.j\n0,0,0\n1,0,0\n", "there is no pos column"),
        ("t,cmd.j,pos.j\n0,0,\n1,0,\n", "pos has no valid sample"),
        ("t,pos.j,pos.j\n0,0,0\n", "column pos.j is there twice"),
        ('t,"cmd.j\n0,0\n1,0\n', "close the quotes of the header"),
        ("t,cmd.j,pos.j\n0,0,1_0\n", "'1_0' is not a number"),
        ("t,cmd.j,pos.j,gyro.w\n0,0,0,0\n", "no such column: gyro.w"),
        ("t,cmd.j,pos.j\n0,0,0\n1,0\n", "a row has 2 values where the header names 3"),
        ("t,cmd.j,pos.j\n0,0,0\n1,0,fast\n", "column pos.j, row 2: 'fast' is not a number"),
        ("t;cmd.j;pos.j\n0;0;0\n", "not separated by commas"),
        ('t,cmd.j,pos.j\n0,0,"0,25"\n', "with a point, not a comma"),
        ("t,cmd.j,pos.j\nnow,0,0\n", "column t, row 1: 'now' is not a number"),
    ],
)
def test_a_csv_that_cannot_be(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "r.csv"
    path.write_text(text)
    line = refusal(path)
    assert what in line
    assert str(path) in line


def test_a_typing_error_in_a_column_is_named(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("t,cmd.knee_fl,pos.knee_fl,vel.knee_fr\n0,0,0,0\n")
    assert "did you mean knee_fl?" in refusal(path)


@pytest.mark.parametrize("keep", [0, 4, 200, -1])
def test_a_parquet_file_that_was_cut(tmp_path: Path, keep: int) -> None:
    path = written(tmp_path, ".parquet")
    path.write_bytes(path.read_bytes()[:keep])
    assert "not a whole parquet file" in refusal(path)


def test_a_csv_that_is_not_text(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_bytes(b"t,pos.j\n\xff\xfe\x00\x01,1\n")
    assert "is no UTF-8 text" in refusal(path)


def test_what_is_not_a_run(tmp_path: Path) -> None:
    (tmp_path / "ant.xml").write_text("<mujoco/>")
    assert "no such file" in refusal(tmp_path / "nowhere.parquet")
    assert "this is not a run" in refusal(tmp_path / "ant.xml")
    written(tmp_path)
    assert "name one of sway.csv" in refusal(tmp_path)


def test_text_in_a_number_column_of_a_parquet_file(tmp_path: Path) -> None:
    pq.write_table(
        pa.table({"t": [0.0, 1.0], "cmd.j": [0.0, 0.0], "pos.j": ["0.1", "0.2 rad"]}), tmp_path / "r.parquet"
    )
    assert "column pos.j, row 2: '0.2 rad' is not a number" in refusal(tmp_path / "r.parquet")


mutations = st.lists(
    st.tuples(
        st.sampled_from(["change", "drop", "insert", "cut"]), st.floats(0.0, 0.999), st.binary(min_size=1, max_size=9)
    ),
    min_size=1,
    max_size=4,
)


@settings(max_examples=80)
@given(mutations=mutations)
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".json"])
def test_a_damaged_table_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, mutations: list[tuple[str, float, bytes]]
) -> None:
    folder = tmp_path_factory.mktemp("run")
    table = written(folder, ".csv" if suffix == ".json" else suffix)
    damaged = table.with_suffix(suffix)
    data = bytearray(damaged.read_bytes())
    for kind, share, payload in mutations:
        at = int(share * len(data))
        if kind == "change":
            data[at : at + len(payload)] = payload
        elif kind == "drop":
            del data[at : at + len(payload)]
        elif kind == "insert":
            data[at:at] = payload
        else:
            del data[at:]
    damaged.write_bytes(data)
    try:
        read_run(table)
    except BadInput as refused:
        line = str(refused)
        assert line.startswith(str(folder))
        assert line.isprintable()


def test_a_full_disk_leaves_what_stood_there_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, ".parquet")
    before = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left") as failed:
        write_table(a_run(rows=90), path)
    assert str(failed.value.filename).startswith(str(tmp_path / "sway."))
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["sway.json", "sway.parquet"]


@pytest.mark.skipif(not REALDATA.is_dir(), reason="the shared recordings are not here")
def test_real_recordings_are_read_whole() -> None:
    paths = sorted(REALDATA.glob("*/*.parquet"))
    assert paths
    for path in paths:
        run = read_run(path)
        assert run.duration_s > 5.0
        assert np.isfinite(run.signal("pos")).all()
        assert run.facts.registers[run.joints[0]]["position_p_gain"] > 0
        assert run.model_path is None or run.model_path.exists()


def test_a_folder_is_told_which_runs_it_has(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"a folder, not a run$"):
        find_run(tmp_path)
    (tmp_path / "learning_curve.csv").write_text("step,seconds,average_reward_m_s\n")
    (tmp_path / "recordings").mkdir()
    written(tmp_path)
    (tmp_path / "recordings" / "walk.mcap").touch()
    with pytest.raises(BadInput, match=r"→ name one of sway.csv, recordings/walk.mcap$"):
        find_run(tmp_path)
