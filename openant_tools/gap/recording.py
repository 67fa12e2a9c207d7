"""The diagnosis of any recording, at once: nothing is prepared beforehand, and one run of a policy is enough.

In this order: `experiment` (the windows that tell most), `assess` (what each cause would do to them, and what evidence comes to by what
was learned), `explain` (how large the few likeliest would be), `closure` (what they close on folds that they were not fitted to),
`decide`. `gap.diagnose` leaves to it what it cannot do: a single run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.assess import Assessment, assess
from openant_tools.gap.closure import ClosureByJoint, Refit, Windows, calibration_of, closures, nothing, unmoved
from openant_tools.gap.decide import Decision, Row, decide
from openant_tools.gap.diagnosis import Diagnosis, Found, Span
from openant_tools.gap.experiment import Experiment
from openant_tools.gap.explain import Part, bounds_of
from openant_tools.gap.measure import measure
from openant_tools.gap.next import suggestion
from openant_tools.model.of_run import own_model
from openant_tools.recording.run import Run
from openant_tools.sysid.identify import joints_in_common

__all__ = ["diagnose_recording"]

Progress = Callable[[float, str], None]

#: causes that are fitted: as likely as this to lead, and at most so many
SUSPECT, SUSPECTS = 0.03, 3
#: share of the excess gap that what is fitted is foretold to close beyond a re-fit, of what it closes where it was fitted
FORETOLD = 0.5


def diagnose_recording(
    runs: Sequence[Run],
    model: Path,
    joints: Sequence[str] | None = None,
    progress: Progress | None = None,
    notes: Sequence[str] = (),
) -> Diagnosis:
    """Diagnose the gap between a robot and its model by whatever was recorded.

    Args:
        runs: recordings of one robot. joints: default every position servo that all runs command and measure.
        progress: told a share and words. notes: what else the diagnosis says of itself.

    Raises:
        BadInput: too little of them can be simulated.
    """
    tell = progress or (lambda share, words: None)
    wanted = joints_in_common(runs, model, joints)
    made = Experiment.of(runs, model, wanted, [own_model(run) for run in runs])
    tell(0.02, str(made.selection))
    assessment = assess(made.protocol, lambda share, words: tell(0.02 + 0.68 * share, words))
    suspects = [name for name in assessment.ranked()[:SUSPECTS] if assessment.leads[name] > SUSPECT]
    windows = Windows(made.folds)
    judged = list(range(len(made.folds.runs)))
    starts = [
        nothing(windows),
        *(unmoved(windows, (Part(name, assessment.place(name)),), (_size(assessment, name),)) for name in suspects),
    ]
    tell(0.72, "held-out windows")
    before, floor, (plain, *closed) = closures(windows, starts, (), judged)
    tell(0.95, "decision")
    rows = [
        Row((), probability=assessment.none),
        *(_row(name, assessment, one, plain) for name, one in zip(suspects, closed, strict=True)),
    ]
    # What was too unlikely to be fitted is still likelier than nothing.
    rows += [
        Row((name,), (assessment.place(name),), assessment.leads[name])
        for name in assessment.ranked() if name not in suspects
    ]  # fmt: skip
    found = decide(rows, assessment.outside)
    by_name = dict(zip(suspects, closed, strict=True))
    best = by_name.get(found.verdict, plain)
    diagnosis = _diagnosis(made, model, runs, assessment, found, by_name, best, windows, before, floor)
    return dataclasses.replace(diagnosis, notes=(*diagnosis.notes, *notes))


def _size(assessment: Assessment, name: str) -> Mapping[str, float]:
    """How large a cause would be by its best template's amplitude: where fits start from."""
    evidence = assessment.evidence
    k = int(evidence.places[0, evidence.causes.index(name)])
    _, _, x = evidence.bank[k]
    amplitude = float(evidence.amplitudes[0, evidence.causes.index(name)])
    out = {}
    for q in catalogue()[name].quantities:
        low, high = bounds_of(q)
        out[q.name] = x[q.name] if q.shape else float(np.clip(amplitude * x[q.name], low, high))
    return out


