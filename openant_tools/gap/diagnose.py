"""The diagnosis: where the gap lies, which causes explain it, and how far it closes on runs that were not used.

A judge that has seen thousands of simulated robots names suspects; fits on simulated robots say where each would sit and how
large it would be; held-out closure decides between them, and says when none will do.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import joblib
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.files import atomic_writer
from openant_tools.gap.cause import Scope, catalogue
from openant_tools.gap.closure import (
    Closure,
    Refit,
    Windows,
    calibration_of,
    closures,
    heat_loss_of,
    nothing,
    unmoved,
)
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED, Diagnosis, Found, Span
from openant_tools.gap.explain import Explained, Part, Scene, fit, robot_with
from openant_tools.gap.features import Floats
from openant_tools.gap.judge import Judge, Judgement, Metric, metric_of, train
from openant_tools.gap.late import late_velocity
from openant_tools.gap.measure import Measurement, measure
from openant_tools.gap.next import suggestion
from openant_tools.gap.prepare import Prepared, prepare
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.rivals import moves_joints, paired, placed, rivals
from openant_tools.gap.sets import SetFits, choose, motions_of
from openant_tools.model.gap import excess
from openant_tools.model.plant import Setup
from openant_tools.recording.run import Run
from openant_tools.sysid.identify import joints_in_common, own_model

__all__ = ["diagnose"]

Progress = Callable[[float, str], None]
Stored = TypeVar("Stored")

#: probabilities: below which of the best nothing is fitted, below which a cause is not looked at, above which it is a finding
DOUBT, SUSPECT, FINDING = 0.12, 0.07, 0.5
#: probability from which a cause is believed if it takes away so much of what is strange that this share is left
MAYBE, EASES = 0.2, 0.7
#: probability of a cause that little closure on the held-out runs does not overrule: a stop, say, shows in few of them
CERTAIN = 0.8
#: share of its least size below which a cause that was re-fitted on the runs has vanished
VANISHED = 0.1
#: how many causes are looked at, at most and at least; and at least where the log is strange and no cause likely
SUSPECTS, LIKELIEST, PUZZLED = 5, 3, 7
#: share of what is left without any cause that a first look leaves with one which contacts are fitted beside
CLEARLY = 0.75
#: how many of the likeliest are fitted on the runs whatever they leave; times the least cost beyond which others are not
LIKELIEST_FITTED, FAR_WORSE = 2, 4.0
#: probability of a second cause, once the first is taken into account
SECOND = 0.35
#: places at which each of them is tried
PLACES = 2
#: held-out closure that an addition must bring; that one cause must bring beyond what tolerances do, where the judge doubts;
#: and below which a set explains nothing
ADDS, ADDS_ALONE, EXPLAINS = 0.02, 0.2, 0.35
#: and that a second cause must bring which the judge does not expect
ADDS_MUCH = 0.15
#: how many causes are looked at of what the judge sees beside the first; how many of those it expects are tried, and of others
OTHERS, TOLD, MORE = 4, 2, 2
#: °C between runs from which heat is asked about, and its cause
WARMED_C, HEAT = 2.5, "thermal_derating"
#: 1/°C of torque that any motor loses: copper's resistance grows by 0.4 %, and its magnets weaken; twice that is an effect
COPPER = 0.01
#: gaps that are so many floors, of robots whose energy is so many gates, ask for an explanation; beyond ODD gates no robot of
#: the build is healthy, whatever the judge says
LARGE, STRANGE, ODD = 3.0, 3.0, 20.0
#: sets whose closures differ by less are not told apart
APART = 0.01
#: s that a diagnosis gives to simulated robots where the protocol was never seen; `prepare` by itself takes what it needs. On two
#: usual cores they are there before; on slow ones it is better to wait than to judge by few
PREPARE_S = 1080.0
#: robots of no more joints are cheap to simulate: all suspects are fitted together
FEW_JOINTS = 2
#: nothing is surer
SURELY = 0.99
#: share of what a re-fit leaves that a cause leaves of it where closure alone proves it
PROVES = 0.72
#: share of what a re-fit leaves that is little enough: no rival is looked for where the best cause leaves no more
SETTLED = 0.35
#: effects in a set that is not told from others, at most
TOGETHER = 3
#: how what is left of the gap counts beside the judge's probability
LEFT_COUNTS = 8.0
#: s after the judge has spoken from which no causes are looked for that it does not expect: slow computers have to answer, too
PATIENCE_S = 65.0
#: share of that by which what takes long has to be begun
EARLY = 0.5
#: of what is kept beside a preparation: another where judges are taught otherwise
FORM = 2


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
    # In the order in which they were prepared, in whatever order they are named: so one judge serves them all.
    training = sorted(range(len(runs)), key=lambda k: prepared.which[k])
    tell(0.63, "the judge")
    judge = _kept(Judge, train, prepared, training, [found[k][1] for k in training])
    tell(0.7, "causes")
    case = _Case(protocol, coarse, prepared, measured, judge, found, training, model, runs, hold_out)
    judgement = judge.say(case.features)
    first = _shown(judgement, protocol)
    # No template was as warm as this robot was in each run: what a thermometer shows is asked about wherever it may sit.
    warmed = [HEAT] if protocol.warmed_c > WARMED_C else []
    if first[0][1] < DOUBT and judgement.energy < STRANGE and not warmed:
        tell(1.0, "done")
        return _healthy(case, judgement, first)
    scenes = _scenes(prepared, coarse, found, training)
    # Where nothing is likely and yet the log is strange, the likeliest few have to answer.
    puzzled = first[0][1] < FINDING and judgement.energy > STRANGE
    suspects = [name for n, (name, chance) in enumerate(first) if chance > SUSPECT or n < LIKELIEST][:SUSPECTS]
    few = len(wanted) <= FEW_JOINTS
    if puzzled or few:
        suspects = [name for name, _ in first[: max(PUZZLED, len(suspects))]]
    if few:
        suspects += [name for name in _questioned(protocol) if name not in suspects and name in judgement.places]
    suspects += [name for name in warmed if name not in suspects and name in judgement.places]
    explained = _explain(scenes, suspects, judgement, thorough=warmed)
    if warmed and HEAT in explained and explained[HEAT].x["loss_per_c"] < COPPER and len(explained) > 1:
        del explained[HEAT]
    tell(0.85, "held-out runs")
    if few:
        return _decide_together(case, judgement, first, explained)
    return _decide(case, judgement, first, explained, scenes)


def _shown(judgement: Judgement, protocol: Protocol) -> list[tuple[str, float]]:
    """Causes that can show on these runs and signals, with their probabilities, most probable first."""
    ranked = sorted(judgement.probability.items(), key=lambda item: -item[1])
    return [(name, chance) for name, chance in ranked if catalogue()[name].shows(protocol.reference)]


@dataclass(frozen=True)
class _Case:
    """What is known of the robot at hand.

    Attributes:
        coarse: its protocol, in the steps and from the starts of the simulated robots that it is compared with.
        begun: when the judge was about to speak, s of the clock that only goes forward. given_up: what there was no time for.
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
    begun: float = dataclasses.field(default_factory=time.monotonic)
    given_up: list[str] = dataclasses.field(default_factory=list)

    def in_time(self, wanted: str, share: float = 1.0) -> bool:
        """Whether there is time for what is wanted; if not, the diagnosis will say so.

        Args:
            share: of the time there is, by which it has to be begun.
        """
        if time.monotonic() <= self.begun + share * PATIENCE_S:
            return True
        self.given_up.append(wanted)
        return False

    @property
    def features(self) -> Floats:
        """(features,) of the runs that are diagnosed."""
        return np.concatenate([self.found[k][0][self.found[k][1]] for k in self.training])


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


