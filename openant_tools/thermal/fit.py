"""Fitting the two nodes to runs: what is known before, what the run adds, and how certain the sum is.

The fit is Gauss–Newton on crossings and priors; parameters are logarithms, so that none turns negative. Servos of one model
in one kind of joint share a mean, from which each may differ. What no two-node model explains (draughts, a cable that
warms) stays near for minutes: residuals are taken as a slow disturbance with standard deviation s and correlation time τ
beside the thermometer's own error, with s and τ from the evidence of the run. Without it every interval would be too
narrow, since a hundred crossings of one drift are not a hundred witnesses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from openant_tools.errors import BadInput
from openant_tools.files import read_json
from openant_tools.robot.joints import JOINTS
from openant_tools.thermal.inputs import Inputs
from openant_tools.thermal.physics import ServoHeat, State, advance, by_duty

__all__ = [
    "ALIKE",
    "PRIORS",
    "Fit",
    "HeatEstimate",
    "HeatPrior",
    "HeldOut",
    "Known",
    "Variants",
    "fit",
    "fit_and_judge",
    "held_out",
]

Array = NDArray[np.float64]

#: two-sided 95 %
Z95 = 1.959964
#: share of a run that is fitted where the rest is to judge it
TRAINED = 0.6
#: s; a shorter run has no later part to speak of
LEAST_HELD_OUT_S = 300.0
#: of a disturbance: standard deviations (K) and correlation times (s) that are tried
DISTURBANCE_K = (0.1, 0.2, 0.35, 0.6, 1.0, 1.8)
DISTURBANCE_S = (120.0, 400.0, 1200.0)
#: where the disturbance is about, before any run: ln K and how sure
_DISTURBANCE_PRIOR = (math.log(0.25), 0.8)
#: Gauss–Newton steps at most
ITERATIONS = 25


@dataclass(frozen=True)
class HeatPrior:
    """What is known of a parameter before any run.

    Attributes:
        value: its median (its mean where `log` is false). spread: standard deviation of its logarithm (of itself).
        own: the part of the spread by which servos of one model and kind of joint differ among themselves.
        unit, words: for people.
    """

    value: float
    spread: float
    own: float
    unit: str
    words: str
    log: bool = True


#: Of each servo. Sizes: an X430 weighs 57 to 82 g at about 0.8 J/(g·K); the platform's own temperature log shows time
#: constants of 390 to 550 s and 14 K of rise from electronics alone (facts/robot, section 9).
PRIORS: Mapping[str, HeatPrior] = {
    "case_j_k": HeatPrior(55.0, 0.35, 0.12, "J/K", "heat capacity of the case"),
    "air_w_k": HeatPrior(1 / 12.0, 0.5, 0.2, "W/K", "case to air, at 30 K over the room"),
    "winding_j_k": HeatPrior(7.5, 0.4, 0.1, "J/K", "heat capacity of the winding"),
    "winding_w_k": HeatPrior(1 / 4.5, 0.4, 0.1, "W/K", "winding to case"),
    "scale": HeatPrior(1.0, 0.15, 0.08, "1", "heat made over what current or duty says"),
    "idle": HeatPrior(1.0, 0.3, 0.1, "1", "electronics over the data sheet's standby"),
}
#: Of each leg, and of all together.
LEG_PRIOR = HeatPrior(0.03, 0.8, 0.8, "W/K", "hip to knee of one leg")
EXPONENT_PRIOR = HeatPrior(0.12, 0.10, 0.0, "1", "power by which the air takes more than in proportion", log=False)
GEAR_PRIOR = HeatPrior(0.5, 0.25, 0.0, "1", "share of the gear's power that stays in the servo", log=False)
#: name → what it is, for people
PARAMETER_WORDS: Mapping[str, str] = {
    **{name: prior.words for name, prior in PRIORS.items()},
    "leg_w_k": LEG_PRIOR.words, "exponent": EXPONENT_PRIOR.words, "gear": GEAR_PRIOR.words, "room_c": "temperature of the room",
    "start_k": "case at the start", "start_winding_k": "winding at the start, over its case",
    "held_w": "heat of a pose whose load nobody logged",
}  # fmt: skip
#: A thermometer on the wall, and a guess from the coldest servo.
ROOM_KNOWN_K, ROOM_GUESSED_K, ROOM_BELOW_K = 1.0, 3.5, 1.5
#: At a run's start: the case against its first reading, the winding against the case (K).
START_SD_K, START_WINDING_K = 0.5, 2.0
#: Heat of unknown cause, W: ln median and spread
UNKNOWN_W = HeatPrior(1.0, 1.0, 1.0, "W", "heat of a pose whose load nobody logged")

#: parameters that pass from one run of a robot to the next
ALIKE = (*PRIORS, "leg_w_k", "exponent", "gear")


@dataclass(frozen=True)
class HeatEstimate:
    """One parameter with its 95 % interval.

    Attributes:
        informed: share of its prior variance that the run has taken away; below a half it is mostly what was believed.
    """

    name: str
    joint: str
    value: float
    low: float
    high: float
    unit: str
    informed: float


@dataclass(frozen=True)
class HeldOut:
    """How the fit of a run's first part meets the rest.

    Attributes:
        from_s: where the rest begins. rms_k: over all thermometers there, of the readings' cells.
        worst_k: largest, and `worst` whose. within: share of the cells inside the 95 % band.
    """

    from_s: float
    rms_k: float
    worst_k: float
    worst: str
    within: float


@dataclass(frozen=True)
class _Layout:
    """Which number of the parameter vector is what.

    Attributes:
        names: (name, joint or "" where all share it) of each. mean: (p,). covariance: (p, p) before the run.
        log: (p,) whether it is a logarithm.
        places: (name, joint) → place. held: unknown heat: (joint, stretch) → place.
    """

    names: tuple[tuple[str, str], ...]
    mean: Array
    covariance: Array
    log: NDArray[np.bool_]
    held: Mapping[tuple[int, int], int]

    def columns(self, name: str) -> list[int]:
        return [k for k, (one, _) in enumerate(self.names) if one == name]


@dataclass(frozen=True)
class Variants:
    """b variants of the servos, and their state at the end of a run.

    Attributes:
        servos: as `physics` takes them. state: at the end. offset: (b, joints) K, the disturbance then.
        held: (b, joints) W of unknown heat in the last pose, 0 where heat is known.
    """

    servos: ServoHeat
    state: State
    offset: Array
    held: Array


@dataclass(frozen=True)
class Known:
    """What runs have taught of a robot's servos, for runs to come.

    Attributes:
        joints, models: of the robot; a model is "" where nobody says.
        names: (name, joint or "") of each number. theta, covariance: of the numbers.
    """

    joints: tuple[str, ...]
    models: tuple[str, ...]
    names: tuple[tuple[str, str], ...]
    theta: Array
    covariance: Array

    def as_json(self) -> dict[str, Any]:
        """As it stands in fit.json, below `known`."""
        return {
            "joints": list(self.joints), "models": list(self.models), "names": [list(name) for name in self.names],
            "theta": self.theta.tolist(), "covariance": self.covariance.tolist(),
        }  # fmt: skip

    @classmethod
    def read(cls, path: Path) -> Known:
        """What stands in the fit.json of an earlier fit; BadInput where that is none."""
        remedy = "name the fit.json that `openant thermal fit` wrote"
        try:
            return cls.of_json(read_json(path, remedy), str(path))
        except OSError as error:
            raise BadInput(str(error.strerror), where=path, remedy=remedy) from None

    @classmethod
    def of_json(cls, content: Any, where: str) -> Known:
        """The inverse of `as_json`; BadInput where it did not write this."""
        try:
            table = content["known"]
            names = tuple((str(name), str(joint)) for name, joint in table["names"])
            theta, covariance = np.array(table["theta"], float), np.array(table["covariance"], float)
            if theta.shape != (len(names),) or covariance.shape != (len(names), len(names)):
                raise ValueError
            if not (np.isfinite(theta).all() and np.isfinite(covariance).all()):
                raise ValueError
            return cls(tuple(table["joints"]), tuple(table["models"]), names, theta, covariance)
        except (KeyError, TypeError, ValueError):
            remedy = "name the fit.json that `openant thermal fit` wrote"
            raise BadInput("this is no fit of heat", where=where, remedy=remedy) from None


@dataclass(frozen=True)
class Fit:
    """What is known of a robot's heat after a run.

    Attributes:
        inputs: the run it ends with, as far as it was fitted.
        theta, covariance: of the parameter vector. disturbance_k, disturbance_s: s and τ of the slow disturbance.
        residual_k: (joints,) rms at the crossings.
    """

    inputs: Inputs
    layout: _Layout
    theta: Array
    covariance: Array
    disturbance_k: float
    disturbance_s: float
    residual_k: Array
    _points: _Points
    _residual: Array
    #: drawn once, since each draw is a simulation of the whole run; nobody changes what was drawn
    _drawn: dict[tuple[int, int], Variants] = field(init=False, repr=False, compare=False, default_factory=dict)

    @property
    def known(self) -> Known:
        """What is known of the servos: the room and the start are the run's own."""
        keep = [k for k, (name, _) in enumerate(self.layout.names) if name in ALIKE]
        return Known(
            self.inputs.joints, _models(self.inputs), tuple(self.layout.names[k] for k in keep), self.theta[keep],
            self.covariance[np.ix_(keep, keep)],
        )  # fmt: skip

    def at(self, t: float) -> Fit:
        """The same knowledge, looked at from `t` (s) of the run: its state and its load then."""
        return replace(self, inputs=self.inputs.until(t))

    @property
    def estimates(self) -> tuple[HeatEstimate, ...]:
        """All parameters, the servos' first."""
        deviation = np.sqrt(np.diag(self.covariance))
        out = []
        for k, (name, joint) in enumerate(self.layout.names):
            low, high = self.theta[k] - Z95 * deviation[k], self.theta[k] + Z95 * deviation[k]
            if name in ("exponent", "gear"):
                low = max(low, 0.0)
            value, unit = self.theta[k], _unit(name)
            informed = 1.0 - self.covariance[k, k] / self.layout.covariance[k, k]
            if self.layout.log[k]:
                value, low, high = np.exp(value), np.exp(low), np.exp(high)
            share = float(np.clip(informed, 0.0, 1.0))
            out.append(HeatEstimate(name, joint, float(value), float(low), float(high), unit, share))
        return tuple(out)

    def as_json(self, held: HeldOut | None) -> dict[str, Any]:
        """With how it met what was held back, and what the next fit begins with (`Known.read`)."""
        return {
            "schema": "openant.thermal-fit/1",
            "parameters": {
                f"{one.joint}.{one.name}" if one.joint else one.name: {
                    "value": one.value, "low": one.low, "high": one.high, "unit": one.unit, "informed": one.informed,
                }
                for one in self.estimates
            },
            "held_out": None if held is None else vars(held),
            "disturbance": {"deviation_k": self.disturbance_k, "time_s": self.disturbance_s},
            "glitches": dict(zip(self.inputs.joints, map(int, self.inputs.glitches), strict=True)),
            "known": self.known.as_json(),
        }  # fmt: skip

    def estimate(self, name: str, joint: str = "") -> HeatEstimate:
        return next(one for one in self.estimates if (one.name, one.joint) == (name, joint))

    def variants(self, count: int, seed: int = 0) -> Variants:
        """Draws from what is believed after the run; the first is the best estimate itself."""
        if (count, seed) not in self._drawn:
            self._drawn[count, seed] = self._draw(count, seed)
        return self._drawn[count, seed]

    def _draw(self, count: int, seed: int) -> Variants:
        random = np.random.default_rng(seed)
        root = _root(self.covariance)
        theta = self.theta + random.standard_normal((count, len(self.theta))) @ root.T
        theta[0] = self.theta
        servos, start = _servos(self.inputs, self.layout, theta)
        _, state = _simulated(self.inputs, self.layout, theta, servos, start)
        mean, deviation = _disturbed(self.inputs, self._points, self._residual, self.disturbance_k, self.disturbance_s)
        offset = mean + deviation * random.standard_normal((count, len(mean)))
        offset[0] = mean
        held = np.zeros((count, len(self.inputs.joints)))
        for (k, stretch), place in self.layout.held.items():
            if stretch == self.inputs.stretch[-1, k]:
                held[:, k] = np.exp(theta[:, place])
        return Variants(servos, state, offset, held)

    def windings(self) -> Array:
        """(m, joints) °C of the windings over the run, by the best estimate."""
        theta = self.theta[None, :]
        servos, start = _servos(self.inputs, self.layout, theta)
        out = np.empty_like(self.inputs.drive)
        for i, state in enumerate(_states(self.inputs, self.layout, theta, servos, start)):
            out[i] = state.winding[0]
        return out

    def replayed(self, inputs: Inputs, count: int = 1, seed: int = 0) -> Array:
        """(count, m, joints) °C of the cases over a run that begins as this one does: cells' ends, the first the estimate."""
        random = np.random.default_rng(seed)
        theta = self.theta + random.standard_normal((count, len(self.theta))) @ _root(self.covariance).T
        theta[0] = self.theta
        servos, start = _servos(inputs, self.layout, theta)
        case, _ = _simulated(inputs, self.layout, theta, servos, start)
        return case


