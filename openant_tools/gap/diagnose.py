"""The diagnosis: where the gap lies, which causes explain it, and how far it closes on runs that were not used.

A judge that has seen thousands of simulated robots names suspects; fits on simulated robots say where each would sit and how
large it would be; held-out closure decides between them, and says when none will do.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import joblib
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.gap.cause import Scope, catalogue
from openant_tools.gap.closure import Closure, Refit, Windows, closures, nothing
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED, Diagnosis, Found, Span
from openant_tools.gap.explain import Explained, Part, Scene, fit
from openant_tools.gap.judge import Judge, Judgement, train, whitening_of
from openant_tools.gap.measure import measure
from openant_tools.gap.prepare import Prepared, prepare
from openant_tools.gap.protocol import Protocol
from openant_tools.model.plant import Setup
from openant_tools.recording.run import Run
from openant_tools.sysid.identify import joints_in_common, own_model

__all__ = ["diagnose"]

Progress = Callable[[float, str], None]

#: probabilities below which a cause is not looked at, how many are, and above which the best one is a finding
SUSPECT, SUSPECTS, FINDING = 0.05, 5, 0.5
#: places at which each of them is tried
PLACES = 2
#: held-out closure that an addition must bring, and below which a set explains nothing
ADDS, EXPLAINS = 0.02, 0.3
#: sets whose closures differ by less are not told apart
APART = 0.02


def diagnose(
    runs: Sequence[Run],
    model: Path,
    *,
    hold_out: Sequence[Run] = (),
    joints: Sequence[str] | None = None,
    robots: int | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Diagnose the gap between a robot and its model.

    Args:
        runs: recordings of one robot. hold_out: recordings to judge on; without them each run is left out in turn.
        joints: default every position servo of the model that all runs command and measure.
        robots: how many to simulate where the protocol was never prepared.
        progress: told a share and words.

    Raises:
        BadInput: runs from which no diagnosis can be made.
    """
    tell = progress or (lambda share, words: None)
    everything = [*runs, *hold_out]
    _check(runs, hold_out)
    wanted = joints_in_common(everything, model, joints)
    _check_motion(everything, wanted)
    protocol = Protocol.of(everything, model, wanted, [own_model(run) for run in everything])
    measured = measure(list(hold_out) or list(runs), model, wanted)
    tell(0.02, "simulated robots")
    prepared = prepare(protocol, robots, lambda share, words: tell(0.02 + 0.6 * share, words))
    training = list(range(len(runs)))
    found = protocol.coarse().features()
    judge = _judge(prepared, training, [found[k][1] for k in training], tell)
    x = np.concatenate([found[k][0][found[k][1]] for k in training])
    judgement = judge.say(x)
    tell(0.7, "causes")
    ranked = sorted(judgement.probability.items(), key=lambda item: -item[1])
    shown = [(name, chance) for name, chance in ranked if catalogue()[name].shows(protocol.reference)]
    suspects = [name for name, chance in shown if chance > SUSPECT][:SUSPECTS] or [shown[0][0]]
    scenes = _scenes(prepared, protocol, found, training)
    explained = _explain(scenes, suspects, judgement)
    tell(0.85, "held-out runs")
    return _decide(_Case(protocol, measured, judgement, shown, explained, training, len(runs), model, runs, hold_out))


@dataclass(frozen=True)
class _Case:
    protocol: Protocol
    measured: object
    judgement: Judgement
    ranked: list[tuple[str, float]]
    explained: dict[str, Explained]
    training: list[int]
    count: int
    model: Path
    runs: Sequence[Run]
    hold_out: Sequence[Run]


