"""An MJCF as a URDF: the same links, joints and inertias for other people's software; what URDF cannot hold is listed in it.

Joint angles mean the same in both. A link's frame stands where its joint turns, as URDF wants it, so that it is the body's
frame moved to the joint's anchor. The root link is the body that moves freely, or the world.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from openant_tools.errors import BadInput
from openant_tools.files import write_bytes, write_text
from openant_tools.model.plant import Setup, load_plant

__all__ = ["write_urdf"]

Array = NDArray[np.float64]

#: kg and kg·m² of a link that stands between two joints of one body: as good as none, and not none
NOTHING = 1e-9
#: rad/s where a model says neither how strong a servo is nor what brakes it
ANY_SPEED = 100.0
_HINGE, _SLIDE, _FREE, _BALL = (
    mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL,
)  # fmt: skip
_SHAPES = {
    mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_MESH,
}  # fmt: skip
#: as MuJoCo's viewer has it; other groups collide and are not seen
DRAWN_GROUPS = 3


@dataclass
class _Writing:
    model: mujoco.MjModel
    out: Path
    root: etree._Element
    missing: list[str] = field(default_factory=list)
    meshes: set[int] = field(default_factory=set)

    def leave_out(self, what: str) -> None:
        if what not in self.missing:
            self.missing.append(what)


def write_urdf(source: Path, out: Path) -> tuple[str, ...]:
    """Write the robot of an MJCF to `out`, its meshes into `meshes/` beside it; returns what URDF cannot hold, a line each.

    Raises:
        BadInput: MuJoCo cannot load it, or a joint of it is none of URDF's.
    """
    model = load_plant(source, None, Setup.FLOOR, drawn=True).model
    name = source.stem if not model.names else bytes(model.names).split(b"\0", 1)[0].decode() or source.stem
    writing = _Writing(model, out, etree.Element("robot", name=name))
    extension = etree.SubElement(writing.root, "mujoco")
    etree.SubElement(
        extension, "compiler",
        strippath="false", fusestatic="false", discardvisual="false", balanceinertia="false", autolimits="true",
    )  # fmt: skip
    free = {int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == _FREE}
    bodies = [b for b in range(1, model.nbody) if model.body_weldid[b] != 0 or _carries(model, b)]
    rooted = [b for b in bodies if b in free]
    if len(rooted) > 1:
        raise BadInput(
            "more than one body moves freely in it", where=source, remedy="URDF is of one robot: take the others out"
        )
    if not rooted:
        etree.SubElement(writing.root, "link", name="world")
    for body in bodies:
        _link(writing, body, source, is_root=body in free)
    _not_held(writing)
    listed = "\n".join(f"     - {line}" for line in writing.missing).replace("--", "−−")
    etree.indent(writing.root)
    text = etree.tostring(writing.root, encoding="unicode")
    head = f"<!-- Written by openant-tools from {source.name.replace('--', '−−')}. URDF cannot hold:\n{listed} -->"
    write_text(out, f'<?xml version="1.0"?>\n{head}\n{text}\n')
    return tuple(writing.missing)


def _carries(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body that cannot move is the base of what does."""
    below = [b for b in range(body + 1, model.nbody) if model.body_weldid[b] != 0]
    for b in below:
        while b > body:
            b = int(model.body_parentid[b])
        if b == body:
            return True
    return False


def _name(model: mujoco.MjModel, body: int) -> str:
    return model.body(body).name or f"body_{body}" if body else "world"


def _anchor(model: mujoco.MjModel, body: int) -> Array:
    """(3,) m, where the link's frame stands in the body's: at its last joint."""
    joints = _joints(model, body)
    return np.array(model.jnt_pos[joints[-1]]) if joints and model.jnt_type[joints[0]] != _FREE else np.zeros(3)


def _joints(model: mujoco.MjModel, body: int) -> list[int]:
    first = int(model.body_jntadr[body])
    return list(range(first, first + int(model.body_jntnum[body]))) if first >= 0 else []


