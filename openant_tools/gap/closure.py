"""How far the gap closes on runs that were not used: the model re-fitted within tolerance, with causes and without.

The gap is measured as it is defined (formats, section 3): re-initialised from measurement twice a second, positions, held-out runs. Causes are
fitted, and judged, by whole windows, and by what sensors of the body say as well: a load or a slipping foot moves the body, and joints
hardly; and a body that has sunk into a soft floor would be put back where it is not by each new beginning.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from openant_tools.effects.catalogue import enter
from openant_tools.effects.robot import USUAL_NOISE, Robot
from openant_tools.gap.descent import END, LEAST_GAIN, Descent
from openant_tools.gap.features import COLUMNS, Floats, around_switching
from openant_tools.gap.hypothesis import Part, Refit, bounds_of, quantities, refit_at, scaled, sizes
from openant_tools.gap.nuisance import BODY, HEAT_LOSS, LESS, ONE_SIDED, TILTS, adjust, nuisances
from openant_tools.gap.protocol import Played, RunSet
from openant_tools.gap.simulation import simulate
from openant_tools.model.floor import floors
from openant_tools.model.gap import HORIZON_S, share_closed
from openant_tools.model.plant import Setup
from openant_tools.model.rollout import Rollouts

__all__ = ["Closure", "Windows", "calibration_of", "closures", "heat_loss_of", "nothing", "unmoved"]

Array = NDArray[np.float64]

#: rows (of some tens of milliseconds each) of one window say about as much as one: errors within it go together
INDEPENDENT_S = 0.1
#: how often slopes are followed at most
ITERATIONS = 30
#: how often slopes of tolerances are measured, each time where those before lead no farther
MEASURED = 3
#: how often errors of each joint in each run are taken to be as large as a step leaves them: no model of a real servo is true, and one
#: that trusts its sensors follows what no parameter explains, to the ends of all of them
INFLATIONS = 4
#: by which bounds are wider than what lies on them
TINY = 1e-12
#: rad: no joint is farther off than in a simulation that fell apart
LOST_RAD = 10.0
#: rad, the least that a position is known to
LEAST_SIGMA_RAD = 2e-4
#: sensors of the body, and how many columns each has
SENSED = {name: len(columns) for name, columns in COLUMNS.items()}


@dataclass(frozen=True)
class Closure:
    """What a hypothesis leaves of the gap on folds that its fit had not seen.

    Attributes:
        before, after, floor: rad, of joints. closed: share of the excess that is gone; low, high: over the folds, 95 %.
        squares: (folds, channels) summed over rows; counts: (folds, channels) of how many errors.
        apart: (folds, channels) squares of how far it is from what it is asked about beside, summed over the same rows.
        likelihood: the logarithm of how likely all is that it was fitted to, where errors of each channel in each run have a size of
            their own, and that of sizes and tolerances. known: (channels,) mean square of sensors.
        refit: on all training runs together.
        std: of the coordinates of its causes, in order: by curvature with errors as large as the fit leaves them, or by how much folds
            differ (jackknife), whichever is more.
    """

    before: float
    after: float
    floor: float
    closed: float
    low: float
    high: float
    likelihood: float
    squares: Array
    apart: Array
    counts: Array
    known: Array
    refit: Refit
    std: tuple[Mapping[str, float], ...]

    def support(self, other: Closure) -> float:
        """Logarithm of how much less it leaves than another on the same folds, rms, mean of them, summed over joints and body sensors.

        Up to a factor that of their likelihoods, where errors of each channel on each fold have a size of their own that nobody knows,
        but not less than sensors'.
        """
        return self._less(other.squares)

    @property
    def foretold(self) -> float:
        """What support would be if it were right: what it leaves is none of what it says that the other leaves beside that."""
        return self._less(self.squares + self.apart)

    def likelier(self, other: Closure) -> float:
        """nats by which what it was fitted to is likelier."""
        return self.likelihood - other.likelihood

    def _less(self, squares: Array) -> float:
        rows = np.maximum(self.counts, 1.0)  # of a fold without any nothing is left
        each = np.log((squares / rows + self.known) / (self.squares / rows + self.known))
        return float(0.5 * each.sum()) / len(rows)


class Windows:
    """Runs cut into windows, and what of the model is re-fitted on them.

    Channels are the joints' positions, rad, and then what sensors of the body say, each column by itself.

    Args:
        protocol: the robot and its runs, at the model's own step. without: signals that have no part in it.

    Attributes:
        sensed: signals of the body that any run has, of the others.
        measured: of each run, (rows, channels); NaN where nobody knows what a servo had in mind (`around_switching`).
        found: where a re-fit of `nothing` came to, in tolerances as `names`; 0 before.
    """

    def __init__(self, protocol: RunSet, without: Collection[str] = ()) -> None:
        self.protocol = protocol
        self.joints = len(protocol.joints)
        there = {name for one in protocol.runs for name in one.seen} - set(without)
        self.sensed = tuple(name for name in SENSED if name in there)
        self.names = nuisances(protocol, self.sensed)
        self._before: dict[int, Array] = {}
        self._rollouts = [_restarted([one]) for one in protocol.runs]
        self._whole = [_windows([one]) for one in protocol.runs]
        self._there = [_rows(one) for one in self._whole]
        self._coarse = protocol.coarse().runs
        self._together: dict[tuple[int, ...], list[tuple[tuple[int, ...], Rollouts]]] = {}
        self.measured = [self._measured(one) for one in protocol.runs]
        self.floor = floors([one.run for one in protocol.runs], protocol.joints)[0]
        #: (channels,) of sensors
        self.sigma = np.concatenate(
            [
                np.maximum(self.floor, LEAST_SIGMA_RAD),
                *(np.full(SENSED[name], USUAL_NOISE[name]) for name in self.sensed),
            ]
        )
        self._learnt: dict[int, Floats] = {}
        self.found = np.zeros(len(self.names))

    def robot(self, refit: Refit | None, k: int, warm_c: Array | None = None) -> Robot:
        """As it is on run k; None: the model as it was given.

        Args:
            warm_c: (joints,) °C above the coolest run; default as warm as its servos were then.
        """
        reference = self.protocol.reference
        if refit is None:
            return Robot(len(self.protocol.joints), creeps=True)
        robot = Robot(len(self.protocol.joints), reference.low, reference.high)
        enter(robot, reference, [(p.cause, p.joints, x) for p, x in zip(refit.hypothesis, refit.x, strict=True)])
        for one, u in zip(self.names, refit.nuisance, strict=True):
            if one.name == HEAT_LOSS:
                left = 1 / (1 + one.value(float(u)) * (self.protocol.runs[k].warm_c if warm_c is None else warm_c))
                for kind in LESS:
                    robot.factor(kind)[:] *= left
            elif u or one.name in ONE_SIDED:
                adjust(robot, one.name, one.joints, one.value(float(u)))
        return robot

    def errors(self, k: int, refits: Sequence[Refit | None]) -> Array:
        """(refits, rows, joints) rad, measured minus simulated on run k, begun anew as the gap is defined."""
        return self._errors([k], [self.robot(refit, k) for refit in refits], self._rollouts[k], ())[0]

    def over_windows(self, k: int, refits: Sequence[Refit]) -> Array:
        """(refits, rows, channels), measured minus simulated on run k, over whole windows."""
        return self._errors([k], [self.robot(refit, k) for refit in refits], self._whole[k], self.sensed)[0]

    def simulated(self, k: int, refit: Refit, signals: Sequence[str]) -> dict[str, Array]:
        """Signal → (rows, joints), what a re-fitted model does on run k."""
        found = simulate(
            self._rollouts[k], [self.robot(refit, k)], signals=signals, warm_c=[self.protocol.runs[k].warm_c]
        ).signals
        return {name: values[0].astype(np.float64) for name, values in found.items()}

    def before(self, k: int) -> Array:
        """(rows, joints) rad, errors of the model as it was given."""
        if k not in self._before:
            self._before[k] = self.errors(k, [None])[0]
        return self._before[k]

    def written(self, refit: Refit, judged: Sequence[int]) -> float:
        """The gap, rad, on these runs of the one model that can be written: its servos are always as warm as on average there."""
        warm = self.warmth(judged)
        errors = np.concatenate(
            [self._errors([k], [self.robot(refit, k, warm)], self._rollouts[k], ())[0][0] for k in judged]
        )
        return float(np.sqrt(np.mean(np.square(errors[np.isfinite(errors)]))))

    def warmth(self, judged: Sequence[int]) -> Array:
        """(joints,) °C above the coolest run, mean of some runs."""
        mean: Array = np.mean([self.protocol.runs[k].warm_c for k in judged], axis=0)
        return mean

    def _errors(
        self, runs: Sequence[int], robots: Sequence[Robot], rollouts: Rollouts, sensed: Sequence[str]
    ) -> list[Array]:
        """Of each run of a rollout (robots, rows, channels), measured minus simulated: of joints, and some sensors of the body."""
        warm_c = [self.protocol.runs[k].warm_c for k in runs]
        signals = simulate(rollouts, robots, signals=("pos", *sensed), warm_c=warm_c).signals
        pos = signals["pos"]
        absent = {name: np.full((*pos.shape[:2], width), np.nan) for name, width in SENSED.items()}
        found = np.concatenate([pos, *(signals.get(name, absent[name]) for name in sensed)], axis=2)
        measured = np.concatenate([self.measured[k][:, : found.shape[2]] for k in runs])
        out: Array = measured[None] - found.astype(np.float64)
        if "yaw" in sensed:
            out[..., self._of("yaw")] = np.remainder(out[..., self._of("yaw")] + np.pi, 2 * np.pi) - np.pi
        # A robot that no step holds together is as wrong as can be: neither right nor unknown.
        lost = _rows(rollouts)[:, None] & np.isfinite(measured[:, : self.joints]) & ~(np.abs(pos) < LOST_RAD)
        out[..., : self.joints][lost] = LOST_RAD
        return [out[:, rows] for rows in rollouts.rows]

    def _side_by_side(self, fitted: Sequence[int]) -> list[tuple[tuple[int, ...], Rollouts]]:
        """Runs that one simulation plays, in large steps, where fits follow them: those on one plant, if servos are alike in all."""
        key = tuple(fitted)
        if key not in self._together:
            unlike = any(one.name == HEAT_LOSS for one in self.names)
            groups: dict[tuple[int, int], list[int]] = {}
            for k in fitted:
                one = self._coarse[k]
                groups.setdefault((id(one.plant), k if unlike or one.windows is None else -1), []).append(k)
            self._together[key] = [(tuple(mine), _windows([self._coarse[k] for k in mine])) for mine in groups.values()]
        return self._together[key]

    def _measured(self, one: Played) -> Array:
        """(rows, channels) of a run."""
        pos = np.where(
            around_switching(one.run, self.protocol.joints), np.nan, one.run.signal("pos", self.protocol.joints)
        )
        absent = {name: np.full((len(pos), width), np.nan) for name, width in SENSED.items()}
        body = [one.seen[name][0] if name in one.seen else absent[name] for name in self.sensed]
        return np.concatenate([pos, *body], axis=1)

    def _of(self, signal: str) -> slice:
        """Which channels a sensor of the body has."""
        first = self.joints + sum(SENSED[name] for name in self.sensed[: self.sensed.index(signal)])
        return slice(first, first + SENSED[signal])

    def refit(
        self, starts: Sequence[Refit], training: Sequence[int], leave_out: Sequence[Collection[int]]
    ) -> list[tuple[Refit, list[Refit], tuple[Mapping[str, float], ...], float]]:
        """Fit within tolerance, and polish sizes: each on all the runs to train on, and without each group of some of them.

        All share one linearisation each, at what is found on all of the training runs; and are simulated side by side.

        Returns:
            of each the fit, those without a group, standard deviations of its sizes, and the logarithm of how likely it is.
        """
        fitted = list(training)
        descents = self._no_worse(self._descend(starts, fitted), fitted)
        for one in descents:
            if not one.causes:
                self._keep(one)
        out = []
        for one in descents:
            folds = [[k for k in one.blocks if k not in left] for left in leave_out]
            # Where a fold leads otherwise than all of them together, from where these came to; held back it would not leave there.
            one.damping = 0.0
            low, high = self._bounds(one)
            whole_way = self._solve(one, list(one.blocks))
            each = [np.clip(one.at + self._solve(one, fold) - whole_way, low, high) for fold in folds]
            whole, parts = refit_at(one.start, one.at), [refit_at(one.start, u) for u in each]
            out.append((whole, parts, refit_at(one.start, self._deviations(one, parts)).x, -0.5 * one.least))
        return out

    def _deviations(self, descent: Descent, folds: Sequence[Refit]) -> Array:
        """Standard deviations of a fit's coordinates."""
        normal = np.diag(1 / descent.scale**2)
        for block in descent.blocks.values():
            normal += block.weighted(1 / block.inflation(block.cost))[0]
        curvature: Array = np.sqrt(np.diag(np.linalg.inv(normal)))
        if len(folds) < 2:
            return curvature
        each = np.array([np.concatenate([sizes(fold), fold.nuisance]) for fold in folds])
        spread = np.sqrt((len(each) - 1) / len(each) * np.square(each - each.mean(axis=0)).sum(axis=0))
        out: Array = np.maximum(curvature, spread)
        return out

    def _no_worse(self, descents: list[Descent], fitted: Sequence[int]) -> list[Descent]:
        """Where a cause leaves more than it does when it is not there, a descent from there in its place."""
        absent = [scaled(one.start, 0.0) if one.causes else one.start for one in descents]
        without = [Descent.of(one, len(self.names), self._learnt) for one in absent]
        self._look(without, fitted, slopes=False)
        again = [n for n, (one, other) in enumerate(zip(descents, without, strict=True)) if other.least < one.least]
        if again:
            for n, one in zip(again, self._descend([absent[n] for n in again], fitted), strict=True):
                descents[n] = one
        return descents

    def _descend(self, starts: Sequence[Refit], fitted: Sequence[int]) -> list[Descent]:
        """Follow each start to where it leaves least on these runs."""
        # Slopes cost the most: causes begin with what was learnt of tolerances without them.
        learnt = {k: known for k, known in self._learnt.items() if k in fitted}
        descents = [Descent.of(start, len(self.names), learnt) for start in starts]
        begun = descents
        for _ in range(1 if learnt else MEASURED):
            before = [one.least for one in begun]
            for one in begun if not learnt else ():
                one.begin()
            moving = begun
            for _ in range(ITERATIONS):
                self._look(moving, fitted)
                for one in moving:
                    one.u = self._solve(one, list(one.blocks))
                moving = [one for one in moving if one.goes_on]
                if not moving:
                    break
            begun = [one for one, cost in zip(begun, before, strict=True) if cost - one.least > 2 * LEAST_GAIN]
            if not begun:
                break
        return descents

    def _keep(self, found: Descent) -> None:
        """Remember what was learnt of tolerances."""
        self._learnt = {k: slopes[found.causes :] for k, slopes in found.slopes.items()}
        self.found = found.at[found.causes :]

    def _weight(self, k: int) -> Array:
        """(channels,) that errors of a run are multiplied by: its rows go together."""
        period = float(np.median(np.diff(self.protocol.runs[k].run.t)))
        out: Array = np.sqrt(1 / max(1.0, INDEPENDENT_S / period)) / self.sigma
        return out

    def _count(self, k: int) -> Array:
        """(channels,) how many independent errors the rows of a run are, as weighted."""
        weight = np.square(self._weight(k) * self.sigma)
        count: Array = (np.isfinite(self.measured[k]) & self._there[k][:, None]).sum(axis=0) * weight
        return count

    def _solve(self, descent: Descent, runs: Sequence[int]) -> Array:
        """Where the blocks of some runs lead, made where the descent was best."""
        u, prior, scale = descent.at, descent.prior, descent.scale
        low, high = self._bounds(descent)
        within = np.minimum(low - u, 0) - TINY, np.maximum(high - u, 0) + TINY
        blocks, found = [descent.blocks[k] for k in runs], u
        for _ in range(INFLATIONS):
            more, slope = np.diag(1 / scale**2), (u - prior) / scale**2
            for block in blocks:
                own, along = block.weighted(1 / block.inflation(block.left(found - u)))
                more, slope = more + own, slope + along
            # What ends at a bound leaves its part to the others: clipped afterwards it would leave it undone.
            root = np.linalg.cholesky(more + descent.damping * np.diag(np.diag(more)))
            found = np.clip(u + lsq_linear(root.T, -np.linalg.solve(root, slope), bounds=within).x, low, high)
        return found

    def _bounds(self, descent: Descent) -> tuple[Array, Array]:
        """Between which each coordinate may be."""
        ends = [bounds_of(q) for q in quantities(descent.start)]
        low, high = np.array([*ends, *[(-END, END)] * len(self.names)]).T
        return low, high

    def _look(self, descents: Sequence[Descent], fitted: Sequence[int], slopes: bool = True) -> None:
        """Simulate runs where descents look next, and, for slopes, what varies there."""
        found: list[dict[int, Floats]] = [{} for _ in descents]
        for mine, rollouts in self._side_by_side(fitted):
            first = mine[0]
            columns = [self._columns(first, one) if slopes else [] for one in descents]
            steps = [one.steps_on(self.protocol.runs[first].plant.setup) for one in descents]
            robots = [
                self.robot(refit_at(one.start, u), first)
                for one, some, by in zip(descents, columns, steps, strict=True)
                for u in (one.u, *(one.moved(members, by) for members in some))
            ]
            for k, errors in zip(mine, self._errors(mine, robots, rollouts, self.sensed), strict=True):
                weight, at = self._weight(k), 0
                for one, some, by, seen in zip(descents, columns, steps, found, strict=True):
                    seen[k] = (np.nan_to_num(errors[at]) * weight).astype(np.float32)
                    change_by = np.zeros((len(one.u), *seen[k].shape), np.float32)
                    if k in one.slopes:
                        change_by[:] = one.slopes[k]
                    for row, members in enumerate(some, at + 1):
                        change = np.nan_to_num(errors[row] - errors[at]) * weight
                        for p, mask in members:
                            change_by[p] = np.where(mask, change, 0.0) / by[p]
                    at += 1 + len(some)
                    one.slopes[k] = change_by
        for one, seen in zip(descents, found, strict=True):
            one.told(seen, {k: self._count(k) for k in fitted})

    def _columns(self, k: int, descent: Descent) -> list[list[tuple[int, NDArray[np.bool_]]]]:
        """What is varied on a run. A joint within tolerance moves little: slopes once known are not looked at again."""
        columns = self._colours(self.protocol.runs[k], descent.start)
        if k not in descent.slopes:
            return columns
        return [members for members in columns if descent.bends[members[0][0]]]

    def _colours(self, one: Played, start: Refit) -> list[list[tuple[int, NDArray[np.bool_]]]]:
        """Coordinates that one simulation can vary, because on the stand legs do not move each other."""
        everywhere = np.ones(len(self.sigma), bool)
        on_stand = one.plant.setup is Setup.STAND
        out: list[list[tuple[int, NDArray[np.bool_]]]] = []
        n = 0
        for part in start.hypothesis:
            for _ in part.definition.quantities:
                out.append([(n, everywhere)])
                n += 1
        tree = one.plant.tree
        used: list[tuple[set[int], list[tuple[int, NDArray[np.bool_]]]]] = []
        for k, nuisance in enumerate(self.names):
            mine = {int(tree[j]) for j in nuisance.joints} if on_stand else set(tree.tolist())
            if not mine:  # of the floor, which does nothing to who hangs on a stand, unless it turns both
                if nuisance.name not in TILTS:
                    continue
                mine = set(tree.tolist())
            mask = np.concatenate([np.isin(tree, list(mine)), ~on_stand & everywhere[self.joints :]])
            for trees, members in used:
                if not trees & mine:
                    trees |= mine
                    members.append((n + k, mask))
                    break
            else:
                used.append((mine, [(n + k, mask)]))
        return out + [members for _, members in used]