def _kept(
    kind: type[Stored],
    make: Callable[[Prepared, Sequence[int], Sequence[NDArray[np.bool_]]], Stored],
    prepared: Prepared,
    which: Sequence[int],
    columns: Sequence[NDArray[np.bool_]],
) -> Stored:
    """What follows from a preparation for some runs and signals: made once, then read again."""
    state = hashlib.sha256(repr((FORM, [prepared.which[k] for k in which], len(prepared.cases))).encode())
    for mine in columns:
        state.update(mine.tobytes())
    path = prepared.folder / f"{kind.__name__.lower()}-{state.hexdigest()[:16]}.joblib"
    if path.is_file():
        try:
            found = joblib.load(path)
            if isinstance(found, kind):
                return found
        except Exception:  # whatever an interrupted or foreign file does, it is made anew
            path.unlink(missing_ok=True)
    made = make(prepared, which, columns)
    with atomic_writer(path) as file:
        joblib.dump(made, file)
    return made


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
        metric = _kept(Metric, metric_of, prepared, mine, [found[k][1] for k in mine])
        seen = np.concatenate([found[k][0] for k in mine])
        scenes[setup] = Scene(coarse, [coarse.runs[k] for k in mine], metric, seen)
    return scenes


def _scene_of(cause: str, scenes: dict[Setup, Scene]) -> Scene:
    # What shifts command and encoder alike shows where feet stand, and hardly anywhere else.
    floor = catalogue()[cause].of_body or catalogue()[cause].silent
    first = Setup.FLOOR if floor else Setup.STAND
    return scenes.get(first) or next(iter(scenes.values()))


