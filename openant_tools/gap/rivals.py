"""Where a suspect sits, and what else would do there: first looks at many causes on windows of the runs, without a fit of each.

The judge names suspects by what a whole log looks like, and a fit to features sizes them. Neither has looked at how a joint
moves in every window of every run, and that decides between causes that are much alike.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.effect import Cause, Scope
from openant_tools.gap.closure import Windows, unmoved
from openant_tools.gap.explain import Explained, Part
from openant_tools.gap.judge import Judgement
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.thresholds import HEAT
from openant_tools.model.plant import Setup

__all__ = [
    "bodily",
    "carries",
    "everywhere",
    "moves_joints",
    "paired",
    "placed",
    "resized",
    "rivals",
    "told",
    "unexpected",
]

#: places that the judge names among which the runs choose, and those whose sizes are tried wider
NAMED, WIDER = 8, 2
#: times the least cost at all its places that a body's cause may leave where it was fitted: there windows of joints say little
UNDECIDED = 1.5
#: share of what a cause leaves that a rival leaves at most; how many of them count, and the sizes (0 … 1) they are tried in
LEAVES, COUNT, STRENGTHS = 0.9, 2, (0.3, 0.7)
#: share of a size within which another one is the same to a fit
NEAR = 0.25
#: places of a second cause that the judge names, once it knows the first
TOLD_AT = 3
#: shares of the sizes found alone in which two causes are tried together
PARTS = (1.0, 0.6)


def placed(
    windows: Windows, judgement: Judgement, explained: Mapping[str, Explained], training: Sequence[int]
) -> dict[str, tuple[Explained, float]]:
    """The same causes where the runs, on the stand and on the floor, say that they sit: where the judge names, or wider.

    What was fitted on the stand alone knows nothing of a joint that carries its load on the floor.

    Args:
        windows: on which `nothing` was re-fitted. training: the runs to look at.

    Returns:
        of each cause where it sits, and the cost that it leaves there.
    """
    strained = windows.strained(training)
    tried = [
        other for one in explained.values() for other in [one, *_places(windows.protocol, judgement, one, strained)]
    ]
    left = windows.left([unmoved(windows, [other.part], [other.x]) for other in tried], training)
    out: dict[str, tuple[Explained, float]] = {}
    for k in np.argsort(left):
        out.setdefault(tried[k].part.cause, (tried[k], float(left[k])))
    for one, cost in zip(tried, left, strict=True):
        name = one.part.cause
        if one is explained[name] and catalogue()[name].unseen_in_joints and cost < UNDECIDED * out[name][1]:
            out[name] = one, float(cost)
    return {name: out[name] for name in explained}


def _places(protocol: Protocol, judgement: Judgement, one: Explained, strained: Sequence[int]) -> list[Explained]:
    """Where else it may sit than where it was fitted."""
    if catalogue()[one.part.cause].random:
        return []
    scopes = one.part.definition.scopes
    named = [(one.part.joints, one.x), *judgement.places[one.part.cause][:NAMED]]
    wider = [tuple(group) for group in protocol.servos()] if Scope.SERVO in scopes else []
    wider += [(j,) for j in strained] if Scope.JOINT in scopes else []
    wider += [tuple(range(len(protocol.joints)))] if Scope.ALL in scopes else []
    places = {(where, tuple(x.items())): x for where, x in named}
    places |= {(where, tuple(x.items())): x for where in wider for _, x in named[:WIDER]}
    if one.part.cause == HEAT:
        # How warm this robot was no template knew, and where feet chatter no fit to features finds how much it lost.
        sizes = [x for strength in STRENGTHS for x in one.part.definition.starts(strength)]
        places |= {(where, tuple(x.items())): x for where in [*(where for where, _ in named), *wider] for x in sizes}
    del places[one.part.joints, tuple(one.x.items())]
    return [dataclasses.replace(one, part=Part(one.part.cause, where), x=x) for (where, _), x in places.items()]


def resized(windows: Windows, explained: Sequence[Explained], training: Sequence[int]) -> list[Explained]:
    """Each of these causes in the size, of a few that are not near its own, that leaves least.

    Args:
        windows: on which `nothing` was re-fitted. training: the runs to look at.
    """
    tried = [
        dataclasses.replace(one, x=x)
        for one in explained
        for strength in STRENGTHS
        for x in one.part.definition.starts(strength)
        if any(abs(x[q.name] - one.x[q.name]) > NEAR * abs(one.x[q.name]) for q in one.part.definition.quantities)
    ]
    left = windows.left([unmoved(windows, [one.part], [one.x]) for one in tried], training)
    out: dict[str, Explained] = {}
    for k in np.argsort(left):
        out.setdefault(tried[k].part.cause, tried[k])
    return list(out.values())


def rivals(
    windows: Windows,
    best: Sequence[Explained],
    known: Collection[str],
    training: Sequence[int],
    *,
    places: Sequence[tuple[int, ...]] = (),
    where: Sequence[int] | None = None,
) -> dict[Part, dict[str, float]]:
    """Causes that nobody suspected and that leave clearly less than the best suspects, where those sit or a joint is strained.

    Args:
        windows: on which `nothing` was re-fitted. known: causes that are suspected already.
        training: the runs to look at. places: where else to look. where: joints of which it counts what is left; default all.

    Returns:
        their sizes.
    """
    protocol = windows.protocol
    anywhere = [*(one.part.joints for one in best), *((j,) for j in windows.strained(training)), *places]
    if where is not None:
        # What acts on others, too, does as much there: only they would tell.
        anywhere = [joints for joints in anywhere if set(joints) <= set(where)]
    others = _others(protocol, anywhere, known)
    tried = [*((one.part, one.x) for one in best), *others]
    left = windows.left([unmoved(windows, [part], [x]) for part, x in tried], training, where)
    least, rest = left[: len(best)].min(), left[len(best) :]
    found: dict[Part, dict[str, float]] = {}
    for k in np.argsort(rest):
        part, start = others[k]
        if rest[k] > LEAVES * least or len(found) == COUNT:
            break
        if part.cause not in [other.cause for other in found]:
            found[part] = start
    return found


def _others(
    protocol: Protocol, places: Sequence[tuple[int, ...]], known: Collection[str]
) -> list[tuple[Part, dict[str, float]]]:
    """Causes that are not known yet and move joints, at each of these places that they may sit at, in a few sizes."""
    return [
        (Part(name, joints), start)
        for joints in dict.fromkeys(places)
        for name, cause in catalogue().items()
        if name not in known
        and moves_joints(cause)
        and _fits(cause, joints, protocol)
        and cause.shows(protocol.reference)
        for turn, strength in enumerate(STRENGTHS)
        for start in cause.starts(strength, turn, len(STRENGTHS))
    ]


def everywhere(protocol: Protocol) -> list[tuple[int, ...]]:
    """The servos of each model, and all joints."""
    return [*(tuple(group) for group in protocol.servos()), tuple(range(len(protocol.joints)))]


def bodily(protocol: Protocol, known: Collection[str]) -> list[Explained]:
    """Causes of the body and the floor of which no size is known yet."""
    joints = tuple(range(len(protocol.joints)))
    return [
        Explained(Part(name, joints), nowhere, nowhere, np.inf)
        for name, cause in catalogue().items()
        if name not in known and cause.of_body and carries(cause) and cause.shows(protocol.reference)
        for nowhere in [{q.name: 0.0 for q in cause.quantities}]
    ]


def paired(
    windows: Windows,
    best: Explained,
    others: Sequence[Explained],
    training: Sequence[int],
    elsewhere: Sequence[Explained] = (),
) -> list[tuple[Explained, float]]:
    """Of causes that leave clearly less beside the best than it leaves alone: how much, as a share; at their best sizes.

    Found alone, each took for its own what was the other's: both are tried at part of their sizes, too. Of what nothing was left
    for alone neither size nor place is known: it is tried in a few sizes where the best sits, too.

    Args:
        windows: on which `nothing` was re-fitted. training: the runs to look at.
        elsewhere: the same causes at other places, which are tried as they are.
    """
    guesses = [there for one in others for there in _guesses(one, best, windows.protocol)]
    pairs = [(there, _part(best, whole)) for there in [*guesses, *elsewhere] for whole in PARTS]
    refits = [unmoved(windows, [best.part], [best.x])]
    refits += [unmoved(windows, [best.part, one.part], [x, one.x]) for one, x in pairs]
    least, *left = windows.left(refits, training)
    found: dict[str, tuple[Explained, float]] = {}
    for k in np.argsort(left):
        one, share = pairs[k][0], float(np.sqrt(left[k] / least))
        if share < LEAVES:
            found.setdefault(one.part.cause, (one, share))
    return list(found.values())


def unexpected(
    windows: Windows,
    best: Explained,
    known: Collection[str],
    places: Sequence[tuple[int, ...]],
    training: Sequence[int],
) -> list[tuple[Explained, float]]:
    """Causes that nobody suspects and that leave clearly less beside the best than it leaves alone: how much, as a share.

    Args:
        windows: on which `nothing` was re-fitted. known: causes that are looked at anyway. places: joints where to look.
        training: the runs to look at; those on the stand, where there are any: there joints show what acts on them, and at once.
    """
    stand = [k for k in training if windows.protocol.runs[k].plant.setup is Setup.STAND]
    others = _others(windows.protocol, places, known)
    tried = [Explained(part, x, dict.fromkeys(x, 0.0), np.inf) for part, x in others]
    refits = [unmoved(windows, [best.part], [best.x])]
    refits += [unmoved(windows, [best.part, one.part], [best.x, one.x]) for one in tried]
    least, *left = windows.left(refits, stand or training)
    found: dict[str, tuple[Explained, float]] = {}
    for k in np.argsort(left):
        share = float(np.sqrt(left[k] / least))
        if share > LEAVES:
            break
        found.setdefault(tried[k].part.cause, (tried[k], share))
    return list(found.values())


def _guesses(one: Explained, best: Explained, protocol: Protocol) -> list[Explained]:
    cause = one.part.definition
    places = {one.part.joints} | ({best.part.joints} if _fits(cause, best.part.joints, protocol) else set())
    if one.beyond_tolerance:
        # Where it was found alone, the best was in its way.
        places |= {joints for joints in everywhere(protocol) if _fits(cause, joints, protocol)}
        return [
            dataclasses.replace(one, part=Part(cause.name, joints), x=_part(one, share))
            for joints in sorted(places)
            for share in PARTS
        ]
    return [
        dataclasses.replace(one, part=Part(cause.name, joints), x=x)
        for joints in sorted(places)
        for strength in STRENGTHS
        for x in cause.starts(strength)
    ]


def told(windows: Windows, judgement: Judgement, causes: Collection[str], training: Sequence[int]) -> list[Explained]:
    """Some causes where a judge says that they sit, in the sizes of the templates that say so; and where a joint is strained."""
    named = [(name, *there) for name in causes for there in judgement.places[name][:TOLD_AT]]
    named += [
        (name, (j,), x)
        for name in causes
        for j in windows.strained(training)
        if _fits(catalogue()[name], (j,), windows.protocol)
        for strength in STRENGTHS
        for x in catalogue()[name].starts(strength)
    ]
    return [Explained(Part(name, joints), x, dict.fromkeys(x, 0.0), np.inf) for name, joints, x in named]


def _fits(cause: Cause, joints: tuple[int, ...], protocol: Protocol) -> bool:
    everywhere = len(joints) == len(protocol.joints)
    return (Scope.JOINT if len(joints) == 1 else Scope.ALL if everywhere else Scope.SERVO) in cause.scopes


def _part(one: Explained, share: float) -> dict[str, float]:
    return {q.name: one.x[q.name] * (1.0 if q.shape else share) for q in one.part.definition.quantities}


def carries(cause: Cause) -> bool:
    """Whether it changes how a robot stands and what its joints carry: on the floor all positions show that a little."""
    return (cause.of_body or cause.silent) and cause.signal is None


def moves_joints(cause: Cause) -> bool:
    """Whether windows of joint positions can tell it: it acts on joints, and the same way each time."""
    return not cause.unseen_in_joints and not cause.random