def fit(runs: Sequence[Inputs], *, after: Known | None = None) -> Fit:
    """Fit one robot's heat to its runs, one after the other: what a run teaches is believed before the next.

    Args:
        runs: of the same servos, in the order in which they were recorded.
        after: what earlier runs taught.

    Raises:
        BadInput: no runs, or runs of different servos.
    """
    if not runs:
        raise BadInput("no run to fit", remedy="name one or more recordings with temperatures")
    found: Fit | None = None
    known = after
    for one in runs:
        if known is not None and (one.joints, _models(one)) != (known.joints, known.models):
            raise BadInput(
                f"{one.name} is of other servos than what is known", remedy="fit the runs of one robot at a time"
            )
        found = _fit_one(one, known)
        known = found.known
    assert found is not None
    return found


def fit_and_judge(runs: Sequence[Inputs], *, after: Known | None = None) -> tuple[Fit, HeldOut | None]:
    """Fit as `fit` does, and judge it on the last run; None where that is too short to have a later part.

    Raises:
        BadInput: as `fit`.
    """
    before = fit(runs[:-1], after=after).known if len(runs) > 1 else after
    found = fit(runs[-1:], after=before)
    return found, held_out(runs[-1], after=before) if runs[-1].duration_s >= LEAST_HELD_OUT_S else None


