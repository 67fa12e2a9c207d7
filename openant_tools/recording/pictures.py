"""Pictures of the overhead camera in a recording: JPEG in Foxglove's own message, so that viewers show them as they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, timestamp_pb2
from mcap.records import Channel, Message, Metadata

from openant_tools.recording.telemetry import message_classes

__all__ = ["PICTURE", "PICTURE_TOPIC", "Picture", "picture_message", "picture_schema", "read_pictures"]

#: the message's name and its topic
PICTURE, PICTURE_TOPIC = "foxglove.CompressedImage", "/picture"


@dataclass(frozen=True)
class Picture:
    """t: s, when it was taken, on the clock of the recording's rows. jpeg: the file."""

    t: float
    jpeg: bytes


@cache
def picture_schema() -> bytes:
    """`foxglove.CompressedImage` as a serialized FileDescriptorSet, with what it refers to."""
    field = descriptor_pb2.FieldDescriptorProto
    stamp = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove/CompressedImage.proto", package="foxglove", syntax="proto3", dependency=[stamp.name]
    )
    message = file.message_type.add(name="CompressedImage")
    for name, number, kind in (
        ("timestamp", 1, ".google.protobuf.Timestamp"),
        ("data", 2, field.TYPE_BYTES),
        ("format", 3, field.TYPE_STRING),
        ("frame_id", 4, field.TYPE_STRING),
    ):
        of_type = {"type": field.TYPE_MESSAGE, "type_name": kind} if isinstance(kind, str) else {"type": kind}
        message.field.add(name=name, number=number, label=field.LABEL_OPTIONAL, **of_type)
    return bytes(descriptor_pb2.FileDescriptorSet(file=[stamp, file]).SerializeToString())


def picture_message(stamp_ns: int, jpeg: bytes) -> bytes:
    """The message of a picture taken `stamp_ns` after 1970."""
    stamp = {"seconds": stamp_ns // 10**9, "nanos": stamp_ns % 10**9}
    return bytes(
        _message_class()(timestamp=stamp, data=jpeg, format="jpeg", frame_id="camera").SerializeToString()
    )  # fmt: skip


def read_pictures(path: Path) -> Iterator[Picture]:
    """The pictures of a recording in order, one at a time: an hour of them is half a gigabyte. None from a table."""
    from openant_tools.recording.reader import RecordScan, recording_content  # which counts them

    offset: int | None = None
    channels: set[int] = set()
    for record in RecordScan(path) if path.suffix == ".mcap" else ():
        if isinstance(record, Metadata) and (content := recording_content(record, path)) is not None:
            offset = int(content.get("stamp_offset_ns", 0))
        elif isinstance(record, Channel) and record.topic == PICTURE_TOPIC:
            channels.add(record.id)
        elif isinstance(record, Message) and record.channel_id in channels and offset is not None:
            jpeg = bytes(_message_class().FromString(record.data).data)
            yield Picture((record.log_time - offset) * 1e-9, jpeg)


@cache
def _message_class() -> Any:
    return message_classes(picture_schema())[PICTURE]
