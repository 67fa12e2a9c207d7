"""What a fit says of the time to come: shutdowns, torque that can be held, rests, cooling.

A servo shuts down when its reading passes its limit (facts/dynamixel C3): at limit + 1 on the scale of `inputs`. All
answers are made from the same draws of parameters, state and disturbance, each brought forward on its own; the room goes its
own way meanwhile. Intervals are 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number, percent, span
from openant_tools.procedure.intervals import Interval
from openant_tools.robot.derating import DeratedJoint, Derating
from openant_tools.thermal.fit import Fit, Known, Variants, fit
from openant_tools.thermal.inputs import Inputs
from openant_tools.thermal.physics import COPPER_PER_K, ServoHeat, State, advance, by_duty, steady_drive

__all__ = [
    "COOLED_K", "HORIZON_S", "HeatForecast", "JointForecast", "Outlook", "Workload", "cool_down", "derating", "forecast",
    "outlook", "present_load", "rest_advice", "settled", "torque_load",
]  # fmt: skip

Array = NDArray[np.float64]

#: s that a forecast looks ahead; what does not happen until then is "not foreseen"
HORIZON_S = 8 * 3600.0
#: s of a simulated step, below the time constant of any winding, and draws of the parameters
STEP_S = 20.0
DRAWS = 400
#: s of a block of the present load: several rounds of any gait, short against a case
BLOCK_S = 45.0
#: by how much a block may be away from those after it to be of the same load: share, and standard deviations of theirs
CHANGED, CHANGED_SD = 0.5, 6.0
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
class Workload:
    """What the servos do from now on.

    A pose that holds a weight needs a torque, and so a current; a joint pressed against a stop has a duty, from which less
    current comes the hotter the winding is. Which of the two goes on as it was is a matter of evidence.

    Attributes:
        current: (k, joints) A², means of the square over k successive blocks: how much, and how it varies.
        push: (k, joints) V², the same of what the duty puts over the windings.
        gear, idle: (joints,) W.
        by_duty: (joints,) probability that duty is what goes on.
        words: for people.
    """

    current: Array
    push: Array
    gear: Array
    idle: Array
    by_duty: Array
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
        when, limit = self.seconds_to_limit, number(self.limit_c, "°C")
        if when is None:
            return f"{self.joint} stays below {limit}: it settles at {_about(self.settles_c, 1.0, '°C')}"
        if when.high >= HORIZON_S:
            return (
                f"{self.joint} reaches {limit} with a probability of {percent(self.probability)}, "
                f"not before {_minutes(when.low)}"
            )
        if when.high - when.value > LOPSIDED * (when.value - when.low):
            return f"{self.joint} reaches {limit} after {_minutes(when.value)}, {span(when.low / 60, when.high / 60, decimals=0)}"
        return f"{self.joint} reaches {limit} after {_about(when, 60.0, 'min')}"


#: how many times longer the late side of an interval may be for "±" to be said of it
LOPSIDED = 2.0


def _about(interval: Interval, size: float, unit: str) -> str:
    """`31 ± 4 min`, of a unit of `size`."""
    half = 0.5 * (interval.high - interval.low)
    return f"{number(interval.value / size, decimals=0)} ± {number(half / size, unit, decimals=0)}"


def _minutes(seconds: float) -> str:
    return number(seconds / 60, "min", decimals=0)


@dataclass(frozen=True)
class HeatForecast:
    """Of all joints, with the fan for pictures.

    Attributes:
        joints: one each. load: what was taken for the time to come.
        t: (n,) s from now. fan: quantile → (n, joints) °C as the servos would read.
    """

    joints: tuple[JointForecast, ...]
    load: Workload
    t: Array
    fan: Mapping[float, Array]

    @property
    def first(self) -> JointForecast | None:
        """Who shuts down first, None where nobody does."""
        due = [one for one in self.joints if one.seconds_to_limit is not None]
        return min(due, key=lambda one: (one.seconds_to_limit.value, -one.probability), default=None)  # type: ignore[union-attr]


def present_load(found: Fit, *, whole: bool = False) -> Workload:
    """The load at the end of the fitted run, over as long as it has been like this; over all of the run if `whole`."""
    run = found.inputs
    width = max(1, round(BLOCK_S / float(np.diff(run.edges).mean())))
    ends = range(len(run.drive), 0, -width)
    rows = [slice(max(0, end - width), end) for end in ends]
    means = np.array([run.drive[block].mean(axis=0) for block in rows])
    count = len(means) if whole else _alike(means)
    first = rows[count - 1].start
    ohm = _resistance(found)
    duty = by_duty(run.source)
    push = np.where(duty, run.drive, run.drive * ohm**2)
    current = np.where(duty, run.drive / ohm**2, run.drive)
    # Heat of unknown cause is a number of each draw; the load is one of it.
    current = np.where(np.array([source == "unknown" for source in run.source]), 1.0, current)
    return Workload(
        np.array([current[block].mean(axis=0) for block in rows[:count]]),
        np.array([push[block].mean(axis=0) for block in rows[:count]]),
        run.gear[first:].mean(axis=0), run.idle[first:].mean(axis=0), _held_by_duty(found, ohm, slice(first, len(push))),
        "the load of the whole run" if whole else "the present load",
    )  # fmt: skip


def _resistance(found: Fit) -> Array:
    """(m, joints) Ω over the run, by the best estimate."""
    cold = np.array([model.resistance_ohm if model else 1.0 for model in found.inputs.models])
    return np.asarray(cold * (1 + COPPER_PER_K * (found.windings() - 25.0)))


def _alike(means: Array) -> int:
    """How many of (k, joints) block means, the newest first, are of the same load."""
    size = np.maximum(np.median(means, axis=0), 1e-9)
    # A single change of load hides in the median of the steps from block to block.
    scatter = (
        np.median(np.abs(np.diff(means, axis=0)), axis=0) / 0.6745 / math.sqrt(2) / size if len(means) > 2 else 0.0
    )
    reach = np.maximum(CHANGED, CHANGED_SD * scatter * np.ones(len(size)))
    # Two blocks in a row say that it was another load; one is an accident.
    count = min(2, len(means))
    while count < len(means):
        older = means[count : count + 2].mean(axis=0)
        if (np.abs(older - means[:count].mean(axis=0)) / size > reach).any():
            break
        count += 1
    return count


def _held_by_duty(found: Fit, ohm: Array, rows: slice) -> Array:
    """(joints,) probability that a load keeps its duty rather than its current, by which of them drifts less.

    As a winding warms, one of the two must give way to its resistance.
    """
    run = found.inputs
    out = np.full(len(run.joints), 0.5)
    t = run.edges[1:][rows]
    for k, source in enumerate(run.source):
        if source in ("load", "unknown") or len(t) < 4:
            out[k] = 0.0 if source in ("load", "unknown") else 0.5
            continue
        push = run.push[rows, k]
        square = run.drive[rows, k] if source == "current" else push / ohm[rows, k] ** 2
        if not np.isfinite(push).all() or push.mean() <= 0 or square.mean() <= 0:
            continue
        drifts = [_drift(t, values / values.mean()) for values in (push, square)]
        # Either is told by the chance that its drift is none: by scatter, and by a percent for all the rest.
        unlikely = [-0.5 * (drift / math.hypot(error, 0.01)) ** 2 for drift, error in drifts]
        out[k] = 1.0 / (1.0 + math.exp(min(max(unlikely[1] - unlikely[0], -50.0), 50.0)))
    return out


def _drift(t: Array, values: Array) -> tuple[float, float]:
    """Relative change over the window by a straight line, and its standard error; neighbouring cells are alike."""
    x = (t - t.mean()) / max(float(t[-1] - t[0]), 1e-9)
    slope = float(x @ values / (x @ x))
    rest = values - values.mean() - slope * x
    return slope, float(math.sqrt(max(rest @ rest, 0.0) / max(len(t) - 2, 1) / float(x @ x)) * 2.0)


def torque_load(found: Fit, torque_nm: Mapping[str, float]) -> Workload:
    """Joints that hold a torque at standstill, the others at their present load.

    Raises:
        BadInput: no such joint, or one whose servo model is not known.
    """
    load = present_load(found)
    current, push, keeps = load.current.copy(), load.push.copy(), load.by_duty.copy()
    ohm = _resistance(found)[-1]
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
        # A torque asks for a current, whatever duty that takes as the winding warms.
        current[:, k] = (torque / model.kt_nm_a) ** 2
        push[:, k], keeps[k] = current[:, k] * ohm[k] ** 2, 0.0
    words = ", ".join(f"{exact(torque, 'N·m')} at {joint}" for joint, torque in torque_nm.items())
    named = np.array([joint in torque_nm for joint in found.inputs.joints])
    gear = np.where(named, 0.0, load.gear)
    return replace(load, current=current, push=push, by_duty=keeps, gear=gear, words=words)


def forecast(
    found: Fit, load: Workload | None = None, *, horizon_s: float = HORIZON_S, draws: int = DRAWS, seed: int = 0,
    from_cold: bool = False, torques: bool = True,
) -> HeatForecast:  # fmt: skip
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
    reached: NDArray[np.bool_] = np.asarray(beyond.any(axis=1))
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
    shown = (0.025, 0.25, 0.5, 0.75, 0.975)
    fan = dict(zip(shown, np.quantile(paths[:, ::every], shown, axis=0) - 0.5, strict=True))
    return HeatForecast(tuple(joints), load, t[::every], fan)


def _paths(
    found: Fit, variants: Variants, load: Workload, steps: int, seed: int, from_cold: bool
) -> tuple[Array, Array]:
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
    servos, current, push = _going_on(found, variants, load, random)
    # Each draw believes in blocks of its own, fewer than there are, since neighbours are alike.
    pool = random.integers(0, len(load.current), (b, max(1, len(load.current) // 2)))
    every = max(1, round(BLOCK_S / STEP_S))
    out = np.empty((b, steps, n))
    for i in range(steps):
        if i % every == 0:
            chosen = pool[np.arange(b), random.integers(0, pool.shape[1], b)]
            now = np.where(servos.by_duty, push * load.push[chosen], current * load.current[chosen])
        room = room + ROOM_K * math.sqrt(STEP_S / HOUR_S) * random.standard_normal((b, 1))
        state = advance(servos, state, STEP_S, now, load.gear, load.idle, room)
        offset = offset * fade + shake * random.standard_normal((b, n))
        out[:, i] = state.case + offset
    t: Array = STEP_S * np.arange(1, steps + 1, dtype=float)
    return t, out


def _going_on(
    found: Fit, variants: Variants, load: Workload, random: np.random.Generator
) -> tuple[ServoHeat, Array, Array]:
    """Servos in which each draw keeps duty or current, as the load is believed to do, and (b, joints) scales of both.

    One of the two was measured; the other follows with the resistance that a draw believes in.
    """
    servos, b = variants.servos, len(variants.state.case)
    ratio = (1 + COPPER_PER_K * (variants.state.winding - 25.0)) / (1 + COPPER_PER_K * (found.windings()[-1] - 25.0))
    unknown = np.array([source == "unknown" for source in found.inputs.source])
    keeps = (random.random(variants.state.case.shape) < load.by_duty) & ~unknown
    current = np.where(servos.by_duty, 1 / ratio**2, np.ones((b, 1)))
    current = np.where(unknown, variants.held, current)
    return replace(servos, by_duty=keeps), current, np.where(servos.by_duty, 1.0, ratio**2)


def _mean_drive(found: Fit, variants: Variants, load: Workload) -> tuple[ServoHeat, Array]:
    """Servos that keep their mean current, and (b, joints) that current squared; heat of unknown cause in W."""
    current = np.broadcast_to(load.current.mean(axis=0), variants.state.case.shape)
    unknown = np.array([source == "unknown" for source in found.inputs.source])
    return replace(variants.servos, by_duty=np.zeros(len(unknown), bool)), np.where(unknown, variants.held, current)


def settled(found: Fit, load: Workload, room_c: float, draws: int, seed: int = 0) -> Array:
    """(draws, joints) °C as read, where the cases come to rest under a mean load in a room of that temperature."""
    variants = found.variants(draws, seed)
    servos, drive = _mean_drive(found, variants, load)
    servos = replace(servos, room_c=np.full((draws, 1), room_c + 0.5))
    state = State(servos.room_c + 0.0 * drive, servos.room_c + 0.0 * drive)
    for _ in range(4 * SETTLING):
        state = advance(servos, state, SETTLING_S / 3, drive, load.gear, load.idle)
    return state.case - 0.5


def _torque(found: Fit, k: int, square: Array) -> Interval | None:
    """Squares of currents (A²) as N·m at standstill, by the data sheet's constant; None where loads were not recorded."""
    model = found.inputs.models[k]
    if model is None or found.inputs.source[k] == "unknown":
        return None
    return Interval.of(model.kt_nm_a * np.sqrt(np.maximum(square, 0.0)))


