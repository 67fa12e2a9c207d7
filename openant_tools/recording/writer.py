"""The append-only recording: an MCAP file that survives a kill, a power cut and a full disk.

The loop that owns the bus only puts what it saw into a queue (a microsecond). A thread encodes it, compresses chunks of
64 KiB and once a second puts all of it on the disk, so that a power cut costs at most that second and no loop ever
waits for a disk. How these choices were measured: docs/recordings.md.
"""

from __future__ import annotations

import errno
import importlib.metadata
import json
import logging
import os
import queue
import threading
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.records import Message
from mcap.writer import CompressionType, Writer

from openant_tools.errors import BadInput, OpenAntError, StorageFault
from openant_tools.numbers import number
from openant_tools.recording.facts import facts_to_json
from openant_tools.recording.pictures import PICTURE, PICTURE_TOPIC, picture_message, picture_schema
from openant_tools.recording.run import Facts
from openant_tools.recording.telemetry import AGENT_TIMES, Cycle, ServoChannel, Telemetry

__all__ = [
    "METADATA",
    "PROFILE",
    "SCHEMA",
    "Continued",
    "RecordingStopped",
    "RecordingWriter",
    "must_be_new",
    "recording_path",
]

SCHEMA = "openant.recording/1"
PROFILE = "openant"
#: name of the metadata record that holds facts, channels, registers and config
METADATA = "openant.recording"
#: bytes; larger chunks compress better and lose more at a kill
CHUNK_BYTES = 64 * 1024
#: s between two syncs to the disk
SYNC_PERIOD = 1.0

_log = logging.getLogger(__name__)


class RecordingStopped(StorageFault):
    """The disk takes no more; what was recorded before stays readable."""


def recording_path(path: str | Path) -> Path:
    """`path` with the suffix .mcap; raises BadInput for the name of a table."""
    path = Path(path)
    if path.suffix in (".parquet", ".csv", ".json"):
        raise BadInput(
            "a recording is a .mcap file",
            where=path,
            remedy=f"record to {path.with_suffix('.mcap').name}, then `openant rec export` it to {path.suffix[1:]}",
        )
    return path if path.suffix == ".mcap" else path.with_name(path.name + ".mcap")


def must_be_new(path: Path, remedy: str = "record under another name, or move that file away") -> None:
    """Raises BadInput where something stands at `path` already, be it a link to nothing."""
    if os.path.lexists(path):
        what = "there is a recording already" if path.exists() else "this is a link to nothing"
        raise BadInput(what, where=path, remedy=remedy)


@dataclass(frozen=True)
class Continued:
    """A recording that is gone on with; see `resume.continuation`.

    Attributes:
        metadata: its metadata record, as it stands. messages: (topic, ns, bytes) of all that is whole.
        shift_s: added to every time to come, so that the recording has one time axis.
        last_s: time of its last row.
        stamp_offset_ns: what its time stamps lie after the clock of its rows; 0 where nobody wrote it down.
    """

    metadata: Mapping[str, str]
    messages: Sequence[tuple[str, int, bytes]]
    shift_s: float
    last_s: float
    stamp_offset_ns: int = 0


