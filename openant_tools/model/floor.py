"""What no model could beat: the floor of the gap (formats, section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.model.gap import gap
from openant_tools.numbers import number
from openant_tools.recording.run import Run

__all__ = ["disagreement", "floors", "noise", "resolution", "sensor_floors", "stamp_error", "steps"]

Array = NDArray[np.float64]
#: smaller changes are rounding of the numbers, not steps of a sensor
LEAST_STEP = 1e-9
#: s for which a command has not changed where a joint is taken to be at rest, and rows at rest without which nothing is said of noise
SETTLED_S, RESTING = 0.5, 20
#: order of the divided differences that smooth motion does not show in; s of motion that goes together
ORDER, TOGETHER_S = 6, 1.0
#: of such times, how many say how sure it is
BLOCKS = 3
#: rad/s below which a joint moves too little to show the error of a stamp
MOVES_RAD_S = 0.2
#: standard deviations within which half of a normal distribution lies
HALF_WITHIN = 0.6745
#: standard errors by which a variance of time stamps has to differ from none
SHOWS = 3.0
#: Repeats of the same commands that differ by more than this times what the sensors leave are no repeats: something else moved.
AGREE = 3.0


def resolution(run: Run, signal: str, joint: str) -> float:
    """The sensor's step, in the signal's unit: from the run's facts, else the smallest change in the data; 0 if there is none."""
    known = run.facts.resolution.get(f"{signal}.{joint}", run.facts.resolution.get(signal))
    if known is not None:
        return known
    steps = np.abs(np.diff(run.column(f"{signal}.{joint}")))
    steps = steps[np.isfinite(steps) & (steps > LEAST_STEP)]
    return float(steps.min()) if len(steps) else 0.0


def steps(runs: Sequence[Run], signal: str, joints: Sequence[str]) -> Array:
    """(joints,) the coarsest step of each joint's sensor in any run."""
    return np.array([max(resolution(run, signal, joint) for run in runs) for joint in joints])


def noise(run: Run, signal: str, joints: Sequence[str]) -> Array:
    """(joints,) what scatters from row to row while each is at rest, in the signal's unit; 0 where it never rests.

    At rest as far as commands say: of a robot that still settles or is shaken divided differences leave nothing, or seldom.
    """
    rows, weights = _differences(run.t)
    commands = run.signal("cmd", joints)
    changed = np.diff(commands, axis=0, prepend=np.nan) != 0
    since = np.maximum.accumulate(np.where(changed, run.t[:, None], -np.inf), axis=0)
    resting = np.logical_and.reduce((run.t[:, None] - since > SETTLED_S)[rows], axis=1)
    scatter = np.abs(np.einsum("ki,kij->kj", weights, run.signal(signal, joints)[rows]))
    each = [scatter[resting[:, j] & np.isfinite(scatter[:, j]), j] for j in range(len(joints))]
    return np.array([np.median(one) / HALF_WITHIN if len(one) >= RESTING else 0.0 for one in each])


def stamp_error(runs: Sequence[Run], joints: Sequence[str]) -> float:
    """s, the standard deviation of a row's time stamp from when its joints were sampled; 0 where nothing shows it.

    All joints of a row share its stamp, and what that is off by moves each in proportion to its speed. Divided differences of high
    order leave nothing of smooth motion, however rows are spaced; products of two joints nothing of the noise of either. Of one
    joint that moves by itself nobody can tell.
    """
    top: list[Array] = [np.zeros(0)]
    bottom: list[Array] = [np.zeros(0)]
    for run in runs:
        rows, weights = _differences(run.t)
        pos = run.signal("pos", joints)
        if not len(rows):
            continue
        rest = np.einsum("ki,kij->kj", weights, pos[rows])
        speed = np.gradient(pos, run.t, axis=0)[rows]
        known = np.isfinite(rest) & (np.abs(speed) > MOVES_RAD_S).all(axis=1)
        rest, speed = np.where(known, rest, 0.0), np.where(known[:, None], speed, 0.0)
        shared = np.einsum("ki,kia,kib->kab", weights**2, speed, speed)
        a, b = np.triu_indices(len(joints), 1)
        product, shared = rest[:, a] * rest[:, b], shared[:, a, b]
        block = ((run.t[rows[:, 0]] - run.t[0]) / TOGETHER_S).astype(int)
        top.append(np.bincount(block, (product * shared).sum(axis=1)).astype(np.float64))
        bottom.append(np.bincount(block, np.square(shared).sum(axis=1)).astype(np.float64))
    gained, could = np.concatenate(top), np.concatenate(bottom)
    if (could > 0).sum() < BLOCKS:
        return 0.0
    variance = float(gained.sum() / could.sum())
    error = float(np.sqrt(np.square(gained - variance * could).sum()) / could.sum())
    return math.sqrt(variance) if variance > SHOWS * error else 0.0


