"""Reading a recording back, whole or torn: every whole record before the damage, in SI."""

from __future__ import annotations

import json
import logging
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import IO, Any

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.files import parse_json, reading
from openant_tools.recording.facts import facts_from_json
from openant_tools.recording.pictures import PICTURE
from openant_tools.recording.run import Array, Facts, Run
from openant_tools.recording.telemetry import IMU_FIELDS, POSE_FIELDS, ServoChannel, message_classes
from openant_tools.recording.writer import METADATA, SCHEMA

__all__ = ["RecordScan", "Recording", "Samples", "read_recording", "recording_content"]

_log = logging.getLogger(__name__)

#: bytes of a chunk; those of ours have 64 KiB, of other software a few MiB
LARGEST_CHUNK = 64 * 2**20
#: bytes of all chunks of a file, unpacked: an hour of an Open Ant is 200 MB
LARGEST_CONTENT = 4 * 2**30
#: of the MCAP specification: opcode and length of a record; channel, sequence and the two times of a message
_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")


@dataclass(frozen=True)
class Samples:
    """Signals on a time axis of their own: t (n,) s, strictly increasing, and columns (n,), NaN where missing."""

    t: Array
    columns: Mapping[str, Array]


@dataclass(frozen=True)
class Recording:
    """Everything that a recording holds.

    Attributes:
        run: the rows of the bus, in SI, with the body's samples at their nearest rows (see `merge_nearest`).
        imu, pose: the body's samples at their own times and rates.
        pose_known: (n,) s, when each pose of the camera was there to be used: the row before which it came.
        pictures: when the camera's were taken, and their `bytes`; `read_pictures` has them themselves.
        events: what happened, each with `t` (s) and `kind`.
        channels: how counts became SI.
        registers: joint → register → counts, as dumped at the start.
        config: the robot's configuration then, as text.
        started: `wall` (ISO 8601, UTC) and `clock` (s) at the same instant.
        damage: what is missing and why; None where the file is whole.
    """

    run: Run
    imu: Samples
    pose: Samples
    pose_known: Array
    pictures: Samples
    events: tuple[Mapping[str, Any], ...]
    channels: tuple[ServoChannel, ...]
    registers: Mapping[str, Mapping[str, int]]
    config: str | None
    started: Mapping[str, Any]
    damage: str | None


