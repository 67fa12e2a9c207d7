"""Teach how evidence weighs on shards, and say how well it does on experiments that it has not seen.

    python -m benchmarks.gap_training.train FOLDER… [--out openant_tools/gap] [--rows tests/gap/rows.npz]

Every experiment is described with the sensors that its log had, with fewer, and by some of its runs alone. Then once more for some causes as if no
catalogue had them: that is what an outsider looks like. First the classifier learns; then, on judgements of experiments that it had
not seen, the weights of the posterior. Figures are of folds over experiments. With --rows the last experiments that have a current
(KEPT_OUT of them) teach nothing: rows of their robots, with that column and without, are kept for a test that it never hurts.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import joblib
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from sklearn.ensemble import HistGradientBoostingClassifier

from benchmarks.gap_training.rows import Shard, read_shard
from openant_tools.arrays import write_arrays
from openant_tools.effects.catalogue import catalogue
from openant_tools.files import json_text, write_text
from openant_tools.gap.classifier import LEAF, Classifier
from openant_tools.gap.population import Case
from openant_tools.gap.posterior import NONE, OUTSIDE, WEIGHTS, features_of, log_posterior

Bools = NDArray[np.bool_]
Floats = NDArray[np.float32]

TREES, LEAVES, RATE = 300, 24, 0.06
#: what a robot counts that was looked at as a diagnosis does
REFINED = 10.0
#: causes of an experiment that are left out in turn, and how large one has to be to be looked for (0 just beyond tolerance, 1 clearly ill)
LEFT_OUT, LOOKED_FOR = 6, 0.25
#: descriptions of an experiment of several runs by some of them
SHORTER = 2
#: experiments of which rows are kept for a test, and which teach nothing; robots of each
KEPT_OUT, HEALTHY_KEPT, ILL_KEPT = 3, 10, 20
#: weights this large cost as much as one robot's surprise
FAR = 3.0


@dataclass(frozen=True)
class Described:
    """Robots of one experiment with some of its sensors.

    Attributes:
        rows: (robots, causes, columns). true: (robots, causes). count: (robots,) causes that a robot has.
        outside: its cause is none of these. refined: as a diagnosis looks at them.
    """

    rows: NDArray[np.float16]
    true: Bools
    count: NDArray[np.int64]
    outside: bool = False
    refined: bool = False


def described(folder: Path, seed: int) -> list[Described]:
    """Of one experiment: as it was recorded, with fewer sensors, and without some causes."""
    shard, rng = read_shard(folder, seed), np.random.default_rng((9, seed))
    out = []
    several = len(np.unique(shard.layouts.run)) > 1
    shorter = [shard.shorter(rng) for _ in range(SHORTER if several else 0)]
    for known in (shard.known, shard.lacking(rng), *shorter):
        found = shard.evidence(known)
        true = np.array([[cause in case.causes for cause in found.causes] for case in shard.learned])
        out.append(
            Described(found.rows.astype(np.float16), true, np.array([len(case.causes) for case in shard.learned]))
        )
    return out + _outsiders(shard, rng) + _refined(shard, rng)


def _refined(shard: Shard, rng: np.random.Generator) -> list[Described]:
    """Robots looked at as a diagnosis does: templates of their likeliest causes made anew; some as if no catalogue had their cause."""
    out = []
    for robot in shard.refined:
        case = shard.learned[robot]
        looks: list[tuple[Bools, str | None]] = [(shard.known, None), (shard.lacking(rng), None)]
        if len(case.causes) == 1 and _strength(case) > LOOKED_FOR:
            looks.append((shard.known, next(iter(case.causes))))
        for known, without in looks:
            found = shard.evidence_refined(known, robot, without)
            true = np.array([[cause in case.causes and without is None for cause in found.causes]])
            count, outside = np.array([len(case.causes)]), without is not None
            out.append(Described(found.rows.astype(np.float16), true, count, outside, refined=True))
    return out


def _outsiders(shard: Shard, rng: np.random.Generator) -> list[Described]:
    ill: dict[str, list[int]] = {}
    for n, case in enumerate(shard.learned):
        if len(case.causes) == 1 and _strength(case) > LOOKED_FOR:
            ill.setdefault(next(iter(case.causes)), []).append(n)
    out = []
    for cause in rng.permutation(sorted(ill))[:LEFT_OUT]:
        found = shard.evidence(shard.known, str(cause), np.array(ill[cause]))
        n = len(ill[cause])
        out.append(
            Described(
                found.rows.astype(np.float16), np.zeros((n, len(found.causes)), bool), np.ones(n, int), outside=True
            )
        )
    return out


def _strength(case: Case) -> float:
    ((name, (_at, x)),) = case.causes.items()
    sizes = [q for q in catalogue()[name].quantities if not q.shape]
    return max(float(np.log(max(abs(x[q.name]) / q.small, 1e-6)) / np.log(q.large / q.small)) for q in sizes)


def with_and_without(shard: Shard, signal: str) -> dict[str, NDArray[np.generic]]:
    """Rows of an experiment's robots, with a signal and without it."""
    less = shard.known & (shard.layouts.signal != signal)
    both = [shard.evidence(known) for known in (shard.known, less)]
    (causes,) = {found.causes for found in both}
    count = np.array([len(case.causes) for case in shard.learned])
    some = np.sort(np.concatenate([np.flatnonzero(count == 0)[:HEALTHY_KEPT], np.flatnonzero(count > 0)[:ILL_KEPT]]))
    return {
        "with": both[0].rows[some].astype(np.float16),
        "without": both[1].rows[some].astype(np.float16),
        "true": np.array([[cause in case.causes for cause in causes] for case in shard.learned])[some],
        "count": count[some],
    }


