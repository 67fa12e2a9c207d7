"""Two soaks side by side: with and without heat sink, two motors, two dates, this robot and the paper's.

Temperatures of two soaks differ by their rooms and loads. What is compared is where each servo would settle under one and the
same torque in one and the same room: that is what a heat sink changes. Draws of both fits are subtracted, so that the
interval holds what either does not know.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.intervals import Interval
from openant_tools.thermal.fit import Fit
from openant_tools.thermal.forecast import HeatForecast, forecast, present_load, settled, torque_load

__all__ = ["PAPER", "ROOM_C", "AgainstPaper", "JointDifference", "Paper", "against_paper", "compare"]

Array = NDArray[np.float64]

#: °C of the room in which both are imagined.
ROOM_C = 25.0
#: draws of the fitted parameters: a 95 % bound then errs by a tenth of a standard deviation
DRAWS = 800


@dataclass(frozen=True)
class JointDifference:
    """One joint in both.

    Attributes:
        torque_nm: the torque at which both are imagined: what A held.
        a_c, b_c: where each settles under it in a room of 25 °C. difference_k: b − a.
        time_constant_s: of the case, b − a.
    """

    joint: str
    torque_nm: float
    a_c: Interval
    b_c: Interval
    difference_k: Interval
    time_constant_s: Interval

    @property
    def certain(self) -> bool:
        """Whether the difference's interval leaves zero out."""
        return self.difference_k.low > 0 or self.difference_k.high < 0

    def as_json(self) -> dict[str, Any]:
        return {
            name: value.as_json() if isinstance(value, Interval) else value for name, value in vars(self).items()
        } | {"certain": self.certain}


def compare(a: Fit, b: Fit, *, joints: Mapping[str, str] | None = None) -> list[JointDifference]:
    """B against A at the torques that A held.

    Args:
        joints: A's joint → B's, where two motors of one robot are compared; None for equal names.

    Raises:
        BadInput: no joint in common whose load was recorded in both.
    """
    pairs = dict(joints or {joint: joint for joint in a.inputs.joints if joint in b.inputs.joints})
    held = _held_torques(a)
    out = []
    for one, other in pairs.items():
        for found, joint in ((a, one), (b, other)):
            if joint not in found.inputs.joints:
                raise BadInput(f"{found.inputs.name} has no joint {joint!r}")
        if one not in held or b.inputs.source[b.inputs.joints.index(other)] == "unknown":
            continue
        torque = held[one]
        end_a, end_b = (
            settled(found, torque_load(found, {joint: torque}), ROOM_C, DRAWS, seed)[
                :, found.inputs.joints.index(joint)
            ]
            for seed, (found, joint) in enumerate(((a, one), (b, other)))
        )
        tau_a, tau_b = _time_constant(a, one, 0), _time_constant(b, other, 1)
        out.append(
            JointDifference(
                one if one == other else f"{one} / {other}",
                torque,
                Interval.of(end_a),
                Interval.of(end_b),
                Interval.of(end_b - end_a),
                Interval.of(tau_b - tau_a),
            )
        )
    if not out:
        raise BadInput(
            f"{a.inputs.name} and {b.inputs.name} have no joint in common whose load was recorded",
            remedy="soak both with `openant thermal soak`",
        )
    return out


def _held_torques(found: Fit) -> dict[str, float]:
    """Joint → root mean square torque (N·m) over the time under load."""
    load = present_load(found, whole=True)
    out = {}
    for k, joint in enumerate(found.inputs.joints):
        model = found.inputs.models[k]
        if model is None or found.inputs.source[k] == "unknown":
            continue
        square = load.current[:, k]
        under = square[square > 0.2 * square.max(initial=0.0)]
        out[joint] = float(model.kt_nm_a * np.sqrt(under.mean())) if len(under) else 0.0
    return out


