"""What speaks for each cause in a recording, as one row of numbers a cause that know neither its motion nor its model.

A recording's residual is whitened by what healthy robots do on it (tolerances, sensors, noise: `gap.whitening`). Against each
cause's templates (what it would do to this very recording) it gives matched-filter scores, what is left once the best cause is
taken out, the same by setup and signal, agreement of joints, the gain on folds that an amplitude fitted to the other folds
predicts, and how large the cause would be. The columns mean the same on a pendulum and on a walking robot, so that how they
weigh can be learned once, on other robots (`gap.classifier`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Reference
from openant_tools.gap.features import (
    ARRIVAL,
    COLUMNS,
    FLOOR_BLOCK_S,
    IMU_DELAY,
    LATENESS,
    ONE_JOINT_BLOCK_S,
    SKIP_S,
    STAND_BLOCK_S,
    Floats,
)
from openant_tools.gap.population import Case
from openant_tools.gap.templates import Template, Templates
from openant_tools.gap.whitening import Whitening, whiten

__all__ = ["COLUMN_NAMES", "Evidence", "Layouts", "RunLayout", "Scale", "anomalies", "evidence_of", "unknown_signals"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

SIGNALS = ("pos", "vel", "torque", "volt", *COLUMNS)
SETUPS = ("stand", "floor")
#: kinds of features that are no block means: signal → names
LOGS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(SIGNALS, ("size", "rough")),
    LATENESS: ("size", "peak"),
    ARRIVAL: ("size", "skew", "shared"),
    IMU_DELAY: ("lag", "loose", "worse"),
}
#: how often the best cause is taken out
PEELED = 2
#: s of a fold at most, and the fewest folds
FOLD_S, FOLDS = 2.5, 4
#: of logs: least spread of healthy robots, and deviations beyond which they say no more
LEAST_SPREAD, FARTHEST = 0.05, 8.0
#: share of a template's square in the training folds that keeps amplitudes from running away
RIDGE = 0.02
#: between which an amplitude is believed, in templates
AMPLITUDE = (0.0, 2.5)
#: causes that may explain a signal, and times the farthest healthy robot beyond which it is unknown
EXPLAINING, OUTSIDE_HEALTHY = 3, 1.3
#: of healthy robots that are within what most of them are off by
QUANTILE = 0.95
#: of what does not apply
ABSENT = -20.0


@dataclass(frozen=True)
class RunLayout:
    """What the features of one run are of.

    Attributes:
        setup: "stand" or "floor". seconds: of the run.
        groups: signal → the kind of each of its features, in order. joints: signal → the joint of each, −1 for none.
    """

    setup: str
    seconds: float
    groups: Mapping[str, Sequence[str]]
    joints: Mapping[str, Sequence[int]]


@dataclass(frozen=True)
class Layouts:
    """The features of all runs, side by side.

    Attributes:
        mean: whether a feature is a block mean. signal, kind: names. floor: whether its run stood on the floor. joint: −1 for none.
        time: s into its run. run: its number.
    """

    mean: Bools
    signal: NDArray[np.str_]
    kind: NDArray[np.str_]
    floor: Bools
    joint: Ints
    time: Array
    run: Ints

    @classmethod
    def of(cls, runs: Sequence[RunLayout], joints: int) -> Layouts:
        signal, kind, floor, joint, time, number = [], [], [], [], [], []
        for k, one in enumerate(runs):
            for name, kinds in one.groups.items():
                body = name in COLUMNS
                wide = one.setup == "floor" or body
                width = FLOOR_BLOCK_S if wide else ONE_JOINT_BLOCK_S if joints <= 2 else STAND_BLOCK_S
                columns = len(COLUMNS[name]) if body else joints
                n = len(kinds)
                signal += [name] * n
                kind += list(kinds)
                joint += list(one.joints[name])
                time += [SKIP_S + width * (i // columns + 0.5) for i in range(n)]
                floor += [one.setup == "floor"] * n
                number += [k] * n
        kinds_of = np.array(kind)
        return cls(
            kinds_of == "mean", np.array(signal), kinds_of, np.array(floor), np.array(joint), np.array(time), np.array(number)
        )  # fmt: skip

    def only(self, some: Bools) -> Layouts:
        """Those features; runs of which none is left do not count."""
        run = np.unique(self.run[some], return_inverse=True)[1]
        return Layouts(
            self.mean[some],
            self.signal[some],
            self.kind[some],
            self.floor[some],
            self.joint[some],
            self.time[some],
            run,
        )

    def folds(self) -> Ints:
        """(features,) the contiguous part of a run that each belongs to; at least FOLDS in all."""
        runs = range(int(self.run.max()) + 1)
        times = [self.time[self.run == k] for k in runs]
        begin = np.array([some.min(initial=np.inf) for some in times])
        length = np.array([some.max(initial=0.0) - some.min(initial=np.inf) for some in times]).clip(1e-6)
        parts = np.maximum(1, np.round(length / FOLD_S)).astype(int)
        while parts.sum() < FOLDS:
            parts[int(np.argmax(length / parts))] += 1
        first = np.concatenate([[0], np.cumsum(parts)[:-1]])
        inside = ((self.time - begin[self.run]) / length[self.run] * parts[self.run]).astype(np.int64)
        out: Ints = first[self.run] + np.minimum(inside, parts[self.run] - 1)
        return out


def _names() -> tuple[str, ...]:
    out = ["share", "score", "lead"]
    for k in range(PEELED):
        out += [f"share after {k + 1}", f"score after {k + 1}", f"left after {k + 1}"]
    for setup in SETUPS:
        for signal in SIGNALS:
            out += [f"{setup} {signal} share", f"{setup} {signal} size"]
    out += ["best joint", "second joint", "all joints"]
    out += ["gain", "gain share", "worst fold", "folds gained", "strength", "shows"]
    for signal, kinds in LOGS.items():
        for setup in SETUPS if signal in SIGNALS else ("",):
            for kind in kinds:
                out += [f"{setup} {signal} {kind} mean", f"{setup} {signal} {kind} most"]
    out += ["size", "features", "folds", "joints", "runs", "floor"]
    out += [f"has {signal}" for signal in SIGNALS]
    return tuple(out)


#: what the columns of a row are; after them the cause's number in the catalogue
COLUMN_NAMES = _names()


@dataclass(frozen=True)
class Evidence:
    """Rows of some robots.

    Attributes:
        causes: names, those that can show on this recording.
        rows: (robots, causes, columns), see COLUMN_NAMES; the last is the cause's number in the catalogue.
        size: (robots,) root mean square of the whitened residual: 1 where a robot differs as healthy ones do.
        places: (robots, causes) the template that fits best, an index into `bank`.
        amplitudes: (robots, causes) how many times that template; deviations: their standard deviations.
        bank: what templates are of.
    """

    causes: tuple[str, ...]
    rows: Floats
    size: Floats
    places: Ints
    amplitudes: Floats
    deviations: Floats
    bank: tuple[Template, ...]


@dataclass(frozen=True)
class Scale:
    """What evidence is measured by: healthy robots and templates of one recording, and which of its features are used.

    Attributes:
        layouts: of the features that are used. some: which those are, of all.
    """

    layouts: Layouts
    some: Bools
    whitening: Whitening
    templates: Templates
    centre: Array
    spread: Array
    joints: int
    runs: int

    @classmethod
    def of(
        cls,
        layouts: Layouts,
        known: Bools,
        healthy: Floats,
        templates: Floats,
        bank: Sequence[Case],
        reference: Reference,
    ) -> Scale:
        """
        Args:
            known: (features,) which of them are used. healthy: (robots, features). templates: (templates, features).
        """
        mine = layouts.only(known)
        h, t = healthy[:, known].astype(np.float32), templates[:, known].astype(np.float32)
        whitening = whiten(h[:, mine.mean], t[:, mine.mean], bank, reference)
        listed = [(name, at, x) for case in bank for name, (at, x) in case.causes.items()]
        found = Templates.of(listed, whitening.of_templates(t[:, mine.mean]), len(reference.torque))
        logs = h[:, ~mine.mean]
        return cls(
            mine, known, whitening, found, np.median(logs, axis=0), logs.std(axis=0) + LEAST_SPREAD,
            len(reference.torque), int(mine.run.max()) + 1,
        )  # fmt: skip

    def whitened(self, features: Floats) -> Floats:
        """(robots, means) of what was seen of robots (robots, features)."""
        return self.whitening(features[:, self.some][:, self.layouts.mean].astype(np.float32))

    def vectors(self, templates: Floats) -> Floats:
        """(templates, means) of robots without scatter, (templates, features)."""
        return self.whitening.of_templates(templates[:, self.some][:, self.layouts.mean].astype(np.float32))

    @cached_property
    def means(self) -> Layouts:
        return self.layouts.only(self.layouts.mean)

    @cached_property
    def others(self) -> Layouts:
        return self.layouts.only(~self.layouts.mean)


def evidence_of(scale: Scale, features: Floats) -> Evidence:
    """The rows of robots of whom features (robots, features) were seen."""
    x = features[:, scale.some].astype(np.float32)
    z, t = scale.whitened(features), scale.templates
    means, fit = scale.means, t.fits(z)
    n, root = len(x), float(np.sqrt(z.shape[1]))
    by = t.by_cause(fit)
    size = np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-6)

    def whole(values: Floats) -> Floats:
        """(robots, 1) as a column of all causes."""
        return np.broadcast_to(values, by.shape)

    columns = [by / size, np.arcsinh(by), np.arcsinh(by) - np.arcsinh(_best_other(by))]
    for score, left in t.peeled(z, PEELED):
        columns += [score / left, np.arcsinh(score), whole(np.log10(left / root))]
    for floor in (False, True):
        for signal in SIGNALS:
            mine = (means.signal == signal) & (means.floor == floor)
            if not mine.any():
                columns += [np.full(by.shape, ABSENT)] * 2
                continue
            own = np.linalg.norm(z[:, mine], axis=1, keepdims=True)
            score = t.by_cause(t.fits(z, mine))
            columns += [score / np.maximum(own, 1e-6), whole(np.log10(own / np.sqrt(mine.sum()) + 1e-3))]
    columns += _by_place(t, fit, size)
    best = np.stack([some[fit[:, some].argmax(axis=1)] for some in t.of_cause], axis=1)
    columns += _held_out(t, z, best, means.folds(), size)
    columns += _magnitude(t, fit, best)
    columns += [whole(column) for column in _logs(scale, x[:, ~scale.layouts.mean])]
    folds = float(means.folds().max() + 1)
    context = [np.log10(size / root)] + [
        np.full((n, 1), value, np.float32)
        for value in (
            np.log10(z.shape[1]),
            folds,
            scale.joints,
            scale.runs,
            float(means.floor.mean()),
            *(float((means.signal == signal).any()) for signal in SIGNALS),
        )
    ]
    columns += [whole(column) for column in context]
    names = sorted(catalogue())
    columns.append(np.broadcast_to(np.array([names.index(cause) for cause in t.causes], np.float32), by.shape))
    rows = np.nan_to_num(np.stack([np.asarray(one, np.float32) for one in columns], axis=2), nan=ABSENT)
    length = np.maximum(np.linalg.norm(t.vectors, axis=1), 1e-6)
    amplitudes = np.take_along_axis(fit, best, axis=1) / length[best]
    # What the best causes leave is as large as the noise that an amplitude is known by.
    deviations = np.maximum(size / root, 1.0) / length[best]
    return Evidence(t.causes, rows, (size[:, 0] / root).astype(np.float32), best, amplitudes, deviations, t.bank)


def anomalies(scale: Scale, healthy: Floats, features: Floats) -> dict[str, float]:
    """Signal → how far it is from the model's, as a factor of what most healthy robots (QUANTILE of them) are off by at most.

    Args:
        healthy: (robots, features) not those of the scale. features: (features,) of the robot at hand.
    """
    means = scale.means
    z = scale.whitened(np.vstack([healthy, features]))
    out = {}
    for signal in SIGNALS:
        size = np.linalg.norm(z[:, means.signal == signal], axis=1)
        usual = float(np.quantile(size[:-1], QUANTILE))
        if usual > 0:  # what no robot differs in says nothing
            out[signal] = float(size[-1]) / usual
    return out


def unknown_signals(scale: Scale, healthy: Floats, features: Floats) -> dict[str, float]:
    """Signals that behave as none that is known: signal → how far outside healthy robots', as a factor.

    Beyond what the likeliest causes do, a signal of a sensor stays outside everything that healthy robots with sensors of all
    forms show. What is known of it so is wrong, and it may lend no certainty to anything.

    Args:
        healthy: (robots, features) not those of the scale. features: (features,) of the robot at hand.
    """
    means, t = scale.means, scale.templates
    z = scale.whitened(np.vstack([healthy, features]))
    left = t.without_best(z[-1], EXPLAINING)
    out = {}
    for signal in SIGNALS[1:]:
        beyond = 0.0
        for floor in (False, True):
            mine = (means.signal == signal) & (means.floor == floor)
            usual = float(np.linalg.norm(z[:-1, mine], axis=1).max())
            if usual > 0:
                beyond = max(beyond, float(np.linalg.norm(left[mine])) / usual)
        if beyond > OUTSIDE_HEALTHY:
            out[signal] = beyond
    return out


def _best_other(by: Floats) -> Floats:
    """(robots, causes) the best score of any other cause."""
    if by.shape[1] == 1:
        return np.zeros_like(by)
    order = np.sort(by, axis=1)
    return np.where(by == order[:, -1:], order[:, -2:-1], order[:, -1:])


def _by_place(t: Templates, fit: Floats, size: Floats) -> list[Floats]:
    """Shares of the residual at the best joint by itself, the second, and at more joints at once; (robots, causes) each."""
    out = np.zeros((3, len(fit), len(t.causes)), np.float32)
    for c, some in enumerate(t.of_cause):
        places: dict[tuple[int, ...], list[int]] = {}
        for k in some:
            places.setdefault(t.bank[k][1], []).append(int(k))
        single = np.array([fit[:, ks].max(axis=1) for at, ks in places.items() if len(at) == 1])
        more = [fit[:, ks].max(axis=1) for at, ks in places.items() if len(at) > 1]
        if len(single):
            single = np.sort(single, axis=0)
            out[0, :, c] = single[-1]
            out[1, :, c] = single[-2] if len(single) > 1 else 0.0
        if more:
            out[2, :, c] = np.max(more, axis=0)
    return [one / size for one in out]


def _held_out(t: Templates, z: Floats, best: Ints, folds: Ints, size: Floats) -> list[Floats]:
    """What each cause's best template gains on folds when its amplitude is fitted to the others; (robots, causes) each.

    In halves of squared deviations, as logarithms of likelihoods are: the whole, as a share of the residual's, the worst fold's as
    a share of that fold's, and how many gain.
    """
    count = int(folds.max()) + 1
    vectors, n = t.vectors, len(z)
    along = np.stack([z[:, folds == f] @ vectors[:, folds == f].T for f in range(count)])
    square = np.stack([np.square(vectors[:, folds == f]).sum(axis=1) for f in range(count)])
    robots = np.arange(n)[:, None]
    a, s = along[:, robots, best], square[:, best]  # (folds, robots, causes)
    rest_a, rest_s = a.sum(axis=0) - a, s.sum(axis=0) - s
    amplitude = np.clip(rest_a / (rest_s + RIDGE * s.sum(axis=0) + 1e-9), *AMPLITUDE)
    gain = amplitude * a - 0.5 * amplitude**2 * s
    own = np.stack([0.5 * np.square(z[:, folds == f]).sum(axis=1) for f in range(count)])[:, :, None] + 1e-6
    whole = gain.sum(axis=0)
    # What a fold could show of it weighs it: where the motion never goes says nothing either way.
    share = s / (s.sum(axis=0) + 1e-9)
    return [
        np.arcsinh(whole), whole / (0.5 * size**2), (gain / own).min(axis=0), (share * (gain > 0)).sum(axis=0)
    ]  # fmt: skip


def _magnitude(t: Templates, fit: Floats, best: Ints) -> list[Floats]:
    """How large each cause would be, 0 just beyond tolerance and 1 clearly ill, and how far one of size 0 would show."""
    length = np.maximum(np.linalg.norm(t.vectors, axis=1), 1e-6)
    small, large = np.array([_sizes(one) for one in t.bank]).T  # of the template over `small`, `large` over `small`
    at = small[best] * np.take_along_axis(fit, best, axis=1) / length[best]
    strength = np.log(np.maximum(at, 1e-3)) / np.log(large[best])
    return [strength, np.log10(length[best] / small[best] + 1e-6)]


def _sizes(template: Template) -> tuple[float, float]:
    name, _, x = template
    main = max((q for q in catalogue()[name].quantities if not q.shape), key=lambda q: abs(x[q.name]) / q.small)
    return max(abs(x[main.name]) / main.small, 1e-3), main.large / main.small


def _logs(scale: Scale, x: Floats) -> list[Floats]:
    """(robots, 1) means and largest of how logs deviate from healthy robots'."""
    of = scale.others
    d = ((x - scale.centre) / scale.spread).clip(-FARTHEST, FARTHEST)
    out = []
    for signal, kinds in LOGS.items():
        for floor in (False, True) if signal in SIGNALS else (None,):
            for kind in kinds:
                mine = (of.signal == signal) & (of.kind == kind)
                if floor is not None:
                    mine &= of.floor == floor
                if mine.any():
                    out += [d[:, mine].mean(axis=1, keepdims=True), d[:, mine].max(axis=1, keepdims=True)]
                else:
                    out += [np.full((len(x), 1), ABSENT)] * 2
    return out
