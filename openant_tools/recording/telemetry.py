"""What a recording holds of one cycle of the bus, and how that becomes protobuf messages and, on reading, SI.

The protobuf schema is made for each recording: one field a joint in `Cycle`, one field a register in `Servo`, so that
a viewer (Foxglove, Rerun, PlotJuggler) shows `/cycle` → `knee_fl` → `pos` without knowing anything of ours. It is
embedded in the file, and reading decodes by what the file holds. Counts stay as the servo sent them; SI is made of them
on reading, so that a wrong scale can be corrected in a recording years old.
"""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from openant_tools.recording.run import Array

__all__ = [
    "AGENT_TIMES",
    "IMU_FIELDS",
    "POSE_FIELDS",
    "Cycle",
    "RecordedAnswer",
    "ServoChannel",
    "Telemetry",
    "message_classes",
]

#: fields of `Servo` that are not registers
_OF_THE_BUS = ("goal", "torque", "ok", "err", "rtt")
#: raw fields that change sign with the joint's direction
_SIGNED = ("pos", "vel", "cur", "load", "pwm")

#: field of `Imu` → column; of `Pose` → column
IMU_FIELDS: Mapping[str, str] = {
    f"{kind}_{axis}": f"{kind}.{axis}" for kind in ("gyro", "acc") for axis in ("x", "y", "z")
}
POSE_FIELDS: Mapping[str, str] = {axis: f"base.{axis}" for axis in ("x", "y", "z", "yaw", "qw", "qx", "qy", "qz")}


@dataclass(frozen=True)
class ServoChannel:
    """How one servo's counts become SI units of its joint.

    joint angle = direction · (counts · scales["pos"] − zero_offset_rad), as in robot.toml: the zero offset is what the
    servo reads, in rad, where the joint is at zero. Velocity, current, load and duty turn with `direction`.

    Attributes:
        joint: name in the model.
        model, id: of the servo.
        direction: +1, or −1 where the servo turns against the joint.
        zero_offset_rad: the servo's angle at the joint's zero.
        scales: name of a register as recorded (`pos`, `vel`, `cur`, `load`, `pwm`, `volt`, `temp`, `tick`, or others,
            which become columns of their own) → SI units per count.
    """

    joint: str
    model: str
    id: int
    direction: int = 1
    zero_offset_rad: float = 0.0
    scales: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.direction not in (1, -1):
            raise ValueError(f"{self.joint}: direction is {self.direction}, not 1 or -1")
        taken = set(self.scales) & set(_OF_THE_BUS)
        if taken:
            raise ValueError(f"{self.joint}: {sorted(taken)[0]} is no name for a register")

    def to_si(self, name: str, counts: Array) -> Array:
        """(n,) counts of the register `name`, or of `goal`, in SI units of the joint."""
        if name in ("pos", "goal"):
            return self.direction * (counts * self.scales.get("pos", 1.0) - self.zero_offset_rad)
        values = counts * self.scales[name]
        return self.direction * values if name in _SIGNED else values


@dataclass(frozen=True, slots=True)
class RecordedAnswer:
    """What one servo answered in one cycle.

    Attributes:
        raw: register → counts; None where no valid answer came.
        ok: whether a valid answer came in time.
        err: "" or what was wrong (formats: timeout, crc, short, late, port; alert comes with ok).
        rtt: s, from the request's first byte to the last byte of this answer; NaN where none came.
    """

    raw: Mapping[str, int] | None
    ok: bool
    err: str = ""
    rtt: float = math.nan


@dataclass(frozen=True, slots=True)
class Cycle:
    """One turn of the bus loop; sequences are in the order of the channels.

    Attributes:
        t: s, when the read request started; strictly increasing.
        goals: counts sent in this cycle; None where nothing was sent and the goal before it stays in force.
        cmd_t: s, when the last byte of the command had left; None where none was sent.
        wake: s, how late the loop began this cycle.
        answers: one a servo.
        torque: whether torque is enabled.
        obs_t, act_t: s, when the observation was made, and the action chosen from it, that this cycle's command carries out
            first; None where nobody said.
    """

    t: float
    goals: Sequence[int | None]
    cmd_t: float | None
    wake: float | None
    answers: Sequence[RecordedAnswer]
    torque: Sequence[bool]
    obs_t: float | None = None
    act_t: float | None = None


#: further columns of a recording of the bus: an agent's own times
AGENT_TIMES: Mapping[str, type] = {"obs_t": float, "act_t": float}


_Field = descriptor_pb2.FieldDescriptorProto