def _explain(
    scenes: dict[Setup, Scene], suspects: Sequence[str], judgement: Judgement, thorough: Sequence[str] = ()
) -> dict[str, Explained]:
    """The best place and size of each suspect by itself, of those to be `thorough` about of all places."""
    out: dict[str, Explained] = {}
    for scene in {id(s): s for s in scenes.values()}.values():
        known = {
            Part(name, where): x
            for name in suspects
            if _scene_of(name, scenes) is scene
            for where, x in judgement.places[name][: None if name in thorough else PLACES]
        }
        if known:
            for one in fit(scene, known):
                name = one.part.cause
                if name not in out or one.misfit < out[name].misfit:
                    out[name] = one
    return out


def _without(case: _Case, explained: Explained) -> Judgement:
    """What the judge says of what is left once a cause is taken into account: against the model that has it."""
    robot = robot_with(case.coarse.reference, (explained.part,), (explained.x,))
    left = case.coarse.features(robot)
    return case.judge.say(np.concatenate([left[k][0][left[k][1]] for k in case.training]))


def _healthy(case: _Case, judgement: Judgement, ranked: Sequence[tuple[str, float]]) -> Diagnosis:
    """No cause is likely: the gap is one of tolerances and noise."""
    gap = {
        "before": case.measured.gaps["pos"],
        "after": case.measured.gaps["pos"],
        "floor": case.measured.floors["pos"],
    }
    return _diagnosis(case, NONE, 1 - ranked[0][1], _rest(ranked, ()), (), (), gap, {}, judgement, None)


