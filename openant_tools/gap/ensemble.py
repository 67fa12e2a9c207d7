"""Simulated robots on a recording's own commands, in its own windows: one for each cause, and healthy ones as varied as one build.

What each cause does to this recording, what tolerances and sensors do, and what noise is left follow from the physics of the
model at hand; nothing of it is learned. How such evidence weighs is (`gap.decide`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import enter
from openant_tools.effects.effect import Cause, Scope
from openant_tools.effects.robot import Robot
from openant_tools.gap.features import Floats
from openant_tools.gap.population import WARMING_C, Case, applicable, robot_of
from openant_tools.gap.protocol import Played, RunSet, rollouts_of
from openant_tools.gap.sensors import logged_by, widened
from openant_tools.gap.simulation import simulate
from openant_tools.model.plant import Setup

__all__ = ["robot_at", "robots_at", "templates_at", "templates_of"]

Ints = NDArray[np.int64]

#: strengths of templates where one joint has a cause, and where more have
OF_ONE, OF_MORE = (0.6,), (0.35, 0.8)
#: beyond which a feature says only that it is large
LARGEST = 1e4
#: seed of a case that has no scatter
EXACT = -1


def templates_of(protocol: RunSet) -> list[Case]:
    """Every cause at every place that it may sit, with either sign, on a robot that is else as the model says.

    First those of one place at the edge of what robots of one build differ by: what healthy robots do (`gap.whitening`).
    """
    edges, out = [], []
    for cause in applicable(protocol):
        where = _places(cause, protocol)
        for joints in [at for at in where if len(at) == 1] or where[-1:]:
            edges += [Case({cause.name: (joints, x)}, EXACT) for x in cause.edges(protocol.reference, np.array(joints))]
        for joints in where:
            # Shapes are sought at half their levels at one joint, and at all of them, in turn, where more have them.
            strengths = OF_ONE if len(joints) == 1 < len(protocol.joints) else OF_MORE
            for turn, strength in enumerate(strengths):
                out += [Case({cause.name: (joints, x)}, EXACT) for x in cause.starts(strength, turn, len(OF_MORE))]
    return edges + out


def _places(cause: Cause, protocol: RunSet) -> list[tuple[int, ...]]:
    """Indices of joints that a cause may sit at, single ones first."""
    everything = tuple(range(len(protocol.joints)))
    out: list[tuple[int, ...]] = []
    if Scope.JOINT in cause.scopes:
        out += [(j,) for j in everything]
    if Scope.SERVO in cause.scopes and len(protocol.servos()) > 1:
        out += [tuple(group) for group in protocol.servos()]
    if everything not in out and ({Scope.ALL, Scope.BODY} & set(cause.scopes) or not out):
        out.append(everything)
    return out


def templates_at(protocol: RunSet, bank: Sequence[Case]) -> list[Floats]:
    """Of each run, (templates, features): what each does otherwise than the model."""
    out = []
    for k, played in enumerate(protocol.runs):
        groups = _side_by_side(bank, played)
        robots = [Robot(len(protocol.joints), protocol.reference.low, protocol.reference.high) for _ in groups]
        for robot, group in zip(robots, groups, strict=True):
            for n in group:
                enter(robot, protocol.reference, [(name, at, x) for name, (at, x) in bank[n].causes.items()])
            robot.heat_c += WARMING_C / 2 * k
        signals = _simulated(played, [Robot(len(protocol.joints)), *robots], seed=k)
        found = played.layout.features(_others(signals), _first(signals))
        of_tree = played.plant.tree[_joints(played)]
        features = np.zeros((len(bank), found.shape[1]), np.float32)
        for row, group in zip(found, groups, strict=True):
            for n in group:
                # Where trees stand apart, what one does is nothing to the others.
                mine = of_tree == played.plant.tree[_only(bank[n])] if len(group) > 1 else slice(None)
                features[n, mine] = row[mine]
        out.append(_bounded(features))
    return out


def robot_at(protocol: RunSet, robots: Sequence[Robot]) -> Floats:
    """(features,) of all runs side by side: what one robot, as it was on each, does otherwise than the model."""
    out = []
    for k, (played, robot) in enumerate(zip(protocol.runs, robots, strict=True)):
        signals = _simulated(played, [Robot(len(protocol.joints)), robot], seed=k)
        out.append(played.layout.features(_others(signals), _first(signals)))
    found: Floats = _bounded(np.concatenate(out, axis=1))[0]
    return found


def robots_at(protocol: RunSet, cases: Sequence[Case], seed: int) -> list[Floats]:
    """Of each run, (robots, features): what robots with all the scatter of one build do otherwise than the model, as they log it."""
    rng = np.random.default_rng((551, seed))
    robots = [robot_of(protocol, case) for case in cases]
    for robot, case in zip(robots, cases, strict=True):
        widened(robot, np.random.default_rng((983, case.seed)))
    order, heat, steps = rng.permutation(len(protocol.runs)), [one.heat_c for one in robots], protocol.resolution()
    out = []
    for k, played in enumerate(protocol.runs):
        for robot, begun in zip(robots, heat, strict=True):
            robot.heat_c = begun + robot.warming_c * float(order[k])
        signals = _simulated(played, [Robot(len(protocol.joints)), *robots], seed=seed * 64 + k, misread=True)
        logs = logged_by(robots, _others(signals), steps, rng, played.layout.t)
        out.append(_bounded(played.layout.features(logs, _first(signals))))
    return out


def _simulated(played: Played, robots: Sequence[Robot], seed: int, *, misread: bool = False) -> dict[str, Floats]:
    rollouts = rollouts_of([played], nthread=1)
    return simulate(rollouts, robots, seed, played.signals, [played.warm_c], misread=misread).signals


def _first(signals: dict[str, Floats]) -> dict[str, Floats]:
    return {name: values[:1] for name, values in signals.items()}


def _others(signals: dict[str, Floats]) -> dict[str, Floats]:
    return {name: values[1:] for name, values in signals.items()}


def _bounded(features: Floats) -> Floats:
    # A robot that no step can hold as one shows as very ill, not as infinite.
    return np.clip(np.nan_to_num(features, nan=0.0, posinf=LARGEST, neginf=-LARGEST), -LARGEST, LARGEST)


def _only(case: Case) -> int:
    """The joint of a case that sits at one."""
    ((at, _x),) = case.causes.values()
    return at[0]


def _joints(played: Played) -> Ints:
    """(features,) the joint of each, −1 for those of none."""
    return np.concatenate([played.layout.joints_of(signal) for signal in played.signals])


def _side_by_side(bank: Sequence[Case], played: Played) -> list[list[int]]:
    """Templates that one simulation shows: of one cause and size, at joints of trees that do not move each other."""
    tree = played.plant.tree
    if played.plant.setup is Setup.FLOOR or len(set(tree.tolist())) == 1:
        return [[n] for n in range(len(bank))]
    out: list[list[int]] = []
    begun: dict[tuple[object, ...], list[list[int]]] = {}
    for n, case in enumerate(bank):
        if len(case.causes) != 1 or len(next(iter(case.causes.values()))[0]) > 1:
            out.append([n])
            continue
        ((name, (at, x)),) = case.causes.items()
        groups = begun.setdefault((name, *x.items()), [])
        free = next((one for one in groups if tree[at[0]] not in {tree[_only(bank[m])] for m in one}), None)
        if free is None:
            groups.append(free := [])
            out.append(free)
        free.append(n)
    return out