class RecordingWriter:
    """Records one run; a context manager. The file appears at once and only ever grows.

    Args:
        path: the file; `.mcap` is added where it is missing.
        facts: what is known about the run; its joints are those of `channels`, in order.
        channels: the servos.
        registers: joint → register → counts, a dump of what was in force.
        config: the robot's configuration as text (robot.toml).
        clock: the clock of `t`, for events that bring no time of their own.
        overwrite: whether a file that stands there may be replaced.
        telemetry: the schema, where it is not the plain one of `channels`.
        continued: the recording at `path` so far: it is gone on with, and `facts`, `registers` and `config` are its own.

    Raises:
        BadInput: there is such a file already, or there can be none.
        RecordingStopped: the disk is full; from any call, once, with what is kept.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        facts: Facts,
        channels: Sequence[ServoChannel],
        registers: Mapping[str, Mapping[str, int]] | None = None,
        config: str | None = None,
        clock: Callable[[], float] = time.monotonic,
        overwrite: bool = False,
        telemetry: Telemetry | None = None,
        continued: Continued | None = None,
    ) -> None:
        joints = tuple(channel.joint for channel in channels)
        if facts.joints != joints:
            raise ValueError(f"the facts name {facts.joints}, the channels {joints}")
        self.path = recording_path(path)
        self.cycles = 0
        self._clock = clock
        self._telemetry = telemetry or Telemetry(channels, extra=AGENT_TIMES)
        self._queue: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
        self._stopped: OpenAntError | None = None
        self._reported = False
        self._closed = False
        #: on the disk: time of the last row, and how many
        self._kept_t: float | None = None
        self._kept = 0
        self._shift = 0.0 if continued is None else continued.shift_s
        #: ns that are added to a time on the clock of `t` for the file's own time stamps: the wall clock at the start
        self._stamp_offset = 0 if continued is None else continued.stamp_offset_ns
        # What is gone on with is copied beside itself, and replaced when all of it is on the disk.
        place = self.path if continued is None else self.path.with_name(f".{self.path.name}.resumed")
        try:
            self._stream = _AppendOnly(place, overwrite or continued is not None)
        except OSError as error:
            if error.errno in _DISK_ERRORS:
                raise self._stop(error) from error
            raise BadInput(
                f"nothing can be recorded here: {error.strerror}", where=self.path, remedy="name another file or folder"
            ) from error
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        try:
            facts = _completed(facts, self._telemetry, registers or {})
            self._begin(facts, registers or {}, config, continued)
            if continued is not None:
                self._take_over(continued)
                os.replace(place, self.path)
                _sync_folder(self.path.parent)
        except BaseException as error:
            self._stream.discard()
            if isinstance(error, OSError):
                raise self._stop(error) from error
            raise
        self._thread = threading.Thread(target=self._run, name=f"recording {self.path.name}", daemon=True)
        self._thread.start()

    def cycle(self, cycle: Cycle) -> None:
        """Record one turn of the bus loop. Costs a microsecond: encoding and disk are another thread's."""
        if self._shift:
            cmd_t, obs_t, act_t = (
                None if at is None else at + self._shift for at in (cycle.cmd_t, cycle.obs_t, cycle.act_t)
            )
            cycle = replace(cycle, t=cycle.t + self._shift, cmd_t=cmd_t, obs_t=obs_t, act_t=act_t)
        self._put((_CYCLE, cycle.t, cycle))
        self.cycles += 1

    def imu(self, t: float, gyro: Sequence[float], acc: Sequence[float]) -> None:
        """Record one sample of the IMU at its own time: gyro (3,) rad/s, specific force (3,) m/s², body frame."""
        t += self._shift
        self._put((_IMU, t, (tuple(gyro), tuple(acc))))

    def pose(
        self,
        t: float,
        *,
        position: Sequence[float] | None = None,
        yaw: float | None = None,
        quaternion: Sequence[float] | None = None,
    ) -> None:
        """Record where the body is, at its own time: position (3,) m, yaw in rad, quaternion (4,) w x y z."""
        values: dict[str, float] = {}
        if position is not None:
            values |= zip(("x", "y", "z"), map(float, position), strict=True)
        if yaw is not None:
            values["yaw"] = float(yaw)
        if quaternion is not None:
            values |= zip(("qw", "qx", "qy", "qz"), map(float, quaternion), strict=True)
        self.pose_fields(t, values)

    def pose_fields(self, t: float, values: Mapping[str, float]) -> None:
        """Record where the body is by the names of formats: x, y, z, yaw, qw, qx, qy, qz; NaN is missing."""
        self._put((_POSE, t + self._shift, values))

    def picture(self, t: float, jpeg: bytes) -> None:
        """Record a picture (JPEG) taken at `t`, s."""
        self._put((_PICTURE, t + self._shift, jpeg))

    def event(self, kind: str, **payload: Any) -> None:
        """Record that something happened now, such as a question answered or a write to a register; kept as JSON."""
        now = self._clock() + self._shift
        self._put((_EVENT, now, json.dumps({"t": now, "kind": kind} | payload, default=str).encode()))

    def row(self, t: float, message: bytes) -> None:
        """Record a row that is encoded already (an imported table)."""
        self._put((_ROW, t, message))

    def sync(self) -> None:
        """Return when all that was recorded so far is on the disk."""
        done = threading.Event()
        self._put((_SYNC, 0.0, done))
        done.wait()
        self._raise_if_stopped()

    def close(self) -> None:
        """Write the summary and close the file; raises RecordingStopped unless an earlier call did."""
        if self._closed:
            return
        self._closed = True
        self._queue.put((_CLOSE, 0.0, None))
        self._thread.join()
        if not self._reported:
            self._raise_if_stopped()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except RecordingStopped as stopped:
            if error is None:
                raise
            _log.warning("%s", stopped)  # the first error is the one to tell

    def _put(self, item: tuple[Any, ...]) -> None:
        if self._closed:
            raise ValueError(f"{self.path}: the recording is closed")
        if self._stopped is not None:
            self._raise_if_stopped()
        self._queue.put(item)

    def _raise_if_stopped(self) -> None:
        if self._stopped is not None:
            self._reported = True
            raise self._stopped

    def _begin(
        self,
        facts: Facts,
        registers: Mapping[str, Mapping[str, int]],
        config: str | None,
        continued: Continued | None = None,
    ) -> None:
        self._writer.start(profile=PROFILE, library=f"openant-tools {importlib.metadata.version('openant-tools')}")
        wall, clock = datetime.now(UTC), self._clock()
        if continued is None:
            self._stamp_offset = time_ns(wall) - round(clock * 1e9)
        content = json.dumps(
            self._telemetry.as_json()
            | {
                "schema": SCHEMA,
                "facts": json.loads(facts_to_json(facts)),
                "registers": {joint: dict(table) for joint, table in registers.items()},
                "config": config,
                "started": {"wall": wall.isoformat(timespec="milliseconds"), "clock": clock},
                "stamp_offset_ns": self._stamp_offset,
            },
            ensure_ascii=False,
        )
        # Metadata records carry no checksum of their own, and a zeroed tail may begin in the middle of this one.
        metadata = {"content": content, "crc32": f"{zlib.crc32(content.encode()):08x}"}
        self._writer.add_metadata(METADATA, metadata if continued is None else dict(continued.metadata))
        self._channel_ids: dict[int, int] = {}
        for kind, topic, message in ((_CYCLE, "/cycle", "Cycle"), (_IMU, "/imu", "Imu"), (_POSE, "/pose", "Pose")):
            schema = self._writer.register_schema(f"openant.{message}", "protobuf", self._telemetry.descriptor_set)
            self._channel_ids[kind] = self._writer.register_channel(topic, "protobuf", schema)
        schema = self._writer.register_schema("openant.Event", "jsonschema", _EVENT_SCHEMA)
        self._channel_ids[_EVENT] = self._writer.register_channel("/event", "json", schema)
        self._stream.sync()

    def _channel(self, kind: int) -> int:
        """Its number; that of pictures is there from the first one on."""
        if kind not in self._channel_ids:
            schema = self._writer.register_schema(PICTURE, "protobuf", picture_schema())
            self._channel_ids[kind] = self._writer.register_channel(PICTURE_TOPIC, "protobuf", schema)
        return self._channel_ids[kind]

    def _stamp(self, t: float) -> int:
        """A time on the clock of the rows, s, as the file's own, ns since 1970."""
        return max(0, round(t * 1e9) + self._stamp_offset)

    def _take_over(self, continued: Continued) -> None:
        topics = {"/cycle": _CYCLE, "/imu": _IMU, "/pose": _POSE, "/event": _EVENT, PICTURE_TOPIC: _PICTURE}
        for topic, stamp, data in continued.messages:
            self._writer.add_message(self._channel(topics[topic]), stamp, data, stamp)
            self.cycles += topic == "/cycle"
        self._writer.flush()
        self._stream.sync()
        self._kept_t, self._kept = continued.last_s, self.cycles

    def _run(self) -> None:
        """The thread: everything that takes longer than a microsecond, until closed or until the disk refuses."""
        encode: dict[int, Callable[[float, Any], bytes]] = {
            _CYCLE: lambda t, cycle: self._telemetry.cycle(cycle),
            _IMU: lambda t, sample: self._telemetry.imu(t, *sample),
            _POSE: self._telemetry.pose,
            _EVENT: lambda t, data: bytes(data),
            _ROW: lambda t, data: bytes(data),
            _PICTURE: lambda t, jpeg: picture_message(self._stamp(t), jpeg),
        }
        due, pending_t, pending, clean = time.monotonic() + SYNC_PERIOD, None, self.cycles, True
        while True:
            try:
                kind, t, item = self._queue.get(timeout=None if clean else max(0.0, due - time.monotonic()))
            except queue.Empty:
                kind, t, item = _SYNC, 0.0, None
            try:
                if self._stopped is None:
                    if kind in encode:
                        if clean:
                            due, clean = time.monotonic() + SYNC_PERIOD, False
                        stamp = self._stamp(t)
                        channel = self._channel(_CYCLE if kind == _ROW else kind)
                        self._writer.add_message(channel, stamp, encode[kind](t, item), stamp)
                        if kind in (_CYCLE, _ROW):
                            pending_t, pending = t, pending + 1
                    if kind == _CLOSE:
                        self._writer.finish()
                        self._stream.sync()
                    elif kind == _SYNC or (not clean and time.monotonic() >= due):
                        self._writer.flush()
                        self._stream.sync()
                        self._kept_t, self._kept, clean = pending_t, pending, True
            except OSError as error:
                self._stopped = self._stop(error)
            except Exception as error:  # a cycle that does not fit the channels: the caller's next call raises it
                _log.exception("recording %s stopped", self.path)
                self._stopped = RecordingStopped(f"a record could not be encoded: {error}", where=self.path)
            if kind == _SYNC and item is not None:
                item.set()
            if kind == _CLOSE:
                self._stream.close()
                return

    def _stop(self, error: OSError) -> RecordingStopped:
        what = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror or str(error)
        kept = ""
        if self._kept_t is None:
            self._look_what_is_kept()
        if self._kept_t is not None:
            kept = f"what was recorded until t = {number(self._kept_t, 's', decimals=3)} is kept, {self._kept} rows"
        return RecordingStopped(
            f"{what}, the recording stopped" + (f"; {kept}" if kept else ""),
            where=self.path,
            remedy="free space or record to another disk",
        )

    def _look_what_is_kept(self) -> None:
        """Count the whole rows of a file that was never synced: it is a second old at most, and soon read."""
        from openant_tools.recording.reader import RecordScan  # which reads what is written here

        try:
            found = [record for record in RecordScan(self.path) if isinstance(record, Message)]
        except (BadInput, OSError):
            return
        stamps = [record.log_time for record in found if record.channel_id == self._channel_ids[_CYCLE]]
        if stamps:
            self._kept_t, self._kept = (max(stamps) - self._stamp_offset) * 1e-9, len(stamps)