def _decide(
    case: _Case,
    judgement: Judgement,
    ranked: Sequence[tuple[str, float]],
    explained: dict[str, Explained],
    scenes: dict[Setup, Scene],
) -> Diagnosis:
    windows = Windows(case.protocol)
    held_out = list(range(len(case.training), len(case.protocol.runs)))
    probability = dict(ranked)
    names = sorted(explained, key=lambda name: -probability[name])
    windows.look(case.training)
    sited = placed(windows, judgement, explained, case.training)
    names = _worth_fitting(names, {name: cost for name, (_, cost) in sited.items()})
    windows.settle(
        _beside(windows, sited.values(), case.training), case.training,
        lambda: case.in_time("other friction cones", EARLY),
    )  # fmt: skip
    explained = {name: sited[name][0] for name in names}
    starts = [nothing(windows), *(_start(windows, [explained[name]], case.training) for name in names)]
    before, floor, (refit, *singles) = closures(windows, starts, held_out, case.training)
    alone = dict(zip(names, singles, strict=True))
    unsettled = 1 - max(one.closed for one in singles) > SETTLED * (1 - refit.closed)
    if judgement.energy > 1 and unsettled and case.in_time("causes that nobody suspects"):
        found = _rivals(windows, case, explained, alone, scenes, probability)
        if found:
            starts = [_start(windows, [one], case.training) for one in found.values()]
            alone |= dict(zip(found, closures(windows, starts, held_out, case.training)[2], strict=True))
            explained = {**explained, **found}
            names += found
    for name in list(names):
        simpler = catalogue()[name].simpler(alone[name].refit.x[0])
        if simpler in alone:
            # Where it is no more than another cause, it is that one.
            names.remove(name)
            del explained[name]
            probability[simpler] = min(probability[simpler] + probability[name], SURELY)
            ranked = [(other, 0.0 if other == name else chance) for other, chance in ranked]
    score = {name: _score(probability[name], refit if catalogue()[name].random else alone[name]) for name in names}
    names.sort(key=lambda name: -score[name])
    best = names[0]
    chosen, whole = [best], alone[best]
    if probability[best] < FINDING:
        # A comparison that counts has to be fair: without the cause, too, from where the fit with it ended.
        warm = dataclasses.replace(nothing(windows), nuisance=alone[best].refit.nuisance)
        _, _, (again,) = closures(windows, [warm], held_out, case.training)
        refit = min(refit, again, key=lambda one: one.after)
    beyond = {best: whole.closed - refit.closed}
    # Joint positions say little of the body: there closure alone proves nothing that the judge does not half believe.
    beside = catalogue()[best].beside_joints_at(alone[best].refit.x[0])
    proves = beyond[best] > ADDS_ALONE or 1 - whole.closed < PROVES * (1 - refit.closed)
    proved = proves and (not beside or probability[best] > SECOND) and not catalogue()[best].random
    if proved:
        # What none of the others closes speaks for a cause whatever the judge thought of it.
        scores = np.array([score[name] for name in names])
        share = float(1 / np.exp(scores - scores[0]).sum())
        probability[best] = max(probability[best], share * min(beyond[best], 1.0))
        # What the judge took for another cause at the same place was this one.
        taken = [probability[name] for name in names if explained[name].part.joints == explained[best].part.joints]
        probability[best] = max(probability[best], share * max(taken))
    left, eased = None, False
    if probability[best] > MAYBE or proved or max(probability[name] for name in names) > CERTAIN:
        left = _without(case, explained[best])
        eased = probability[best] > MAYBE and judgement.energy > 1 and left.energy < EASES * judgement.energy
    if left is not None and (max(probability[name] for name in names) > FINDING or proved or eased):
        second = None
        tried = _seconds(windows, case, scenes, explained, best, probability, left)
        # What is random only adds its noise to every simulation.
        fitted = [one for one, _ in tried if not catalogue()[one.part.cause].random]
        starts = [_start(windows, [explained[best], one], case.training) for one in fitted]
        pairs = closures(windows, starts, held_out, case.training)[2] if starts else []
        together = {one.part: both for one, both in zip(fitted, pairs, strict=True)}
        for one, adds in tried:
            name, chance = one.part.cause, left.probability[one.part.cause]
            both = together.get(one.part, whole)
            # What moves no joint, or not twice alike, no closure can prove: there the judge's word is enough.
            moves = moves_joints(catalogue()[name]) and not catalogue()[name].beside_joints_at(both.refit.x[-1])
            silent = not moves and chance > FINDING
            much = moves and 1 - both.closed < PROVES * (1 - whole.closed)
            if both.closed > whole.closed + adds or much or (silent and both.closed > whole.closed - ADDS):
                how = _score(max(chance, probability[name]), both)
                if second is None or how > second[0]:
                    second = how, one, both
        if second is not None:
            _, one, both = second
            name = one.part.cause
            explained[name] = one
            beyond[name] = both.closed - whole.closed
            without = alone[name] if name in alone and not catalogue()[name].random else refit
            beyond[best] = both.closed - without.closed
            chosen.append(name)
            whole = both
            probability[name] = max(probability[name], left.probability[name])
    sure = probability[best] > (SECOND if judgement.energy > STRANGE else FINDING) or eased
    sure = sure or (judgement.energy > 1 and proved and alone[best].closed > EXPLAINS)
    # Where the judge is sure of something, and the log is strange, which of its suspects it is the fits may say.
    sure = sure or (judgement.energy > STRANGE and max(probability[name] for name in names) > FINDING)
    if probability[best] < CERTAIN and not explained[best].beyond_tolerance:
        sure = False
    # What is half believed does not come before what is certain, whatever it closes.
    certain = any(probability[name] > CERTAIN for name in chosen)
    doubted = [name for name in chosen if certain and probability[name] < SECOND]
    verdict, selected = best, tuple(sorted(chosen, key=lambda name: (name in doubted, -beyond[name])))
    ambiguous: tuple[tuple[str, ...], ...] = ()
    equal = [
        name
        for name in names[1:3]
        if not beside
        and abs(alone[name].closed - alone[best].closed) < APART
        and probability[name] > probability[best] / 2
    ]
    # Nor is it a riddle what a random cause leaves beside a likely one.
    noisy = any(catalogue()[name].random for name in chosen[1:]) and min(probability[name] for name in chosen) > FINDING
    if not sure:
        verdict, selected = (NONE if judgement.energy < ODD else UNEXPLAINED), ()
    elif (
        not beside
        and excess(before, floor) > LARGE * floor
        and whole.closed < EXPLAINS
        and judgement.energy > STRANGE
        and (
            probability[best] < CERTAIN
            or (_vanished(alone[best].refit) and not catalogue()[best].random)
            or (left is not None and left.energy > ODD)
        )
        and not noisy
    ):
        # However sure the judge is: what comes out as nothing at all, or leaves a robot as odd as it was, is not what makes the
        # gap. No fit finds what is random.
        verdict, selected = UNEXPLAINED, ()
    elif beside and not certain and left is not None and min(judgement.energy, left.energy) > STRANGE:
        # Strange with it, too: a foot that came off is no offset, though nothing known is more like it.
        verdict, selected = UNEXPLAINED, ()
    elif equal:
        verdict, ambiguous = AMBIGUOUS, ((best, *equal),)
    elif len(selected) > 1:
        verdict = selected[0]
    order = [*selected, *(name for name in names if name not in selected)]
    # The set was re-fitted together: these are the sizes that leave what it leaves.
    points = dict(zip((part.cause for part in whole.refit.hypothesis), whole.refit.x, strict=True))
    explained = {name: dataclasses.replace(one, x=points.get(name, one.x)) for name, one in explained.items()}
    alone |= {name: dataclasses.replace(alone[name], refit=whole.refit) for name in points if name in alone}
    effects = tuple(_found(case, explained[name], probability[name], alone.get(name)) for name in order)
    gap = {"before": before, "after": before if verdict == NONE else whole.after, "floor": floor, "refit": refit.after}
    removal = {name: beyond[name] for name in selected}
    confidence = 1 - probability[best] if verdict == NONE else probability[best]
    calibration, notes = None, []
    if verdict != NONE:
        judged = held_out or case.training
        calibration = calibration_of(windows, whole.refit, judged)
        notes = _warmth(windows, whole.refit, judged)
    return _diagnosis(
        case, verdict, confidence, (*effects, *_rest(ranked, order)), selected, ambiguous, gap, removal, judgement,
        calibration, notes,
    )  # fmt: skip