def _models(run: Inputs) -> tuple[str, ...]:
    return tuple(model.name if model else "" for model in run.models)


def held_out(run: Inputs, *, after: Known | None = None, draws: int = 200) -> HeldOut:
    """Fit the first part of a run and meet the rest, whose loads are known and whose temperatures are not."""
    split = TRAINED * run.duration_s
    trained = fit([run.until(split)], after=after)
    case = trained.replayed(run, draws)
    rows = run.edges[1:] > trained.inputs.duration_s + 1e-6
    random = np.random.default_rng(1)
    drift = trained.disturbance_k * random.standard_normal((draws, 1, len(run.joints)))
    reading = ENTERED * (2 * random.random((draws, rows.sum(), len(run.joints))) - 1)
    low, high = np.quantile(case[:, rows] + drift + reading, [0.025, 0.975], axis=0)
    seen = run.readings[rows] + 0.5
    away = np.abs(seen - case[0, rows])
    good = np.isfinite(seen)
    if not good.any():
        raise BadInput("nothing was read in the later part", where=run.name)
    worst = int(np.nanargmax(np.where(good, away, np.nan).max(axis=0, initial=0.0, where=good)))
    inside = (seen >= low) & (seen <= high)
    return HeldOut(
        split,
        float(np.sqrt(np.mean(away[good] ** 2))),
        float(np.max(away[good])),
        run.joints[worst],
        float(np.mean(inside[good])),
    )