def _restarted(runs: Sequence[Played]) -> Rollouts:
    """Runs on one plant, begun anew from measurement as the gap is defined: all of it, or what of it is simulated."""
    parts = []
    for one in runs:
        mine: list[tuple[float, float]] = []
        for start, stop in one.windows or ():
            edges = np.linspace(start, stop, max(1, round((stop - start) / HORIZON_S)) + 1).tolist()
            mine += itertools.pairwise(edges)
        parts.append(mine)
    return _rollouts(runs, parts)


def _windows(runs: Sequence[Played]) -> Rollouts:
    """Runs on one plant in whole windows."""
    return _rollouts(runs, [one.windows or () for one in runs])


def _rollouts(runs: Sequence[Played], windows: Sequence[Sequence[tuple[float, float]]]) -> Rollouts:
    whole = runs[0].windows is None
    return Rollouts(
        runs[0].plant,
        [one.run for one in runs],
        HORIZON_S if whole else None,
        windows=None if whole else windows,
    )


def _rows(rollouts: Rollouts) -> NDArray[np.bool_]:
    """(rows,) which of its runs' are simulated."""
    out = np.zeros(rollouts.rows[-1].stop, bool)
    for segment in rollouts.segments:
        out[segment.row] = True
    return out


def closures(
    windows: Windows, starts: Sequence[Refit], folds: Sequence[Collection[int]], training: Sequence[int]
) -> list[Closure]:
    """What each hypothesis leaves of the gap.

    Args:
        starts: the first is what the others are asked about beside.
        folds: runs judged together by fits that have not seen them. training: the runs to fit on, but for those of the fold.
    """
    fits = windows.refit(starts, training, folds)
    channels = len(windows.sigma)
    each, counts = np.zeros((len(starts), len(folds), channels)), np.zeros((len(folds), channels))
    apart = np.zeros_like(each)
    gaps, known = np.zeros((len(starts) + 1, len(folds))), np.zeros(len(folds))
    for f, fold in enumerate(folds):
        held_out = [parts[f] for _, parts, *_ in fits]
        for k in sorted(fold):
            errors = windows.over_windows(k, held_out)
            squares, good = _squares(errors)
            each[:, f], counts[f] = each[:, f] + squares, counts[f] + good
            apart[:, f] += _squares(errors - errors[0])[0]
            squares, good = _squares(np.concatenate([windows.before(k)[None], windows.errors(k, held_out)]))
            gaps[:, f] += squares.sum(axis=1)
            known[f] += good.sum()
    floor = float(np.sqrt(np.mean(windows.floor**2)))
    out = []
    for n, (whole, _, std, likelihood) in enumerate(fits):
        both = gaps[[0, n + 1]]
        before, after = (float(one) for one in np.sqrt(both.sum(axis=1) / known.sum()))
        low, high = _interval(both[0], both[1], known, floor)
        out.append(
            Closure(
                before, after, floor, _closed(before, after, floor), low, high, likelihood, each[n], apart[n], counts,
                windows.sigma**2, whole, std,
            )
        )  # fmt: skip
    return out


