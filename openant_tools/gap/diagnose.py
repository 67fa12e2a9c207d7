"""The diagnosis: where the gap lies, which causes explain it, and how far it closes on runs that were not used.

A judge that has seen thousands of simulated robots names suspects; fits on simulated robots say where each would sit and how
large it would be; held-out closure decides between them, and says when none will do.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.errors import BadInput
from openant_tools.gap.diagnosis import NONE, Diagnosis
from openant_tools.gap.explain import Scene, explain
from openant_tools.gap.judge import Judgement
from openant_tools.gap.kept import judge_of, kept_metric
from openant_tools.gap.measure import measure
from openant_tools.gap.patient import Patient, diagnosis_of, shown, unfitted
from openant_tools.gap.prepare import Prepared, prepare
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.recording import diagnose_recording
from openant_tools.gap.thresholds import (
    BEFOREHAND_S,
    COPPER,
    DOUBT,
    FEW_JOINTS,
    FINDING,
    HEAT,
    LIKELIEST,
    PUZZLED,
    STRANGE,
    SUSPECT,
    SUSPECTS,
    WARMED_C,
)
from openant_tools.gap.together import decide_together
from openant_tools.gap.verdict import decide
from openant_tools.model.of_run import own_model
from openant_tools.model.plant import Setup
from openant_tools.recording.run import Run
from openant_tools.sysid.identify import joints_in_common

__all__ = ["diagnose"]

Progress = Callable[[float, str], None]

#: s that a diagnosis gives to simulated robots where the protocol was never seen; `prepare` by itself takes what it needs. On two
#: usual cores they are there before; on slow ones it is better to wait than to judge by few
PREPARE_S = 1080.0


def diagnose(
    runs: Sequence[Run],
    model: Path,
    *,
    hold_out: Sequence[Run] = (),
    joints: Sequence[str] | None = None,
    robots: int | None = None,
    prior: Sequence[str] = (),
    progress: Progress | None = None,
) -> Diagnosis:
    """Diagnose the gap between a robot and its model.

    Args:
        runs: recordings of one robot. hold_out: recordings to judge on; without them each run is left out in turn.
        joints: default every position servo of the model that all runs command and measure.
        robots: how many to simulate where the protocol was never prepared.
        prior: effects that are known or expected of this robot: where the runs cannot tell causes apart, they do.
        progress: told a share and words.

    Raises:
        BadInput: no such effect, or runs from which no diagnosis can be made.
    """
    tell, began = progress or (lambda share, words: None), time.monotonic()
    everything = [*runs, *hold_out]
    _check(runs, hold_out)
    _check_prior(prior)
    wanted = joints_in_common(everything, model, joints)
    _check_motion(everything, wanted)
    if len(everything) == 1:
        unasked = (
            [f"that {' and '.join(prior)} is expected had no part in the diagnosis of a single run"] if prior else []
        )
        return diagnose_recording(runs, model, wanted, progress, unasked)
    played = Protocol.of(runs, model, wanted, [own_model(run) for run in runs])
    measured = measure(list(hold_out) or list(runs), model, wanted)
    tell(0.02, "simulated robots")
    prepared = prepare(played, robots, seconds=PREPARE_S, progress=lambda share, words: tell(0.02 + 0.6 * share, words))
    coarse = played.started_as(prepared.protocol).coarse()
    protocol = played
    if hold_out:
        protocol = Protocol.of(everything, model, wanted, [own_model(run) for run in everything])
    protocol = dataclasses.replace(protocol, reference=coarse.reference)
    found = coarse.features()
    judge = judge_of(prepared, played, progress=lambda share, words: tell(0.63 + 0.07 * share, words))
    training = prepared.ordered
    tell(0.7, "causes")
    began = max(began, time.monotonic() - BEFOREHAND_S)
    patient = Patient(protocol, coarse, prepared, measured, judge, found, training, model, runs, hold_out, prior, began)
    judgement = judge.say(patient.features)
    first = shown(judgement, protocol)
    # No template was as warm as this robot was in each run: what a thermometer shows is asked about wherever it may sit.
    warmed = [HEAT] if protocol.warmed_c > WARMED_C else []
    # Nor is a thermometer a reason to ask where nothing differs from healthy robots.
    if first[0][1] < DOUBT and judgement.energy < (1.0 if warmed else STRANGE):
        tell(1.0, "done")
        return _healthy(patient, judgement, first)
    scenes = _scenes(prepared, coarse, found, training)
    # Where nothing is likely and yet the log is strange, the likeliest few have to answer.
    puzzled = first[0][1] < FINDING and judgement.energy > STRANGE
    suspects = [name for n, (name, chance) in enumerate(first) if chance > SUSPECT or n < LIKELIEST][:SUSPECTS]
    suspects += [name for name in catalogue()[suspects[0]].alike if name not in suspects and name in judgement.places]
    few = len(wanted) <= FEW_JOINTS
    if puzzled or few:
        suspects = [name for name, _ in first[: max(PUZZLED, len(suspects))]]
    if few:
        suspects += [name for name in _questioned(protocol) if name not in suspects and name in judgement.places]
    suspects += [name for name in prior if name not in suspects and name in judgement.places]
    suspects += [name for name in warmed if name not in suspects and name in judgement.places]
    explained = explain(scenes, suspects, judgement, thorough=warmed)
    tell(0.85, "held-out runs")
    if few:
        # There sizes come from the fits alone: what any motor loses is no cause.
        if warmed and HEAT in explained and explained[HEAT].x["loss_per_c"] < COPPER and len(explained) > 1:
            del explained[HEAT]
        return decide_together(patient, judgement, first, explained)
    return decide(patient, judgement, first, explained, scenes)


def _check(runs: Sequence[Run], hold_out: Sequence[Run]) -> None:
    if not runs:
        raise BadInput("only held-out runs", remedy="name runs to diagnose beside --hold-out")
    for one in hold_out:
        for other in runs:
            if _content(one) == _content(other):
                raise BadInput(
                    f"the held-out run is the same as {other.name}", where=one.path or one.name,
                    remedy="hold out a run that is not diagnosed",
                )  # fmt: skip


def _check_prior(prior: Sequence[str]) -> None:
    for name in prior:
        if name not in catalogue():
            near = difflib.get_close_matches(name, catalogue(), 1)
            raise BadInput(
                f"there is no effect {name!r}",
                remedy=f"did you mean {near[0]!r}?" if near else f"name one of: {', '.join(sorted(catalogue()))}",
            )


def _content(run: Run) -> str:
    state = hashlib.sha256(np.ascontiguousarray(run.t).tobytes())
    for name in sorted(run.columns):
        if name.startswith(("pos.", "cmd.")):
            state.update(np.ascontiguousarray(run.columns[name]).tobytes())
    return state.hexdigest()


def _check_motion(runs: Sequence[Run], joints: Sequence[str]) -> None:
    moved = 0.0
    for run in runs:
        pos = run.signal("pos", joints)
        moved = max(moved, float(np.nanmax(np.nanmax(pos, axis=0) - np.nanmin(pos, axis=0))))
    if moved < math.radians(1):
        raise BadInput(
            f"nothing moves: no joint goes farther than {math.degrees(moved):.2f}°", where=runs[0].path or runs[0].name,
            remedy="record a protocol that moves the joints, see `openant sysid record --list`; angles are in rad",
        )  # fmt: skip


def _scenes(
    prepared: Prepared,
    coarse: Protocol,
    found: Sequence[tuple[NDArray[np.float32], NDArray[np.bool_]]],
    training: Sequence[int],
) -> dict[Setup, Scene]:
    """Where hypotheses are compared: the runs of each setup."""
    scenes = {}
    for setup in Setup:
        mine = [k for k in training if coarse.runs[k].plant.setup is setup]
        if not mine:
            continue
        metric = kept_metric(prepared, mine, [found[k][1] for k in mine])
        seen = np.concatenate([found[k][0] for k in mine])
        scenes[setup] = Scene(coarse, [coarse.runs[k] for k in mine], metric, seen)
    return scenes


def _questioned(protocol: Protocol) -> list[str]:
    """What the given model may get wrong by construction: that is tried whatever the judge says."""
    out = []
    if not protocol.reference.friction.any():
        out.append("coulomb_friction")
    if any((one.run.signal("torque", protocol.joints, default=1.0) == 0).any() for one in protocol.runs):
        # Damping that stands in the joint brakes with torque off, too.
        out.append("electrical_damping")
    return out


def _healthy(patient: Patient, judgement: Judgement, ranked: Sequence[tuple[str, float]]) -> Diagnosis:
    """No cause is likely: the gap is one of tolerances and noise."""
    gap = {
        "before": patient.measured.gaps["pos"],
        "after": patient.measured.gaps["pos"],
        "floor": patient.measured.floors["pos"],
    }
    return diagnosis_of(patient, NONE, 1 - ranked[0][1], unfitted(ranked, ()), (), (), gap, {}, judgement, None)
