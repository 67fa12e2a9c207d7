"""What a plan of recordings will determine, and how well, before anything moves.

The recordings are simulated (`forecast`). The sensitivity A of every position to every parameter gives the information
Aᵀ W A that they will hold; with the priors (unit deviation in u) its inverse is the covariance that a fit will report,
if what it leaves is as large and lasts as long as `Residual` says. When each servo samples within its cycle is unknown: it is
estimated along with the parameters, one time a joint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, Setup, load_plant, setup_of
from openant_tools.recording.run import Run
from openant_tools.sysid.dataset import Dataset
from openant_tools.sysid.excitation import CommandSpace
from openant_tools.sysid.forecast import Forecast, forecast
from openant_tools.sysid.forward import STEP
from openant_tools.sysid.identify import applicable
from openant_tools.sysid.intervals import TIMING_STD_S, TWO_SIDED_95
from openant_tools.sysid.kinds import ELECTRICAL_DAMPING
from openant_tools.sysid.parameter import Parameter, apply, choose, colours
from openant_tools.sysid.plan_file import as_table
from openant_tools.sysid.protocols import Protocol
from openant_tools.sysid.verdict import TIED, told

__all__ = ["Expectation", "Plan", "Planned", "Residual", "information", "make_plan", "marginal", "parameters_of"]

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

#: difference step in prior deviations on the floor, where contacts chatter and only a change that is physically large stands out
FLOOR_STEP = 1.0
#: s, what is unknown of when a servo samples: its own period, and where in a round trip of 3 ms (eight servos) its turn is
SAMPLING_STD_S = math.hypot(TIMING_STD_S, 3e-3 / math.sqrt(3))


@dataclass(frozen=True)
class Residual:
    """What a fit is expected to leave: per sample a deviation, and for how long an error lasts.

    Attributes:
        rad, memory_s: on the stand; by default as the virtual robot leaves it, whose physics is not the model's.
        floor_rad, floor_memory_s: on the floor.
    """

    rad: float = 1.5e-3
    memory_s: float = 0.05
    floor_rad: float = 5e-3
    floor_memory_s: float = 0.2

    def weight(self, setup: Setup, period_s: float) -> float:
        """1/rad, of one sample."""
        rad, memory = (self.floor_rad, self.floor_memory_s) if setup is Setup.FLOOR else (self.rad, self.memory_s)
        return 1.0 / (rad * math.sqrt(max(1.0, memory / period_s)))


@dataclass(frozen=True)
class Expectation:
    """What will be known of one parameter.

    Attributes:
        nominal: the value that is assumed.
        low, high: expected 95 % interval about it; `prior_low`, `prior_high` the prior's.
        information: share of the precision that the data give, 0…1.
        verdict: `identified`, `weak`, `not in the data`, or `tied`: what the data say of it they say of `tied_to`, too.
        tied_to: the parameter that is most correlated with it, where that matters.
        correlation: with that one.
    """

    name: str
    unit: str
    joints: tuple[str, ...]
    nominal: float
    low: float
    high: float
    prior_low: float
    prior_high: float
    information: float
    verdict: str
    tied_to: str | None
    correlation: float


@dataclass(frozen=True)
class Planned:
    """A robot and what is asked of it.

    Attributes:
        model: the MJCF.
        space: where commands may go.
        kinds: parameters of interest; None for those of a fit.
        tie: as a fit's.
        motors: joint → servo model, for `tie="servo"`.
    """

    model: Path
    space: CommandSpace
    rate_hz: float = 100.0
    seed: int = 0
    kinds: tuple[str, ...] | None = None
    tie: str = "joint"
    motors: dict[str, str] = field(default_factory=dict)
    residual: Residual = field(default_factory=Residual)


@dataclass(frozen=True)
class Plan:
    """The recordings of a plan, and what they will determine."""

    asked: Planned
    forecasts: tuple[Forecast, ...]
    expectations: tuple[Expectation, ...]
    notes: tuple[str, ...]
    #: ½ log det of posterior over prior precision, nats: what all recordings together say about all parameters
    nats: float

    @property
    def seconds(self) -> float:
        return sum(one.protocol.seconds for one in self.forecasts)

    @property
    def objections(self) -> list[str]:
        return [words for one in self.forecasts for words in one.objections]

    def as_json(self) -> dict[str, Any]:
        return {
            "schema": "openant.plan-forecast/1",
            "model": str(self.asked.model),
            "protocol": self.forecasts[0].protocol.name,
            "seed": self.asked.seed,
            "rate_hz": self.asked.rate_hz,
            "seconds": self.seconds,
            "residual": asdict(self.asked.residual),
            "recordings": [
                {
                    "setup": one.protocol.setup,
                    "heading_rad": one.protocol.heading_rad,
                    "seconds": one.protocol.seconds,
                    "segments": [
                        {"start_s": round(start, 3), **as_table(segment)}
                        for start, segment in zip(one.protocol.starts(), one.protocol.segments, strict=True)
                    ],
                    "clearance_m": one.clearance_m,
                    "nearest": list(one.nearest),
                    "lean_rad": one.lean_rad,
                    "travel_m": one.travel_m,
                    "peaks": {peak.joint: _finite(asdict(peak)) for peak in one.peaks},
                }
                for one in self.forecasts
            ],
            "parameters": {one.name: asdict(one) for one in self.expectations},
            "information_nats": self.nats,
            "objections": self.objections,
            "notes": list(self.notes),
        }


def _finite(table: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in table.items()
        if key != "joint"
    }


def make_plan(asked: Planned, protocols: Sequence[Protocol], progress: Progress | None = None) -> Plan:
    """Simulate `protocols` and say what they will determine.

    Raises:
        BadInput: the model lacks the joints that are commanded, or has none of the parameters.
    """
    plants = {setup: _plant(asked, protocols, setup) for setup in dict.fromkeys(setup_of(p.setup) for p in protocols)}
    parameters = _parameters(asked, protocols, plants)
    forecasts = []
    for number, protocol in enumerate(protocols, 1):
        if progress:
            progress(0.3 * (number - 1) / len(protocols), f"simulating, {protocol.setup}")
        plant = plants[setup_of(protocol.setup)]
        as_expected = _as_expected(plant, parameters)
        commands, limp = (
            protocol.commands(asked.space, asked.rate_hz, asked.seed),
            protocol.limp(asked.space, asked.rate_hz),
        )
        forecasts.append(
            forecast(as_expected, protocol, asked.space, commands, limp, asked.rate_hz, f"{protocol.setup}-{number}")
        )
    total = np.zeros((len(parameters) + len(asked.space.joints),) * 2)
    notes = []
    on_stand = Setup.STAND in plants
    for done, (setup, plant) in enumerate(plants.items()):
        if progress:
            progress(0.3 + 0.7 * done / len(plants), f"sensitivities, {setup}")
        runs = [one.run for one in forecasts if setup_of(one.protocol.setup) is setup]
        # What joints are like shows far better on the stand, and every column on the floor costs a rollout of its own.
        some = [p.definition.body or not on_stand for p in parameters] if setup is Setup.FLOOR else None
        total += sum(information(plant, runs, parameters, asked.residual, some))
    if on_stand and Setup.FLOOR in plants:
        notes.append("Of the recordings on the floor, only what they say about body and floor is counted.")
    posterior = marginal(total, len(parameters))
    return Plan(
        asked,
        tuple(forecasts),
        _expectations(plants, parameters, posterior),
        tuple(notes),
        -0.5 * float(np.linalg.slogdet(posterior)[1]),
    )


def _plant(asked: Planned, protocols: Sequence[Protocol], setup: Setup) -> Plant:
    released = any(protocol.limp(asked.space, 10.0).any() for protocol in protocols)
    wanted = asked.kinds is None or ELECTRICAL_DAMPING in asked.kinds
    plant = load_plant(asked.model, asked.space.joints, setup, electrical=released and wanted)
    if setup is Setup.FLOOR and plant.free_joint is None:
        raise BadInput(
            "the model has no free joint: it cannot stand on the floor",
            where=asked.model,
            remedy="choose a protocol for the stand, or --setup stand",
        )
    return plant


def parameters_of(asked: Planned, protocols: Sequence[Protocol], plant: Plant) -> tuple[Plant, list[Parameter]]:
    """The plant as it is expected to be, and what is to be known of it."""
    parameters = _parameters(asked, protocols, {plant.setup: plant})
    return _as_expected(plant, parameters), parameters


def _parameters(asked: Planned, protocols: Sequence[Protocol], plants: dict[Setup, Plant]) -> list[Parameter]:
    plant = plants.get(Setup.FLOOR) or next(iter(plants.values()))
    kinds = applicable(
        asked.kinds,
        load_plant(asked.model, asked.space.joints, Setup.FLOOR),
        limp=any(protocol.limp(asked.space, 10.0).any() for protocol in protocols),
        on_floor=any(setup_of(protocol.setup) is Setup.FLOOR for protocol in protocols),
    )
    parameters = choose(plant, kinds, asked.tie, asked.motors)
    if not parameters:
        raise BadInput(f"the model has nothing of {', '.join(kinds)}", where=asked.model, remedy="choose other --kinds")
    return parameters


def _bounds(parameters: Sequence[Parameter], plant: Plant) -> tuple[Array, Array, Array]:
    """(low, high, middle of the prior) of u."""
    ends = [[p.bounds(p.definition.read(plant.model, plant, j)) for j in p.joints] for p in parameters]
    low = np.array([max(end[0] for end in each) for each in ends])
    high = np.array([min(end[1] for end in each) for each in ends])
    return low, high, np.clip([p.centre for p in parameters], low, high)


def _as_expected(plant: Plant, parameters: Sequence[Parameter]) -> Plant:
    """The plant with every parameter in the middle of its prior."""
    _, _, centre = _bounds(parameters, plant)
    return replace(plant, model=apply(plant, parameters, centre))


def information(
    plant: Plant,
    runs: Sequence[Run],
    parameters: Sequence[Parameter],
    residual: Residual,
    some: Sequence[bool] | None = None,
) -> list[Array]:
    """What each run says: (parameters + joints,)² precision of u and of each joint's sampling time, priors left out.

    Args:
        some: which parameters to vary; None for all.
    """
    data = Dataset.prepare(plant, runs)
    low, high, centre = _bounds(parameters, plant)
    size = FLOOR_STEP if plant.setup is Setup.FLOOR else STEP
    up = centre + size <= high
    step = np.where(up, size, -size)
    if plant.setup is not Setup.FLOOR:
        step = np.where(up | (centre - size >= low), step, np.minimum(size, high - centre))
    rolled = colours(plant, parameters, coupled=plant.setup is Setup.FLOOR, some=some)
    variants = [centre]
    for members, _ in rolled:
        moved = centre.copy()
        moved[members] += step[members]
        variants.append(np.clip(moved, low, high))
    seen = data.simulate(parameters, variants)
    joints = len(plant.joints)
    out = []
    for run, rows in zip(runs, data.fitted.rows, strict=True):
        weight = residual.weight(plant.setup, float(np.median(np.diff(run.t))))
        columns = np.zeros((rows.stop - rows.start, joints, len(parameters) + joints))
        for c, (members, masks) in enumerate(rolled):
            change = np.nan_to_num(seen.pos[1 + c, rows] - seen.pos[0, rows])
            for p, mask in zip(members, masks, strict=True):
                columns[:, mask, p] = change[:, mask] / (variants[1 + c][p] - centre[p])
        for j in range(joints):
            columns[:, j, len(parameters) + j] = np.nan_to_num(seen.vel[0, rows, j]) * SAMPLING_STD_S
        flat = weight * columns.reshape(-1, columns.shape[2])
        out.append(flat.T @ flat)
    return out


def marginal(total: Array, n: int) -> Array:
    """(n, n) covariance of the first n numbers, priors of unit deviation on all."""
    return np.asarray(np.linalg.inv(total + np.eye(len(total)))[:n, :n], np.float64)


def _expectations(
    plants: dict[Setup, Plant], parameters: Sequence[Parameter], posterior: Array
) -> tuple[Expectation, ...]:
    plant = plants.get(Setup.FLOOR) or next(iter(plants.values()))
    low, high, centre = _bounds(parameters, plant)
    deviation = np.sqrt(np.diag(posterior))
    correlation = posterior / np.outer(deviation, deviation)
    np.fill_diagonal(correlation, 0.0)
    words = told(posterior, 1.0 - deviation**2)
    out = []
    for k, parameter in enumerate(parameters):
        nominal = parameter.definition.read(plant.model, plant, parameter.joints[0])
        other = int(np.argmax(np.abs(correlation[k])))
        close = abs(correlation[k, other]) >= TIED

        def between(
            spread: float, k: int = k, parameter: Parameter = parameter, nominal: float = nominal
        ) -> tuple[float, float]:
            ends = np.clip(centre[k] + np.array([-spread, spread]), low[k], high[k])
            # A bound comes back by way of u, with an error of rounding.
            first, last = (round(parameter.value(nominal, float(end)), 12) for end in ends)
            return first, last

        ends, prior = between(TWO_SIDED_95 * float(deviation[k])), between(TWO_SIDED_95)
        out.append(
            Expectation(
                parameter.name,
                parameter.definition.unit,
                tuple(plant.joints[j] for j in parameter.joints),
                parameter.value(nominal, float(centre[k])),
                *ends,
                *prior,
                1.0 - float(deviation[k] ** 2),
                words[k][0],
                parameters[other].name if close else None,
                float(correlation[k, other]),
            )
        )
    return tuple(out)
