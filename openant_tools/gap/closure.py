"""How far the gap closes on runs that were not used: the model re-fitted within tolerance, with causes and without.

Everything is judged as the gap is defined (formats, section 3): re-initialised from measurement, positions, held-out runs.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from openant_tools.effects.catalogue import enter
from openant_tools.effects.effect import Quantity
from openant_tools.effects.robot import Robot
from openant_tools.gap.explain import Hypothesis, Part, bounds_of
from openant_tools.gap.features import Floats, around_switching
from openant_tools.gap.protocol import Played, Protocol
from openant_tools.gap.simulation import simulate
from openant_tools.gap.tolerance import FACTORS, FLOOR, tolerance_of, torso_kg
from openant_tools.model.floor import floors
from openant_tools.model.gap import HORIZON_S, share_closed
from openant_tools.model.plant import Setup
from openant_tools.model.rollout import Rollouts

__all__ = [
    "BODY", "Closure", "ClosureByJoint", "Refit", "Windows", "adjust", "calibration_of", "closures", "heat_loss_of", "nothing", "unmoved",
]  # fmt: skip

Array = NDArray[np.float64]

#: standard deviation of a prior, as a share of the tolerance; and where it ends: a re-fit within tolerance is no effect
SPREAD, END = 0.6, 1.0
#: rows (of some tens of milliseconds each) of one window say about as much as one: errors within it go together
INDEPENDENT_S = 0.5
#: standard deviation that sizes of causes keep from where they were found, as a share
POLISH = 0.3
#: times what it was found to be that a size may become
FARTHEST = 2.5
#: and how often slopes are followed; while contacts are found, so often with one base, and how often it is led anew
ITERATIONS, SETTLES, LED = 3, 2, 2
#: times what slopes foretold that may be left: beyond, they are looked at anew
FORETOLD = 1.3
#: of so many windows fits follow one, on the stand and on the floor, where each takes long and all joints move each; and of so
#: many a first look takes one
FOLLOWED = {Setup.STAND: 1, Setup.FLOOR: 2}
GLANCE = {Setup.STAND: 3, Setup.FLOOR: 4}
#: of a tolerance by which it is varied to learn its slope
NEARBY = 0.3
#: times what a re-fit leaves of a servo's other joints that it leaves of a joint which is strained
STRAINED = 1.5
#: by which bounds are wider than what lies on them
TINY = 1e-12
#: rad: no joint is farther off than in a simulation that fell apart
LOST_RAD = 10.0
#: how the kinds of friction cone are called, and the impratio about which it is sought with each: a pyramid needs none of the
#: stiffness that keeps feet in an elliptic cone from creeping
CONES = {
    "pyramidal_cones": int(mujoco.mjtCone.mjCONE_PYRAMIDAL), "elliptic_cones": int(mujoco.mjtCone.mjCONE_ELLIPTIC),
}  # fmt: skip
USUAL_IMPRATIO = {CONES["pyramidal_cones"]: 2.0, CONES["elliptic_cones"]: 5.0}
#: squares of tolerances by which a floor has to be bent before another cone is looked at, and times what is left that it may
#: leave at first sight; squares of what a position is known to beyond which what is left of a joint and window is seldom a foot's
BENT, ANSWERS, MUCH = 4.0, 2.5, 40.0
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
    """What a hypothesis leaves of the gap on runs that its fit had not seen.

    Attributes:
        after: rad. closed: share of the excess that is gone; low, high: over the runs, 95 %.
        worst: the least closed of any run that had a gap.
        refit: on all training runs together.
    """

    after: float
    closed: float
    low: float
    high: float
    worst: float
    refit: Refit


@dataclass(frozen=True)
class ClosureByJoint(Closure):
    """The same where it is known of each joint.

    Attributes:
        joints: (2, joints) rad², mean squares before and after. floor: rad.
    """

    joints: Array
    floor: float

    def outlier(self, groups: Iterable[Sequence[int]], times: float) -> int | None:
        """The joint of which it leaves most beside others with the same servo, if that is so many times what it leaves of them."""
        return _outlier(np.sqrt(self.joints[1]), groups, times)

    def closed_at(self, joints: Sequence[int]) -> float:
        """The share that is gone of the excess of some joints."""
        before, after = np.sqrt(self.joints[:, list(joints)].mean(axis=1))
        return _closed(float(before), float(after), self.floor)


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
    elif kind in CONES:
        robot.cone = CONES[kind]
    elif kind in TILTS:
        robot.tilt = robot.tilt + value * np.eye(2)[TILTS.index(kind)]
    else:
        raise KeyError(kind)


@dataclass
class _Descent:
    """One hypothesis on its way to where it leaves least.

    Attributes:
        u: where it is, sizes of causes, then tolerances. prior, scale: around what, and how far it may go.
        at, least, blocks: where it was best, what it cost there, and of each run cost, normal matrix and gradient there.
        seen: the same where it is now.
        slopes: of each run, weighted, (coordinates, rows). bends: which of them are other ones wherever it comes to.
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
    blocks: dict[int, tuple[float, Array, Array]] = dataclasses.field(default_factory=dict)
    seen: dict[int, tuple[float, Array, Array]] = dataclasses.field(default_factory=dict)

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
        """What it costs where it is now: its prior, and what runs leave."""
        own = float(np.sum(np.square((self.u - self.prior) / self.scale)))
        return own + sum(cost for cost, _, _ in self.seen.values())

    def failed(self, k: int) -> bool:
        """Whether a run leaves clearly more than its slopes foretold where it was best, though all together have gained."""
        if k not in self.blocks or self.cost > self.least:
            return False
        moved = self.u - self.at
        cost, more, slope = self.blocks[k]
        expected = max(cost + float(2 * slope @ moved + moved @ more @ moved), 0.0)
        return self.seen[k][0] > FORETOLD * expected


