"""Which causes a log shows: learned from simulated robots, one probability for each cause, because real robots have several.

Differences are measured by what healthy robots of one build show: tolerances, chatter, numerical form and sensors in one
covariance. In that measure a robot is compared with templates, each the model with one cause at one place: how well the best
template of a cause fits, over all and signal by signal, is what a forest of trees decides by, and small neural networks, which
also see the differences themselves along their main directions. Both together err less than either. Their probabilities are
calibrated on robots that the deciding trees and networks have not seen.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.neural_network import MLPClassifier

from openant_tools.gap import tolerance
from openant_tools.gap.by_joint import FEWEST_JOINTS, ByJoint, places_of
from openant_tools.gap.cause import catalogue
from openant_tools.gap.features import COLUMNS, Floats
from openant_tools.gap.networks import logit, logits_of, teach
from openant_tools.gap.population import Case
from openant_tools.gap.prepare import Prepared
from openant_tools.gap.robot import Reference
from openant_tools.model.plant import Setup

__all__ = ["Judge", "Judgement", "Metric", "Whitening", "metric_of", "train"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

#: share by which what healthy robots show beyond their tolerances is taken for independent noise
SHRUNK = 0.5
#: deviations beyond which a difference says no more
CLIP = 40.0
#: standard deviation of a robot within a tolerance, as a share of it
SPREAD = 0.6
#: the forest
TREES, LEAF, TRIED = 300, 2, 0.15
#: the networks: how many, each taught without its share of the robots; neurons, rounds of teaching
NETWORKS, NEURONS, ROUNDS = 4, 128, 60
#: robots of a step, at least; steps of a round, at most
PORTION, STEPS = 64, 40
#: main directions of the differences that they see, and of how many robots; deviations beyond which an input says no more
DIRECTIONS, ENOUGH, FAR = 100, 3000, 5.0
#: signals of single joints that are looked at by themselves, too
LOOKED_AT = ("pos", "vel", "torque")
#: share of healthy robots whose energy lies above the gate
GATE = 0.02
#: causes whose templates show what tolerances do: cause → the tolerance of its coordinate, for a robot's reference
NUISANCES: dict[str, Callable[[Reference, Ints], float]] = {
    "stiffness_error": lambda reference, joints: tolerance.FACTORS["stiffness"],
    "damping_error": lambda reference, joints: tolerance.FACTORS["damping"],
    "torque_limit": lambda reference, joints: tolerance.FACTORS["torque_limit"],
    "armature_error": lambda reference, joints: tolerance.FACTORS["armature"],
    "link_mass": lambda reference, joints: tolerance.FACTORS["link_mass"],
    "coulomb_friction": lambda reference, joints: tolerance.COULOMB_NM / float(reference.torque[joints].mean()),
    "zero_offset": lambda reference, joints: tolerance.ZERO_RAD,
    "action_delay": lambda reference, joints: tolerance.DELAY_S,
    "floor_friction": lambda reference, joints: tolerance.FLOOR["floor_friction"],
    "contact_softness": lambda reference, joints: tolerance.FLOOR["softness"],
    "floor_tilt": lambda reference, joints: tolerance.TILT_RAD,
    "imu_misalignment": lambda reference, joints: tolerance.IMU_RAD,
    "payload": lambda reference, joints: tolerance.TORSO_KG / reference.robot_kg,
}


@dataclass(frozen=True)
class Judgement:
    """What a judge says of one robot.

    Attributes:
        probability: cause → that it is present beyond tolerance.
        joints: (joints,) that something sits at this joint and not at all of them.
        energy: of the whitened differences, as a multiple of the healthy robots' gate: below 1 a robot looks healthy.
        places: cause → where its best templates sit and their coordinates, best first, each place once.
    """

    probability: dict[str, float]
    joints: Array
    energy: float
    places: dict[str, list[tuple[tuple[int, ...], dict[str, float]]]]


@dataclass(frozen=True)
class Whitening:
    """What healthy robots do, taken out of the measure: Σ = M Mᵀ + σ², by its eigenvectors.

    Attributes:
        centre, scale: (features,) of the differences; the scale of a feature that never differs is infinite.
        basis: (features, directions). gains: (directions,) on top of 1/rest. rest: σ.
    """

    centre: Array
    scale: Array
    basis: Floats
    gains: Floats
    rest: float

    def __call__(self, x: Floats) -> Floats:
        """(robots, features) of differences."""
        return self.measure(np.clip((x - self.centre) / self.scale, -CLIP, CLIP).astype(np.float32))

    def measure(self, d: Floats) -> Floats:
        """(robots, features) of differences already scaled."""
        out: Floats = (d / self.rest + ((d @ self.basis) * self.gains) @ self.basis.T).astype(np.float32)
        return out


@dataclass(frozen=True)
class Metric:
    """What distances between robots are measured in: a whitening of some features.

    Attributes:
        columns: (features,) which it takes.
    """

    whitening: Whitening
    columns: Bools

    def __call__(self, x: Floats) -> Floats:
        """(robots, features) of differences, all of them."""
        return self.whitening(x[:, self.columns])


@dataclass(frozen=True)
class Networks:
    """Networks that have each been taught without one share of the robots; what they say is the mean of their logits.

    Attributes:
        centre: (features,) of the whitened differences' inverse hyperbolic sines. directions: (features, directions).
        usual, spread: (inputs,) of the forest's inputs.
    """

    centre: Floats
    directions: Floats
    usual: Floats
    spread: Floats
    members: tuple[MLPClassifier, ...] = ()

    @classmethod
    def of(cls, z: Floats, inputs: Floats) -> Networks:
        """For robots with whitened differences (robots, features) and inputs (robots, inputs)."""
        x = np.arcsinh(z[:: -(-len(z) // ENOUGH)])
        centre = x.mean(axis=0)
        squares, vectors = np.linalg.eigh((x - centre) @ (x - centre).T)
        squares, vectors = squares[-DIRECTIONS:], vectors[:, -DIRECTIONS:]
        real = squares > 1e-6 * squares[-1]
        # Along each direction these robots scatter by one.
        directions = (x - centre).T @ (vectors[:, real] / squares[real]) * np.sqrt(len(x))
        return cls(
            centre, directions.astype(np.float32), inputs.mean(axis=0), np.maximum(inputs.std(axis=0), 1e-6)
        )  # fmt: skip

    def seen(self, z: Floats, inputs: Floats) -> Floats:
        """(robots, …) what they are told of each robot."""
        own = (np.arcsinh(z) - self.centre) @ self.directions
        return np.hstack([own, ((inputs - self.usual) / self.spread).clip(-FAR, FAR)]).astype(np.float32)

    def taught(self, x: Floats, labels: Ints, seed: int) -> tuple[Networks, Array]:
        """The same with networks that have learned from robots, and the logits for those each had not seen."""
        # Larger portions of more robots: as many steps whatever there is to learn from.
        portion = max(PORTION, len(x) * (NETWORKS - 1) // NETWORKS // STEPS)
        members, unseen = teach(
            x, labels, shares=NETWORKS, neurons=NEURONS, rounds=ROUNDS, portion=portion, seed=seed
        )  # fmt: skip
        return dataclasses.replace(self, members=members), unseen

    def logits(self, z: Floats, inputs: Floats, outputs: int) -> Array:
        """(robots, outputs)."""
        return logits_of(self.members, self.seen(z, inputs), outputs)


@dataclass(frozen=True)
class Judge:
    """A trained judge; `say` is what it is for.

    Attributes:
        causes: by name, in the order of its probabilities. joints: how many.
        known: which causes, then joints, the forest and the networks tell.
        means, logs: which of the features are block means, and which are logarithms of sizes.
        bank: cause, joints and coordinates of each template. templates: whitened.
        groups: of each block mean, its run and signal.
    """

    causes: tuple[str, ...]
    joints: int
    means: Bools
    logs: Bools
    log_centre: Floats
    log_scale: Floats
    whitening: Whitening
    bank: tuple[tuple[str, tuple[int, ...], dict[str, float]], ...]
    templates: Floats
    groups: Ints
    gates: Array
    forest: ExtraTreesClassifier | None = None
    networks: Networks | None = None
    by_joint: ByJoint | None = None
    known: Bools | None = None
    calibration: tuple[tuple[float, float], ...] = ()

    def inputs(self, x: Floats) -> tuple[Floats, Floats, Floats]:
        """Of features (robots, features): inputs of the forest but what single joints say, differences whitened, logarithms."""
        z = self.whitening(x[:, self.means])
        fit = self._fits(z)
        size = np.linalg.norm(z, axis=1, keepdims=True)
        parts = [
            np.log10(size + 1e-3),
            self._by_cause(fit) / size,
            np.arcsinh(self._by_cause(fit)),
            self._by_joint(fit) / size,
        ]
        for group in np.unique(self.groups):
            mine = self.groups == group
            own = np.linalg.norm(z[:, mine], axis=1, keepdims=True)
            parts += [
                self._by_cause(self._fits(z, mine)) / np.maximum(own, 1e-6),
                np.log10(own + 1e-3) - np.log10(size + 1e-3),
            ]
        logs = ((x[:, self.logs] - self.log_centre) / self.log_scale).clip(-8, 8).astype(np.float32)
        return np.concatenate([*parts, logs], axis=1).astype(np.float32), z, logs

    def energy(self, x: Floats) -> Array:
        """(robots,) largest energy of any run's signal, as a multiple of its gate."""
        return np.asarray((_energies(self.whitening(x[:, self.means]), self.groups) / self.gates).max(axis=1))

    def say(self, x: Floats) -> Judgement:
        """Judge one robot, of features (features,)."""
        assert self.forest is not None
        assert self.networks is not None
        assert self.known is not None
        inputs, z, logs = self.inputs(x[None])
        if self.by_joint is not None:
            inputs = np.concatenate([inputs, self.by_joint.said(z, logs)], axis=1)
        count = int(self.known.sum())
        votes = _table(self.forest.predict_proba(inputs), count)
        raw = _together(logit(votes), self.networks.logits(z, inputs, count))[0]
        n = len(self.causes)
        chances = np.zeros(n + self.joints)
        chances[self.known] = [_logistic(a * value + b) for value, (a, b) in zip(raw, self.calibration, strict=True)]
        fit = self._fits(z)[0]
        places: dict[str, list[tuple[tuple[int, ...], dict[str, float]]]] = {cause: [] for cause in self.causes}
        for k in np.argsort(-fit):
            name, where, x_ = self.bank[int(k)]
            if where not in [there for there, _ in places[name]]:
                places[name].append((where, dict(x_)))
        return Judgement(
            dict(zip(self.causes, map(float, chances[:n]), strict=True)),
            chances[n:],
            float(self.energy(x[None])[0]),
            places,
        )

    def _fits(self, z: Floats, some: Bools | None = None) -> Floats:
        """(robots, templates) how far each goes along each template, none backwards."""
        templates = self.templates if some is None else self.templates[:, some]
        length = np.linalg.norm(templates, axis=1)
        out: Floats = np.maximum((z if some is None else z[:, some]) @ templates.T / np.maximum(length, 1e-6), 0.0)
        return out

    def _by_cause(self, fit: Floats) -> Floats:
        names = np.array([name for name, _, _ in self.bank])
        return np.stack([fit[:, names == cause].max(axis=1) for cause in self.causes], axis=1)

    def _by_joint(self, fit: Floats) -> Floats:
        single = [where[0] if len(where) == 1 else -1 for _, where, _ in self.bank]
        return np.stack([fit[:, np.array(single) == j].max(axis=1, initial=0.0) for j in range(self.joints)], axis=1)


