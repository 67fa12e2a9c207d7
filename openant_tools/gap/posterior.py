"""What the evidence comes to: how likely nothing, each cause, or something that no catalogue has leads the gap.

A pure function of the rows of evidence and the classifier's log-odds, with ten weights that were learned with it
(benchmarks/gap_training): a softmax over "none", "outside" and every cause. Which cause leads is one question, so that what a second
cause adds is asked of the odds themselves, which are one for each cause.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.evidence import COLUMN_NAMES
from openant_tools.gap.features import Floats

__all__ = ["COLUMNS", "NONE", "OUTSIDE", "WEIGHTS", "features_of", "log_posterior"]

Array = NDArray[np.float64]

#: the first columns of a posterior; after them the causes
NONE, OUTSIDE = 0, 1
#: columns of evidence that the choice between causes looks at beside their odds
COLUMNS = ("gain share", "folds gained", "share")
#: the weights by their names, see `log_posterior`
WEIGHTS = (
    "none", "none: size", "none: odds", "outside", "outside: left", "outside: odds", "outside: gain share", "outside: size",
    "odds", *COLUMNS,
)  # fmt: skip


@dataclass(frozen=True)
class Features:
    """What the posterior looks at.

    Attributes:
        odds: (robots, causes). causes: (robots, causes, COLUMNS). size: (robots,) log10 of the residual's, 0 as healthy ones have.
        left: (robots,) the same once the best cause is taken out.
    """

    odds: Array
    causes: Array
    size: Array
    left: Array


def features_of(rows: Floats, odds: Floats) -> Features:
    """From evidence (robots, causes, columns) and log-odds (robots, causes)."""
    at = {name: n for n, name in enumerate(COLUMN_NAMES)}
    return Features(
        odds.astype(np.float64),
        rows[:, :, [at[name] for name in COLUMNS]].astype(np.float64),
        rows[:, 0, at["size"]].astype(np.float64),
        rows[:, 0, at["left after 1"]].astype(np.float64),
    )


def log_posterior(x: Features, weights: Mapping[str, float]) -> Array:
    """(robots, 2 + causes) logarithms of probabilities: none, outside, and each cause."""
    w = weights
    best = x.odds.argmax(axis=1)
    most = x.odds.max(axis=1)
    gain = x.causes[np.arange(len(best)), best, COLUMNS.index("gain share")]
    none = w["none"] + w["none: size"] * x.size + w["none: odds"] * most
    outside = (
        w["outside"] + w["outside: left"] * x.left + w["outside: odds"] * most + w["outside: gain share"] * gain
        + w["outside: size"] * x.size
    )  # fmt: skip
    causes = w["odds"] * x.odds + x.causes @ np.array([w[name] for name in COLUMNS])
    logits = np.column_stack([none, outside, causes])
    out: Array = logits - np.logaddexp.reduce(logits, axis=1, keepdims=True)
    return out
