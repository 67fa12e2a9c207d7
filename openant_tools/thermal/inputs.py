"""What heat sees of a run: how hard each servo worked, on a coarse grid, and where its thermometer stepped.

A servo reports whole °C. Within such a step nothing is known, at its edge everything: where the reading passes from n to
n + 1 the sensor is at the edge between them. So the crossings are what is fitted, not the plateaus between.
Temperatures here are on the scale on which a reading n means n ≤ T < n + 1: whether a servo cuts off or rounds shifts
both its readings and its limit alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.recording.run import Run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.servo import SERVO_MODELS, ServoModel
from openant_tools.thermal.thermometer import clean

__all__ = ["ENTERED_SD_K", "Inputs", "Observed", "Source", "inputs_of"]

Array = NDArray[np.float64]
Source = Literal["current", "duty", "load", "unknown"]

#: s a cell of the grid, at least and at most, and how many cells a run has where both allow it
CELL_S, LONGEST_CELL_S, CELLS = 5.0, 30.0, 360
#: s over which readings are averaged before a crossing is looked for: a noisy one flutters at the edge
SMOOTH_S = 15.0
#: s between two readings beyond which no crossing is between them that could be placed
SPARSE_S = 30.0
#: s between two rows beyond which the recording paused, torque off
PAUSE_S = 10.0
#: standard deviation of a crossing's temperature (the smoothing's width), and of a reading alone: 1 °C / √12
CROSSING_SD_K, ENTERED_SD_K = 0.12, 0.29
#: rad between two samples of a log without loads that mean another pose, and so another heat
MOVED_RAD = 0.1
#: share of its largest drive from which on a servo works
WORKS = 0.1


@dataclass(frozen=True)
class Observed:
    """What one thermometer said, as points: (n,) s, °C and standard deviations."""

    t: Array
    temperature: Array
    sd: Array

    def until(self, t: float) -> Observed:
        """Only what was said by `t` (s)."""
        keep = self.t <= t
        return Observed(self.t[keep], self.temperature[keep], self.sd[keep])


@dataclass(frozen=True)
class Inputs:
    """A run on a grid of m cells.

    Attributes:
        name: of the run. joints, models: its servos; the model is None where nobody says.
        edges: (m + 1,) s from the run's first row.
        source: (joints,) where each servo's heat is known from.
        drive: (m, joints) means over the cell of I² (A²), or of (d·V − ke·ω)² (V²) where duty is the source.
        push: (m, joints) V², means of (d·V − ke·ω)² whatever the source, NaN where no duty was recorded.
        gear: (m, joints) W, means of |kt·I·ω|: what the motor gives to the gear. idle: (m, joints) W of the electronics.
        stretch: (m, joints) number of the pose held, for servos whose heat is unknown.
        observed: of each joint. readings: (m, joints) °C, means, NaN where none; for pictures.
        limit_c: (joints,) where each servo shuts down, as read from it, else the model's.
        glitches: (joints,) readings that were telemetry errors.
        ambient_c: of the room, where the run says so. heat_sinks: joints that have one.
    """

    name: str
    joints: tuple[str, ...]
    models: tuple[ServoModel | None, ...]
    edges: Array
    source: tuple[Source, ...]
    drive: Array
    push: Array
    gear: Array
    idle: Array
    stretch: NDArray[np.intp]
    observed: tuple[Observed, ...]
    readings: Array
    limit_c: Array
    glitches: NDArray[np.intp]
    ambient_c: float | None
    heat_sinks: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        return float(self.edges[-1])

    @property
    def partner(self) -> NDArray[np.intp]:
        """(joints,) the neighbour in the leg, −1 for none."""
        legs = [JOINTS[joint].leg.name if joint in JOINTS else joint for joint in self.joints]
        out = np.full(len(legs), -1, np.intp)
        for k, leg in enumerate(legs):
            others = [i for i, other in enumerate(legs) if other == leg and i != k]
            if len(others) == 1:
                out[k] = others[0]
        return out

    @property
    def loaded_s(self) -> float:
        """When the load ended, s: the end of the last cell in which a servo worked; of the run where loads are unknown."""
        most = self.drive.max(axis=0, initial=0.0)
        works = (self.drive > WORKS * most) & (most > 0)
        rows = np.flatnonzero(works.any(axis=1))
        return float(self.edges[rows[-1] + 1]) if len(rows) and "unknown" not in self.source else self.duration_s

    def until(self, t: float) -> Inputs:
        """What was known at `t` (s from the start)."""
        t = float(min(max(t, self.edges[1] / 2), self.edges[-1]))
        # The last cell ends there; its mean load is the whole cell's, some seconds.
        m = int(np.searchsorted(self.edges, t, side="left"))
        edges = np.append(self.edges[:m], t)
        return Inputs(
            self.name, self.joints, self.models, edges, self.source, self.drive[:m], self.push[:m],
            self.gear[:m], self.idle[:m], self.stretch[:m], tuple(one.until(t) for one in self.observed),
            self.readings[:m], self.limit_c, self.glitches, self.ambient_c, self.heat_sinks,
        )  # fmt: skip


def inputs_of(run: Run) -> Inputs:
    """The inputs of a run that has temperatures.

    Raises:
        BadInput: it has none, or is too short.
    """
    if not run.has("temp"):
        raise BadInput(
            "the run has no temperatures",
            where=run.path or run.name,
            remedy="record one with `openant thermal soak`, or give the table columns temp.J in °C",
        )
    joints = tuple(joint for joint in run.joints if run.has("temp", [joint]))
    t = run.t - run.t[0]
    if len(t) < 2 or t[-1] < 2 * CELL_S:
        raise BadInput("the run is too short to see heat", where=run.path or run.name, remedy="record some minutes")
    cell = float(np.clip(t[-1] / CELLS, CELL_S, LONGEST_CELL_S))
    m = max(2, int(np.ceil(t[-1] / cell)))
    edges = np.linspace(0.0, float(t[-1]), m + 1)
    place = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, m - 1)
    models = tuple(SERVO_MODELS.get(run.facts.motors.get(joint, "")) for joint in joints)
    shape = (m, len(joints))
    drive, gear, idle = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    readings, push, stretch = np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, np.intp)
    source, observed, glitches = list[Source](), list[Observed](), np.zeros(len(joints), np.intp)
    limits = np.zeros(len(joints))
    for k, (joint, model) in enumerate(zip(joints, models, strict=True)):
        cleaned = clean(t, run.column(f"temp.{joint}"))
        glitches[k] = len(cleaned.glitches)
        readings[:, k] = _mean(place, cleaned.values, m, fill=False)
        observed.append(_observed(t, cleaned.values))
        kind, square, power = _effort(run, joint, model)
        source.append(kind)
        if kind == "unknown":
            stretch[:, k] = _stretches(run, joint, t, edges)
        else:
            awake = _awake(t, m, edges)
            drive[:, k] = _mean(place, square, m) * awake
            gear[:, k] = _mean(place, power, m) * awake
            if model is not None and run.has("pwm", [joint]):
                push[:, k] = _mean(place, _push(run, joint, model), m) * awake
        volts = run.column(f"volt.{joint}")
        supply = run.facts.supply_v or (model.nominal_voltage_v if model else 12.0)
        idle[:, k] = (model.standby_current_a if model else 0.045) * _mean(place, volts, m, start=supply)
        limits[k] = _limit(run, joint, model)
    soak = run.facts.extra.get("soak")
    sinks = tuple(soak.get("heat_sinks", ())) if isinstance(soak, dict) else ()
    sinks = sinks or tuple(str(joint) for joint in run.facts.extra.get("heat_sinks", ()))
    return Inputs(
        run.name, joints, models, edges, tuple(source), drive, push, gear, idle, stretch, tuple(observed), readings, limits,
        glitches, run.facts.ambient_c, sinks,
    )  # fmt: skip


def _limit(run: Run, joint: str, model: ServoModel | None) -> float:
    """°C from the register as it was read, else the model's."""
    registers = run.facts.registers.get(joint, {})
    if "temperature_limit" in registers:
        return float(registers["temperature_limit"])
    return model.temperature_limit_c if model else 80.0