def _continuous(found: Fit, variants: Variants, load: Workload) -> Array:
    """(b, joints) A² that each joint could bear for ever, its neighbour at the load given."""
    run = found.inputs
    servos, drive = _mean_drive(found, variants, load)
    limit: Array = np.asarray(run.limit_c, float)
    others = np.empty_like(variants.state.case)
    for k, partner in enumerate(run.partner.tolist()):
        if partner < 0:
            continue
        # The neighbour settles beside a case at its limit.
        held = State(variants.state.winding.copy(), variants.state.case.copy())
        for _ in range(SETTLING):
            held.case[:, k] = float(limit[k])
            held = advance(servos, held, SETTLING_S, drive, load.gear, load.idle)
        others[:, partner] = held.case[:, partner]
    return steady_drive(servos, limit, load.idle, others)


#: steps, and s of each, in which a case comes to rest beside a neighbour held at a temperature
SETTLING, SETTLING_S = 12, 900.0


def _for_an_hour(found: Fit, variants: Variants, load: Workload) -> Array:
    """(b, joints) A² under which a cold servo comes to its limit in just an hour, its neighbour at the load given."""
    run, shape = found.inputs, variants.state.case.shape
    servos, present = _mean_drive(found, variants, load)
    limit = run.limit_c + 1.0
    out = np.zeros(shape)
    for kind in ("knee", "hip"):
        tried = np.array([joint.startswith("knee") == (kind == "knee") for joint in run.joints])
        low, high = np.zeros(shape), np.full(shape, MOST_A2)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            cold = np.broadcast_to(servos.room_c, shape).copy()
            state = State(cold, cold.copy())
            drive = np.where(tried, middle, present)
            for _ in range(int(HOUR_S / HOUR_STEP_S)):
                state = advance(servos, state, HOUR_STEP_S, drive, load.gear, load.idle)
            too_warm = state.case >= limit
            high, low = np.where(too_warm, middle, high), np.where(too_warm, low, middle)
        out = np.where(tried, (low + high) / 2, out)
    return out


