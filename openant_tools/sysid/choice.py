"""What of a fit is kept: chosen by folds within the fitted runs, by motion and by gain, and never by what judges it.

A fold leaves some runs out; the fit to the others says what they would have done. A kind of parameter goes back to the given
model where that follows them better. What such a choice is worth only runs can tell that had no part in it: those that were
held out, or the fitted ones left out in turn, if the choice is made anew without each (nested).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from openant_tools.model.gap import Gap
from openant_tools.recording.run import Run
from openant_tools.sysid.dataset import Dataset, gaps, runs_of
from openant_tools.sysid.estimate import Estimate, Posterior
from openant_tools.sysid.intervals import TWO_SIDED_95
from openant_tools.sysid.parameter import Parameter
from openant_tools.sysid.problem import Problem
from openant_tools.sysid.verdict import undetermined

__all__ = [
    "Choice",
    "Fold",
    "Settled",
    "by_gain",
    "by_motion",
    "choose",
    "helps",
    "lacking",
    "pays",
    "pooled",
    "settle",
]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Progress = Callable[[float, str], None]
#: asks for what options of kept parameters leave, is answered with that of each fold, ends with a choice
Choosing = Generator["_Ask", Sequence[Sequence["_Left"]], "Choice"]

#: what is chosen must pay this much on what was left out (relative, over both horizons)
WORTH = 0.01
#: and going back with this probability
CERTAIN = 0.95
#: motions are left out in so many folds at most
MOST_FOLDS = 4
#: s; of a single motion so long parts are left out, up to THRICE from place to place of one run
PART_S, THRICE = 2.0, 3


@dataclass(frozen=True)
class Fold:
    """What is left out together: of each run itself, or a part of it."""

    pieces: tuple[tuple[Run, Run], ...]

    @property
    def runs(self) -> list[Run]:
        """As they are simulated."""
        return [part for _, part in self.pieces]

    def rows(self, datasets: Sequence[Dataset]) -> Bools:
        """(rows,) of all datasets, one after another: which are left out."""
        out = np.zeros(sum(len(data.measured) for data in datasets), bool)
        for _, run, rows in runs_of(datasets):
            for whole, part in self.pieces:
                if whole is run:
                    out[rows] |= (run.t >= part.t[0]) & (run.t <= part.t[-1])
        return out


def by_motion(runs: Sequence[Run], joints: Sequence[str]) -> list[Fold]:
    """Each motion with its repeats, or where there are many a share of them; a single motion is cut, and loses a third at a time."""
    motion = [run.facts.repeat_of or run.name for run in runs]
    motions = list(dict.fromkeys(motion))
    if len(motions) == 1:
        return _cut(runs, joints)
    folds = min(MOST_FOLDS, len(motions))
    return [
        Fold(tuple((run, run) for run, name in zip(runs, motion, strict=True) if motions.index(name) % folds == k))
        for k in range(folds)
    ]


def _cut(runs: Sequence[Run], joints: Sequence[str]) -> list[Fold]:
    folds: list[list[tuple[Run, Run]]] = [[], [], []]
    for run in runs:
        # A long run goes from one motion to another: each fold has of all.
        parts = 3 * max(1, min(THRICE, int(run.duration_s / (3 * PART_S))))
        edges = np.linspace(run.t[0], run.t[-1] + 1e-9, parts + 1)
        for k in range(parts):
            part = replace(run.between(edges[k], edges[k + 1]), name=f"{run.name}[{k + 1}/{parts}]")
            if np.isfinite(part.signal("pos", joints)).all(axis=1).sum() > 1:
                folds[k % 3].append((run, part))
    return [Fold(tuple(pieces)) for pieces in folds if pieces]


def by_gain(runs: Sequence[Run], model_of: Callable[[Run], Path]) -> list[Fold]:
    """The runs of each model, where there are several."""
    groups: dict[Path, list[tuple[Run, Run]]] = {}
    for run in runs:
        groups.setdefault(model_of(run), []).append((run, run))
    return [Fold(tuple(pieces)) for pieces in groups.values()] if len(groups) > 1 else []


def _folds(motions: Sequence[Fold], gains: Sequence[Fold], without: Fold | None, joints: Sequence[str]) -> list[Fold]:
    """By which is chosen what is kept, of a fit without some runs."""
    if without is None:
        return [*motions, *gains]
    rest = [fold for fold in motions if fold is not without]
    left = [piece for fold in rest for piece in fold.pieces]
    if len(rest) == 1 and all(whole is part for whole, part in left):
        rest = _cut([run for run, _ in left], joints)
    members = [{id(run) for run, _ in gain.pieces} for gain in gains]
    split = [Fold(tuple(piece for piece in left if id(piece[0]) in ids)) for ids in members]
    return [*rest, *(gain for gain in split if 0 < len(gain.pieces) < len(left))]


@dataclass(frozen=True)
class _Trial:
    """A fit without a fold, the rows that it has not seen, and the fold's runs."""

    posterior: Posterior
    gone: Bools
    unseen: Sequence[Dataset]