def _effort(run: Run, joint: str, model: ServoModel | None) -> tuple[Source, Array, Array]:
    """Where the heat is known from, its square (A² or V²), and W given to the gear, (n,) each."""
    nothing = np.zeros(len(run.t))
    if model is None:
        return "unknown", nothing, nothing
    velocity = np.nan_to_num(run.column(f"vel.{joint}"))
    if run.has("cur", [joint]):
        current = run.column(f"cur.{joint}")
        return "current", current**2, np.abs(model.kt_nm_a * current * velocity)
    if run.has("pwm", [joint]):
        push = _push(run, joint, model)
        return "duty", push, np.abs(model.kt_nm_a * np.sqrt(push) / model.resistance_ohm * velocity)
    if run.has("load", [joint]):
        current = run.column(f"load.{joint}") * model.stall_current_a
        return "load", current**2, np.abs(model.kt_nm_a * current * velocity)
    return "unknown", nothing, nothing


def _push(run: Run, joint: str, model: ServoModel) -> Array:
    """(n,) V², what the bridge puts over the winding's resistance, squared. With torque off the bridge is open."""
    volts = run.column(f"volt.{joint}")
    volts = np.where(np.isfinite(volts), volts, run.facts.supply_v or model.nominal_voltage_v)
    back = model.ke_v_s_rad * np.nan_to_num(run.column(f"vel.{joint}"))
    on = np.nan_to_num(run.signal("torque", [joint], default=1.0)[:, 0], nan=1.0)
    return np.asarray(((run.column(f"pwm.{joint}") * volts - back) * on) ** 2)


