"""Rollouts of many models over many recorded runs: the one engine behind identification, the gap and its diagnosis.

Contract

* **What is simulated.** Each run is cut into *segments*. A segment starts at a row in which every joint was measured,
  with the measured positions and the velocities that fit the neighbouring positions, and is simulated with the run's
  own commands until the next one starts: every `horizon` seconds, or once for the whole run (`horizon=None`). With
  `windows` each of these is a segment, from its first complete row on, and what lies outside them is not simulated.
* **Time.** Rows may come at any strictly increasing times. A segment steps from its first row's time on the model's own
  time step; positions between two steps are interpolated linearly. A command acts from its own time on (`cmd_t`, else
  the row's `t`), held until the next; each step sees its mean over the step, so that results vary smoothly with delays
  and time stamps instead of by whole steps. (A servo that limits its setpoint's rate takes the command of the middle of
  each step: to a limiter a part of a change is as good as the whole.) A missing command leaves the one before in force.
* **Late encoders.** Where sensors `pos.J` of the model have a delay, simulated joints are compared with what they say: rows hold
  states of so much earlier, and commands act as much later in their time.
* **Start of a segment.** Setpoint filters and slew limiters hold the first command; delay buffers hold the commands before it,
  of which there are none at the start of a run, so that there they hold the first; all other activations are zero (formats,
  section 5). A base whose pose was measured at most POSES_S before and after is between the two. Without a measured
  base, a robot on the floor starts a run settled on its
  feet; a later segment starts where the base has come to and as fast as it moves when the joints are led along their
  measured positions from there. (Started at rest amid a gait, it would first have to catch up with its own feet.)
  A window's base is led from a settled stand LEAD_S before, however well it was measured: a degree of a tracker's or an
  IMU's error puts feet through the floor or above it. A tracker says where it is and heads. At the beginning of a run, or
  after a pause in its rows, nothing leads there, and it starts as a run does.
* **Torque off** (`torque.J` = 0) disables that joint's actuator from its row to the next; what stands in the joint
  stays.
* **Gaps.** A row with a missing sample is simulated all the same; what to compare is the caller's choice. Rows before
  the first complete one, of the run or of each window, are NaN, and so are those outside windows.
* **Many models.** A call rolls out V variants of the model in one batch on all cores. They must share the layout of the
  plant's model (same compiled sizes); parameters may differ freely. Results do not depend on the number of threads.
* **Nothing idle is computed.** Sensors are off (positions and velocities are read from the state), and so are contacts on the
  stand where, at the measured poses, no two parts of the robot come within CLEARANCE_M of each other; without contacts
  constraints are solved as one island, which is equal within the solver's tolerance.
* **Memory** is bounded: states are sampled at the rows in chunks and never kept for a whole run.
"""

from __future__ import annotations

import copy
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, Setup, position_servos
from openant_tools.numbers import literal
from openant_tools.recording.run import Run

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

__all__ = ["Measured", "Rollouts", "RunStretch", "Staircase", "Trajectories", "initial_velocities"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: rows are compared, and segments started, on positions; the slope over this span (s) on both sides gives the velocity
VELOCITY_SPAN_S = 0.02
#: parts that stay farther apart than this (m) in the measured motion do not touch in a simulation of it
CLEARANCE_M = 0.01
#: states kept at a time while a batch runs
CHUNK_BYTES = 16 * 2**20
#: where an actuator of this kind keeps the rate limit of its setpoint (`slewmax`) in dynprm, MuJoCo 4
SLEW_RATE = {int(mujoco.mjtDyn.mjDYN_PID): 1, int(mujoco.mjtDyn.mjDYN_DCMOTOR): 7}
#: MuJoCo's warnings of a simulation that falls apart
FALLS_APART = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]
#: how long a robot without a measured base is left to settle on its feet before a floor run
SETTLE_S = 1.0
#: cosine of how far from its attitude at the start a base may lean that is led along
FALLEN = 0.5
#: s for which a base is led along before a window, and s between rows across which it is not
LEAD_S, ROWS_S = 0.5, 0.1
#: s between two poses of a base that tell where it was between them
POSES_S = 0.1
#: columns of a base's pose; rows about one in whose motion it is led to that row
POSE, AROUND = ("x", "y", "z", "qw", "qx", "qy", "qz", "yaw"), 20


@dataclass(frozen=True)
class Trajectories:
    """Simulated positions and velocities at the rows of all runs, one after another.

    Attributes:
        pos: (variants, rows, joints) rad.
        vel: (variants, rows, joints) rad/s.
        rows: for each run, the slice of its rows.
    """

    pos: Array
    vel: Array
    rows: tuple[slice, ...]


