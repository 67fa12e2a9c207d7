"""The experiment that best separates what a diagnosis left open.

What is still possible is simulated on every protocol of the library; the protocol on which the two that are most alike differ
most, against how robots of one build differ, is the one to record. Where physics forbids commands and positions to tell two
effects apart, the effects know what to do with one's hands (`Effect.told_from`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import action
from openant_tools.effects.robot import USUAL_NOISE, Reference, Robot, Seen
from openant_tools.errors import BadInput
from openant_tools.gap.apply import robot_of
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED, Diagnosis, Found
from openant_tools.gap.protocol import FLOOR_STEP_S, STAND_STEP_S
from openant_tools.gap.simulation import simulate
from openant_tools.gap.tolerance import scatter
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.numbers import number
from openant_tools.recording.run import Facts, Run
from openant_tools.robot.joints import JOINTS
from openant_tools.sysid.protocols import FULL, PROTOCOLS, CommandSpace, Protocol, protocols

__all__ = ["Answer", "Experiment", "experiments", "suggestion"]

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

#: effects that count as still possible: probability at least, how many at most
POSSIBLE, MOST = 0.1, 4
#: simulated robots without any effect, by which is told what robots of one build differ by
BUILD = 12
#: s and Hz of a candidate's recording here: how motions compare does not need all of a recording
SECONDS, RATE_HZ = 8.0, 50.0
#: s over which signals are averaged before they are compared
BLOCK_S = 0.1
#: experiments shown
SHOWN = 5
#: kinds of motion without which too many causes fit a robot
KINDS = 3
#: rad, of joints without a range
REACH_RAD = 0.6


@dataclass(frozen=True)
class Experiment:
    """One thing to do.

    Attributes:
        name: of the protocol, or what to do by hand. words: for people.
        apart: whitened distance of the two possibilities that it leaves most alike, in standard deviations of robots of one
            build; None for what is not simulated. pair: those two.
    """

    name: str
    words: str
    apart: float | None
    pair: tuple[str, str]

    def as_json(self) -> dict[str, Any]:
        return {"name": self.name, "words": self.words, "apart": self.apart, "pair": list(self.pair)}


@dataclass(frozen=True)
class Answer:
    """What to do next: a sentence, what was still open, and experiments, best first."""

    sentence: str
    open: tuple[str, ...]
    experiments: tuple[Experiment, ...]

    def as_json(self) -> dict[str, Any]:
        return {
            "sentence": self.sentence,
            "open": list(self.open),
            "experiments": [one.as_json() for one in self.experiments],
        }


def experiments(
    found: Diagnosis, model: Path, *, names: Sequence[str] | None = None, progress: Progress | None = None
) -> Answer:
    """The experiments that would settle what is open.

    Args:
        model: the MJCF that was diagnosed.
        names: the protocols to consider; default all of the library that this robot can play.

    Raises:
        BadInput: the model lacks a joint of the diagnosis.
    """
    possible = _possible(found)
    if len(possible) < 2:
        return Answer(_nothing_open(found), tuple(one.effect for one in possible), ())
    tell = progress or (lambda share, words: None)
    by_hand = _by_hand(possible)
    simulated = _simulated(possible, found, model, names, tell)
    listed = sorted(simulated, key=lambda one: -(one.apart or 0.0))[:SHOWN]
    open_ = tuple(one.effect for one in possible)
    if listed and (listed[0].apart or 0.0) >= 1.0:
        best = listed[0]
        said = (
            f"Record `{best.name}`: even {best.pair[0]} and {best.pair[1]} differ there by {number(best.apart)} standard "
            "deviations of robots of one build."
        )
    elif by_hand:
        said = f"No motion tells {' from '.join(by_hand[0].pair)} well; {by_hand[0].name}: {by_hand[0].words}."
    else:
        said = "No protocol of the library tells these apart well; log more signals (current, voltage, IMU), or repeat the runs."
    return Answer(said, open_, (*listed, *by_hand))


def suggestion(verdict: str, together: Sequence[Sequence[str]], kinds: int) -> str | None:
    """What to record or do to settle what a diagnosis leaves open, without simulating anything; None where nothing is.

    Args:
        together: causes that it could not tell apart. kinds: of motion, that its runs had.
    """
    if verdict not in (AMBIGUOUS, UNEXPLAINED):
        return None
    if kinds < KINDS:
        return (
            f"record at least {KINDS} kinds of motion, steps and slow reversals among them, and each at two gains where the "
            "servo lets you: too many causes fit fewer"
        )
    for group in together:
        for pair in itertools.combinations(group, 2):
            found = action(*pair)
            if found is not None:
                return f"{found.name}: {found.words}"
    if verdict == AMBIGUOUS:
        return "record another motion: `openant gap next` on the JSON of this diagnosis says which tells these causes apart best"
    return (
        "look at the robot where the gap is largest, and repeat the runs, so that what changes from run to run is told from "
        "what does not"
    )


def _possible(found: Diagnosis) -> list[Found]:
    """What was not settled: the sets that were not told apart, else what may still be true beside what leads."""
    if found.verdict == NONE:
        return []
    named = {name for group in found.ambiguous_with for name in group}
    fitted = [one for one in found.effects if one.parameters]
    if named:
        return [one for one in fitted if one.effect in named][:MOST]
    return [one for one in fitted if one.probability >= POSSIBLE][:MOST]


def _nothing_open(found: Diagnosis) -> str:
    if found.verdict == NONE:
        return "Nothing is open: these runs show no gap to explain."
    return (
        "Nothing is open between known effects: apply the diagnosis, and record another motion to hold out against it."
        if found.selected
        else "No known effect is left to tell apart: repeat the runs, and look at the robot where the gap is largest."
    )


def _by_hand(possible: Sequence[Found]) -> list[Experiment]:
    out = []
    for a, b in itertools.combinations([one.effect for one in possible], 2):
        told = action(a, b)
        if told is not None:
            out.append(Experiment(told.name, told.words, None, (a, b)))
    return out


def _simulated(
    possible: Sequence[Found], found: Diagnosis, model: Path, names: Sequence[str] | None, tell: Progress
) -> list[Experiment]:
    plants = {setup: _coarse(load_plant(model, None, setup)) for setup in Setup}
    joints = plants[Setup.STAND].joints
    walks = set(joints) <= set(JOINTS) and plants[Setup.FLOOR].free_joint is not None
    out = []
    wanted = [name for name in PROTOCOLS if name != FULL] if names is None else list(names)
    for k, name in enumerate(wanted):
        tell(k / len(wanted), f"simulating {name}")
        parts = _parts(name)
        if any(part.setup == "floor" for part in parts) and not walks:
            continue
        squares: dict[tuple[str, str], float] = {}
        for part in parts:
            plant = plants[Setup(part.setup)]
            for pair, distance in _distances(plant, part, possible, found).items():
                squares[pair] = squares.get(pair, 0.0) + distance**2
        pair = min(squares, key=lambda pair: squares[pair])
        out.append(Experiment(name, PROTOCOLS[name][0], math.sqrt(squares[pair]), pair))
    return out


def _parts(name: str) -> tuple[Protocol, ...]:
    try:
        return protocols(name, SECONDS)
    except BadInput:
        return protocols(name)  # too short for all of its recordings


def _coarse(plant: Plant) -> Plant:
    """The plant in steps that are fine enough to compare by."""
    most = FLOOR_STEP_S if plant.setup is Setup.FLOOR else STAND_STEP_S
    return plant.stepped(max(plant.timestep, most if len(plant.joints) > 2 else STAND_STEP_S / 2))


def _distances(
    plant: Plant, part: Protocol, possible: Sequence[Found], found: Diagnosis
) -> dict[tuple[str, str], float]:
    """Whitened distances of each pair of possibilities on one recording."""
    run = _run(plant, part)
    n = len(plant.joints)
    cmd = run.signal("cmd", plant.joints)
    low, high = cmd.min(axis=0), cmd.max(axis=0)
    reference = Reference.of(
        plant, floor=plant.setup is Setup.FLOOR, imu=True, tracker=True, seen=Seen(np.ones(n), low, high, 0.0)
    )
    robots = [robot_of(plant, [one], found.calibration) for one in possible]
    chance = np.random.default_rng(0)  # the same robots for every protocol: what differs is the motion
    for _ in range(BUILD):
        robots.append(Robot(n, low, high))
        scatter(robots[-1], reference, chance)
    names = ("pos", "gyro", "acc", "base", "yaw") if plant.setup is Setup.FLOOR else ("pos",)
    signals = simulate(Rollouts(plant, [run]), robots, signals=names).signals
    width = max(1, round(BLOCK_S * RATE_HZ))
    parts = []
    for name, values in signals.items():
        rows = values.shape[1] // width * width
        blocks = np.nan_to_num(values[:, :rows]).reshape(len(robots), -1, width, values.shape[2]).mean(axis=2)
        parts.append(blocks.reshape(len(robots), -1) / USUAL_NOISE[name])
    x = np.concatenate(parts, axis=1, dtype=np.float64)
    apart, build = x[: len(possible)], x[len(possible) :]
    build = (build - build.mean(axis=0)) / math.sqrt(len(build) - 1)
    out = {}
    for (a, one), (b, other) in itertools.combinations(enumerate(possible), 2):
        # Woodbury: what robots of one build share counts little, and all else by the sensors' noise.
        d = apart[a] - apart[b]
        along = build @ d
        squared = float(d @ d - along @ np.linalg.solve(np.eye(len(build)) + build @ build.T, along))
        out[one.effect, other.effect] = math.sqrt(max(squared, 0.0) / x.shape[1])
    return out


def _run(plant: Plant, part: Protocol) -> Run:
    space = _space(plant)
    commands = part.commands(space, RATE_HZ)
    limp = part.limp(space, RATE_HZ)
    t = np.arange(len(commands), dtype=np.float64) / RATE_HZ
    columns: dict[str, Array] = {}
    for j, joint in enumerate(plant.joints):
        columns[f"cmd.{joint}"] = commands[:, j]
        columns[f"pos.{joint}"] = commands[:, j]
        columns[f"torque.{joint}"] = (~limp[:, j]).astype(np.float64)
    facts = Facts(joints=plant.joints, setup=part.setup, heading_rad=part.heading_rad)
    return Run(part.name, facts, t, columns)


def _space(plant: Plant) -> CommandSpace:
    """Where the library may move this robot: an Ant as the library does, another about the middle of its ranges."""
    if set(plant.joints) <= set(JOINTS):
        return CommandSpace.around_home(joints=plant.joints)
    low, high = [], []
    for dof in plant.dof:
        joint = int(plant.model.dof_jntid[dof])
        ends = plant.model.jnt_range[joint] if plant.model.jnt_limited[joint] else np.array([-REACH_RAD, REACH_RAD])
        middle = float(np.clip(0.0, ends[0], ends[1]))
        low.append(max(float(ends[0]), middle - REACH_RAD))
        high.append(min(float(ends[1]), middle + REACH_RAD))
    a, b = np.array(low), np.array(high)
    return CommandSpace(plant.joints, np.clip(0.0, a, b), a, b)