def _link(writing: _Writing, body: int, source: Path, *, is_root: bool) -> None:
    model, name = writing.model, _name(writing.model, body)
    anchor = _anchor(model, body)
    joints = [] if is_root else _joints(model, body)
    if not is_root:
        parent = int(model.body_parentid[body])
        place = np.array(model.body_pos[body]) - _anchor(model, parent)
        turn, above = _rotation(model.body_quat[body]), _name(model, parent)
        if not joints:
            _joint(writing, f"{name}_fixed", "fixed", above, name, place, turn)
        at = np.zeros(3)  # of the frame so far, in the body's
        for k, j in enumerate(joints):
            if model.jnt_type[j] == _BALL:
                raise BadInput(
                    "URDF has no ball joint", where=f"{source}, joint {model.joint(j).name}", remedy="use hinges"
                )
            axis, zero = np.array(model.jnt_axis[j]), float(model.qpos0[model.jnt_qposadr[j]])
            place = place + turn.apply(model.jnt_pos[j] - at)
            # Angles are as MuJoCo counts them: where its zero is not the file's pose, the link begins turned back.
            if model.jnt_type[j] == _HINGE:
                turn = turn * Rotation.from_rotvec(-zero * axis)
            else:
                place = place - turn.apply(zero * axis)
            last = k == len(joints) - 1
            child = name if last else f"{name}_{k + 1}"
            if not last:
                between = etree.SubElement(writing.root, "link", name=child)
                _inertial(between, NOTHING, np.zeros(3), NOTHING * np.eye(3))
            _moving(writing, j, above, child, place, turn)
            above, place, turn, at = child, np.zeros(3), Rotation.identity(), np.array(model.jnt_pos[j])
    link = etree.SubElement(writing.root, "link", name=name)
    if model.body_mass[body] > 0:
        axes = _rotation(model.body_iquat[body]).as_matrix()
        inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
        _inertial(link, float(model.body_mass[body]), model.body_ipos[body] - anchor, inertia)
    for geom in range(model.ngeom):
        if int(model.geom_bodyid[geom]) == body:
            _geom(writing, link, geom, anchor)


def _joint(
    writing: _Writing, name: str, kind: str, parent: str, child: str, place: Array, turn: Rotation
) -> etree._Element:
    joint = etree.SubElement(writing.root, "joint", name=name, type=kind)
    _origin(joint, place, turn)
    etree.SubElement(joint, "parent", link=parent)
    etree.SubElement(joint, "child", link=child)
    return joint


def _moving(writing: _Writing, j: int, parent: str, child: str, place: Array, turn: Rotation) -> None:
    model = writing.model
    limited = bool(model.jnt_limited[j])
    kind = "prismatic" if model.jnt_type[j] == _SLIDE else "revolute" if limited else "continuous"
    joint = _joint(writing, model.joint(j).name or f"joint_{j}", kind, parent, child, place, turn)
    etree.SubElement(joint, "axis", xyz=_n(*model.jnt_axis[j]))
    dof = int(model.jnt_dofadr[j])
    damping, friction = float(model.dof_damping[dof]), float(model.dof_frictionloss[dof])
    etree.SubElement(joint, "dynamics", damping=_n(damping), friction=_n(friction))
    drives = [
        i for i in range(model.nactuator)
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[i, 0] == j
    ]  # fmt: skip
    effort = max(
        (float(model.actuator_forcerange[i, 1]) for i in drives if model.actuator_forcelimited[i]), default=0.0
    )
    # What a servo's torque limit overcomes of its damping is how fast it turns unloaded.
    speed = effort / damping if effort and damping else ANY_SPEED
    limit = {"effort": _n(effort or 1e3), "velocity": _n(speed)}
    if limited:
        limit |= {"lower": _n(model.jnt_range[j, 0]), "upper": _n(model.jnt_range[j, 1])}
    etree.SubElement(joint, "limit", limit)
    if model.dof_armature[dof]:
        writing.leave_out("armature of joints (the motors' inertia behind their gears)")
    if model.jnt_stiffness[j]:
        writing.leave_out("springs of joints")