def _mean(place: NDArray[np.intp], values: Array, m: int, *, fill: bool = True, start: float = 0.0) -> Array:
    """(m,) means of the rows in each cell; a cell without any repeats the one before, or is NaN."""
    good = np.isfinite(values)
    count = np.bincount(place[good], minlength=m)
    total = np.bincount(place[good], weights=values[good], minlength=m)
    out = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    if not fill:
        return out
    last = np.maximum.accumulate(np.where(np.isfinite(out), np.arange(m), -1))
    return np.where(last >= 0, out[np.maximum(last, 0)], start)


def _awake(t: Array, m: int, edges: Array) -> Array:
    """(m,) share of each cell that lies in no pause of the recording: torque was off in one."""
    paused = np.zeros(m)
    gaps = np.flatnonzero(np.diff(t) > max(PAUSE_S, 5 * float(np.median(np.diff(t)))))
    for row in gaps:
        low, high = t[row], t[row + 1]
        paused += np.clip(np.minimum(edges[1:], high) - np.maximum(edges[:-1], low), 0.0, None)
    return 1.0 - paused / np.diff(edges)


def _stretches(run: Run, joint: str, t: Array, edges: Array) -> NDArray[np.intp]:
    """(m,) number of the pose that was held; where it changed between two samples, the middle is taken."""
    angle = run.column(f"pos.{joint}")
    good = np.isfinite(angle)
    if not good.any():
        return np.zeros(len(edges) - 1, np.intp)
    angle, when = angle[good], t[good]
    changes = np.flatnonzero(np.abs(np.diff(angle)) > MOVED_RAD)
    middles = (when[changes] + when[changes + 1]) / 2
    return np.searchsorted(middles, (edges[1:] + edges[:-1]) / 2).astype(np.intp)


def _observed(t: Array, values: Array) -> Observed:
    """Crossings where readings are dense, single readings where they are sparse or stand still."""
    rows = np.isfinite(values)
    t, values = t[rows], values[rows]
    if len(t) == 0:
        return Observed(np.zeros(0), np.zeros(0), np.zeros(0))
    if len(t) < 3 or float(np.median(np.diff(t))) > SPARSE_S:
        return Observed(t, np.floor(values) + 0.5, np.full(len(t), ENTERED_SD_K))
    when, mean = _smooth(t, values)
    points: list[tuple[float, float, float]] = [(float(when[0]), float(mean[0]) + 0.5, ENTERED_SD_K)]
    level = float(np.round(mean[0]))
    last = float(when[0])
    for (before, was), (after, now) in zip(
        zip(when[:-1].tolist(), mean[:-1].tolist(), strict=True),
        zip(when[1:].tolist(), mean[1:].tolist(), strict=True), strict=True,
    ):  # fmt: skip
        gap = after - before > SPARSE_S
        while now > level + 0.5 or now < level - 0.5:
            up = now > level
            edge = level + (0.5 if up else -0.5)
            share = (edge - was) / (now - was) if now != was else 1.0
            at = before + min(max(share, 0.0), 1.0) * (after - before)
            if not gap:
                points.append((at, edge + 0.5, CROSSING_SD_K))
                last = at
            level += 1.0 if up else -1.0
        if gap or after - last > STANDS_S:
            points.append((after, float(now) + 0.5, ENTERED_SD_K))
            last = after
    if when[-1] - last > SMOOTH_S:
        points.append((float(when[-1]), float(mean[-1]) + 0.5, ENTERED_SD_K))
    made = np.array(points)
    return Observed(made[:, 0], made[:, 1], made[:, 2])


#: s without a crossing after which the plateau itself is a point
STANDS_S = 240.0


def _smooth(t: Array, values: Array) -> tuple[Array, Array]:
    """Means over `SMOOTH_S`, at the mean times of their rows."""
    place = ((t - t[0]) / SMOOTH_S).astype(int)
    count = np.bincount(place)
    full = count > 0
    mean = np.bincount(place, weights=values)[full] / count[full]
    when = np.bincount(place, weights=t)[full] / count[full]
    return when, mean
