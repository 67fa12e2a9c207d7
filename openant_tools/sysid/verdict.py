"""What the data say about a parameter, in one word, and what to record where they say too little."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from openant_tools.sysid.estimate import Estimate, Posterior
from openant_tools.sysid.kinds import KINDS

__all__ = ["SILENT", "TIED", "Verdict", "Word", "experiment", "told", "undetermined", "verdicts"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Word = Literal["identified", "weak", "tied", "conflict", "not in the data", "fell back"]
#: of these a value has no interval: what is written is not what the data say
SILENT: tuple[Word, ...] = ("not in the data", "fell back")

#: share of the posterior precision that must come from the data for a value to be called identified: the interval is
#: then less than half as wide as the prior's
IDENTIFIED = 0.75
#: below this share the data say nothing, and the value stays at its prior
NOT_IN_THE_DATA = 0.1
#: two estimates are tied if they correlate beyond this, and knowing one would make the other identified
TIED = 0.8


@dataclass(frozen=True)
class Verdict:
    """What the data say about one parameter.

    Attributes:
        word: the verdict.
        tied_to: index of the parameter that it cannot be told from, where it is tied.
        contradictory: whether two halves of the data differ about it by more than chance.
    """

    word: Word
    tied_to: int | None = None
    contradictory: bool = False


def verdicts(estimate: Estimate, kept: Bools) -> list[Verdict]:
    """A verdict for each parameter; `kept` are those that stood up to held-out runs."""
    out = []
    for k, (word, other) in enumerate(told(estimate.narrow, estimate.information)):
        if not kept[k]:
            word, other = "fell back", None
        elif word == "identified" and estimate.contradicts[k]:
            word = "conflict"
        out.append(Verdict(word, other, bool(estimate.contradictory[k])))
    return out


def told(covariance: Array, information: Array) -> list[tuple[Word, int | None]]:
    """Of each parameter whether the data tell it, and what it is tied to.

    Args:
        covariance: (parameters, parameters) in prior deviations.
        information: (parameters,) share of the precision that the data give.
    """
    deviation = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(deviation, deviation)
    out: list[tuple[Word, int | None]] = []
    for k, share in enumerate(information):
        other = None if share >= IDENTIFIED else _partner(correlation[k], k, deviation[k])
        if share >= IDENTIFIED:
            out.append(("identified", None))
        elif other is not None:
            out.append(("tied", other))
        else:
            out.append(("weak" if share >= NOT_IN_THE_DATA else "not in the data", None))
    return out


def undetermined(posterior: Posterior) -> Bools:
    """(parameters,) of which the data say nothing."""
    return np.array([word == "not in the data" for word, _ in told(posterior.narrow, posterior.information)], bool)


def _partner(correlation: Array, k: int, deviation: float) -> int | None:
    """The parameter whose value, if it was known, would make this one identified."""
    strength = np.abs(np.delete(correlation, k))
    if not len(strength) or strength.max() < TIED:
        return None
    nearest = int(np.argmax(strength))
    if 1 - deviation**2 * (1 - strength[nearest] ** 2) < IDENTIFIED:
        return None
    return nearest + (nearest >= k)


def experiment(kind: str, other: str | None = None) -> str:
    """What to record so that a kind of parameter is told, or told from another one; empty where nothing is known."""
    asked = [KINDS[name] for name in dict.fromkeys((kind, other)) if name in KINDS]
    if len(asked) == 2:
        one, two = asked
        words = one.told_from.get(two.name) or two.told_from.get(one.name)
        if words:
            return words
    return " and ".join(dict.fromkeys(each.shown_by for each in asked if each.shown_by))
