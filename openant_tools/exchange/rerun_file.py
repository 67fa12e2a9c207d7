"""A run for Rerun: every signal as a curve, the robot and where it was, and beside the measured one the simulated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.exchange.scene import DrawnRobot, Track, base_track
from openant_tools.exchange.source import Source
from openant_tools.optional import rerun as rr
from openant_tools.recording.run import JOINT_SIGNALS

__all__ = ["log_gap", "log_source", "rerun_stream"]

Array = NDArray[np.float64]

#: Okabe–Ito orange; the simulated robot is drawn by its edges, so that the measured one is seen through it
SIMULATED_RGBA = (230, 159, 0, 255)


def rerun_stream(name: str, path: Path | None = None) -> Any:
    """A stream into the file `path`, or, without one, into Rerun's own viewer, which is opened."""
    stream = rr.RecordingStream("openant", recording_id=name)
    if path is None:
        stream.spawn()
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream.save(str(path))
    return stream


def log_source(stream: Any, source: Source) -> None:
    """Log what was measured: `joints/J/SIGNAL`, `imu`, `base`, `log`, `camera`, and the robot below `robot/measured`.

    Timelines: `t`, s since the run began, and `wall`, where the day is known.
    """
    run = source.run
    for joint in run.joints:
        for signal, unit in JOINT_SIGNALS.items():
            values = run.columns.get(f"{signal}.{joint}")
            if values is None or not unit:
                continue
            t = run.command_times if signal == "cmd" else run.t
            _scalars(stream, source, f"joints/{joint}/{signal}", t, np.asarray(values, float))
    for samples in (source.imu, source.pose):
        for name, values in samples.columns.items():
            _scalars(stream, source, name.replace(".", "/"), samples.t, np.asarray(values, float))
    for one in source.sayings():
        _at(stream, source, one.t)
        stream.log("log", rr.TextLog(one.words, level="WARN" if one.bad else "INFO"))
    for picture in source.pictures():
        _at(stream, source, picture.t)
        stream.log("camera", rr.EncodedImage(contents=picture.jpeg, media_type="image/jpeg"))
    stream.reset_time()
    if source.scene is not None:
        joints = run.signal("pos", source.scene.plant.joints)
        track = source.scene.track(run, joints, base_track(source.recording, run, source.scene))
        _robot(stream, source, "robot/measured", source.scene, track, None)


def log_gap(stream: Any, source: Source, simulated: Mapping[str, Array]) -> None:
    """Log the simulated robot over the measured one, its joints, and how far off it is: `gap/J`, rad.

    Args:
        simulated: joint → (rows,) rad; joints that it lacks are drawn where they were measured.
    """
    run, scene = source.run, source.scene
    assert scene is not None
    joints = run.signal("pos", scene.plant.joints)
    for j, joint in enumerate(scene.plant.joints):
        if joint in simulated:
            _scalars(stream, source, f"joints/{joint}/simulated", run.t, simulated[joint])
            _scalars(stream, source, f"gap/{joint}", run.t, joints[:, j] - simulated[joint])
            joints[:, j] = simulated[joint]
    track = scene.track(run, joints, base_track(source.recording, run, scene))
    _robot(stream, source, "robot/simulated", scene, track, SIMULATED_RGBA)
    blueprint = rr.blueprint
    stream.send_blueprint(
        blueprint.Blueprint(
            blueprint.Horizontal(
                blueprint.Spatial3DView(origin="robot", name="measured, and simulated in orange"),
                blueprint.Vertical(
                    blueprint.TimeSeriesView(origin="gap", name="measured − simulated, rad"),
                    blueprint.TimeSeriesView(
                        origin="joints",
                        contents=[
                            f"$origin/{joint}/{signal}" for joint in simulated for signal in ("cmd", "pos", "simulated")
                        ],
                        name="commanded, measured, simulated, rad",
                    ),
                ),
            )
        )
    )


def _columns(source: Source, t: Array) -> list[Any]:
    """The times (n,) s on both timelines."""
    columns = [rr.TimeColumn("t", duration=t - source.run.t[0])]
    if source.wall_ns is not None:
        stamps = (np.round(t * 1e9).astype(np.int64) + source.wall_ns).astype("datetime64[ns]")
        columns.append(rr.TimeColumn("wall", timestamp=stamps))
    return columns


def _at(stream: Any, source: Source, t: float) -> None:
    stream.set_time("t", duration=t - float(source.run.t[0]))
    if source.wall_ns is not None:
        stream.set_time("wall", timestamp=np.datetime64(round(t * 1e9) + source.wall_ns, "ns"))


def _scalars(stream: Any, source: Source, path: str, t: Array, values: Array) -> None:
    there = np.isfinite(values)
    if there.any():
        stream.send_columns(path, _columns(source, t[there]), rr.Scalars.columns(scalars=values[there]))


def _robot(stream: Any, source: Source, root: str, scene: DrawnRobot, track: Track, rgba: Any) -> None:
    for k, body in enumerate(scene.bodies):
        for n, one in enumerate(body.shapes):
            colors = [rgba or [round(255 * part) for part in one.rgba]]
            turned = one.quaternion[[1, 2, 3, 0]]
            fill = "solid" if rgba is None else "majorwireframe"
            placed = {"quaternions": [turned], "colors": colors, "fill_mode": fill}
            radius, half = float(one.size[0]), float(one.size[1])
            shape: Any
            if one.kind == "mesh":
                stream.log(
                    f"{root}/{body.name}/{n}", rr.Transform3D(translation=one.position, quaternion=turned), static=True
                )
                shape = rr.Mesh3D(
                    vertex_positions=one.vertices, triangle_indices=one.faces, albedo_factor=colors[0]
                )  # fmt: skip
            elif one.kind == "box":
                shape = rr.Boxes3D(half_sizes=[one.size], centers=[one.position], **placed)
            elif one.kind in ("sphere", "ellipsoid"):
                sizes = [[radius] * 3 if one.kind == "sphere" else one.size]
                shape = rr.Ellipsoids3D(half_sizes=sizes, centers=[one.position], **placed)
            elif one.kind == "cylinder":
                shape = rr.Cylinders3D(lengths=[2 * half], radii=[radius], centers=[one.position], **placed)
            else:  # Rerun's capsule begins where MuJoCo's ends
                shape = rr.Capsules3D(lengths=[2 * half], radii=[radius], translations=[one.ends[0]], **placed)
            stream.log(f"{root}/{body.name}/{n}", shape, static=True)
        columns = rr.Transform3D.columns(
            translation=track.position[:, k], quaternion=track.quaternion[:, k][:, [1, 2, 3, 0]]
        )
        stream.send_columns(f"{root}/{body.name}", _columns(source, track.t), columns)