#: A², more than any X430 draws; halvings; s of a step
MOST_A2, BISECTIONS, HOUR_STEP_S = 25.0, 14, 60.0


# ---- advice ----


@dataclass(frozen=True)
class RestPlan:
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
            return f"{self.joint} is not cool enough to work: let it rest {_minutes(self.rest_s)} first"
        return f"work {_minutes(self.work_s)}, rest {_minutes(self.rest_s)} with torque off ({self.joint} decides)"


def rest_advice(found: Fit, load: Workload | None = None, *, draws: int = 100, seed: int = 0) -> RestPlan:
    """Work until the earliest likely shutdown less a margin, rest until the decider has cooled.

    The times are for the cautious end of the interval: 19 of 20 robots believed in come through.
    """
    load = load or present_load(found)
    run = found.inputs
    told = forecast(found, load, draws=draws, seed=seed, from_cold=True, torques=False)
    due = [(one.seconds_to_limit.low, one.joint) for one in told.joints if one.seconds_to_limit is not None]
    if not due:
        return RestPlan(None, 0.0, 1.0, None)
    work, joint = min(due)
    work *= 0.9
    k = run.joints.index(joint)
    variants = found.variants(draws, seed)
    cold = np.broadcast_to(variants.servos.room_c, variants.state.case.shape).copy()
    state = State(cold, cold.copy())
    servos, drive = _mean_drive(found, variants, load)
    for _ in range(max(1, int(work / STEP_S))):
        state = advance(servos, state, STEP_S, drive, load.gear, load.idle)
    goal = float(run.limit_c[k]) - COOLED_K
    rest = 0.0
    while rest < HORIZON_S and np.quantile(state.case[:, k], 0.95) > goal:
        state = advance(servos, state, STEP_S, np.zeros_like(drive), np.zeros_like(load.gear), load.idle)
        rest += STEP_S
    # From warm the next work is shorter: until the decider is at its limit again.
    again = 0.0
    while again < work and np.quantile(state.case[:, k], 0.95) < run.limit_c[k]:
        state = advance(servos, state, STEP_S, drive, load.gear, load.idle)
        again += STEP_S
    return RestPlan(again, rest, again / max(again + rest, 1e-9), joint)


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
    found: Fit, load: Workload | None = None, *, told: HeatForecast | None = None, joints: Sequence[str] = ()
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
        asked = _torque(found, k, np.atleast_1d(load.current[:, k].mean()))
        if one.continuous_torque_nm is None or asked is None or asked.value <= 0:
            continue
        # The cautious end of what can be borne, with a tenth in hand, so that the servo cools at the hot end.
        least = DERATED_SHARE * one.continuous_torque_nm.low / asked.value
        stop = one.limit_c - DERATED_BELOW_K
        rules[one.joint] = DeratedJoint(stop - DERATED_OVER_K, stop, float(np.clip(least, 0.0, 1.0)))
    return Derating(rules)


