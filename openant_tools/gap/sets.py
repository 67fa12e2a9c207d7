"""Which causes explain a robot of few joints together: fits of sets of them, judged on motions and settings left out.

Real servos have several effects at once, and one alone is bent to make up for the others. Where a robot is cheap to simulate,
all suspects are fitted together, and what can be spared is taken away again, one after another.

No model of a real servo is true. Errors are taken to be as large as a fit leaves them (tempered), not as the sensor's: a fit
that trusts its sensor follows what no parameter explains, to the ends of all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from openant_tools.effects.effect import Quantity
from openant_tools.gap.closure import END, INDEPENDENT_S, LEAST_SIGMA_RAD, SPREAD, Closure, Refit, Windows
from openant_tools.gap.explain import Part, bounds_of
from openant_tools.gap.features import Floats
from openant_tools.gap.protocol import Protocol, alike
from openant_tools.gap.simulation import simulate
from openant_tools.model.gap import HORIZON_S, share_closed
from openant_tools.model.rollout import Rollouts

__all__ = ["Choice", "Fold", "SetFits", "Tried", "choose", "folds_of", "motions_of"]

Array = NDArray[np.float64]

#: steps of a fit between two derivatives by differences; Broyden's rank-one updates do in between
ROUNDS = 2
#: derivatives of a fit that starts anew
ANEW = 2
#: and of the best in the end
SETTLED = 1
#: share of a coordinate, and of a large one, by which it is varied; of what tolerances let move, in tolerances
STEP, LEAST_STEP, TOLERANCE_STEP = 0.05, 0.02, 0.3
#: dampings of Levenberg and Marquardt that are tried side by side, and the first of them
DAMPINGS, FIRST_DAMPING = (1.0, 30.0), 1e-2
#: standard deviation of a cause's size beforehand, in large ones
LIKELY = 1.0
#: share of the cost below which a step is no step
ENOUGH = 1e-3
#: closure that a cause must bring to a set, and more of it for each factor of ten by which the judge doubts that it is there
BRINGS, DOUBTED, LIKELY_THERE = 0.015, 0.02, 0.5
#: closure that a cause may cost which another signal vouches for
LOSES = 0.01
#: sets whose closures differ by less are not told apart
APART = 0.02
#: sizes, as shares of what was found, among which a fold chooses that of a cause which moves no joint
SIZES = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5)
#: of the gap's, how far positions may be moved by a cause that is judged by another signal
STILL = 0.1


@dataclass(frozen=True)
class Fold:
    """Runs that are left out together: all of one motion, or all in one setting."""

    name: str
    out: tuple[int, ...]


def motions_of(protocol: Protocol, which: Sequence[int]) -> list[list[int]]:
    """Runs of one kind of motion together."""
    motions: list[list[int]] = []
    for k in which:
        for group in motions:
            if alike(protocol.runs[k].run, protocol.runs[group[0]].run, protocol.joints):
                group.append(k)
                break
        else:
            motions.append([k])
    return motions


def folds_of(protocol: Protocol, which: Sequence[int]) -> list[Fold]:
    """By motion, and where the runs' models differ, by setting; of one motion in one setting each run by itself."""
    motions = motions_of(protocol, which)
    settings: dict[str, list[int]] = {}
    for k in which:
        settings.setdefault(protocol.runs[k].plant.path.stem, []).append(k)
    names = [protocol.runs[group[0]].run.facts.protocol or protocol.runs[group[0]].run.name for group in motions]
    by_motion = [Fold(name, tuple(group)) for name, group in zip(names, motions, strict=True)]
    by_setting = [Fold(name, tuple(group)) for name, group in settings.items()]
    found = [fold for folds in (by_motion, by_setting) if len(folds) > 1 for fold in folds]
    return found or [Fold(protocol.runs[k].run.name, (k,)) for k in which]


@dataclass
class _Search:
    """A set on its way. Coordinates of its causes come first, then what tolerances let move.

    Attributes:
        u: (n,). errors: (rows,) rad. slopes: (n, rows).
    """

    parts: tuple[Part, ...]
    u: Array
    errors: Array = field(default_factory=lambda: np.empty(0))
    slopes: Array = field(default_factory=lambda: np.empty((0, 0)))
    damping: float = FIRST_DAMPING
    done: bool = False

    @property
    def quantities(self) -> list[Quantity]:
        return [q for part in self.parts for q in part.definition.quantities]

    def without(self, causes: Sequence[str]) -> _Search:
        """The same without some of its causes."""
        names = [part.cause for part in self.parts for _ in part.definition.quantities]
        keep = np.array([name not in causes for name in names] + [True] * (len(self.u) - len(names)))
        return _Search(
            tuple(part for part in self.parts if part.cause not in causes), self.u[keep],
            slopes=self.slopes[keep],
        )  # fmt: skip