def _warmth(windows: Windows, refit: Refit, judged: Sequence[int]) -> list[str]:
    """What a diagnosis that knows how warm servos were has to say to whom a model of one warmth is written."""
    loss = heat_loss_of(windows, refit)
    if loss is None:
        return []
    return [
        f"servos lose {100 * loss:.2f} % of their torque per °C; a written model is always as warm as on average here, "
        f"and leaves {1000 * windows.written(refit, judged):.2f} mrad"
    ]


def _seconds(
    windows: Windows, case: _Case, scenes: dict[Setup, Scene], explained: dict[str, Explained], best: str,
    probability: dict[str, float], left: Judgement,
) -> list[tuple[Explained, float]]:  # fmt: skip
    """Causes that may act beside the best, each with the held-out closure that it has to add.

    Those that the judge expects in what the best leaves, and those it half hides behind the best, where a first look says that
    both together leave clearly less.
    """
    seen = [
        (name, chance) for name, chance in _shown(left, case.protocol)[:OTHERS] if chance > SUSPECT and name != best
    ]
    missing = [name for name, _ in seen if name not in explained]
    known = {**explained, **(_explain(scenes, missing, left) if missing else {})}
    told = [name for name, chance in seen[:TOLD] if name in known and max(chance, probability[name]) > SECOND]
    hidden = [
        one
        for name, one in known.items()
        if name not in (best, *told)
        and (one.beyond_tolerance or left.energy > STRANGE)
        and moves_joints(catalogue()[name])
    ]
    look: list[tuple[Explained, float]] = []
    if hidden and case.in_time("second causes that the judge does not expect"):
        look = paired(windows, known[best], hidden, case.training)
    chance = {one.part.cause: max(left.probability[one.part.cause], probability[one.part.cause]) for one, _ in look}
    look.sort(key=lambda pair: _rank(chance[pair[0].part.cause], pair[1]), reverse=True)
    return [(known[name], ADDS) for name in told] + [(one, ADDS_MUCH) for one, _ in look[:MORE]]


