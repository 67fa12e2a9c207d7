"""When rows, commands and switches of one robot happen, and the goals that its servos' loops follow because of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from openant_tools.blind.commands import RATE_HZ, Motion
from openant_tools.blind.robot import Clocks

__all__ = ["PRE_ROLL_S", "Schedule", "goals", "schedule"]

Array = NDArray[np.float64]

#: s before the first row, in which the first command holds
PRE_ROLL_S = 0.1


@dataclass(frozen=True)
class Schedule:
    """Of one run: true times, and what the host writes down.

    Attributes:
        row: (n,) s since the simulation's start, when a row is sampled. t, cmd_t: (n,) as logged.
        arrival: (n, joints) s, when each command takes effect; NaN where it is lost.
        switch: (n,) s, when torque follows `limp`.
        steps: of the simulation.
    """

    row: Array
    t: Array
    cmd_t: Array
    arrival: Array
    switch: Array
    steps: int


def schedule(clocks: Clocks, motion: Motion, step_s: float, chance: np.random.Generator) -> Schedule:
    n, joints = motion.commands.shape
    row = PRE_ROLL_S + np.arange(n) / RATE_HZ + np.clip(chance.standard_normal(n), -3, 3) * clocks.row_s
    gap = clocks.gap_s + np.abs(chance.standard_normal(n)) * clocks.gap_scatter_s
    sent = row + gap
    arrival = np.repeat((sent + clocks.base_s + clocks.jitter * chance.standard_normal(n))[:, None], joints, axis=1)
    # A bus keeps the order of what is sent.
    arrival = np.maximum.accumulate(arrival + clocks.delay, axis=0)
    arrival[_lost(clocks, n, chance)] = np.nan
    since = row[0]
    stamp = (1 + clocks.ppm * 1e-6) * (row - since) + np.clip(chance.standard_normal(n), -3, 3) * clocks.stamp_s
    return Schedule(
        row, stamp - stamp[0], stamp + gap + np.clip(chance.standard_normal(n), -3, 3) * 5e-5 - stamp[0], arrival,
        row + chance.uniform(0.0, 1e-3), int((row[-1] + 0.05) / step_s),
    )  # fmt: skip


def _lost(clocks: Clocks, n: int, chance: np.random.Generator) -> NDArray[np.bool_]:
    """(n, joints): runs of rows, of even lengths up to the longest, so that a fraction of all is lost."""
    lost = np.zeros((n, 8), bool)
    if not clocks.lost.any():
        return lost
    # Either a packet for all is lost, or each servo loses its own.
    together = bool(chance.random() < 0.5)
    for k in np.flatnonzero(clocks.lost):
        longest = max(1, round(float(clocks.longest[k]) * RATE_HZ))
        at = 1
        while at < n:
            run = int(chance.integers(1, longest + 1))
            pause = chance.exponential((1 + longest) / 2 * (1 / clocks.lost[k] - 1))
            at += 1 + int(pause)
            lost[at : at + run, k] = True
            at += run
    first = int(np.flatnonzero(clocks.lost)[0])
    if together:
        lost[:, clocks.lost > 0] = lost[:, [first]]
    return lost


def goals(plan: Schedule, clocks: Clocks, motion: Motion, step_s: float) -> tuple[Array, NDArray[np.bool_]]:
    """(steps, joints) rad that the loops see, and whether torque is on."""
    times = np.arange(plan.steps) * step_s
    goal = np.empty((plan.steps, motion.commands.shape[1]))
    for j in range(goal.shape[1]):
        there = np.flatnonzero(np.isfinite(plan.arrival[:, j]))
        index = np.searchsorted(plan.arrival[there, j], times, side="right") - 1
        goal[:, j] = np.where(index >= 0, motion.commands[there[np.maximum(index, 0)], j], motion.commands[0, j])
    for j in map(int, np.flatnonzero(clocks.lag > 0)):
        share = 1 - np.exp(-step_s / clocks.lag[j])
        goal[:, j] = lfilter([share], [1, share - 1], goal[:, j], zi=[(1 - share) * goal[0, j]])[0]
    slow = np.flatnonzero(np.isfinite(clocks.slew))
    if len(slow):
        most = clocks.slew[slow] * step_s
        now = goal[0, slow].copy()
        for row in goal:
            now += np.minimum(np.maximum(row[slow] - now, -most), most)
            row[slow] = now
    index = np.searchsorted(plan.switch, times, side="right") - 1
    on = np.where((index >= 0)[:, None], ~motion.limp[np.maximum(index, 0)], True)
    return goal, on
