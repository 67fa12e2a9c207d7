"""Simulated robots at random: healthy ones, and ones with one cause or several, all of them as different as one build is."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue, enter
from openant_tools.effects.effect import Cause, Scope
from openant_tools.effects.robot import Robot
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.tolerance import random_form, scatter

__all__ = ["Case", "applicable", "draw", "robot_of"]

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


@dataclass(frozen=True)
class Case:
    """What a simulated robot has.

    Attributes:
        causes: name → (indices of joints, coordinates).
        seed: of its scatter; below 0 for a template, which has none.
    """

    causes: dict[str, tuple[tuple[int, ...], dict[str, float]]]
    seed: int


def applicable(protocol: RunSet) -> list[Cause]:
    """The causes that can show on what this protocol recorded."""
    # What is prepared serves robots with any sensors: what shows only to some is left to the judge.
    floor = protocol.reference.floor
    everything = dataclasses.replace(protocol.reference, imu=floor, tracker=floor)
    return [cause for cause in catalogue().values() if cause.shows(everything)]


def draw(protocol: RunSet, seed: int, causes: list[Cause] | None = None) -> Case:
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


def place(cause: Cause, protocol: RunSet, rng: np.random.Generator) -> Ints:
    """Joints that a cause may sit at."""
    scope = Scope(rng.choice([str(scope) for scope in cause.scopes]))
    everything = np.arange(len(protocol.joints))
    if scope is Scope.JOINT:
        return rng.choice(everything, 1)
    if scope is Scope.SERVO:
        groups = protocol.servos()
        return np.array(groups[int(rng.integers(len(groups)))])
    return everything


def robot_of(protocol: RunSet, case: Case) -> Robot:
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