@dataclass(frozen=True)
class _Ask:
    """For what is left with each option of kept parameters; `fitted`: with the kept ones fitted anew, else to first order."""

    options: Sequence[Bools]
    fitted: bool = False


@dataclass(frozen=True)
class _Left:
    """What is left of a fold, and how many positions it has."""

    gap: Gap
    samples: int


@dataclass(frozen=True)
class Choice:
    """Which parameters keep what was found, and what the given model and this choice leave of each fold."""

    kept: Bools
    given: tuple[_Left, ...]
    left: tuple[_Left, ...]

    @property
    def before(self) -> Gap:
        """Of all folds, of the given model."""
        return pooled([one.gap for one in self.given], [one.samples for one in self.given])

    @property
    def after(self) -> Gap:
        return pooled([one.gap for one in self.left], [one.samples for one in self.left])


@dataclass(frozen=True)
class Settled:
    """A fit to all runs, or without some, and what was chosen of it.

    Attributes:
        choice: by folds within its runs.
        u: (parameters,) of the model that this gives.
        unseen: the runs without which all of it was found; none where it was all.
    """

    choice: Choice
    u: Array
    unseen: Sequence[Dataset]

    @property
    def samples(self) -> int:
        return _samples(self.unseen)


def settle(
    problem: Problem,
    estimate: Estimate,
    motions: Sequence[Fold],
    gains: Sequence[Fold],
    turns: Sequence[Fold],
    prepare: Callable[[Sequence[Run]], list[Dataset]],
    progress: Progress | None = None,
) -> list[Settled]:
    """What is kept of a fit, and then of fits without each of `turns`, chosen anew without it.

    Args:
        problem, estimate: the fit to all runs.
        motions, gains: the folds.
        turns: those of `motions` that are left out to be judged by.
        prepare: runs → datasets as the problem's.
        progress: called with what is being done and the share that is done.
    """
    datasets, parameters = problem.datasets, problem.parameters
    joints = datasets[0].plant.joints
    measured = np.isfinite(np.concatenate([data.measured for data in datasets])).any(axis=1)
    masks: dict[bytes, Bools] = {}
    sets: list[list[tuple[Fold, Bools]]] = []
    nothing = np.zeros(len(measured), bool)
    for turn in (None, *turns):
        gone = nothing if turn is None else turn.rows(datasets)
        each = [(fold, gone | fold.rows(datasets)) for fold in _folds(motions, gains, turn, joints)]
        sets.append([(fold, mask) for fold, mask in each if (measured & ~mask).any()])
        masks |= {mask.tobytes(): mask for mask in (gone, *(mask for _, mask in sets[-1]))}
    del masks[nothing.tobytes()]
    found = problem.solve_without(
        list(masks.values()), estimate.found, progress=progress and (lambda done, what: progress(done / 2, what))
    )
    without: dict[bytes, Posterior] = dict(zip(masks, found, strict=True))
    unseen = {id(fold): prepare(fold.runs) for each in sets for fold, _ in each}
    fits = [estimate, *(without[turn.rows(datasets).tobytes()] for turn in turns)]
    trials = [
        [
            _Trial(one, nothing if turn is None else turn.rows(datasets), ()),
            *(_Trial(without[mask.tobytes()], mask, unseen[id(fold)]) for fold, mask in each),
        ]
        for one, turn, each in zip(fits, (None, *turns), sets, strict=True)
    ]

    def refit(asked: Sequence[tuple[_Trial, Bools]]) -> list[_Trial]:
        """Those kept from where they are likeliest while the others are as given."""
        ends = problem.solve_without(
            [trial.gone for trial, _ in asked],
            estimate.found,
            [trial.posterior.with_given(~kept) for trial, kept in asked],
            [~kept for _, kept in asked],
        )
        return [replace(trial, posterior=end) for (trial, _), end in zip(asked, ends, strict=True)]

    choices = choose(trials, parameters, refit, progress and (lambda done, what: progress((1 + done) / 2, what)))
    shown = [list[Dataset](), *(unseen[id(turn)] for turn in turns)]
    return [
        Settled(choice, _at(posterior, choice.kept), runs)
        for (choice, posterior), runs in zip(choices, shown, strict=True)
    ]


