"""The robot that is diagnosed, and how what is found of it is put down."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Scope
from openant_tools.gap.closure import Closure, Refit, Windows, calibration_of, heat_loss_of
from openant_tools.gap.diagnosis import Diagnosis, Found, Span
from openant_tools.gap.explain import Explained
from openant_tools.gap.features import Floats
from openant_tools.gap.judge import Judge, Judgement
from openant_tools.gap.measure import Measurement
from openant_tools.gap.next import suggestion
from openant_tools.gap.prepare import Prepared
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.rest import rest_of
from openant_tools.gap.sets import motions_of
from openant_tools.gap.thresholds import PATIENCE_S
from openant_tools.recording.run import Run

__all__ = ["Patient", "diagnosis_of", "found_of", "shown", "unfitted"]


#: a re-fitted model on the windows that it was fitted on
Left = tuple[Windows, Refit]


@dataclass(frozen=True)
class Patient:
    """What is known of the robot at hand.

    Attributes:
        coarse: its protocol, in the steps and from the starts of the simulated robots that it is compared with.
        prior: causes that its builder declared to be likely, whatever the runs say.
        began: when its diagnosis did, s of the clock that only goes forward. given_up: what there was no time for.
        refuted: cause → what signature speaks against it, in words.
    """

    protocol: Protocol
    coarse: Protocol
    prepared: Prepared
    measured: Measurement
    judge: Judge
    found: Sequence[tuple[Floats, NDArray[np.bool_]]]
    training: list[int]
    model: Path
    runs: Sequence[Run]
    hold_out: Sequence[Run]
    prior: Sequence[str] = ()
    began: float = dataclasses.field(default_factory=time.monotonic)
    given_up: list[str] = dataclasses.field(default_factory=list)
    refuted: dict[str, str] = dataclasses.field(default_factory=dict)

    def in_time(self, wanted: str, share: float = 1.0) -> bool:
        """Whether there is time for what is wanted; if not, the diagnosis will say so.

        Args:
            share: of the time there is, by which it has to be begun.
        """
        if time.monotonic() <= self.began + share * PATIENCE_S:
            return True
        self.given_up.append(wanted)
        return False

    def declared(self, group: Sequence[str]) -> str | None:
        """Of causes that the runs cannot tell apart, the one that was declared; None where that is none or several."""
        mine = [name for name in group if name in self.prior]
        return mine[0] if len(mine) == 1 else None

    @property
    def held_out(self) -> list[int]:
        """Of the protocol's runs, those that nothing is fitted on; where there are none, each run is left out in turn."""
        return list(range(len(self.training), len(self.protocol.runs)))

    @property
    def features(self) -> Floats:
        """(features,) of the runs that are diagnosed."""
        return np.concatenate([self.found[k][0][self.found[k][1]] for k in self.training])


def shown(judgement: Judgement, protocol: Protocol) -> list[tuple[str, float]]:
    """Causes that can show on these runs and signals, with their probabilities, most probable first."""
    ranked = sorted(judgement.probability.items(), key=lambda item: -item[1])
    return [(name, chance) for name, chance in ranked if catalogue()[name].shows(protocol.reference)]


def diagnosis_of(
    patient: Patient, verdict: str, confidence: float, effects: tuple[Found, ...], selected: tuple[str, ...],
    ambiguous: tuple[tuple[str, ...], ...], gap: dict[str, float], removal: dict[str, float], judgement: Judgement,
    left: Left | None, notes: Sequence[str] = (),
) -> Diagnosis:  # fmt: skip
    """A diagnosis, put down.

    Args:
        left: windows and the refit that goes into the improved model; None where there is none.
    """
    if ambiguous and verdict in ambiguous[0]:
        others = " and ".join(name for name in ambiguous[0] if name != verdict)
        notes = (*notes, f"{verdict} was declared beforehand: these runs cannot tell it from {others}")
    measured = patient.measured.as_json()
    calibration: dict[str, dict[str, float]] = {}
    where, rest = measured["where"], None
    if left is not None:
        judged = patient.held_out or patient.training
        calibration = calibration_of(*left, judged)
        rest, where = rest_of(*left, judged, patient.measured)
        notes = (*notes, *_warmth(*left, judged))
    return Diagnosis(
        model=str(patient.model),
        runs=tuple(run.name for run in patient.runs),
        held_out=tuple(run.name for run in patient.hold_out),
        verdict=verdict,
        confidence=confidence,
        effects=effects,
        selected=selected,
        ambiguous_with=ambiguous,
        next_experiment=suggestion(
            verdict, ambiguous, len(motions_of(patient.protocol, range(len(patient.protocol.runs))))
        ),
        gap={**gap, "energy": judgement.energy, "signals": measured["signals"]},
        where=where,
        calibration=calibration,
        removal=removal,
        refuted=dict(patient.refuted),
        notes=(*_notes(patient), *notes),
        rest={} if rest is None else rest.as_json(),
    )


