"""Causes with probability and evidence, from a log of the bus.

Bayes' rule over the causes of `causes`, over a healthy bus (`none`) and over something that none of them describes
(`unknown`): each mark multiplies in its density under the cause, bounded below so that no single mark can rule a cause
out, and the sum is tempered since marks are not independent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from openant_tools.comms.dropouts.causes import CAUSES, OTHERWISE, DropoutCause, Spread, separating_test
from openant_tools.comms.dropouts.episodes import cables
from openant_tools.comms.dropouts.log import read_log
from openant_tools.comms.dropouts.measures import Measures, measure
from openant_tools.numbers import number, percent
from openant_tools.recording.run import Run

__all__ = ["SCHEMA", "DropoutDiagnosis", "Suspect", "Why", "diagnose_dropouts"]

SCHEMA = "openant.dropouts/1"
#: share of the uniform density in every density: no mark says more against a cause than its logarithm
FLOOR = 0.04
#: marks are less than independent: log likelihoods are divided by it
TEMPER = 1.6
#: a cause is named from this probability on; below, the answer is `unknown`
NAMED = 0.34
#: two causes tie where the second has more than this share of the first
TIE = 0.4

#: marks that do not come from losses
_OF_TIME = frozenset({"stall", "comb", "stairs"})
#: marks that stand for themselves: no other repeats what they say
_DECISIVE = frozenset({"stall", "comb", "stairs", "port", "late", "reset", "empty"})
#: marks of what was going on when losses began, of which a robot that is hardly ever heard tells little
_OF_MOMENTS = frozenset({"dip", "sag", "angle", "load", "low", "motion"})
#: lossy reads that say whom losses concern
ENOUGH = 6

_HEALTHY = DropoutCause(
    "nothing wrong", "", "", (0.78, 0.2197, 0.0003),
    {"all": 0.25, "behind": 0.05, "one": 0.4, "pair": 0.1, "scattered": 0.2},
    {"stall": (0.35, 12.0), "rate": (0.3, 60.0)}, prior=8.0,
)  # fmt: skip
_UNKNOWN = DropoutCause(
    "something else", "", "", (0.002, 0.05, 0.95),
    {"all": 0.3, "behind": 0.15, "one": 0.3, "pair": 0.1, "scattered": 0.15},
    {"crc": (1.0, 1.0), "late": (0.5, 2.5), "dip": (0.5, 3.5), "reset": (0.5, 4.0), "angle": (0.7, 2.5),
     "load": (0.7, 2.5), "low": (0.7, 2.5), "motion": (0.8, 2.5), "stall": (0.5, 3.5), "host": (0.5, 3.5), "gap": (0.6, 2.5),
     "comb": (0.4, 6.0), "stairs": (0.4, 6.0), "port": (0.35, 10.0)}, prior=0.5,
)  # fmt: skip


@dataclass(frozen=True)
class Why:
    """One piece of evidence: what was seen, and how much it speaks for the cause (nats; below zero against it)."""

    words: str
    nats: float


@dataclass(frozen=True)
class Suspect:
    """One cause as it stands after the evidence.

    Attributes:
        where: joints, or one of "all", "supply", "host", "adapter".
        evidence: what speaks for it first.
    """

    cause: str
    where: tuple[str, ...]
    probability: float
    evidence: tuple[Why, ...]
    next_test: str
    remedy: str


@dataclass(frozen=True)
class DropoutDiagnosis:
    """What is wrong with the bus.

    Attributes:
        verdict: a cause, `none` or `unknown`.
        suspects: all causes, best first. healthy, unknown: probability of either.
        next_test: what to do now; "" where nothing is wrong.
        tied: the causes that the log cannot tell apart, the verdict among them.
        what: one sentence.
    """

    verdict: str
    suspects: tuple[Suspect, ...]
    healthy: float
    unknown: float
    next_test: str
    tied: tuple[str, ...]
    what: str
    measures: Measures

    @property
    def healthy_bus(self) -> bool:
        return self.verdict == "none"

    def as_json(self) -> dict[str, Any]:
        """As `openant comms diagnose --json` writes it (formats, section 6)."""
        log, m = self.measures.log, self.measures
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "what": self.what,
            "causes": [
                {
                    "cause": one.cause,
                    "where": list(one.where),
                    "probability": round(one.probability, 4),
                    "evidence": [why.words for why in one.evidence],
                    "nats": [round(why.nats, 2) for why in one.evidence],
                    "next_test": one.next_test,
                    "remedy": one.remedy,
                }
                for one in self.suspects
            ],
            "none": round(self.healthy, 4),
            "unknown": round(self.unknown, 4),
            "tied": list(self.tied),
            "next_test": self.next_test or None,
            "runs": list(log.names),
            "seconds": round(log.seconds, 3),
            "reads": len(log.t),
            "lost": {joint: int(count) for joint, count in zip(log.joints, log.lost.sum(axis=0), strict=True)},
            "loss": {
                joint: float(count / max(1, asked))
                for joint, count, asked in zip(log.joints, log.lost.sum(axis=0), log.answers, strict=True)
            },
            "marks": {name: {"value": round(one.value, 4), "words": one.words} for name, one in m.marks.items()},
            "episodes": [
                {
                    "from_s": round(one.from_s, 4), "to_s": round(one.to_s, 4), "reads": one.stop - one.start,
                    "joints": [log.joints[k] for k in one.joints], "how": list(one.words),
                }
                for one in m.episodes[:LISTED]
            ],
            "episodes_in_all": len(m.episodes),
        }  # fmt: skip


#: episodes written out; a noisy hour has thousands
LISTED = 200


def diagnose_dropouts(runs: Sequence[Run]) -> DropoutDiagnosis:
    """Find out what loses the communication in these recordings of one robot.

    Args:
        runs: recordings or tables, whatever of the columns of formats, section 1, they have; runs at several baud
            rates tell noise from other causes.

    Raises:
        BadInput: nothing in them tells of the bus.
    """
    return judge(measure(read_log(runs)))


def judge(measures: Measures) -> DropoutDiagnosis:
    """The diagnosis of what was measured."""
    everything: dict[str, DropoutCause] = {**CAUSES, "none": _HEALTHY, "unknown": _UNKNOWN}
    terms = {name: _terms(cause, measures) for name, cause in everything.items()}
    logs = {name: math.log(cause.prior) + sum(terms[name].values()) / TEMPER for name, cause in everything.items()}
    top = max(logs.values())
    total = sum(math.exp(value - top) for value in logs.values())
    probability = {name: math.exp(value - top) / total for name, value in logs.items()}
    ranked = sorted(CAUSES, key=lambda name: -probability[name])
    where = {name: _where(name, measures) for name in ranked}
    who = {name: _who(where[name], measures) for name in ranked}
    suspects = tuple(_suspect(name, where[name], who[name], probability, terms, measures) for name in ranked)
    best = ranked[0]
    verdict = "none" if probability["none"] >= max(0.5, probability[best]) else best
    if verdict != "none" and (probability[best] < NAMED or probability["unknown"] > probability[best]):
        verdict = "unknown"
    rivals = [name for name in ranked[1:] if probability[name] > TIE * probability[best]]
    tied = (best, *rivals) if rivals and verdict not in ("none", "unknown") else ()
    next_test = ""
    if verdict == "unknown":
        next_test = separating_test(best, ranked[1], who)
    elif verdict != "none":
        next_test = separating_test(best, rivals[0], who) if rivals else suspects[0].next_test
    return DropoutDiagnosis(
        verdict=verdict,
        suspects=suspects,
        healthy=probability["none"],
        unknown=probability["unknown"],
        next_test=next_test,
        tied=tied,
        what=_sentence(verdict, suspects[0], measures, tied),
        measures=measures,
    )


def _density(value: float, spread: Spread) -> float:
    """Log of the Beta density at a mark, away from the ends, where it may be infinite, and above a floor."""
    x, (a, b) = min(0.985, max(0.015, value)), spread
    # As `scipy.stats.beta.pdf`, which takes a second to load and a hundred times as long for each number.
    size = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    density = math.exp(size + (a - 1) * math.log(x) + (b - 1) * math.log1p(-x))
    return math.log(FLOOR + (1 - FLOOR) * density)


def _terms(cause: DropoutCause, measures: Measures) -> dict[str, float]:
    """Mark → log likelihood under a cause."""
    kinds = ("no", "stray", "yes")
    terms = {"losses": math.log(cause.losses[kinds.index(measures.losses)])}
    lossy = measures.losses == "yes"
    silent = float(measures.log.lost.all(axis=1).mean())
    if lossy:
        reach = measures.reach
        share = cause.reach[reach.kind]
        if reach.tied is not None:
            share = 0.75 * share + 0.25 * cause.reach[reach.tied]
        # A few losses say little of whom they concern; one that goes on says it again and again.
        few = min(1.0, sum(min(one.stop - one.start, ENOUGH) for one in measures.episodes) / ENOUGH)
        terms["reach"] = TEMPER * few * math.log(share)
    for name, seen in measures.marks.items():
        if not lossy and name not in _OF_TIME:
            continue  # a few losses that any bus has say nothing of what else is wrong
        terms[name] = _density(seen.value, cause.marks.get(name, OTHERWISE[name]))
        if name == "load" and "low" in measures.marks:
            terms[name] *= 0.4  # the supply says the same, and better
        if name in _DECISIVE:
            terms[name] *= TEMPER
        if name in _OF_MOMENTS:
            terms[name] *= 1 - silent
        if name in ("angle", "load", "low", "motion", "single", "together", "dip", "crc"):
            terms[name] *= len(measures.episodes) / (len(measures.episodes) + 4)
    return terms


def _suspect(
    name: str,
    where: tuple[str, ...],
    who: str,
    probability: Mapping[str, float],
    terms: Mapping[str, Mapping[str, float]],
    measures: Measures,
) -> Suspect:
    cause = CAUSES[name]
    why = []
    for mark, own in terms[name].items():
        rest = [math.log(max(probability[other], 1e-6)) + terms[other][mark] for other in terms if other != name]
        weights = [math.log(max(probability[other], 1e-6)) for other in terms if other != name]
        others = _log_sum(rest) - _log_sum(weights)
        nats = (own - others) / TEMPER
        if abs(nats) >= 0.4:
            why.append(Why(_words(mark, measures), nats))
    why.sort(key=lambda one: -one.nats)
    test, remedy = cause.test.format(who=who), cause.remedy.format(who=who)
    return Suspect(name, where, probability[name], tuple(why), test, remedy)


def _log_sum(values: Sequence[float]) -> float:
    top = max(values)
    return top + math.log(sum(math.exp(value - top) for value in values))


def _words(mark: str, measures: Measures) -> str:
    if mark == "losses":
        lost, asked = int(measures.log.lost.sum()), int(measures.log.answers.sum())
        return f"{lost} of {asked} answers lost" if lost else f"none of {asked} answers lost"
    if mark == "reach":
        reach, log = measures.reach, measures.log
        names = ", ".join(log.joints[k] for k in reach.joints)
        return {
            "all": "all servos are concerned",
            "behind": f"all that hang behind one place of a cable: {names}",
            "one": f"only {names} is concerned",
            "pair": f"two servos are concerned: {names}",
            "scattered": f"{names} are concerned, which no cable joins",
        }[reach.kind]
    return measures.marks[mark].words


def _where(name: str, measures: Measures) -> tuple[str, ...]:
    log, reach = measures.log, measures.reach
    if name in ("host_stall",):
        return ("host",)
    if name in ("latency_timer", "usb_unplug"):
        return ("adapter",)
    if name == "supply_weak":
        return ("supply",)
    if name == "return_delay":
        joints = measures.at.get("stairs", ())
        return ("all",) if len(joints) in (0, len(log.joints)) else tuple(log.joints[k] for k in joints)
    if name in ("line_noise", "write_read_gap"):
        return ("all",)
    concerned = reach.joints
    if name == "power_connector":
        return ("all",) if reach.kind == "all" or not concerned else tuple(log.joints[k] for k in concerned)
    if name == "broken_wire" and measures.at.get("angle"):
        bent = measures.at["angle"][0]
        # Behind a joint's wire hang others: the wire is the one before the first of them, or over the joint that bends.
        return (log.joints[bent],) if bent in concerned or not concerned else (log.joints[_first(measures)],)
    if name in ("bad_cable", "broken_wire") and concerned:
        return (log.joints[_first(measures)],)
    if name == "bad_servo" and concerned:
        worst = max(concerned, key=lambda k: reach.rate[k])
        return (log.joints[worst],)
    if name == "duplicate_id" and concerned:
        worst_two = sorted(concerned, key=lambda k: -reach.rate[k])[:2]
        return tuple(log.joints[k] for k in sorted(worst_two))
    return tuple(log.joints[k] for k in concerned)


def _who(where: Sequence[str], measures: Measures) -> str:
    """The servos of a place, each with its id where the log knows it."""
    ids = measures.log.ids
    names = [f"{joint} (id {ids[joint]})" if joint in ids else joint for joint in where if joint in measures.log.joints]
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names) or "every servo"


def _first(measures: Measures) -> int:
    """Of those concerned, the one nearest to the adapter."""
    concerned = measures.reach.joints
    for cable in cables(measures.log):
        for k in cable:
            if k in concerned:
                return k
    return concerned[0]


def _sentence(verdict: str, best: Suspect, measures: Measures, tied: Sequence[str]) -> str:
    log = measures.log
    lost, asked = int(log.lost.sum()), int(log.answers.sum())
    count = f"{lost} of {asked} answers lost in {number(log.seconds, 's', decimals=0)}"
    if verdict == "none":
        return f"{count}: nothing is wrong with the bus"
    if verdict == "unknown":
        return f"{count}: the log does not tell why"
    place = (
        "" if best.where[:1] in ((), ("all",), ("host",), ("adapter",), ("supply",)) else f" at {', '.join(best.where)}"
    )
    words = f"{count}: {CAUSES[best.cause].words}{place} ({percent(best.probability)})"
    return words + (f", or {CAUSES[tied[1]].words}" if len(tied) > 1 else "")
