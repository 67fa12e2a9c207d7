"""Which causes a log shows: learned from simulated robots, one probability for each cause, because real robots have several.

Differences are measured by what healthy robots of one build show (`gap.whitening`). In that measure a robot is compared with
templates, each the model with one cause at one place; networks see how well the best template of each cause fits, over all and
signal by signal, and the differences themselves along their main directions, of the whole robot or of one joint at a time. What
to believe of all that is learned once more, of all causes together (`gap.stack`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.by_joint import FEWEST_JOINTS, ByJoint, places_of
from openant_tools.gap.features import Floats
from openant_tools.gap.networks import Networks
from openant_tools.gap.prepare import Prepared
from openant_tools.gap.stack import Stack, evidence
from openant_tools.gap.templates import Template, Templates
from openant_tools.gap.whitening import Metric, Whitening, whiten
from openant_tools.model.plant import Setup

__all__ = ["Judge", "Judgement", "metric_of", "train"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

#: signals of single joints that are looked at by themselves, too
LOOKED_AT = ("pos", "vel", "torque")
#: share of healthy robots whose energy lies above the gate
GATE = 0.02
#: of the healthy robots, the share that the measure comes from; and the least that it does with
MEASURE, LEAST = 0.6, 20
#: robots that are looked at side by side
PORTION = 256
#: deviations beyond which a logarithm says no more, and the least of what healthy robots scatter by
FAR, LEAST_SPREAD = 8.0, 0.05


@dataclass(frozen=True)
class Judgement:
    """What a judge says of one robot.

    Attributes:
        probability: cause → that it is present beyond tolerance.
        energy: of the whitened differences, as a multiple of the healthy robots' gate: below 1 a robot looks healthy.
        places: cause → where its best templates sit and their coordinates, best first, each place once.
    """

    probability: dict[str, float]
    energy: float
    places: dict[str, list[tuple[tuple[int, ...], dict[str, float]]]]


@dataclass(frozen=True)
class _Told:
    """What robots show.

    Attributes:
        z: (robots, features) whitened differences. logs: (robots, …) logarithms of sizes.
        inputs: (robots, …) of the networks that see all of a robot, but for what single joints say.
    """

    z: Floats
    logs: Floats
    inputs: Floats


@dataclass(frozen=True)
class Judge:
    """A trained judge; `say` is what it is for.

    Attributes:
        means: which of the features are block means; the others are logarithms of sizes.
        log_centre, log_scale: (logarithms,) of healthy robots.
        groups: of each block mean, its run and signal. gates: of each of those, the energy that few healthy robots exceed.
    """

    means: Bools
    log_centre: Floats
    log_scale: Floats
    whitening: Whitening
    templates: Templates
    groups: Ints
    gates: Array
    networks: Networks | None = None
    by_joint: ByJoint | None = None
    stack: Stack | None = None

    @property
    def causes(self) -> tuple[str, ...]:
        """In the order of its probabilities."""
        return self.templates.causes

    def told(self, x: Floats) -> _Told:
        """Of features (robots, features)."""
        z = self.whitening(x[:, self.means])
        bank = self.templates
        fit = bank.fits(z)
        size = np.linalg.norm(z, axis=1, keepdims=True)
        parts = [
            np.log10(size + 1e-3),
            bank.by_cause(fit) / size,
            np.arcsinh(bank.by_cause(fit)),
            bank.by_joint(fit) / size,
        ]
        for group in np.unique(self.groups):
            mine = self.groups == group
            own = np.linalg.norm(z[:, mine], axis=1, keepdims=True)
            parts += [
                bank.by_cause(bank.fits(z, mine)) / np.maximum(own, 1e-6),
                np.log10(own + 1e-3) - np.log10(size + 1e-3),
            ]
        logs = ((x[:, ~self.means] - self.log_centre) / self.log_scale).clip(-FAR, FAR).astype(np.float32)
        return _Told(z, logs, np.concatenate([*parts, logs], axis=1).astype(np.float32))

    def energy(self, x: Floats) -> Array:
        """(robots,) largest energy of any run's signal, as a multiple of its gate."""
        return self._energy(self.whitening(x[:, self.means]))

    def _energy(self, z: Floats) -> Array:
        return np.asarray((_energies(z, self.groups) / self.gates).max(axis=1))

    def probabilities(self, x: Floats) -> Array:
        """(robots, causes), of features (robots, features)."""
        told = self.told(x)
        return self._believed(told, self._at_joints(told))

    def _at_joints(self, told: _Told) -> Array | None:
        """(robots, joints, causes) logits by the networks that see one joint at a time, if there are any."""
        return None if self.by_joint is None else self.by_joint.logits(told.z, told.logs)

    def _believed(self, told: _Told, logits: Array | None) -> Array:
        """(robots, causes) probabilities."""
        assert self.networks is not None
        assert self.stack is not None
        at_joints, inputs = {}, []
        if self.by_joint is not None and logits is not None:
            at_joints, inputs = self.by_joint.named(logits), [self.by_joint.summary(logits)]
        whole = self.networks.logits(told.z, np.hstack([told.inputs, *inputs]), len(self.causes))
        return self.stack(evidence(self.templates, told.z, whole, at_joints))

    def say(self, x: Floats) -> Judgement:
        """Judge one robot, of features (features,)."""
        told = self.told(x[None])
        logits = self._at_joints(told)
        chances = self._believed(told, logits)[0]
        energy = float(self._energy(told.z)[0])
        return Judgement(dict(zip(self.causes, map(float, chances), strict=True)), energy, self._places(told, logits))

    def _places(self, told: _Told, logits: Array | None) -> dict[str, list[tuple[tuple[int, ...], dict[str, float]]]]:
        """Of one robot, as `Judgement.places`."""
        out = self.templates.places(self.templates.fits(told.z)[0])
        if self.by_joint is None or logits is None:
            return out
        for name in self.by_joint.causes:
            if catalogue()[name].random:
                # No template tells where: it has lost other commands than this robot.
                likelihood = self.by_joint.likelihood(logits[0], name, [where for where, _ in out[name]])
                out[name] = [out[name][k] for k in np.argsort(-likelihood)]
        return out


