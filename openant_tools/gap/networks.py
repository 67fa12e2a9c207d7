"""Small neural networks, each taught without one share of the robots, so that every robot is judged by one that never saw it."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import KFold
from sklearn.neural_network import MLPClassifier

from openant_tools.gap.features import Floats

__all__ = ["Networks", "logits_of", "teach"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

#: decay of weights
DECAY = 1.0
#: probabilities nearer to 0 or 1 than this count as this
EDGE = 0.002
#: those that see the whole robot: how many, each taught without its share of the robots; neurons, rounds of teaching
NETWORKS, NEURONS, ROUNDS = 4, 128, 60
#: robots of a step, at least; steps of a round, at most
PORTION, STEPS = 64, 40
#: main directions of the differences that they see, and of how many robots; deviations beyond which an input says no more
DIRECTIONS, ENOUGH, FAR = 100, 3000, 5.0


@dataclass(frozen=True)
class Networks:
    """Networks that see a whole robot: its differences along their main directions, and how well causes fit them.

    Attributes:
        centre: (features,) of the whitened differences' inverse hyperbolic sines. directions: (features, directions).
        usual, spread: (inputs,) of what else they are told.
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

    def taught(self, z: Floats, inputs: Floats, labels: Ints, seed: int) -> tuple[Networks, Array]:
        """The same with networks that have learned from robots, and the logits for those each had not seen."""
        x = self._seen(z, inputs)
        # Larger portions of more robots: as many steps whatever there is to learn from.
        portion = max(PORTION, len(x) * (NETWORKS - 1) // NETWORKS // STEPS)
        members, unseen = teach(
            x, labels, shares=NETWORKS, neurons=NEURONS, rounds=ROUNDS, portion=portion, seed=seed
        )  # fmt: skip
        return dataclasses.replace(self, members=members), unseen

    def logits(self, z: Floats, inputs: Floats, outputs: int) -> Array:
        """(robots, outputs) the mean of what they say."""
        return logits_of(self.members, self._seen(z, inputs), outputs)

    def _seen(self, z: Floats, inputs: Floats) -> Floats:
        own = (np.arcsinh(z) - self.centre) @ self.directions
        return np.hstack([own, ((inputs - self.usual) / self.spread).clip(-FAR, FAR)]).astype(np.float32)


def teach(
    x: Floats, labels: Ints, *, shares: int, neurons: int, rounds: int, portion: int, seed: int
) -> tuple[tuple[MLPClassifier, ...], Array]:
    """Networks of one hidden layer, and the logits that each gives to the robots that it has not seen.

    Args:
        x: (robots, …, inputs). labels: (robots, …, outputs) of 0 and 1.
        shares: how many, each without one share of the robots. portion: examples of a step.

    Returns:
        The networks; (robots, …, outputs).
    """
    members, unseen = [], np.zeros(labels.shape)
    for some, others in KFold(shares, shuffle=True, random_state=seed).split(x):
        own, wanted = x[some].reshape(-1, x.shape[-1]), labels[some].reshape(-1, labels.shape[-1])
        one = MLPClassifier(
            (neurons,), alpha=DECAY, max_iter=rounds, batch_size=min(portion, len(own)), random_state=seed
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # to stop early is meant
            one.fit(own, wanted)
        members.append(one)
        unseen[others] = logits_of([one], x[others], labels.shape[-1])
    return tuple(members), unseen


def logits_of(members: Sequence[MLPClassifier], x: Floats, outputs: int) -> Array:
    """(robots, …, outputs) the mean of what networks say of (robots, …, inputs)."""
    flat = x.reshape(-1, x.shape[-1])
    # Of one output a classifier tells both probabilities, of several each one's.
    mean = np.mean([_logit(np.asarray(one.predict_proba(flat))[:, -outputs:]) for one in members], axis=0)
    out: Array = mean.reshape(*x.shape[:-1], outputs)
    return out


def _logit(p: Array) -> Array:
    """Of probabilities."""
    clipped = np.clip(p, EDGE, 1 - EDGE)
    out: Array = np.log(clipped / (1 - clipped))
    return out