#: K, half a step of the thermometer
ENTERED = 0.5


# ---- the parameter vector ----


def _unit(name: str) -> str:
    return {
        "leg_w_k": LEG_PRIOR.unit, "exponent": "1", "gear": "1", "room_c": "°C", "start_k": "°C", "start_winding_k": "K",
        "held_w": "W",
    }.get(name) or PRIORS[name].unit  # fmt: skip


def _layout(run: Inputs, before: Known | None) -> _Layout:
    names: list[tuple[str, str]] = []
    mean, spread, log = list[float](), list[float](), list[bool]()

    def put(name: str, joint: str, value: float, deviation: float, is_log: bool) -> int:
        names.append((name, joint))
        mean.append(value)
        spread.append(deviation)
        log.append(is_log)
        return len(names) - 1

    groups: dict[tuple[str, str], list[int]] = {}
    for k, joint in enumerate(run.joints):
        model = run.models[k].name if run.models[k] else ""  # type: ignore[union-attr]
        kind = JOINTS[joint].kind if joint in JOINTS else joint
        for name, prior in PRIORS.items():
            median = prior.value
            if name == "case_j_k" and run.models[k] is not None:
                median = CASE_J_K.get(model, prior.value)
            place = put(name, joint, math.log(median), prior.spread, True)
            groups.setdefault((name, f"{model} {kind}"), []).append(place)
    for k, partner in enumerate(run.partner.tolist()):
        if partner > k:
            put("leg_w_k", run.joints[k], math.log(LEG_PRIOR.value), LEG_PRIOR.spread, True)
    put("exponent", "", EXPONENT_PRIOR.value, EXPONENT_PRIOR.spread, False)
    put("gear", "", GEAR_PRIOR.value, GEAR_PRIOR.spread, False)
    first = np.array([one.temperature[0] if len(one.t) else np.nan for one in run.observed])
    room, sure = run.ambient_c, ROOM_KNOWN_K
    if room is None:
        room, sure = float(np.nanmin(first)) - 0.5 - ROOM_BELOW_K, ROOM_GUESSED_K
    put("room_c", "", room + 0.5, sure, False)
    for k, joint in enumerate(run.joints):
        put("start_k", joint, float(first[k]), START_SD_K, False)
        put("start_winding_k", joint, 0.5, START_WINDING_K, False)
    held = {}
    for k, source in enumerate(run.source):
        if source == "unknown":
            for stretch in sorted(set(run.stretch[:, k].tolist())):
                held[k, stretch] = put("held_w", run.joints[k], math.log(UNKNOWN_W.value), UNKNOWN_W.spread, True)
    covariance = np.diag(np.square(spread))
    for (name, _), places in groups.items():
        shared = max(PRIORS[name].spread ** 2 - PRIORS[name].own ** 2, 0.0)
        for one in places:
            for other in places:
                if one != other:
                    covariance[one, other] = shared
    if before is not None:
        _believe(names, mean, covariance, before)
    return _Layout(tuple(names), np.array(mean), covariance, np.array(log), held)