@dataclass(frozen=True)
class Tried:
    """A set fitted, and what it leaves on the folds.

    Attributes:
        refit: on all training runs. std: of its coordinates, in order. folds: closed of each; closed: of all their samples.
        after: rad.
    """

    refit: Refit
    std: Array
    folds: Mapping[str, float]
    closed: float
    before: float
    after: float

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(part.cause for part in self.refit.hypothesis)

    @property
    def worst(self) -> float:
        return min(self.folds.values())

    def point(self, cause: str) -> Mapping[str, float]:
        """Coordinates of one of its causes."""
        return self.refit.x[self.names.index(cause)]

    def spread(self, cause: str) -> dict[str, float]:
        """Their standard deviations."""
        owners = [(part.cause, q.name) for part in self.refit.hypothesis for q in part.definition.quantities]
        return {name: float(std) for (owner, name), std in zip(owners, self.std, strict=False) if owner == cause}

    @property
    def closure(self) -> Closure:
        """The same in other words; its interval spans the folds."""
        return Closure(self.after, self.closed, self.worst, max(self.folds.values()), self.worst, self.refit)


class SetFits:
    """Fits of sets on a protocol's runs.

    Args:
        windows: the runs. training: those to fit on. folds: what is left out in turn; `held_out`: instead, runs never fitted.
    """

    def __init__(self, windows: Windows, training: Sequence[int], held_out: Sequence[int]) -> None:
        self.windows, self.training = windows, list(training)
        protocol = windows.protocol
        self.folds = [Fold("held out", tuple(held_out))] if held_out else folds_of(protocol, training)
        coarse = protocol.coarse()
        # One thread: what one joint's steps take is less than waiting for each other.
        self._rollouts = [Rollouts(one.plant, [one.run], HORIZON_S, nthread=1) for one in coarse.runs]
        self._weight, self._run = [], []
        for k in training:
            t = protocol.runs[k].run.t
            period = np.minimum(np.gradient(t), INDEPENDENT_S)
            self._weight.append(np.repeat(period / INDEPENDENT_S, len(protocol.joints)))
            self._run.append(np.full(t.size * len(protocol.joints), k))
        self._weights, self._runs = np.concatenate(self._weight), np.concatenate(self._run)

    def _errors(self, k: int, refits: Sequence[Refit | None], *, exact: bool = False) -> Array:
        """(refits, rows) rad, 0 where nothing was measured; `exact`: in the model's own steps."""
        if exact:
            errors = self.windows.errors(k, refits)
        else:
            robots = [self.windows.robot(refit, k) for refit in refits]
            errors = (
                self.windows.measured[k][None] - simulate(self._rollouts[k], robots, signals=("pos",)).signals["pos"]
            )
        out: Array = np.nan_to_num(errors).reshape(len(refits), -1)
        return out

    def _all(self, refits: Sequence[Refit]) -> Array:
        return np.concatenate([self._errors(k, refits) for k in self.training], axis=1)

    def refit(self, search: _Search, u: Array) -> Refit:
        """A point of a set's coordinates."""
        at, x = 0, []
        for part in search.parts:
            names = [q.name for q in part.definition.quantities]
            x.append(dict(zip(names, map(float, u[at : at + len(names)]), strict=True)))
            at += len(names)
        return Refit(search.parts, tuple(x), u[at:])

    def _prior(self, search: _Search) -> tuple[Array, Array, Array, Array]:
        """Where each coordinate is likely, how far from there, and between which ends it lies."""
        own, n = search.quantities, len(self.windows.names)
        lows, highs = np.array([bounds_of(q) for q in own]).reshape(-1, 2).T
        centre = np.array([q.between(0.5) if q.shape else 0.0 for q in own])
        width = np.array([LIKELY * q.large for q in own])
        return (
            np.concatenate([centre, np.zeros(n)]), np.concatenate([width, np.full(n, SPREAD)]),
            np.concatenate([lows, np.full(n, -END)]), np.concatenate([highs, np.full(n, END)]),
        )  # fmt: skip

    def _noise(self, errors: Array, rows: NDArray[np.bool_] | slice = slice(None)) -> float:
        weights = self._weights[rows]
        return max(float(np.sqrt(np.sum(weights * errors[rows] ** 2) / weights.sum())), LEAST_SIGMA_RAD)

    def _cost(self, search: _Search, u: Array, errors: Array) -> float:
        centre, width, _, _ = self._prior(search)
        noise = self._noise(errors)
        return float(self._weights.sum() * 2 * np.log(noise) + np.sum(((u - centre) / width) ** 2))

    def _steps(self, search: _Search) -> Array:
        own = [max(STEP * abs(v), LEAST_STEP * q.large) for v, q in zip(search.u, search.quantities, strict=False)]
        steps: Array = np.concatenate([own, np.full(len(self.windows.names), TOLERANCE_STEP)])
        high = self._prior(search)[3]
        out: Array = np.where(search.u + steps > high, -steps, steps)
        return out

    def _differentiate(self, searches: Sequence[_Search]) -> None:
        """Errors and slopes where each of them is."""
        refits, steps = [], []
        for search in searches:
            steps.append(self._steps(search))
            refits += [
                self.refit(search, search.u),
                *(self.refit(search, row) for row in search.u + np.diag(steps[-1])),
            ]
        found, at = self._all(refits), 0
        for search, step in zip(searches, steps, strict=True):
            search.errors = found[at]
            search.slopes = (found[at + 1 : at + 1 + len(step)] - found[at]) / step[:, None]
            at += 1 + len(step)

    def _step(self, search: _Search, damping: float, rows: NDArray[np.bool_] | slice = slice(None)) -> Array:
        """Where a damped step of Gauss and Newton within bounds leads, on some rows."""
        centre, width, low, high = self._prior(search)
        weight = np.sqrt(self._weights[rows]) / self._noise(search.errors, rows)
        slopes, errors = search.slopes[:, rows] * weight, search.errors[rows] * weight
        normal = slopes @ slopes.T + np.diag(1 / width**2)
        gradient = slopes @ errors + (search.u - centre) / width**2
        root = np.linalg.cholesky(normal + np.diag(damping * np.diag(normal)))
        target = -np.linalg.solve(root, gradient)
        inside = lsq_linear(root.T, target, bounds=(low - search.u - 1e-12, high - search.u + 1e-12))
        out: Array = np.clip(search.u + inside.x, low, high)
        return out

    def _improve(self, searches: Sequence[_Search]) -> None:
        """One step of each, all side by side."""
        going = [search for search in searches if not search.done]
        if not going:
            return
        tries = [[self._step(search, search.damping * scale) for scale in DAMPINGS] for search in going]
        found = self._all([self.refit(s, u) for s, us in zip(going, tries, strict=True) for u in us])
        for n, (search, us) in enumerate(zip(going, tries, strict=True)):
            errors = found[n * len(us) : (n + 1) * len(us)]
            costs = [self._cost(search, u, e) for u, e in zip(us, errors, strict=True)]
            best, before = int(np.argmin(costs)), self._cost(search, search.u, search.errors)
            width = self._prior(search)[1]
            step = (us[best] - search.u) / width
            if step @ step > 0:
                surprise = errors[best] - search.errors - (us[best] - search.u) @ search.slopes
                search.slopes = search.slopes + np.outer(step / width / (step @ step), surprise)
            if costs[best] < before:
                search.done = before - costs[best] < ENOUGH * self._weights.sum()
                search.u, search.errors = us[best], errors[best]
                search.damping = max(search.damping * DAMPINGS[best] / 5, 1e-5)
            else:
                search.damping *= 100
                search.done = search.damping > 1e4

    def fit(self, sets: Sequence[tuple[tuple[Part, ...], Sequence[Mapping[str, float]]]]) -> list[_Search]:
        """Fit sets of causes anew, from these coordinates."""
        n = len(self.windows.names)
        searches = [
            _Search(parts, np.array([point[q.name] for part, point in zip(parts, x, strict=True) for q in part.definition.quantities] + [0.0] * n))
            for parts, x in sets
        ]  # fmt: skip
        self.settle(searches, ANEW)
        return searches

    def settle(self, searches: Sequence[_Search], times: int) -> None:
        """Fit on from where each of them is."""
        for search in searches:
            search.done = False
        for _ in range(times):
            going = [search for search in searches if not search.done]
            if going:
                self._differentiate(going)
            for _ in range(ROUNDS):
                self._improve(going)
        # Folds step from here without another look: what rank-one updates say would lead them astray.
        self._differentiate(searches)

    def without(self, search: _Search, removed: Sequence[Sequence[str]]) -> list[_Search]:
        """The same set without some of its causes, for each of `removed`, fitted on from where it ended."""
        out = [search.without(causes) for causes in removed]
        found = self._all([self.refit(one, one.u) for one in out])
        for one, errors in zip(out, found, strict=True):
            one.errors = errors
        for _ in range(ROUNDS + 1):
            self._improve(out)
        return out

    def judge(self, searches: Sequence[_Search], *, exact: bool = False) -> list[Tried]:
        """What each leaves on the folds; a fold's fit is a step from that of all runs, on the rows it may see."""
        fits = [[self._fold(search, fold) for fold in self.folds] for search in searches]
        n = len(searches)
        before, after, counts = np.zeros(len(self.folds)), np.zeros((n, len(self.folds))), np.zeros(len(self.folds))
        for k in sorted({k for fold in self.folds for k in fold.out}):
            mine = [f for f, fold in enumerate(self.folds) if k in fold.out]
            refits: list[Refit | None] = [None, *(fits[s][f] for s in range(n) for f in mine)]
            squares = np.square(self._errors(k, refits, exact=exact)).sum(axis=1)
            before[mine] += squares[0]
            after[:, mine] += squares[1:].reshape(n, len(mine))
            counts[mine] += np.isfinite(self.windows.measured[k]).sum()
        floor = float(np.sqrt(np.mean(self.windows.floor**2)))
        out = []
        for s, search in enumerate(searches):
            folds = {
                fold.name: _closed(_rms(before[f], counts[f]), _rms(after[s, f], counts[f]), floor)
                for f, fold in enumerate(self.folds)
            }
            whole = _rms(before.sum(), counts.sum()), _rms(after[s].sum(), counts.sum())
            out.append(Tried(self.refit(search, search.u), self._std(search), folds, _closed(*whole, floor), *whole))
        return out

    def by_signal(self, refit: Refit, part: Part, x: Mapping[str, float]) -> dict[str, float]:
        """What a cause beside a set closes of each other signal's gap, its size by the runs that a fold may see.

        Nothing where it moves the joints: there positions judge.
        """
        sized = []
        for size in SIZES:
            own = {q.name: x[q.name] * (1.0 if q.shape else size) for q in part.definition.quantities}
            sized.append(dataclasses.replace(refit, hypothesis=(*refit.hypothesis, part), x=(*refit.x, own)))
        runs = sorted({*self.training, *(k for fold in self.folds for k in fold.out)})
        left: dict[str, Array] = {}
        moved = gap = 0.0
        for n, k in enumerate(runs):
            seen = self.windows.protocol.runs[k].seen
            names = [name for name in seen if name != "torque"]  # its scale is not known: it would follow
            robots = [self.windows.robot(one, k) for one in sized]
            found = simulate(self._rollouts[k], robots, signals=names).signals
            moved += float(np.nansum(np.square(found["pos"][SIZES.index(1.0)] - found["pos"][0])))
            gap += float(np.nansum(np.square(seen["pos"] - found["pos"][:1])))
            for name in names:
                left.setdefault(name, np.zeros((len(runs), len(SIZES))))[n] = _squares(name, seen[name], found[name])
        if moved > STILL**2 * gap:
            return {}
        out = {}
        for name in left.keys() - {"pos"}:
            before = after = 0.0
            for fold in self.folds:
                outside = np.isin(runs, fold.out)
                size = int(np.argmin(left[name][~outside].sum(axis=0)))
                before, after = before + left[name][outside, 0].sum(), after + left[name][outside, size].sum()
            out[name] = 1 - float(np.sqrt(after / before)) if before > 0 else 0.0
        return out

    def _fold(self, search: _Search, fold: Fold) -> Refit:
        if not set(fold.out) & set(self.training):
            return self.refit(search, search.u)
        return self.refit(search, self._step(search, 0.0, ~np.isin(self._runs, fold.out)))

    def _std(self, search: _Search) -> Array:
        weight = np.sqrt(self._weights) / self._noise(search.errors)
        slopes = search.slopes * weight
        covariance = np.linalg.inv(slopes @ slopes.T + np.diag(1 / self._prior(search)[1] ** 2))
        out: Array = np.sqrt(np.diag(covariance))
        return out