class RecordScan:
    """The records of an MCAP file in order, up to where it is torn.

    A chunk whose checksum fails while its frame is whole (a bad sector, a torn page) is left out and counted; a frame
    that cannot be (a cut, a zeroed tail) ends the scan.

    Attributes:
        damage: after iteration, why it ended before the end; None where the file is whole.
        lost_chunks: chunks left out.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: str | None = None
        self.lost_chunks = 0

    def __iter__(self) -> Iterator[Schema | Channel | Message | Metadata]:
        with self.path.open("rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            magic = stream.read(MAGIC_SIZE)
            if magic != MCAP0_MAGIC:
                raise BadInput(
                    "this is not a recording" if any(magic) else "the recording is empty",
                    where=self.path,
                    remedy="a recording is an MCAP file written by `openant … record`; tables are .parquet or .csv",
                )
            yield from self._records(stream, size)
        if self.lost_chunks:
            lost = f"{self.lost_chunks} chunk{'s' if self.lost_chunks > 1 else ''} with a wrong checksum left out"
            self.damage = f"{self.damage}; {lost}" if self.damage else lost

    def _records(self, stream: IO[bytes], size: int) -> Iterator[Schema | Channel | Message | Metadata]:
        unpacked = 0
        while True:
            at = stream.tell()
            frame = stream.read(9)
            opcode, length = (frame[0], int.from_bytes(frame[1:], "little")) if len(frame) == 9 else (0, 0)
            if len(frame) < 9 or opcode == 0 or length > size - at - 9:
                cut = len(frame) < 9 or opcode != 0
                self.damage = f"{'cut' if cut else 'overwritten'} after byte {at} of {size}"
                return
            if opcode == Opcode.FOOTER:
                stream.seek(length, 1)
                if stream.read(MAGIC_SIZE) != MCAP0_MAGIC:
                    self.damage = f"cut within the summary, at byte {at} of {size}"
                return
            if opcode not in (Opcode.CHUNK, Opcode.METADATA):
                stream.seek(length, 1)
                continue
            body = ReadDataStream(BytesIO(stream.read(length)))
            try:
                if opcode == Opcode.METADATA:
                    records: list[Any] = [Metadata.read(body)]
                else:
                    chunk = _unpacked(Chunk.read(body))
                    unpacked += len(chunk)
                    records = list(_inside(chunk))
            except Exception:
                # mcap, zstandard and struct each have their own errors for bytes that are not what they should be.
                self.lost_chunks += 1
                continue
            yield from records
            if unpacked > LARGEST_CONTENT:
                self.damage = f"larger than a recording can be, after byte {at} of {size}"
                return


def _unpacked(chunk: Chunk) -> bytes:
    """The records of a chunk as they were, and never more of them than a chunk may hold, however small it is packed."""
    if chunk.uncompressed_size > LARGEST_CHUNK:
        raise ValueError("a chunk that large is none of a recording's")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(chunk.uncompressed_size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
    elif chunk.compression:
        raise ValueError(f"compressed by {chunk.compression}")
    else:
        data = chunk.data
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk of another size than it says")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a wrong checksum")
    return bytes(data)


def _inside(chunk: bytes) -> Iterator[Schema | Channel | Message]:
    """The records of an uncompressed chunk. The library's own way takes 20 µs a message, this one 2."""
    at = 0
    while at < len(chunk):
        opcode, length = _FRAME.unpack_from(chunk, at)
        at += _FRAME.size
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(chunk, at)
            data = chunk[at + _MESSAGE.size : at + length]
            yield Message(channel, log_time, data, publish_time, sequence)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind: Any = Schema if opcode == Opcode.SCHEMA else Channel
            yield kind.read(ReadDataStream(BytesIO(chunk[at : at + length])))
        at += length


def read_recording(path: str | Path) -> Recording:
    """The recording at `path`. One that is torn gives every whole record before the tear, and a warning in the log.

    Raises:
        BadInput: not a recording of ours, or one torn before its first row.
    """
    path = Path(path)
    with reading(path, "this recording is not as this program writes them", "record again, or name another"):
        return _read(path)


def _read(path: Path) -> Recording:
    scan = RecordScan(path)
    content: dict[str, Any] | None = None
    kinds: dict[int, str] = {}
    classes: Mapping[str, Any] = {}
    schemas: dict[int, Schema] = {}
    cycles: list[Any] = []
    body: dict[str, list[Any]] = {"openant.Imu": [], "openant.Pose": []}
    before: list[int] = []  # rows before each pose
    events: list[Mapping[str, Any]] = []
    pictures: list[tuple[int, int]] = []
    for record in scan:
        if isinstance(record, Metadata) and record.name == METADATA:
            content = recording_content(record, path)
        elif isinstance(record, Schema):
            schemas[record.id] = record
            if record.encoding == "protobuf" and record.name.startswith("openant.") and not classes:
                classes = message_classes(record.data)
        elif isinstance(record, Channel):
            schema = schemas.get(record.schema_id)
            kinds[record.id] = "" if schema is None else schema.name
        elif isinstance(record, Message):
            kind = kinds.get(record.channel_id)
            if kind == "openant.Cycle":
                cycles.append(classes[kind].FromString(record.data))
            elif kind == "openant.Event":
                events.append(parse_json(record.data, path))
            elif kind == PICTURE:
                pictures.append((record.log_time, len(record.data)))
            elif kind in body:
                body[kind].append(classes[kind].FromString(record.data))
                if kind == "openant.Pose":
                    before.append(len(cycles))
    if content is None:
        raise BadInput(
            "this MCAP file holds no recording of ours"
            if scan.damage is None
            else "the recording was cut at its start",
            where=path,
            remedy="record again; logs of other software come in as tables (`openant rec import`)",
        )
    if not cycles:
        raise BadInput(
            "the run is empty: no rows" + (f" ({scan.damage})" if scan.damage else ""),
            where=path,
            remedy="record again",
        )
    if scan.damage:
        _log.warning(
            "%s: %s; the %d rows before it are used (`openant rec repair` makes the file whole)",
            path, scan.damage, len(cycles),
        )  # fmt: skip
    facts = facts_from_json(json.dumps(content["facts"]), str(path))
    channels = tuple(ServoChannel(**channel) for channel in content["channels"])
    run = _rows(path, facts, channels, content, cycles)
    imu, pose = (
        _samples(body[kind], fields) for kind, fields in (("openant.Imu", IMU_FIELDS), ("openant.Pose", POSE_FIELDS))
    )
    columns = dict(run.columns)
    for samples, time in ((imu, "imu_t"), (pose, "pose_t")):
        merged = merge_nearest(samples, run.t)
        if merged and content["counts"]:
            columns[time] = merged["t"]
        columns |= {name: values for name, values in merged.items() if name != "t"}
    return Recording(
        run=replace(run, columns=columns),
        imu=imu,
        pose=pose,
        pose_known=_known(before, cycles, body["openant.Pose"]),
        pictures=_pictures(pictures, int(content.get("stamp_offset_ns", 0))),
        events=tuple(events),
        channels=channels,
        registers=content["registers"],
        config=content["config"],
        started=content["started"],
        damage=scan.damage,
    )