def _inertial(link: etree._Element, mass: float, at: Array, inertia: Array) -> None:
    inertial = etree.SubElement(link, "inertial")
    _origin(inertial, at, Rotation.identity())
    etree.SubElement(inertial, "mass", value=_n(mass))
    words = {f"i{'xyz'[a]}{'xyz'[b]}": _n(inertia[a, b]) for a in range(3) for b in range(a, 3)}
    etree.SubElement(inertial, "inertia", words)


def _geom(writing: _Writing, link: etree._Element, geom: int, anchor: Array) -> None:
    model = writing.model
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind not in _SHAPES:
        writing.leave_out(f"shapes of the kind {kind.name.removeprefix('mjGEOM_').lower()}")
        return
    collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
    place, turn = np.array(model.geom_pos[geom]) - anchor, _rotation(model.geom_quat[geom])
    material = int(model.geom_matid[geom])
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    for used, tag in ((model.geom_group[geom] < DRAWN_GROUPS, "visual"), (collides, "collision")):
        if not used:
            continue
        for at, shape, words in _shapes(writing, geom, kind):
            element = etree.SubElement(link, tag)
            _origin(element, place + turn.apply(at), turn)
            etree.SubElement(etree.SubElement(element, "geometry"), shape, words)
            if tag == "visual":
                name = f"rgba_{'_'.join(f'{round(255 * part)}' for part in rgba)}"  # for a file
                etree.SubElement(etree.SubElement(element, "material", name=name), "color", rgba=_n(*rgba))


def _shapes(writing: _Writing, geom: int, kind: mujoco.mjtGeom) -> Iterator[tuple[Array, str, dict[str, str]]]:
    """What a geom is made of: where along its own axes, the element, its attributes. A capsule is a cylinder with two balls."""
    model, nowhere = writing.model, np.zeros(3)
    radius, half = float(model.geom_size[geom, 0]), float(model.geom_size[geom, 1])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        yield nowhere, "box", {"size": _n(*(2 * model.geom_size[geom]))}
    elif kind == mujoco.mjtGeom.mjGEOM_MESH:
        yield nowhere, "mesh", {"filename": _mesh(writing, int(model.geom_dataid[geom]))}
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        yield nowhere, "sphere", {"radius": _n(radius)}
    else:
        yield nowhere, "cylinder", {"radius": _n(radius), "length": _n(2 * half)}
        for side in (-half, half) if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else ():
            yield np.array([0.0, 0.0, side]), "sphere", {"radius": _n(radius)}


def _mesh(writing: _Writing, mesh: int) -> str:
    """The mesh as the model has it, in the frame of its geom, as binary STL; its path from the URDF."""
    model = writing.model
    name = f"meshes/{model.mesh(mesh).name or mesh}.stl"
    if mesh not in writing.meshes:
        writing.meshes.add(mesh)
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        corners = np.array(model.mesh_vert[first : first + count], "<f4")
        first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        triangles = np.zeros(count, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("none", "<u2")])
        triangles["corners"] = corners[model.mesh_face[first : first + count]]
        write_bytes(writing.out.parent / name, b"\0" * 80 + struct.pack("<I", count) + triangles.tobytes())
    return name


def _not_held(writing: _Writing) -> None:
    model = writing.model
    for count, words in (
        (model.nactuator, "actuators (gains, delays, filters); of them only the torque limit, as effort"),
        (model.nsensor, "sensors"),
        (model.nsite, "sites"),
        (model.neq, "equality constraints"),
        (model.ntendon, "tendons"),
        (model.nkey, "keyframes"),
        (model.nexclude, "pairs of bodies that do not touch"),
        (model.ngeom, "friction and softness of contacts; the floor and whatever else stands in the world"),
    ):
        if count:
            writing.leave_out(words)


def _rotation(quaternion: Array) -> Rotation:
    """Of MuJoCo's w x y z."""
    return Rotation.from_quat(np.asarray(quaternion, float)[[1, 2, 3, 0]])


def _origin(element: etree._Element, place: Array, turn: Rotation) -> None:
    etree.SubElement(element, "origin", xyz=_n(*place), rpy=_n(*turn.as_euler("xyz")))


def _n(*values: float) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)  # for a file