def _time_constant(found: Fit, joint: str, seed: int) -> Array:
    """(b,) s, heat capacity of winding and case over what the air takes."""
    k = found.inputs.joints.index(joint)
    servos = found.variants(DRAWS, seed).servos
    return np.asarray((servos.case_j_k + servos.winding_j_k)[:, k] / servos.air_w_k[:, k])


@dataclass(frozen=True)
class Paper:
    """What the Open Ant paper's stress test tells of one kit: stalled under a weight, a downward torque all the time.

    Attributes:
        shutdown_s: when its first knee shut down, None where none did.
        peak_c: how warm its knees became, without and with heat sinks.
    """

    words: str
    shutdown_s: float | None
    limit_c: float


#: servo model of the knees → the paper's test (appendix on heat; facts/robot, section 8)
PAPER: Mapping[str, Paper] = {
    "XL430-W250-T": Paper(
        "a Lite's knee shuts down at 72 °C after about 30 min; heat sinks help it little", 1800.0, 72.0
    ),
    "XM430-W350-T": Paper("knees touch their 80 °C limit without heat sinks and stay below it with them", None, 80.0),
}


@dataclass(frozen=True)
class AgainstPaper:
    """This robot's warmest knee under its own load from a cold start, less the paper's.

    Attributes:
        later_s: how much later it shuts down; None where the paper's did not, or this one is not expected to.
        above_limit_k: where it would settle, were there no limit, less the limit that the paper's knees touched.
        paper: the test of the same knees. told: what comes of this robot's load.
    """

    joint: str
    later_s: Interval | None
    above_limit_k: Interval
    words: str
    paper: Paper
    told: HeatForecast

    def as_json(self) -> dict[str, Any]:
        return {
            "paper": self.words,
            "joint": self.joint,
            "later_s": None if self.later_s is None else self.later_s.as_json(),
            "above_limit_k": self.above_limit_k.as_json(),
        }


def against_paper(found: Fit) -> AgainstPaper:
    """This robot under its own load from a cold start, beside the paper's robot of the same knees.

    Raises:
        BadInput: the paper tested no such servo.
    """
    knees = [k for k, joint in enumerate(found.inputs.joints) if joint.startswith("knee")]
    names = {model.name for k in knees if (model := found.inputs.models[k]) is not None}
    known = names & set(PAPER)
    if len(known) != 1:
        raise BadInput(
            f"the paper tested no robot with knees of {', '.join(sorted(names)) or 'an unknown model'}",
            where=found.inputs.name,
            remedy=f"it has curves for {', '.join(PAPER)}",
        )
    paper = PAPER[known.pop()]
    told = forecast(found, present_load(found, whole=True), from_cold=True, torques=False)
    worst = max((told.joints[k] for k in knees), key=lambda one: (one.probability, one.settles_c.value))
    here = f"here, from a cold start, {worst.words}"
    above = _less(worst.settles_c, paper.limit_c)
    settles = (
        f"settling {number(above.value, 'K', above.low, above.high, sign=True)} from {number(paper.limit_c, '°C')}"
    )
    when = worst.seconds_to_limit
    if paper.shutdown_s is None or when is None:
        verdict = "" if paper.shutdown_s is None else ": it stays cooler than the paper's"
        words = f"Paper: {paper.words}. This robot: {here}, {settles}{verdict}."
        return AgainstPaper(worst.joint, None, above, words, paper, told)
    later = _less(when, paper.shutdown_s)
    if later.low > 0:
        verdict = "it lasts longer than the paper's"
    elif later.high < 0:
        verdict = "it gives out sooner than the paper's"
    else:
        verdict = "as the paper's, within the interval"
    span = number(later.value / 60, "min", later.low / 60, later.high / 60, sign=True)
    words = f"Paper: {paper.words}. This robot: {here}, {span} from the paper's: {verdict}."
    return AgainstPaper(worst.joint, later, above, words, paper, told)


def _less(interval: Interval, by: float) -> Interval:
    return Interval(interval.value - by, interval.low - by, interval.high - by)