def taught(parts: Sequence[Described], trees: int = TREES) -> Classifier:
    """The classifier that these robots teach; outsiders teach the posterior alone."""
    mine = [part for part in parts if not part.outside]
    x = np.concatenate([part.rows.reshape(-1, part.rows.shape[2]) for part in mine]).astype(np.float32)
    y = np.concatenate([part.true.ravel() for part in mine])
    weight = np.concatenate([np.full(part.true.size, REFINED if part.refined else 1.0) for part in mine])
    model = HistGradientBoostingClassifier(
        max_iter=trees,
        learning_rate=RATE,
        max_leaf_nodes=LEAVES,
        min_samples_leaf=60,
        l2_regularization=3.0,
        max_features=0.5,
        early_stopping=False,
        random_state=0,
    )
    return exported(model.fit(x, y, weight))


def exported(model: HistGradientBoostingClassifier) -> Classifier:
    """The same trees as plain arrays."""
    root, parts, at = [], [], 0
    for (predictor,) in model._predictors:
        nodes = predictor.nodes
        root.append(at)
        column = np.where(nodes["is_leaf"], LEAF, nodes["feature_idx"])
        left, right = nodes["left"].astype(int) + at, nodes["right"].astype(int) + at
        parts.append((column, nodes["num_threshold"], left, right, nodes["value"]))
        at += len(nodes)
    column, threshold, left, right, value = (np.concatenate(some) for some in zip(*parts, strict=True))
    return Classifier(
        float(model._baseline_prediction.ravel()[0]),
        np.array(root, np.int32),
        column.astype(np.int16),
        threshold.astype(np.float32),
        left.astype(np.int32),
        right.astype(np.int32),
        value.astype(np.float32),
    )


def weighed(parts: Sequence[Described], odds: Sequence[Floats]) -> dict[str, float]:
    """The weights of the posterior under which these robots, whom the classifier had not seen, surprise least."""
    x = [features_of(part.rows.astype(np.float32), z) for part, z in zip(parts, odds, strict=True)]
    right = [_right(part) for part in parts]
    # As many robots count as outsiders as have nothing, and half of all have causes.
    kinds = [np.where(part.outside, 2, np.minimum(part.count, 1)) for part in parts]
    weight = [REFINED if part.refined else 1.0 for part in parts]
    of = np.sum([w * np.bincount(kind, minlength=3) for w, kind in zip(weight, kinds, strict=True)], axis=0)
    share = np.array([0.25, 0.5, 0.25]) / np.maximum(of, 1)

    def surprise(w: NDArray[np.float64]) -> float:
        named, total = dict(zip(WEIGHTS, w, strict=True)), 0.0
        for features, truth, kind, counts in zip(x, right, kinds, weight, strict=True):
            p = log_posterior(features, named)
            total -= counts * float((share[kind] * np.logaddexp.reduce(np.where(truth, p, -np.inf), axis=1)).sum())
        return total + float(np.square(w / FAR).sum() / of.sum())

    start = np.array([{"odds": 1.0, "none: odds": 0.0}.get(name, 0.0) for name in WEIGHTS])
    return dict(zip(WEIGHTS, minimize(surprise, start, method="L-BFGS-B").x.tolist(), strict=True))