_CYCLE, _IMU, _POSE, _EVENT, _ROW, _PICTURE, _SYNC, _CLOSE = range(8)
#: what a disk says that takes no more, rather than a path that cannot be
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG)

_EVENT_SCHEMA = json.dumps(
    {
        "title": "openant.Event",
        "type": "object",
        "properties": {"t": {"type": "number"}, "kind": {"type": "string"}},
        "required": ["t", "kind"],
    }
).encode()


def time_ns(wall: datetime) -> int:
    """Nanoseconds since 1970 of a wall clock, as MCAP counts them."""
    return round(wall.timestamp() * 1e6) * 1000


def _sync_folder(path: Path) -> None:
    """So that a file's name survives a power cut, too."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


class _AppendOnly:
    """The file under the MCAP writer: unbuffered; a write that fails half way is taken back."""

    def __init__(self, path: Path, overwrite: bool) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL)
        try:
            self._descriptor = os.open(path, flags, 0o666)
        except FileExistsError:
            raise BadInput(
                "there is a recording already", where=path, remedy="record under another name, or move that file away"
            ) from None
        _sync_folder(path.parent)
        self._path = path
        self._end = 0
        self._open = True

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            try:
                os.ftruncate(self._descriptor, self._end)
            except OSError:
                pass  # a device, or the disk is gone: reading stops at the torn record anyway
            raise
        self._end += len(data)
        return len(data)

    def tell(self) -> int:
        return self._end

    def flush(self) -> None:
        """Nothing waits here: each write goes to the system at once."""

    def sync(self) -> None:
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            if error.errno != errno.EINVAL:  # a pipe or a device has nothing to sync
                raise
        if not os.fstat(self._descriptor).st_nlink:
            raise FileNotFoundError(errno.ENOENT, "the file was removed while it was written", str(self._path))

    def close(self) -> None:
        if self._open:
            self._open = False
            os.close(self._descriptor)

    def discard(self) -> None:
        """Close, and leave nothing behind of a recording that never began."""
        self.close()
        if self._path.is_file():
            self._path.unlink()


def _completed(facts: Facts, telemetry: Telemetry, registers: Mapping[str, Mapping[str, int]]) -> Facts:
    """The facts with what the channels know: servo models, registers, and the quantum where all joints share it."""
    channels = telemetry.channels
    resolution = {}
    for name in telemetry.registers if telemetry.counts else ():
        steps = {abs(channel.scales[name]) for channel in channels if name in channel.scales}
        if len(steps) == 1 and name != "tick":
            resolution[name] = steps.pop()
    return replace(
        facts,
        motors={channel.joint: channel.model for channel in channels if channel.model} | dict(facts.motors),
        registers=facts.registers or {joint: dict(table) for joint, table in registers.items()},
        resolution=facts.resolution or resolution,
    )
