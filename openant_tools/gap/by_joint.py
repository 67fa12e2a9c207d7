"""What each joint shows by itself, whatever joint it is.

A robot has many joints of the same make, and what ails one of them looks alike at all: joints are so many examples to learn
from where robots are few. Small neural networks see one joint at a time, by how well each cause's template at that joint fits
what that joint does, and say which causes it has. How often, how surely and where they say so is what the judge of the whole
robot then goes by.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.neural_network import MLPClassifier

from openant_tools.gap.features import Floats
from openant_tools.gap.networks import logits_of, teach

__all__ = ["FEWEST_JOINTS", "ByJoint", "places_of"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

#: robots of fewer joints have nothing to learn from each other's
FEWEST_JOINTS = 3
#: the networks: how many, each taught without its share of the robots; neurons, rounds, joints of a step
NETWORKS, NEURONS, ROUNDS, PORTION = 3, 192, 20, 256
#: deviations beyond which an input says no more
FAR = 5.0
#: templates whose part at a joint is shorter do not show there
SHORT = 0.3


@dataclass(frozen=True)
class ByJoint:
    """Networks that look at one joint at a time.

    Attributes:
        causes: by name, those that sit at joints.
        groups: joints with servos of one model.
        parts: of each joint, some of the whitened differences, (differences,) each.
        bank: of each joint and cause, which templates tell of it.
        templates: (templates, differences) whitened. logs: of each joint, which of the logarithms are its own.
    """

    causes: tuple[str, ...]
    groups: tuple[Ints, ...]
    parts: tuple[tuple[Bools, ...], ...]
    bank: tuple[tuple[Ints, ...], ...]
    templates: Floats
    logs: tuple[Bools, ...]
    usual: Floats = dataclasses.field(default_factory=lambda: np.zeros(0, np.float32))
    spread: Floats = dataclasses.field(default_factory=lambda: np.zeros(0, np.float32))
    members: tuple[MLPClassifier, ...] = ()

    def seen(self, z: Floats, logs: Floats) -> Floats:
        """(robots, joints, inputs) of whitened differences and of logarithms, (robots, …) each."""
        return np.stack([self._of_joint(j, z, logs) for j in range(len(self.parts))], axis=1)

    def _of_joint(self, j: int, z: Floats, logs: Floats) -> Floats:
        out = []
        for part in self.parts[j]:
            own, templates = z[:, part], self.templates[:, part]
            size = np.linalg.norm(own, axis=1, keepdims=True)
            length = np.linalg.norm(templates, axis=1)
            fit = np.where(length > SHORT, own @ templates.T / np.maximum(length, 1e-6), 0.0)
            best = np.stack([fit[:, some].max(axis=1, initial=0.0) for some in self.bank[j]], axis=1)
            out += [np.log10(size + 1e-2), np.arcsinh(best), best / np.maximum(size, 1e-6)]
        which = next(float(k) for k, group in enumerate(self.groups) if j in group)
        joined: Floats = np.concatenate([*out, logs[:, self.logs[j]], np.full((len(z), 1), which)], axis=1)
        return joined.astype(np.float32)

    def taught(
        self, z: Floats, logs: Floats, causes: Sequence[Mapping[str, tuple[tuple[int, ...], object]]], seed: int
    ) -> tuple[ByJoint, Array]:
        """Learn from robots; with it (robots, joints, causes) logits for each by those that have not seen it.

        Args:
            z, logs: as `logits`. causes: of each robot, name → where it sits and whatever.
        """
        x = self.seen(z, logs)
        labels = np.zeros((*x.shape[:2], len(self.causes)), np.int64)
        for row, mine in enumerate(causes):
            for name in set(mine) & set(self.causes):
                labels[row, list(mine[name][0]), self.causes.index(name)] = 1
        flat = x.reshape(-1, x.shape[2])
        self = dataclasses.replace(self, usual=flat.mean(axis=0), spread=flat.std(axis=0) + np.float32(1e-6))
        members, unseen = teach(
            self._scaled(x), labels, shares=NETWORKS, neurons=NEURONS, rounds=ROUNDS, portion=PORTION, seed=seed
        )  # fmt: skip
        return dataclasses.replace(self, members=members), unseen

    def logits(self, z: Floats, logs: Floats) -> Array:
        """(robots, joints, causes), of differences whitened and of logarithms, (robots, …) each."""
        return logits_of(self.members, self._scaled(self.seen(z, logs)), len(self.causes))

    def _scaled(self, x: Floats) -> Floats:
        out: Floats = ((x - self.usual) / self.spread).clip(-FAR, FAR)
        return out

    def named(self, logits: Array) -> dict[str, Array]:
        """Cause → (robots, joints) logits."""
        return {name: logits[..., k] for k, name in enumerate(self.causes)}

    def likelihood(self, logits: Array, cause: str, places: Sequence[tuple[int, ...]]) -> Array:
        """(places,) logarithms of how likely a cause sits at these joints and at no other; logits: (joints, causes)."""
        own = logits[:, self.causes.index(cause)]
        there = np.array([[j in where for j in range(len(own))] for where in places])
        # log p where it sits, log (1 − p) where it does not.
        out: Array = -np.logaddexp(0.0, np.where(there, -own, own)).sum(axis=1)
        return out

    def summary(self, logits: Array) -> Floats:
        """Of (robots, joints, causes): how sure of each cause at all joints, at the surest two, and at servos of one model."""
        ordered = np.sort(logits, axis=1)
        mean = logits.mean(axis=1)
        parts = [mean, ordered[:, -1], ordered[:, -2], ordered[:, -1] - mean]
        parts += [logits[:, group].mean(axis=1) for group in self.groups]
        return np.concatenate(parts, axis=1).astype(np.float32)


def places_of(
    bank: Sequence[tuple[str, tuple[int, ...], dict[str, float]]], causes: Sequence[str], joint: int
) -> tuple[Ints, ...]:
    """Of each cause, the templates that tell of it at a joint: those that sit there alone, else those that sit there too."""
    out = []
    for cause in causes:
        there = [k for k, (name, where, _) in enumerate(bank) if name == cause and joint in where]
        alone = [k for k in there if len(bank[k][1]) == 1]
        out.append(np.array(alone or there, dtype=np.int64))
    return tuple(out)