def _squares(errors: Array) -> tuple[Array, Array]:
    """(robots, channels) summed over rows that all robots have, and (channels,) of how many."""
    good = np.isfinite(errors).all(axis=0)
    return np.square(np.where(good, errors, 0.0)).sum(axis=1), good.sum(axis=0).astype(np.float64)


def _closed(before: float, after: float, floor: float) -> float:
    share = share_closed(before, after, floor)
    return share if np.isfinite(share) else 0.0


def _interval(before: Array, after: Array, counts: Array, floor: float) -> tuple[float, float]:
    """95 % of the closure over folds drawn with replacement."""
    rng = np.random.default_rng(0)
    draws = rng.integers(len(counts), size=(400, len(counts)))
    values = []
    for draw in draws:
        total = counts[draw].sum()
        values.append(
            _closed(float(np.sqrt(before[draw].sum() / total)), float(np.sqrt(after[draw].sum() / total)), floor)
        )
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)


def calibration_of(windows: Windows, refit: Refit, judged: Sequence[int]) -> dict[str, dict[str, float]]:
    """What moved within tolerance: kind → joint or `BODY` → factor, or what is added (N·m, rad, s, kg), see `adjust`.

    Args:
        judged: runs on which servos were as warm as those of the model are to be.
    """
    out: dict[str, dict[str, float]] = {}
    joints = windows.protocol.joints
    for one, u in zip(windows.names, refit.nuisance, strict=True):
        value = one.value(float(u))
        if one.of_imu:
            continue
        if one.name == HEAT_LOSS:
            for kind in LESS:
                for joint, left in zip(joints, 1 / (1 + value * windows.warmth(judged)), strict=True):
                    if kind in out:
                        out[kind][joint] *= float(left)
            continue
        for name in [joints[j] for j in one.joints] or [BODY]:
            out.setdefault(one.name, {})[name] = value
    return {kind: {name: float(f"{value:.6g}") for name, value in values.items()} for kind, values in out.items()}


def heat_loss_of(windows: Windows, refit: Refit) -> float | None:
    """1/°C of torque that warm servos lose; None where none was warmer in one run than in another."""
    return next(
        (one.value(float(u)) for one, u in zip(windows.names, refit.nuisance, strict=True) if one.name == HEAT_LOSS),
        None,
    )


def unmoved(windows: Windows, parts: Iterable[Part], x: Iterable[Mapping[str, float]]) -> Refit:
    """Causes at these coordinates, from where a re-fit without them came to."""
    return Refit(tuple(parts), tuple(x), windows.found)


def nothing(windows: Windows) -> Refit:
    """No cause at all, only what tolerances let move, from where it was last found to be."""
    return Refit((), (), windows.found)
