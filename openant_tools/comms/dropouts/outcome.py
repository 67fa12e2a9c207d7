"""What a diagnosis of the bus leaves behind: a finding for the robot's folder, and effects that the gap knows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from openant_tools.comms.dropouts.causes import CAUSES
from openant_tools.comms.dropouts.diagnose import DropoutDiagnosis
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.intervals import wilson

__all__ = ["dropout_effects", "dropouts_finding", "effects_toml"]

#: name of the step, and of its files in `findings/`
STEP = "comms"
#: causes that keep a command from a servo as they keep its answer from the host; the others lose answers alone, or only
#: delay them
_BOTH_WAYS = frozenset(
    {
        "power_connector", "supply_weak", "broken_wire", "bad_servo", "bad_cable", "line_noise", "usb_unplug",
        "duplicate_id", "unknown",
    }
)  # fmt: skip
#: share of lost commands below which a simulation needs none
WORTH_SIMULATING = 1e-3
#: mark → unit-free share; those with a physical unit are said in words
_SHOWN = 6


def dropouts_finding(
    found: DropoutDiagnosis, recordings: Sequence[str], command: str = "openant comms diagnose"
) -> Finding:
    """The finding of the walk's bus step: yes where nothing is wrong.

    Args:
        recordings: what it was found in, as paths that the finding names.
    """
    log = found.measures.log
    source = ", ".join(recordings)
    asked, lost = int(log.answers.sum()), int(log.lost.sum())
    low, high = wilson(lost, asked)
    evidence = [
        Evidence("time watched", round(log.seconds, 3), "s", source),
        Evidence("answers asked for", float(asked), "", source),
        Evidence("share lost", lost / asked if asked else None, "share", source, low, high),
    ]
    last = np.nanmax(np.where(np.isfinite(log.rtt), log.rtt, -np.inf), axis=1)
    last = last[np.isfinite(last)]
    if len(last):
        evidence.append(Evidence("round trip, median", float(np.median(last)), "s", source))
        evidence.append(Evidence("round trip, 99 of 100", float(np.quantile(last, 0.99)), "s", source))
    wake = log.wake[np.isfinite(log.wake)]
    if len(wake):
        evidence.append(Evidence("loop late, 99 of 100", float(np.quantile(wake, 0.99)), "s", source))
    best = found.suspects[0]
    if not found.healthy_bus:
        evidence.append(
            Evidence(f"probability of {CAUSES[best.cause].words}", best.probability, "share", "openant comms diagnose")
        )
    remedy = "" if found.verdict in ("none", "unknown") else best.remedy
    steps = [words for words in (remedy, found.next_test) if words]
    marks = tuple(why.words for why in best.evidence if why.nats > 0)[:_SHOWN]
    return Finding(
        step=STEP,
        ok=found.healthy_bus,
        what=found.what,
        evidence=tuple(evidence),
        next_action="; to make sure: ".join(steps),
        command=command,
        data={"diagnosis": found.as_json()},
        problems=() if found.healthy_bus else marks or (found.what,),
    )


def dropout_effects(found: DropoutDiagnosis) -> list[dict[str, Any]]:
    """`command_dropout` of the catalogue as this bus would give it to a simulation; [] where nothing worth it is lost.

    A read that was lost on its way there or back says nothing of which way; both are as long, so half of what comes to
    nothing is taken for the way there. Outages of supply, cable and plug cut both ways. Servos that lose alike share an
    entry.
    """
    if found.verdict not in _BOTH_WAYS:
        return []
    log, reach = found.measures.log, found.measures.reach
    whole = found.verdict in ("power_connector", "supply_weak", "usb_unplug", "broken_wire", "duplicate_id")
    entries: dict[tuple[float, float], list[str]] = {}
    for k, joint in enumerate(log.joints):
        lost = reach.lost[:, k]
        fraction = float(f"{reach.rate[k] * (1.0 if whole else 0.5):.2g}")  # for a file
        if fraction < WORTH_SIMULATING:
            continue
        edges = np.flatnonzero(np.diff(np.r_[False, lost, False].astype(np.int8)))
        runs = edges[1::2] - edges[::2]
        # One stray outage must not stand for all: the length that 95 of 100 lost reads lie within.
        lengths = np.sort(runs)
        longest = int(lengths[np.searchsorted(np.cumsum(lengths), 0.95 * lengths.sum())])
        entries.setdefault((fraction, float(f"{longest * log.period_s:.2g}")), []).append(joint)  # for a file
    return [
        {
            "effect": "command_dropout",
            "joints": "all" if len(joints) == len(log.joints) else joints,
            "parameters": {"fraction": fraction, "longest_s": longest},
            "enabled": True,
        }
        for (fraction, longest), joints in entries.items()
    ]


def effects_toml(found: DropoutDiagnosis) -> str:
    """The same as a file of effects (formats, section 4)."""
    import tomlkit

    return tomlkit.dumps({"effect": dropout_effects(found)})
