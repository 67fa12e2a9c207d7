"""How well a fit knows what it found: what no residual shows, the jackknife over blocks, and two halves of the data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from openant_tools.sysid.dataset import Dataset, runs_of
from openant_tools.sysid.forward import ForwardModel
from openant_tools.sysid.solve import Descent, Point, Prior
from openant_tools.sysid.weights import Weighing, Weights

__all__ = ["TIMING_STD_S", "TWO_SIDED_95", "halves", "left_open", "wider_by_blocks"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: 95 % of a normal distribution
TWO_SIDED_95 = 1.96
#: half of the ±2 ms within which delays count as calibrated (effects.md)
TIMING_STD_S = 1e-3
#: models about the estimate that are looked at for how contacts chatter
CHATTER_LOOKS = 4
#: a block of the resampling is this many autocorrelation times long, and at least so many seconds; fewer blocks tell nothing
BLOCK_TIMES, BLOCK_S, FEWEST_BLOCKS = 5.0, 0.5, 8
#: chance of calling two halves of good data contradictory, over all parameters of a fit
FALSE_ALARM = 1e-3
#: rounds in which each half finds its own weights
OWN_WEIGHTS = 4


def left_open(model: ForwardModel, found: Descent, weights: Weights) -> Array:
    """(parameters, causes): how what no residual can show pulls at each parameter.

    One standard deviation of each joint's sampling time; then, of all joints together, all that the time step does, and
    how contacts chatter.
    """
    point, tangent, trust = found.point, found.tangent, weights.each**2
    late = _late(model.datasets, point) * trust
    shared = [part * trust for part in (_time_step(model, point), *_chatter(model, found))]
    out = np.zeros((len(point.u), late.shape[1] + len(shared)))
    for j, (p, _) in enumerate(tangent.movers):
        moves = tangent.moves(j)
        out[p, j] = moves @ late[:, j]
        for k, part in enumerate(shared):
            out[p, late.shape[1] + k] += moves @ part[:, j]
    return out


def _late(datasets: Sequence[Dataset], point: Point) -> Array:
    """(rows, joints) rad: what one standard deviation of each joint's unknown sampling time does to its position.

    A bus log's `t` is when the read begins; a servo samples at some moment before the last byte of its answer. What
    the stamps leave open, the intervals of the parameters must hold: a millisecond is several per cent of a servo's
    lag. The moment is taken as anywhere in the round trip where that is logged; and a servo acts on a command, and
    notes where it is, once in a period of its own.
    """
    late = np.full(point.velocity.shape, TIMING_STD_S)
    for data, run, rows in runs_of(datasets):
        for j, joint in enumerate(data.plant.joints):
            rtt = run.column(f"rtt.{joint}")
            if np.isfinite(rtt).any():
                late[rows, j] = math.hypot(TIMING_STD_S, np.nanmedian(rtt) / math.sqrt(3))
    moved: Array = np.nan_to_num(point.velocity * late)
    return moved


def _time_step(model: ForwardModel, point: Point) -> Array:
    """(rows, joints) rad: what the model's own time step does to positions, by Richardson's rule from half of it.

    A step h of an implicit integrator brakes a joint of damping D as if it had h·D more inertia, among the like: the
    values that fit best are those of the model with its step, and the robot's own lie about that far off.
    """
    out, begin = [], 0
    for data in model.datasets:
        simulated = data.measured - point.residual[begin : begin + len(data.measured)]
        begin += len(data.measured)
        if data.plant.model.nhistory:
            out.append(np.zeros_like(data.measured))  # buffers hold a number of steps, too few at half of one
            continue
        model.evaluations += 1
        if model.coarse and not model.on_floor and data.coarse is not data:
            twice = data.coarse.simulate(model.parameters, [point.u]).pos[0]
            out.append(np.nan_to_num(simulated - twice))
        else:
            half = data.stepped(0.5).simulate(model.parameters, [point.u]).pos[0]
            out.append(2.0 * np.nan_to_num(half - simulated))
    return np.concatenate(out)


def _chatter(model: ForwardModel, found: Descent) -> list[Array]:
    """(rows, joints) rad each: what models near the estimate do beyond the tangent, on the floor.

    There a hair's difference lets a foot slip a moment earlier, and the rest of the run is another. A robot is such a model
    too: no estimate is better than that.
    """
    if not model.on_floor:
        return []
    point = found.point
    moved = model.differences * np.random.default_rng(0).standard_normal((CHATTER_LOOKS, len(point.u)))
    near = model.look(list(np.clip(point.u + moved, model.low, model.high)))
    beyond = (one.residual - point.residual - found.tangent.along(one.u - point.u) for one in near)
    return [np.nan_to_num(one) / math.sqrt(CHATTER_LOOKS) for one in beyond]


def wider_by_blocks(
    datasets: Sequence[Dataset], found: Descent, weights: Weights, precision: Array, free: Bools
) -> Array:
    """(parameters,) how many times wider intervals are if each block of the runs counts as one observation, at least 1.

    The jackknife over blocks, to first order (Miller 1974; cluster-robust "CR3"): how far the estimate moves when one
    block is left out, the prior staying. It needs no model of the residual: whether errors last, come with a single
    fast motion, or differ from motion to motion, blocks hold them whole. A block that alone tells a parameter moves it
    far. Where blocks are few it is rough, so that it may widen intervals only.

    Args:
        precision: (parameters, parameters) the prior included. free: which parameters are at no bound.
    """
    block = _blocks(datasets, weights)
    count = int(block.max()) + 1
    if count < FEWEST_BLOCKS:
        return np.ones(len(free))
    inside = np.ix_(free, free)
    moved = np.empty((count, int(free.sum())))
    edges = np.flatnonzero(np.diff(block, prepend=-1, append=count))
    # Block by block: there are the more of them the longer the runs are, and all they tell at once would fill memory.
    for b, (first, stop) in enumerate(itertools.pairwise(edges)):
        told, pulled = np.zeros(precision.shape), np.zeros(len(free))
        weight, left = weights.each[first:stop], np.nan_to_num(found.point.residual[first:stop])
        for j, (p, colour) in enumerate(found.tangent.movers):
            part = found.tangent.change[colour, first:stop, j] * weight[:, j]
            told[np.ix_(p, p)] += part @ part.T
            pulled[p] += part @ (weight[:, j] * left[:, j])
        moved[b] = np.linalg.solve((precision - told)[inside], pulled[free])
    moved -= moved.mean(axis=0)
    give = np.linalg.inv(precision[inside])
    robust = (count - 1) / count * (moved**2).sum(axis=0) + (give**2).sum(axis=0)
    wider = np.ones(len(free))
    wider[free] = np.sqrt(np.maximum(1.0, robust / np.diag(np.linalg.inv(precision))[free]))
    return wider


def _blocks(datasets: Sequence[Dataset], weights: Weights) -> Ints:
    """(rows,) number of each row's block, in order; a block is a part of one run."""
    seconds = max(BLOCK_S, BLOCK_TIMES * float(weights.correlation_s.max(initial=0.0)))
    out, count = [], 0
    for _, run, _ in runs_of(datasets):
        parts = max(1, round(run.duration_s / seconds))
        part = np.minimum((run.t - run.t[0]) / max(run.duration_s, 1e-9) * parts, parts - 1).astype(np.int64)
        part = np.unique(part, return_inverse=True)[1]
        out.append(part + count)
        count += int(part.max()) + 1
    return np.concatenate(out)