# ---- all of it ----


@dataclass(frozen=True)
class Outlook:
    """What comes of a load.

    Attributes:
        found: what is known, and when of the run. from_cold: whether the load begins in the room's temperature.
        rules: under which it can go on. cooling: joint → s until it has cooled, of those that are to cool.
    """

    found: Fit
    told: HeatForecast
    rest: RestPlan
    rules: Derating
    cooling: Mapping[str, Interval]
    from_cold: bool

    @property
    def shuts_down(self) -> bool:
        """Whether a servo is more likely than not to."""
        return any(one.probability > 0.5 for one in self.told.joints)

    def as_json(self) -> dict[str, Any]:
        return {
            "schema": "openant.thermal-forecast/1", "run": self.found.inputs.name, "load": self.told.load.words,
            "at_s": self.found.inputs.duration_s, "horizon_s": HORIZON_S, "from_cold": self.from_cold,
            "joints": [one.as_json() for one in self.told.joints], "rest": vars(self.rest),
            "derating": self.rules.as_table(),
            "cool_down_s": {joint: interval.as_json() for joint, interval in self.cooling.items()},
        }  # fmt: skip


def outlook(
    run: Inputs, *, after: Known | None = None, at_s: float | None = None, torque_nm: Mapping[str, float] | None = None,
    whole: bool = False, from_cold: bool = False,
) -> Outlook:  # fmt: skip
    """Look ahead from the end of a run's load.

    Args:
        after: what earlier runs taught. at_s: know only so much of the run, s.
        torque_nm: joint → torque that it is to hold instead. whole: take the mean load of the whole run.
        from_cold: begin in the room's temperature.

    Raises:
        BadInput: the run is shorter; no such joint.
    """
    if at_s is not None and at_s > run.duration_s + 1:
        words = f"the run ends after {number(run.duration_s / 60, 'min', decimals=1)}"
        raise BadInput(words, where=run.name, remedy="give --at less")
    known = run if at_s is None else run.until(at_s)
    found = fit([known], after=after)
    found = found if at_s is not None else found.at(run.loaded_s)
    load = torque_load(found, torque_nm) if torque_nm else present_load(found, whole=whole)
    told = forecast(found, load, from_cold=from_cold)
    cooling = {one.joint: cool_down(found, one.joint) for one in told.joints}
    return Outlook(
        found, told, rest_advice(found, load), derating(found, load, told=told),
        {joint: interval for joint, interval in cooling.items() if interval.value > 0}, from_cold,
    )  # fmt: skip
