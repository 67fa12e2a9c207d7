"""Files that are not as they should be: one line each, no traceback, no minutes, and nothing of them runs."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from plants import pendulum
from readers import READERS, SCENARIO, Reader, mutations

from openant_tools.cli import main
from openant_tools.errors import BadInput, OpenAntError
from openant_tools.model.of_run import own_model
from openant_tools.recording.tables import read_run

#: s, far beyond what any of these files takes on a busy computer
BOUND_S = 20.0


def refusal(read: Any, path: Path) -> str:
    began = time.monotonic()
    with pytest.raises(BadInput) as caught:
        read(path)
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 1500
    assert path.name in line or path.stem in line
    assert time.monotonic() - began < BOUND_S
    return line


@pytest.mark.parametrize("kind", READERS)
def test_mutations_of_each_file_are_read_or_refused(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The first of those of which benchmarks/fuzz_readers.py tries fifty thousand."""
    reader = READERS[kind]
    reader.make(tmp_path)
    path = tmp_path / reader.name
    good = path.read_bytes()
    reader.read(path)
    caplog.set_level(logging.CRITICAL)
    for data in itertools.islice(mutations(good, 1), reader.tries):
        path.write_bytes(data)
        # The operating system's own words are printed in a line, too.
        with contextlib.suppress(OpenAntError, OSError):
            reader.read(path)


@pytest.fixture
def written(kind: str, tmp_path: Path) -> tuple[Reader, Path, str]:
    """A reader, a folder with a good file of its kind, and what stands in that."""
    READERS[kind].make(tmp_path)
    return READERS[kind], tmp_path, (tmp_path / READERS[kind].name).read_text()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.parametrize("kind", [kind for kind, reader in READERS.items() if reader.name.endswith(".json")])
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_json_of_another_structure_is_read_or_refused(
    kind: str, written: tuple[Reader, Path, str], data: st.DataObject
) -> None:
    reader, folder, good = written
    content = json.loads(good)
    place: Any = content
    while True:  # somewhere in it stands something else
        keys = sorted(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        inner = place[key]
        if isinstance(inner, dict | list) and inner and data.draw(st.booleans()):
            place = inner
            continue
        place[key] = data.draw(JSON)
        break
    (folder / reader.name).write_text(json.dumps(content))
    try:
        reader.read(folder / reader.name)
    except OpenAntError:
        pass


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("facts of a table", '{"joints": ["hinge"], "supply_v": %s}' % ("9" * 400)),
        ("facts of a table", '{"joints": ["hinge"], "notes": %s}' % ("[" * 100_000)),
        ("diagnosis", "[" * 100_000),
        ("diagnosis", '{"a":' * 100_000),
        ("robot.toml", f"id = {'9' * 400}"),
        ("robot.toml", f"id = {'[' * 100_000}"),
        ("scenario", f"seed = {'9' * 5000}"),
        ("scenario", f"seed = {'[' * 100_000}"),
        ("scenario", f"{SCENARIO}\n[bus.{'.'.join('a' * 500)}]"),
        ("plan", f"schema = {'{a=' * 20_000}"),
        ("table as CSV", "t," + "x" * 100_000 + "\n0,1\n"),
        ("table as CSV", "t," + ",".join(f"c{k}" for k in range(100_000)) + "\n"),
        ("table as CSV", '"' + "t" * 200_000),
        ("MJCF", "<mujoco><worldbody>" + "<body>" * 100_000),
        ("MJCF", "<mujoco><worldbody>" + "<geom size='1'/>" * 60_000 + "</worldbody></mujoco>"),
        ("MJCF", "<mujoco><worldbody><replicate count='99'><replicate count='99'/></replicate></worldbody></mujoco>"),
        ("MJCF", "<mujoco><asset><hfield name='h' nrow='99999' ncol='99999' size='1 1 1 1'/></asset></mujoco>"),
        ("MJCF", "<mujoco><include file='model.xml'/></mujoco>"),
        ("MJCF", "<!DOCTYPE m [<!ENTITY a 'ha'><!ENTITY b '&a;&a;&a;'>]><mujoco model='&b;'/>"),
    ],
)  # fmt: skip
def test_files_of_absurd_size_take_one_line(kind: str, text: str, tmp_path: Path) -> None:
    reader = READERS[kind]
    reader.make(tmp_path)
    (tmp_path / reader.name).write_text(text)
    refusal(reader.read, tmp_path / reader.name)