def _differences(t: Array) -> tuple[NDArray[np.int64], Array]:
    """Divided differences of all rows that follow each other: (differences, rows) which rows; their weights, of length 1.

    None where there are too few rows, or any that do not come one after another.
    """
    if len(t) <= ORDER or not (np.diff(t) > 0).all():
        return np.zeros((0, ORDER + 1), np.int64), np.zeros((0, ORDER + 1))
    rows = np.lib.stride_tricks.sliding_window_view(np.arange(len(t)), ORDER + 1)
    apart = t[rows][:, :, None] - t[rows][:, None, :] + np.eye(ORDER + 1)
    weights = 1 / apart.prod(axis=2)
    return rows, weights / np.linalg.norm(weights, axis=1, keepdims=True)


def floors(runs: Sequence[Run], joints: Sequence[str], signal: str = "pos") -> tuple[Array, bool]:
    """(joints,) rms that remains with any model, and whether repeats of the same commands have shown it.

    A joint of which no repeat says anything has what its sensor leaves: the coarsest step / √12, or its noise at rest where that is
    more than a step; and what it moves within the error of a row's time stamp.
    """
    by_sensors = sensor_floors(runs, joints, signal)
    by_name = {run.name: run for run in runs}
    pairs = [(run, by_name[run.facts.repeat_of]) for run in runs if run.facts.repeat_of in by_name]
    squares = np.full((len(pairs), len(joints)), np.nan)
    for k, (again, once) in enumerate(pairs):
        second, first = again.signal(signal, joints), once.signal(signal, joints)
        t = again.t - again.t[0] + once.t[0]
        for j in range(len(joints)):
            seen = np.isfinite(first[:, j])
            if seen.sum() > 1:
                # Two repeats differ by both their noises, so that each has half of the squared difference.
                squares[k, j] = gap(second[:, j], np.interp(t, once.t[seen], first[seen, j])) ** 2 / 2
    known = np.isfinite(squares)
    mean = np.where(known, squares, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), np.sqrt(mean), by_sensors), bool(known.any())


def sensor_floors(runs: Sequence[Run], joints: Sequence[str], signal: str = "pos") -> Array:
    """(joints,) rms that the sensors and the rows' time stamps leave by themselves."""
    step, at_rest = steps(runs, signal, joints), np.max([noise(run, signal, joints) for run in runs], axis=0)
    # Less than a step is an encoder between two of them, and what that leaves is known.
    sensors = np.where(at_rest > step, at_rest, step / math.sqrt(12))
    return np.asarray(np.hypot(sensors, stamp_error(runs, joints) * _speeds(runs, joints, signal)), float)


def disagreement(runs: Sequence[Run], joints: Sequence[str]) -> str:
    """Why repeats of one motion say nothing of what a model could reach; "" where they agree, or where there are none."""
    found, from_repeats = floors(runs, joints)
    least = sensor_floors(runs, joints)
    if not from_repeats or not least.any():
        return ""
    shown, sensors = (float(np.sqrt(np.mean(np.square(each)))) for each in (found, least))
    if shown <= AGREE * sensors:
        return ""
    worst = joints[int(np.argmax(found / np.maximum(least, 1e-12)))]
    return (
        f"the repeats disagree: two plays of one motion differ by {number(shown, 'rad', name='error')}, {number(shown / sensors, decimals=0)} times what the sensors "
        f"leave, most at {worst} → something changed between them (heat, a loose horn, another start): record them again"
    )


def _speeds(runs: Sequence[Run], joints: Sequence[str], signal: str) -> Array:
    """(joints,) root mean square of how fast a signal changes, in its unit per second."""
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = [np.square(np.diff(run.signal(signal, joints), axis=0) / np.diff(run.t)[:, None]) for run in runs]
    each = np.concatenate(squares)
    known = np.isfinite(each)
    mean: Array = np.where(known, each, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.sqrt(mean)
