"""The gap as figures: per signal, joint and regime, above what no model could beat (formats, section 3)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.entries import check_pair, entries_of, values_of
from openant_tools.effects.rollout import EffectValues, rollout
from openant_tools.gap.regime import Regime, regimes
from openant_tools.model.floor import disagreement, floors, stamp_error
from openant_tools.model.gap import HORIZON_S, excess, gap
from openant_tools.model.of_run import plants_of
from openant_tools.model.plant import Plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.robot.config import EffectEntry
from openant_tools.sysid.identify import joints_in_common

__all__ = ["Measurement", "Place", "Played", "difference", "measure"]

Array = NDArray[np.float64]

UNITS = {"pos": "rad", "vel": "rad/s"}
NOTHING_MEASURED = "no position of these joints was measured while they were simulated"


@dataclass(frozen=True)
class Played:
    """One run, measured and simulated.

    Attributes:
        run: it.
        measured, simulated: signal → (rows, joints).
        regime: (rows, joints).
    """

    run: Run
    measured: dict[str, Array]
    simulated: dict[str, Array]
    regime: NDArray[np.str_]


@dataclass(frozen=True)
class Place:
    """A part of the gap.

    Attributes:
        share: of the signal's excess, summed over its squares.
        gap: rms there, in the signal's unit.
        seconds: how long the joint was in this regime.
    """

    signal: str
    joint: str
    regime: Regime
    share: float
    gap: float
    seconds: float


@dataclass(frozen=True)
class Measurement:
    """The gap of a model on some runs.

    Attributes:
        horizon_s: between re-initialisations from measurement; None is never.
        gaps, floors: signal → rms over all joints and samples, and what no model could beat.
        from_repeats: whether the floor comes from repeats of the same commands, else from the sensors.
        stamp_error_s: as `model.floor.stamp_error`; in a floor from the sensors.
        places: largest share first, signal by signal.
        effects: what acted between the steps of the model, (effect, its parameter) → (joints,).
        doubt: why the floor is none, and nothing can be judged by it; "" where it holds.
    """

    model: Path
    joints: tuple[str, ...]
    horizon_s: float | None
    gaps: dict[str, float]
    floors: dict[str, float]
    from_repeats: bool
    stamp_error_s: float
    places: tuple[Place, ...]
    played: tuple[Played, ...]
    doubt: str = ""
    effects: EffectValues = field(default_factory=dict)

    def excess(self, signal: str) -> float:
        return excess(self.gaps[signal], self.floors[signal])

    def resimulated(self, simulated: Sequence[Mapping[str, Array]]) -> tuple[Place, ...]:
        """The same places with another simulation of the runs; shares are of what the excess was before.

        Args:
            simulated: of each run in order, signal → (rows, joints).
        """
        played = [
            replace(one, simulated={**one.simulated, **other})
            for one, other in zip(self.played, simulated, strict=True)
        ]
        floor = {signal: floors([one.run for one in played], self.joints, signal)[0] for signal in self.gaps}
        return tuple(
            place
            for signal in self.gaps
            for place in _places(played, self.joints, signal, floor[signal], of=self.played)
        )

    def as_json(self) -> dict[str, Any]:
        return {
            "schema": "openant.gap-measure/1",
            "model": str(self.model),
            "effects": [
                {"effect": entry.effect, "joints": list(entry.joints), "parameters": dict(entry.parameters)}
                for entry in entries_of(self.effects, self.joints)
            ],
            "runs": [played.run.name for played in self.played],
            "horizon_s": self.horizon_s,
            "floor_from": "repeats" if self.from_repeats else "sensors",
            "doubt": self.doubt,
            "stamp_error_s": self.stamp_error_s,
            "signals": {
                signal: {"gap": self.gaps[signal], "floor": self.floors[signal], "excess": self.excess(signal),
                         "unit": UNITS[signal]}
                for signal in self.gaps
            },
            "where": [
                {"signal": place.signal, "joint": place.joint, "regime": str(place.regime), "share": place.share,
                 "gap": place.gap, "seconds": place.seconds}
                for place in self.places
            ],
        }  # fmt: skip


def measure(
    runs: Sequence[Run],
    model: Path,
    joints: Sequence[str] | None = None,
    horizon_s: float | None = 0.5,
    effects: Sequence[EffectEntry] = (),
) -> Measurement:
    """Simulate runs with their own commands and say how far off they are, and where.

    Args:
        runs: recordings of robots of this model; each is simulated as it stood, on stand or floor.
        joints: default every position servo of the model that all runs command and measure.
        horizon_s: as `Measurement`.
        effects: `[[effect]]` entries of the robot or of the model's pair: what acts between steps in an environment does here. What
            chance decides (jitter, lost commands) does not, nor what acts on an IMU or tracker.

    Raises:
        BadInput: no run, none of the model's joints in it, or effects that were fitted with another model.
    """
    wanted = joints_in_common(runs, model, joints)
    plants = plants_of(runs, model, wanted)
    for plant in plants:
        check_pair(effects, plant.model, plant.path)
    acting = values_of(effects, wanted)
    played = tuple(_play(run, plant, horizon_s, acting) for run, plant in zip(runs, plants, strict=True))
    found = {signal: floors(runs, wanted, signal) for signal in UNITS}
    gaps = {
        signal: gap(
            np.concatenate([one.measured[signal] for one in played]),
            np.concatenate([one.simulated[signal] for one in played]),
        )
        for signal in UNITS
    }
    gaps = {signal: value for signal, value in gaps.items() if math.isfinite(value)}
    places = [place for signal in gaps for place in _places(played, wanted, signal, found[signal][0])]
    return Measurement(
        model, tuple(wanted), horizon_s, gaps, {signal: rms(found[signal][0]) for signal in gaps}, found["pos"][1],
        stamp_error(runs, wanted),
        tuple(places), played, disagreement(runs, wanted) if "pos" in gaps else NOTHING_MEASURED, acting,
    )  # fmt: skip


def difference(before: Measurement, after: Measurement, signal: str = "pos") -> tuple[float, float]:
    """By how much the mean squared error changes from one model to another on the same runs, and its standard error.

    Both are compared window by window, HORIZON_S long: what one window is hard for, it is hard for with either model. Of
    less than two windows the standard error is NaN.
    """
    each: list[float] = []
    for one, other in zip(before.played, after.played, strict=True):
        change = (other.measured[signal] - other.simulated[signal]) ** 2
        change = change - (one.measured[signal] - one.simulated[signal]) ** 2
        window = np.floor((one.run.t - one.run.t[0]) / HORIZON_S)
        for k in np.unique(window):
            here = change[window == k]
            here = here[np.isfinite(here)]
            if here.size:
                each.append(float(here.mean()))
    spread = np.std(each, ddof=1) / math.sqrt(len(each)) if len(each) > 1 else math.nan
    return float(np.mean(each)) if each else math.nan, float(spread)


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _play(run: Run, plant: Plant, horizon_s: float | None, effects: EffectValues) -> Played:
    rollouts = Rollouts(plant, [run], horizon_s)
    done = rollout(rollouts, [plant.model], [effects]) if effects else rollouts()
    measured = {signal: run.signal(signal, plant.joints) for signal in UNITS}
    return Played(run, measured, {"pos": done.pos[0], "vel": done.vel[0]}, regimes(run, plant))


def _places(
    played: Sequence[Played], joints: Sequence[str], signal: str, floor: Array, of: Sequence[Played] | None = None
) -> list[Place]:
    """What each joint and regime has of the gap, the largest share first.

    Args:
        of: the simulation whose excess the shares are of; default their own.
    """
    found = [
        (joint, regime, *_there(played, j, regime, signal, float(floor[j])))
        for j, joint in enumerate(joints)
        for regime in Regime
    ]
    found = [one for one in found if math.isfinite(one[3])]
    total = sum(one[2] for one in found)
    if of is not None:
        total = sum(_there(of, j, regime, signal, float(floor[j]))[0] for j in range(len(joints)) for regime in Regime)
    places = [
        Place(signal, joint, regime, beyond / total if total > 0 else 0.0, error, seconds)
        for joint, regime, beyond, error, seconds in found
    ]
    return sorted(places, key=lambda place: -place.share)


def _there(played: Sequence[Played], j: int, regime: Regime, signal: str, floor: float) -> tuple[float, float, float]:
    """Of a joint in one regime: the squares beyond its floor, their rms (NaN where it was never seen in it), and for how long, s."""
    squares, seconds = [], 0.0
    for one in played:
        here = one.regime[:, j] == regime.value
        error = (one.measured[signal][:, j] - one.simulated[signal][:, j])[here]
        squares.append(error[np.isfinite(error)] ** 2)
        seconds += float(np.median(np.diff(one.run.t))) * int(here.sum())
    each = np.concatenate(squares)
    if not len(each):
        return 0.0, math.nan, seconds
    return max(0.0, float(each.sum()) - len(each) * floor**2), math.sqrt(float(each.mean())), seconds