class Windows:
    """Runs cut into windows, and what of the model is re-fitted on them.

    Args:
        protocol: the robot and its runs, at the model's own step.

    Attributes:
        measured: of each run, (rows, joints) rad; NaN where nobody knows what a servo had in mind (`around_switching`).
        found: where `settle` came to, before that a re-fit of `nothing`, in tolerances as `names`; 0 before either.
        cone: mjtCone by which feet were found to slip, None as given.
    """

    def __init__(self, protocol: Protocol) -> None:
        self.protocol = protocol
        self.names = _nuisances(protocol)
        self._coarse = protocol.coarse()
        self._before: dict[int, Array] = {}
        self._given = [_restarted(one) for one in protocol.runs]
        self._rollouts = self._given.copy()
        whole = [_restarted(one) for one in self._coarse.runs]
        self._quick = [one.thinned(FOLLOWED[one.plant.setup]) for one in whole]
        self._glance = [one.thinned(GLANCE[one.plant.setup]) for one in whole]
        unsure = [around_switching(one.run, protocol.joints) for one in protocol.runs]
        self.measured = [
            np.where(there, np.nan, one.run.signal("pos", protocol.joints))
            for one, there in zip(protocol.runs, unsure, strict=True)
        ]
        self.floor = floors([one.run for one in protocol.runs], protocol.joints)[0]
        self._sigma = np.maximum(self.floor, LEAST_SIGMA_RAD)
        self._learnt: dict[int, Floats] = {}
        self._plain: dict[int, Array] = {}
        self.found = np.zeros(len(self.names))
        self.cone: int | None = None
        self._settled_once = False
        self._of_floor = np.array([not one.joints for one in self.names])

    def robot(self, refit: Refit | None, k: int, warm_c: Array | None = None) -> Robot:
        """As it is on run k; None: the model as it was given.

        Args:
            warm_c: (joints,) °C above the coolest run; default as warm as its servos were then.
        """
        reference = self.protocol.reference
        robot = Robot(len(self.protocol.joints), reference.low, reference.high)
        if refit is None:
            return robot
        if self.cone is not None:
            robot.cone = self.cone
            robot.impratio = self.usual_ratio()
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
        """(rows, joints) rad, the same of the model as it was given, with a base that it led itself."""
        if k not in self._before:
            self._before[k] = self._errors(k, [self.robot(None, k)], self._given[k])[0]
        return self._before[k]

    def _lead(self, refit: Refit, *, quick: bool) -> None:
        """Let a base that nobody measured come, at the beginning of each window, to where a re-fitted model takes it.

        Args:
            quick: where simulations take larger steps; else where they do not.
        """
        for k, one in enumerate((self._coarse if quick else self.protocol).runs):
            if one.plant.setup is not Setup.FLOOR:
                continue
            led = _restarted(one, self.robot(refit, k).model(one.plant))
            if quick:
                self._quick[k], self._glance[k] = led.thinned(FOLLOWED[Setup.FLOOR]), led.thinned(GLANCE[Setup.FLOOR])
            else:
                self._rollouts[k] = led

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
        self, starts: Sequence[Refit], training: Sequence[int], leave_out: Sequence[int], *, anew: bool = False
    ) -> list[tuple[Refit, list[Refit]]]:
        """Fit within tolerance, and polish sizes: each on all the runs to train on, and without each of some of them.

        All share one linearisation each, at what is found on all of the training runs; and are simulated side by side.

        Args:
            anew: learn there what tolerances do, whatever was learnt without causes.
        """
        fitted = list(training)
        descents = self._descend(starts, fitted, anew=anew)
        for one in descents:
            if not one.causes and not self._settled_once:
                self._keep(one)
        out = []
        for one in descents:
            folds = [[block for k, (_, *block) in one.blocks.items() if k != left] for left in leave_out]
            whole = _from(one.start, one.u)
            out.append((whole, [_from(one.start, self._solve(one, fold)) for fold in folds]))
        return out

    def _descend(
        self, starts: Sequence[Refit], fitted: Sequence[int], turns: int = ITERATIONS, *,
        settles: bool = False, anew: bool = False,
    ) -> list[_Descent]:  # fmt: skip
        """Follow each start to where it leaves least on these runs; `settles`: contacts bend on their way."""
        # Slopes cost the most: what was learnt without causes does until it fails.
        learnt = {k: known for k, known in self._learnt.items() if k in fitted and not anew}
        descents = [_Descent.of(start, len(self.names), learnt) for start in starts]
        for one in descents:
            one.bends[one.causes :] = settles & self._of_floor
        for _ in range(turns):
            self._linearize(descents, fitted)
            for k in fitted:
                if poor := [one for one in descents if one.failed(k)]:
                    for one in poor:
                        del one.slopes[k]
                    self._linearize(poor, [k])
            for one in descents:
                if one.cost > one.least:
                    # Farther than the slopes hold.
                    one.u = (one.at + one.u) / 2
                    continue
                one.at, one.least, one.blocks = one.u, one.cost, dict(one.seen)
                one.u = self._solve(one, [block for _, *block in one.blocks.values()])
        return descents

    def _keep(self, found: _Descent) -> None:
        """Remember what was learnt of tolerances."""
        self._learnt = {k: slopes[found.causes :] for k, slopes in found.slopes.items()}
        self.found = found.u[found.causes :]

    @property
    def contacts(self) -> Array:
        """(names,) where floor and body were found to be; 0 of joints."""
        out: Array = np.where(self._of_floor, self.found, 0.0)
        return out

    def usual_ratio(self) -> float:
        """The factor on the given impratio that belongs to the cones which were found."""
        if self.cone is None:
            return 1.0
        given = next(one.plant.model.opt.impratio for one in self.protocol.runs if one.plant.setup is Setup.FLOOR)
        return USUAL_IMPRATIO[self.cone] / float(given)

    def look(self, training: Sequence[int]) -> None:
        """Learn what tolerances do on these runs, as first looks (`left`) need to know it."""
        (found,) = self._descend([nothing(self)], training, SETTLES)
        self._keep(found)

    def settle(self, best: Refit, training: Sequence[int], in_time: Callable[[], bool] = lambda: True) -> None:
        """Find how feet meet the floor: everything else starts from there, and bases are led by it.

        Feet may slip by the other of MuJoCo's friction cones, too, whatever the given model has.

        Args:
            best: what leaves least so far; contacts that had to do for a cause would be none of this floor's.
            in_time: whether there is time to try other cones, asked where they might do better.
        """
        floor = [k for k in training if self.protocol.runs[k].plant.setup is Setup.FLOOR]
        if not floor:
            return
        self._settled_once = True
        found = self._settled(best, training)
        (own,) = self.left([found], floor)
        if float(np.square(found.nuisance[self._of_floor]).sum()) < BENT:
            self._lead(found, quick=False)
            return
        looked = FOLLOWED[Setup.FLOOR] * sum(len(self._glance[k].segments) for k in floor)
        much = own > MUCH * len(self.protocol.joints) * looked
        given = int(self.protocol.runs[floor[0]].plant.model.opt.cone)
        before = self._learnt, self._plain.copy(), self.found
        self.cone = next(cone for cone in CONES.values() if cone != given)
        start = dataclasses.replace(found, nuisance=np.where(self._of_floor, 0.0, found.nuisance))
        self._lead(start, quick=True)
        if self.left([start], floor)[0] < (1 if much else ANSWERS) * own and in_time():
            self._learnt = {k: known for k, known in self._learnt.items() if k not in floor}
            other = self._settled(start, training)
            (others,) = self.left([other], floor)
            if others < own:
                self._lead(other, quick=False)
                return
        self.cone = None
        self._learnt, self._plain, self.found = before
        self._lead(found, quick=True)
        self._lead(found, quick=False)

    def _settled(self, start: Refit, training: Sequence[int]) -> Refit:
        """Where contacts are found to be, with a base that is led by what was found."""
        for _ in range(LED):
            (descent,) = self._descend([start], list(training), SETTLES, settles=True)
            self._keep(descent)
            start = _from(start, descent.u)
            self._lead(start, quick=True)
        return start

    def left(self, refits: Sequence[Refit], seen: Sequence[int], joints: Sequence[int] | None = None) -> Array:
        """(refits,) the cost that each would leave, re-fitted within tolerance by the slopes that were learnt without causes.

        A first look at many causes, at some of the windows, after a re-fit of `nothing` on these runs.

        Args:
            joints: of which it counts what is left; default all.
        """
        others = np.ones(len(self.protocol.joints), bool)
        others[list(range(len(others)) if joints is None else joints)] = False
        normal = np.diag(np.full(len(self.names), 1 / SPREAD**2))
        at = np.array([refit.nuisance for refit in refits])
        gradients, cost = at / SPREAD**2, np.square(at / SPREAD).sum(axis=1)
        for k in seen:
            errors = self._errors(k, [self.robot(refit, k) for refit in refits], self._glance[k])
            errors[..., others] = np.nan
            looked = np.isfinite(errors).any(axis=0).ravel()
            errors = (np.nan_to_num(errors) * self._weight(k)).reshape(len(refits), -1)[:, looked]
            slopes = self._learnt[k][:, looked].astype(np.float64)
            normal += slopes @ slopes.T
            gradients += errors @ slopes.T
            cost += np.square(errors).sum(axis=1)
        root = np.linalg.cholesky(normal)
        out = np.empty(len(refits))
        for r, gradient in enumerate(gradients):
            ends = np.minimum(-END - at[r], 0) - TINY, np.maximum(END - at[r], 0) + TINY
            u = lsq_linear(root.T, -np.linalg.solve(root, gradient), bounds=ends).x
            out[r] = cost[r] + 2 * gradient @ u + u @ normal @ u
        return out

    def strained(self, seen: Sequence[int], times: float = STRAINED) -> list[int]:
        """Joints of which the model leaves so many times what it leaves of others with the same servo.

        Of all runs one at most, and one of the stand's: on the floor what one leg does wrong shows in all. After a re-fit of
        `nothing` on these runs.
        """
        stand = [k for k in seen if self.protocol.runs[k].plant.setup is Setup.STAND]
        found = [self._outlier(runs, times) for runs in (seen, stand) if len(runs)]
        return sorted({joint for joint in found if joint is not None})

    def _outlier(self, seen: Sequence[int], times: float) -> int | None:
        left = np.sqrt(np.mean([np.square(self._plain[k]) for k in seen], axis=0))
        return _outlier(left, self.protocol.servos(), times)

    def _weight(self, k: int) -> Array:
        """(joints,) that errors of a run are multiplied by: its rows go together, and windows stand for those not followed."""
        played = self.protocol.runs[k]
        period = float(np.median(np.diff(played.run.t)))
        out: Array = np.sqrt(FOLLOWED[played.plant.setup] / max(1.0, INDEPENDENT_S / period)) / self._sigma
        return out

    def _solve(self, descent: _Descent, blocks: Iterable[Sequence[Array]]) -> Array:
        """Where the runs' blocks lead, made where the descent is at."""
        u, prior, scale = descent.at, descent.prior, descent.scale
        normal, gradient = np.diag(1 / scale**2), (u - prior) / scale**2
        for more, slope in blocks:
            normal, gradient = normal + more, gradient + slope
        ends = [_limits(q, float(at)) for q, at in zip(_quantities(descent.start), prior, strict=False)]
        low, high = np.array([*ends, *[(-END, END)] * len(self.names)]).T
        # What ends at a bound leaves its part to the others: clipped afterwards it would leave it undone.
        root = np.linalg.cholesky(normal)
        inside = lsq_linear(
            root.T,
            -np.linalg.solve(root, gradient),
            bounds=(np.minimum(low - u, 0) - TINY, np.maximum(high - u, 0) + TINY),
        )
        found: Array = np.clip(u + inside.x, low, high)
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
                followed = np.isfinite(errors[at]).any(axis=-1)
                base = np.nan_to_num(errors[at]) * weight
                slopes = np.zeros((len(one.u), base.size), np.float32)
                if k in one.slopes:
                    slopes[:] = one.slopes[k]
                for row, members in enumerate(mine, at + 1):
                    change = np.nan_to_num(errors[row] - errors[at]) * weight
                    for p, mask in members:
                        slopes[p] = (np.where(mask, change, 0.0) / one.steps[p]).ravel()
                at += 1 + len(mine)
                left = base.ravel().astype(np.float32)
                one.slopes[k] = slopes
                if not one.causes:
                    self._plain[k] = np.sqrt(np.mean(np.square(base[followed]), axis=0)) / weight
                one.seen[k] = (
                    float(left.astype(np.float64) @ left),
                    (slopes @ slopes.T).astype(np.float64),
                    (slopes @ left).astype(np.float64),
                )

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