#: J/K, weight of the servo times 0.8 J/(g·K), of which the part inside that warms last is left out
CASE_J_K: Mapping[str, float] = {"XL430-W250-T": 45.0, "XC430-W240-T": 52.0, "XM430-W350-T": 64.0, "XM430-W210-T": 64.0}


def _believe(names: list[tuple[str, str]], mean: list[float], covariance: Array, before: Known) -> None:
    """What an earlier run taught, in place of the priors; the room and the start are each run's own."""
    theirs = {name: k for k, name in enumerate(before.names)}
    ours = [k for k, name in enumerate(names) if name in theirs]
    places = [theirs[names[k]] for k in ours]
    covariance[np.ix_(ours, ours)] = before.covariance[np.ix_(places, places)]
    for k, place in zip(ours, places, strict=True):
        mean[k] = float(before.theta[place])


def _servos(run: Inputs, layout: _Layout, theta: Array) -> tuple[ServoHeat, State]:
    """(b, p) parameter vectors as servos and their start."""

    def each(name: str) -> Array:
        return np.asarray(np.exp(theta[:, layout.columns(name)]))

    legs = np.zeros((len(theta), len(run.joints)))
    for place in layout.columns("leg_w_k"):
        k = run.joints.index(layout.names[place][1])
        legs[:, k] = legs[:, run.partner[k]] = np.exp(theta[:, place])
    unknown = np.array([source == "unknown" for source in run.source])
    resistance = np.array([model.resistance_ohm if model else 1.0 for model in run.models])
    case = theta[:, layout.columns("start_k")]
    scale = each("scale")
    scale[:, unknown] = 1.0
    servos = ServoHeat(
        each("case_j_k"), each("air_w_k"), each("winding_j_k"), each("winding_w_k"), scale, each("idle"), legs,
        theta[:, layout.columns("room_c")], np.clip(theta[:, layout.columns("exponent")], 0.0, 0.5),
        np.clip(theta[:, layout.columns("gear")], 0.0, 1.0), np.where(unknown, 1.0, resistance), by_duty(run.source),
        run.partner,
    )  # fmt: skip
    return servos, State(case + theta[:, layout.columns("start_winding_k")], case.copy())