def _worth_fitting(names: Sequence[str], cost: dict[str, float]) -> list[str]:
    """Of suspects, the most probable first, those that are likely or do not leave far more than the best of them."""
    least = min(cost.values())
    return [name for n, name in enumerate(names) if n < LIKELIEST_FITTED or cost[name] < FAR_WORSE * least]


def _rivals(
    windows: Windows, case: _Case, explained: dict[str, Explained], alone: dict[str, Closure], scenes: dict[Setup, Scene],
    probability: dict[str, float],
) -> dict[str, Explained]:  # fmt: skip
    """Causes that would leave less than any where the suspect sits that leaves least, or the likeliest; fitted like those."""
    suspects = [name for name in explained if moves_joints(catalogue()[name])]
    if not suspects:
        return {}
    least = min(suspects, key=lambda name: alone[name].after)
    likeliest = max(suspects, key=lambda name: _score(probability[name], alone[name]))
    best = [explained[name] for name in dict.fromkeys((least, likeliest))]
    found = rivals(windows, best, explained, case.training)
    return {one.part.cause: one for one in fit(_scene_of(least, scenes), found)} if found else {}


def _vanished(refit: Refit) -> bool:
    """Whether of a cause by itself nothing is left, once it was re-fitted on the runs."""
    (part,), (x,) = refit.hypothesis, refit.x
    return all(abs(x[q.name]) < VANISHED * q.small for q in part.definition.quantities if not q.shape)


def _questioned(protocol: Protocol) -> list[str]:
    """What the given model may get wrong by construction: that is tried whatever the judge says."""
    out = []
    if not protocol.reference.friction.any():
        out.append("coulomb_friction")
    if any((one.run.signal("torque", protocol.joints, default=1.0) == 0).any() for one in protocol.runs):
        # Damping that stands in the joint brakes with torque off, too.
        out.append("electrical_damping")
    return out


