"""A robot's masses and what it stands on, in a compiled model: which numbers they are, and how they change together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.model.plant import Plant, world_bodies

__all__ = [
    "Contacts", "colliding", "contact_number", "floor_contacts", "link_bodies", "lowest", "scale_mass", "torso_body", "upright",
]  # fmt: skip

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def link_bodies(model: mujoco.MjModel, plant: Plant, j: int) -> Ints:
    """The bodies that joint j moves as one piece: its own, and those fixed to it."""
    own = int(model.jnt_bodyid[model.dof_jntid[plant.dof[j]]])
    return np.flatnonzero(model.body_weldid == model.body_weldid[own]).astype(np.int64)


def torso_body(model: mujoco.MjModel, plant: Plant) -> int:
    """The body that carries all others of the robot: the one with the free joint, on the floor."""
    first = int(model.jnt_bodyid[model.dof_jntid[plant.dof[0]]])
    return int(model.body_rootid[first])


def scale_mass(model: mujoco.MjModel, bodies: Ints, factor: float) -> None:
    """Make bodies denser: mass and inertia together, so that the inertia stays one that a solid of this shape can have."""
    model.body_mass[bodies] *= factor
    model.body_inertia[bodies] *= factor


@dataclass(frozen=True)
class Contacts:
    """What decides how the robot meets the world: ids of geoms, and of pairs."""

    geoms: Ints
    pairs: Ints


def floor_contacts(model: mujoco.MjModel) -> Contacts:
    """The geoms and pairs whose friction and softness decide what happens at the floor.

    A <pair> decides for its two geoms. Else, of two geoms the one of higher priority decides alone, and of equal priority both
    (MuJoCo's rules). So these are the pairs with the world, and the world's geoms where they have priority over all of the
    robot's, else all that may touch anything.
    """
    of_world = np.isin(model.geom_bodyid, list(world_bodies(model)))
    touches = (model.geom_contype | model.geom_conaffinity) != 0
    robot = touches & ~of_world
    highest = int(model.geom_priority[robot].max(initial=0))
    alone = of_world & (model.geom_priority > highest)
    geoms = np.flatnonzero(alone if alone.any() else robot | (of_world & touches)).astype(np.int64)
    with_world = of_world[model.pair_geom1] | of_world[model.pair_geom2]
    return Contacts(geoms, np.flatnonzero(with_world).astype(np.int64))


def contact_number(field: str, columns: int) -> tuple[Callable[..., float], Callable[..., None]]:
    """Reader and writer of the first number of a contact's field: the greatest of all; all are scaled alike.

    Args:
        field: as after `geom_` and `pair_`.
        columns: how many of a pair's numbers mean the same (its friction has two sliding directions).
    """

    def numbers(model: mujoco.MjModel) -> tuple[Array, Array]:
        contacts = floor_contacts(model)
        # A negative time constant is a stiffness (`solref`): it is none, and stays.
        geoms = np.asarray(getattr(model, f"geom_{field}"))[contacts.geoms, 0]
        pairs = np.asarray(getattr(model, f"pair_{field}"))[contacts.pairs, 0]
        return geoms, pairs

    def read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
        return max(float(part.max(initial=0.0)) for part in numbers(model))

    def write(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
        contacts, factor = floor_contacts(model), value / read(model, plant, j)
        geoms, pairs = numbers(model)
        getattr(model, f"geom_{field}")[contacts.geoms, 0] *= np.where(geoms > 0, factor, 1.0)
        for column in range(columns):
            getattr(model, f"pair_{field}")[contacts.pairs, column] *= np.where(pairs > 0, factor, 1.0)

    return read, write


def colliding(model: mujoco.MjModel) -> Ints:
    """The geoms of the robot that can touch something."""
    touches = (model.geom_contype | model.geom_conaffinity) != 0
    return np.flatnonzero(touches & ~np.isin(model.geom_bodyid, list(world_bodies(model)))).astype(np.int64)


def lowest(plant: Plant, data: mujoco.MjData) -> float:
    """m, how high the lowest point of the robot is, after `mj_kinematics`; boxes about its meshes stand for them."""
    model, geoms = plant.model, colliding(plant.model)
    if not len(geoms):
        return 0.0
    down = np.abs(data.geom_xmat[geoms].reshape(-1, 3, 3)[:, 2])
    size, kind = model.geom_size[geoms], model.geom_type[geoms]
    half, centre = model.geom_aabb[geoms, 3:], model.geom_aabb[geoms, :3]
    below: Array = np.sum(down * half, axis=1) - np.sum(data.geom_xmat[geoms].reshape(-1, 3, 3)[:, 2] * centre, axis=1)
    ball = kind == mujoco.mjtGeom.mjGEOM_SPHERE
    pill = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
    can = kind == mujoco.mjtGeom.mjGEOM_CYLINDER
    below[ball] = size[ball, 0]
    below[pill] = size[pill, 0] + down[pill, 2] * size[pill, 1]
    below[can] = size[can, 0] * np.sqrt(np.maximum(1 - down[can, 2] ** 2, 0.0)) + down[can, 2] * size[can, 1]
    return float(np.min(data.geom_xpos[geoms, 2] - below))


def upright(up: Array) -> Array:
    """(4,) the shortest turn that brings `up` (3,) to the world's z."""
    x, y, z = up / max(float(np.linalg.norm(up)), 1e-12)
    quat: Array = np.array([1.0 + z, y, -x, 0.0]) if z > -1.0 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    return quat / np.linalg.norm(quat)