def _simulated(run: Inputs, layout: _Layout, theta: Array, servos: ServoHeat, start: State) -> tuple[Array, State]:
    """(b, m, joints) °C of the cases at the cells' ends, and the state at the last."""
    out = np.empty((len(theta), len(run.edges) - 1, len(run.joints)))
    state = start
    for i, state in enumerate(_states(run, layout, theta, servos, start)):
        out[:, i] = state.case
    return out, state


def _states(run: Inputs, layout: _Layout, theta: Array, servos: ServoHeat, start: State) -> Iterator[State]:
    """The state at each cell's end."""
    state, steps = start, np.diff(run.edges)
    unknown = sorted({k for k, _ in layout.held})
    last = {k: max(stretch for one, stretch in layout.held if one == k) for k in unknown}
    for i in range(len(steps)):
        here: Array = run.drive[i]
        if unknown:
            here = np.broadcast_to(here, (len(theta), len(run.joints))).copy()
            for k in unknown:
                # A pose that was not fitted is taken to be as the last one that was.
                here[:, k] = np.exp(theta[:, layout.held[k, min(int(run.stretch[i, k]), last[k])]])
        state = advance(servos, state, float(steps[i]), here, run.gear[i], run.idle[i])
        yield state


# ---- the fit ----


@dataclass(frozen=True)
class _Points:
    """All crossings of a run as one vector: whose, when, what, how sure."""

    joint: NDArray[np.intp]
    t: Array
    temperature: Array
    sd: Array

    @classmethod
    def of(cls, run: Inputs) -> _Points:
        joint = np.concatenate([np.full(len(one.t), k, np.intp) for k, one in enumerate(run.observed)])
        t, temperature, sd = (
            np.concatenate([getattr(one, name) for one in run.observed]) for name in ("t", "temperature", "sd")
        )
        return cls(joint, t, temperature, sd)

    def seen_in(self, run: Inputs, start: Array, case: Array) -> Array:
        """(b, n) what (b, joints) starts and (b, m, joints) ends of cells say at the points, on straight lines between."""
        whole = np.concatenate([start[:, None, :], case], axis=1)
        cell = np.clip(np.searchsorted(run.edges, self.t, side="right") - 1, 0, len(run.edges) - 2)
        share = (self.t - run.edges[cell]) / (run.edges[cell + 1] - run.edges[cell])
        return np.asarray(whole[:, cell, self.joint] * (1 - share) + whole[:, cell + 1, self.joint] * share)

    def noise(self, deviation: float, tau: float) -> _Noise:
        """The thermometers' own errors (K) and a slow disturbance at each joint: a deviation (K) that lasts for τ (s)."""
        rows = [np.flatnonzero(self.joint == k) for k in np.unique(self.joint)]
        roots = []
        for mine in rows:
            apart = np.abs(self.t[mine, None] - self.t[None, mine])
            covariance = np.diag(self.sd[mine] ** 2) + deviation**2 * np.exp(-apart / tau)
            roots.append(linalg.cholesky(covariance, lower=True))
        return _Noise(rows, roots)