def _at(posterior: Posterior, kept: Bools) -> Array:
    """u with those kept that the data tell, and at their priors those of which they say nothing."""
    return np.where(kept & undetermined(posterior), posterior.centre, posterior.with_given(~kept))


def _shown(fit: Posterior, trial: Posterior, kept: Bools) -> Array:
    """u by which a fold is followed.

    A fit without the fold is no judge of what only the fold tells: the stiffness of a gain that it has not seen, whose the
    damping is where no other run falls. There the fit to all counts.
    """
    return np.where(undetermined(trial) & ~undetermined(fit), _at(fit, kept), _at(trial, kept))


def lacking(fit: Posterior) -> Bools:
    """(parameters,) of what the given model lacks, those that the data cannot tell from none, the others given: a delay of a few
    milliseconds that a slow motion neither shows nor excludes is a guess, and none is the safer one."""
    out = np.zeros(len(fit.u), bool)
    fit = replace(fit, covariance=fit.narrow)
    while True:
        u, precision = fit.with_given(out), np.linalg.inv(fit.covariance)[np.ix_(~out, ~out)]
        clear = np.full(len(u), math.inf)
        clear[~out] = u[~out] / np.sqrt(np.diag(np.linalg.inv(precision)))
        unclear = (fit.low == 0) & (fit.centre == 0) & (u > 0) & (clear < TWO_SIDED_95)
        if not unclear.any():
            return out
        out[np.argmin(np.where(unclear, clear, math.inf))] = True


def choose(
    trials: Sequence[Sequence[_Trial]],
    parameters: Sequence[Parameter],
    refit: Callable[[Sequence[tuple[_Trial, Bools]]], list[_Trial]],
    progress: Progress | None = None,
) -> list[tuple[Choice, Posterior]]:
    """Which parameters keep their estimates, and where those of the fit are then; all fits side by side.

    Args:
        trials: for each fit the fit itself, and then those without a fold of its runs.
        refit: trials and what each keeps → the same with that fitted anew, and the rest as given.
    """
    choosing = [_choose(parameters, lacking(each[0].posterior)) for each in trials]
    now = {k: list(each) for k, each in enumerate(trials)}
    tried: dict[int, tuple[Bools, list[_Trial]]] = {}
    ended: dict[int, tuple[Choice, Posterior]] = {}
    answers: dict[int, Sequence[Sequence[_Left]] | None] = dict.fromkeys(range(len(trials)))
    told = 0.0
    while answers:
        if progress:
            progress(told, "choosing what is kept")
        told += (1.0 - told) / 3  # how many rounds there are nobody knows beforehand
        asked: dict[int, _Ask] = {}
        for k, answer in answers.items():
            kept, there = tried.pop(k, (None, now[k]))
            try:
                asked[k] = next(choosing[k]) if answer is None else choosing[k].send(answer)
                now[k] = there
            except StopIteration as end:
                choice: Choice = end.value
                taken = there if kept is not None and np.array_equal(kept, choice.kept) else now[k]
                ended[k] = choice, taken[0].posterior
        places = [(k, trial, ask.options[0]) for k, ask in asked.items() if ask.fitted for trial in now[k]]
        anew = iter(refit([(trial, kept) for _, trial, kept in places]) if places else ())
        for k, ask in asked.items():
            if ask.fitted:
                tried[k] = ask.options[0], [next(anew) for _ in now[k]]
        shown = {k: tried[k][1] if k in tried else now[k] for k in asked}
        answers = {**_left(shown, parameters, {k: ask.options for k, ask in asked.items()})}
    return [ended[k] for k in range(len(trials))]


