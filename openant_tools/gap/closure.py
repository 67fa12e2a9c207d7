"""How far the gap closes on runs that were not used: the model re-fitted within tolerance, with causes and without.

Everything is judged as the gap is defined (formats, section 3): re-initialised from measurement, positions, held-out runs.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from openant_tools.effects.catalogue import enter
from openant_tools.effects.effect import Quantity
from openant_tools.effects.robot import Robot
from openant_tools.gap.features import Floats, around_switching
from openant_tools.gap.hypothesis import Hypothesis, Part, bounds_of
from openant_tools.gap.protocol import Played, RunSet
from openant_tools.gap.simulation import simulate
from openant_tools.gap.tolerance import FACTORS, FLOOR, tolerance_of, torso_kg
from openant_tools.model.floor import floors
from openant_tools.model.gap import HORIZON_S, share_closed
from openant_tools.model.plant import Setup
from openant_tools.model.rollout import Rollouts

__all__ = [
    "BODY", "Closure", "Refit", "Windows", "adjust", "calibration_of", "closures", "heat_loss_of", "nothing", "unmoved",
]  # fmt: skip

Array = NDArray[np.float64]

#: standard deviation of a prior, as a share of the tolerance; and where it ends: a re-fit within tolerance is no effect
SPREAD, END = 0.6, 1.0
#: rows (of some tens of milliseconds each) of one window say about as much as one: errors within it go together
INDEPENDENT_S = 0.1
#: standard deviation that sizes of causes keep from where they were found, as a share
POLISH = 0.3
#: times what it was found to be that a size may become
FARTHEST = 2.5
#: how often slopes are followed, and the step, in prior deviations, below which a fit has settled
ITERATIONS, SETTLED = 8, 0.02
#: how often errors of each joint in each run are taken to be as large as a step leaves them: no model of a real servo is true, and one
#: that trusts its sensors follows what no parameter explains, to the ends of all of them
INFLATIONS = 4
#: times what slopes foretold that may be left: beyond, they are looked at anew
FORETOLD = 1.3
#: of so many windows fits follow one, on the stand and on the floor, where each takes long and all joints move each
FOLLOWED = {Setup.STAND: 1, Setup.FLOOR: 2}
#: of a tolerance by which it is varied to learn its slope
NEARBY = 0.3
#: by which bounds are wider than what lies on them
TINY = 1e-12
#: rad: no joint is farther off than in a simulation that fell apart
LOST_RAD = 10.0
#: what tilts a floor along its x and y, rad
TILTS = ("tilt_x", "tilt_y")
#: what a warm motor loses, and °C between runs from which it is asked how much; what of a servo is less by it
HEAT_LOSS, WARMED_C, LESS = "heat_loss", 2.0, ("stiffness", "torque_limit")
#: whose calibration it is that belongs to no joint
BODY = "body"
#: rad, the least that a position is known to
LEAST_SIGMA_RAD = 2e-4


@dataclass(frozen=True)
class Refit:
    """A model re-fitted within tolerance, with causes.

    Attributes:
        x: of each part of the hypothesis, its coordinates. nuisance: what else moved, in tolerances, see `Windows.names`.
    """

    hypothesis: Hypothesis
    x: tuple[Mapping[str, float], ...]
    nuisance: Array


@dataclass(frozen=True)
class Closure:
    """What a hypothesis leaves of the gap on folds that its fit had not seen.

    Attributes:
        after, floor: rad. closed: share of the excess that is gone; low, high: over the folds, 95 %.
        squares: (2, folds, joints) rad², summed over rows, of the given model and of this one; counts: (folds,) of how many errors.
        fitted: (joints,) rad², mean square of what it leaves of all that it was fitted to.
        refit: on all training runs together.
        std: of the coordinates of its causes, in order: by curvature with errors as large as the fit leaves them, or by how much folds
            differ (jackknife), whichever is more.
    """

    after: float
    floor: float
    closed: float
    low: float
    high: float
    fitted: Array
    squares: Array
    counts: Array
    refit: Refit
    std: tuple[Mapping[str, float], ...]

    @property
    def before(self) -> float:
        """rad, the gap of the given model."""
        return float(np.sqrt(self.squares[0].sum() / self.counts.sum()))

    def support(self, other: Closure) -> float:
        """Logarithm of how much less it leaves than another on the same folds, rms, mean of them, summed over joints.

        Up to a factor that of their likelihoods, where errors of each joint on each fold have a size of their own that nobody knows,
        but not less than sensors'.
        """
        rows = np.maximum(self.counts[:, None] / self.squares.shape[2], 1.0)  # of a fold without any nothing is left
        return self._less(other.squares[1] / rows, self.squares[1] / rows) / len(self.counts)

    def foretold(self, other: Closure) -> float:
        """The same of what it was fitted to."""
        return self._less(other.fitted, self.fitted)

    def _less(self, other: Array, own: Array) -> float:
        known = max(self.floor, LEAST_SIGMA_RAD) ** 2
        return float(0.5 * np.log((other + known) / (own + known)).sum())


@dataclass(frozen=True)
class _Nuisance:
    """What may move within tolerance; of the body and the floor where it has no joints."""

    name: str
    joints: tuple[int, ...]
    tolerance: float

    def value(self, u: float) -> float:
        """The factor, or what is added (N·m, rad, s, kg), at so many tolerances; 1/°C of what is lost to heat."""
        if self.name == HEAT_LOSS:
            return self.tolerance * (1 + u)
        return float(np.exp(u * self.tolerance)) if self.name in {*FACTORS, *FLOOR} else float(u * self.tolerance)


def adjust(robot: Robot, kind: str, joints: Sequence[int], value: float) -> None:
    """Move a robot within tolerance, by a value of `calibration_of`.

    Args:
        joints: none for what belongs to the body or the floor.

    Raises:
        KeyError: no such kind.
    """
    at = list(joints)
    if kind in FACTORS:
        robot.factor(kind)[at] *= value
    elif kind == "coulomb_friction":
        robot.more(kind)[at] += value
    elif kind == "zero_offset":
        robot.zero[at] += value
    elif kind == "delay":
        robot.delay[at] += value
    elif kind in FLOOR:
        setattr(robot, kind, getattr(robot, kind) * value)
    elif kind == "torso_kg":
        robot.torso_kg += value
    elif kind in TILTS:
        robot.tilt = robot.tilt + value * np.eye(2)[TILTS.index(kind)]
    else:
        raise KeyError(kind)


@dataclass(frozen=True)
class _Block:
    """What a run says where a descent is, joint by joint; errors count in deviations of their sensors.

    Attributes:
        cost: (joints,) squares. more: (joints, coordinates, coordinates), slope: (joints, coordinates), so that so far from there squares
            are cost + 2 slope·moved + moved·more·moved. count: (joints,) of how many independent errors.
    """

    cost: Array
    more: Array
    slope: Array
    count: Array

    @classmethod
    def of(cls, errors: Floats, slopes: Floats, count: Array) -> _Block:
        """Of weighted errors (rows, joints) and how each coordinate moves them (coordinates, rows, joints)."""
        along = slopes.transpose(2, 0, 1)  # in float32: nothing of a fit is larger
        left = errors.T[:, :, None]
        return cls(
            np.square(errors, dtype=np.float64).sum(axis=0),
            (along @ along.transpose(0, 2, 1)).astype(np.float64),
            (along @ left)[:, :, 0].astype(np.float64),
            np.maximum(count, 1.0),
        )

    def left(self, moved: Array) -> Array:
        """(joints,) squares that are foretold so far from there."""
        out: Array = np.maximum(self.cost + 2 * self.slope @ moved + self.more @ moved @ moved, 0.0)
        return out

    def inflation(self, left: Array) -> Array:
        """(joints,) how many times its sensors' variance."""
        out: Array = np.maximum(left / self.count, 1.0)
        return out

    @property
    def surprise(self) -> float:
        """Minus twice the logarithm of how likely it is, with errors as large as they are, if not smaller than sensors'."""
        inflation = self.inflation(self.cost)
        return float((self.cost / inflation + self.count * np.log(inflation)).sum())

    def weighted(self, weight: Array) -> tuple[Array, Array]:
        """Normal matrix and gradient of all joints together."""
        return np.tensordot(weight, self.more, 1), weight @ self.slope


