"""Simulated robots at random, all of them as different as one build is, and the causes that a recording can show."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from openant_tools.effects.catalogue import catalogue, enter
from openant_tools.effects.effect import Cause
from openant_tools.effects.robot import Robot
from openant_tools.gap.protocol import RunSet
from openant_tools.gap.tolerance import random_form, scatter

__all__ = ["WARMING_C", "WIDTH", "Case", "applicable", "robot_of"]

#: what tolerances are drawn wider by
WIDTH = 1.15
#: °C by which servos warm up at most from one run to the next
WARMING_C = 5.0


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


def robot_of(protocol: RunSet, case: Case) -> Robot:
    """One with the scatter of a build, and the causes of a case."""
    reference = protocol.reference
    robot = Robot(len(protocol.joints), reference.low, reference.high)
    rng = np.random.default_rng((977, case.seed))
    scatter(robot, reference, rng, WIDTH)
    enter(robot, reference, [(name, joints, x) for name, (joints, x) in case.causes.items()])
    robot.warming_c = float(rng.uniform(0, WARMING_C))
    robot.form = random_form(rng, reference.seen.encoder_rad)
    return robot