def _restarted(one: Played, leader: mujoco.MjModel | None = None) -> Rollouts:
    """A run, begun anew from measurement as the gap is defined: all of it, or what of it is simulated."""
    if one.windows is None:
        return Rollouts(one.plant, [one.run], HORIZON_S, leader=leader)
    parts = []
    for start, stop in one.windows:
        edges = np.linspace(start, stop, max(1, round((stop - start) / HORIZON_S)) + 1).tolist()
        parts += list(itertools.pairwise(edges))
    return Rollouts(one.plant, [one.run], leader=leader, windows=[parts])


def closures(
    windows: Windows, starts: Sequence[Refit], held_out: Sequence[int], training: Sequence[int], *, anew: bool = False
) -> tuple[float, float, list[ClosureByJoint]]:
    """The gap before, the floor (rad), and what each hypothesis leaves.

    Args:
        held_out: runs that nothing was fitted on; empty to leave out each in turn.
        training: the runs to fit on. anew: see `Windows.refit`.
    """
    judged = list(held_out or training)
    fits = windows.refit(starts, training, () if held_out else judged, anew=anew)
    joints = len(windows.protocol.joints)
    each, known = np.zeros((len(starts) + 1, len(judged), joints)), np.zeros((len(judged), joints))
    for n, k in enumerate(judged):
        refits = [whole if held_out else folds[n] for whole, folds in fits]
        errors = np.concatenate([windows.before(k)[None], windows.errors(k, refits)])
        good = np.isfinite(errors).all(axis=0)
        each[:, n] = np.square(np.where(good, errors, 0.0)).sum(axis=1)
        known[n] = good.sum(axis=0)
    squares, counts = each.sum(axis=2), known.sum(axis=1)
    means = each.sum(axis=1) / np.maximum(known.sum(axis=0), 1)
    floor = float(np.sqrt(np.mean(windows.floor**2)))
    before = float(np.sqrt(squares[0].sum() / counts.sum()))
    out = []
    for s in range(len(starts)):
        after = float(np.sqrt(squares[s + 1].sum() / counts.sum()))
        low, high = _interval(squares[0], squares[s + 1], counts, floor)
        runs = [
            _closed(float(np.sqrt(a / c)), float(np.sqrt(b / c)), floor)
            for a, b, c in zip(squares[0], squares[s + 1], counts, strict=True)
            if np.sqrt(a / c) > 1.5 * floor
        ]
        closed, worst = _closed(before, after, floor), min(runs, default=float("nan"))
        out.append(ClosureByJoint(after, closed, low, high, worst, fits[s][0], means[[0, s + 1]], floor))
    return before, floor, out


