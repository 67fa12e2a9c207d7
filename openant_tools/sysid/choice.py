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
from openant_tools.sysid.parameter import Parameter
from openant_tools.sysid.problem import Problem
from openant_tools.sysid.verdict import undetermined

__all__ = ["Choice", "Fold", "Settled", "by_gain", "by_motion", "choose", "pays", "pooled", "settle"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Progress = Callable[[str, float], None]
#: asks for what options of kept parameters leave, is answered with that over all folds and over each, ends with a choice
Choosing = Generator["_Ask", Sequence[Sequence[Gap]], "Choice"]

#: going back must pay this much on what was left out (relative, over both horizons): less is luck
WORTH = 0.01
#: and, of two or three folds, must pay with this probability
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
class Choice:
    """Which parameters keep what was found, and what the given model and this choice leave of all folds."""

    kept: Bools
    before: Gap
    after: Gap


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
        list(masks.values()), estimate.found, progress=progress and (lambda what, done: progress(what, done / 2))
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

    choices = choose(trials, parameters, refit, progress and (lambda what, done: progress(what, (1 + done) / 2)))
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
    choosing = [_choose(parameters, len(each) - 1) for each in trials]
    now = {k: list(each) for k, each in enumerate(trials)}
    tried: dict[int, tuple[Bools, list[_Trial]]] = {}
    ended: dict[int, tuple[Choice, Posterior]] = {}
    answers: dict[int, Sequence[Sequence[Gap]] | None] = dict.fromkeys(range(len(trials)))
    told = 0.0
    while answers:
        if progress:
            progress("choosing what is kept", told)
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


def _choose(parameters: Sequence[Parameter], folds: int) -> Choosing:
    """The rule of formats, section 6.

    Starting from all, the kind or joint whose return to the given model helps most on what was left out goes back, as long as
    one does, by more than chance; and on, while what is left does not beat the given model at both horizons. Which one it is is
    seen to first order, whether it helps with the rest fitted anew.
    """
    kept = np.ones(len(parameters), bool)
    before, after = yield _Ask([~kept, kept])
    while folds and kept.any():
        # What is kept must pay too. Where physics knows better than the given model, its value is no safer one.
        short, full, gain = after[0].horizon, after[0].full, _score(after[0], before[0])
        beats = short < before[0].horizon and full < before[0].full and gain < -WORTH
        groups = [
            np.array([bool(kept[k]) and p.kind == kind for k, p in enumerate(parameters)])
            for kind in dict.fromkeys(p.kind for p in parameters if not beats or p.centre == 0)
        ]
        labels = list(dict.fromkeys(p.label for p in parameters))
        if len(labels) > 1:
            groups += [
                np.array([bool(kept[k]) and p.label == label for k, p in enumerate(parameters)]) for label in labels
            ]

        def better(one: Sequence[Gap], other: Sequence[Gap] = after, gain: float = gain) -> bool:
            # What helps on one motion and hardly on another is luck, and two or three motions have much of it.
            return _score(one[0], before[0]) <= gain - WORTH and _helps(one, other, before)

        options = [kept & ~group for group in groups if group.any()]
        results = (yield _Ask(options)) if options else []
        found = [(option, one) for option, one in zip(options, results, strict=True) if not beats or better(one)]
        if not found:
            break
        option, _ = min(found, key=lambda each: _score(each[1][0], before[0]))
        (there,) = (yield _Ask([option], fitted=True)) if option.any() else [before]
        if beats and not better(there):
            break
        kept, after = option, there
    return Choice(kept, before[0], after[0])


def _helps(one: Sequence[Gap], other: Sequence[Gap], before: Sequence[Gap]) -> bool:
    """Whether one choice of parameters follows what was left out better than another, where folds are few by more than they
    differ (Student)."""
    gains = [_score(b, given) - _score(a, given) for a, b, given in zip(one[1:], other[1:], before[1:], strict=True)]
    n = len(gains)
    if not 1 < n < MOST_FOLDS:
        return True
    error = float(np.std(gains, ddof=1)) / math.sqrt(n)
    return float(np.mean(gains)) > float(stdtrit(n - 1, CERTAIN)) * error


def _score(figure: Gap, before: Gap) -> float:
    """Mean log ratio to the given model over both horizons; a horizon that is worse than given counts thrice."""
    ratios = np.log([figure.horizon / before.horizon, figure.full / before.full])
    return float(np.mean(np.where(ratios > 0, 3 * ratios, ratios)))


def pays(one: Gap, other: Gap) -> bool:
    """Whether one way to fit follows what was left out better than another: at both horizons, and by more than luck at one."""
    short, full = one.horizon / other.horizon, one.full / other.full
    return max(short, full) < 1.0 and min(short, full) < 1.0 - WORTH


def pooled(figures: Sequence[Gap], samples: Sequence[int]) -> Gap:
    """The gap over all samples together."""
    squares = np.average([[one.horizon**2, one.full**2] for one in figures], axis=0, weights=samples)
    return Gap(*np.sqrt(squares).tolist())


def _samples(datasets: Sequence[Dataset]) -> int:
    return sum(int(np.isfinite(data.measured).sum()) for data in datasets)


def _left(
    trials: Mapping[int, Sequence[_Trial]], parameters: Sequence[Parameter], asked: Mapping[int, Sequence[Bools]]
) -> dict[int, list[list[Gap]]]:
    """For each fit and option of kept parameters the gap over all folds, and then over each.

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
    out = {}
    for k, options in asked.items():
        counts = [_samples(trial.unseen) for trial in trials[k][1:]]
        each = [[found[k, t][o] for t in range(1, 1 + len(counts))] for o in range(len(options))]
        out[k] = [[pooled(one, counts), *one] if one else [Gap(math.nan, math.nan)] for one in each]
    return out