def _decide_together(
    case: _Case, judgement: Judgement, ranked: Sequence[tuple[str, float]], explained: dict[str, Explained]
) -> Diagnosis:
    """Real servos have several causes at once: where all can be fitted together they are, and what can be spared goes."""
    windows = Windows(case.protocol)
    held_out = list(range(len(case.training), len(case.protocol.runs)))
    fits = SetFits(windows, case.training, held_out)
    probability = dict(ranked)
    late = _late_register(case)
    moving = [name for name in explained if not catalogue()[name].beside_joints]
    if late is not None:
        # What the log itself shows needs no fit to positions, and none may make something else of it.
        moving = [name for name in moving if name != late[0].part.cause]
    seen = {signal for one in case.protocol.runs for signal in one.seen}
    witnessed = {name for name in moving if catalogue()[name].witness in seen and probability[name] > FINDING}
    parts, starts = [explained[name].part for name in moving], [explained[name].x for name in moving]
    choice = choose(fits, parts, starts, probability, witnessed)
    chosen, floor = choice.chosen, float(np.sqrt(np.mean(windows.floor**2)))
    notes = [
        f"closed where left out: {', '.join(f'{name} {100 * share:.0f} %' for name, share in chosen.folds.items())}"
    ]
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
    one_motion = len(motions_of(case.protocol, range(len(case.protocol.runs)))) == 1
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
            effects.append(_found(case, one, probability[name], None))
            continue
        fitted = chosen if name in chosen.names else alone
        one = dataclasses.replace(one, x=fitted.point(name), std=fitted.spread(name))
        effects.append(_found(case, one, probability[name], dataclasses.replace(alone.closure, refit=fitted.refit)))
    gap = {
        "before": chosen.before, "after": chosen.before if verdict == NONE else chosen.after, "floor": floor,
        "refit": choice.nothing.after,
    }  # fmt: skip
    confidence = 1 - likely if verdict == NONE else max((probability[name] for name in selected[:1]), default=likely)
    if verdict != NONE:
        notes += _warmth(windows, chosen.refit, held_out or case.training)
    return _diagnosis(
        case, verdict, confidence, (*effects, *_rest(ranked, order)), selected, ambiguous, gap,
        {name: choice.removal[name] for name in selected if name in choice.removal}, judgement,
        None if verdict == NONE else calibration_of(windows, chosen.refit, held_out or case.training), notes,
    )  # fmt: skip


def _late_register(case: _Case) -> tuple[Explained, float] | None:
    """A velocity register that is late by the log's own word, with the probability that it is so beyond tolerance."""
    joints = case.protocol.joints
    late = late_velocity([one.run for one in case.protocol.runs], joints)
    cause = catalogue()["sensor_delay"]
    least = next(q.small for q in cause.quantities if q.name == "vel")
    if late is None or late.beyond(least) < FINDING:
        return None
    x, std = (
        {q.name: value if q.name == "vel" else 0.0 for q in cause.quantities} for value in (late.delay_s, late.std_s)
    )
    return Explained(Part(cause.name, tuple(range(len(joints)))), x, std, math.nan), min(late.beyond(least), SURELY)


def _score(probability: float, closure: Closure) -> float:
    """How a cause ranks: by the judge, and by what it leaves of the gap on held-out runs."""
    return _rank(probability, 1 - closure.closed)


def _rank(probability: float, left: float) -> float:
    return math.log(max(probability, 1e-3)) - LEFT_COUNTS * math.log(max(left, 0.0) + 0.05)


def _rest(ranked: Sequence[tuple[str, float]], done: Sequence[str]) -> tuple[Found, ...]:
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