def _right(part: Described) -> Bools:
    """(robots, 2 + causes) what is right to say."""
    out = np.zeros((len(part.true), 2 + part.true.shape[1]), bool)
    out[:, 2:] = part.true
    out[:, NONE] = part.count == 0
    out[:, OUTSIDE] = part.outside
    # What these sensors cannot show of a robot's only cause is no outsider, and nothing to be found.
    out[~out.any(axis=1), NONE] = True
    return out


def figures(parts: Sequence[Described], odds: Sequence[Floats], weights: dict[str, float]) -> dict[str, float]:
    """Of robots of unseen experiments, shares: first name right (of one cause), among the first two, named, alarms, outsiders refused."""
    first, two, named, alarms, refused, said = (list[bool]() for _ in range(6))
    for part, z in zip(parts, odds, strict=True):
        p = log_posterior(features_of(part.rows.astype(np.float32), z), weights)
        verdict, one = p.argmax(axis=1), part.count == 1
        if part.outside:
            refused += (verdict < 2).tolist()
            continue
        hit = np.take_along_axis(part.true, np.argsort(-p[:, 2:], axis=1), axis=1)
        first += hit[one, 0].tolist()
        named += np.logical_and(hit[one, 0], verdict[one] > 1).tolist()
        named += (hit[one, 0] & (verdict[one] > 1)).tolist()
        said += hit[(verdict > 1) & (part.count > 0), 0].tolist()
        alarms += (verdict[part.count == 0] != NONE).tolist()
    words = "first", "first two", "named", "names right", "alarms", "outsiders refused"
    return {
        name: round(float(np.mean(of)), 4)
        for name, of in zip(words, (first, two, named, said, alarms, refused), strict=True)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    seeds = [
        (folder, int(path.stem))
        for folder in options.folder
        for path in sorted(folder.glob("*.npz"))
        if path.stem.isdigit()
    ]
    if options.rows:
        rows: dict[str, NDArray[np.generic]] = {}
        for folder, seed in reversed(seeds.copy()):
            shard = read_shard(folder, seed)
            if len(shard.reference.torque) == 8 and (shard.known & (shard.layouts.signal == "torque")).any():
                seeds.remove((folder, seed))
                rows |= {f"{seed} {name}": values for name, values in with_and_without(shard, "torque").items()}
            if len(rows) == 4 * KEPT_OUT:
                break
        write_arrays(options.rows, rows)
    every = joblib.Parallel(n_jobs=options.jobs)(joblib.delayed(described)(folder, seed) for folder, seed in seeds)
    print(
        f"{len(every)} experiments, {sum(len(part.true) for parts in every for part in parts[:1])} robots", flush=True
    )
    parts: list[Described] = []
    odds: list[Floats] = []
    for fold in range(options.folds):
        model = taught([part for n, some in enumerate(every) if n % options.folds != fold for part in some])
        for part in (part for n, some in enumerate(every) if n % options.folds == fold for part in some):
            parts.append(part)
            odds.append(model(part.rows.astype(np.float32)))
    weights = weighed(parts, odds)
    print({name: round(value, 3) for name, value in weights.items()})
    for refined in (False, True):  # as a diagnosis looks at them apart
        some = [(part, z) for part, z in zip(parts, odds, strict=True) if part.refined == refined]
        if some:
            print(figures([part for part, _ in some], [z for _, z in some], weights), flush=True)
    if options.out:
        write_arrays(options.out / "classifier.npz", taught([part for some in every for part in some]).arrays())
        write_text(options.out / "posterior.json", json_text(weights))


if __name__ == "__main__":
    main()
