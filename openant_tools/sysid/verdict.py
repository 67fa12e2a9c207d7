"""What the data say about a parameter, in one word, and what to record where they say too little."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from openant_tools.sysid.estimate import Estimate

__all__ = ["SILENT", "Verdict", "Word", "experiment", "verdicts"]

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

#: what separates two kinds, by what moves one of them and not the other
_APART: dict[frozenset[str], str] = {
    frozenset(pair.split()): words
    for pair, words in {
        "velocity_gain damping": "`drops` or `saturating-steps`: without torque, or at its limit, only damping brakes",
        "velocity_gain electrical_damping": "`drops` or `saturating-steps`: without torque both vanish, at its limit one",
        "damping electrical_damping": "`releases` or `drops`: without torque only the mechanical share brakes",
        "action_delay actuator_lag": "`steps` and `square`: a delay shifts an edge, a lag rounds it",
        "action_delay damping": "`chirp` and `steps`: a delay grows with frequency where damping does not",
        "action_delay velocity_gain": "`chirp` and `steps`: a delay grows with frequency where damping does not",
        "action_delay armature": "`steps`: inertia shows in the overshoot, a delay in the start",
        "armature damping": "`chirp`: inertia rules above the resonance, damping at it",
        "stiffness zero_offset": "`long-holds` in poses on both sides of the vertical",
        "stiffness link_mass": "`long-holds` with a known mass on the foot, or `openant sysid scale`",
        "stiffness torque_limit": "`saturating-steps`: only there the limit shows",
        "stiffness coulomb_friction": "`holds` and `slow-reversals`: poses that are reached from both sides",
        "coulomb_friction damping": "`slow-reversals` beside `chirp`: dry friction stays where damping fades",
        "coulomb_friction load_friction": "`slow-reversals` in loaded and in hanging poses",
        "torso_mass link_mass": "`drops` on the stand, where the torso is held",
        "torque_limit speed_limit": "`saturating-steps`: slow ones stop at the torque limit, long ones at the speed limit",
    }.items()
}
#: what shows a kind best
_SHOWS = {
    "stiffness": "`long-holds`",
    "zero_offset": "`long-holds`; a joint with a vertical axis shows its zero only with the robot tilted",
    "link_mass": "`drops` and `long-holds`",
    "torso_mass": "`full`, on the floor",
    "damping": "`chirp`",
    "velocity_gain": "`chirp`",
    "armature": "`chirp`",
    "coulomb_friction": "`slow-reversals`",
    "load_friction": "`slow-reversals` in loaded poses",
    "electrical_damping": "`releases` and `drops`",
    "action_delay": "`steps`",
    "actuator_lag": "`steps` and `square`",
    "torque_limit": "`saturating-steps`",
    "speed_limit": "`saturating-steps`",
    "floor_friction": "`full`, on the floor",
    "contact_softness": "`full`, on the floor",
    "contact_impedance": "`full`, on the floor",
}


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
    covariance = np.linalg.inv(estimate.precision + np.diag(estimate.prior_precision))
    deviation = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(deviation, deviation)
    out = []
    for k, information in enumerate(estimate.information):
        other = _partner(correlation[k], k, deviation[k])
        word: Word
        if not kept[k]:
            word, other = "fell back", None
        elif information >= IDENTIFIED:
            word, other = "conflict" if estimate.contradicts[k] else "identified", None
        elif other is not None:
            word = "tied"
        else:
            word = "weak" if information >= NOT_IN_THE_DATA else "not in the data"
        out.append(Verdict(word, other, bool(estimate.contradictory[k])))
    return out


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
    if other is not None and (words := _APART.get(frozenset((kind, other)))):
        return words
    shown = [_SHOWS[each] for each in dict.fromkeys((kind, other)) if each in _SHOWS]
    return " and ".join(dict.fromkeys(shown))
