"""What a viewer draws of a robot: the shapes of its MJCF, body by body, and where each body was in a run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, Setup, load_plant, setup_of
from openant_tools.recording.reader import Recording
from openant_tools.recording.run import Run

__all__ = ["DrawnBody", "DrawnRobot", "Shape", "Track", "base_track", "load_scene"]

Array = NDArray[np.float64]

#: pictures a second of a moving robot; more than a screen shows
DRAWN_HZ = 60.0
#: geoms of these groups are drawn, as MuJoCo's own viewer does; others are its collision shapes
DRAWN_GROUPS = 3
_KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}


@dataclass(frozen=True)
class Shape:
    """One geom in its body's frame.

    Attributes:
        kind: sphere, capsule, cylinder, ellipsoid, box, mesh.
        size: (3,) m, as MuJoCo has it: radii or half lengths.
        position: (3,) m. quaternion: (4,) w x y z. rgba: (4,) 0…1.
        vertices, faces: of a mesh, (n, 3) m and (m, 3).
    """

    kind: str
    size: Array
    position: Array
    quaternion: Array
    rgba: Array
    vertices: NDArray[np.float32] | None = None
    faces: NDArray[np.int32] | None = None

    @property
    def ends(self) -> tuple[Array, Array]:
        """Of a capsule or cylinder, the middles (3,) of its two ends, in the body's frame."""
        along = np.empty(3)
        mujoco.mju_rotVecQuat(along, np.array([0.0, 0.0, self.size[1]]), self.quaternion)
        return self.position - along, self.position + along


@dataclass(frozen=True)
class DrawnBody:
    """A body that is drawn: its number in the model, its name, its shapes."""

    number: int
    name: str
    shapes: tuple[Shape, ...]


@dataclass(frozen=True)
class Track:
    """Where things were: t (n,) s; position (n, bodies, 3) m and quaternion (n, bodies, 4) w x y z in the world."""

    t: Array
    position: Array
    quaternion: Array


@dataclass(frozen=True)
class DrawnRobot:
    """A robot as it is drawn."""

    plant: Plant
    bodies: tuple[DrawnBody, ...]

    def track(self, run: Run, joints_rad: Array, base: Array | None = None) -> Track:
        """Where each body was, at most `DRAWN_HZ` times a second.

        Args:
            joints_rad: (rows of `run`, joints of the plant); NaN holds the value before.
            base: (rows, 7) of the free joint, m and w x y z; None: where the model puts it.
        """
        rows = _thinned(run.t)
        joints = _held(joints_rad)[rows]
        model, data = self.plant.model, mujoco.MjData(self.plant.model)
        start = np.array(model.qpos0)
        numbers = [body.number for body in self.bodies]
        position, quaternion = np.empty((len(rows), len(numbers), 3)), np.empty((len(rows), len(numbers), 4))
        free = self.plant.free_joint
        for k, row in enumerate(rows):
            data.qpos[:] = start
            data.qpos[self.plant.qpos] = joints[k]
            if base is not None and free is not None:
                at = int(model.jnt_qposadr[free])
                data.qpos[at : at + 7] = base[row]
            mujoco.mj_kinematics(model, data)
            position[k], quaternion[k] = data.xpos[numbers], data.xquat[numbers]
        return Track(run.t[rows], position, quaternion)


def load_scene(path: Path, run: Run) -> DrawnRobot:
    """The robot of an MJCF, set up as it stood in `run`, moved by the joints that both have; BadInput where there are none."""
    setup = setup_of(run.facts.setup)
    joints = [joint for joint in load_plant(path, None, setup).joints if joint in run.joints]
    if not joints:
        raise BadInput(
            f"it has none of the run's joints ({', '.join(run.joints)})",
            where=path,
            remedy="name the MJCF of this robot",
        )
    plant = load_plant(path, joints, setup, drawn=True)
    model = plant.model
    bodies = []
    for number in range(1, model.nbody):
        shapes = tuple(_shapes(model, number))
        if shapes:
            bodies.append(DrawnBody(number, model.body(number).name or f"body_{number}", shapes))
    return DrawnRobot(plant, tuple(bodies))


def base_track(recording: Recording | None, run: Run, scene: DrawnRobot) -> Array | None:
    """(rows, 7) where a robot on the floor was by its tracker; None on a stand, or where no tracker saw it."""
    free = scene.plant.free_joint
    if scene.plant.setup is not Setup.FLOOR or free is None:
        return None
    at = int(scene.plant.model.jnt_qposadr[free])
    base = np.tile(scene.plant.model.qpos0[at : at + 7], (len(run.t), 1))
    seen = False
    t, columns = (run.t, run.columns) if recording is None else (recording.pose.t, recording.pose.columns)
    for k, axis in enumerate("xyz"):
        there = columns.get(f"base.{axis}")
        if there is not None and np.isfinite(there).any():
            good = np.isfinite(there)
            base[:, k] = np.interp(run.t, t[good], there[good])
            seen = True
    turned = np.array([columns.get(f"base.q{axis}", np.full(len(t), np.nan)) for axis in "wxyz"], float).T
    yaw = np.asarray(columns.get("base.yaw", np.full(len(t), np.nan)), float)
    if len(t) and np.isfinite(turned).all(axis=1).any():
        good = np.flatnonzero(np.isfinite(turned).all(axis=1))
        near = good[np.clip(np.searchsorted(t[good], run.t), 0, len(good) - 1)]
        base[:, 3:] = turned[near]
        seen = True
    elif len(t) and np.isfinite(yaw).any():
        good = np.isfinite(yaw)
        half = np.interp(run.t, t[good], np.unwrap(yaw[good])) / 2
        base[:, 3], base[:, 4:6], base[:, 6] = np.cos(half), 0.0, np.sin(half)
        seen = True
    return base if seen else None


def _thinned(t: Array) -> NDArray[np.int64]:
    """The first row of each 1 / DRAWN_HZ."""
    return np.unique(np.floor((t - t[0]) * DRAWN_HZ + 1e-6), return_index=True)[1] if len(t) else np.arange(0)


def _held(values: Array) -> Array:
    """Each column with its last finite value in place of NaN; 0 before the first."""
    rows = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values))[:, None], 0), axis=0)
    return np.nan_to_num(np.take_along_axis(values, rows, axis=0))


def _shapes(model: mujoco.MjModel, body: int) -> Iterator[Shape]:
    for geom in range(model.ngeom):
        kind = _KINDS.get(mujoco.mjtGeom(int(model.geom_type[geom])))
        if int(model.geom_bodyid[geom]) != body or kind is None or model.geom_group[geom] >= DRAWN_GROUPS:
            continue
        material = int(model.geom_matid[geom])
        rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        vertices, faces = None, None
        if kind == "mesh":
            mesh = int(model.geom_dataid[geom])
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            vertices = np.array(model.mesh_vert[first : first + count])
            first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
            faces = np.array(model.mesh_face[first : first + count])
        yield Shape(
            kind, np.array(model.geom_size[geom]), np.array(model.geom_pos[geom]), np.array(model.geom_quat[geom]),
            np.array(rgba, float), vertices, faces,
        )  # fmt: skip
