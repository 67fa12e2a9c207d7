"""What a fit says of the time to come: shutdowns, torque that can be held, rests, cooling.

A servo shuts down when its reading passes its limit (facts/dynamixel C3): at limit + 1 on the scale of `inputs`. All
answers are made from the same draws of parameters, state and disturbance, each brought forward on its own; the room goes its
own way meanwhile. Intervals are 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.robot.derating import Derating, Joint
from openant_tools.thermal.fit import Fit, Variants
from openant_tools.thermal.physics import Servos, State, advance, steady_drive

__all__ = [
    "COOLED_K", "HORIZON_S", "Forecast", "Interval", "JointForecast", "Load", "cool_down", "derating", "forecast", "present_load",
    "rest_advice", "torque_load",
]  # fmt: skip

Array = NDArray[np.float64]

#: s that a forecast looks ahead; what does not happen until then is "not foreseen"
HORIZON_S = 8 * 3600.0
STEP_S = 20.0
DRAWS = 400
#: s over which the present load is averaged: several rounds of any gait, short against a case
PRESENT_S = 60.0
#: K per √h by which a room goes its own way: a window, the sun, a heating that switches
ROOM_K = 1.0
#: probability from which on a shutdown is spoken of at all: with less its interval would begin beyond the horizon
SPOKEN_OF = 0.025
HOUR_S = 3600.0
#: The maker's advice after a shutdown (facts/dynamixel C3), s; and K below its limit at which a servo counts as cool.
LEAST_COOLING_S, COOLED_K = 1200.0, 20.0
#: K below a limit at which derating has taken what it takes, and over which it takes it.
DERATED_BELOW_K, DERATED_OVER_K = 2.0, 8.0
#: Of the torque that could be held for ever, how much is left at the hottest: then the servo cools.
DERATED_SHARE = 0.9


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, draws: Array) -> Interval:
        """Median and the middle 95 % of (b,) draws."""
        low, value, high = np.quantile(draws, [0.025, 0.5, 0.975])
        return cls(float(value), float(low), float(high))

    def as_json(self) -> dict[str, float]:
        return {"value": self.value, "low": self.low, "high": self.high}


@dataclass(frozen=True)
class Load:
    """What the servos do from now on.

    Attributes:
        drive: (joints,) A² or V² as the fit takes it, or (b, joints). gear, idle: (joints,) W. words: for people.
    """

    drive: Array
    gear: Array
    idle: Array
    words: str


@dataclass(frozen=True)
class JointForecast:
    """One joint.

    Attributes:
        temperature_c: now. limit_c: where it shuts down.
        seconds_to_limit: from now; None where a shutdown is not to be expected within the horizon. Ends beyond it are the
            horizon.
        probability: of a shutdown within the horizon.
        settles_c: where it goes under this load, were there no limit.
        continuous_torque_nm: what it could bear for ever. hour_torque_nm: for an hour from a cold start.
    """

    joint: str
    temperature_c: float
    limit_c: float
    seconds_to_limit: Interval | None
    probability: float
    settles_c: Interval
    continuous_torque_nm: Interval | None
    hour_torque_nm: Interval | None

    def as_json(self) -> dict[str, object]:
        """As formats, section 6 has it, and more."""

        def table(interval: Interval | None) -> dict[str, float] | None:
            return None if interval is None else interval.as_json()

        return {
            "joint": self.joint,
            "temperature_c": self.temperature_c,
            "limit_c": self.limit_c,
            "seconds_to_limit": table(self.seconds_to_limit),
            "probability": self.probability,
            "settles_c": table(self.settles_c),
            "continuous_torque_nm": table(self.continuous_torque_nm),
            "hour_torque_nm": table(self.hour_torque_nm),
        }

    @property
    def words(self) -> str:
        """`knee_fl reaches 72 °C after 31 ± 4 min`."""
        when = self.seconds_to_limit
        if when is None:
            return f"{self.joint} stays below {self.limit_c:.0f} °C: it settles at {_about(self.settles_c)} °C"
        if when.high >= HORIZON_S:
            return (
                f"{self.joint} reaches {self.limit_c:.0f} °C with a probability of {self.probability:.0%}, "
                f"not before {when.low / 60:.0f} min"
            )
        half = (when.high - when.low) / 120
        return f"{self.joint} reaches {self.limit_c:.0f} °C after {when.value / 60:.0f} ± {half:.0f} min"


def _about(interval: Interval) -> str:
    return f"{interval.value:.0f} ± {(interval.high - interval.low) / 2:.0f}"


@dataclass(frozen=True)
class Forecast:
    """Of all joints, with the fan for pictures.

    Attributes:
        joints: one each. load: what was taken for the time to come.
        t: (n,) s from now. fan: quantile → (n, joints) °C as the servos would read.
    """

    joints: tuple[JointForecast, ...]
    load: Load
    t: Array
    fan: Mapping[float, Array]

    @property
    def first(self) -> JointForecast | None:
        """Who shuts down first, None where nobody does."""
        due = [one for one in self.joints if one.seconds_to_limit is not None]
        return min(due, key=lambda one: (one.seconds_to_limit.value, -one.probability), default=None)  # type: ignore[union-attr]


def present_load(found: Fit, seconds: float | None = PRESENT_S) -> Load:
    """The mean load of the fitted run's last `seconds`, of all of it for None."""
    run = found.inputs
    rows = np.ones(len(run.edges) - 1, bool) if seconds is None else run.edges[1:] > run.duration_s - seconds
    rows[-1] = True
    words = "the load of the whole run" if seconds is None else "the present load"
    return Load(run.drive[rows].mean(axis=0), run.gear[rows].mean(axis=0), run.idle[rows].mean(axis=0), words)