@dataclass
class _Descent:
    """One hypothesis on its way to where it leaves least.

    Attributes:
        u: where it is, sizes of causes, then tolerances. prior, scale: around what, and how far it may go.
        at, least, blocks: where it was best, what it cost there, and what each run says there. seen: the same where it is now.
        slopes: of each run, weighted, (coordinates, rows, joints). bends: which of them are other ones wherever it comes to.
        share: of the way to where its blocks lead that it has gone since.
    """

    start: Refit
    causes: int
    u: Array
    prior: Array
    scale: Array
    steps: Array
    slopes: dict[int, Floats]
    at: Array
    bends: NDArray[np.bool_]
    least: float = np.inf
    share: float = 1.0
    blocks: dict[int, _Block] = dataclasses.field(default_factory=dict)
    seen: dict[int, _Block] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, start: Refit, tolerances: int, learnt: Mapping[int, Floats]) -> _Descent:
        """From a start, with what slopes are known of the tolerances alone."""
        centre = _vector(start)
        shares = np.array([q.share for q in _quantities(start)], bool)
        sizes = np.where(shares, POLISH, np.maximum(POLISH * np.abs(centre), 1e-3))
        steps = np.where(shares, 0.1, np.maximum(0.05 * np.abs(centre), 1e-3))
        u: Array = np.concatenate([centre, start.nuisance])
        slopes = {
            k: np.concatenate([np.zeros((len(centre), *known.shape[1:]), np.float32), known])
            for k, known in learnt.items()
        }
        return cls(
            start,
            len(centre),
            u,
            np.concatenate([centre, np.zeros(tolerances)]),
            np.concatenate([sizes, np.full(tolerances, SPREAD)]),
            np.concatenate([steps, np.full(tolerances, NEARBY)]),
            slopes,
            u,
            np.array([True] * len(centre) + [False] * tolerances),
        )

    def moved(self, members: Iterable[tuple[int, NDArray[np.bool_]]]) -> Array:
        """Where it is with some coordinates a step farther."""
        out = self.u.copy()
        for p, _ in members:
            out[p] += self.steps[p]
        return out

    @property
    def cost(self) -> float:
        """Minus twice the logarithm of how likely it is where it is now, and what that says of sizes and tolerances."""
        own = float(np.sum(np.square((self.u - self.prior) / self.scale)))
        return own + sum(block.surprise for block in self.seen.values())

    def failed(self, k: int) -> bool:
        """Whether a run leaves clearly more than its slopes foretold where it was best, though all together have gained."""
        if k not in self.blocks or self.cost > self.least:
            return False
        before, now = self.blocks[k], self.seen[k]
        foretold = before.left(self.u - self.at)
        weight = 1 / before.inflation(before.cost)
        return bool(weight @ now.cost > FORETOLD * (weight @ foretold))