@dataclass(frozen=True)
class _Noise:
    """What disturbs the points, each joint's by itself: its rows and the lower root of its covariance, K."""

    rows: Sequence[NDArray[np.intp]]
    roots: Sequence[Array]

    def whitened(self, values: Array) -> Array:
        """(n, …) values at the points, so weighed that their errors are independent and of size 1."""
        out = np.empty_like(values)
        for rows, root in zip(self.rows, self.roots, strict=True):
            out[rows] = linalg.solve_triangular(root, values[rows], lower=True)
        return out

    @property
    def log_size(self) -> float:
        """Half the logarithm of the covariance's determinant."""
        return sum(float(np.log(np.diag(root)).sum()) for root in self.roots)


def _fit_one(run: Inputs, before: Known | None) -> Fit:
    layout, points = _layout(run, before), _Points.of(run)
    if len(points.t) < 2:
        raise BadInput("there are no temperatures in this part of the run", where=run.name)
    theta = layout.mean.copy()
    prior = linalg.inv(layout.covariance)
    deviation, tau = math.exp(_DISTURBANCE_PRIOR[0]), DISTURBANCE_S[1]
    residual, jacobian = _linearised(run, layout, points, theta)
    for round_ in range(3):
        noise = points.noise(deviation, tau)
        theta, residual, jacobian = _gauss_newton(run, layout, points, theta, prior, noise, residual, jacobian)
        if round_ < 2:
            deviation, tau = _evidence(points, layout, theta, residual, jacobian)
    weighted = noise.whitened(jacobian)
    covariance = linalg.inv(weighted.T @ weighted + prior)
    rms = np.array(
        [np.sqrt(np.mean(residual[points.joint == k] ** 2)) if (points.joint == k).any() else np.nan
         for k in range(len(run.joints))]
    )  # fmt: skip
    return Fit(run, layout, theta, (covariance + covariance.T) / 2, deviation, tau, rms, points, residual)


def _linearised(run: Inputs, layout: _Layout, points: _Points, theta: Array) -> tuple[Array, Array]:
    """(n,) residuals in K and their (n, p) derivatives of the model by its parameters."""
    steps = np.full(len(theta), 1e-3)
    steps[~layout.log] = 1e-2
    row, reached = _apart(run, layout)
    batch = np.tile(theta, (row.max() + 1, 1))
    batch[row, np.arange(len(theta))] += steps
    servos, start = _servos(run, layout, batch)
    case, _ = _simulated(run, layout, batch, servos, start)
    seen = points.seen_in(run, start.case, case)
    change = np.where(reached[:, points.joint], seen[row] - seen[0], 0.0)
    return points.temperature - seen[0], (change / steps[:, None]).T


