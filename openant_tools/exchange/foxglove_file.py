"""A run for Foxglove: joint states in SI, the robot and where it was, IMU, tracker, events and findings as logs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.exchange.scene import Shape, base_track
from openant_tools.exchange.source import Source
from openant_tools.files import atomic_writer
from openant_tools.optional import foxglove, foxglove_channels, foxglove_messages

__all__ = ["write_foxglove"]

_m = foxglove_messages
#: of each servo, on `/servos`: signal → what it is called there
_SERVO = {
    "cur": "current_a",
    "pwm": "duty",
    "load": "load",
    "volt": "voltage_v",
    "temp": "temperature_c",
    "rtt": "answer_s",
}


def write_foxglove(source: Source, path: Path) -> int:
    """Write an MCAP file with Foxglove's own schemas; returns how many messages it has.

    Topics: `/joint_states` (measured), `/joint_commands`, `/servos`, `/imu`, `/tracker`, `/log`, where the robot's model is
    known `/tf` and `/scene`, and where they were recorded the camera's `/picture`. Without a wall clock (a table) time begins in 1970, at the run's own.
    """
    context = foxglove.Context()
    offset = source.wall_ns or 0
    messages = 0
    with atomic_writer(path) as stream, foxglove.open_mcap(stream, context=context):
        channels: dict[str, Any] = {}
        for topic, t, message in merge(
            sorted(_messages(source), key=itemgetter(1)), _pictures(source), key=itemgetter(1)
        ):
            if topic not in channels:
                channels[topic] = _channel(topic, message, context)
            stamp = max(0, round(t * 1e9) + offset)
            if not isinstance(message, dict):
                message = message(_m.Timestamp(sec=stamp // 10**9, nsec=stamp % 10**9))
            channels[topic].log(message, log_time=stamp)
            messages += 1
    return messages


def _channel(topic: str, message: Any, context: Any) -> Any:
    if isinstance(message, dict):
        return foxglove.Channel(topic, schema=_schema(message), message_encoding="json", context=context)
    kinds = {
        "/joint_states": "JointStates", "/joint_commands": "JointStates", "/tf": "FrameTransforms", "/scene": "SceneUpdate",
        "/tracker": "PoseInFrame", "/log": "Log", "/picture": "CompressedImage",
    }  # fmt: skip
    return getattr(foxglove_channels, f"{kinds[topic]}Channel")(topic, context=context)


def _schema(example: dict[str, Any]) -> dict[str, Any]:
    """Of a message of numbers, or of such messages by name."""
    rows = {
        key: _schema(value) if isinstance(value, dict) else {"type": ["number", "null"]}
        for key, value in example.items()
    }
    return {"type": "object", "properties": rows}


def _messages(source: Source) -> Iterator[tuple[str, float, Any]]:
    """(topic, s, message): a mapping, or a function of the time stamp."""
    run = source.run
    for topic, place, speed in (("/joint_states", "pos", "vel"), ("/joint_commands", "cmd", "")):
        if not run.has(place):
            continue
        position, velocity = run.signal(place), run.signal(speed)
        for k, t in enumerate(run.command_times if place == "cmd" else run.t):
            states = [
                _m.JointState(name=joint, position=float(position[k, j]), velocity=_known(velocity[k, j]))
                for j, joint in enumerate(run.joints)
                if math.isfinite(position[k, j])
            ]
            if states:
                yield topic, float(t), lambda stamp, states=states: _m.JointStates(timestamp=stamp, joints=states)
    signals = {signal: run.signal(signal) for signal in _SERVO if run.has(signal)}
    for k, t in enumerate(run.t if signals else ()):
        yield "/servos", float(t), {
            joint: {_SERVO[signal]: _known(values[k, j]) for signal, values in signals.items()}
            for j, joint in enumerate(run.joints)
        }  # fmt: skip
    imu = source.imu
    for k, t in enumerate(imu.t):
        yield "/imu", float(t), {name.replace(".", "_"): _known(values[k]) for name, values in imu.columns.items()}
    yield from _tracker(source)
    for one in source.sayings():
        level = _m.LogLevel.Warning if one.bad else _m.LogLevel.Info
        yield (
            "/log",
            one.t,
            lambda stamp, one=one, level=level: _m.Log(timestamp=stamp, level=level, message=one.words, name=run.name),
        )
    if source.scene is not None:
        yield from _scene(source)


def _pictures(source: Source) -> Iterator[tuple[str, float, Any]]:
    """One at a time: all together they need more memory than there is."""
    for one in source.pictures():
        yield (
            "/picture",
            one.t,
            lambda stamp, jpeg=one.jpeg: _m.CompressedImage(
                timestamp=stamp, frame_id="camera", data=jpeg, format="jpeg"
            ),
        )


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _tracker(source: Source) -> Iterator[tuple[str, float, Any]]:
    pose = source.pose
    if not {"base.x", "base.y"} <= set(pose.columns):
        return
    zeros, missing = np.zeros(len(pose.t)), np.full(len(pose.t), np.nan)
    place = np.array([pose.columns.get(f"base.{axis}", zeros) for axis in "xyz"]).T
    turned = np.array([pose.columns.get(f"base.q{axis}", missing) for axis in "wxyz"]).T
    yaw = pose.columns.get("base.yaw", zeros)
    for k, t in enumerate(pose.t):
        if not np.isfinite(place[k]).all():
            continue
        q = turned[k] if np.isfinite(turned[k]).all() else [math.cos(yaw[k] / 2), 0.0, 0.0, math.sin(yaw[k] / 2)]
        if np.isfinite(q).all():
            yield (
                "/tracker",
                float(t),
                lambda stamp, p=place[k], q=q: _m.PoseInFrame(timestamp=stamp, frame_id="world", pose=_pose(p, q)),
            )


def _scene(source: Source) -> Iterator[tuple[str, float, Any]]:
    scene, run = source.scene, source.run
    assert scene is not None
    track = scene.track(run, run.signal("pos", scene.plant.joints), base_track(source.recording, run, scene))
    yield (
        "/scene",
        float(run.t[0]),
        lambda stamp: _m.SceneUpdate(
            entities=[
                _m.SceneEntity(
                    timestamp=stamp, frame_id=body.name, id=body.name, frame_locked=True, **_primitives(body.shapes)
                )
                for body in scene.bodies
            ]
        ),
    )
    for k, t in enumerate(track.t):
        where = list(zip(scene.bodies, track.position[k], track.quaternion[k], strict=True))
        yield "/tf", float(t), lambda stamp, where=where: _m.FrameTransforms(
            transforms=[
                _m.FrameTransform(
                    timestamp=stamp, parent_frame_id="world", child_frame_id=body.name,
                    translation=_m.Vector3(x=float(p[0]), y=float(p[1]), z=float(p[2])), rotation=_quaternion(q),
                )
                for body, p, q in where
            ]
        )  # fmt: skip


def _primitives(shapes: tuple[Shape, ...]) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {"cubes": [], "spheres": [], "cylinders": [], "triangles": []}
    for one in shapes:
        color = _m.Color(**dict(zip("rgba", map(float, one.rgba), strict=True)))
        pose = _pose(one.position, one.quaternion)
        radius, half = float(one.size[0]), float(one.size[1])
        if one.kind == "mesh" and one.vertices is not None and one.faces is not None:
            points = [_m.Point3(x=float(x), y=float(y), z=float(z)) for x, y, z in one.vertices]
            indices = [int(k) for k in one.faces.ravel()]
            out["triangles"].append(_m.TriangleListPrimitive(pose=pose, points=points, color=color, indices=indices))
        elif one.kind == "box":
            out["cubes"].append(_m.CubePrimitive(pose=pose, size=_size(*(2 * one.size)), color=color))
        elif one.kind in ("sphere", "ellipsoid"):
            size = [2 * radius] * 3 if one.kind == "sphere" else 2 * one.size
            out["spheres"].append(_m.SpherePrimitive(pose=pose, size=_size(*size), color=color))
        else:
            size = _size(2 * radius, 2 * radius, 2 * half)
            out["cylinders"].append(
                _m.CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=color)
            )
            for end in one.ends if one.kind == "capsule" else ():
                ball = _pose(end, one.quaternion)
                out["spheres"].append(_m.SpherePrimitive(pose=ball, size=_size(*[2 * radius] * 3), color=color))
    return out


def _size(x: float, y: float, z: float) -> Any:
    return _m.Vector3(x=float(x), y=float(y), z=float(z))


def _quaternion(q: Any) -> Any:
    return _m.Quaternion(w=float(q[0]), x=float(q[1]), y=float(q[2]), z=float(q[3]))


def _pose(position: Any, quaternion: Any) -> Any:
    return _m.Pose(position=_size(*position), orientation=_quaternion(quaternion))
