"""The verdict on a robot of one or two joints: real servos have several causes at once, and there all can be fitted together."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.closure import Windows
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED, Diagnosis
from openant_tools.gap.explain import Explained, Part
from openant_tools.gap.judge import Judgement
from openant_tools.gap.late import late_velocity
from openant_tools.gap.patient import Patient, diagnosis_of, found_of, unfitted
from openant_tools.gap.sets import SetFits, choose, motions_of
from openant_tools.gap.thresholds import ADDS, ADDS_ALONE, EXPLAINS, FINDING, LARGE, ODD, SURELY, TOGETHER
from openant_tools.model.gap import excess

__all__ = ["decide_together"]


def decide_together(
    patient: Patient, judgement: Judgement, ranked: Sequence[tuple[str, float]], explained: dict[str, Explained]
) -> Diagnosis:
    """Real servos have several causes at once: where all can be fitted together they are, and what can be spared goes."""
    windows = Windows(patient.protocol)
    fits = SetFits(windows, patient.training, patient.held_out)
    probability = dict(ranked)
    late = _late_register(patient)
    moving = [name for name in explained if not catalogue()[name].unseen_in_joints]
    if late is not None:
        # What the log itself shows needs no fit to positions, and none may make something else of it.
        moving = [name for name in moving if name != late[0].part.cause]
    seen = {signal for one in patient.protocol.runs for signal in one.seen}
    witnessed = {name for name in moving if catalogue()[name].witness in seen and probability[name] > FINDING}
    parts, starts = [explained[name].part for name in moving], [explained[name].x for name in moving]
    choice = choose(fits, parts, starts, probability, witnessed)
    chosen, floor = choice.chosen, float(np.sqrt(np.mean(windows.floor**2)))
    notes = []
    if late is not None:
        explained, probability = (
            {**explained, late[0].part.cause: late[0]},
            {**probability, late[0].part.cause: late[1]},
        )
    beside = []
    for name, one in explained.items():
        if name in chosen.names or probability[name] < FINDING:
            continue
        shares = sorted(fits.by_signal(chosen.refit, one.part, one.x).items(), key=lambda item: -item[1])
        if shares and shares[0][1] > ADDS:
            beside.append(name)
            notes.append(f"{name} moves no joint and closes {100 * shares[0][1]:.0f} % of the gap of {shares[0][0]}")
    likely = max((probability[name] for name in chosen.names), default=0.0)
    gained = chosen.closed - choice.nothing.closed
    sure = likely > FINDING or (judgement.energy > 1 and gained > ADDS_ALONE and chosen.closed > EXPLAINS)
    selected = (*(choice.removal if sure else ()), *beside)
    ambiguous: tuple[tuple[str, ...], ...] = ()
    one_motion = len(motions_of(patient.protocol, range(len(patient.protocol.runs)))) == 1
    if not selected:
        verdict = NONE if judgement.energy < ODD else UNEXPLAINED
    elif selected[0] in beside:
        verdict = selected[0]
    elif excess(chosen.before, floor) > LARGE * floor and min(chosen.closed - EXPLAINS, chosen.worst) < 0:
        verdict, selected = UNEXPLAINED, ()
    elif one_motion or choice.open:
        others = choice.rival.names if choice.rival is not None else ()
        likeliest = [name for name, _ in ranked if name in moving]
        group = dict.fromkeys((selected[0], *(name for name in (*others, *likeliest) if name not in chosen.names)))
        verdict, ambiguous = AMBIGUOUS, (tuple(group)[:TOGETHER],)
        declared = None if one_motion else patient.declared(ambiguous[0])
        if declared is not None and choice.rival is not None and declared in choice.rival.names:
            chosen = choice.rival
            selected = (declared, *(name for name in chosen.names if name != declared), *beside)
        if declared in selected[:1]:
            verdict = selected[0]
        if one_motion:
            notes.append("one kind of motion alone: what fits it may fit no other")
    else:
        verdict = selected[0]
    order = [
        *selected,
        *sorted((name for name in explained if name not in selected), key=lambda name: -probability[name]),
    ]
    effects = []
    for name in order:
        one, alone = explained[name], choice.alone.get(name)
        if alone is None:
            effects.append(found_of(patient, one, probability[name], None))
            continue
        fitted = chosen if name in chosen.names else alone
        one = dataclasses.replace(one, x=fitted.point(name), std=fitted.spread(name))
        effects.append(
            found_of(patient, one, probability[name], dataclasses.replace(alone.closure, refit=fitted.refit))
        )
    gap = {
        "before": chosen.before, "after": chosen.before if verdict == NONE else chosen.after, "floor": floor,
        "refit": choice.nothing.after,
    }  # fmt: skip
    folds = ", ".join(f"{name} {100 * share:.0f} %" for name, share in chosen.folds.items())
    # What the removal of each costs is known of the set that explains most, not of one that was declared in its place.
    removal = choice.removal if chosen is choice.chosen else {}
    confidence = 1 - likely if verdict == NONE else max((probability[name] for name in selected[:1]), default=likely)
    return diagnosis_of(
        patient, verdict, confidence, (*effects, *unfitted(ranked, order)), selected, ambiguous, gap,
        {name: removal[name] for name in selected if name in removal}, judgement,
        None if verdict == NONE else (windows, chosen.refit), [f"closed where left out: {folds}", *notes],
    )  # fmt: skip


def _late_register(patient: Patient) -> tuple[Explained, float] | None:
    """A velocity register that is late by the log's own word, with the probability that it is so beyond tolerance."""
    joints = patient.protocol.joints
    late = late_velocity([one.run for one in patient.protocol.runs], joints)
    cause = catalogue()["sensor_delay"]
    least = next(q.small for q in cause.quantities if q.name == "vel")
    if late is None or late.beyond(least) < FINDING:
        return None
    x, std = (
        {q.name: value if q.name == "vel" else 0.0 for q in cause.quantities} for value in (late.delay_s, late.std_s)
    )
    return Explained(Part(cause.name, tuple(range(len(joints)))), x, std, math.nan), min(late.beyond(least), SURELY)