@dataclass(frozen=True)
class RunStretch:
    """A stretch of one run, ready to be stepped."""

    run: int
    first: int  # row of the run
    state: Array  # (nstate,) integration state at its start
    control: Array  # (steps, nu)
    step: Ints  # (rows,) step before each row
    fraction: Array  # (rows,) of the step after it
    row: Ints  # (rows,) index among the rows of all runs
    torque_off: dict[float, Bools]  # s after its start → joints off from then on; first at -inf, those before it
    start: float  # s, time of its first row
    commands: Staircase

    def switches(self, h: float) -> dict[int, Bools]:
        """Step, of those of h (s), → joints off from there on."""
        last = len(self.control) - 1
        return {round(min(max(after / h, 0.0), last)): off for after, off in self.torque_off.items()}


def allowed_threads() -> int:
    """How many threads a process may have by OMP_NUM_THREADS; 0 where it says nothing.

    Joblib sets it where it runs processes side by side: threads of all would wait for each other.
    """
    allowed = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(allowed) if allowed.isdecimal() else 0


class Rollouts:
    """Runs prepared for one plant: called with variants of its model, returns what each would have done.

    Args:
        plant: the model, set up as the runs were made.
        runs: recorded runs that command every joint of the plant.
        horizon: seconds between re-initialisations from measurement; None simulates each run from its start.
        nthread: threads; 0 takes as many as the environment variable OMP_NUM_THREADS allows, else all cores.
        leader: a variant of the plant's model by which a base that nobody measured is led along; default that model.
        windows: of each run, from and up to (s of its `t`), in order: what alone is simulated, in place of `horizon`.

    Attributes:
        horizon: s; of windows, the longest. None: simulations begin where runs do.

    Raises:
        BadInput: a run has no row in which all joints were measured, or no commands.
        ValueError: windows overlap, or none has two rows from a complete one on.
    """

    def __init__(
        self, plant: Plant, runs: Sequence[Run], horizon: float | None = None, nthread: int = 0,
        leader: mujoco.MjModel | None = None, windows: Sequence[Sequence[tuple[float, float]]] | None = None,
    ) -> None:  # fmt: skip
        self.runs = tuple(runs)
        if windows is not None:
            horizon = max((stop - start for own in windows for start, stop in own), default=0.0)
        self.horizon = horizon
        self._nthread = nthread
        ends = np.cumsum([0, *(len(run.t) for run in runs)])
        self.rows = tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(ends))
        leads = plant if leader is None else replace(plant, model=leader)
        segments = [
            segment
            for k, run in enumerate(runs)
            for segment in _segments(
                plant, leads, run, k, self.rows[k].start, horizon, None if windows is None else windows[k]
            )
        ]
        if not segments:
            raise ValueError("no window has two rows to simulate")
        # The longest first, so that those still running are always the first simulations of the batch.
        self._segments = sorted(segments, key=lambda segment: -len(segment.control))
        self._batches: dict[int, Batch] = {}
        self._finer: dict[int, Rollouts] = {}
        self._disable = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        if plant.setup is Setup.STAND and not any(_comes_close(plant, run) for run in runs):
            # Without contacts a few joints' dry friction is solved sooner than it is sorted into islands.
            self._disable |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        #: whoever makes variants of this one's model saves a copy of each
        self.plant = replace(plant, model=self.lean(plant.model))

    @property
    def nthread(self) -> int:
        """Threads that it may take in this process; 0 for all cores."""
        return self._nthread or allowed_threads()

    def finer(self, parts: int) -> Rollouts:
        """The same with each step cut into so many; as it is where actuators have delay buffers, whose samples count steps."""
        if parts == 1 or (self.plant.model.actuator_history[:, 0] > 0).any():
            return self
        if parts not in self._finer:
            fine = copy.copy(self)
            fine.plant, fine._batches, fine._finer = self.plant.stepped(self.plant.timestep / parts), {}, {}
            # Rows lie between steps: what was as long as another may now be a step shorter.
            cut = (self._cut(segment, parts) for segment in self._segments)
            fine._segments = sorted(cut, key=lambda segment: -len(segment.control))
            self._finer[parts] = fine
        return self._finer[parts]

    def _cut(self, segment: RunStretch, parts: int) -> RunStretch:
        at = (segment.step + segment.fraction) * parts
        step = np.floor(at + 1e-9).astype(np.int64)
        control = np.repeat(segment.control, parts, axis=0)[: int(step[-1]) + 1]
        edges = segment.start + self.plant.timestep / parts * np.arange(len(control) + 1, dtype=np.float64)
        control[:, self.plant.ctrl] = _setpoints(self.plant, segment.commands, edges)
        return replace(segment, control=control, step=step, fraction=np.clip(at - step, 0.0, 1.0))

    @property
    def steps(self) -> int:
        """Simulation steps of one variant."""
        return sum(len(segment.control) for segment in self._segments)

    def __call__(self, models: Sequence[mujoco.MjModel] | None = None, delays: Array | None = None) -> Trajectories:
        """Roll out every run on each of `models` (default: the plant's own).

        Args:
            models: the variants.
            delays: (variants, joints) s by which each joint's commands act later than they were sent, on top of what the
                model's own actuators delay. Continuous, where MuJoCo's buffers know nothing between none and one step.
        """
        nv, total, nj = len(models or [self.plant.model]), self.rows[-1].stop, len(self.plant.joints)
        pos, vel = np.full((nv, total, nj), np.nan), np.full((nv, total, nj), np.nan)
        for rows, there, speed in self.stream(models, delays):
            pos[:, rows], vel[:, rows] = there, speed
        return Trajectories(pos, vel, self.rows)

    def stream(
        self, models: Sequence[mujoco.MjModel] | None = None, delays: Array | None = None
    ) -> Iterator[tuple[slice, Array, Array]]:
        """The same, piece by piece, for those who reduce the pieces at once: memory does not follow the runs' length.

        Yields:
            a slice of consecutive rows among those of all runs, and (variants, rows, joints) positions and velocities
            there. Each row comes once, in no promised order; rows before the first complete one of a run never.
        """
        variants = [self.lean(model) for model in (models or [self.plant.model])]
        segments, nv = self._segments, len(variants)
        plant = self.plant
        batch = self._batch(nv)
        batch.state[:] = np.repeat([segment.state for segment in segments], nv, axis=0)
        lengths = np.array([len(segment.control) for segment in segments])
        nj = len(plant.joints)

        batch.set_models([model for _ in segments for model in variants])
        switches = [segment.switches(plant.timestep) for segment in segments]
        changes = set().union(*switches)
        limp = {(v, _key(np.zeros(nj, bool))): model for v, model in enumerate(variants)}
        off = [one[0] for one in switches]
        last = [(segment.state[self._qpos], segment.state[self._qvel]) for segment in segments]
        last_pos = np.array([p for p, _ in last])[:, None, :].repeat(nv, axis=1)
        last_vel = np.array([v for _, v in last])[:, None, :].repeat(nv, axis=1)

        per_step = nv * len(segments) * 8 * (plant.model.nq + plant.model.nv)
        chunk = max(16, CHUNK_BYTES // per_step)
        edges = sorted({0, *changes, *lengths.tolist(), *range(0, int(lengths[0]), chunk)})
        for begin, end in itertools.pairwise(edges):
            active = int((lengths > begin).sum())
            if begin in changes:
                for s in range(active):
                    off[s] = switches[s].get(begin, off[s])
                batch.set_models(
                    [self._limp(limp, variants[v], v, off[s]) for s in range(len(segments)) for v in range(nv)]
                )
            control = np.repeat([segment.control[begin:end] for segment in segments[:active]], nv, axis=0)
            if delays is not None:
                self.delay(control.reshape(active, nv, end - begin, -1), delays, begin)
            record = batch.rollout(
                end - begin, control, record=("qpos", "qvel"), ids=np.arange(active * nv, dtype=np.int32)
            )
            shape = (active, nv, end - begin, -1)
            qpos = record["qpos"].reshape(shape)[..., plant.qpos]
            qvel = record["qvel"].reshape(shape)[..., plant.dof]
            qpos = np.concatenate([last_pos[:active, :, None], qpos], axis=2)
            qvel = np.concatenate([last_vel[:active, :, None], qvel], axis=2)
            for s in range(active):
                segment = segments[s]
                first, stop = np.searchsorted(segment.step, [begin, end])
                if first == stop:
                    continue
                k, f = segment.step[first:stop] - begin, segment.fraction[first:stop][:, None]
                rows = slice(int(segment.row[first]), int(segment.row[first] + stop - first))
                pos = qpos[s][:, k] * (1 - f) + qpos[s][:, k + 1] * f
                vel = qvel[s][:, k] * (1 - f) + qvel[s][:, k + 1] * f
                yield rows, pos, vel
            last_pos[:active], last_vel[:active] = qpos[:, :, -1], qvel[:, :, -1]

    def delay(self, control: Array, delays: Array, begin: int) -> None:
        """Shift the commands in `control` (segments, variants, steps, nu), which starts at step `begin`, in place."""
        h = self.plant.timestep
        for j in range(len(self.plant.joints)):
            for delay in np.unique(delays[:, j][delays[:, j] != 0]):
                late = np.flatnonzero(delays[:, j] == delay)
                for s, segment in enumerate(self._segments[: len(control)]):
                    edges = segment.start + h * np.arange(begin, begin + control.shape[2] + 1) - delay
                    control[s, late, :, self.plant.ctrl[j]] = segment.commands.column(j).mean(edges)[:, 0]

    @cached_property
    def measured(self) -> tuple[Measured, ...]:
        """Of each run, how its joints moved."""
        return tuple(Measured.of(run.t, run.signal("pos", self.plant.joints)) for run in self.runs)

    @property
    def segments(self) -> Sequence[RunStretch]:
        """What is stepped, the longest first."""
        return self._segments

    @property
    def unstable(self) -> bool:
        """Whether a simulation so far met numbers that are none, or none of this world: MuJoCo began that one anew."""
        return any(batch.warning[:, FALLS_APART, 1].any() for batch in self._batches.values())

    def lean(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """A variant that computes nothing that nobody reads: a copy, unless it is so already."""
        if model.opt.disableflags & self._disable == self._disable:
            return model
        lean = copy.copy(model)
        lean.opt.disableflags |= self._disable
        return lean

    @property
    def _qpos(self) -> Ints:
        return 1 + self.plant.qpos  # the integration state starts with the time

    @property
    def _qvel(self) -> Ints:
        return self.plant.dof + (1 + int(self.plant.model.nq))

    def _batch(self, nv: int) -> Batch:
        if nv not in self._batches:
            self._batches[nv] = Batch(self.plant.model, nv * len(self._segments), self.nthread)
        return self._batches[nv]

    def _limp(
        self, cache: dict[tuple[int, bytes], mujoco.MjModel], model: mujoco.MjModel, variant: int, off: Bools
    ) -> mujoco.MjModel:
        key = (variant, _key(off))
        if key not in cache:
            cache[key] = self.plant.with_torque_off(model, off)
        return cache[key]


def _key(off: Bools) -> bytes:
    return off.tobytes()


def initial_velocities(t: Array, pos: Array, row: int) -> Array:
    """Joint velocities at a row, (joints,) rad/s, from the slope of the positions around it.

    A servo's velocity register is coarse and late; the positions on both sides are neither. Least squares over the
    rows within VELOCITY_SPAN_S (at least one neighbour on each side where there is one). Where one side has fewer, as at
    the start of a run, the slope of a line would be that of another moment: there it is a parabola's, over twice the span.
    0 where nothing is known.
    """
    out = np.zeros(pos.shape[1])
    for j in range(pos.shape[1]):
        rows = _measured_around(t, pos[:, j], row, VELOCITY_SPAN_S, 1)
        degree = 1
        if len(rows) and abs(t[rows].mean() - t[row]) > VELOCITY_SPAN_S / 4:
            wider = _measured_around(t, pos[:, j], row, 2 * VELOCITY_SPAN_S, 2)
            if len(wider) > 2:
                rows, degree = wider, 2
        if len(rows) > degree:
            dt = t[rows] - t[row]
            powers = dt[:, None] ** np.arange(degree + 1)
            out[j] = np.linalg.lstsq(powers, pos[rows, j], rcond=None)[0][1]
    return out


def _measured_around(t: Array, pos: Array, row: int, span: float, neighbours: int) -> Ints:
    """The rows with a sample within `span` (s) of a row, and at least that many neighbours on each side if measured."""
    first = min(int(np.searchsorted(t, t[row] - span)), max(0, row - neighbours))
    stop = max(int(np.searchsorted(t, t[row] + span, side="right")), row + neighbours + 1)
    rows: Ints = first + np.flatnonzero(np.isfinite(pos[first:stop]))
    return rows


def _segments(
    plant: Plant, leads: Plant, run: Run, index: int, offset: int, horizon: float | None,
    windows: Sequence[tuple[float, float]] | None,
) -> list[RunStretch]:  # fmt: skip
    t, pos = run.t, run.signal("pos", plant.joints)
    cmd = _held(run.signal("cmd", plant.joints))
    if cmd is None:
        raise BadInput("some joint was never commanded", where=run.path or run.name, remedy="drop it with --joint")
    whole = np.flatnonzero(np.isfinite(pos).all(axis=1))
    if len(whole) < 2:
        raise BadInput(
            "no two rows have a position of every joint",
            where=run.path or run.name,
            remedy="check the pos.* columns, or choose fewer joints with --joint",
        )
    parts = _parts(t, whole, horizon) if windows is None else _parts_of(t, whole, windows)
    h, model = plant.timestep, plant.model
    torque_off = run.signal("torque", plant.joints, default=1.0) == 0
    flips = 1 + np.flatnonzero((torque_off[1:] != torque_off[:-1]).any(axis=1))
    # Rows say what was; to what they say commands come as much later.
    commands = Staircase.of(run.command_times + plant.encoder_delay_s, cmd)
    rest = _at_rest(model)
    buffered = int(model.actuator_history[plant.actuator, 0].max(initial=0))
    bases: list[tuple[Array, Array] | None]
    if windows is None:
        poses: Array = np.stack([run.column(f"base.{axis}") for axis in POSE[:7]], axis=1)
        measured: Bools = np.logical_and.reduce(np.isfinite(poses), axis=1)
        led = _led(leads, run, [first for first, _ in parts], pos, commands)
        bases = [base if n and not measured[parts[n][0]] else None for n, base in enumerate(led)]
    else:
        bases = [_led_in(leads, run, whole, first, pos, commands) for first, _ in parts]
    segments = []
    for (first, stop), base in zip(parts, bases, strict=True):
        rows = np.arange(first, stop)
        at = (t[rows] - t[first]) / h
        step = np.floor(at + 1e-9).astype(np.int64)
        nstep = int(step[-1]) + 1
        edges = t[first] + h * np.arange(nstep + 1)
        setpoint = _setpoints(plant, commands, edges)
        control = np.tile(rest, (nstep, 1))
        control[:, plant.ctrl] = setpoint
        off = {-np.inf: torque_off[max(first - 1, 0)]}
        for row in flips[(flips >= first) & (flips < stop)]:
            off[float(t[row] - t[first])] = torque_off[row]
        velocity = initial_velocities(t, pos, first)
        segments.append(
            RunStretch(
                run=index,
                first=first,
                state=_initial_state(
                    leads,
                    run,
                    first,
                    pos[first],
                    velocity,
                    setpoint[0],
                    base,
                    _setpoints(plant, commands, t[first] + h * np.arange(-buffered, 1.0)) if buffered else None,
                ),
                control=control,
                step=step,
                fraction=np.clip(at - step, 0.0, 1.0),
                row=offset + rows,
                torque_off=off,
                start=float(t[first]),
                commands=commands,
            )
        )
    return segments


def _parts(t: Array, whole: Ints, horizon: float | None) -> list[tuple[int, int]]:
    """First row and first row beyond of each segment of a run; the row at which the next one starts belongs to that one."""
    starts = [int(whole[0])]
    if horizon is not None:
        for row in whole[1:]:
            if t[row] - t[starts[-1]] >= horizon - 1e-9 and row < len(t) - 1:
                starts.append(int(row))
    return list(itertools.pairwise([*starts, len(t)]))


def _parts_of(t: Array, whole: Ints, windows: Sequence[tuple[float, float]]) -> list[tuple[int, int]]:
    """The same of each window that has two rows from a complete one on."""
    parts = []
    end = -np.inf
    for start, stop in windows:
        if start < end or stop <= start:
            raise ValueError(
                f"the window from {literal(start)} to {literal(stop)} s ends before it begins, or overlaps the one before"
            )
        first, beyond = np.searchsorted(t, [start, stop]).tolist()
        complete = whole[(whole >= first) & (whole < beyond - 1)]
        if len(complete):
            parts.append((int(complete[0]), beyond))
        end = stop
    return parts


def _led_in(
    plant: Plant, run: Run, whole: Ints, row: int, pos: Array, commands: Staircase
) -> tuple[Array, Array] | None:
    """Pose and velocity of a free base at a complete row, led there from a settled stand that heads as it was tracked.

    How it leans and moves the joints on the floor say better than a tracker or an IMU does.
    """
    before = _lead_row(run.t, whole, row)
    if before == row or plant.free_joint is None:
        return None
    yaw = _pose(run, before)[0][7]
    facts = replace(run.facts, heading_rad=float(yaw)) if np.isfinite(yaw) else run.facts
    near = slice(max(0, before - AROUND), row + AROUND + 1)
    # Of what a tracker says no more than the heading: its own errors would have to settle first.
    bare = replace(run, facts=facts, t=run.t[near], columns={})
    led = _led(plant, bare, [before - near.start, row - near.start], pos[near], commands)[1]
    heads = _pose(run, row)[0][7]
    if led is None or not np.isfinite(heads):
        return led
    # Feet that slipped otherwise on the way turned it otherwise; on a floor every heading is as good.
    pose, velocity = led
    turn = float(heads) - 2 * float(np.arctan2(pose[6], pose[3]))
    c, s = np.cos(turn), np.sin(turn)
    pose[3:] = _turned(pose[3:], turn)
    velocity[:2] = c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1]
    return pose, velocity


def _lead_row(t: Array, whole: Ints, row: int) -> int:
    """The complete row from which a base is led to a row: LEAD_S before, or as far back as rows go on."""
    apart = np.flatnonzero(np.diff(t[: row + 1]) > ROWS_S)
    earliest = max(float(t[apart[-1] + 1]) if len(apart) else -np.inf, float(t[row]) - LEAD_S)
    return int(whole[np.searchsorted(t[whole], earliest)])


def _setpoints(plant: Plant, commands: Staircase, edges: Array) -> Array:
    """(steps, joints) rad: what each step between two edges (s) commands, see the contract."""
    setpoint = commands.mean(edges)
    slewing = np.array([_limits_slew(plant.model, int(i)) for i in plant.actuator])
    if slewing.any():
        setpoint[:, slewing] = commands.at((edges[:-1] + edges[1:]) / 2)[:, slewing]
    return setpoint


def _comes_close(plant: Plant, run: Run) -> bool:
    """Whether, in the measured poses of a run, any two parts that may touch come within CLEARANCE_M of each other."""
    model = copy.copy(plant.model)
    model.geom_margin[:] += CLEARANCE_M
    data = mujoco.MjData(model)
    pos = run.signal("pos", plant.joints)
    pos = pos[np.isfinite(pos).all(axis=1)]
    # Neighbouring rows are alike: at most a few hundred poses of a run are looked at.
    for row in pos[:: max(1, len(pos) // 500)]:
        data.qpos[plant.qpos] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon:
            return True
    return False


def _at_rest(model: mujoco.MjModel) -> Array:
    """(nu,) controls with which joints that are not played stay where the model puts them."""
    control = np.zeros(model.nu)
    for joint, actuator in position_servos(model).items():
        control[model.actuator_ctrladr[actuator]] = model.qpos0[model.joint(joint).qposadr[0]]
    return control


def _held(cmd: Array) -> Array | None:
    """Commands with every missing one replaced by the one before it; None where a joint has none at all."""
    out = cmd.copy()
    for j in range(cmd.shape[1]):
        given = np.flatnonzero(np.isfinite(cmd[:, j]))
        if not len(given):
            return None
        source = np.searchsorted(given, np.arange(len(cmd)), side="right") - 1
        out[:, j] = cmd[given[np.maximum(source, 0)], j]
    return out


@dataclass(frozen=True)
class Staircase:
    """Commands in force: `values[k]` from `times[k]` until the next, before the first time the first value.

    Attributes:
        times: (n,) s, in order; where several are the same, the last one counts.
        values: (n, columns).
    """

    times: Array
    values: Array

    @classmethod
    def of(cls, times: Array, values: Array) -> Staircase:
        order = np.argsort(times, kind="stable")
        return cls(times[order], values[order])

    def column(self, k: int) -> Staircase:
        return Staircase(self.times, self.values[:, k : k + 1])

    def _index(self, times: Array) -> Ints:
        return np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)

    def at(self, times: Array) -> Array:
        """The values in force at `times`, (times, columns)."""
        return self.values[self._index(times)]

    def mean(self, edges: Array) -> Array:
        """The mean over each interval between two edges, (intervals, columns)."""
        first, last = self._index(edges[[0, -1]])
        # Only the steps between the edges, and time from the first edge: sums stay short and exact.
        levels = self.values[first : last + 1]
        start = edges[0]
        knots = np.clip(np.append(self.times[first + 1 : last + 1], edges[-1]) - start, 0.0, None)
        knots = np.concatenate([[0.0], knots])
        area = np.concatenate([np.zeros((1, levels.shape[1])), np.cumsum(levels * np.diff(knots)[:, None], axis=0)])
        at = np.stack([np.interp(edges - start, knots, column) for column in area.T], axis=1)
        mean: Array = np.diff(at, axis=0) / np.diff(edges)[:, None]
        return mean


def _led(
    plant: Plant, run: Run, rows: Sequence[int], pos: Array, commands: Staircase
) -> list[tuple[Array, Array] | None]:
    """Pose (7,) and velocity (6,) of a free base at rows, the joints led along their measured positions (rows, joints).

    None where there is no free base, and where it fell over on its way.
    """
    if len(rows) < 2 or plant.setup is not Setup.FLOOR or plant.free_joint is None:
        return [None] * len(rows)
    model, t, h = plant.model, run.t, plant.timestep
    adr, dof = int(model.jnt_qposadr[plant.free_joint]), int(model.jnt_dofadr[plant.free_joint])
    first, last = float(t[rows[0]]), float(t[rows[-1]])
    edges: Array = first + h * np.arange(round((last - first) / h) + 2, dtype=np.float64)
    where, speed = Measured.of(t, pos).at(edges)
    setpoint = commands.mean(edges)
    data = mujoco.MjData(model)
    state = _initial_state(plant, run, rows[0], pos[rows[0]], speed[0], setpoint[0])
    mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    upright = _upright(data.qpos[adr + 3 : adr + 7])
    at = {round((float(t[row]) - first) / h): n for n, row in enumerate(rows)}
    out: list[tuple[Array, Array] | None] = [None] * len(rows)
    for step in range(len(edges) - 1):
        if step in at and np.isfinite(data.qpos).all() and _upright(data.qpos[adr + 3 : adr + 7]) @ upright > FALLEN:
            out[at[step]] = data.qpos[adr : adr + 7].copy(), data.qvel[dof : dof + 6].copy()
        data.ctrl[plant.ctrl] = setpoint[step]
        mujoco.mj_step(model, data)
        data.qpos[plant.qpos], data.qvel[plant.dof] = where[step + 1], speed[step + 1]
    return out


def _upright(quat: Array) -> Array:
    """(3,) the body's z in the world."""
    axis = np.empty(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), quat)
    return axis


@dataclass(frozen=True)
class Measured:
    """Positions of joints between the samples of a run, smoothly; before the first and after the last at rest there."""

    curves: tuple[PchipInterpolator, ...]

    @classmethod
    def of(cls, t: Array, pos: Array) -> Measured:
        """Of positions (rows, joints) rad at times (s); missing samples are bridged."""
        from scipy.interpolate import PchipInterpolator  # half a second to load

        there = np.isfinite(pos)
        return cls(tuple(PchipInterpolator(t[known], own[known]) for own, known in zip(pos.T, there.T, strict=True)))

    @property
    def begin(self) -> float:
        """s, of the first sample of any joint."""
        return float(min(curve.x[0] for curve in self.curves))

    def at(self, times: Array) -> tuple[Array, Array]:
        """(times, joints) rad and rad/s."""
        where, speed = [], []
        for curve in self.curves:
            held = np.clip(times, curve.x[0], curve.x[-1])
            where.append(curve(held))
            speed.append(np.where(held == times, curve(held, 1), 0.0))
        return np.stack(where, axis=1), np.stack(speed, axis=1)


def _initial_state(
    plant: Plant, run: Run, row: int, pos: Array, vel: Array, command: Array, led: tuple[Array, Array] | None = None,
    past: Array | None = None,
) -> Array:  # fmt: skip
    """(nstate,) integration state at a row: measured joints, base, filled setpoints and buffers.

    The base is as it was `led` (pose and velocity), else where it was measured, else settled. `past`: (steps, joints)
    setpoints of the steps before.
    """
    model = plant.model
    data = mujoco.MjData(model)
    data.qpos[plant.qpos] = pos
    if plant.setup is Setup.FLOOR and plant.free_joint is not None:
        _place_base(plant, data, run, row, command, led)
        data.qpos[plant.qpos] = pos
    data.qvel[plant.dof] = vel
    fill_setpoints(plant, data, command, past)
    data.qacc_warmstart[:] = 0
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    return state


def fill_setpoints(plant: Plant, data: mujoco.MjData, command: Array, past: Array | None = None) -> None:
    """Set controls, setpoint activations and delay buffers as if `command` (joints,) had been in force for ever.

    Args:
        past: (steps, joints) what was in force in the steps before, as far as buffers reach; default `command`.
    """
    model = plant.model
    data.act[:] = 0
    for k, i in enumerate(plant.actuator):
        data.ctrl[plant.ctrl[k]] = command[k]
        adr, num = int(model.actuator_actadr[i]), int(model.actuator_actnum[i])
        dyn = model.actuator_dyntype[i]
        if num and dyn in (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT):
            data.act[adr + num - 1] = command[k]
        elif num and _limits_slew(model, int(i)):
            data.act[adr] = command[k]  # first of its activations
        if model.actuator_history[i, 0] > 0:
            nsample, width = int(model.actuator_history[i, 0]), int(model.actuator_ctrlnum[i])
            values = np.zeros((nsample, width))
            values[:, 0] = command[k] if past is None else past[len(past) - nsample :, k]
            mujoco.mj_initCtrlHistory(model, data, int(i), None, values)


def _limits_slew(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator limits the rate of its setpoint."""
    where = SLEW_RATE.get(int(model.actuator_dyntype[actuator]))
    return where is not None and bool(model.actuator_dynprm[actuator, where] > 0)


def _place_base(
    plant: Plant, data: mujoco.MjData, run: Run, row: int, command: Array, led: tuple[Array, Array] | None
) -> None:
    """Put the free base where it was led to, else where it was measured, else settled on the floor with the run's heading."""
    model, joint = plant.model, plant.free_joint
    assert joint is not None
    adr, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    pose, velocity = _pose(run, row)
    place, quat = pose[:3], pose[3:7]
    # How high it stands follows from how it leans: a tracker's millimetres of one without the other let it drop.
    seen = np.isfinite(place) & (True, True, False)
    if led is not None:
        data.qpos[adr : adr + 7], data.qvel[dof : dof + 6] = led
        data.qpos[adr : adr + 3][seen] = place[seen]
        return
    yaw = pose[7] if np.isfinite(pose[7]) else run.facts.heading_rad or 0.0
    if np.isfinite(pose[:7]).all():
        data.qpos[adr : adr + 3], data.qpos[adr + 3 : adr + 7] = place, quat / np.linalg.norm(quat)
        data.qvel[dof : dof + 3] = velocity
        gyro = np.array([run.column(f"gyro.{axis}")[row] for axis in "xyz"])
        data.qvel[dof + 3 : dof + 6] = np.where(np.isfinite(gyro), gyro, 0.0)
        return
    # Let the robot find its own height and attitude, then turn it to the heading and move it to where it was seen.
    settling = copy.copy(model)
    rest = mujoco.MjData(settling)
    rest.qpos[plant.qpos] = data.qpos[plant.qpos]
    fill_setpoints(plant, rest, command)
    rest.qpos[adr + 3 : adr + 7] = _turned(np.array([1.0, 0, 0, 0]), yaw)
    for _ in range(round(SETTLE_S / plant.timestep)):
        rest.qvel[plant.dof] = 0  # held at the measured pose; only the base moves
        rest.qpos[plant.qpos] = data.qpos[plant.qpos]
        mujoco.mj_step(settling, rest)
    data.qpos[adr : adr + 7] = rest.qpos[adr : adr + 7]
    data.qpos[adr : adr + 3][seen] = place[seen]


def _pose(run: Run, row: int) -> tuple[Array, Array]:
    """Place, attitude and heading (8,) of the base at a row, and how fast it moves, (3,) m/s; NaN where the tracker does not say.

    Between two poses that are at most POSES_S apart it says.
    """
    poses: Array = np.stack([run.column(f"base.{axis}") for axis in POSE], axis=1)
    tracked: Bools = np.logical_or.reduce(np.isfinite(poses), axis=0)
    known = np.flatnonzero(np.isfinite(poses[:, tracked]).all(axis=1)) if tracked.any() else np.zeros(0, np.int64)
    here = poses[row]
    at = int(np.searchsorted(known, row))
    if not np.isfinite(here).any() and 0 < at < len(known) and run.t[known[at]] - run.t[known[at - 1]] <= POSES_S:
        before, after = poses[known[at - 1]], poses[known[at]].copy()
        share = (run.t[row] - run.t[known[at - 1]]) / (run.t[known[at]] - run.t[known[at - 1]])
        # The same attitude has two quaternions, the same heading many angles.
        after[3:7] *= -1.0 if before[3:7] @ after[3:7] < 0 else 1.0
        after[7] = before[7] + np.remainder(after[7] - before[7] + np.pi, 2 * np.pi) - np.pi
        here = (1 - share) * before + share * after
        around = known[max(0, at - 2) : at + 2]
        powers = (run.t[around] - run.t[row])[:, None] ** np.arange(2)
        velocity = np.linalg.lstsq(powers, poses[around, :3], rcond=None)[0][1] if tracked[:3].all() else np.zeros(3)
    else:
        near = slice(max(0, row - 5), row + 6)
        velocity = initial_velocities(run.t[near], poses[near, :3], row - near.start)
    if not np.isfinite(here[7]) and np.isfinite(here[3:7]).all():
        here = np.append(here[:7], _heading(here[3:7]))
    return here, velocity


def _heading(quat: Array) -> float:
    """rad, about the world's z."""
    w, x, y, z = quat
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def _turned(quat: Array, yaw: float) -> Array:
    turn = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    out = np.empty(4)
    mujoco.mju_mulQuat(out, turn, quat)
    return out
