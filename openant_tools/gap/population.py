"""Simulated robots at random: healthy ones, and ones with one cause or several, all of them as different as one build is."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue, enter
from openant_tools.effects.effect import Cause, Scope
from openant_tools.effects.robot import Robot
from openant_tools.gap.features import Floats, with_noise
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.simulation import simulate
from openant_tools.gap.tolerance import random_form, resting, scatter
from openant_tools.model.plant import Setup
from openant_tools.model.rollout import Rollouts

__all__ = ["Case", "applicable", "draw", "play", "templates"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

#: how many robots have none, one, two … causes
COUNTS = (0.19, 0.40, 0.28, 0.09, 0.04)
#: of one joint's model robots have more causes at once: it is cheap, and real servos have many
COUNTS_ONE_JOINT = (0.15, 0.30, 0.2, 0.15, 0.1, 0.06, 0.04)
#: what tolerances are drawn wider by
WIDTH = 1.15
#: °C by which servos warm up at most from one run to the next
WARMING_C = 5.0
#: how unequal the joints are that share a cause
UNEQUAL = 0.1
#: strengths of templates
TEMPLATES = (0.2, 0.5, 0.85)
#: beyond which a feature says only that it is large
LARGEST = 1e4


@dataclass(frozen=True)
class Case:
    """What a simulated robot has.

    Attributes:
        causes: name → (indices of joints, coordinates).
        seed: of its scatter; below 0 for a template, which has none.
    """

    causes: dict[str, tuple[tuple[int, ...], dict[str, float]]]
    seed: int


def applicable(protocol: Protocol) -> list[Cause]:
    """The causes that can show on what this protocol recorded."""
    # What is prepared serves robots with any sensors: what shows only to some is left to the judge.
    floor = protocol.reference.floor
    everything = dataclasses.replace(protocol.reference, imu=floor, tracker=floor)
    return [cause for cause in catalogue().values() if cause.shows(everything)]


def draw(protocol: Protocol, seed: int, causes: list[Cause] | None = None) -> Case:
    """A robot at random; the same for the same seed."""
    rng = np.random.default_rng((813, seed))
    causes = applicable(protocol) if causes is None else causes
    counts = COUNTS_ONE_JOINT if len(protocol.joints) <= 2 else COUNTS
    count = int(rng.choice(len(counts), p=counts))
    chosen = rng.choice(len(causes), size=min(count, len(causes)), replace=False)
    out = {}
    for k in chosen:
        cause = causes[int(k)]
        out[cause.name] = (
            tuple(int(j) for j in place(cause, protocol, rng)),
            cause.draw(rng, float(rng.uniform(0, 1))),
        )
    return Case(out, seed)


def place(cause: Cause, protocol: Protocol, rng: np.random.Generator) -> Ints:
    """Joints that a cause may sit at."""
    scope = Scope(rng.choice([str(scope) for scope in cause.scopes]))
    everything = np.arange(len(protocol.joints))
    if scope is Scope.JOINT:
        return rng.choice(everything, 1)
    if scope is Scope.SERVO:
        groups = protocol.servos()
        return np.array(groups[int(rng.integers(len(groups)))])
    return everything


def robot_of(protocol: Protocol, case: Case) -> Robot:
    """The robot that a case describes."""
    reference = protocol.reference
    robot = Robot(len(protocol.joints), reference.low, reference.high)
    if case.seed < 0:
        enter(robot, reference, [(name, joints, x) for name, (joints, x) in case.causes.items()])
        robot.warming_c = WARMING_C / 2
        return robot
    rng = np.random.default_rng((977, case.seed))
    scatter(robot, reference, rng, WIDTH)
    for name, (joints, x) in case.causes.items():
        cause = catalogue()[name]
        if len(joints) == 1 or not {Scope.JOINT, Scope.SERVO} & set(cause.scopes):
            enter(robot, reference, [(name, joints, x)])
            continue
        for j in joints:
            own = {
                q.name: x[q.name] if q.shape else x[q.name] * float(np.exp(UNEQUAL * rng.normal()))
                for q in cause.quantities
            }
            # Sized by all joints that share it, it sits at each of them.
            cause.enter(robot, np.array([j]), cause.values(own, reference, np.array(joints)))
    if robot.shared_dropout:
        robot.shared_dropout = bool(rng.random() < 0.5)
    robot.warming_c = float(rng.uniform(0, WARMING_C))
    robot.form = random_form(rng, reference.seen.encoder_rad)
    return robot


def templates(protocol: Protocol) -> list[Case]:
    """Every cause at every place it may sit, in several sizes and either sign, on a robot that is else as the model says."""
    out = []
    everything = tuple(range(len(protocol.joints)))
    for cause in applicable(protocol):
        where: list[tuple[int, ...]] = []
        if Scope.JOINT in cause.scopes:
            where += [(j,) for j in everything]
        if Scope.SERVO in cause.scopes and len(protocol.servos()) > 1:
            where += [tuple(group) for group in protocol.servos()]
        if {Scope.ALL, Scope.BODY} & set(cause.scopes) and everything not in where:
            where.append(everything)
        for joints in where or [everything]:
            for turn, strength in enumerate(TEMPLATES):
                starts = cause.starts(strength, turn, len(TEMPLATES))
                out += [Case({cause.name: (joints, x)}, -1) for x in starts]
    return out


def play(protocol: Protocol, cases: Sequence[Case], seed: int) -> list[Floats]:
    """Features (robots, features) of each run of a protocol, against its own model without any cause.

    A case without a seed is a template: no scatter, no noise.
    """
    rng = np.random.default_rng((551, seed))
    # The first is the model itself, that the others are compared with.
    robots = [Robot(len(protocol.joints)), *(robot_of(protocol, case) for case in cases)]
    steps = {} if cases[0].seed < 0 else protocol.resolution()
    heat, turns = [robot.heat_c for robot in robots], _turns(protocol, rng)
    out = []
    for k, played in enumerate(protocol.runs):
        standing = played.plant.setup is Setup.FLOOR
        for n, (robot, begun) in enumerate(zip(robots, heat, strict=True)):
            robot.heat_c = begun + robot.warming_c * turns[k]
            if n and cases[n - 1].seed >= 0:
                at_rest = np.random.default_rng((979, cases[n - 1].seed, k))
                robot.start = resting(robot, protocol.reference, at_rest, standing=standing)
        rollouts = Rollouts(played.plant, [played.run], nthread=1)
        signals = simulate(rollouts, robots, seed=seed * 64 + k, signals=played.signals).signals
        nominal = {name: values[:1] for name, values in signals.items()}
        noisy = with_noise(
            {name: values[1:] for name, values in signals.items()}, robots[1:], steps, rng, played.layout.t
        )
        # A robot that no step can hold together shows as very ill, not as infinite.
        found = played.layout.features(noisy, nominal)
        out.append(np.clip(np.nan_to_num(found, nan=0.0, posinf=LARGEST, neginf=-LARGEST), -LARGEST, LARGEST))
    return out


def _turns(protocol: Protocol, rng: np.random.Generator) -> Ints:
    """(runs,) which run came first, which next: as they are given, or those on the stand first, or those on the floor."""
    floor = np.array([one.plant.setup is Setup.FLOOR for one in protocol.runs])
    orders = [np.arange(len(floor)), np.argsort(floor, kind="stable"), np.argsort(~floor, kind="stable")]
    order = orders[int(rng.integers(len(orders)))]
    return np.argsort(order)
