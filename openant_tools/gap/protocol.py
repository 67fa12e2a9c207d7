"""What was played: the commands of a set of runs, as every robot that plays them again is simulated and compared."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.robot import Reference, Robot, Seen
from openant_tools.gap.features import COLUMNS, Floats, Layout, around_switching, logged
from openant_tools.gap.simulation import simulate
from openant_tools.model.floor import resolution
from openant_tools.model.plant import Plant, Setup, load_plant, setup_of
from openant_tools.model.rollout import Rollouts
from openant_tools.numbers import literal
from openant_tools.recording.run import Run

__all__ = ["Played", "Players", "RunSet", "alike", "rollouts_of"]

Array = NDArray[np.float64]

#: s: the grid on which commands are compared, so that jitter of time stamps does not make another motion
GRID_S = 0.02
#: correlation from which commands are those of one kind of motion
ALIKE = 0.95
#: share of the time in which commands are slower than what they often ask for, and the least of the fastest that this is
OFTEN, LEAST_OF_MOST = 0.9, 0.2
#: smaller changes of a supply's share are rounding of numbers
LEAST_CHANGE = 1e-6
#: s, steps of simulated populations, in which they cost the least that does not show beside tolerances
STAND_STEP_S, FLOOR_STEP_S = 0.0025, 0.004


@dataclass(frozen=True)
class Played:
    """One run of a protocol.

    Attributes:
        run: its commands. Where its base was on the floor is left out of a run that is simulated as a whole.
        plant: how it is simulated. signals: those that a robot on it can have.
        seen: what its log has of them.
        warm_c: (joints,) °C, by which its servos were warmer than in the coolest run beside it, as far as that was logged.
        windows: from, up to (s of the run's t) what alone is simulated, each begun from what was measured; None: the whole run.
    """

    run: Run
    plant: Plant
    signals: tuple[str, ...]
    seen: Mapping[str, Floats]
    warm_c: Array
    windows: tuple[tuple[float, float], ...] | None = None

    @classmethod
    def of(cls, run: Run, plant: Plant, warm_c: Array, windows: Sequence[tuple[float, float]] | None = None) -> Played:
        """A run on a plant."""
        free = plant.setup is Setup.FLOOR and plant.free_joint is not None
        signals = ("pos", "vel", "torque", "volt", *(COLUMNS if free else ()))
        seen = {name: values for name, values in logged(run, plant.joints).items() if name in signals}
        if windows is None and "torque" in seen and not np.isfinite(seen["torque"]).any(axis=1).all():
            del seen["torque"]  # judges that saw a whole protocol know of no log with some joints' torque alone
        # Amid a run a simulation begins where the base was; a whole one from a settled stand, as every other robot does.
        columns = {
            name: values for name, values in run.columns.items() if windows is not None or not name.startswith("base.")
        }
        return cls(
            dataclasses.replace(run, columns=columns),
            plant,
            signals,
            seen,
            warm_c,
            None if windows is None else tuple(windows),
        )

    @property
    def switches(self) -> bool:
        """Whether torque goes or comes meanwhile."""
        return bool(around_switching(self.run, self.plant.joints).any())

    @cached_property
    def layout(self) -> Layout:
        t = self.run.t - self.run.t[0]
        return Layout(
            t, self.plant.setup, len(self.plant.joints), self.signals, self.run.duration_s,
            around_switching(self.run, self.plant.joints),
        )  # fmt: skip

    def features(self, nominal: Mapping[str, Floats]) -> Floats:
        """(features,) of the run itself against what the model does."""
        seen = {name: self.seen.get(name, nominal[name]) for name in self.signals}
        found: Floats = self.layout.features(seen, nominal)[0]
        return found


def rollouts_of(runs: Sequence[Played], nthread: int = 0) -> Rollouts:
    """Runs on one plant, in their windows, ready to be simulated."""
    windows = [one.windows for one in runs if one.windows is not None]
    return Rollouts(runs[0].plant, [one.run for one in runs], nthread=nthread, windows=windows or None)


@dataclass(frozen=True)
class Players:
    """Runs made ready to be played: those on one plant are simulated side by side.

    Attributes:
        runs: in order. groups: of each plant, which runs are on it, and they prepared.
    """

    runs: tuple[Played, ...]
    groups: tuple[tuple[tuple[int, ...], Rollouts], ...]

    @classmethod
    def of(cls, runs: Sequence[Played]) -> Players:
        on: dict[int, list[int]] = {}
        for k, one in enumerate(runs):
            on.setdefault(id(one.plant), []).append(k)
        groups = ((tuple(mine), rollouts_of([runs[k] for k in mine])) for mine in on.values())
        return cls(tuple(runs), tuple(groups))

    def play(self, robots: Sequence[Robot]) -> list[dict[str, Floats]]:
        """Of each run, what robots do with its commands: signal → (robots, rows, columns)."""
        out: list[dict[str, Floats]] = [{} for _ in self.runs]
        for mine, rollouts in self.groups:
            warm_c = [self.runs[k].warm_c for k in mine]
            found = simulate(rollouts, robots, signals=self.runs[mine[0]].signals, warm_c=warm_c).signals
            for k, rows in zip(mine, rollouts.rows, strict=True):
                out[k] = {name: values[:, rows] for name, values in found.items()}
        return out


@dataclass(frozen=True)
class RunSet:
    """A set of runs to be diagnosed together.

    Attributes:
        model: the given MJCF. joints: those played. runs: in order.
        reference: the model's own numbers.
    """

    model: Path
    joints: tuple[str, ...]
    runs: tuple[Played, ...]
    reference: Reference

    @classmethod
    def of(
        cls,
        runs: Sequence[Run],
        model: Path,
        joints: Sequence[str],
        models: Sequence[Path | None],
        windows: Sequence[Sequence[tuple[float, float]]] | None = None,
    ) -> RunSet:
        """The protocol that these runs played.

        Args:
            models: of each run its own MJCF, None for `model`.
            windows: of each run, what alone is simulated; default all of it.
        """
        plants: dict[tuple[Path, Setup], Plant] = {}
        played = []
        for k, (run, own, warm_c) in enumerate(zip(runs, models, _warmer(runs, joints), strict=True)):
            key = (own or model, setup_of(run.facts.setup))
            if key not in plants:
                plants[key] = load_plant(key[0], joints, key[1])
            played.append(Played.of(run, plants[key], warm_c, None if windows is None else windows[k]))
        seen = {name for one in played for name in one.seen}
        first = next((one.plant for one in played if one.plant.setup is Setup.FLOOR), played[0].plant)
        reference = Reference.of(
            first,
            floor=any(one.plant.setup is Setup.FLOOR and one.plant.free_joint is not None for one in played),
            imu=bool({"gyro", "acc"} & seen),
            tracker="base" in seen,
            seen=shown(runs, joints),
        )
        return cls(model, tuple(joints), tuple(played), reference)

    @property
    def warmed_c(self) -> float:
        """°C by which any servo was warmer in any run than in its coolest one."""
        return max(float(one.warm_c.max()) for one in self.runs)

    def servos(self) -> list[list[int]]:
        """Groups of joints with servos of one model: as the runs say, else those that the MJCF makes alike."""
        motors = next((one.run.facts.motors for one in self.runs if one.run.facts.motors), {})
        groups: dict[str, list[int]] = {}
        for j, joint in enumerate(self.joints):
            alike = f"{literal(self.reference.stiffness[j], 4)} {literal(self.reference.limit[j], 4)}"
            groups.setdefault(str(motors.get(joint, alike)), []).append(j)
        return list(groups.values())

    def coarse(self, stand_step_s: float = STAND_STEP_S) -> RunSet:
        """The same, simulated in steps as large as populations allow, or others on the stand."""
        plants: dict[int, Plant] = {}
        for one in self.runs:
            if id(one.plant) not in plants:
                largest = FLOOR_STEP_S if one.plant.setup is Setup.FLOOR else stand_step_s
                plant = one.plant.stepped(largest if len(self.joints) > 2 else min(0.002, one.plant.timestep * 2))
                plant.model.opt.tolerance = max(plant.model.opt.tolerance, 1e-6)
                # One robot is one island: sorting what touches costs more than it saves.
                plant.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
                plants[id(one.plant)] = plant
        return dataclasses.replace(
            self, runs=tuple(dataclasses.replace(one, plant=plants[id(one.plant)]) for one in self.runs)
        )

    def resolution(self) -> dict[str, float]:
        """Signal → the steps of its sensor, as the runs show them."""
        runs = [one.run for one in self.runs]
        out = {signal: _resolution(runs, signal, self.joints) for signal in ("pos", "vel")}
        changes = [np.abs(np.diff(one.seen["volt"][0], axis=0)) for one in self.runs if "volt" in one.seen]
        out["volt"] = min((float(c[c > LEAST_CHANGE].min(initial=np.inf)) for c in changes), default=np.inf)
        return {signal: step if np.isfinite(step) else 0.0 for signal, step in out.items()}

    def nominal(self, robot: Robot | None = None) -> list[dict[str, Floats]]:
        """Of each run, what the model (or another robot) does with its commands from its start on, at its own rows."""
        return Players.of(self.runs).play([robot or Robot(len(self.joints))])

    def fingerprint(self) -> str:
        """Of what decides the simulations but for the runs themselves: model and joints."""
        state = hashlib.sha256()
        for path in sorted({one.plant.path for one in self.runs}):
            state.update(path.read_bytes())
        state.update(json.dumps(list(self.joints)).encode())
        return state.hexdigest()[:16]


def alike(one: Run, other: Run, joints: Sequence[str]) -> bool:
    """Whether two runs are of one kind of motion: of one protocol, or with commands that differ by little but size."""
    names = one.facts.protocol, other.facts.protocol
    if None not in names:
        return names[0] == names[1]
    a, b = _on_grid(one, joints), _on_grid(other, joints)
    n = min(len(a), len(b))
    a, b = a[:n] - a[:n].mean(axis=0), b[:n] - b[:n].mean(axis=0)
    return float(np.sum(a * b)) > ALIKE * float(np.sqrt(np.sum(a**2) * np.sum(b**2)))


def _on_grid(run: Run, joints: Sequence[str]) -> Array:
    cmd, times = run.signal("cmd", joints), run.command_times
    grid = np.arange(run.t[0], run.t[-1], GRID_S) + GRID_S / 2
    out = np.empty((len(grid), len(joints)))
    for j in range(len(joints)):
        given = np.isfinite(cmd[:, j])
        order = np.argsort(times[given], kind="stable")
        at = np.maximum(np.searchsorted(times[given][order], grid, side="right") - 1, 0)
        out[:, j] = cmd[given, j][order][at]
    return out


def _speeds(x: Array) -> Array:
    """(joints,) rad/s that commands often ask for, of those at any time (rows, joints): a step asks for any speed at all."""
    often: Array = np.maximum(np.quantile(x, OFTEN, axis=0), LEAST_OF_MOST * x.max(axis=0))
    return often


def _resolution(runs: Sequence[Run], signal: str, joints: Sequence[str]) -> float:
    steps = [resolution(run, signal, joint) for run in runs for joint in joints]
    return float(np.median([step for step in steps if step > 0] or [0.0]))


def _warmer(runs: Sequence[Run], joints: Sequence[str]) -> Array:
    """(runs, joints) °C above the coolest run; 0 where nothing was logged. Medians: single samples may be glitches."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns that are empty
        temperature = np.array([np.nanmedian(run.signal("temp", joints), axis=0) for run in runs])
        warmer: Array = np.nan_to_num(temperature - np.nanmin(temperature, axis=0))
    return warmer


def shown(runs: Sequence[Run], joints: Sequence[str]) -> Seen:
    """What the commands ask for, where the joints went and how finely that is known."""
    speeds, positions = [], []
    for run in runs:
        grid = _on_grid(run, joints)
        if len(grid) > 5:
            speeds.append(_speeds(np.abs(grid[5:] - grid[:-5]) / (5 * GRID_S)))
        positions.append(run.signal("pos", joints))
    seen = np.concatenate(positions)
    low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    still = high - low < math.radians(1)
    low, high = np.where(still, low - math.radians(1), low), np.where(still, high + math.radians(1), high)
    return Seen(np.maximum(np.max(speeds, axis=0), 0.1), low, high, _resolution(runs, "pos", joints))