class Windows:
    """Runs cut into windows, and what of the model is re-fitted on them.

    Args:
        protocol: the robot and its runs, at the model's own step.

    Attributes:
        measured: of each run, (rows, joints) rad; NaN where nobody knows what a servo had in mind (`around_switching`).
        found: where a re-fit of `nothing` came to, in tolerances as `names`; 0 before.
    """

    def __init__(self, protocol: RunSet) -> None:
        self.protocol = protocol
        self.names = _nuisances(protocol)
        self._before: dict[int, Array] = {}
        self._rollouts = [_restarted(one) for one in protocol.runs]
        coarse = protocol.coarse().runs
        self._quick = [_restarted(one).thinned(FOLLOWED[one.plant.setup]) for one in coarse]
        unsure = [around_switching(one.run, protocol.joints) for one in protocol.runs]
        self.measured = [
            np.where(there, np.nan, one.run.signal("pos", protocol.joints))
            for one, there in zip(protocol.runs, unsure, strict=True)
        ]
        self.floor = floors([one.run for one in protocol.runs], protocol.joints)[0]
        self._sigma = np.maximum(self.floor, LEAST_SIGMA_RAD)
        self._followed = [
            np.isin(np.arange(len(one.run.t)), [row for piece in quick.segments for row in piece.row])
            for one, quick in zip(protocol.runs, self._quick, strict=True)
        ]
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
            elif u:
                adjust(robot, one.name, one.joints, one.value(float(u)))
        return robot

    def errors(self, k: int, refits: Sequence[Refit | None], *, quick: bool = False) -> Array:
        """(refits, rows, joints) rad, measured minus simulated on run k; `quick`: in larger steps, where fits follow it."""
        return self._errors(
            k, [self.robot(refit, k) for refit in refits], (self._quick if quick else self._rollouts)[k]
        )

    def simulated(self, k: int, refit: Refit, signals: Sequence[str]) -> dict[str, Array]:
        """Signal → (rows, joints), what a re-fitted model does on run k."""
        found = simulate(
            self._rollouts[k], [self.robot(refit, k)], signals=signals, warm_c=[self.protocol.runs[k].warm_c]
        ).signals
        return {name: values[0].astype(np.float64) for name, values in found.items()}

    def before(self, k: int) -> Array:
        """(rows, joints) rad, the same of the model as it was given."""
        if k not in self._before:
            self._before[k] = self._errors(k, [self.robot(None, k)], self._rollouts[k])[0]
        return self._before[k]

    def written(self, refit: Refit, judged: Sequence[int]) -> float:
        """The gap, rad, on these runs of the one model that can be written: its servos are always as warm as on average there."""
        warm = self.warmth(judged)
        errors = np.concatenate([self._errors(k, [self.robot(refit, k, warm)], self._rollouts[k])[0] for k in judged])
        return float(np.sqrt(np.mean(np.square(errors[np.isfinite(errors)]))))

    def warmth(self, judged: Sequence[int]) -> Array:
        """(joints,) °C above the coolest run, mean of some runs."""
        mean: Array = np.mean([self.protocol.runs[k].warm_c for k in judged], axis=0)
        return mean

    def _errors(self, k: int, robots: Sequence[Robot], rollouts: Rollouts) -> Array:
        found = simulate(rollouts, robots, signals=("pos",), warm_c=[self.protocol.runs[k].warm_c]).signals["pos"]
        out: Array = self.measured[k][None] - found.astype(np.float64)
        there = np.zeros(found.shape[1], bool)
        for segment in rollouts.segments:
            there[segment.row] = True
        # A robot that no step holds together is as wrong as can be: neither right nor unknown.
        lost = there[:, None] & np.isfinite(self.measured[k]) & ~(np.abs(found) < LOST_RAD)
        out[lost] = LOST_RAD
        return out

    def refit(
        self, starts: Sequence[Refit], training: Sequence[int], leave_out: Sequence[Collection[int]]
    ) -> list[tuple[Refit, list[Refit], tuple[Mapping[str, float], ...]]]:
        """Fit within tolerance, and polish sizes: each on all the runs to train on, and without each group of some of them.

        All share one linearisation each, at what is found on all of the training runs; and are simulated side by side.
        """
        descents = self._descend(starts, list(training))
        for one in descents:
            if not one.causes:
                self._keep(one)
        out = []
        for one in descents:
            folds = [[k for k in one.blocks if k not in left] for left in leave_out]
            # As far as all of them together went.
            each = [one.at + one.share * (self._solve(one, fold) - one.at) for fold in folds]
            whole, parts = _from(one.start, one.u), [_from(one.start, u) for u in each]
            out.append((whole, parts, _from(one.start, self._deviations(one, parts)).x))
        return out

    def _deviations(self, descent: _Descent, folds: Sequence[Refit]) -> Array:
        """Standard deviations of a fit's coordinates."""
        normal = np.diag(1 / descent.scale**2)
        for block in descent.blocks.values():
            normal += block.weighted(1 / block.inflation(block.cost))[0]
        curvature: Array = np.sqrt(np.diag(np.linalg.inv(normal)))
        if len(folds) < 2:
            return curvature
        each = np.array([np.concatenate([_vector(fold), fold.nuisance]) for fold in folds])
        spread = np.sqrt((len(each) - 1) / len(each) * np.square(each - each.mean(axis=0)).sum(axis=0))
        out: Array = np.maximum(curvature, spread)
        return out

    def _descend(self, starts: Sequence[Refit], fitted: Sequence[int]) -> list[_Descent]:
        """Follow each start to where it leaves least on these runs."""
        # Slopes cost the most: what was learnt without causes does until it fails.
        learnt = {k: known for k, known in self._learnt.items() if k in fitted}
        descents = [_Descent.of(start, len(self.names), learnt) for start in starts]
        moving = descents
        for _ in range(ITERATIONS):
            self._linearize(moving, fitted)
            for k in fitted:
                if poor := [one for one in moving if one.failed(k)]:
                    for one in poor:
                        del one.slopes[k]
                    self._linearize(poor, [k])
            for one in moving:
                if one.cost > one.least:
                    # Farther than the slopes hold.
                    one.share /= 2
                    one.u = (one.at + one.u) / 2
                    continue
                one.at, one.least, one.blocks, one.share = one.u, one.cost, dict(one.seen), 1.0
                one.u = self._solve(one, list(one.blocks))
            moving = [one for one in moving if (np.abs(one.u - one.at) > SETTLED * one.scale).any()]
            if not moving:
                break
        return descents

    def _keep(self, found: _Descent) -> None:
        """Remember what was learnt of tolerances."""
        self._learnt = {k: slopes[found.causes :] for k, slopes in found.slopes.items()}
        self.found = found.u[found.causes :]

    def _weight(self, k: int) -> Array:
        """(joints,) that errors of a run are multiplied by: its rows go together, and windows stand for those not followed."""
        played = self.protocol.runs[k]
        period = float(np.median(np.diff(played.run.t)))
        out: Array = np.sqrt(FOLLOWED[played.plant.setup] / max(1.0, INDEPENDENT_S / period)) / self._sigma
        return out

    def _count(self, k: int) -> Array:
        """(joints,) how many independent errors the rows of a run are, as weighted."""
        weight = np.square(self._weight(k) * self._sigma)
        count: Array = (np.isfinite(self.measured[k]) & self._followed[k][:, None]).sum(axis=0) * weight
        return count

    def _solve(self, descent: _Descent, runs: Sequence[int]) -> Array:
        """Where the blocks of some runs lead, made where the descent was best."""
        u, prior, scale = descent.at, descent.prior, descent.scale
        ends = [_limits(q, float(at)) for q, at in zip(_quantities(descent.start), prior, strict=False)]
        low, high = np.array([*ends, *[(-END, END)] * len(self.names)]).T
        within = np.minimum(low - u, 0) - TINY, np.maximum(high - u, 0) + TINY
        blocks, found = [descent.blocks[k] for k in runs], u
        for _ in range(INFLATIONS):
            more, slope = np.diag(1 / scale**2), (u - prior) / scale**2
            for block in blocks:
                own, along = block.weighted(1 / block.inflation(block.left(found - u)))
                more, slope = more + own, slope + along
            # What ends at a bound leaves its part to the others: clipped afterwards it would leave it undone.
            root = np.linalg.cholesky(more)
            found = np.clip(u + lsq_linear(root.T, -np.linalg.solve(root, slope), bounds=within).x, low, high)
        return found

    def _linearize(self, descents: Sequence[_Descent], fitted: Sequence[int]) -> None:
        """Look at runs from where descents have come to: what they cost there, and their blocks."""
        for k in fitted:
            weight = self._weight(k)
            columns = [self._columns(k, one) for one in descents]
            refits = [
                refit
                for one, mine in zip(descents, columns, strict=True)
                for refit in [_from(one.start, one.u), *(_from(one.start, one.moved(members)) for members in mine)]
            ]
            errors = self.errors(k, refits, quick=True)
            at = 0
            for one, mine in zip(descents, columns, strict=True):
                base = np.nan_to_num(errors[at]) * weight
                slopes = np.zeros((len(one.u), *base.shape), np.float32)
                if k in one.slopes:
                    slopes[:] = one.slopes[k]
                for row, members in enumerate(mine, at + 1):
                    change = np.nan_to_num(errors[row] - errors[at]) * weight
                    for p, mask in members:
                        slopes[p] = np.where(mask, change, 0.0) / one.steps[p]
                at += 1 + len(mine)
                one.slopes[k] = slopes
                one.seen[k] = _Block.of(base.astype(np.float32), slopes, self._count(k))

    def _columns(self, k: int, descent: _Descent) -> list[list[tuple[int, NDArray[np.bool_]]]]:
        """What is varied on a run. A joint within tolerance moves little: slopes once known are not looked at again."""
        columns = self._colours(self.protocol.runs[k], descent.start)
        if k not in descent.slopes:
            return columns
        return [members for members in columns if descent.bends[members[0][0]]]

    def _colours(self, one: Played, start: Refit) -> list[list[tuple[int, NDArray[np.bool_]]]]:
        """Coordinates that one simulation can vary, because on the stand legs do not move each other."""
        everywhere = np.ones(len(self.protocol.joints), bool)
        out: list[list[tuple[int, NDArray[np.bool_]]]] = []
        n = 0
        for part in start.hypothesis:
            for _ in part.definition.quantities:
                out.append([(n, everywhere)])
                n += 1
        tree = one.plant.tree
        used: list[tuple[set[int], list[tuple[int, NDArray[np.bool_]]]]] = []
        for k, nuisance in enumerate(self.names):
            mine = {int(tree[j]) for j in nuisance.joints} if one.plant.setup is Setup.STAND else set(tree.tolist())
            if not mine:  # of the floor, which does nothing to who hangs on a stand, unless it turns both
                if nuisance.name not in TILTS:
                    continue
                mine = set(tree.tolist())
            mask = np.isin(tree, list(mine))
            for trees, members in used:
                if not trees & mine:
                    trees |= mine
                    members.append((n + k, mask))
                    break
            else:
                used.append((mine, [(n + k, mask)]))
        return out + [members for _, members in used]