def train(prepared: Prepared, which: Sequence[int], columns: Sequence[Bools], seed: int = 0) -> Judge:
    """Train a judge on some runs of a prepared protocol.

    Args:
        which: the runs that the robots at hand have.
        columns: of each of them, the features that they have.
    """
    kept = np.concatenate(list(columns))
    x = np.concatenate([prepared.features[k] for k in which], axis=1)[:, kept]
    templates = np.concatenate([prepared.templates[k] for k in which], axis=1)[:, kept]
    told_by = _layout(prepared, which).only(kept)
    means, groups = told_by.means, told_by.groups
    healthy = np.flatnonzero(prepared.healthy())
    np.random.default_rng(seed).shuffle(healthy)
    # Those that the measure comes from look too healthy to it: they must not teach what healthy looks like.
    measure, others = np.split(healthy, [max(20, len(healthy) * 3 // 5)])
    whitening = _whiten(x[measure][:, means], templates[:, means], prepared.bank, prepared.protocol.reference)
    moved = whitening.measure(np.clip(templates[:, means] / whitening.scale, -CLIP, CLIP).astype(np.float32))
    seen = np.linalg.norm(moved, axis=1) > 1e-3
    bank = tuple(
        (name, where, x_)
        for case, shown in zip(prepared.bank, seen, strict=True)
        for name, (where, x_) in case.causes.items()
        if shown
    )
    logs = x[measure][:, ~means]
    names = tuple(sorted({name for name, _, _ in bank}))
    joints = len(prepared.protocol.joints)
    energies = _energies(whitening(x[others][:, means]), groups[means])
    judge = Judge(
        names, joints, means, ~means, np.median(logs, axis=0), logs.std(axis=0) + 0.05, whitening, bank, moved[seen],
        groups[means], np.quantile(energies, 1 - GATE, axis=0),
    )  # fmt: skip
    labels = _labels(prepared, names, joints)
    taught = np.concatenate([np.flatnonzero(~prepared.healthy()), others])
    known = labels[taught].any(axis=0)  # a robot of one joint has no other joints
    forest = ExtraTreesClassifier(
        TREES, min_samples_leaf=LEAF, max_features=TRIED, bootstrap=True, oob_score=True, n_jobs=-1, random_state=seed
    )
    some = [judge.inputs(x[taught[k : k + 256]]) for k in range(0, len(taught), 256)]
    inputs, z, told = (np.concatenate(parts) for parts in zip(*some, strict=True))
    if joints >= FEWEST_JOINTS:
        by_joint, said = _by_joint(prepared, judge, told_by).taught(
            z, told, [prepared.cases[k].causes for k in taught], seed
        )
        judge, inputs = dataclasses.replace(judge, by_joint=by_joint), np.concatenate([inputs, said], axis=1)
    wanted = labels[np.ix_(taught, known)]
    forest.fit(inputs, wanted)
    empty = Networks.of(z, inputs)
    networks, guessed = empty.taught(empty.seen(z, inputs), wanted, seed)
    unseen = _together(logit(_unseen(forest, wanted.shape[1])), guessed)
    calibration = tuple(_calibrated(unseen[:, n], wanted[:, n]) for n in range(wanted.shape[1]))
    forest.oob_decision_function_ = None  # of no use any more, and large
    return dataclasses.replace(judge, forest=forest, networks=networks, known=known, calibration=calibration)


def metric_of(prepared: Prepared, which: Sequence[int], columns: Sequence[Bools]) -> Metric:
    """The metric of some runs' block means alone."""
    chosen = _layout(prepared, which).means & np.concatenate(list(columns))
    x = np.concatenate([prepared.features[k] for k in which], axis=1)[:, chosen]
    templates = np.concatenate([prepared.templates[k] for k in which], axis=1)[:, chosen]
    return Metric(_whiten(x[prepared.healthy()], templates, prepared.bank, prepared.protocol.reference), chosen)


@dataclass(frozen=True)
class _Layout:
    """Of each feature: whether it is a block mean, its run's number and whether that stood on the floor, its signal and joint.

    Attributes:
        joints: −1 for the body's.
    """

    means: Bools
    runs: Ints
    floor: Bools
    signals: NDArray[np.str_]
    joints: Ints

    def only(self, kept: Bools) -> _Layout:
        return _Layout(self.means[kept], self.runs[kept], self.floor[kept], self.signals[kept], self.joints[kept])

    @property
    def groups(self) -> Ints:
        """Of each feature, a number for its run and signal, from 0."""
        _, signals = np.unique(self.signals, return_inverse=True)
        return np.unique(self.runs * (signals.max() + 1) + signals, return_inverse=True)[1]


def _layout(prepared: Prepared, which: Sequence[int]) -> _Layout:
    means, runs, floor, signals, joints = [], [], [], [], []
    for n, k in enumerate(which):
        played = prepared.protocol.runs[k]
        for signal, kinds in played.layout.groups().items():
            means += [kind == "mean" for kind in kinds]
            runs += [n] * len(kinds)
            floor += [played.plant.setup is Setup.FLOOR] * len(kinds)
            signals += [signal] * len(kinds)
            joints += [-1] * len(kinds) if signal in COLUMNS else [j % played.layout.joints for j in range(len(kinds))]
    return _Layout(np.array(means), np.array(runs), np.array(floor), np.array(signals), np.array(joints))


def _by_joint(prepared: Prepared, judge: Judge, told_by: _Layout) -> ByJoint:
    """What is to look at single joints: at each setup's runs, and on the stand at each signal by itself."""
    of_means = told_by.only(judge.means)
    views = [
        ~of_means.floor,
        of_means.floor,
        *(~of_means.floor & (of_means.signals == name) for name in LOOKED_AT),
    ]
    causes = tuple(name for name in judge.causes if not catalogue()[name].of_body)
    return ByJoint(
        causes=causes,
        groups=tuple(np.array(group) for group in prepared.protocol.servos()),
        parts=tuple(
            tuple(part for view in views if (part := view & (of_means.joints == j)).any()) for j in range(judge.joints)
        ),
        bank=tuple(places_of(judge.bank, causes, j) for j in range(judge.joints)),
        templates=judge.templates,
        logs=tuple(told_by.joints[judge.logs] == j for j in range(judge.joints)),
    )  # fmt: skip


def _labels(prepared: Prepared, names: Sequence[str], joints: int) -> Ints:
    labels = np.zeros((len(prepared.cases), len(names) + joints), np.int64)
    for row, case in enumerate(prepared.cases):
        for name, (where, _) in case.causes.items():
            if name not in names:
                continue
            labels[row, names.index(name)] = 1
            if len(where) < joints:
                labels[row, [len(names) + j for j in where]] = 1
    return labels


def _whiten(x: Floats, templates: Floats, bank: Sequence[Case], reference: Reference) -> Whitening:
    """Σ of healthy robots: what tolerances do, by the templates' directions, and what else healthy robots show."""
    centre = np.median(x, axis=0).astype(np.float64)
    scale = np.std(x, axis=0).astype(np.float64)
    # What no simulated robot ever showed (a block that lay beyond its run's end, or all around a switch of torque) says nothing.
    scale = np.where(np.ptp(x, axis=0) > 0, np.maximum(scale, 1e-3 * float(np.median(scale))), np.inf)
    d = np.clip((x - centre) / scale, -CLIP, CLIP).astype(np.float32)
    tolerances = _tolerances(templates / scale, bank, reference)
    inner = np.linalg.solve(tolerances.T @ tolerances + np.eye(tolerances.shape[1]), tolerances.T @ d.T)
    rest = d - (tolerances @ inner).T
    # Few robots and many features: their covariance, shrunk a little towards independence (Ledoit and Wolf 2004).
    squares, vectors = np.linalg.eigh(rest @ rest.T / len(rest))
    real = squares > 1e-6 * squares[-1]
    own = rest.T @ (vectors[:, real] / np.sqrt(len(rest)))  # as long as the robots scatter along it
    variance = SHRUNK * float(np.mean(rest**2))
    both = np.hstack([tolerances, own * np.float32(math.sqrt(1 - SHRUNK))])
    squares, vectors = np.linalg.eigh(both.T @ both)
    keep = squares > 1e-6 * squares.max()
    basis = (both @ vectors[:, keep]) / np.sqrt(squares[keep])
    gains = 1 / np.sqrt(squares[keep] + variance) - 1 / np.sqrt(variance)
    return Whitening(centre, scale, basis.astype(np.float32), gains.astype(np.float32), float(np.sqrt(variance)))


def _tolerances(templates: Array, bank: Sequence[Case], reference: Reference) -> Floats:
    """(features, nuisances): how a robot moves that is one deviation within each tolerance."""
    out = [np.zeros(templates.shape[1])]
    taken = set()
    for template, case in zip(templates, bank, strict=True):
        ((name, (joints, x)),) = case.causes.items()
        if name not in NUISANCES:
            continue
        main = max((q for q in catalogue()[name].quantities if not q.shape), key=lambda q: abs(x[q.name]) / q.small)
        key = (name, joints, main.name)
        # The smallest template of a place: the nearest to a derivative.
        if key in taken:
            continue
        taken.add(key)
        out.append(template * (SPREAD * NUISANCES[name](reference, np.array(joints)) / x[main.name]))
    found: Floats = np.array(out).T.astype(np.float32)
    return found


def _energies(z: Floats, groups: Ints) -> Array:
    count = np.bincount(groups)
    sums = np.stack([np.bincount(groups, row) for row in np.square(z, dtype=np.float64)])
    out: Array = sums / np.maximum(count, 1)
    return out


def _unseen(forest: ExtraTreesClassifier, outputs: int) -> Array:
    """(robots, outputs) votes of the trees that had not seen each robot."""
    votes = np.asarray(forest.oob_decision_function_)
    if votes.ndim == 3 and votes.shape[1] == 2:
        votes = votes.transpose(0, 2, 1)
    out: Array = np.nan_to_num(votes[:, :outputs, 1])
    return out


def _table(said: Sequence[Array] | Array, outputs: int) -> Array:
    """(robots, outputs) probabilities, in whatever form a classifier of several labels gives them."""
    if isinstance(said, np.ndarray):
        return said[:, -outputs:]
    return np.stack([one[:, 1] if one.shape[1] > 1 else np.zeros(len(one)) for one in said], axis=1)


def _together(votes: Array, networks: Array) -> Array:
    """(robots, outputs) one logit of the forest's and the networks'."""
    out: Array = (votes + networks) / 2
    return out


def _logistic(x: float | Array) -> float:
    return float(1 / (1 + np.exp(-x)))


def _calibrated(logits: Array, label: Ints) -> tuple[float, float]:
    """Platt's scale and offset on a logit."""
    if label.sum() < 5:
        return 1.0, 0.0
    model = LogisticRegression(C=10.0).fit(logits[:, None], label)
    scale = float(model.coef_[0, 0])
    return (scale, float(model.intercept_[0])) if scale > 0.1 else (1.0, 0.0)