def _check(runs: Sequence[Run], hold_out: Sequence[Run]) -> None:
    if len(runs) + len(hold_out) < 2:
        raise BadInput(
            "one run is not enough to diagnose: nothing is left to judge on",
            where=(runs[0].path or runs[0].name) if runs else None,
            remedy="record at least two runs of different motions, `openant sysid record`",
        )
    if not runs:
        raise BadInput("only held-out runs", remedy="name runs to diagnose beside --hold-out")
    for one in hold_out:
        for other in runs:
            if _content(one) == _content(other):
                raise BadInput(
                    f"the held-out run is the same as {other.name}", where=one.path or one.name,
                    remedy="hold out a run that is not diagnosed",
                )  # fmt: skip


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


def _judge(prepared: Prepared, which: Sequence[int], columns: Sequence[NDArray[np.bool_]], tell: Progress) -> Judge:
    """The trained judge for these runs and signals, from the cache where it stands there."""
    state = hashlib.sha256(repr((list(which), len(prepared.cases))).encode())
    for mine in columns:
        state.update(mine.tobytes())
    path = prepared.folder / f"judge-{state.hexdigest()[:16]}.joblib"
    if path.is_file():
        try:
            found = joblib.load(path)
            if isinstance(found, Judge):
                return found
        except Exception:  # whatever an interrupted or foreign file does, it is made anew
            path.unlink(missing_ok=True)
    tell(0.63, "training the judge")
    judge = train(prepared, which, columns)
    partial = path.with_suffix(".tmp")
    joblib.dump(judge, partial)
    partial.replace(path)
    return judge


def _scenes(
    prepared: Prepared,
    protocol: Protocol,
    found: Sequence[tuple[NDArray[np.float32], NDArray[np.bool_]]],
    training: Sequence[int],
) -> dict[Setup, Scene]:
    """Where hypotheses are compared: the runs of each setup."""
    coarse = protocol.coarse()
    scenes = {}
    for setup in Setup:
        mine = [k for k in training if protocol.runs[k].plant.setup is setup]
        if not mine:
            continue
        whitening, columns = whitening_of(prepared, mine, [found[k][1] for k in mine])
        seen = np.concatenate([found[k][0] for k in mine])
        scenes[setup] = Scene(coarse, [coarse.runs[k] for k in mine], whitening, columns, seen)
    return scenes


def _scene_of(cause: str, scenes: dict[Setup, Scene]) -> Scene:
    body = catalogue()[cause].scopes == (Scope.BODY,)
    first = Setup.FLOOR if body else Setup.STAND
    return scenes.get(first) or next(iter(scenes.values()))


def _explain(scenes: dict[Setup, Scene], suspects: Sequence[str], judgement: Judgement) -> dict[str, Explained]:
    """The best place and size of each suspect by itself."""
    out: dict[str, Explained] = {}
    for scene in {id(s): s for s in scenes.values()}.values():
        known = {
            Part(name, where): x
            for name in suspects
            if _scene_of(name, scenes) is scene
            for where, x in judgement.places[name][:PLACES]
        }
        if known:
            for one in fit(scene, [(part,) for part in known], known):
                name = one.hypothesis[0].cause
                if name not in out or one.misfit < out[name].misfit:
                    out[name] = one
    return out