def _restarted(one: Played) -> Rollouts:
    """A run, begun anew from measurement as the gap is defined: all of it, or what of it is simulated."""
    if one.windows is None:
        return Rollouts(one.plant, [one.run], HORIZON_S)
    parts = []
    for start, stop in one.windows:
        edges = np.linspace(start, stop, max(1, round((stop - start) / HORIZON_S)) + 1).tolist()
        parts += list(itertools.pairwise(edges))
    return Rollouts(one.plant, [one.run], windows=[parts])


def closures(
    windows: Windows, starts: Sequence[Refit], folds: Sequence[Collection[int]], training: Sequence[int]
) -> list[Closure]:
    """What each hypothesis leaves of the gap.

    Args:
        folds: runs judged together by fits that have not seen them. training: the runs to fit on, but for those of the fold.
    """
    fits = windows.refit(starts, training, folds)
    judged = {k for fold in folds for k in fold}
    joints = windows.measured[0].shape[1]
    each, counts = np.zeros((len(starts) + 1, len(folds), joints)), np.zeros(len(folds))
    seen, rows = np.zeros((len(starts), joints)), 0.0
    for k in sorted(judged | set(training)):
        mine = [f for f, fold in enumerate(folds) if k in fold]
        refits = [one for whole, parts, _ in fits for one in (whole, *(parts[f] for f in mine))]
        errors = np.concatenate([windows.before(k)[None], windows.errors(k, refits)])
        good = np.isfinite(errors).all(axis=0)
        squares = np.square(np.where(good, errors, 0.0)).sum(axis=1)
        of = squares[1:].reshape(len(starts), 1 + len(mine), joints)
        if k in training:
            seen, rows = seen + of[:, 0], rows + good.sum() / joints
        each[0, mine] += squares[0]
        each[1:, mine] += of[:, 1:]
        counts[mine] += good.sum()
    floor = float(np.sqrt(np.mean(windows.floor**2)))
    out = []
    for n, (whole, _, std) in enumerate(fits):
        both = each[[0, n + 1]]
        before, after = np.sqrt(both.sum(axis=(1, 2)) / counts.sum())
        low, high = _interval(both[0].sum(axis=1), both[1].sum(axis=1), counts, floor)
        closed = _closed(float(before), float(after), floor)
        out.append(Closure(float(after), floor, closed, low, high, seen[n] / rows, both, counts, whole, std))
    return out


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


