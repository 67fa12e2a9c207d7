"""The paper's test of contacts: a robot that twitches fast on the floor must stay where it is.

Hard, bouncing contacts let a simulated robot travel by high-frequency commands that do nothing on a real floor, and an
agent finds that out. `solref` and `solimp` of the feet were chosen by the paper so that it does not.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant
from openant_tools.model.rollout import fill_setpoints
from openant_tools.sysid.excitation import CommandSpace

__all__ = ["PAPER_SOLIMP", "PAPER_SOLREF", "STAYS_M_S", "Travel", "travel", "with_paper_contacts"]

Array = NDArray[np.float64]

#: m/s; a robot that drifts slower than a walking one's noise (2 cm/s is a poor gait) is taken to stay
STAYS_M_S = 0.005
SETTLE_S, FADE_S = 1.5, 0.3
RATE_HZ = 100.0
#: faster than any step of a gait, slow enough for a servo to follow a part of it
BAND_HZ = (6.0, 10.0)
#: at the Ant's feet 4 mm: less than what slips on a floor of friction 0.6, so that nothing excuses travelling
AMPLITUDE_RAD = 0.03
#: `solref` and `solimp` with which the paper's Ant stays (its own files')
PAPER_SOLREF, PAPER_SOLIMP = (0.02, 1.5), (0.7, 0.9, 0.02, 0.5, 2.0)
#: m above the floor from which the robot is put down
DROP_M = 0.02


@dataclass(frozen=True)
class Travel:
    """Where twitching takes a simulated robot.

    Attributes:
        distance_m: between where it stood before and after, in the floor's plane.
        turn_rad: by which it turned.
        seconds: of twitching.
        path: (n, 2) m, of the torso, row by row at RATE_HZ.
    """

    distance_m: float
    turn_rad: float
    seconds: float
    path: Array

    @property
    def speed(self) -> float:
        """m/s."""
        return self.distance_m / self.seconds

    @property
    def stays(self) -> bool:
        return self.speed < STAYS_M_S


def travel(plant: Plant, space: CommandSpace, seeds: Sequence[int] = range(4), seconds: float = 6.0) -> Travel:
    """Twitch on the floor with several seeds; the one that travels farthest.

    Args:
        plant: on the floor.
        space: the range of commands.
        seconds: of each.

    Raises:
        BadInput: the model has no free joint, or falls over.
    """
    return max((_once(plant, space, seed, seconds) for seed in seeds), key=lambda found: found.distance_m)


def with_paper_contacts(plant: Plant) -> Plant:
    """The same robot with the paper's softness in every contact."""
    model = copy.copy(plant.model)
    model.geom_solref[:], model.geom_solimp[:] = PAPER_SOLREF, PAPER_SOLIMP
    return replace(plant, model=model)


def _once(plant: Plant, space: CommandSpace, seed: int, seconds: float) -> Travel:
    model, free = plant.model, plant.free_joint
    if free is None:
        raise BadInput(
            "the model has no free joint, so nothing can travel", where=plant.path, remedy="name a whole robot"
        )
    adr = int(model.jnt_qposadr[free])
    commands = _commands(space, seed, seconds)
    data = mujoco.MjData(model)
    data.qpos[plant.qpos] = commands[0]
    mujoco.mj_kinematics(model, data)
    data.qpos[adr + 2] += DROP_M - _clearance(model, data)
    fill_setpoints(plant, data, commands[0])
    mujoco.mj_step(model, data, nstep=round(SETTLE_S / plant.timestep))
    path = np.empty((len(commands), 2))
    start = _yaw(data.qpos[adr + 3 : adr + 7])
    substeps = max(1, round(1.0 / RATE_HZ / plant.timestep))
    for k, command in enumerate(commands):
        path[k] = data.qpos[adr : adr + 2]
        data.ctrl[plant.ctrl] = command
        mujoco.mj_step(model, data, nstep=substeps)
    if not np.isfinite(data.qpos).all() or data.xmat[_base(plant), 8] < 0.5:
        raise BadInput("the robot falls over when it twitches", where=plant.path, remedy="check masses and contacts")
    turn = (_yaw(data.qpos[adr + 3 : adr + 7]) - start + math.pi) % (2 * math.pi) - math.pi
    return Travel(float(np.linalg.norm(path[-1] - path[0])), turn, len(commands) / RATE_HZ, path)


def _commands(space: CommandSpace, seed: int, seconds: float) -> Array:
    """(n, joints) rad: each joint fast and small at a phase of its own, so that no symmetry holds the robot in place."""
    chance = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    phase, hz = chance.uniform(0, 2 * np.pi, len(space.joints)), chance.uniform(*BAND_HZ)
    fade = np.clip(np.minimum(t, seconds - t) / FADE_S, 0.0, 1.0)[:, None]
    wave = AMPLITUDE_RAD * fade * np.sin(2 * np.pi * hz * t[:, None] + phase)
    commands: Array = np.clip(space.home + wave, space.low, space.high)
    return commands


def _base(plant: Plant) -> int:
    assert plant.free_joint is not None
    return int(plant.model.jnt_bodyid[plant.free_joint])


def _clearance(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """m between the lowest point of what moves and z = 0, by bounding spheres' boxes."""
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0)
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1)
    lowest = math.inf
    for geom in moving:
        box = model.geom_aabb[geom]
        points = data.geom_xmat[geom].reshape(3, 3) @ (box[:3, None] + box[3:, None] * corners)
        lowest = min(lowest, float(data.geom_xpos[geom, 2] + points[2].min()))
    return lowest


def _yaw(quat: Array) -> float:
    w, x, y, z = quat
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