def _outlier(left: Array, groups: Iterable[Sequence[int]], times: float) -> int | None:
    share = np.ones(len(left))
    for group in groups:
        for j in group:
            others = [left[i] for i in group if i != j]
            share[j] = left[j] / np.median(others) if others else 1.0
    worst = int(np.argmax(share))
    return worst if share[worst] > times else None


def _closed(before: float, after: float, floor: float) -> float:
    share = share_closed(before, after, floor)
    return share if np.isfinite(share) else 0.0


def _interval(before: Array, after: Array, counts: Array, floor: float) -> tuple[float, float]:
    """95 % of the closure over runs drawn with replacement."""
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


def _nuisances(protocol: Protocol) -> list[_Nuisance]:
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
    out |= {kind: {BODY: 1.0} for kind, cone in CONES.items() if cone == windows.cone}
    for one, u in zip(windows.names, refit.nuisance, strict=True):
        value = one.value(float(u))
        if one.name == HEAT_LOSS:
            for kind in LESS:
                for joint, left in zip(joints, 1 / (1 + value * windows.warmth(judged)), strict=True):
                    if kind in out:
                        out[kind][joint] *= float(left)
            continue
        if one.name == "impratio":
            value *= windows.usual_ratio()
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
    """Causes at these coordinates, and no joint moved within tolerance yet; contacts are where they were found."""
    return Refit(tuple(parts), tuple(x), windows.contacts)


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