@dataclass(frozen=True)
class Choice:
    """The set that explains most with least.

    Attributes:
        chosen: it. nothing: what tolerances do by themselves. alone: of each suspect.
        removal: cause → closure lost without it, the most first. rival: the best set without the first of them.
    """

    chosen: Tried
    nothing: Tried
    alone: Mapping[str, Tried]
    removal: Mapping[str, float]
    rival: Tried | None

    @property
    def open(self) -> bool:
        """Whether a set without the first cause explains as much."""
        return self.rival is not None and self.rival.closed > self.chosen.closed - APART


def choose(
    fits: SetFits,
    parts: Sequence[Part],
    starts: Sequence[Mapping[str, float]],
    probability: Mapping[str, float],
    witnessed: Container[str] = (),
) -> Choice:
    """Fit all suspects together and take away what can be spared.

    Args:
        parts: the suspects, each at its place. starts: coordinates from which each of them starts.
        probability: cause → the judge's.
        witnessed: causes that a signal of their own vouches for: positions must not gain by them, if they do not lose.
    """

    def value(tried: Tried) -> float:
        doubts = [max(0.0, float(np.log10(LIKELY_THERE / max(probability[name], 1e-4)))) for name in tried.names]
        costs = [
            -LOSES if name in witnessed else BRINGS + DOUBTED * doubt
            for name, doubt in zip(tried.names, doubts, strict=True)
        ]
        return tried.closed - sum(costs)

    singles = fits.fit([((), ()), *(((part,), (x,)) for part, x in zip(parts, starts, strict=True))])
    nothing, *alone = fits.judge(singles)
    # Together each has less to explain than alone.
    half = [
        {q.name: tried.refit.x[0][q.name] * (1.0 if q.shape else 0.5) for q in part.definition.quantities}
        for part, tried in zip(parts, alone, strict=True)
    ]
    (whole,) = fits.fit([(tuple(parts), half)])
    visited = [*zip(singles, [nothing, *alone], strict=True), *_fewer(fits, whole, value)]
    search, best = max(visited, key=lambda one: value(one[1]))
    removal: dict[str, float] = {}
    while best.names:
        fits.settle([search], SETTLED)
        (best,) = fits.judge([search])
        spared = _each_spared(fits, search)
        left = fits.judge(spared)
        lost = {name: best.closed - one.closed for name, one in zip(best.names, left, strict=True)}
        removal = dict(sorted(lost.items(), key=lambda item: -item[1]))
        fewer, without = max(zip(spared, left, strict=True), key=lambda one: value(one[1]))
        if value(without) < value(best):
            break
        # What a fit that had not settled seemed to need can be spared after all.
        search, best, removal = fewer, without, {}
    rival = None
    if removal:
        first = next(iter(removal))
        others = [one for one in visited if first not in one[1].names]
        other = max(others, key=lambda one: value(one[1]))[0]
        (rival,) = fits.judge(fits.fit([(other.parts, fits.refit(other, other.u).x)]))
    (chosen,) = fits.judge([search], exact=True)
    return Choice(chosen, nothing, dict(zip([part.cause for part in parts], alone, strict=True)), removal, rival)