def merge_nearest(samples: Samples, t: Array) -> dict[str, Array]:
    """Samples at the rows `t` (n,) s: each goes to the row nearest in time, if that is within a median row.

    Of several at one row the nearest stays; a row without any is NaN. Besides the columns the result has `t`, the
    time when the sample was really taken. Empty where there are no samples.
    """
    if not len(samples.t):
        return {}
    reach = float(np.median(np.diff(t))) if len(t) > 1 else np.inf
    after = np.clip(np.searchsorted(t, samples.t), 1, max(1, len(t) - 1))
    row = after - 1 + (np.abs(t[np.minimum(after, len(t) - 1)] - samples.t) < np.abs(samples.t - t[after - 1]))
    row = np.minimum(row, len(t) - 1)
    away = np.abs(t[row] - samples.t)
    # From far to near: the last one written to a row is the nearest.
    order = np.argsort(-away, kind="stable")
    order = order[away[order] <= reach]
    merged = {}
    for name, values in {"t": samples.t, **samples.columns}.items():
        column = np.full(len(t), np.nan)
        column[row[order]] = values[order]
        merged[name] = column
    return merged


def recording_content(record: Metadata, path: Path) -> dict[str, Any] | None:
    """What the metadata of a recording says; None where it is torn. BadInput: a format of another version."""
    text = record.metadata.get("content", "")
    if f"{zlib.crc32(text.encode()):08x}" != record.metadata.get("crc32"):
        return None
    content: dict[str, Any] = parse_json(text, path)
    if not isinstance(content, dict):
        raise BadInput("this is not a recording of ours", where=path, remedy="record again")
    if content.get("schema") != SCHEMA:
        raise BadInput(
            f"this recording has the format {content.get('schema')}, this program reads {SCHEMA}",
            where=path,
            remedy="update openant-tools",
        )
    return content


def _rows(
    path: Path, facts: Facts, channels: tuple[ServoChannel, ...], content: Mapping[str, Any], cycles: list[Any]
) -> Run:
    t = np.array([cycle.t for cycle in cycles])
    forward = _forward(t)
    if not forward.all():
        _log.warning("%s: %d rows whose time does not run forward are left out", path, int((~forward).sum()))
        cycles = [cycle for cycle, keep in zip(cycles, forward, strict=True) if keep]
        t = t[forward]
    columns: dict[str, NDArray[Any]] = {}
    for channel in channels:
        field = content["joint_fields"][channel.joint]
        raw, words = _servo_fields([getattr(cycle, field) for cycle in cycles])
        if words is not None:
            columns[f"err.{channel.joint}"] = words
        goal = raw.pop("goal", None)
        if goal is not None:
            columns[f"cmd.{channel.joint}"] = channel.to_si("goal", goal)
        for name, values in raw.items():
            known = name in channel.scales
            columns[f"{name}.{channel.joint}"] = channel.to_si(name, values) if known else values
        if f"ok.{channel.joint}" in columns and f"err.{channel.joint}" not in columns:
            columns[f"err.{channel.joint}"] = np.full(len(t), "", dtype=object)
    for name, field in {"cmd_t": "cmd_t", "wake": "wake", **content["extra_fields"]}.items():
        column = _column(cycles, field)
        if column is not None:
            columns[name] = column
    run = Run(name=path.stem, facts=facts, t=t, columns=columns, path=path)
    return _commands_in_force(run) if content["counts"] else run