def _nuisances(protocol: RunSet) -> list[_Nuisance]:
    """What may move within tolerance: of each joint, of floor and body."""
    out = []
    joints = range(len(protocol.joints))
    for kind in ("stiffness", "damping", "torque_limit", "armature", "link_mass"):
        if kind != "torque_limit" or np.isfinite(protocol.reference.limit).all():
            out += [_Nuisance(kind, (j,), FACTORS[kind]) for j in joints]
    out += [
        _Nuisance(
            "coulomb_friction",
            (j,),
            tolerance_of("coulomb_friction") * min(1.0, float(protocol.reference.torque[j]) / 0.2),
        )
        for j in joints
    ]
    out += [_Nuisance("zero_offset", (j,), tolerance_of("zero_offset")) for j in joints]
    out.append(_Nuisance("delay", tuple(joints), tolerance_of("action_delay")))
    if protocol.warmed_c > WARMED_C:
        out.append(_Nuisance(HEAT_LOSS, tuple(joints), tolerance_of("thermal_derating")))
    if protocol.reference.floor:
        out += [_Nuisance(kind, (), tolerance) for kind, tolerance in FLOOR.items()]
        out.append(_Nuisance("torso_kg", (), torso_kg(protocol.reference)))
        out += [_Nuisance(kind, (), tolerance_of("floor_tilt") / np.sqrt(2)) for kind in TILTS]
    return out