def _row(name: str, assessment: Assessment, one: ClosureByJoint, plain: ClosureByJoint) -> Row:
    effect = catalogue()[name]
    if effect.random or effect.unseen_in_joints:  # what joints' positions hardly show, or no simulation repeats
        return Row((name,), (assessment.place(name),), assessment.leads[name])
    # Both were judged on the same folds: what they have in common does not scatter.
    error = max((one.high - one.low + plain.high - plain.low) / 8, 1e-3)
    place = assessment.place(name)
    return Row(
        (name,),
        (place,),
        assessment.leads[name],
        one.closed - plain.closed,
        error,
        FORETOLD * max(0.0, 1 - plain.closed),
    )


def _diagnosis(
    made: Experiment, model: Path, runs: Sequence[Run], assessment: Assessment, found: Decision,
    closed: Mapping[str, ClosureByJoint], best: ClosureByJoint, windows: Windows, before: float, floor: float,
) -> Diagnosis:  # fmt: skip
    judged = list(range(len(made.folds.runs)))
    selected = tuple(name for row in found.selected for name in row.causes)
    refit = best.refit if selected else Refit((), (), best.refit.nuisance)
    measured = measure([one.run for one in made.folds.runs], model, made.protocol.joints).as_json()
    effects = tuple(_found(made, assessment, name, closed.get(name)) for name in assessment.ranked())
    notes = [
        str(made.selection),
        *(
            f"the {signal} column behaves like none that is known ({times:.1f} times the farthest healthy robot): judged without it"
            for signal, times in assessment.set_aside.items()
        ),
    ]
    return Diagnosis(
        model=str(model),
        runs=tuple(run.name for run in runs),
        held_out=tuple(one.run.name for one in made.folds.runs),
        verdict=found.verdict,
        confidence=found.confidence,
        effects=effects,
        selected=selected,
        ambiguous_with=found.alike,
        next_experiment=suggestion(found.verdict, found.alike, len(runs)),
        gap={
            "before": before,
            "after": best.after if selected else before,
            "floor": floor,
            "signals": measured["signals"],
        },
        where=measured["where"],
        calibration=calibration_of(windows, refit, judged) if selected else {},
        notes=tuple(notes),
        sensors=tuple(
            {"signal": signal, "joints": "all", "finding": "unknown_form", "used": False, "parameters": {}}
            for signal in assessment.set_aside
        ),
    )


def _found(made: Experiment, assessment: Assessment, name: str, closure: ClosureByJoint | None) -> Found:
    effect, protocol = catalogue()[name], made.protocol
    at = assessment.place(name)
    x = _size(assessment, name) if closure is None else closure.refit.x[0]
    where, c = np.array(at), assessment.evidence.causes.index(name)
    amplitude, deviation = (float(of[0, c]) for of in (assessment.evidence.amplitudes, assessment.evidence.deviations))
    unsure = 1.96 * deviation / max(amplitude, 1e-6)

    def stated(times: float) -> dict[str, float]:
        point = {q.name: x[q.name] * (1.0 if q.shape else times) for q in effect.quantities}
        return effect.stated(effect.values(point, protocol.reference, where), protocol.reference, where)

    centre, ends = stated(1.0), (stated(max(1 - unsure, 0.0)), stated(1 + unsure))
    spans = {
        key: Span(value, min(end.get(key, value) for end in ends), max(end.get(key, value) for end in ends))
        if ends[0].get(key) != ends[1].get(key) else Span(value, -np.inf, np.inf)  # how it acts was not asked
        for key, value in centre.items()
    }  # fmt: skip
    joints: tuple[str, ...] | str = tuple(protocol.joints[j] for j in at)
    if effect.of_body:
        joints = "body"
    elif len(at) == len(protocol.joints) > 1:
        joints = "all"
    return Found(
        name, joints, spans, assessment.present[name], None if closure is None else closure.closed, None if closure is None else closure.low,
        None if closure is None else closure.high, effect.native, dict(x),
    )  # fmt: skip
