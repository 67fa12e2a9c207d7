"""Hands on a robot, as its log shows them: it lies, is carried, or a joint gives way that nothing moves.

Joints, IMU and tracker say so together: a body that goes faster than its legs can take it is taken, and one whose lowest part,
by its joints and its attitude, is above the floor is lifted.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.regime import slope
from openant_tools.model.body import colliding, lowest, torso_body, upright
from openant_tools.model.plant import Plant, Setup
from openant_tools.recording.run import Run

__all__ = ["lifted", "lying", "pushed"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: s over which an attitude, a speed or a height is taken: a gait's own accelerations leave little of themselves on average
STEADY_S = 0.5
#: cosine of how far from upright a robot on its feet leans, and of how far a stand is turned from how it usually stood
LIES, TURNED = math.cos(math.radians(60)), math.cos(math.radians(30))
#: s between looks at where a body is, and from one to the nearest row that it says something of
LOOK_S, SEEN_S = 0.1, 0.3
#: m between the floor and the lowest part of a robot that is lifted, with and without its attitude; which of its heights is the floor
LIFTED_M, LEVEL_M, ON_FLOOR = 0.03, 0.08, 0.1
#: m/s and rad/s by which a body goes faster than its joints take it, and how much faster than a joint it may turn
TAKEN_M_S, TURNED_RAD_S, LEVER = 0.1, 1.0, 2.0
#: s without a command after which a joint rests, rad by which it is pushed, and rad within which it is back
RESTS_S, PUSHED_RAD, BACK_RAD = 0.5, 0.1, 0.03
#: rad/s of a joint that is at rest
REST_RAD_S = 0.1


def lying(run: Run, plant: Plant) -> Bools:
    """(rows,) where the body is on its side or back; on a stand, where that was turned away from how it usually stood."""
    up = _down(run)
    known = np.isfinite(up).all(axis=1)
    if not known.any():
        return np.zeros(len(run.t), bool)
    if plant.setup is Setup.FLOOR:
        return known & (up[:, 2] < LIES)
    usual = np.median(up[known], axis=0)
    return known & (up @ (usual / max(float(np.linalg.norm(usual)), 1e-9)) < TURNED)


def lifted(run: Run, plant: Plant) -> Bools:
    """(rows,) where hands carry the body: off the floor, or faster than its joints can."""
    speeds = np.stack([slope(run.t, one) for one in run.signal("pos", plant.joints).T], axis=1)
    legs = _steady(run.t, np.abs(speeds)).max(axis=1)
    gyro = _steady(run.t, run.signal("gyro", ("x", "y", "z")))
    out: Bools = np.nan_to_num(np.linalg.norm(gyro, axis=1)) > TURNED_RAD_S + LEVER * legs
    if plant.setup is not Setup.FLOOR:
        return out
    place = run.signal("base", ("x", "y", "z"))
    seen: Bools = np.asarray(np.isfinite(place[:, :2]).all(axis=1))
    rows = _looks(run.t, seen)
    if len(rows) > 2:
        ahead, behind = (
            _between(run.t + side * STEADY_S / 2, run.t[rows], _smooth(place[rows, :2])) for side in (1, -1)
        )
        span = np.minimum(run.t + STEADY_S / 2, run.t[rows[-1]]) - np.maximum(run.t - STEADY_S / 2, run.t[rows[0]])
        with np.errstate(divide="ignore", invalid="ignore"):
            speed = np.linalg.norm(ahead - behind, axis=1) / span
        out |= _near(run.t, run.t[rows]) & (span > STEADY_S / 2) & (speed > TAKEN_M_S + _reach(plant) * legs)
    out |= _off_the_floor(run, plant, place)
    return out


def _off_the_floor(run: Run, plant: Plant, place: Array) -> Bools:
    """(rows,) where the lowest part of the robot is above the floor, by its joints, its tracked height and its attitude."""
    pos = run.signal("pos", plant.joints)
    there: Bools = np.asarray(np.isfinite(np.column_stack([place[:, 2], pos])).all(axis=1))
    rows = _looks(run.t, there)
    out = np.zeros(len(run.t), bool)
    if len(rows) < 3 or plant.free_joint is None:
        return out
    quat, up = run.signal("base", ("qw", "qx", "qy", "qz"))[rows], _down(run)[rows]
    known = np.isfinite(quat).all(axis=1) | np.isfinite(up).all(axis=1)
    model, data = plant.model, mujoco.MjData(plant.model)
    adr = int(model.jnt_qposadr[plant.free_joint])
    height = np.empty(len(rows))
    for k, row in enumerate(rows):
        data.qpos[plant.qpos] = pos[row]
        data.qpos[adr : adr + 3] = 0.0, 0.0, place[row, 2]
        data.qpos[adr + 3 : adr + 7] = quat[k] if np.isfinite(quat[k]).all() else _leaning(up[k])
        mujoco.mj_kinematics(model, data)
        height[k] = lowest(plant, data)
    height = _smooth(height[:, None])[:, 0]
    above = height - np.quantile(height, ON_FLOOR) > np.where(known, LIFTED_M, LEVEL_M)
    out[:] = _near(run.t, run.t[rows]) & (np.interp(run.t, run.t[rows], above.astype(float)) > 0)
    return out


def _leaning(up: Array) -> Array:
    """The attitude (4,) of a body in whose frame `up` is upwards; level where nobody knows."""
    return upright(up) if np.isfinite(up).all() else np.array([1.0, 0.0, 0.0, 0.0])


def pushed(run: Run, plant: Plant) -> Bools:
    """(rows,) where a joint gives way from rest that nothing moved: neither a command of any joint nor its own weight.

    What sinks with its weight and stays is the servo's own, and tells of it.
    """
    t, pos, cmd = run.t, run.signal("pos", plant.joints), run.signal("cmd", plant.joints)
    row = np.maximum.accumulate(np.where(np.isfinite(cmd), np.arange(len(t))[:, None], 0), axis=0)
    changes = np.diff(np.take_along_axis(cmd, row, axis=0), axis=0, prepend=np.nan) != 0
    off = run.signal("torque", plant.joints, default=1.0) == 0
    changes |= off | (off != np.concatenate([off[:1], off[:-1]]))
    latest = np.maximum.accumulate(np.where(changes.any(axis=1), t, -np.inf))
    rests = t - latest > RESTS_S
    out = np.zeros(len(t), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rests, [False]]).astype(int)))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        for j in range(len(plant.joints)):
            rows = first + np.flatnonzero(np.isfinite(pos[first:stop, j]))
            if len(rows) > 2:
                moved = _pushed(t[rows], pos[rows, j])
                if moved is not None and not _sinks(run, plant, j, rows, pos, moved):
                    a, b = rows[moved[0]], rows[moved[1]]
                    out[a : b + 1] = True
    return out


def _pushed(t: Array, pos: Array) -> tuple[int, int] | None:
    """From which sample to which a joint was away from where it had come to rest; None where it was not, or never rested."""
    begin = t <= t[0] + 0.2
    if np.ptp(pos[begin]) > REST_RAD_S * 0.2 + BACK_RAD / 2:
        return None
    away = np.abs(pos - np.median(pos[begin]))
    if away.max() < PUSHED_RAD:
        return None
    beyond = np.flatnonzero(away > BACK_RAD)
    return int(beyond[0]), int(beyond[-1])


def _sinks(run: Run, plant: Plant, j: int, rows: NDArray[np.int64], pos: Array, moved: tuple[int, int]) -> bool:
    """Whether it went with its weight, as far as that is known, and stayed."""
    way = pos[rows[-1], j] - pos[rows[0], j]
    if moved[1] < len(rows) - 1 or abs(way) < PUSHED_RAD:
        return False
    if plant.setup is Setup.FLOOR or not np.isfinite(pos[rows[0]]).all():
        return True
    data = mujoco.MjData(plant.model)
    data.qpos[plant.qpos] = pos[rows[0]]
    mujoco.mj_forward(plant.model, data)
    return bool(-data.qfrc_bias[plant.dof[j]] * way > 0)


def _down(run: Run) -> Array:
    """(rows, 3) which way is up in the body's frame: by the tracker's attitude, else by the accelerometer on average; NaN where neither is."""
    quat = run.signal("base", ("qw", "qx", "qy", "qz"))
    w, x, y, z = quat.T
    seen = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w**2 - x**2 - y**2 + z**2], axis=1)
    acc = _steady(run.t, run.signal("acc", ("x", "y", "z")))
    with np.errstate(invalid="ignore", divide="ignore"):
        felt = acc / np.linalg.norm(acc, axis=1, keepdims=True)
    return np.where(np.isfinite(seen), seen, felt)


def _steady(t: Array, values: Array) -> Array:
    """(rows, columns) means over STEADY_S about each row, missing samples bridged; NaN where a column has none."""
    out = np.full(values.shape, np.nan)
    for k, column in enumerate(values.T):
        known = np.isfinite(column)
        if known.sum() < 2:
            continue
        area = np.concatenate([[0.0], np.cumsum(np.diff(t) * _mid(np.interp(t, t[known], column[known])))])
        a, b = np.maximum(t - STEADY_S / 2, t[0]), np.minimum(t + STEADY_S / 2, t[-1])
        out[:, k] = (np.interp(b, t, area) - np.interp(a, t, area)) / np.maximum(b - a, 1e-9)
        out[~_near(t, t[known]), k] = np.nan
    return out


def _mid(values: Array) -> Array:
    out: Array = (values[1:] + values[:-1]) / 2
    return out


def _looks(t: Array, there: Bools) -> NDArray[np.int64]:
    """Rows with a sample, LOOK_S apart."""
    rows, last = [], -math.inf
    for row in np.flatnonzero(there):
        if t[row] - last >= LOOK_S - 1e-9:
            rows.append(int(row))
            last = t[row]
    return np.array(rows, np.int64)


def _smooth(values: Array) -> Array:
    """(looks, columns) medians of five: a single wrong pose is no motion."""
    padded = np.concatenate([values[:1].repeat(2, 0), values, values[-1:].repeat(2, 0)])
    out: Array = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1)
    return out


def _near(t: Array, seen: Array) -> Bools:
    """(rows,) within SEEN_S of a sample at times `seen`."""
    after = np.clip(np.searchsorted(seen, t), 1, max(len(seen) - 1, 1))
    nearest = np.minimum(np.abs(seen[np.minimum(after, len(seen) - 1)] - t), np.abs(seen[after - 1] - t))
    out: Bools = nearest <= SEEN_S
    return out


def _between(at: Array, t: Array, values: Array) -> Array:
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def _reach(plant: Plant) -> float:
    """m from the body to the farthest part of the robot, about."""
    model, data = plant.model, mujoco.MjData(plant.model)
    mujoco.mj_kinematics(model, data)
    base = torso_body(model, plant)
    away = np.linalg.norm(data.geom_xpos[colliding(model)] - data.xpos[base], axis=1)
    return float(away.max(initial=0.0))