def _each_spared(fits: SetFits, search: _Search) -> list[_Search]:
    return fits.without(search, [[part.cause] for part in search.parts])


def _fewer(fits: SetFits, search: _Search, value: Callable[[Tried], float]) -> list[tuple[_Search, Tried]]:
    """Sets on the way from all suspects to one: of those that can be spared half goes at a time, at least the least one."""
    (tried,) = fits.judge([search])
    out = [(search, tried)]
    while len(search.parts) > 1:
        spared = _each_spared(fits, search)
        found = sorted(zip(spared, fits.judge(spared), tried.names, strict=True), key=lambda one: -value(one[1]))
        out += [(one, left) for one, left, _ in found]
        needless = sum(value(left) >= value(tried) for _, left, _ in found)
        if needless < 4:
            search, tried, _ = found[0]
            continue
        (search,) = fits.without(search, [[cause for _, _, cause in found[: needless // 2]]])
        (tried,) = fits.judge([search])
        out.append((search, tried))
    return out


def _squares(name: str, seen: Floats, made: Floats) -> Array:
    """(robots,) summed squares of what was seen (1, rows, columns) minus what robots made of it."""
    if name == "volt":  # shares of a supply that is not known
        power = np.nansum(np.square(seen * np.isfinite(made)), axis=(1, 2))
        seen = seen * (np.nansum(seen * made, axis=(1, 2)) / np.maximum(power, 1e-12))[:, None, None]
    out: Array = np.nansum(np.square(seen - made, dtype=np.float64), axis=(1, 2))
    return out


def _rms(squares: float, count: float) -> float:
    return float(np.sqrt(squares / count))


def _closed(before: float, after: float, floor: float) -> float:
    share = share_closed(before, after, floor)
    return share if np.isfinite(share) else 0.0
