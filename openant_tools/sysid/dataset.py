"""Runs of one plant, prepared to be simulated with any values of its parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.rollout import EffectValues, rollout
from openant_tools.model.floor import steps
from openant_tools.model.gap import HORIZON_S, Gap
from openant_tools.model.plant import Plant, Setup
from openant_tools.model.rollout import Rollouts, Trajectories
from openant_tools.recording.run import Run
from openant_tools.sysid.parameter import Parameter, apply, delays, effect_values

__all__ = ["Dataset", "gaps", "runs_of", "sensor_floor"]

Array = NDArray[np.float64]

#: s; the longest time step that derivatives are taken with, where the model's own is at most half of it
COARSEST_S = 0.004
#: share of the rows with the base's whole pose from which a robot on the floor can be put where it was
PLACED = 0.9


@dataclass(frozen=True)
class Dataset:
    """Runs of one plant, prepared for rollouts at both horizons.

    Attributes:
        plant: the model as given, set up as these runs were made.
        runs: the recordings.
        measured: (rows, joints) rad, the runs' positions one after another.
        nthread: of the rollouts; 0 takes all cores.
        measured_supply: gains and torque limits follow the voltage that the runs logged.
        acting: effects between steps that the robot is known to have, in every simulation; at joints where a parameter
            says what an effect is, the parameter counts.
    """

    plant: Plant
    runs: tuple[Run, ...]
    measured: Array
    nthread: int = 0
    measured_supply: bool = False
    acting: EffectValues = field(default_factory=dict)

    @classmethod
    def prepare(
        cls,
        plant: Plant,
        runs: Sequence[Run],
        nthread: int = 0,
        *,
        measured_supply: bool = False,
        acting: EffectValues | None = None,
    ) -> Dataset:
        measured = np.concatenate([run.signal("pos", plant.joints) for run in runs])
        return cls(plant, tuple(runs), measured, nthread, measured_supply, acting or {})

    @cached_property
    def full(self) -> Rollouts:
        return Rollouts(self.plant, self.runs, None, self.nthread)

    @cached_property
    def horizon(self) -> Rollouts:
        return Rollouts(self.plant, self.runs, HORIZON_S, self.nthread)

    @cached_property
    def coarse(self) -> Dataset:
        """The same with twice the time step, where that is short enough: half the cost, and as good to find a direction."""
        if 2 * self.plant.timestep > COARSEST_S or self.plant.model.nhistory:
            return self
        return self.stepped(2.0)

    def stepped(self, times: float) -> Dataset:
        """The same with so many times the time step."""
        return replace(self, plant=self.plant.stepped(self.plant.timestep * times))

    @property
    def fitted(self) -> Rollouts:
        """What the fit compares: full runs, but on the floor, where contact makes long runs chaotic, the horizon.

        A robot whose base nobody measured, or a camera now and then, cannot be put back on its feet in mid-gait: such runs
        are compared whole too.
        """
        if self.plant.setup is not Setup.FLOOR:
            return self.full
        pose = [[run.column(f"base.{axis}") for axis in ("x", "y", "z", "qw")] for run in self.runs]
        placed = min(float(np.isfinite(columns).all(axis=0).mean()) for columns in pose)
        return self.horizon if placed > PLACED else self.full

    def simulate(
        self, parameters: Sequence[Parameter], us: Sequence[Array], rollouts: Rollouts | None = None
    ) -> Trajectories:
        """What the model would have done with the parameters at each u, (parameters,), by default as the fit compares."""
        rollouts = rollouts or self.fitted
        models, late = self._variants(parameters, us, rollouts)
        effects = [effect_values(self.plant, parameters, u, self.acting) for u in us]
        if self.measured_supply or any(effects):
            return rollout(rollouts, models, effects, late, measured_supply=self.measured_supply)
        return rollouts(models, late)

    def stream(
        self, parameters: Sequence[Parameter], us: Sequence[Array], rollouts: Rollouts | None = None
    ) -> Iterator[tuple[slice, Array, Array]]:
        """`simulate` piece by piece, so that no more than a piece of it is held: rows, positions, velocities."""
        rollouts = rollouts or self.fitted
        if self.measured_supply or any(effect_values(self.plant, parameters, u, self.acting) for u in us):
            whole = self.simulate(parameters, us, rollouts)  # effects act step by step on all runs at once
            return iter([(slice(0, whole.pos.shape[1]), whole.pos, whole.vel)])
        return rollouts.stream(*self._variants(parameters, us, rollouts))

    def _variants(
        self, parameters: Sequence[Parameter], us: Sequence[Array], rollouts: Rollouts
    ) -> tuple[list[mujoco.MjModel], Array | None]:
        models = [apply(rollouts.plant, parameters, u) for u in us]
        late = np.array([delays(self.plant, parameters, u) for u in us])
        return models, late if late.any() else None


def runs_of(datasets: Sequence[Dataset]) -> Iterator[tuple[Dataset, Run, slice]]:
    """Every run with its dataset, and where its rows are among those of all datasets one after another."""
    begin = 0
    for data in datasets:
        for run in data.runs:
            yield data, run, slice(begin, begin + len(run.t))
            begin += len(run.t)


def gaps(datasets: Sequence[Dataset], parameters: Sequence[Parameter], us: Sequence[Array]) -> list[Gap]:
    """The gap of each variant over all datasets together, at the horizon and over full runs."""
    squares, samples = np.zeros((2, len(us))), np.zeros((2, len(us)))
    for data in datasets:
        for which, rollouts in enumerate((data.horizon, data.full)):
            for rows, pos, _ in data.stream(parameters, us, rollouts):
                error = (data.measured[rows] - pos) ** 2
                squares[which] += np.nansum(error, axis=(1, 2))
                samples[which] += np.isfinite(error).sum(axis=(1, 2))
    with np.errstate(invalid="ignore"):  # where nothing compares there is no gap
        short, full = np.sqrt(squares / samples).tolist()
    return [Gap(*both) for both in zip(short, full, strict=True)]


def sensor_floor(runs: Sequence[Run], joints: Sequence[str]) -> Array:
    """(joints,) rad, the deviation that the encoder's resolution alone gives: its coarsest quantum / √12."""
    return steps(runs, "pos", joints) / math.sqrt(12)