def _diagnosis(
    case: _Case, verdict: str, confidence: float, effects: tuple[Found, ...], selected: tuple[str, ...],
    ambiguous: tuple[tuple[str, ...], ...], gap: dict[str, float], removal: dict[str, float], judgement: Judgement,
    calibration: dict[str, dict[str, float]] | None, notes: Sequence[str] = (),
) -> Diagnosis:  # fmt: skip
    signals = case.measured.as_json()["signals"]
    return Diagnosis(
        model=str(case.model),
        runs=tuple(run.name for run in case.runs),
        held_out=tuple(run.name for run in case.hold_out),
        verdict=verdict,
        confidence=confidence,
        effects=effects,
        selected=selected,
        ambiguous_with=ambiguous,
        next_experiment=suggestion(verdict, ambiguous, len(motions_of(case.protocol, range(len(case.protocol.runs))))),
        gap={**gap, "energy": judgement.energy, "signals": signals},
        where=case.measured.as_json()["where"],
        calibration=calibration or {},
        removal=removal,
        notes=(*_notes(case), *notes),
    )


def _notes(case: _Case) -> tuple[str, ...]:
    """What it rests on, and what more signals would add."""
    seen = {name for one in case.protocol.runs for name in one.seen}
    notes = [
        f"judged by {len(case.prepared.cases)} simulated robots that played these commands",
        "held-out runs as given" if case.hold_out else "each run left out of the fits in turn",
        *(f"{wanted} were not tried: {PATIENCE_S:.0f} s were over on this computer" for wanted in case.given_up),
    ]
    if not case.protocol.reference.floor:
        notes.append("no run on the floor: body, contact and environment cannot show")
    elif not case.protocol.reference.imu:
        notes.append("no IMU: tilt, cable and payload are hard to tell apart")
    if "torque" not in seen:
        notes.append("no current or load: stiffness and torque scale are known only together")
    if "volt" not in seen:
        notes.append("no voltage: a sagging supply looks like weak motors")
    return tuple(notes)


def _beside(windows: Windows, sited: Iterable[tuple[Explained, float]], seen: Sequence[int]) -> Refit:
    """What is there while it is found out how feet meet the floor: the cause that leaves least, if it leaves clearly less."""
    least, cost = min(sited, key=lambda one: one[1])
    (plain,) = windows.left([nothing(windows)], seen)
    return _start(windows, [least], seen) if cost < CLEARLY * plain else nothing(windows)


def _start(windows: Windows, explained: Sequence[Explained], seen: Sequence[int]) -> Refit:
    """Where a re-fit with causes starts: contacts as without any, or as given where causes of the body leave less so."""
    start = unmoved(windows, (one.part for one in explained), (one.x for one in explained))
    if not any(one.part.definition.of_body for one in explained):
        return start
    both = [start, dataclasses.replace(start, nuisance=np.zeros_like(start.nuisance))]
    return both[int(np.argmin(windows.left(both, seen)))]


def _found(case: _Case, one: Explained, probability: float, closure: Closure | None) -> Found:
    name = one.part.cause
    cause = catalogue()[name]
    part, x, std = one.part, dict(one.x), one.std
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
            with np.errstate(over="ignore"):  # of what no run says, an end may be infinite
                ends = stated(moved)
            for key, value in ends.items():
                if key in centre:
                    low[key], high[key] = min(low[key], value), max(high[key], value)
    everything = len(part.joints) == len(case.protocol.joints)
    joints: tuple[str, ...] | str = tuple(case.protocol.joints[j] for j in part.joints)
    if cause.of_body:
        joints = "body"
    elif everything and Scope.ALL in cause.scopes:
        joints = "all"
    return Found(
        name, joints, {key: Span(centre[key], low[key], high[key]) for key in centre}, probability,
        None if closure is None else closure.closed, None if closure is None else closure.low,
        None if closure is None else closure.high, cause.native, x,
    )  # fmt: skip
