"""One probability of each cause, from all that is said of it (stacked generalisation, Wolpert 1992).

What networks that see a whole robot say of a cause, what those say that see one joint at a time, and how well its templates
fit, alone and once what fits best is taken out: how much each of these is to be believed is the same question for all causes.
Trees that are boosted learn it of all of them together, from what was said of robots by networks that had not seen them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

from openant_tools.gap.features import Floats
from openant_tools.gap.templates import Templates

__all__ = ["PEELED", "Stack", "evidence"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

#: how often the best cause is taken out
PEELED = 2
#: what is said of a cause that nobody was asked about, as a logit
NOTHING = -9.0
#: the trees: how many, how much each of them adds, leaves of each, examples of a leaf
TREES, RATE, LEAVES, EXAMPLES = 300, 0.04, 15, 30
#: share by which leaves are drawn towards nothing
SHRUNK = 1.0


@dataclass(frozen=True)
class Stack:
    """Boosted trees that have learned what to believe."""

    trees: HistGradientBoostingClassifier

    @classmethod
    def taught(cls, told: Floats, labels: Ints, seed: int) -> Stack:
        """From what was said of robots, (robots, causes, columns), and which causes they have, (robots, causes)."""
        columns = told.shape[2]
        trees = HistGradientBoostingClassifier(
            max_iter=TREES, learning_rate=RATE, max_leaf_nodes=LEAVES, min_samples_leaf=EXAMPLES,
            l2_regularization=SHRUNK, categorical_features=[columns - 1], early_stopping=False, random_state=seed,
        )  # fmt: skip
        return cls(trees.fit(told.reshape(-1, columns), labels.ravel()))

    def __call__(self, told: Floats) -> Array:
        """(robots, causes) probabilities, from what is said of robots, (robots, causes, columns)."""
        out: Array = self.trees.predict_proba(told.reshape(-1, told.shape[2]))[:, 1].reshape(told.shape[:2])
        return out


def evidence(templates: Templates, z: Floats, whole: Array, at_joints: Mapping[str, Array]) -> Floats:
    """(robots, causes, columns) what is said of each cause of some robots.

    Args:
        z: (robots, features) whitened differences. whole: (robots, causes) logits of networks that see all of a robot.
        at_joints: of causes that sit at joints, (robots, joints) logits of networks that see one joint at a time.
    """
    causes = templates.causes
    size = np.linalg.norm(z, axis=1, keepdims=True)
    fits = [(templates.by_cause(templates.fits(z)), size), *templates.peeled(z, PEELED)]
    surest = np.max([logits.max(axis=1) for logits in at_joints.values()], axis=0) if at_joints else None
    out = []
    for c, name in enumerate(causes):
        columns = [whole[:, c], np.delete(whole, c, axis=1).max(axis=1, initial=NOTHING)]
        for fit, left in fits:
            columns += [fit[:, c] / left[:, 0], np.arcsinh(fit[:, c]), np.log10(left[:, 0] + 1e-3)]
        if surest is not None:
            columns += [*_of_joints(name, at_joints), surest]
        out.append(np.stack([*columns, np.full(len(z), c)], axis=1))
    return np.stack(out, axis=1).astype(np.float32)


def _of_joints(cause: str, at_joints: Mapping[str, Array]) -> list[Array]:
    """How sure of a cause at all joints, at the surest, the next, how much surer there, and of any other cause there."""
    if cause not in at_joints:
        robots = len(next(iter(at_joints.values())))
        return [np.full(robots, NOTHING)] * 5
    own = at_joints[cause]
    ordered, mean, there = np.sort(own, axis=1), own.mean(axis=1), own.argmax(axis=1)
    rows = np.arange(len(own))
    others = [logits[rows, there] for name, logits in at_joints.items() if name != cause]
    return [mean, ordered[:, -1], ordered[:, -2], ordered[:, -1] - mean, np.max(others, axis=0, initial=NOTHING)]
