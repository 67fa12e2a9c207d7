"""The verdict on a robot of many joints: which cause leads, whether a second acts beside it, and whether either is believed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from openant_tools.effects.catalogue import catalogue
from openant_tools.gap.closure import STRAINED, ClosureByJoint, Refit, Windows, closures, nothing, unmoved
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED, Diagnosis
from openant_tools.gap.explain import Explained, Hypothesis, Part, Scene, explain, fit, known_to, robot_with, scene_of
from openant_tools.gap.judge import Judgement
from openant_tools.gap.patient import Patient, diagnosis_of, found_of, shown, unfitted
from openant_tools.gap.returning import returning
from openant_tools.gap.rivals import (
    bodily,
    carries,
    everywhere,
    moves_joints,
    paired,
    placed,
    resized,
    rivals,
    told,
    unexpected,
)
from openant_tools.gap.thresholds import (
    ADDS,
    ADDS_ALONE,
    ADDS_MUCH,
    APART,
    ASTRAY,
    BARELY,
    CERTAIN,
    CLEARLY,
    CLOSES_MOST,
    EARLY,
    EASES,
    EXPLAINS,
    EXPLAINS_RIDDLE,
    FAR_LESS,
    FAR_WORSE,
    FINDING,
    LARGE,
    LATE,
    LEFT_COUNTS,
    LIKELIEST_FITTED,
    MAYBE,
    MORE,
    ODD,
    OTHERS,
    PROVES,
    RETURNS,
    RIDDLE,
    SECOND,
    SETTLED,
    STANDS_OUT,
    STAYS,
    STRANGE,
    STRAYS,
    SURELY,
    SUSPECT,
    TOLD,
    VANISHED,
)
from openant_tools.model.gap import excess
from openant_tools.model.plant import Setup

__all__ = ["decide"]


@dataclass
class _Evidence:
    """What has been found of each suspect.

    Attributes:
        ranked: what the judge thought of all causes. probability: what is believed of them by now.
        explained: where each suspect sits, and how large it is. alone: what it leaves by itself.
        plain: what a re-fit leaves without any. before, floor: the gap, rad.
        where: the joints that stand out of what a re-fit leaves, where suspects are compared: among all of a robot's joints what
            one of them does is soon lost. All, where none does.
    """

    patient: Patient
    judgement: Judgement
    scenes: Mapping[Setup, Scene]
    windows: Windows
    ranked: Sequence[tuple[str, float]]
    probability: dict[str, float]
    explained: dict[str, Explained]
    alone: dict[str, ClosureByJoint]
    plain: ClosureByJoint
    before: float
    floor: float
    where: Sequence[int]

    @property
    def names(self) -> list[str]:
        """The suspects, first the one for which most speaks."""
        names = sorted(self.explained, key=lambda name: -self.score(name))
        first, chance, closed = names[0], self.probability, {name: self.alone[name].closed for name in self.alone}
        certain = [name for name in names if chance[name] > CERTAIN and closed.get(name, 0.0) > closed[first]]
        if chance[first] < SECOND and certain:
            # What is hardly believed and does well at one joint is no reason to doubt what is certain and does more.
            names.remove(certain[0])
            names.insert(0, certain[0])
        return names

    def score(self, name: str) -> float:
        """How a suspect ranks: by the judge, and by what it leaves of the gap on held-out runs."""
        closure = self.plain if catalogue()[name].random else self.alone[name]
        return _rank(self.probability[name], 1 - self.closed(closure))

    def closed(self, closure: ClosureByJoint) -> float:
        """The share of the excess that is gone where suspects are compared."""
        return closure.closed_at(self.where)

    def closures(self, starts: Sequence[Refit], *, anew: bool = False) -> tuple[float, float, list[ClosureByJoint]]:
        return _closures(self.windows, self.patient, starts, anew=anew)


@dataclass(frozen=True)
class _Leader:
    """The suspect for which most speaks.

    Attributes:
        gained: closed beyond what tolerances do. beside: whether positions of joints say little of it.
        proved: whether closure alone proves it. left: what the judge says of what it leaves, if it was asked.
        eased: whether that is far less strange.
    """

    name: str
    gained: float
    beside: bool
    proved: bool
    left: Judgement | None
    eased: bool


@dataclass(frozen=True)
class _Chosen:
    """The causes that go into the improved model; what they leave together, and what the removal of each costs.

    Attributes:
        energy: how strange what they leave is; infinite where nobody asked.
    """

    names: tuple[str, ...]
    closure: ClosureByJoint
    removal: Mapping[str, float]
    energy: float = math.inf


@dataclass(frozen=True)
class _Said:
    """A verdict, the suspects in the order that led to it, and the causes that these runs cannot tell apart."""

    names: Sequence[str]
    leader: _Leader
    chosen: _Chosen
    verdict: str
    selected: tuple[str, ...]
    ambiguous: tuple[tuple[str, ...], ...]


def decide(
    patient: Patient,
    judgement: Judgement,
    ranked: Sequence[tuple[str, float]],
    explained: dict[str, Explained],
    scenes: Mapping[Setup, Scene],
) -> Diagnosis:
    """Which of the suspects explain the gap, if any.

    Args:
        ranked: every cause that can show, with its probability. explained: the suspects, fitted on simulated robots.
    """
    evidence = _heard(patient, judgement, ranked, explained, scenes)
    said = _judged(evidence, evidence.names)
    declared = patient.declared([name for group in said.ambiguous for name in group])
    if declared is not None and said.leader.name != declared:
        # What the runs leave open, what is known besides decides.
        said = _judged(evidence, [declared, *(name for name in evidence.names if name != declared)])
    return _put_down(evidence, said)


def _judged(evidence: _Evidence, names: Sequence[str]) -> _Said:
    """What is to be said if the first of these suspects leads."""
    leader = _led(evidence, names)
    whole = evidence.alone[leader.name]
    chosen = _Chosen((leader.name,), whole, {leader.name: whole.closed - evidence.plain.closed})
    if leader.left is not None and (
        max(evidence.probability[name] for name in names) > FINDING or leader.proved or leader.eased
    ):
        chosen = _joined(evidence, leader, leader.left, chosen)
    if leader.left is not None:
        chosen = dataclasses.replace(chosen, energy=_strangeness(evidence, chosen, leader.left))
    verdict, selected, ambiguous = _verdict(evidence, names, leader, chosen)
    if selected and evidence.patient.in_time("slopes where the causes were found", LATE):
        chosen = _polished(evidence, chosen)
    return _Said(names, leader, chosen, verdict, selected, ambiguous)


def _heard(
    patient: Patient, judgement: Judgement, ranked: Sequence[tuple[str, float]], explained: dict[str, Explained],
    scenes: Mapping[Setup, Scene],
) -> _Evidence:  # fmt: skip
    """Each suspect where the runs say that it sits, and what it leaves; rivals that nobody suspected, too."""
    windows, training, probability = Windows(patient.protocol), patient.training, dict(ranked)
    windows.look(training)
    where = windows.strained(training, STANDS_OUT) or range(len(patient.protocol.joints))
    sited = placed(windows, judgement, explained, training)
    _kept_in_place(patient, windows, explained, sited, probability)
    windows.settle(
        _beside(windows, sited.values(), training), training, lambda: patient.in_time("other friction cones", EARLY)
    )
    likely_first = sorted(explained, key=lambda name: -probability[name])
    names = _worth_fitting(likely_first, {name: cost for name, (_, cost) in sited.items()})
    # Causes that look alike have to be compared.
    names += [name for name in catalogue()[likely_first[0]].alike if name in sited and name not in names]
    explained = {name: sited[name][0] for name in names}
    starts = [nothing(windows), *(_start(windows, [explained[name]], training) for name in names)]
    before, floor, (plain, *singles) = _closures(windows, patient, starts)
    evidence = _Evidence(
        patient, judgement, scenes, windows, ranked, probability, explained,
        dict(zip(names, singles, strict=True)), plain, before, floor, where,
    )  # fmt: skip
    unsettled = 1 - max(map(evidence.closed, singles)) > SETTLED * (1 - evidence.closed(plain))
    if judgement.energy > 1 and unsettled and patient.in_time("causes that nobody suspects"):
        found = _rivals(evidence)
        if found:
            starts = [_start(windows, [one], training) for one in found.values()]
            evidence.alone |= dict(zip(found, evidence.closures(starts)[2], strict=True))
            evidence.explained |= found
    _simplify(evidence)
    _fitted_anew(evidence)
    _told_apart(evidence)
    _refute(evidence)
    _taken_in(evidence)
    return evidence


def _kept_in_place(
    patient: Patient, windows: Windows, explained: Mapping[str, Explained], sited: dict[str, tuple[Explained, float]],
    probability: Mapping[str, float],
) -> None:  # fmt: skip
    """What is certain stays where features put it, if that takes far more of what is strange away than where windows do.

    Windows see what is largest. Beside a second cause that is larger, the first would do harm wherever it sits, and least where it
    does least.
    """
    for name, (there, _) in sited.items():
        here = explained[name]
        if probability[name] < CERTAIN or here.part == there.part or not moves_joints(catalogue()[name]):
            continue
        energy, instead = (_left(patient, [((one.part,), (one.x,))]).energy for one in (here, there))
        if energy < FAR_LESS * instead:
            (cost,) = windows.left([unmoved(windows, [here.part], [here.x])], patient.training)
            sited[name] = here, float(cost)


def _fitted_anew(evidence: _Evidence) -> None:
    """Causes that look alike, fitted from other sizes, too: what half of one does is another motion, and fits follow what is near."""
    windows, training, alone = evidence.windows, evidence.patient.training, evidence.alone
    twins = [name for name in alone if name in evidence.explained and set(catalogue()[name].alike) & set(alone)]
    if evidence.names[0] not in twins:
        return
    others = resized(windows, [evidence.explained[name] for name in twins], training)
    found = evidence.closures([_start(windows, [one], training) for one in others])[2]
    for one, closure in zip(others, found, strict=True):
        name = one.part.cause
        if closure.closed > alone[name].closed:
            alone[name], evidence.explained[name] = closure, one


def _told_apart(evidence: _Evidence) -> None:
    """Of causes that look alike the judge says that there is one of them, and runs that were not used, which."""
    chance, likeliest = evidence.probability, evidence.names[0]
    for twin in catalogue()[likeliest].alike:
        if twin in evidence.alone:
            better, other = sorted((likeliest, twin), key=lambda name: -evidence.closed(evidence.alone[name]))
            closed, less = (evidence.closed(evidence.alone[name]) for name in (better, other))
            if closed > max(EXPLAINS, less + APART):
                chance[other], chance[better] = sorted((chance[likeliest], chance[twin]))


def _refute(evidence: _Evidence) -> None:
    """Lost and late commands come anywhere: where nothing else is likely, what comes back at the same angles is not theirs."""
    patient, chance = evidence.patient, evidence.probability
    random = [name for name in evidence.explained if catalogue()[name].random and chance[name] > SUSPECT]
    if not random or any(likely > SECOND and not catalogue()[name].random for name, likely in chance.items()):
        return
    coarse, nominal = patient.coarse, patient.coarse.nominal()
    # On the floor legs trip over each other's errors.
    runs = [k for k in patient.training if coarse.runs[k].plant.setup is Setup.STAND] or patient.training
    t = [coarse.runs[k].layout.t for k in runs]
    for name in random:
        mine = list(evidence.explained[name].part.joints)
        known = [
            np.where(coarse.runs[k].layout.unsure, np.float32(np.nan), coarse.runs[k].seen["pos"][0]) for k in runs
        ]
        share = returning(t, [one[:, mine] for one in known], [nominal[k]["pos"][0][:, mine] for k in runs])
        if share > RETURNS:
            chance[name] = SUSPECT
            patient.refuted[name] = (
                f"{100 * share:.0f} % of what scatters comes back at the same angles, as a gear's faults do"
            )


def _taken_in(evidence: _Evidence) -> None:
    """Where two are likely and one of them shows as the other, too, there is that one alone: it explains both."""
    chance = evidence.probability
    for name in evidence.explained:
        for other in catalogue()[name].shows_as:
            if other in evidence.explained and min(chance[name], chance[other]) > FINDING:
                chance[other] = SUSPECT
                evidence.patient.refuted[other] = f"{name} looks like this, too, and not the other way round"


def _simplify(evidence: _Evidence) -> None:
    """Where a suspect is no more than another one, it is that one."""
    probability = evidence.probability
    for name in list(evidence.explained):
        simpler = catalogue()[name].simpler(evidence.alone[name].refit.x[0])
        if simpler in evidence.alone:
            del evidence.explained[name]
            probability[simpler] = min(probability[simpler] + probability[name], SURELY)
            evidence.ranked = [(other, 0.0 if other == name else chance) for other, chance in evidence.ranked]


def _led(evidence: _Evidence, names: Sequence[str]) -> _Leader:
    """What speaks for the first suspect: the judge, what it closes, and what is left of what is strange."""
    probability, best = evidence.probability, names[0]
    score = {name: evidence.score(name) for name in names}
    whole = evidence.alone[best]
    if probability[best] < FINDING:
        # A comparison that counts has to be fair: without the cause, too, from where the fit with it ended.
        warm = dataclasses.replace(nothing(evidence.windows), nuisance=whole.refit.nuisance)
        _, _, (again,) = evidence.closures([warm])
        evidence.plain = max(evidence.plain, again, key=evidence.closed)
    closed, without = evidence.closed(whole), evidence.closed(evidence.plain)
    gained = closed - without
    # Joint positions say little of the body: there closure alone proves nothing that the judge does not half believe.
    beside = catalogue()[best].unseen_in_joints_at(whole.refit.x[0])
    # Of what is left of a healthy robot a cause may take a third by chance.
    healthy = evidence.plain.after < LARGE * evidence.floor and evidence.judgement.energy < STRANGE
    proves = gained > ADDS_ALONE or (not healthy and 1 - closed < PROVES * (1 - without))
    proved = proves and (not beside or probability[best] > SECOND) and not catalogue()[best].random
    if proved:
        # What none of the others closes speaks for a cause whatever the judge thought of it.
        scores = np.array([score[name] for name in names])
        share = float(1 / np.exp(scores - scores[0]).sum())
        probability[best] = max(probability[best], share * min(gained, 1.0))
        # What the judge took for another cause at the same place was this one.
        here = evidence.explained[best].part.joints
        taken = [probability[name] for name in names if evidence.explained[name].part.joints == here]
        probability[best] = max(probability[best], share * max(taken))
    left, eased, energy = None, False, evidence.judgement.energy
    needless = healthy and moves_joints(catalogue()[best]) and not beside and gained < BARELY
    farther = energy < 1 and carries(catalogue()[best]) and gained < -ADDS
    if probability[best] < CERTAIN and (needless or farther):
        # Tolerances do what it does, and leave no more than of a healthy robot, of which no judge is certain.
        probability[best] *= max(gained, 0.0) / BARELY
    if probability[best] > MAYBE or proved or max(probability[name] for name in names) > CERTAIN:
        left = _without(evidence, best)
        eased = probability[best] > MAYBE and energy > 1 and left.energy < EASES * energy
    return _Leader(best, gained, beside, proved, left, eased)


def _without(evidence: _Evidence, name: str) -> Judgement:
    """What the judge says of what is left once a cause is taken into account: against the model that has it."""
    explained = evidence.explained[name]
    sizes = [explained.x]
    if not catalogue()[name].random:
        sizes += [x for x in evidence.alone[name].refit.x if x != explained.x]
    return _left(evidence.patient, [((explained.part,), (x,)) for x in sizes])


def _left(patient: Patient, causes: Sequence[tuple[Hypothesis, Sequence[Mapping[str, float]]]]) -> Judgement:
    """What the judge says against the model that has causes, in those of some sizes that leave least that is strange.

    Fits to features and to windows give them different ones: where two causes act, features give the first what belongs to both.
    """
    said = []
    for parts, x in causes:
        left = patient.coarse.features(robot_with(patient.coarse.reference, parts, x))
        said.append(patient.judge.say(np.concatenate([left[k][0][left[k][1]] for k in patient.training])))
    return min(said, key=lambda judgement: judgement.energy)


def _strangeness(evidence: _Evidence, chosen: _Chosen, left: Judgement) -> float:
    """How strange what a set of causes leaves is; left: what the first of them leaves."""
    first, *_ = chosen.names
    known = [evidence.explained[name] for name in chosen.names if not catalogue()[name].random]
    if not known:
        return evidence.judgement.energy
    if [one.part.cause for one in known] == [first]:
        return left.energy
    found = dict(zip((part.cause for part in chosen.closure.refit.hypothesis), chosen.closure.refit.x, strict=True))
    parts = tuple(one.part for one in known)
    sizes = [[one.x for one in known], [found.get(one.part.cause, one.x) for one in known]]
    return _left(evidence.patient, [(parts, x) for x in sizes]).energy


def _joined(evidence: _Evidence, leader: _Leader, left: Judgement, chosen: _Chosen) -> _Chosen:
    """The leader with the cause that acts beside it, if there is one."""
    windows, training = evidence.windows, evidence.patient.training
    explained, probability, whole = evidence.explained, evidence.probability, chosen.closure
    tried, plain = _seconds(evidence, leader.name, left)
    # What is random only adds its noise to every simulation.
    fitted = [one for one in tried if not catalogue()[one.part.cause].random]
    starts = [_start(windows, [explained[leader.name], one], training) for one in fitted]
    pairs = evidence.closures(starts)[2] if starts else []
    together = {one.part: both for one, both in zip(fitted, pairs, strict=True)}
    # What a second cause adds shows where a random leader does not drown it.
    calm = {part: (both, whole) for part, both in together.items()}
    if catalogue()[leader.name].random and fitted:
        singles = evidence.closures([_start(windows, [one], training) for one in fitted])[2]
        calm = {one.part: (single, evidence.plain) for one, single in zip(fitted, singles, strict=True)}
    second: tuple[float, Explained, ClosureByJoint, float] | None = None
    for one in tried:
        name = one.part.cause
        before = _found_both(evidence, leader.name, name)
        chance = max(left.probability[name], before)
        both = together.get(one.part, whole)
        with_it, without_it = calm.get(one.part, (whole, whole))
        # What moves no joint, or not twice alike, no closure can prove: there the judge's word is enough.
        moves = moves_joints(catalogue()[name]) and not catalogue()[name].unseen_in_joints_at(both.refit.x[-1])
        # Unless it takes away so much of what is strange that nothing within tolerance does.
        much = (moves or carries(catalogue()[name])) and 1 - with_it.closed < PROVES * (1 - without_it.closed)
        # What looks like the leader is hardly there beside it, whatever a judge says that cannot tell them apart.
        alike = name in catalogue()[leader.name].alike
        has_to_add = ADDS_MUCH if alike else _has_to_add(left.probability[name], before, moves=moves)
        if one.part == plain:
            has_to_add = min(has_to_add, ADDS)
        adds = with_it.closed - without_it.closed
        if much or adds > has_to_add:
            how = _rank(chance, 1 - with_it.closed)
            if second is None or how > second[0]:
                second = how, one, both, adds
    if second is None:
        return chosen
    _, one, both, adds = second
    name = one.part.cause
    explained[name] = one if any(one.std.values()) else known_to(scene_of(name, evidence.scenes), one)
    known = name in evidence.alone and not catalogue()[name].random
    without = evidence.alone[name] if known else evidence.plain
    probability[name] = max(probability[name], left.probability[name])
    removal = {leader.name: both.closed - without.closed, name: adds}
    return _Chosen((leader.name, name), both, removal)


def _found_both(evidence: _Evidence, best: str, name: str) -> float:
    """How probable the judge found a cause before it knew of any other, where it found the leader, too; else 0.

    Those are no two names of one thing.
    """
    before = dict(evidence.ranked)
    return before[name] if min(before[best], before[name]) > FINDING else 0.0


def _has_to_add(left: float, before: float, *, moves: bool) -> float:
    """Held-out closure that a second cause has to add: the less, the more probable the judge finds it.

    Args:
        left: what the judge says of what the leader leaves; a leader that is a little off leaves what looks like other causes.
        before: what it said of it beside the leader, of the robot as it is. moves: whether closure can tell the cause.
    """
    if not moves:
        return -ADDS if max(left, before) > FINDING else ADDS if left > SECOND else math.inf
    if before > CERTAIN:
        return -ADDS
    if before > FINDING or left > CERTAIN:
        return 0.0
    return ADDS if left > SECOND else ADDS_MUCH


def _seconds(evidence: _Evidence, best: str, left: Judgement) -> tuple[list[Explained], Part | None]:
    """Causes that may act beside the best; and the one that a first look finds plain: it leaves far less than any other does.

    Those that the judge expects, in what the best leaves or from the beginning; those it half hides behind the best, where a first
    look says that both together leave clearly less; and what by itself leaves least of the others.
    """
    patient, explained = evidence.patient, evidence.explained
    chance = {
        name: max(left.probability[name], _found_both(evidence, best, name))
        for name in evidence.probability
        if name != best and name not in catalogue()[best].shows_as
    }
    likely = sorted(
        (name for name, _ in shown(left, patient.protocol) if name in chance), key=lambda name: -chance[name]
    )
    seen = [name for name in likely[:OTHERS] if chance[name] > SUSPECT]
    missing = [name for name in seen if name not in explained]
    known = {**explained, **(explain(evidence.scenes, missing, left) if missing else {})}
    expected = [
        name
        for name in seen[:TOLD]
        if name in known
        and chance[name] > SECOND
        and not (moves_joints(catalogue()[name]) and _vanished(known[name].part, known[name].x))
    ]
    sited = [known[name] for name in expected]
    look: list[tuple[Explained, float]] = []
    if sited:
        # Found alone, it sat where the best does if that hid it.
        elsewhere = told(evidence.windows, left, expected, patient.training)
        look = paired(evidence.windows, known[best], sited, patient.training, elsewhere)
        better = {one.part.cause: one for one, _ in look}
        sited = [better.get(one.part.cause, one) for one in sited]
    odd = left.energy > STRANGE
    hidden = [
        one
        for name, one in known.items()
        if name not in (best, *expected)
        and (one.beyond_tolerance or odd)
        and (moves_joints(catalogue()[name]) or (odd and carries(catalogue()[name])))
    ]
    if odd:
        # What carries or holds the body shows in every joint, and the judge of joints takes it for anything.
        hidden += bodily(patient.protocol, known)
    look = []
    if hidden and patient.in_time("second causes that the judge does not expect"):
        look = paired(evidence.windows, known[best], hidden, patient.training)
    whole = evidence.alone.get(best, evidence.plain)
    lost = odd and whole.after > STRAYS * evidence.floor and not catalogue()[best].random
    if lost and patient.in_time("second causes that nobody suspects"):
        groups = patient.protocol.servos()
        strained = whole.outlier(groups, STRAINED)
        places = [
            known[best].part.joints,
            *everywhere(patient.protocol),
            *([(strained,)] if strained is not None else []),
        ]
        look += unexpected(
            evidence.windows,
            known[best],
            {best, *(one.part.cause for one in hidden), *expected},
            places,
            patient.training,
        )
    plain = _plain(look)
    look.sort(key=lambda pair: _rank(chance.get(pair[0].part.cause, 0.0), pair[1]), reverse=True)
    out = [*sited, *(one for one, _ in look[:MORE])]
    alone = [name for name in explained if name != best and name in evidence.alone and moves_joints(catalogue()[name])]
    if alone:
        # What closes much by itself may do so beside the best, too.
        least = max(alone, key=lambda name: evidence.alone[name].closed)
        gains = evidence.alone[least].closed - evidence.plain.closed
        if gains > ADDS_MUCH and least not in {one.part.cause for one in out}:
            out.append(explained[least])
    return out, plain


def _plain(look: Sequence[tuple[Explained, float]]) -> Part | None:
    """The one of some causes that leaves much less than without it, as a share, and clearly less than all others."""
    shares = sorted(share for _, share in look)
    if not shares or shares[0] > PROVES * (shares[1] if len(shares) > 1 else 1.0):
        return None
    return min(look, key=lambda pair: pair[1])[0].part


def _polished(evidence: _Evidence, chosen: _Chosen) -> _Chosen:
    """The same causes, fitted once more: near them tolerances do something else than they did without."""
    _, _, (closure,) = evidence.closures([chosen.closure.refit], anew=True)
    if closure.closed < chosen.closure.closed:
        return chosen
    if len(chosen.names) == 1:
        evidence.alone[chosen.names[0]] = closure
    return dataclasses.replace(chosen, closure=closure)


def _verdict(
    evidence: _Evidence, names: Sequence[str], leader: _Leader, chosen: _Chosen
) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """The verdict, the causes selected, and those that these runs cannot tell apart."""
    probability, energy, best, left = evidence.probability, evidence.judgement.energy, leader.name, leader.left
    if not _sure(evidence, names, leader):
        # No robot of the build leaves so much, and looks so strange, whatever no suspect can be convicted of.
        ill = energy > STRANGE and evidence.plain.after > STRAYS * evidence.floor
        return UNEXPLAINED if ill or energy > ODD else NONE, (), ()
    # What is half believed does not come before what is certain, whatever it closes.
    certain = any(probability[name] > CERTAIN for name in chosen.names)
    # Nor is it a riddle what a random cause leaves: beside a likely one, or by itself where it is certain.
    noisy = probability[best] > FINDING and any(
        catalogue()[name].random and probability[name] > (CERTAIN if name == best else FINDING) for name in chosen.names
    )
    # What the judge was sure of before it knew of anything is no riddle where there are two of it, one of which joints can show.
    shows = any(moves_joints(catalogue()[name]) or carries(catalogue()[name]) for name in chosen.names)
    both = len(chosen.names) > 1 and certain and shows and _found_both(evidence, *chosen.names) > 0
    little = excess(evidence.before, evidence.floor) > LARGE * evidence.floor and chosen.closure.closed < EXPLAINS
    refit = evidence.alone[best].refit
    vanished = _vanished(refit.hypothesis[0], refit.x[0]) and not catalogue()[best].random
    as_odd = left is not None and left.energy > ODD and leader.gained < ADDS_ALONE
    doubtful = probability[best] < CERTAIN or vanished or as_odd
    if not leader.beside and little and energy > STRANGE and doubtful and not noisy and not both:
        # However sure the judge is: what comes out as nothing at all, or closes little and leaves a robot as odd as it was, is not
        # what makes the gap. No fit finds what is random.
        return UNEXPLAINED, (), ()
    odd = left is not None and min(energy, left.energy) > STRANGE
    if leader.beside and not certain and odd and chosen.closure.closed < CLOSES_MOST:
        # Strange with it, too: a foot that came off is no offset, though nothing known is more like it.
        return UNEXPLAINED, (), ()
    large = chosen.closure.after > STRAYS * evidence.floor
    astray = chosen.closure.after > ASTRAY * evidence.floor
    riddle = (large and chosen.energy > RIDDLE) or (astray and chosen.energy > STRANGE)
    # What leaves the gap and all that is strange as they were has no part in either.
    stays = left is not None and leader.gained < ADDS and left.energy > STAYS * energy
    no_part = stays and len(chosen.names) == 1 and not catalogue()[best].random
    if riddle and not noisy and not both and (no_part or chosen.closure.closed < EXPLAINS_RIDDLE):
        # The better half of a gap that is still a riddle: it only looks like what it was called.
        return UNEXPLAINED, (), ()
    if not certain and carries(catalogue()[best]) and chosen.closure.closed < evidence.plain.closed - ADDS:
        # Joints show little of what carries the robot, but they do not move farther from their model with it.
        return UNEXPLAINED, (), ()
    doubted = [
        name for name in chosen.names if certain and (probability[name] < SECOND or _idle(evidence, chosen, name))
    ]
    selected = tuple(sorted(chosen.names, key=lambda name: (name in doubted, -chosen.removal[name])))
    near = [
        name
        for name in names[1:3]
        if abs(evidence.closed(evidence.alone[name]) - evidence.closed(evidence.alone[best])) < APART
    ]
    equal = [
        name
        for name in near
        # Of what looks alike the judge cannot say which it is, either.
        if name in catalogue()[best].alike or (not leader.beside and probability[name] > probability[best] / 2)
    ]
    if not equal:
        return selected[0], selected, ()
    group = (best, *equal)
    if evidence.patient.declared(group) == best:
        return best, tuple(sorted(selected, key=lambda name: name != best)), (group,)
    return AMBIGUOUS, selected, (group,)


def _idle(evidence: _Evidence, chosen: _Chosen, name: str) -> bool:
    """Whether only the judge's word speaks for a cause, and that is not certain.

    What it does not expect before it knows of the other may be what that one leaves where it was misplaced: it has to add more.
    """
    expected = dict(evidence.ranked).get(name, 0.0) > SECOND
    return evidence.probability[name] < CERTAIN and chosen.removal[name] < (ADDS if expected else ADDS_MUCH)


def _sure(evidence: _Evidence, names: Sequence[str], leader: _Leader) -> bool:
    """Whether there is any finding at all."""
    probability, energy, best = evidence.probability, evidence.judgement.energy, leader.name
    surest = max(probability[name] for name in names)
    if probability[best] < CERTAIN and not evidence.explained[best].beyond_tolerance:
        return False
    return (
        probability[best] > (SECOND if energy > STRANGE else FINDING)
        or leader.eased
        or (
            (energy > 1 or evidence.plain.after > STRAYS * evidence.floor or probability[best] > MAYBE)
            and leader.proved
            and evidence.closed(evidence.alone[best]) > EXPLAINS
        )
        # Where the judge is sure of something, and the log is strange, which of its suspects it is the fits may say.
        or (energy > STRANGE and surest > FINDING)
        or (energy > 1 and surest > CERTAIN)
    )


def _put_down(evidence: _Evidence, said: _Said) -> Diagnosis:
    verdict, selected, chosen = said.verdict, said.selected, said.chosen
    patient, probability, whole = evidence.patient, evidence.probability, chosen.closure
    order = [*selected, *(name for name in said.names if name not in selected)]
    # The set was re-fitted together: these are the sizes that leave what it leaves.
    points = dict(zip((part.cause for part in whole.refit.hypothesis), whole.refit.x, strict=True))
    effects = []
    for name in order:
        one, alone = evidence.explained[name], evidence.alone.get(name)
        if name in points:
            one = dataclasses.replace(one, x=points[name])
            alone = alone and dataclasses.replace(alone, refit=whole.refit)
        effects.append(found_of(patient, one, probability[name], alone))
    gap = {
        "before": evidence.before, "after": evidence.before if verdict == NONE else whole.after,
        "floor": evidence.floor, "refit": evidence.plain.after,
    }  # fmt: skip
    chance = probability[said.leader.name]
    return diagnosis_of(
        patient, verdict, 1 - chance if verdict == NONE else chance,
        (*effects, *unfitted(evidence.ranked, order)), selected, said.ambiguous, gap,
        {name: chosen.removal[name] for name in selected}, evidence.judgement,
        None if verdict == NONE else (evidence.windows, whole.refit),
    )  # fmt: skip


def _closures(
    windows: Windows, patient: Patient, starts: Sequence[Refit], *, anew: bool = False
) -> tuple[float, float, list[ClosureByJoint]]:
    return closures(windows, starts, patient.held_out, patient.training, anew=anew)


def _worth_fitting(names: Sequence[str], cost: dict[str, float]) -> list[str]:
    """Of suspects, the most probable first, those that are likely or do not leave far more than the best of them."""
    least = min(cost.values())
    return [name for n, name in enumerate(names) if n < LIKELIEST_FITTED or cost[name] < FAR_WORSE * least]


def _rivals(evidence: _Evidence) -> dict[str, Explained]:
    """Causes that would leave less than any where the suspect sits that leaves least, or the likeliest; fitted like those."""
    explained, alone, training = evidence.explained, evidence.alone, evidence.patient.training
    suspects = [name for name in explained if moves_joints(catalogue()[name])]
    if not suspects:
        return {}
    least = max(suspects, key=lambda name: evidence.closed(alone[name]))
    likeliest = max(suspects, key=evidence.score)
    best = [explained[name] for name in dict.fromkeys((least, likeliest))]
    lost = evidence.judgement.energy > STRANGE and max(evidence.probability.values()) < FINDING
    places = everywhere(evidence.patient.protocol) if lost else ()
    found = rivals(evidence.windows, best, explained, training, places=places, where=evidence.where)
    return {one.part.cause: one for one in fit(scene_of(least, evidence.scenes), found)} if found else {}


def _vanished(part: Part, x: Mapping[str, float]) -> bool:
    """Whether of a cause nothing is left where a fit ended."""
    return all(abs(x[q.name]) < VANISHED * q.small for q in part.definition.quantities if not q.shape)


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


def _rank(probability: float, left: float) -> float:
    return math.log(max(probability, 1e-3)) - LEFT_COUNTS * math.log(max(left, 0.0) + 0.05)
