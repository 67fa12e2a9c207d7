"""A recording that was cut short, taken up again, so that one session stays one file.

What is whole of the old file is copied into a new one, which takes its place before the first new row is written:
whenever the power goes, one of the two stands there with all that was recorded.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Metadata, Schema

from openant_tools.errors import BadInput
from openant_tools.recording.reader import RecordScan, recording_content
from openant_tools.recording.telemetry import ServoChannel, Telemetry
from openant_tools.recording.writer import METADATA, Continued, recording_path

__all__ = ["continuation"]

#: s by which wall clock and monotonic clock may drift apart (NTP sets the former) and still be those of one boot
SAME_BOOT_S = 20.0
#: s between the last old row and the first new one where the old clock is gone and the wall clock says nothing
UNKNOWN_GAP_S = 1.0


def continuation(path: str | Path, channels: Sequence[ServoChannel], now: float, *, wall_counts: bool) -> Continued:
    """What a `RecordingWriter` needs to go on with the recording at `path`.

    Args:
        channels: the servos as they are now; they must be those of the recording.
        now: s on the clock of the rows to come.
        wall_counts: whether the wall clock passes as `now` does. The host's monotonic clock starts anew with the host: the
            wall clock then says how long the pause was. A stepped virtual robot has nothing to do with the wall.

    Raises:
        BadInput: no recording stands there, or it is of other servos.
    """
    path = recording_path(path)
    if not path.is_file():
        raise BadInput("there is no recording to go on with", where=path, remedy="leave out --resume to begin one")
    metadata: dict[str, str] | None = None
    content: dict[str, Any] | None = None
    schemas: dict[int, str] = {}
    kinds: dict[int, str] = {}
    messages: list[tuple[str, int, bytes]] = []
    for record in RecordScan(path):
        if isinstance(record, Metadata) and record.name == METADATA:
            content, metadata = recording_content(record, path), dict(record.metadata)
        elif isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            kinds[record.id] = record.topic
        elif isinstance(record, Message):
            messages.append((kinds.get(record.channel_id, ""), record.log_time, record.data))
    if content is None or metadata is None:
        raise BadInput("nothing of this recording can be kept", where=path, remedy="record under another name")
    ours = json.loads(json.dumps(Telemetry(channels).as_json()))
    if content["channels"] != ours["channels"]:
        before = {channel["joint"]: channel for channel in content["channels"]}
        changed = [c["joint"] for c in ours["channels"] if before.get(c["joint"]) != c] or list(before)
        raise BadInput(
            f"this is a recording of other servos, or of others mounted ({', '.join(changed)} differ)",
            where=path,
            remedy="record under another name",
        )
    rows = [stamp for topic, stamp, _ in messages if topic == "/cycle"]
    offset = int(content.get("stamp_offset_ns", 0))
    last = (max(rows) - offset) * 1e-9 if rows else 0.0
    started = content["started"]
    shift = 0.0
    if wall_counts:
        passed = (datetime.now(UTC) - datetime.fromisoformat(started["wall"])).total_seconds()
        expected = float(started["clock"]) + passed
        if abs(expected - now) > SAME_BOOT_S:
            shift = expected - now
    if now + shift <= last:
        shift = last + UNKNOWN_GAP_S - now
    return Continued(metadata, tuple(messages), shift, last, offset)