def torque_load(found: Fit, torque_nm: Mapping[str, float]) -> Load:
    """Joints that hold a torque at standstill, the others at their present load.

    Raises:
        BadInput: no such joint, or one whose servo model is not known.
    """
    load = present_load(found)
    drive = load.drive.copy()
    for joint, torque in torque_nm.items():
        if joint not in found.inputs.joints:
            raise BadInput(f"the run has no joint {joint!r}", remedy=f"one of {', '.join(found.inputs.joints)}")
        k = found.inputs.joints.index(joint)
        model = found.inputs.models[k]
        if model is None or found.inputs.source[k] == "unknown":
            raise BadInput(
                f"the load of {joint} was not recorded, so that torques mean nothing to the fit",
                where=found.inputs.name,
                remedy="record current, duty or load too: `openant thermal soak` does",
            )
        current = torque / model.kt_nm_a
        drive[k] = (current * model.resistance_ohm) ** 2 if found.inputs.source[k] == "duty" else current**2
    words = ", ".join(f"{torque:g} N·m at {joint}" for joint, torque in torque_nm.items())
    return replace(load, drive=drive, gear=np.where(drive != load.drive, 0.0, load.gear), words=words)


def forecast(
    found: Fit, load: Load | None = None, *, horizon_s: float = HORIZON_S, draws: int = DRAWS, seed: int = 0,
    from_cold: bool = False, torques: bool = True,
) -> Forecast:  # fmt: skip
    """Bring every draw forward under a load.

    Args:
        load: None for the present one.
        from_cold: from the room's temperature instead of from the state at the end of the run.
        torques: also find the torques that can be held, which costs about a second.
    """
    run = found.inputs
    load = load or present_load(found)
    variants = found.variants(draws, seed)
    steps = int(np.ceil(horizon_s / STEP_S))
    limit = run.limit_c + 1.0
    t, paths = _paths(found, variants, load, steps, seed, from_cold)
    beyond: NDArray[np.bool_] = np.greater_equal(paths, limit)
    reached = beyond.any(axis=1)
    first = beyond.argmax(axis=1)
    before = np.take_along_axis(paths, np.maximum(first - 1, 0)[:, None, :], axis=1)[:, 0]
    at = np.take_along_axis(paths, first[:, None, :], axis=1)[:, 0]
    share = np.clip((limit - before) / np.maximum(at - before, 1e-9), 0.0, 1.0)
    when = np.where(reached, np.where(first == 0, t[0] * 0.5, t[np.maximum(first - 1, 0)] + share * STEP_S), horizon_s)
    lasting = _continuous(found, variants, load) if torques else None
    hour = _for_an_hour(found, variants, load) if torques else None
    newest = run.readings
    joints = []
    for k, joint in enumerate(run.joints):
        seen = newest[np.isfinite(newest[:, k]), k]
        probability = float(reached[:, k].mean())
        joints.append(
            JointForecast(
                joint,
                float(seen[-1]) if len(seen) else math.nan,
                float(run.limit_c[k]),
                Interval.of(when[:, k]) if probability >= SPOKEN_OF else None,
                probability,
                Interval.of(paths[:, -1, k] - 0.5),
                None if lasting is None else _torque(found, k, lasting[:, k]),
                None if hour is None else _torque(found, k, hour[:, k]),
            )
        )
    every = max(1, steps // 400)
    fan = {q: np.quantile(paths[:, ::every], q, axis=0) - 0.5 for q in (0.025, 0.25, 0.5, 0.75, 0.975)}
    return Forecast(tuple(joints), load, t[::every], fan)


def _paths(found: Fit, variants: Variants, load: Load, steps: int, seed: int, from_cold: bool) -> tuple[Array, Array]:
    """(n,) s and (b, n, joints) °C, disturbance and the room's own way included."""
    random = np.random.default_rng(seed + 1)
    servos, state, offset = variants.servos, variants.state, variants.offset
    b, n = state.case.shape
    if from_cold:
        cold = np.broadcast_to(servos.room_c, (b, n)).copy()
        state = State(cold, cold.copy())
        offset = found.disturbance_k * random.standard_normal((b, n))
    room: Array = servos.room_c.copy()
    fade = math.exp(-STEP_S / found.disturbance_s)
    shake = found.disturbance_k * math.sqrt(1 - fade**2)
    drive = _driven(found, variants, load)
    out = np.empty((b, steps, n))
    for i in range(steps):
        room = room + ROOM_K * math.sqrt(STEP_S / HOUR_S) * random.standard_normal((b, 1))
        state = advance(servos, state, STEP_S, drive, load.gear, load.idle, room)
        offset = offset * fade + shake * random.standard_normal((b, n))
        out[:, i] = state.case + offset
    t: Array = STEP_S * np.arange(1, steps + 1, dtype=float)
    return t, out


def _driven(found: Fit, variants: Variants, load: Load) -> Array:
    unknown = np.array([source == "unknown" for source in found.inputs.source])
    return np.where(unknown, variants.held, load.drive)


def _torque(found: Fit, k: int, drive: Array) -> Interval | None:
    """Drives as N·m at standstill, by the data sheet's constant; None where the drive is unknown heat."""
    model = found.inputs.models[k]
    if model is None or found.inputs.source[k] == "unknown":
        return None
    current = np.sqrt(np.maximum(drive, 0.0))
    if found.inputs.source[k] == "duty":
        current = current / model.resistance_ohm
    return Interval.of(model.kt_nm_a * current)


def _continuous(found: Fit, variants: Variants, load: Load) -> Array:
    """(b, joints) drives that each joint could bear for ever, its neighbour at the load given."""
    run, servos = found.inputs, variants.servos
    warmed = variants.state
    drive = _driven(found, variants, load)
    limit: Array = np.asarray(run.limit_c, float)
    others = np.empty_like(warmed.case)
    for k, partner in enumerate(run.partner.tolist()):
        if partner < 0:
            continue
        # The neighbour settles beside a case at its limit.
        held = State(warmed.winding.copy(), warmed.case.copy())
        for _ in range(SETTLING):
            held.case[:, k] = float(run.limit_c[k])
            held = advance(servos, held, SETTLING_S, drive, load.gear, load.idle)
        others[:, partner] = held.case[:, partner]
    return _by_voltage(found, servos, steady_drive(servos, limit, load.idle, others), limit, load.idle, others)


#: steps, and s of each, in which a case comes to rest beside a neighbour held at a temperature
SETTLING, SETTLING_S = 12, 900.0


def _by_voltage(found: Fit, servos: Servos, drive: Array, limit: Array, idle: Array, others: Array) -> Array:
    """Drives of duty as those of the same current in a cold winding: torque is current's."""
    rise = np.maximum(limit - servos.room_c, 0.0)
    air = servos.air_w_k * rise * (np.maximum(rise, 0.5) / 30.0) ** servos.exponent
    leg = servos.leg_w_k * (servos.partner >= 0) * (limit - others[:, servos.partner])
    power = np.maximum(air + leg - servos.idle * idle, 0.0)
    hot = 1 + 0.0039 * (limit + power / servos.winding_w_k - 25.0)
    return np.where(servos.by_duty, drive / hot**2, drive)


def _for_an_hour(found: Fit, variants: Variants, load: Load) -> Array:
    """(b, joints) drives under which a cold servo comes to its limit in just an hour, its neighbour at the load given."""
    run, servos = found.inputs, variants.servos
    b, n = variants.state.case.shape
    limit = run.limit_c + 1.0
    present = np.broadcast_to(_driven(found, variants, load), (b, n))
    out = np.zeros((b, n))
    halves = [np.array([(joint.startswith("knee")) == knee for joint in run.joints]) for knee in (True, False)]
    resistance = servos.resistance
    for tried in halves:
        if not tried.any():
            continue
        # Torque is current's, so the search is in A², whatever the source; a duty has the voltage of that current when hot.
        low, high = np.zeros((b, n)), np.full((b, n), 25.0)
        current_only = replace(servos, by_duty=servos.by_duty & ~tried)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            state = State(np.broadcast_to(servos.room_c, (b, n)).copy(), np.broadcast_to(servos.room_c, (b, n)).copy())
            drive = np.where(tried, middle, present)
            for _ in range(int(HOUR_S / HOUR_STEP_S)):
                state = advance(current_only, state, HOUR_STEP_S, drive, load.gear, load.idle)
            too_warm = state.case >= limit
            high, low = np.where(too_warm, middle, high), np.where(too_warm, low, middle)
        found_a2 = (low + high) / 2
        out = np.where(tried, np.where(servos.by_duty, found_a2 * resistance**2, found_a2), out)
    return out


BISECTIONS, HOUR_STEP_S = 12, 60.0


# ---- advice ----


@dataclass(frozen=True)
class Rest:
    """How to work so that no servo shuts down: `work_s`, then `rest_s` with torque off; None for no end of work.

    Attributes:
        share: of the time under load that is borne for ever.
        joint: who decides.
    """

    work_s: float | None
    rest_s: float
    share: float
    joint: str | None

    @property
    def words(self) -> str:
        if self.work_s is None:
            return "it can go on without rests"
        if self.work_s <= 0:
            return f"{self.joint} is not cool enough to work: let it rest {self.rest_s / 60:.0f} min first"
        return (
            f"work {self.work_s / 60:.0f} min, rest {self.rest_s / 60:.0f} min with torque off ({self.joint} decides)"
        )


def rest_advice(found: Fit, load: Load | None = None, *, draws: int = 100, seed: int = 0) -> Rest:
    """Work until the earliest likely shutdown less a margin, rest until the decider has cooled.

    The times are for the cautious end of the interval: 19 of 20 robots believed in come through.
    """
    load = load or present_load(found)
    run = found.inputs
    told = forecast(found, load, draws=draws, seed=seed, from_cold=True, torques=False)
    due = [(one.seconds_to_limit.low, one.joint) for one in told.joints if one.seconds_to_limit is not None]
    if not due:
        return Rest(None, 0.0, 1.0, None)
    work, joint = min(due)
    work *= 0.9
    k = run.joints.index(joint)
    variants = found.variants(draws, seed)
    cold = np.broadcast_to(variants.servos.room_c, variants.state.case.shape).copy()
    state = State(cold, cold.copy())
    drive = _driven(found, variants, load)
    for _ in range(max(1, int(work / STEP_S))):
        state = advance(variants.servos, state, STEP_S, drive, load.gear, load.idle)
    goal = float(run.limit_c[k]) - COOLED_K
    rest = 0.0
    while rest < HORIZON_S and np.quantile(state.case[:, k], 0.95) > goal:
        state = advance(variants.servos, state, STEP_S, np.zeros_like(drive), np.zeros_like(load.gear), load.idle)
        rest += STEP_S
    # From warm the next work is shorter: until the decider is at its limit again.
    again = 0.0
    while again < work and np.quantile(state.case[:, k], 0.95) < run.limit_c[k]:
        state = advance(variants.servos, state, STEP_S, drive, load.gear, load.idle)
        again += STEP_S
    return Rest(again, rest, again / max(again + rest, 1e-9), joint)


def cool_down(found: Fit, joint: str, *, below_k: float = COOLED_K, draws: int = 200, seed: int = 0) -> Interval:
    """s from now, torque off, until a joint's case is `below_k` under its limit: when torque may come back.

    Never less than the maker's 20 minutes where it is hotter than that now: the winding is hotter than the case shows.
    """
    run = found.inputs
    k = run.joints.index(joint)
    variants = found.variants(draws, seed)
    state, goal = variants.state, float(run.limit_c[k]) - below_k
    nothing = np.zeros(len(run.joints))
    idle = present_load(found).idle
    when = np.where(state.case[:, k] + variants.offset[:, k] <= goal, 0.0, np.nan)
    if not np.isnan(when).any():
        return Interval(0.0, 0.0, 0.0)
    t = 0.0
    while np.isnan(when).any() and t < HORIZON_S:
        state = advance(variants.servos, state, STEP_S, nothing, nothing, idle)
        t += STEP_S
        offset = variants.offset[:, k] * math.exp(-t / found.disturbance_s)
        when = np.where(np.isnan(when) & (state.case[:, k] + offset <= goal), t, when)
    return Interval.of(np.maximum(np.nan_to_num(when, nan=HORIZON_S), LEAST_COOLING_S))


def derating(
    found: Fit, load: Load | None = None, *, told: Forecast | None = None, joints: Sequence[str] = ()
) -> Derating:
    """The rule under which this load can go on for ever: torque falls towards what each joint can bear.

    Args:
        load: what is to be derated, None for the present one. told: a forecast of it with torques, if there is one.
        joints: only these; else those that would pass their limit with more than a 2.5 % chance.
    """
    load = load or present_load(found)
    told = told or forecast(found, load)
    rules = {}
    for k, one in enumerate(told.joints):
        if (joints and one.joint not in joints) or (not joints and one.seconds_to_limit is None):
            continue
        asked = _torque(found, k, np.atleast_1d(load.drive[..., k]))
        if one.continuous_torque_nm is None or asked is None or asked.value <= 0:
            continue
        # The cautious end of what can be borne, with a tenth in hand, so that the servo cools at the hot end.
        least = DERATED_SHARE * one.continuous_torque_nm.low / asked.value
        stop = one.limit_c - DERATED_BELOW_K
        rules[one.joint] = Joint(stop - DERATED_OVER_K, stop, float(np.clip(least, 0.0, 1.0)))
    return Derating(rules)