def calibration_of(windows: Windows, refit: Refit, judged: Sequence[int]) -> dict[str, dict[str, float]]:
    """What moved within tolerance: kind → joint or `BODY` → factor, or what is added (N·m, rad, s, kg), see `adjust`.

    Args:
        judged: runs on which servos were as warm as those of the model are to be.
    """
    out: dict[str, dict[str, float]] = {}
    joints = windows.protocol.joints
    for one, u in zip(windows.names, refit.nuisance, strict=True):
        value = one.value(float(u))
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


def _limits(quantity: Quantity, at: float) -> tuple[float, float]:
    """Between which a size may be polished that was found somewhere: it keeps its sign, and a shape its reason."""
    if quantity.shape:
        return bounds_of(quantity)
    return (0.0, FARTHEST * at) if at >= 0 else (FARTHEST * at, 0.0)


def _quantities(refit: Refit) -> list[Quantity]:
    return [q for part in refit.hypothesis for q in part.definition.quantities]


def _vector(refit: Refit) -> Array:
    return np.array(
        [x[q.name] for part, x in zip(refit.hypothesis, refit.x, strict=True) for q in part.definition.quantities]
    )


def _from(start: Refit, u: Array) -> Refit:
    at, x = 0, []
    for part in start.hypothesis:
        names = [q.name for q in part.definition.quantities]
        x.append(dict(zip(names, map(float, u[at : at + len(names)]), strict=True)))
        at += len(names)
    return dataclasses.replace(start, x=tuple(x), nuisance=u[at:])
