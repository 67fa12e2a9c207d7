"""A torn recording becomes a whole one: its whole records, copied into a new file with a summary."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from openant_tools.errors import BadInput
from openant_tools.files import atomic_writer
from openant_tools.recording.reader import RecordScan
from openant_tools.recording.writer import CHUNK_BYTES, PROFILE

__all__ = ["Repair", "repair"]


@dataclass(frozen=True)
class Repair:
    """What a repair did.

    Attributes:
        path: the whole file.
        damage: what was wrong; None where nothing was and nothing was written.
        messages: records kept.
        original: where the torn file went, if it was moved away.
    """

    path: Path
    damage: str | None
    messages: int
    original: Path | None = None


def repair(path: str | Path, out: str | Path | None = None) -> Repair:
    """Write every whole record of the recording at `path` into a new file with a summary.

    Args:
        path: the recording.
        out: where to; without it the new file takes the old one's name and the old one is kept beside it as
            `NAME.mcap.damaged`.

    Raises:
        BadInput: not a recording, nothing in it can be kept, or the name for the old one is taken.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput("there is no such file", where=path, remedy="name a .mcap recording")
    scan = RecordScan(path)
    messages = sum(isinstance(record, Message) for record in scan)
    if scan.damage is None:
        return Repair(path, None, messages)
    if not messages:
        raise BadInput("nothing of this recording can be kept", where=path, remedy="record again")
    original = None if out is not None else path.with_name(path.name + ".damaged")
    if original is not None and original.exists():
        raise BadInput("an earlier damaged file stands there", where=original, remedy="move it away, or use --out")
    target = path if out is None else Path(out)
    with atomic_writer(target) as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE, library="openant-tools repair")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for record in RecordScan(path):
            if isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Schema) and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in channels:
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas.get(record.schema_id, 0), record.metadata
                )
            elif isinstance(record, Message) and record.channel_id in channels:
                writer.add_message(
                    channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
                )
        writer.finish()
        stream.flush()
        if original is not None:
            os.link(path, original)
    return Repair(target, scan.damage, messages, original)