def _apart(run: Inputs, layout: _Layout) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Which parameters may be changed in one and the same simulation, since no joint feels two of them.

    Heat goes from a servo to its neighbour in the leg and no farther.

    Returns:
        (p,) the simulation in which each is changed, from 1 (0 changes nothing); (p, joints) whom each reaches.
    """
    partner = np.where(run.partner >= 0, run.partner, np.arange(len(run.joints)))
    reached = np.ones((len(layout.names), len(run.joints)), bool)
    for place, (_, joint) in enumerate(layout.names):
        if joint:
            k = run.joints.index(joint)
            reached[place] = False
            reached[place, [k, partner[k]]] = True
    row, taken = np.zeros(len(reached), np.intp), list[NDArray[np.bool_]]()
    for place, mine in enumerate(reached):
        free = next((n for n, others in enumerate(taken) if not (others & mine).any()), len(taken))
        if free == len(taken):
            taken.append(mine.copy())
        else:
            taken[free] |= mine
        row[place] = free + 1
    return row, reached


def _gauss_newton(
    run: Inputs,
    layout: _Layout,
    points: _Points,
    theta: Array,
    prior: Array,
    noise: _Noise,
    residual: Array,
    jacobian: Array,
) -> tuple[Array, Array, Array]:
    """The best parameters for this noise, with residuals and derivatives there; steps are shortened until they help."""

    def cost(residual: Array, theta: Array) -> float:
        whitened = noise.whitened(residual)
        away = theta - layout.mean
        return float(whitened @ whitened + away @ prior @ away)

    best, damping = cost(residual, theta), 1e-3
    for _ in range(ITERATIONS):
        weighted = noise.whitened(jacobian)
        gradient = weighted.T @ noise.whitened(residual) - prior @ (theta - layout.mean)
        curvature = weighted.T @ weighted + prior
        step = linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient, assume_a="pos")
        step = (
            np.clip(step, -1.0, 1.0)
            if not (~layout.log).any()
            else np.where(layout.log, np.clip(step, -0.7, 0.7), step)
        )
        tried = theta + step
        new_residual, new_jacobian = _linearised(run, layout, points, tried)
        now = cost(new_residual, tried)
        if now < best:
            gained, best = best - now, now
            theta, residual, jacobian = tried, new_residual, new_jacobian
            damping = max(damping / 5, 1e-6)
            if gained < 1e-3:
                break
        else:
            damping *= 8
            if damping > 1e4:
                break
    return theta, residual, jacobian


def _evidence(points: _Points, layout: _Layout, theta: Array, residual: Array, jacobian: Array) -> tuple[float, float]:
    """The disturbance (K, s) under which these points are most probable, the parameters integrated out."""
    z = residual + jacobian @ (theta - layout.mean)
    # (n, p): with the parameters, the points' covariance is that of the noise and this times its transpose. So few
    # parameters are taken out by themselves (Woodbury), and the noise is one joint's at a time.
    shown = jacobian @ _root(layout.covariance)
    one = np.eye(len(theta))
    best = (-math.inf, DISTURBANCE_K[0], DISTURBANCE_S[0])
    for deviation in DISTURBANCE_K:
        centre, spread = _DISTURBANCE_PRIOR
        prior = -0.5 * ((math.log(deviation) - centre) / spread) ** 2
        for tau in DISTURBANCE_S:
            noise = points.noise(deviation, tau)
            whitened, weighted = noise.whitened(z), noise.whitened(shown)
            root = linalg.cholesky(one + weighted.T @ weighted, lower=True)
            explained = linalg.solve_triangular(root, weighted.T @ whitened, lower=True)
            away = float(whitened @ whitened) - float(explained @ explained)
            value = -0.5 * away - noise.log_size - float(np.log(np.diag(root)).sum()) + prior
            best = max(best, (value, deviation, tau))
    return best[1], best[2]


def _disturbed(run: Inputs, points: _Points, residual: Array, deviation: float, tau: float) -> tuple[Array, Array]:
    """(joints,) mean and standard deviation of the disturbance at the run's end, given the residuals."""
    mean, sd = np.zeros(len(run.joints)), np.full(len(run.joints), deviation)
    for k in range(len(run.joints)):
        rows = points.joint == k
        if not rows.any():
            continue
        t = points.t[rows]
        inner = np.diag(points.sd[rows] ** 2) + deviation**2 * np.exp(-np.abs(t[:, None] - t[None, :]) / tau)
        outer = deviation**2 * np.exp(-np.abs(run.duration_s - t) / tau)
        weights = linalg.solve(inner, outer, assume_a="pos")
        mean[k] = float(weights @ residual[rows])
        sd[k] = math.sqrt(max(deviation**2 - float(weights @ outer), 0.0))
    return mean, sd


def _root(covariance: Array) -> Array:
    """A matrix whose square is the covariance, be it only just positive."""
    values, vectors = linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