def train(prepared: Prepared, which: Sequence[int], columns: Sequence[Bools], seed: int = 0) -> Judge:
    """Train a judge on some runs of a prepared protocol.

    Args:
        which: the runs that the robots at hand have.
        columns: of each of them, the features that they have.
    """
    kept = np.concatenate(list(columns))
    x = np.concatenate([prepared.features[k] for k in which], axis=1)[:, kept]
    vectors = np.concatenate([prepared.templates[k] for k in which], axis=1)[:, kept]
    told_by = _layout(prepared, which).only(kept)
    means, groups = told_by.means, told_by.groups
    healthy = np.flatnonzero(prepared.healthy())
    np.random.default_rng(seed).shuffle(healthy)
    # Those that the measure comes from look too healthy to it: they must not teach what healthy looks like.
    measure, others = np.split(healthy, [max(LEAST, int(len(healthy) * MEASURE))])
    whitening = whiten(x[measure][:, means], vectors[:, means], prepared.bank, prepared.protocol.reference)
    bank: list[Template] = [(name, *one) for case in prepared.bank for name, one in case.causes.items()]
    joints = len(prepared.protocol.joints)
    templates = Templates.of(bank, whitening.of_templates(vectors[:, means]), joints)
    logs = x[measure][:, ~means]
    energies = _energies(whitening(x[others][:, means]), groups)
    judge = Judge(
        means, np.median(logs, axis=0), logs.std(axis=0) + LEAST_SPREAD, whitening, templates, groups,
        np.quantile(energies, 1 - GATE, axis=0),
    )  # fmt: skip
    taught = np.concatenate([np.flatnonzero(~prepared.healthy()), others])
    cases = [prepared.cases[k].causes for k in taught]
    labels = np.array([[name in mine for name in judge.causes] for mine in cases], np.int64)
    some = [judge.told(x[taught[k : k + PORTION]]) for k in range(0, len(taught), PORTION)]
    z, logs, inputs = (np.concatenate([getattr(part, name) for part in some]) for name in ("z", "logs", "inputs"))
    at_joints = {}
    if joints >= FEWEST_JOINTS:
        by_joint, logits = _by_joint(prepared, judge, told_by).taught(z, logs, cases, seed)
        judge, at_joints = dataclasses.replace(judge, by_joint=by_joint), by_joint.named(logits)
        inputs = np.hstack([inputs, by_joint.summary(logits)])
    networks, whole = Networks.of(z, inputs).taught(z, inputs, labels, seed)
    stack = Stack.taught(evidence(templates, z, whole, at_joints), labels, seed)
    return dataclasses.replace(judge, networks=networks, stack=stack)


def metric_of(prepared: Prepared, which: Sequence[int], columns: Sequence[Bools]) -> Metric:
    """The metric of some runs' block means alone."""
    chosen = _layout(prepared, which).means & np.concatenate(list(columns))
    x = np.concatenate([prepared.features[k] for k in which], axis=1)[:, chosen]
    vectors = np.concatenate([prepared.templates[k] for k in which], axis=1)[:, chosen]
    return Metric(whiten(x[prepared.healthy()], vectors, prepared.bank, prepared.protocol.reference), chosen)


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
        """Of each block mean, a number for its run and signal, from 0."""
        _, signals = np.unique(self.signals, return_inverse=True)
        return np.unique((self.runs * (signals.max() + 1) + signals)[self.means], return_inverse=True)[1]


def _layout(prepared: Prepared, which: Sequence[int]) -> _Layout:
    means, runs, floor, signals, joints = [], [], [], [], []
    for n, k in enumerate(which):
        played = prepared.protocol.runs[k]
        for signal, kinds in played.layout.groups().items():
            means += [kind == "mean" for kind in kinds]
            runs += [n] * len(kinds)
            floor += [played.plant.setup is Setup.FLOOR] * len(kinds)
            signals += [signal] * len(kinds)
            joints += played.layout.joints_of(signal)
    return _Layout(np.array(means), np.array(runs), np.array(floor), np.array(signals), np.array(joints))


def _by_joint(prepared: Prepared, judge: Judge, told_by: _Layout) -> ByJoint:
    """What is to look at single joints: at each setup's runs, and on the stand at each signal by itself."""
    of_means, joints = told_by.only(judge.means), range(judge.templates.joints)
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
            tuple(part for view in views if (part := view & (of_means.joints == j)).any()) for j in joints
        ),
        bank=tuple(places_of(judge.templates.bank, causes, j) for j in joints),
        templates=judge.templates.vectors,
        logs=tuple(told_by.joints[~judge.means] == j for j in joints),
    )  # fmt: skip


def _energies(z: Floats, groups: Ints) -> Array:
    count = np.bincount(groups)
    sums = np.stack([np.bincount(groups, row) for row in np.square(z, dtype=np.float64)])
    out: Array = sums / np.maximum(count, 1)
    return out
