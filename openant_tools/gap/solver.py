"""The steps of descents: runs simulated where they look next, and what varies there, side by side; and where that leads.

Processes share the robots, each with the runs: laws are Python, of which one thread of a process computes at a time. What a robot does
depends on no other.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Future

import joblib
import numpy as np
from joblib.externals.loky import ProcessPoolExecutor
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from openant_tools.effects.robot import Robot
from openant_tools.gap.descent import Descent
from openant_tools.gap.design import design, scatter, slopes
from openant_tools.gap.features import Floats
from openant_tools.gap.hypothesis import Refit, refit_at
from openant_tools.gap.nuisance import TILTS
from openant_tools.gap.prediction import Predictions
from openant_tools.model.plant import Setup
from openant_tools.model.rollout import allowed_threads
from openant_tools.workers import end_with

__all__ = ["Solver"]

Array = NDArray[np.float64]
#: coordinates that one simulation varies, and which channels each moves
Column = list[tuple[int, NDArray[np.bool_]]]

#: rows (of some tens of milliseconds each) of one window say about as much as one: errors within it go together
INDEPENDENT_S = 0.1
#: how often errors of each joint in each run are taken to be as large as a step leaves them: no model of a real servo is true, and one
#: that trusts its sensors follows what no parameter explains, to the ends of all of them
INFLATIONS = 4
#: by which bounds are wider than what lies on them
TINY = 1e-12
#: steps of simulations (10 µs each) from which processes share them, and s after which these end that have nothing to do
SHARED, IDLE_S = 30_000, 20
#: times an even share of all steps that one process may have of what is not shared
WHOLE = 1.05


class Solver:
    """Follows descents over some runs."""

    def __init__(self, predictions: Predictions) -> None:
        self.predictions = predictions
        self._of_tolerances: dict[int, list[Column]] = {}
        self._workers: ProcessPoolExecutor | None = None
        self._scatter: dict[int, Array] = {}

    def follow(self, descents: Sequence[Descent], fitted: Sequence[int], at_most: int) -> None:
        """Take so many steps of each, or until it does not go on, simulated on the runs that it is fitted to."""
        moving = list(descents)
        for _ in range(at_most):
            if not moving:
                break
            self.look(moving, fitted)
            for one in moving:
                one.u = self.solve(one, list(one.blocks))
            moving = [one for one in moving if one.goes_on]

    def look(self, descents: Sequence[Descent], fitted: Sequence[int]) -> None:
        """Simulate runs where descents look next, and what varies there."""
        found: list[dict[int, Floats]] = [{} for _ in descents]
        runs = [mine for mine, _ in self.predictions.side_by_side(fitted)]
        columns = [[self._columns(mine[0], one) for one in descents] for mine in runs]
        designs = [[self._design(mine[0], one) for one in descents] for mine in runs]
        robots = [
            [
                self.predictions.robot(refit_at(one.start, u), mine[0])
                for one, some, moved in zip(descents, of_runs, of_designs, strict=True)
                for u in (one.u, *map(one.moved, some), *one.spread(moved))
            ]
            for mine, of_runs, of_designs in zip(runs, columns, designs, strict=True)
        ]
        for mine, of_runs, of_designs, there in zip(runs, columns, designs, self._errors(fitted, robots), strict=True):
            for k, errors in zip(mine, there, strict=True):
                at = 0
                for one, some, moved, seen in zip(descents, of_runs, of_designs, found, strict=True):
                    size = 1 + len(some) + len(moved)
                    shown = np.nan_to_num(errors[at : at + size])
                    at += size
                    if len(moved):
                        # Once, so that all hypotheses are weighed alike.
                        self._scatter.setdefault(k, scatter(shown[1 + len(some) :], moved))
                    shown = shown * self._weight(k)
                    seen[k] = shown[0].astype(np.float32)
                    change_by = np.zeros((len(one.u), *seen[k].shape), np.float32)
                    if k in one.slopes:
                        change_by[:] = one.slopes[k]
                    for row, members in enumerate(some, 1):
                        for p, mask in members:
                            change_by[p] = np.where(mask, shown[row] - shown[0], 0.0) / one.nearby[p]
                    if len(moved):
                        steps = one.nearby[one.causes :, None, None]
                        change_by[one.causes :] = slopes(shown[1 + len(some) :], moved) / steps
                    one.slopes[k] = change_by
        for one, seen in zip(descents, found, strict=True):
            one.told(seen, {k: self._count(k) for k in fitted})

    def _errors(self, fitted: Sequence[int], robots: Sequence[Sequence[Robot]]) -> list[list[Array]]:
        """Of runs that are simulated together, of each (robots, rows, channels)."""
        groups, processes = self.predictions.side_by_side(fitted), allowed_threads() or joblib.cpu_count()
        steps = [len(some) * rollouts.steps for some, (_, rollouts) in zip(robots, groups, strict=True)]
        if processes == 1 or (self._workers is None and sum(steps) < SHARED):
            return [
                self.predictions.coarse(mine, some, rollouts)
                for some, (mine, rollouts) in zip(robots, groups, strict=True)
            ]
        if self._workers is None:
            self._workers = ProcessPoolExecutor(
                processes, timeout=IDLE_S, initializer=_begin, initargs=(os.getpid(), self.predictions),
                env={"OMP_NUM_THREADS": "1"},
            )  # fmt: skip
        work: dict[int, list[Future[list[Array]]]] = {}
        load = [0.0] * processes
        for group in sorted(range(len(steps)), key=lambda group: -steps[group]):
            # Laws take as long for a few robots as for many: what has room in one process is not shared.
            least = load.index(min(load))
            whole = load[least] + steps[group] <= WHOLE * sum(steps) / processes
            load[least] += steps[group] if whole else 0.0
            share = len(robots[group]) if whole else -(-len(robots[group]) // processes)
            work[group] = [
                self._workers.submit(_simulated, tuple(fitted), group, robots[group][n : n + share])
                for n in range(0, len(robots[group]), share)
            ]
        return [
            [np.concatenate(parts) for parts in zip(*(one.result() for one in work[group]), strict=True)]
            for group in range(len(groups))
        ]

    def deviation(self, k: int, near: Refit) -> Array:
        """(rows, channels) or (channels,) how far errors of a run are off by sensors and by feet that chatter.

        Args:
            near: where that is looked at, on a run that nothing was fitted to.
        """
        if self._chatters(k) and k not in self._scatter:
            moved = design(len(near.nuisance))
            some = Descent.of(near, len(near.nuisance), {}).spread(moved)
            [[seen]] = self._errors([k], [[self.predictions.robot(refit_at(near, u), k) for u in some]])
            self._scatter[k] = scatter(np.nan_to_num(seen), moved)
        out: Array = np.sqrt(np.square(self.predictions.sigma) + self._scatter.get(k, 0.0))
        return out

    def solve(self, descent: Descent, runs: Sequence[int]) -> Array:
        """Where the blocks of some runs lead, made where the descent was best."""
        u, prior, scale = descent.at, descent.prior, descent.scale
        low, high = descent.low, descent.high
        within = low - u - TINY, high - u + TINY
        blocks, found = [descent.blocks[k] for k in runs], u
        for _ in range(INFLATIONS):
            more, slope = np.diag(1 / scale**2), (u - prior) / scale**2
            for block in blocks:
                own, along = block.weighted(1 / block.inflation(block.left(found - u)))
                more, slope = more + own, slope + along
            # What ends at a bound leaves its part to the others: clipped afterwards it would leave it undone.
            root = np.linalg.cholesky(more + descent.damping * np.diag(np.diag(more)))
            step = lsq_linear(root.T, -np.linalg.solve(root, slope), bounds=within, method="bvls").x
            found = np.clip(u + step, low, high)
        # Rounding leaves 1e-16 of what lies on its bound: a delay of that is none.
        for bound in (low, high):
            found = np.where(np.abs(found - bound) < 10 * TINY, bound, found)
        return found

    def _columns(self, k: int, descent: Descent) -> list[Column]:
        """What is varied by itself on a run. A joint within tolerance moves little: slopes once known are not looked at again."""
        everywhere = np.ones(len(self.predictions.sigma), bool)
        own: list[Column] = [[(p, everywhere)] for p in range(descent.causes)]
        if k in descent.slopes:
            return [members for members in own if descent.bends[members[0][0]]]
        if self._chatters(k):
            return own
        return own + [[(descent.causes + p, mask) for p, mask in members] for members in self._tolerances(k)]

    def _design(self, k: int, descent: Descent) -> Array:
        """(robots, tolerances) that are varied at once on a run; none where they are varied by themselves, or slopes are known."""
        tolerances = len(self.predictions.names)
        return design(tolerances) if self._chatters(k) and k not in descent.slopes else np.empty((0, tolerances))

    def _chatters(self, k: int) -> bool:
        """Whether robots that hardly differ may do otherwise on a run: those whose feet are on a floor."""
        return self.predictions.protocol.runs[k].plant.setup is Setup.FLOOR

    def _tolerances(self, k: int) -> list[Column]:
        """Those that one simulation can vary, because on the stand legs do not move each other."""
        if k in self._of_tolerances:
            return self._of_tolerances[k]
        plant = self.predictions.protocol.runs[k].plant
        on_stand, tree = plant.setup is Setup.STAND, plant.tree
        of_body = np.full(len(self.predictions.sigma) - self.predictions.joints, not on_stand)
        used: list[tuple[set[int], Column]] = []
        for p, nuisance in enumerate(self.predictions.names):
            mine = {int(tree[j]) for j in nuisance.joints} if on_stand else set(tree.tolist())
            if not mine:  # of the floor, which does nothing to who hangs on a stand, unless it turns both
                if nuisance.name not in TILTS:
                    continue
                mine = set(tree.tolist())
            mask = np.concatenate([np.isin(tree, list(mine)), of_body])
            for trees, members in used:
                if not trees & mine:
                    trees |= mine
                    members.append((p, mask))
                    break
            else:
                used.append((mine, [(p, mask)]))
        self._of_tolerances[k] = [members for _, members in used]
        return self._of_tolerances[k]

    def _weight(self, k: int) -> Array:
        """(rows, channels) or (channels,) that errors of a run are multiplied by: its rows go together, and some are little to be trusted."""
        out: Array = np.sqrt(self._share(k)) / np.sqrt(np.square(self.predictions.sigma) + self._scatter.get(k, 0.0))
        return out

    def _count(self, k: int) -> Array:
        """(channels,) how many independent errors the rows of a run are, as weighted."""
        count: Array = (np.isfinite(self.predictions.measured[k]) & self.predictions.there[k][:, None]).sum(axis=0)
        return count * self._share(k)

    def _share(self, k: int) -> float:
        """Of how many independent errors a row is."""
        period = float(np.median(np.diff(self.predictions.protocol.runs[k].run.t)))
        return 1 / max(1.0, INDEPENDENT_S / period)


#: of a process that shares the work
_given: list[Predictions] = []


def _begin(parent: int, predictions: Predictions) -> None:
    end_with(parent)
    _given.append(predictions)


def _simulated(fitted: Sequence[int], group: int, robots: Sequence[Robot]) -> list[Array]:
    runs, rollouts = _given[0].side_by_side(fitted)[group]
    return _given[0].coarse(runs, robots, rollouts)