def _notes(patient: Patient) -> tuple[str, ...]:
    """What it rests on, and what more signals would add."""
    seen = {name for one in patient.protocol.runs for name in one.seen}
    notes = [
        f"judged by {len(patient.prepared.cases)} simulated robots that played these commands",
        "held-out runs as given" if patient.hold_out else "each run left out of the fits in turn",
        *(f"{wanted} were not tried: {PATIENCE_S:.0f} s were over on this computer" for wanted in patient.given_up),
        *(f"{name} is refuted: {why}" for name, why in patient.refuted.items()),
    ]
    if not patient.protocol.reference.floor:
        notes.append("no run on the floor: body, contact and environment cannot show")
    elif not patient.protocol.reference.imu:
        notes.append("no IMU: tilt, cable and payload are hard to tell apart")
    if "torque" not in seen:
        notes.append("no current or load: stiffness and torque scale are known only together")
    if "volt" not in seen:
        notes.append("no voltage: a sagging supply looks like weak motors")
    return tuple(notes)


def found_of(patient: Patient, one: Explained, probability: float, closure: Closure | None) -> Found:
    name = one.part.cause
    cause = catalogue()[name]
    part, x, std = one.part, dict(one.x), one.std
    if closure is not None and len(closure.refit.x) == 1:
        x = dict(closure.refit.x[0])
    where = np.array(part.joints)
    reference = patient.protocol.reference

    def stated(point: dict[str, float]) -> dict[str, float]:
        return cause.stated(cause.values(point, reference, where), reference, where)

    centre = stated(x)
    low, high = dict(centre), dict(centre)
    for q in cause.quantities:
        for sign in (-1.96, 1.96):
            moved = {**x, q.name: x[q.name] + sign * std[q.name]}
            if not q.signed:
                moved[q.name] = max(moved[q.name], 1e-6)
            with np.errstate(over="ignore"):  # of what no run says, an end may be infinite
                ends = stated(moved)
            for key, value in ends.items():
                if key in centre:
                    low[key], high[key] = min(low[key], value), max(high[key], value)
    everything = len(part.joints) == len(patient.protocol.joints)
    joints: tuple[str, ...] | str = tuple(patient.protocol.joints[j] for j in part.joints)
    if cause.of_body:
        joints = "body"
    elif everything and Scope.ALL in cause.scopes:
        joints = "all"
    return Found(
        name, joints, {key: Span(centre[key], low[key], high[key]) for key in centre}, probability,
        None if closure is None else closure.closed, None if closure is None else closure.low,
        None if closure is None else closure.high, cause.native, x,
    )  # fmt: skip


def unfitted(ranked: Sequence[tuple[str, float]], done: Sequence[str]) -> tuple[Found, ...]:
    """The causes that were not fitted."""
    return tuple(
        Found(
            name,
            "body" if catalogue()[name].of_body else "all",
            {},
            chance,
            None,
            None,
            None,
            catalogue()[name].native,
        )
        for name, chance in ranked
        if name not in done
    )


def _warmth(windows: Windows, refit: Refit, judged: Sequence[int]) -> list[str]:
    """What a diagnosis that knows how warm servos were has to say to whom a model of one warmth is written."""
    loss = heat_loss_of(windows, refit)
    if loss is None:
        return []
    return [
        f"servos lose {100 * loss:.2f} % of their torque per °C; a written model is always as warm as on average here, "
        f"and leaves {1000 * windows.written(refit, judged):.2f} mrad"
    ]
