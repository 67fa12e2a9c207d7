"""Whether a model's servos can hold still in the model's own time steps.

A step of the simulation maps positions, velocities and activations to those of the next. Linearised about a pose at rest, without
what bounds it (dry friction, force limits, stops, contacts), it grows by |λ| a step along each eigenvector: what grows although the
same model does not in much finer steps is no motion of the robot but of the integrator, and limits of force turn it into a trembling.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.model.plant import Plant
from openant_tools.model.rollout import fill_setpoints

__all__ = ["NUDGE", "growth"]

Array = NDArray[np.float64]

#: rad and rad/s by which states are moved to see what becomes of it
NUDGE = 1e-6
#: what bounds a motion once it is large, or holds it while it is small
BOUNDS = ("CONTACT", "LIMIT", "FRICTIONLOSS", "CLAMPCTRL")


def growth(plant: Plant, pose: Array, parts: int = 1) -> float:
    """1/s at which what moves the fastest away from a pose does so, its servos commanded there; negative where all comes to rest.

    A free base is held.

    Args:
        pose: (joints,) rad.
        parts: into how many the model's time step is cut.
    """
    model = copy.copy(plant.model)
    for name in BOUNDS:
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    model.opt.timestep /= parts
    step = _linearised(plant, model, pose)
    held = np.isin(model.jnt_type[model.dof_jntid], (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))
    free = np.flatnonzero(np.concatenate([~held, ~held, np.ones(model.na, bool)]))
    fastest = float(np.abs(np.linalg.eigvals(step[np.ix_(free, free)])).max(initial=0.0))
    return float(np.log(max(fastest, np.finfo(float).tiny)) / model.opt.timestep)


def _linearised(plant: Plant, model: mujoco.MjModel, pose: Array) -> Array:
    """(n, n) how positions (in their tangent space), velocities and activations after a step follow those before it.

    By hand, as `mjd_transitionFD` takes neither delays nor RK4.
    """
    data, nv, na = mujoco.MjData(model), model.nv, model.na
    data.qpos[plant.qpos] = pose
    fill_setpoints(plant, data, pose)
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    still, moved = data.qpos.copy(), np.empty(nv)
    out = np.empty((2 * nv + na, 2 * nv + na))
    for k in range(2 * nv + na):
        ends = []
        for nudge in (-NUDGE, NUDGE):
            mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
            if k < nv:
                moved[:] = 0.0
                moved[k] = nudge
                mujoco.mj_integratePos(model, data.qpos, moved, 1.0)
            elif k < 2 * nv:
                data.qvel[k - nv] += nudge
            else:
                data.act[k - 2 * nv] += nudge
            mujoco.mj_step(model, data)
            mujoco.mj_differentiatePos(model, moved, 1.0, still, data.qpos)
            ends.append(np.concatenate([moved, data.qvel, data.act]))
        out[:, k] = (ends[1] - ends[0]) / (2 * NUDGE)
    return out
