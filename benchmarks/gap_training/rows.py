"""From shards to what is learned from: rows of evidence, and which of them are of a cause that the robot has."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.arrays import read_arrays
from openant_tools.effects.robot import Reference, Seen
from openant_tools.gap.evidence import Evidence, Layouts, RunLayout, Scale, evidence_of
from openant_tools.gap.features import ARRIVAL, IMU_DELAY, LATENESS, Floats
from openant_tools.gap.population import Case

__all__ = ["Shard", "read_shard", "refined_place"]

Bools = NDArray[np.bool_]

#: signal → what its absence takes with it
WITH = {"gyro": ("gyro", IMU_DELAY), "pos": ("pos", LATENESS, ARRIVAL)}
#: signals that a log may lack
MAY_LACK = ("vel", "torque", "volt", "gyro", "acc", "base", "yaw")


@dataclass(frozen=True)
class Shard:
    """One experiment as `shards` wrote it.

    Attributes:
        refined: some learned robots → templates of their likeliest causes at the sizes that fit them best, and their features.
        robots: (robots, features), of them the first `measure` make the measure. log: (features,) of the robot that recorded it.
    """

    seed: int
    layouts: Layouts
    known: Bools
    robots: NDArray[np.float32]
    templates: NDArray[np.float32]
    log: NDArray[np.float32]
    bank: list[Case]
    cases: list[Case]
    truth: Case
    measure: int
    reference: Reference
    refined: Mapping[int, tuple[list[Case], Floats]]

    def scale(self, known: Bools, without: str | None = None, robot: int | None = None) -> Scale:
        """What evidence is measured by, or that of a robot; without a cause as if no catalogue had it."""
        more, found = self.refined[robot] if robot is not None else ([], self.templates[:0])
        bank, templates = [*self.bank, *more], np.concatenate([self.templates, found])
        some = [n for n, case in enumerate(bank) if without not in case.causes]
        return Scale.of(
            self.layouts, known, self.robots[: self.measure], templates[some], [bank[n] for n in some], self.reference
        )

    def evidence(self, known: Bools, without: str | None = None, some: NDArray[np.int64] | None = None) -> Evidence:
        """Rows of all robots that do not make the measure (or of some of them), and of the log itself as the last."""
        robots = np.concatenate([self.robots[self.measure :], self.log[None]])
        return evidence_of(self.scale(known, without), robots if some is None else robots[some])

    def evidence_refined(self, known: Bools, robot: int, without: str | None = None) -> Evidence:
        """The rows of a refined robot."""
        return evidence_of(self.scale(known, without, robot), self.robots[self.measure + robot][None])

    @property
    def learned(self) -> list[Case]:
        return [*self.cases[self.measure :], self.truth]

    def lacking(self, rng: np.random.Generator) -> Bools:
        """(features,) what a log with fewer sensors would have."""
        known = self.known.copy()
        signals = sorted({str(s) for s in self.layouts.signal})
        for signal in MAY_LACK:
            if signal in signals and rng.random() < 0.4:
                for gone in WITH.get(signal, (signal,)):
                    known &= self.layouts.signal != gone
        return known

    def shorter(self, rng: np.random.Generator) -> Bools:
        """(features,) what a log of some of the runs would have, with fewer sensors or with all; of a single run all."""
        runs = np.unique(self.layouts.run)
        some = rng.choice(runs, int(rng.integers(1, max(len(runs), 2))), replace=False)
        known = self.lacking(rng) if rng.random() < 0.5 else self.known
        return known & np.isin(self.layouts.run, some)


def read_shard(folder: Path, seed: int) -> Shard:
    facts = json.loads((folder / f"{seed:05d}.json").read_text().replace('"following"', '"imu_delay"'))
    arrays = read_arrays(folder / f"{seed:05d}.npz")
    runs = range(len(facts["runs"]))

    def side_by_side(name: str) -> NDArray[np.float32]:
        return np.concatenate([np.atleast_2d(arrays[f"{name}{k}"].astype(np.float32)) for k in runs], axis=1)

    numbers = {name: np.array(value) for name, value in facts["reference"].items()}
    # What was seen of angles has its part in templates, which are simulated here already.
    still = np.zeros_like(numbers["torque"])
    reference = Reference(
        **{name: numbers[name] for name in ("torque", "stiffness", "damping", "limit", "armature", "friction")},
        robot_kg=float(numbers["robot_kg"]), floor=True, imu=True, tracker=True, seen=Seen(still, still, still, 0.0),
    )  # fmt: skip
    layouts = [RunLayout(one["setup"], one["seconds"], one["groups"], one["joints"]) for one in facts["runs"]]
    return Shard(
        seed, Layouts.of(layouts, len(reference.torque)),
        np.concatenate([arrays[f"known{k}"] for k in runs]).astype(bool),
        side_by_side("robots"), side_by_side("templates"), side_by_side("log")[0],
        [_case(one, -1) for one in facts["bank"]], [_case(one, 0) for one in facts["cases"]], _case(facts["truth"], 0),
        facts["measure"], reference, _refined(folder, seed),
    )  # fmt: skip


def refined_place(folder: Path, seed: int) -> Path:
    """Where what was refined of a shard lies."""
    return folder / f"{seed:05d}-refined.npz"


def _refined(folder: Path, seed: int) -> dict[int, tuple[list[Case], Floats]]:
    place = refined_place(folder, seed)
    if not place.exists():
        return {}
    facts, arrays = json.loads(place.with_suffix(".json").read_text()), read_arrays(place)
    return {
        int(robot): ([_case(one, -1) for one in stated], arrays[f"robot{robot}"].astype(np.float32))
        for robot, stated in facts.items()
    }


def _case(stated: dict[str, list[Any]], seed: int) -> Case:
    return Case({name: (tuple(joints), dict(x)) for name, (joints, x) in stated.items()}, seed)
