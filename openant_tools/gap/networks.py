"""Small neural networks, each taught without one share of the robots, so that every robot is judged by one that never saw it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import KFold
from sklearn.neural_network import MLPClassifier

from openant_tools.gap.features import Floats

__all__ = ["logit", "logits_of", "teach"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

#: decay of weights
DECAY = 1.0
#: probabilities nearer to 0 or 1 than this count as this
EDGE = 0.002


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
    mean = np.mean([logit(np.asarray(one.predict_proba(flat))[:, -outputs:]) for one in members], axis=0)
    out: Array = mean.reshape(*x.shape[:-1], outputs)
    return out


def logit(p: Array) -> Array:
    """Of probabilities."""
    clipped = np.clip(p, EDGE, 1 - EDGE)
    out: Array = np.log(clipped / (1 - clipped))
    return out