def _decide(case: _Case) -> Diagnosis:
    protocol, judgement = case.protocol, case.judgement
    windows = Windows(protocol)
    held_out = list(range(case.count, len(protocol.runs)))
    names = [name for name, _ in case.ranked if name in case.explained]
    probability = dict(case.ranked)
    chosen = [name for name in names if probability[name] > FINDING] or names[:1]
    chosen = chosen[:3]
    sets: list[list[str]] = [chosen, *([name] for name in names[:3] if [name] != chosen)]
    if len(chosen) > 1:
        sets += [[other for other in chosen if other != name] for name in chosen if len(chosen) > 2]
    starts = [nothing(windows), *(_start(windows, [case.explained[name] for name in some]) for some in sets)]
    before, floor, results = closures(windows, starts, held_out, case.training)
    refit, results = results[0], results[1:]
    alone = {some[0]: result for some, result in zip(sets, results, strict=True) if len(some) == 1}
    whole = results[0]
    removal = _removal(chosen, sets, results, refit)
    chosen = sorted(chosen, key=lambda name: -removal.get(name, 0.0))
    healthy = judgement.energy < 1.0 and probability[names[0]] < FINDING
    best = probability[chosen[0]] if chosen else 0.0
    verdict, selected = chosen[0], list(chosen)
    if healthy or (judgement.energy < 1.5 and best < SUSPECT * 4):
        verdict, selected = NONE, []
    elif best < FINDING:
        verdict, selected = (NONE, []) if judgement.energy < 2.0 else (AMBIGUOUS, [])
    effects = tuple(
        _found(case, name, probability[name], alone.get(name))
        for name in [*chosen, *(n for n in names if n not in chosen)]
    )
    rest = tuple(
        Found(
            name,
            "body" if catalogue()[name].scopes == (Scope.BODY,) else "all",
            {},
            chance,
            None,
            None,
            None,
            catalogue()[name].native,
        )
        for name, chance in case.ranked
        if name not in names
    )
    after = before if verdict == NONE else whole.after
    measured = case.measured
    return Diagnosis(
        model=str(case.model),
        runs=tuple(run.name for run in case.runs),
        held_out=tuple(run.name for run in case.hold_out),
        verdict=verdict,
        confidence=1 - best if verdict == NONE else best,
        effects=effects + rest,
        selected=tuple(selected),
        ambiguous_with=(tuple(names[:2]),) if verdict == AMBIGUOUS else (),
        next_experiment=None,
        gap={"before": before, "after": after, "floor": floor, "energy": judgement.energy, "refit": refit.after},
        where=measured.as_json()["where"],  # type: ignore[attr-defined]
        removal=removal,
    )


def _removal(
    chosen: Sequence[str], sets: Sequence[Sequence[str]], results: Sequence[Closure], refit: Closure
) -> dict[str, float]:
    """Effect → held-out closure that is lost without it."""
    out = {}
    whole = results[0].closed
    for name in chosen:
        others = [other for other in chosen if other != name]
        without = refit.closed
        for some, result in zip(sets, results, strict=True):
            if others and sorted(some) == sorted(others):
                without = result.closed
        out[name] = whole - without
    return out


def _start(windows: Windows, explained: Sequence[Explained]) -> Refit:
    parts = tuple(part for one in explained for part in one.hypothesis)
    x = tuple(point for one in explained for point in one.x)
    return Refit(parts, x, np.zeros(len(windows.names)))


def _found(case: _Case, name: str, probability: float, closure: Closure | None) -> Found:
    one, cause = case.explained[name], catalogue()[name]
    part, x, std = one.hypothesis[0], dict(one.x[0]), one.std[0]
    if closure is not None and len(closure.refit.x) == 1:
        x = dict(closure.refit.x[0])
    where = np.array(part.joints)
    reference = case.protocol.reference

    def stated(point: dict[str, float]) -> dict[str, float]:
        return cause.stated(cause.values(point, reference, where), reference, where)

    centre = stated(x)
    low, high = dict(centre), dict(centre)
    for q in cause.quantities:
        for sign in (-1.96, 1.96):
            moved = {**x, q.name: x[q.name] + sign * std[q.name]}
            if not q.signed:
                moved[q.name] = max(moved[q.name], 1e-6)
            for key, value in stated(moved).items():
                if key in centre:
                    low[key], high[key] = min(low[key], value), max(high[key], value)
    everything = len(part.joints) == len(case.protocol.joints)
    joints: tuple[str, ...] | str = tuple(case.protocol.joints[j] for j in part.joints)
    if cause.scopes == (Scope.BODY,):
        joints = "body"
    elif everything and Scope.ALL in cause.scopes:
        joints = "all"
    return Found(
        name, joints, {key: Span(centre[key], low[key], high[key]) for key in centre}, probability,
        None if closure is None else closure.closed, None if closure is None else closure.low,
        None if closure is None else closure.high, cause.native, x,
    )  # fmt: skip


_ = (UNEXPLAINED, dataclasses, ADDS, EXPLAINS, APART)