def halves(
    datasets: Sequence[Dataset], weighing: Weighing, found: Descent, prior: Prior, free: Bools
) -> tuple[Array, Bools]:
    """What the first half of the runs (of a single one, its first half) and the second say, and where they differ.

    Each half with the prior and with weights of its own, to first order from where both together end: a half that
    disagrees counts for little in the whole, whose misfit to it is large. They differ by more than chance where
    chance, as the residuals' size and memory make it, would do so once in 1 / FALSE_ALARM fits.
    """
    point, tangent, n = found.point, found.tangent, len(found.point.u)
    ends = [rows.stop for _, _, rows in runs_of(datasets)]
    middle = ends[len(ends) // 2 - 1] if len(ends) > 1 else ends[0] // 2
    first = np.arange(len(point.residual)) < middle
    each, inverses = np.full((2, n), np.nan), []
    inside = np.ix_(free, free)
    for k, rows in enumerate((first, ~first)):
        step = np.zeros(n)
        for _ in range(OWN_WEIGHTS):
            weights = weighing(replace(point, residual=point.residual + tangent.along(step)))
            precision, gradient = tangent.normal(point, weights.each * rows[:, None], prior)
            inverse = np.linalg.inv(precision[inside])
            step[free] = -inverse @ gradient[free]
        each[k] = point.u + step
        inverses.append(inverse)
    # Of the data alone, for the prior is in both; but it draws each half as far as that half leaves it room.
    variance = sum(inverse - inverse @ inverse for inverse in inverses)
    apart = inverses[0] - inverses[1]
    deviation = np.sqrt(np.maximum(np.diag(variance + apart @ apart), 1e-12))
    limit = -ndtri(FALSE_ALARM / 2 / max(1, int(free.sum())))
    contradictory = np.zeros(n, bool)
    contradictory[free] = np.abs(each[0] - each[1])[free] > limit * deviation
    return np.clip(each, prior.low, prior.high), contradictory