@pytest.mark.parametrize(
    "kind", [kind for kind, reader in READERS.items() if reader.name.endswith((".toml", ".json", ".csv"))]
)
def test_text_of_a_windows_editor(kind: str, tmp_path: Path) -> None:
    reader = READERS[kind]
    reader.make(tmp_path)
    path = tmp_path / reader.name
    text = path.read_text()
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert reader.read(path) is not None, "a byte order mark says nothing new"
    path.write_bytes(text.encode("utf-16"))
    if kind == "finding":
        assert reader.read(path) is None, "a finding that cannot be read counts as none"
    else:
        assert "UTF-16" in refusal(reader.read, path)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("encoding", ["", "jsonschema", "protobuf"])
def test_a_legal_mcap_of_other_software_is_none_of_ours(compression: Any, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start(profile="ros2", library="theirs")
        schema = writer.register_schema("theirs/Twist", encoding, b"\x07 what they like") if encoding else 0
        channel = writer.register_channel("/theirs", "json", schema)
        writer.add_attachment(1, 1, "photo.jpg", "image/jpeg", b"\xff\xd8" * 100)
        writer.add_metadata("theirs", {"a": "b"})
        for k in range(20):
            writer.add_message(channel, k, b'{"x": 1}', k)
        writer.finish()
    assert "holds no recording of ours" in refusal(read_run, path)


def test_a_recording_whose_chunk_blows_up_loses_that_chunk(tmp_path: Path) -> None:
    import zstandard

    reader = READERS["recording"]
    reader.make(tmp_path)
    good = (tmp_path / reader.name).read_bytes()
    bomb = zstandard.compress(b"\0" * 300_000_000, 19)
    # A chunk that says it is small, and unpacks to 300 MB: times, size, checksum, compression, records.
    for says in (1000, 300_000_000, 2**62):
        body = b"".join(
            (
                bytes(16),
                says.to_bytes(8, "little"),
                bytes(4),
                (4).to_bytes(4, "little"),
                b"zstd",
                len(bomb).to_bytes(8, "little"),
                bomb,
            )
        )
        spoilt = good[:8] + b"\x06" + len(body).to_bytes(8, "little") + body + good[8:]
        (tmp_path / reader.name).write_bytes(spoilt)
        assert len(read_run(tmp_path / reader.name).t) == 12, "all else is there"


@pytest.mark.parametrize(
    "column",
    [
        pa.array([[1.0], [2.0]]), pa.array([{"a": 1}, {"a": 2}]), pa.array([b"a", b"b"]), pa.array([0, 1], pa.timestamp("ns")),
        pa.array(["1", "x"]).dictionary_encode(), pa.array([0, 1], pa.duration("s")), pa.array([0, 1], pa.time32("s")),
    ],
    ids=str,
)  # fmt: skip
def test_columns_of_odd_types_are_named(column: Any, tmp_path: Path) -> None:
    for name in ("t", "pos.hinge"):
        table = {
            "t": pa.array([0.0, 0.1]),
            "cmd.hinge": pa.array([0.0, 0.1]),
            "pos.hinge": pa.array([0.0, 0.1]),
            name: column,
        }
        pq.write_table(pa.table(table), tmp_path / "run.parquet")
        assert name in refusal(read_run, tmp_path / "run.parquet")
    kept = {
        "t": pa.array([0.0, 0.1]),
        "cmd.hinge": pa.array([0.0, 0.1]),
        "pos.hinge": pa.array([0.0, 0.1]),
        "theirs": column,
    }
    pq.write_table(pa.table(kept), tmp_path / "run.parquet")
    assert len(read_run(tmp_path / "run.parquet").columns["theirs"]) == 2, "what is not ours is kept"


def test_a_parquet_file_that_blows_up_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("openant_tools.recording.tables.LARGEST_TABLE", 8_000_000)  # or this takes seconds to make
    pq.write_table(
        pa.table({"t": pa.DictionaryArray.from_arrays(np.zeros(9_000_000, np.int8), ["x"])}), tmp_path / "run.parquet"
    )
    assert (tmp_path / "run.parquet").stat().st_size < 100_000
    assert "9000000 rows" in refusal(read_run, tmp_path / "run.parquet")


def test_paths_in_a_run_are_followed_nearby_and_elsewhere_by_word_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, elsewhere = tmp_path / "a" / "ant", tmp_path / "b" / "their.xml"
    runs = robot / "recordings" / "today" / "run1"
    runs.mkdir(parents=True)
    elsewhere.parent.mkdir()
    (robot / "robot.toml").write_text("")
    for place in (runs / "own.xml", runs.parent / "beside.xml", robot / "calibrated.xml", elsewhere):
        place.write_text(pendulum())
    (runs / "link.xml").symlink_to(elsewhere)
    READERS["table as CSV"].make(runs)

    def named(model: str) -> Path | None:
        facts = json.loads((runs / "run.json").read_text()) | {"model": model}
        (runs / "run.json").write_text(json.dumps(facts))
        return own_model(read_run(runs / "run.csv", need=()))

    for near in ("own.xml", "../beside.xml", "../../../calibrated.xml"):
        assert named(near) == (runs / near).resolve()  # one file is one model, however runs name it
    for far in (str(elsewhere), "link.xml", os.path.relpath(elsewhere, runs)):
        caplog.clear()
        assert named(far) is None
        assert "is not followed → add --trust-paths" in caplog.text
    monkeypatch.setenv("OPENANT_TRUST_PATHS", "1")
    for far in (str(elsewhere), "link.xml"):
        assert named(far) == elsewhere.resolve()


def test_a_model_names_files_as_mujoco_follows_them_but_for_absolute_ones_and_links_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model, parts = tmp_path / "a" / "model" / "model.xml", tmp_path / "parts" / "options.xml"
    model.parent.mkdir(parents=True)
    parts.parent.mkdir()
    parts.write_text("<mujoco><option timestep='0.004'/></mujoco>")
    (model.parent / "link.xml").symlink_to(parts)
    read = READERS["MJCF"].read

    def include(file: object) -> None:
        model.write_text(pendulum().replace("<compiler", f"<include file='{file}'/><compiler", 1))

    include("../../parts/options.xml")
    read(model)
    for far in (parts, "link.xml"):
        include(far)
        assert "lies elsewhere and is not followed" in refusal(read, model)
    with pytest.raises(SystemExit) as ended:
        main(["gap", "measure", str(tmp_path / "none.csv"), "--model", str(model)])
    assert ended.value.code == 2
    monkeypatch.setenv("OPENANT_TRUST_PATHS", "1")
    read(model)


def test_every_command_that_reads_such_files_can_be_told_to_trust_them() -> None:
    import click

    from openant_tools.cli import COMMANDS, openant

    def leaves(command: click.Command, name: str) -> list[tuple[str, click.Command]]:
        if not isinstance(command, click.Group):
            return [(name, command)]
        found = []
        for one in command.list_commands(click.Context(command)):
            inner = command.get_command(click.Context(command), one)
            assert inner is not None
            found += leaves(inner, f"{name} {one}")
        return found

    context = click.Context(openant)
    for name in COMMANDS:
        command = openant.get_command(context, name)
        assert command is not None
        for words, leaf in leaves(command, name):
            options = {option for parameter in leaf.params for option in parameter.opts}
            if options & {"--model", "--robot", "runs"}:
                assert "--trust-paths" in options, words


def test_a_checkpoint_without_what_belongs_into_it_is_one_line(tmp_path: Path) -> None:
    runs = pytest.importorskip("openant_agents.runs")
    READERS["checkpoint"].make(tmp_path)
    checkpoint = runs.load_checkpoint(tmp_path)
    with (
        pytest.raises(BadInput, match=r"the checkpoint is not as its run\.json and this program have it"),
        runs.making_sense(tmp_path),
    ):
        checkpoint["average"]


def test_the_table_names_a_reader_of_ours_each() -> None:
    assert all(isinstance(reader, Reader) for reader in READERS.values())
    assert len(READERS) >= 19
