"""A model without what no physics reads, so that memory and time of a simulation do not follow how a robot looks.

Every variant of a model is a copy of all that it holds: of textures, of the meshes that are drawn, and of every triangle of
those that collide. What remains here is what moves: masses as they were inferred from all geoms, and of a mesh that may touch
something its convex hull, which is all that MuJoCo collides. Elements keep their ids and names, so that a number of the
stripped model is the same number of the file's.
"""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np
from numpy.typing import NDArray

__all__ = ["strip_colliding", "strip_visual"]

#: m; what is left of a geom that is only drawn
POINT_M = 1e-4
_MESH = mujoco.mjtGeom.mjGEOM_MESH
_FROM_GEOMS, _WHERE_UNSTATED = (
    mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE,
    mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO,
)


def strip_visual(spec: mujoco.MjSpec) -> bool:
    """Take textures, skins and the meshes of geoms that never collide out of a spec; whether there were any."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for light in spec.lights:
        light.texture = ""
    found = [*spec.skins, *spec.textures]
    for one in found:
        spec.delete(one)
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    drawn = [g for g in spec.geoms if not g.contype and not g.conaffinity and not (g.name and g.name in paired)]
    return _to_points(spec, drawn) or bool(found)


def strip_colliding(spec: mujoco.MjSpec, model: mujoco.MjModel) -> bool:
    """Take the meshes of what can touch nothing out of a spec, and leave of the others their hulls; whether any changed.

    Args:
        model: compiled of the spec, whose elements have its ids.
    """
    geoms = [geom for geom in spec.geoms if geom.id >= 0]
    changed = strip_visual(spec)
    alone = _touching_nothing(spec, model)
    changed |= _to_points(spec, [geom for geom in geoms if alone[geom.id]])
    fitted = {geom.meshname for geom in spec.geoms if geom.type != _MESH and geom.meshname}
    for mesh in list(spec.meshes):
        on_it = [geom for geom in geoms if geom.meshname == mesh.name and geom.type == _MESH]
        ids = {int(model.geom_dataid[geom.id]) for geom in on_it if model.geom_type[geom.id] == _MESH}
        if mesh.name in fitted or len(ids) != 1 or any(_immersed(spec, geom) for geom in on_it):
            continue
        corners = _hull(model, ids.pop())
        if corners is None or len(corners) >= len(mesh.uservert) // 3 > 0:
            continue
        for geom in on_it:
            _adopt(spec, geom.parent)
        hull = spec.add_mesh(name=f"hull of {mesh.name}", uservert=corners.ravel())
        for geom in on_it:
            geom.meshname = hull.name
            geom.mass = 0.0
        spec.delete(mesh)
        changed = True
    return changed


def _to_points(spec: mujoco.MjSpec, geoms: Iterable[mujoco.MjsGeom]) -> bool:
    """Make each of these whose shape is an asset a point without mass, its part of a body's inertia kept by the body."""
    sensed = {name for sensor in spec.sensors for name in (sensor.objname, sensor.refname) if name}
    shaped = [
        geom
        for geom in geoms
        if (geom.meshname or geom.hfieldname) and geom.name not in sensed and not _immersed(spec, geom)
    ]
    shaped = [geom for geom in shaped if not geom.plugin.active]
    for geom in shaped:
        _adopt(spec, geom.parent)
    for geom in shaped:
        geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
        geom.meshname, geom.hfieldname = "", ""
        geom.size[:] = [POINT_M, 0.0, 0.0]
        geom.mass = 0.0
    meshes = {geom.meshname for geom in spec.geoms}
    heights = {geom.hfieldname for geom in spec.geoms}
    unused = [mesh for mesh in spec.meshes if mesh.name not in meshes]
    unused += [field for field in spec.hfields if field.name not in heights]
    for one in unused:
        spec.delete(one)
    return bool(shaped or unused)


def _adopt(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> None:
    """Let a body keep the inertia that its geoms give it, whatever becomes of them."""
    if body.name == "world":
        return
    if spec.compiler.inertiafromgeom == _FROM_GEOMS:
        # Nothing else can be adopted then: those that have geoms are told to be inferred, one by one.
        low, high = spec.compiler.inertiagrouprange
        for one in spec.bodies[1:]:
            if any(low <= geom.group <= high for geom in one.geoms):
                one.explicitinertial = False
                one.ipos[:], one.fullinertia[:] = np.nan, np.nan
        spec.compiler.inertiafromgeom = _WHERE_UNSTATED
    if not body.explicitinertial:
        spec.adopt_inertial(body)


def _immersed(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Whether a fluid acts on the geom's own shape."""
    return bool(geom.fluid_ellipsoid) and (spec.option.density > 0 or spec.option.viscosity > 0)


def _touching_nothing(spec: mujoco.MjSpec, model: mujoco.MjModel) -> NDArray[np.bool_]:
    """(geoms,) whether no other one of another body may collide with it."""
    contype, conaffinity = np.zeros(model.ngeom, np.int64), np.zeros(model.ngeom, np.int64)
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    named = np.zeros(model.ngeom, bool)
    for geom in spec.geoms:
        if geom.id >= 0:
            contype[geom.id], conaffinity[geom.id] = geom.contype, geom.conaffinity
            named[geom.id] = bool(geom.name) and geom.name in paired
    meets = (contype[:, None] & conaffinity[None, :]) != 0
    elsewhere = model.geom_bodyid[:, None] != model.geom_bodyid[None, :]
    soft = (contype | conaffinity != 0) if model.nflex else np.zeros(model.ngeom, bool)
    out: NDArray[np.bool_] = ~(((meets | meets.T) & elsewhere).any(axis=1) | named | soft)
    return out


def _hull(model: mujoco.MjModel, mesh: int) -> NDArray[np.float32] | None:
    """(corners, 3) of a mesh's convex hull in the coordinates of its file, scaled; None where none was made."""
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        return None
    count = int(model.mesh_graph[start])
    corners = model.mesh_graph[start + 2 + count : start + 2 + 2 * count]
    first, number = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    if count >= number:
        return None
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[mesh])
    at = model.mesh_vert[first : first + number][corners] @ turn.reshape(3, 3).T + model.mesh_pos[mesh]
    return np.asarray(at, np.float32)