def _choose(parameters: Sequence[Parameter], unclear: Bools) -> Choosing:
    """The rule of formats, section 6.

    Starting from all but what is `lacking`, the kind, the joint or the whole whose return to the given model helps most on what was
    left out goes back, as long as that is more than chance; and on, while what is left follows none of it better than the given
    model. What stays needs no second proof: its prior has shrunk it as far as the data are weak, and a fit to half of the motions
    that fails at the other half speaks against the half. Which one it is is seen to first order, whether it helps with the rest
    fitted anew.
    """
    kept = ~unclear
    before, after = yield _Ask([np.zeros_like(kept), kept])
    if unclear.any():
        (after,) = yield _Ask([kept], fitted=True)
    while kept.any():
        somewhere = max(_gains(after, before, before), default=math.inf) > WORTH
        # Where physics knows better than the given model, its value is no safer one.
        kinds = dict.fromkeys(p.kind for p in parameters if p.centre == 0)
        groups = [np.array([p.kind == kind for p in parameters]) for kind in kinds]
        groups += [
            np.array([p.label == label for p in parameters]) for label in dict.fromkeys(p.label for p in parameters)
        ]
        options = [kept & ~group for group in (*groups, kept) if (kept & group).any()]
        gains = [_gains(one, after, before) for one in (yield _Ask(options))]
        best = int(np.argmax([_mean(each) for each in gains]))
        if somewhere and not helps(gains[best]):
            break
        (there,) = (yield _Ask([options[best]], fitted=True)) if options[best].any() else [before]
        if somewhere and not helps(_gains(there, after, before)):
            break
        kept, after = options[best], there
    return Choice(kept, tuple(before), tuple(after))


def _gains(one: Sequence[_Left], other: Sequence[_Left], before: Sequence[_Left]) -> list[float]:
    """By how much one choice follows each fold better than another."""
    return [_score(b.gap, given.gap) - _score(a.gap, given.gap) for a, b, given in zip(one, other, before, strict=True)]


def helps(gains: Sequence[float]) -> bool:
    """Whether what was left out is followed better: by what is worth it, and by more than the folds differ (Student). What helps on
    one motion and hardly on another is luck, and two or three motions have much of it."""
    n = len(gains)
    error = float(np.std(gains, ddof=1)) / math.sqrt(n) if n > 1 else 0.0
    return _mean(gains) > max(WORTH, float(stdtrit(max(1, n - 1), CERTAIN)) * error)


def _mean(gains: Sequence[float]) -> float:
    return float(np.mean(gains)) if gains else 0.0


def _score(figure: Gap, before: Gap) -> float:
    """Mean log ratio to the given model over both horizons; a horizon that is worse than given counts thrice."""
    ratios = np.log([figure.horizon / before.horizon, figure.full / before.full])
    return float(np.mean(np.where(ratios > 0, 3 * ratios, ratios)))


def pays(one: Choice, other: Choice, *, surely: bool = False) -> bool:
    """Whether one way to fit follows what was left out better than another; `surely`: by more than chance."""
    gains = _gains(one.left, other.left, other.given)
    return helps(gains) if surely else _mean(gains) > WORTH


def pooled(figures: Sequence[Gap], samples: Sequence[int]) -> Gap:
    """The gap over all samples together."""
    if not figures:
        return Gap(math.nan, math.nan)
    squares = np.average([[one.horizon**2, one.full**2] for one in figures], axis=0, weights=samples)
    return Gap(*np.sqrt(squares).tolist())


def _samples(datasets: Sequence[Dataset]) -> int:
    return sum(int(np.isfinite(data.measured).sum()) for data in datasets)


def _left(
    trials: Mapping[int, Sequence[_Trial]], parameters: Sequence[Parameter], asked: Mapping[int, Sequence[Bools]]
) -> dict[int, list[list[_Left]]]:
    """For each fit and option of kept parameters what is left of each fold.

    What different fits would have done on the same fold is simulated together.
    """
    shown: dict[int, list[tuple[int, int]]] = {}
    for k in asked:
        for t, trial in enumerate(trials[k][1:], 1):
            shown.setdefault(id(trial.unseen), []).append((k, t))
    found: dict[tuple[int, int], list[Gap]] = {}
    for places in shown.values():
        us = [_shown(trials[k][0].posterior, trials[k][t].posterior, kept) for k, t in places for kept in asked[k]]
        first_k, first_t = places[0]
        figures = gaps(trials[first_k][first_t].unseen, parameters, us)
        for k, t in places:
            found[k, t], figures = figures[: len(asked[k])], figures[len(asked[k]) :]
    counts = {k: [_samples(trial.unseen) for trial in trials[k][1:]] for k in asked}
    return {
        k: [[_Left(found[k, t][o], n) for t, n in enumerate(counts[k], 1)] for o in range(len(options))]
        for k, options in asked.items()
    }