def _servo_fields(servos: list[Any]) -> tuple[dict[str, Array], NDArray[Any] | None]:
    """Fields of one servo over all rows as numbers (NaN where unset), and its error words where there are any."""
    names = [descriptor.name for descriptor in servos[0].DESCRIPTOR.fields if descriptor.name != "err"]
    table = np.array(list(map(attrgetter(*names), servos)), dtype=float)
    # An unset field reads as zero: only zeros need the slow question whether they were set.
    for row, field in np.argwhere(table == 0.0).tolist():
        if not servos[row].HasField(names[field]):
            table[row, field] = np.nan
    raw = {name: column for name, column in zip(names, table.T, strict=True) if not np.isnan(column).all()}
    words = np.array([servo.err for servo in servos], dtype=object)
    return raw, words if words.any() else None


def _column(messages: list[Any], field: str) -> NDArray[Any] | None:
    values = [getattr(message, field) if message.HasField(field) else None for message in messages]
    if all(value is None for value in values):
        return None
    if any(isinstance(value, str) for value in values):
        return np.array(["" if value is None else value for value in values], dtype=object)
    return np.array([np.nan if value is None else value for value in values], dtype=float)


def _commands_in_force(run: Run) -> Run:
    """Repeat each command, with its `cmd_t`, through the rows in which none was sent, while torque is on (formats)."""
    columns = dict(run.columns)
    torque = run.signal("torque", default=1.0)
    sent = np.isfinite(run.signal("cmd"))
    for k, joint in enumerate(run.joints):
        command = columns.get(f"cmd.{joint}")
        if command is None:
            continue
        held = np.maximum.accumulate(np.where(sent[:, k] | (torque[:, k] == 0.0), np.arange(len(run.t)), 0))
        columns[f"cmd.{joint}"] = np.asarray(command[held])
    if "cmd_t" in columns:
        last = np.maximum.accumulate(np.where(sent.any(axis=1), np.arange(len(run.t)), 0))
        columns["cmd_t"] = np.asarray(columns["cmd_t"][last])
    return replace(run, columns=columns)


def _samples(messages: list[Any], fields: Mapping[str, str]) -> Samples:
    t = np.array([message.t for message in messages])
    forward = _forward(t)
    kept = [message for message, keep in zip(messages, forward, strict=True) if keep]
    columns = {}
    for field, name in fields.items():
        column = _column(kept, field) if kept else None
        if column is not None:
            columns[name] = column
    return Samples(t[forward], columns)


def _known(before: list[int], cycles: list[Any], poses: list[Any]) -> Array:
    """(n,) s, when the poses that `_samples` keeps were there; those after the last row never were: infinity."""
    rows = np.array([cycle.t for cycle in cycles] + [np.inf])
    known: Array = rows[np.array(before, np.intp)]
    return known[_forward(np.array([pose.t for pose in poses]))]


def _pictures(found: list[tuple[int, int]], offset_ns: int) -> Samples:
    stamps, sizes = np.array(found, np.int64).reshape(-1, 2).T
    return Samples(np.asarray((stamps - offset_ns) * 1e-9, np.float64), {"bytes": sizes.astype(float)})


def _forward(t: Array) -> NDArray[np.bool_]:
    """Which entries of `t` (n,) are later than all before them."""
    if not len(t):
        return np.zeros(0, dtype=bool)
    latest = np.maximum.accumulate(t)
    return np.concatenate([[True], t[1:] > latest[:-1]])
