"""What a diagnosis hands on (formats, section 2), from what was tried and decided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Scope
from openant_tools.gap.closure import Closure, calibration_of, heat_loss_of
from openant_tools.gap.decide import Decision, Row, presence, weights
from openant_tools.gap.diagnosis import UNEXPLAINED, Diagnosis, Found, Span
from openant_tools.gap.measure import measure
from openant_tools.gap.next import suggestion
from openant_tools.gap.residual import residual_after
from openant_tools.gap.size_interval import Known, ends
from openant_tools.gap.trials import Trials
from openant_tools.gap.velocity_delay import velocity_delay
from openant_tools.numbers import number, percent
from openant_tools.recording.run import Run
from openant_tools.sysid.intervals import TWO_SIDED_95

__all__ = ["Given", "finding"]

#: signals of features → columns of run tables
COLUMNS: Mapping[str, str] = {"torque": "cur", "yaw": "base"}
#: probability from which a cause of sensors is found
FOUND = 0.5
#: s by which a healthy servo's filter makes its velocities late
HEALTHY_LATE_S = 0.012


@dataclass(frozen=True)
class Given:
    """What was asked about: the model, runs, and what was expected of the robot."""

    model: Path
    runs: tuple[Run, ...]
    hold_out: tuple[Run, ...]
    prior: tuple[str, ...]


@dataclass(frozen=True)
class Tried:
    """What was decided on.

    Attributes:
        rows: no cause, each by itself, and what was added to one. declined: what was asked for beside one and not added.
        there: of causes asked for beside one, how likely each is there.
    """

    rows: Sequence[Row]
    declined: Sequence[Row]
    there: Mapping[str, float]

    @property
    def singles(self) -> list[Row]:
        return [row for row in self.rows if len(row.causes) == 1]


def finding(trials: Trials, given: Given, tried: Tried, decision: Decision, chosen: tuple[str, ...]) -> Diagnosis:
    """The diagnosis that is handed on.

    Args:
        chosen: causes that go into the improved model, the one that leads first.
    """
    experiment, predictions = trials.experiment, trials.fits.predictions
    best, plain = trials.closures.get(chosen), trials.closures[()]
    judged = sorted({k for fold in experiment.folds for k in fold})
    parts = [experiment.parts.runs[k].run for k in judged]
    measured = measure(parts, given.model, experiment.parts.joints)
    removal = trials.removal(chosen) if best is not None and chosen else {}
    where, rest, calibration = measured.as_json()["where"], None, {}
    notes = [str(experiment.selection), *_notes(trials, given, decision)]
    if best is not None and chosen:
        rest, where = residual_after(predictions, best.refit, judged, measured)
        calibration = calibration_of(predictions, best.refit, judged)
        if (loss := heat_loss_of(predictions, best.refit)) is not None:
            notes.append(
                f"servos lose {number(loss, 'share')} of their torque per °C; a written model is always as warm as on average here, and "
                f"leaves {number(predictions.written(best.refit, judged), 'rad', name='gap')}"
            )
    elif decision.verdict == UNEXPLAINED:
        closest = trials.closures.get((decision.likeliest,), plain)
        rest = residual_after(predictions, closest.refit, judged, measured)[0]
    there = _there(trials, tried, decision, chosen)
    effects = sorted(
        (_found(trials, row, best, there[row.causes[0]]) for row in tried.singles),
        key=lambda one: -_rank(one, decision, chosen),
    )
    return Diagnosis(
        model=str(given.model),
        runs=tuple(run.name for run in given.runs),
        held_out=tuple(run.name for run in parts),
        verdict=decision.verdict,
        confidence=decision.confidence,
        effects=tuple(effects),
        selected=chosen,
        ambiguous_with=decision.alike,
        next_experiment=suggestion(decision.verdict, decision.alike, len(given.runs) + len(given.hold_out)),
        gap={
            "before": plain.before,
            "after": plain.before if best is None or not chosen else best.after,
            "floor": plain.floor,
            "floor_from": "repeats" if predictions.from_repeats else "sensors",
            "signals": measured.as_json()["signals"],
        },
        where=where,
        calibration=calibration,
        removal=removal,
        refuted={row.causes[0]: _why_not(row, plain) for row in tried.singles if row.refuted},
        notes=tuple(notes),
        rest={} if rest is None else rest.as_json(),
        sensors=_sensors(trials, given, there),
        rows=tuple(map(_row, tried.rows)),
        declined=tuple(map(_row, tried.declined)),
        anomaly=asdict(trials.anomaly),
    )


def _row(row: Row) -> dict[str, Any]:
    """What is decided on, so that it can be decided anew and weights be learned from it."""
    kept = asdict(row)
    del kept["joints"], kept["gain"]
    return kept


def _there(trials: Trials, tried: Tried, decision: Decision, chosen: tuple[str, ...]) -> dict[str, float]:
    """Cause → how likely it is there: that it leads, or that it is beside what is chosen, whichever is more."""
    known = chosen if chosen in trials.closures else ()
    beside = {part.cause: presence(fit, weights()) for part, _, fit in trials.left(known)}
    return {name: max(decision.chances[name], tried.there.get(name, by)) for name, by in beside.items()}


def _rank(one: Found, decision: Decision, chosen: Sequence[str]) -> float:
    """What is chosen, in its order, before what is likelier to lead."""
    if one.effect in chosen:
        return float(len(chosen) - chosen.index(one.effect)) + 1.0
    return decision.chances[one.effect]


def _why_not(row: Row, plain: Closure) -> str:
    assert row.gain is not None
    words = "closes no more" if row.gain < 0.005 else f"closes {percent(row.gain)} more"
    return f"on held-out data it {words} than a re-fit within tolerance, which closes {percent(plain.closed)}"


def _found(trials: Trials, row: Row, best: Closure | None, probability: float) -> Found:
    """One cause, as it is in the improved model if that has it, else by itself."""
    (name,) = row.causes
    effect, protocol, assessment = catalogue()[name], trials.experiment.parts, trials.assessment
    alone, at = trials.closures.get((name,)), assessment.place(name)
    evidence = assessment.evidence
    c = evidence.causes.index(name)
    within = [] if best is None else [part.cause for part in best.refit.hypothesis]
    of = best if name in within else alone
    if of is None:
        x, length = dict(trials.size(name)), float(evidence.deviations[c])
        std = {q.name: 0.0 if q.shape else abs(assessment.template(name)[q.name]) * length for q in effect.quantities}
    else:
        k = [part.cause for part in of.refit.hypothesis].index(name)
        x, std, at = dict(of.refit.x[k]), dict(of.std[k]), of.refit.hypothesis[k].joints

    where = np.array(at)

    def stated(point: Mapping[str, float]) -> dict[str, float]:
        return effect.stated(effect.values(dict(point), protocol.reference, where), protocol.reference, where)

    centre, points = stated(x), []
    for q in effect.quantities:
        support = None if effect.random else row.support or 0.0
        count = len(protocol.joints if effect.of_body else at)
        know = Known.of(q, x, effect.quantities, std[q.name], q.allowed(protocol.reference, where), support, count)
        points += [{**x, q.name: end} for end in ends(q, know)]
    with np.errstate(over="ignore"):  # of what no run says, an end may be infinite
        known = [stated(point) for point in points]
    spans = {
        key: Span(value, min(value, *(end.get(key, value) for end in known)), max(value, *(end.get(key, value) for end in known)))
        for key, value in centre.items()
    }  # fmt: skip
    joints: tuple[str, ...] | str = tuple(protocol.joints[j] for j in at)
    if effect.of_body:
        joints = "body"
    elif len(at) == len(protocol.joints) and Scope.ALL in effect.scopes:
        joints = "all"
    return Found(
        name, joints, spans, probability, None if alone is None else alone.closed,
        None if alone is None else alone.low, None if alone is None else alone.high, effect.native, x,
    )  # fmt: skip


def _notes(trials: Trials, given: Given, decision: Decision) -> list[str]:
    """What it rests on, and what more signals would add."""
    protocol = trials.experiment.protocol
    seen = {name for one in protocol.runs for name in one.seen}
    notes = [
        f"judged by {trials.assessment.robots} robots simulated for these recordings",
        "held-out runs as given" if given.hold_out else "parts left out of the fits in turn",
    ]
    for signal, times in trials.assessment.set_aside.items():
        notes.append(
            f"the {COLUMNS.get(signal, signal)} column behaves like none that is known ({number(times)} times the farthest healthy robot): "
            "judged without it"
        )
    if decision.verdict in given.prior:
        notes.append(f"{decision.verdict} was declared beforehand, which was taken to make it ten times as likely")
    if not protocol.reference.floor:
        notes.append("no run on the floor: body, contact and environment cannot show")
    elif not protocol.reference.imu:
        notes.append("no IMU: tilt, cable and payload are hard to tell apart")
    if "torque" not in seen:
        notes.append("no current or load: stiffness and torque scale are known only together")
    if "volt" not in seen:
        notes.append("no voltage: a sagging supply looks like weak motors")
    return notes


def _sensors(trials: Trials, given: Given, there: Mapping[str, float]) -> tuple[dict[str, Any], ...]:
    """What was found of each signal of the log; `there` is how likely each cause is."""
    protocol, assessment = trials.experiment.protocol, trials.assessment
    out: list[dict[str, Any]] = []
    acting = {name: assessment.template(name) for name, chance in there.items() if chance > FOUND}
    for signal in sorted({name for one in protocol.runs for name in one.seen}):
        used = signal not in assessment.set_aside
        found: dict[str, Any] = {
            "signal": COLUMNS.get(signal, signal), "joints": "all" if signal in ("pos", "vel", "torque", "volt") else "body",
            "finding": "as_modelled" if used else "unknown_form", "used": used, "parameters": {},
        }  # fmt: skip
        for name, x in acting.items():
            if used and catalogue()[name].of_sensors_at(x) and _shows(name, x, signal):
                found |= {"finding": name}
        late = velocity_delay(given.runs, protocol.joints) if signal == "vel" else None
        if late is not None and late.beyond(HEALTHY_LATE_S) > FOUND:
            ends = {"low": late.delay_s - TWO_SIDED_95 * late.std_s, "high": late.delay_s + TWO_SIDED_95 * late.std_s}
            found |= {"finding": "sensor_delay", "parameters": {"vel.delay_s": {"value": late.delay_s, **ends}}}
        if not any(one["signal"] == found["signal"] for one in out):
            out.append(found)
    return tuple(out)


def _shows(name: str, x: Mapping[str, float], signal: str) -> bool:
    """Whether a cause of sensors acts on a signal."""
    effect = catalogue()[name]
    on = (
        {effect.signal}
        if effect.signal is not None
        else {q.name for q in effect.quantities if abs(x[q.name]) >= q.small}
    )
    return ("imu" if signal in ("gyro", "acc") else "base" if signal == "yaw" else signal) in on