class Telemetry:
    """The protobuf schema of one recording, and cycles as its messages.

    Args:
        channels: the servos, in order.
        counts: True where registers are integers; False where a table in SI is carried, as doubles.
        extra: further columns of a row → float or str.
    """

    def __init__(
        self, channels: Sequence[ServoChannel], *, counts: bool = True, extra: Mapping[str, type] | None = None
    ) -> None:
        self.channels = tuple(channels)
        self.counts = counts
        names = ["t", "cmd_t", "wake"]
        self.joint_fields = _identifiers([channel.joint for channel in channels], names)
        self.extra_fields = _identifiers(list(extra or {}), [*names, *self.joint_fields.values()])
        self.registers = tuple(dict.fromkeys(name for channel in channels for name in channel.scales))
        file = descriptor_pb2.FileDescriptorProto(name="openant/telemetry.proto", package="openant", syntax="proto3")
        number = _Field.TYPE_SINT64 if counts else _Field.TYPE_DOUBLE
        servo = {"goal": number, "torque": _Field.TYPE_BOOL, "ok": _Field.TYPE_BOOL, "err": _Field.TYPE_STRING}
        servo |= {"rtt": _Field.TYPE_DOUBLE} | dict.fromkeys(self.registers, number)
        _message(file, "Servo", servo)
        row: dict[str, Any] = dict.fromkeys(names, _Field.TYPE_DOUBLE)
        row |= dict.fromkeys(self.joint_fields.values(), ".openant.Servo")
        kinds = {float: _Field.TYPE_DOUBLE, str: _Field.TYPE_STRING}
        row |= {self.extra_fields[name]: kinds[kind] for name, kind in (extra or {}).items()}
        _message(file, "Cycle", row)
        _message(file, "Imu", {"t": _Field.TYPE_DOUBLE} | dict.fromkeys(IMU_FIELDS, _Field.TYPE_DOUBLE))
        _message(file, "Pose", {"t": _Field.TYPE_DOUBLE} | dict.fromkeys(POSE_FIELDS, _Field.TYPE_DOUBLE))
        self.descriptor_set: bytes = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
        classes = message_classes(self.descriptor_set)
        self._cycle, self._imu, self._pose = (classes[f"openant.{name}"] for name in ("Cycle", "Imu", "Pose"))

    def cycle(self, cycle: Cycle) -> bytes:
        """The message `Cycle` of one cycle."""
        fields: dict[str, Any] = {"t": cycle.t}
        if cycle.cmd_t is not None:
            fields["cmd_t"] = cycle.cmd_t
        if cycle.wake is not None:
            fields["wake"] = cycle.wake
        for name, at in (("obs_t", cycle.obs_t), ("act_t", cycle.act_t)):
            if at is not None:
                fields[self.extra_fields[name]] = at
        rows = zip(self.joint_fields.values(), cycle.goals, cycle.answers, cycle.torque, strict=True)
        for name, goal, answer, torque in rows:
            servo: dict[str, Any] = {"ok": answer.ok, "torque": torque}
            if answer.raw is not None:
                servo |= answer.raw
            if goal is not None:
                servo["goal"] = goal
            if answer.err:
                servo["err"] = answer.err
            if answer.rtt == answer.rtt:  # not NaN
                servo["rtt"] = answer.rtt
            fields[name] = servo
        return bytes(self._cycle(**fields).SerializeToString())

    def row(self, t: float, joints: Mapping[str, Mapping[str, Any]], rest: Mapping[str, Any]) -> bytes:
        """The message `Cycle` of a table's row: joint → fields of `Servo`, and columns of the row itself."""
        fields = {self.joint_fields[joint]: servo for joint, servo in joints.items()}
        return bytes(
            self._cycle(t=t, **fields, **{self.extra_fields.get(k, k): v for k, v in rest.items()}).SerializeToString()
        )

    def imu(self, t: float, gyro: Sequence[float], acc: Sequence[float]) -> bytes:
        """The message `Imu`: gyro in rad/s, specific force in m/s², in the body's frame."""
        values = dict(zip(IMU_FIELDS, (*gyro, *acc), strict=True))
        return bytes(
            self._imu(t=t, **{name: value for name, value in values.items() if value == value}).SerializeToString()
        )

    def pose(self, t: float, values: Mapping[str, float]) -> bytes:
        """The message `Pose`: place in m, heading in rad, orientation as a quaternion; any may be missing."""
        return bytes(
            self._pose(t=t, **{name: value for name, value in values.items() if value == value}).SerializeToString()
        )

    def as_json(self) -> dict[str, Any]:
        """What reading needs besides the schema."""
        return {
            "counts": self.counts,
            "channels": [asdict(channel) | {"scales": dict(channel.scales)} for channel in self.channels],
            "joint_fields": self.joint_fields,
            "extra_fields": self.extra_fields,
        }


def message_classes(descriptor_set: bytes) -> Mapping[str, Any]:
    """Full name → message class, of a serialized FileDescriptorSet."""
    pool = descriptor_pool.DescriptorPool()
    files = descriptor_pb2.FileDescriptorSet.FromString(descriptor_set).file
    for file in files:
        pool.Add(file)
    return {
        f"{file.package}.{message.name}": message_factory.GetMessageClass(
            pool.FindMessageTypeByName(f"{file.package}.{message.name}")
        )
        for file in files
        for message in file.message_type
    }


def _message(file: Any, name: str, fields: Mapping[str, Any]) -> None:
    """Add a message whose fields all know whether they are set: a missing sample is not zero."""
    message = file.message_type.add(name=name)
    for number, (field_name, kind) in enumerate(fields.items(), 1):
        if isinstance(kind, str):
            message.field.add(
                name=field_name, number=number, type=_Field.TYPE_MESSAGE, type_name=kind, label=_Field.LABEL_OPTIONAL
            )
        else:
            message.field.add(
                name=field_name,
                number=number,
                type=kind,
                label=_Field.LABEL_OPTIONAL,
                proto3_optional=True,
                oneof_index=len(message.oneof_decl),
            )
            message.oneof_decl.add(name=f"_{field_name}")


def _identifiers(names: Sequence[str], taken: Sequence[str]) -> dict[str, str]:
    """Each name as an identifier that protobuf and its viewers take, all different."""
    found: dict[str, str] = {}
    for name in names:
        base = re.sub(r"[^A-Za-z0-9_]", "_", name).strip("_") or "x"
        if base[0].isdigit() or keyword.iskeyword(base) or base == "self":
            base = f"j_{base}"
        identifier, suffix = base, 2
        while identifier in taken or identifier in found.values():
            identifier, suffix = f"{base}_{suffix}", suffix + 1
        found[name] = identifier
    return found
