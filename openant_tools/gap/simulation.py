"""Many simulated robots at work on the same commands, and what their sensors would have logged.

The clocks, segments and starts are those of `model.rollout`, whose contract holds here too. Every robot may differ from the
model in everything that `effects.robot` names, so that one batch holds thousands of different robots, or the variants of a fit.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from openant_tools.effects.robot import Cable, Form, Robot, tilted
from openant_tools.effects.rollout import laws_of
from openant_tools.effects.servos import as_slice, batch_of
from openant_tools.effects.step import Law, Step
from openant_tools.gap.initial_state import heats, setpoints
from openant_tools.gap.laws import Fields, Transmission, back_emf, first_laws, last_laws
from openant_tools.gap.tolerance import STAMP_S
from openant_tools.model.body import torso_body
from openant_tools.model.plant import Plant, Setup, without_words
from openant_tools.model.rollout import VELOCITY_SPAN_S, Rollouts, RunStretch
from openant_tools.recording.run import Run

__all__ = ["BASE", "Log", "simulate"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: bytes of states while a batch runs: with a third of it a robot takes a quarter longer, with three times as much a tenth less
CHUNK_BYTES = 192 * 2**20
#: s over which velocities become an acceleration
ACCELERATION_S = 0.01
#: s, the longest step on a floor in which rotors behind play and springs do not rattle
FINE_S = 0.002
#: s for which rotors behind play and springs are led along before a simulation begins amid a run
LED_S = 1.0
#: time constants of a lag after which what was commanded is forgotten
REMEMBERS = 5.0
#: m/s and rad/s, deviations of how fast a body is taken to move where a simulation begins anew
BASE_M_S, BASE_RAD_S = 0.01, 0.05
#: mjtCone of forms that are elliptic, or not
_CONES = {False: int(mujoco.mjtCone.mjCONE_PYRAMIDAL), True: int(mujoco.mjtCone.mjCONE_ELLIPTIC)}
#: signals that are as late as others, together with what makes them so
LATE_WITH = {"gyro": ("imu",), "acc": ("imu", "acc"), "base": ("base",), "yaw": ("base",)}
#: base signals and how many columns they have
BASE = {"gyro": 3, "acc": 3, "base": 3, "yaw": 1}


@dataclass(frozen=True)
class Log:
    """What the robots' sensors would have logged at the rows of all runs, without noise; NaN before a run's first start.

    Attributes:
        signals: name → (robots, rows, columns): "pos" rad, "vel" rad/s, "torque" (of the motor, N·m) and "volt" (share of the
            supply) by joint; with a free base "gyro" (rad/s) and "acc" (m/s²) in its frame, "base" (m), "yaw" (rad).
    """

    signals: dict[str, NDArray[np.float32]]


def simulate(
    rollouts: Rollouts,
    robots: Sequence[Robot],
    seed: int = 0,
    signals: Sequence[str] | None = None,
    warm_c: Sequence[Array] | None = None,
    misread: bool = False,
) -> Log:
    """Let robots do what runs command.

    Args:
        rollouts: the runs, prepared; re-initialised from measurement as they say.
        robots: any number; those with a form of their own are simulated in it.
        seed: of what is random in time (jitter, lost commands).
        signals: those wanted; default all that there are.
        warm_c: of each run (joints,) °C, by which servos are known to be warmer than in the coolest one; default none.
        misread: simulations that begin anew begin where noisy sensors say, as those of a real log do.
    """
    without_words()
    plant, rows = rollouts.plant, rollouts.rows[-1].stop
    floor = plant.setup is Setup.FLOOR and plant.free_joint is not None
    names = [name for name in ("pos", "vel", "torque", "volt") if signals is None or name in signals]
    names += [name for name in BASE if floor and (signals is None or name in signals)]
    width = {name: BASE.get(name, len(plant.joints)) for name in names}
    out = {name: np.full((len(robots), rows, width[name]), np.nan, np.float32) for name in names}
    # Rotors behind play and springs take smaller steps, and are led along to each window: that costs more than the others.
    hidden = np.array([_hides(robot) for robot in robots])
    groups = [(np.flatnonzero(~hidden), rollouts)]
    if hidden.any():
        parts = math.ceil(plant.timestep / FINE_S - 1e-9) if floor else 1
        groups.append((np.flatnonzero(hidden), rollouts.finer(parts)))
    for group, stepped in groups:
        longest = max(len(segment.control) for segment in stepped.segments)
        state = 8 * (plant.model.nq + 3 * plant.model.nv)
        at_once = max(1, int(CHUNK_BYTES // (state * longest * len(stepped.segments))))
        for first in range(0, len(group), at_once):
            some = group[first : first + at_once]
            # A run of its own of random numbers to each portion, whatever the others are.
            rng = np.random.default_rng((seed, int(some[0])))
            mine = {name: np.full((len(some), *whole.shape[1:]), np.nan, np.float32) for name, whole in out.items()}
            told = "torque" in names or "volt" in names
            _Batch(stepped, [robots[k] for k in some], rng, warm_c, misread=misread, told=told).play(mine)
            for name, values in mine.items():
                out[name][some] = values
    return Log(out)


def _switching(run: Run) -> tuple[float, float]:
    """s after the row that says so about which torque goes or comes, and by how much earlier or later at most.

    Between the row and its own command, whichever is first; where a log does not say when that was, up to a row before or after.
    """
    sent = run.column("cmd_t")
    # Rows may be faster than commands, and repeat the one before.
    fresh = 1 + np.flatnonzero(np.diff(sent) > 0)
    if not len(fresh):
        return 0.0, float(np.median(np.diff(run.t)))
    gap = float(np.median(sent[fresh] - run.t[fresh]))
    return gap / 2, abs(gap) / 2 + STAMP_S


def _scatters(robot: Robot) -> bool:
    """Whether its commands come by chance."""
    return bool(robot.jitter_s > 0 or robot.dropout.any())


def _hides(robot: Robot) -> bool:
    """Whether positions of joints do not tell where rotors are."""
    return bool(robot.play.any() or robot.compliance.any())


class _Batch:
    """Robots × segments side by side: simulation s · robots + r."""

    def __init__(
        self,
        rollouts: Rollouts,
        robots: Sequence[Robot],
        rng: np.random.Generator,
        warm_c: Sequence[Array] | None,
        *,
        misread: bool = False,
        told: bool = True,
    ) -> None:
        self._rollouts, self._robots, self._rng, self._told = rollouts, robots, rng, told
        self._plant, self._segments = rollouts.plant, rollouts.segments
        self._n = len(robots)
        plant, copies = self._plant, len(self._segments)
        scratch = mujoco.MjData(plant.model)
        models = [rollouts.lean(robot.model(plant, scratch)) for robot in robots]
        # A batch takes arrays from its models, flags from the first.
        models[0].flg_adhesion = any(robot.adhesion_n > 0 for robot in robots)
        self._batch, self._servos = batch_of(plant, models, copies, rollouts.nthread)
        self._zero = np.tile(np.array([robot.zero for robot in robots]), (copies, 1))
        self._take_forms()
        state = np.repeat([segment.state for segment in self._segments], self._n, axis=0)
        state[:, 1 + plant.qpos] += np.tile(np.array([robot.start for robot in robots]), (copies, 1)) - self._zero
        self._look_ahead(state)
        if misread:
            self._misread(state)
        self._batch.state[:] = state
        self._batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
        hidden = rollouts.horizon is not None and any(_hides(robot) for robot in robots)
        self._share: Array | None = None
        self._led = round(LED_S / plant.timestep) if hidden else 0
        warm = np.zeros((len(rollouts.runs), len(plant.joints))) if warm_c is None else np.array(warm_c)
        self._laws = self._make_laws(warm[[segment.run for segment in self._segments]][:, None])

    def _look_ahead(self, state: Array) -> None:
        """Move where simulations begin, in place, to where joints were whose encoders are late: what these say comes later."""
        late = np.array([robot.log_delay.get("pos", 0.0) for robot in self._robots])
        (some,) = np.nonzero(late >= self._plant.timestep)
        speed, around = 1 + self._plant.model.nq, VELOCITY_SPAN_S / 2 * np.array([-1.0, 0.0, 1.0])
        for s, segment in enumerate(self._segments if len(some) else ()):
            measured, rows = self._rollouts.measured[segment.run], s * self._n + some[:, None]
            now = measured.at(segment.start + around)[0][:, None]
            then = measured.at((segment.start + around[:, None] + late[some]).ravel())[0]
            moved = then.reshape(len(around), len(some), -1) - now
            state[rows, 1 + self._plant.qpos] += moved[1]
            state[rows, speed + self._plant.dof] += (moved[2] - moved[0]) / VELOCITY_SPAN_S

    def _misread(self, state: Array) -> None:
        """Move where simulations begin, in place, by what each robot's sensors make of it."""
        plant, sims = self._plant, len(state)
        noise = np.tile([robot.noise.get("pos", 0.0) for robot in self._robots], len(self._segments))[:, None]
        amid = np.repeat([segment.first > 0 for segment in self._segments], self._n)[:, None]
        off = noise * self._rng.standard_normal((sims, len(plant.joints)))
        state[:, 1 + plant.qpos] += off
        speed = 1 + plant.model.nq
        state[:, speed + plant.dof] += amid * noise / VELOCITY_SPAN_S * self._rng.standard_normal(off.shape)
        if plant.free_joint is not None:
            dof = int(plant.model.jnt_dofadr[plant.free_joint])
            unsure = np.repeat([BASE_M_S, BASE_RAD_S], 3) * (noise > 0)
            adr = 1 + int(plant.model.jnt_qposadr[plant.free_joint])
            seen = np.tile([robot.noise.get("base", 0.0) for robot in self._robots], len(self._segments))[:, None]
            state[:, adr : adr + 2] += amid * seen * self._rng.standard_normal((sims, 2))
            state[:, speed + dof : speed + dof + 6] += amid * unsure * self._rng.standard_normal((sims, 6))

    def _take_forms(self) -> None:
        """What a batch takes from its models are their arrays; these are options."""
        given = self._plant.model.opt
        if any(robot.tilt.any() for robot in self._robots):
            down = [tilted(given.gravity, robot.tilt) if robot.tilt.any() else given.gravity for robot in self._robots]
            self._take("opt.gravity", down)
        own = Form(given.integrator, given.cone == _CONES[True], given.impratio)
        forms = [robot.form or own for robot in self._robots]
        cones = [_CONES[form.elliptic] for form in forms]
        if any(form.integrator != given.integrator for form in forms):
            self._take("opt.integrator", [form.integrator for form in forms])
        if any(cone != given.cone for cone in cones):
            self._take("opt.cone", cones)
        ratios = [form.impratio * robot.impratio for form, robot in zip(forms, self._robots, strict=True)]
        if any(ratio != given.impratio for ratio in ratios):
            self._take("opt.impratio", ratios)

    def _take(self, option: str, values: Sequence[object]) -> None:
        field = self._batch.expand(option)
        field[:] = np.tile(np.array(values).reshape(len(values), -1), (len(self._segments), 1)).reshape(field.shape)

    def _make_laws(self, warm_c: Array) -> list[Law]:
        plant, copies = self._plant, len(self._segments)
        robots = [robot for _ in range(copies) for robot in self._robots]
        armatures = self._batch.expand("dof_armature")

        def weigh(values: Array) -> None:
            armatures[:, plant.dof] = values

        fields = Fields(
            armature=_column(self._batch, "dof_armature", plant.dof),
            damping=_column(self._batch, "dof_damping", plant.dof),
            friction=_column(self._batch, "dof_frictionloss", plant.dof),
            link=np.maximum(plant.model.dof_M0[plant.dof] - plant.model.dof_armature[plant.dof], 1e-6)[None].repeat(len(robots), 0),
            weigh=weigh,
        )  # fmt: skip
        duty = np.array([[robot.form is None or robot.form.tells_duty] for robot in robots])
        self._asked = np.array([[robot.form is not None and robot.form.tells_asked] for robot in robots])
        whole = np.ones(len(plant.joints))
        self._lacks = {
            kind: np.array([robot.lacks.get(kind, whole) for robot in robots]) for kind in ("stiffness", "torque_limit")
        }
        self._generated = generated = back_emf(robots, fields)
        untold = np.where(duty, generated, 0.0)
        self._untold = untold if untold.any() else None
        asked, heat_c = self._begun(warm_c)
        first = first_laws(robots, generated, heat_c, asked)
        last = last_laws(robots, generated, fields)
        for name, values in (("dof_armature", fields.armature), ("dof_damping", fields.damping)):
            self._batch.expand(name)[:, plant.dof] = values
        between = laws_of([robot.laws for robot in robots], len(plant.joints))
        before, note = ([self._ask] if self._asked.any() else []), [self._note]
        if not self._told:  # of what motors give
            before, note = [], []
        return [*before, *first, *between, self._partly, *note, *last]

    def _begun(self, warm_c: Array) -> tuple[Array, Array]:
        """As each simulation begins: where setpoints of limited rate are (rad), and how warm its servos are (°C)."""
        copies, joints = len(self._segments), len(self._plant.joints)
        asked = np.empty((copies, self._n, joints))
        heat = np.broadcast_to(np.array([[[robot.heat_c] for robot in self._robots]]) + warm_c, asked.shape).copy()
        warming = self._rollouts.horizon is not None and any(robot.derating.any() for robot in self._robots)
        rows = slice(0, self._n)

        def servos(dt: float, state: tuple[Array, Array], setpoint: Array) -> Step:
            return self._servos.view(dt, np.zeros(self._n), state, setpoint, rows=rows)

        for k in sorted({segment.run for segment in self._segments}):
            mine = [s for s, segment in enumerate(self._segments) if segment.run == k]
            commands, starts = self._segments[mine[0]].commands, [self._start(self._segments[s]) for s in mine]
            asked[mine] = setpoints(commands, starts, self._robots) - self._zero[rows]
            if warming:
                measured = self._rollouts.measured[k]
                heat[mine] = heats(measured, commands, starts, self._robots, heat[mine[0]], servos)
        return asked.reshape(-1, joints), heat.reshape(-1, joints)

    def _start(self, segment: RunStretch) -> float:
        return segment.start - self._led * self._plant.timestep

    def _ask(self, step: Step) -> None:
        """What loops ask of motors, before any law on what these can give."""
        lacks = self._lacks
        self._healthy = step.stiffness / lacks["stiffness"], step.limit / lacks["torque_limit"]

    def _note(self, step: Step) -> None:
        """What the motors give and get, before laws on what comes of it."""
        told = step.motor_torque
        if self._asked.any():
            stiffness, limit = (of * step.supply for of in self._healthy)
            healthy = dataclasses.replace(step, stiffness=stiffness, limit=limit)
            told = np.where(self._asked, healthy.motor_torque, told)
        if self._untold is not None:
            told = told + np.where(step.on, self._untold * step.velocity, 0.0)
        self._given = told, step.supply

    def play(self, out: dict[str, NDArray[np.float32]]) -> None:
        plant, segments, n = self._plant, self._segments, self._n
        lengths = np.array([len(segment.control) for segment in segments])
        longest, sims = int(lengths[0]), n * len(segments)
        control = self._controls(self._led + longest)
        ctrl, time, h, of_joints = self._batch.bind("ctrl"), np.zeros(sims), plant.timestep, as_slice(plant.ctrl)
        # Of each step how many simulations take it: those of the longer segments come first.
        going = (n * (lengths[:, None] > np.arange(longest)).sum(axis=0)).tolist()
        rest = np.repeat([segment.control[0] for segment in segments], n, axis=0)
        ctrl[:] = rest
        switches = self._switches()
        floor = "gyro" in out or "base" in out or plant.setup is Setup.FLOOR
        states = _States(self._batch, plant, sims, longest, base=floor, told=self._told)
        cable = self._cable()
        self._lead(control)
        before = self._servos.state
        for step, active in enumerate(going):
            self._share = None
            for some, off, share in switches.get(step, ()):
                self._servos.switch(some, off)
                if share is not None:
                    self._share = (
                        np.ones((n * len(segments), len(plant.joints))) if self._share is None else self._share
                    )
                    self._share[some] = share
            ctrl[:, of_joints] = control[:, self._led + step]
            self._servos.prepare(self._laws, time, before)
            states.keep(step, before, self._given if self._told else None)
            if cable is not None:
                cable()
            self._batch.step(ids=None if active == sims else np.arange(active, dtype=np.int32))
            time += h
            before = self._servos.state
        states.keep(longest, before, None)
        self._sample(states, out)

    def _switches(self) -> dict[int, list[tuple[slice, Bools, Array | None]]]:
        """Step → of some simulations, joints that are off from there on, and what share of it torque is on where it goes or comes amid it."""
        out: dict[int, list[tuple[slice, Bools, Array | None]]] = {}
        h, later = self._plant.timestep, [robot.switching for robot in self._robots]
        alike = [list(group) for _, group in itertools.groupby(range(self._n), later.__getitem__)]
        for s, segment in enumerate(self._segments):
            last, ((_, before), *changes) = len(segment.control) - 1, segment.torque_off.items()
            out.setdefault(0, []).append((slice(s * self._n, (s + 1) * self._n), before, None))
            if not changes:
                continue
            centre, half = _switching(self._rollouts.runs[segment.run])
            for after, off in changes:
                for robots in alike:
                    sims = slice(s * self._n + robots[0], s * self._n + robots[-1] + 1)
                    at = max(after + centre + later[robots[0]] * half, 0.0) / h
                    step = min(int(at), last)
                    went, stays = min(at - step, 1.0), off & before
                    share = np.where(stays | (off == before), 1.0, np.where(off, went, 1.0 - went))
                    out.setdefault(step, []).append((sims, stays, share))
                    out.setdefault(step + 1, []).append((sims, off, None))
                before = off
        return out

    def _partly(self, step: Step) -> None:
        """Torque that goes or comes amid a step is there for a part of it."""
        if self._share is not None:
            step.stiffness, step.velocity_gain = step.stiffness * self._share, step.velocity_gain * self._share
            step.limit = step.limit * self._share
            # Back-EMF that a law takes off for the whole step.
            step.torque = step.torque + (1 - self._share) * self._generated * step.velocity

    def _lead(self, control: NDArray[np.float32]) -> None:
        """Bring rotors behind play and springs to where they are as a simulation begins: laws act, the joints go as measured."""
        if not self._led:
            return
        h, zero, ctrl = self._plant.timestep, self._zero, self._batch.bind("ctrl")
        paths = [
            self._rollouts.measured[segment.run].at(self._start(segment) + h * np.arange(self._led, dtype=np.float64))
            for segment in self._segments
        ]
        where, speed = (np.stack(of, axis=1).repeat(self._n, axis=1) for of in zip(*paths, strict=True))
        for s, segment in enumerate(self._segments):
            self._servos.switch(slice(s * self._n, (s + 1) * self._n), segment.torque_off[-np.inf])
        for step in range(self._led):
            ctrl[:, self._plant.ctrl] = control[:, step]
            self._servos.prepare(
                self._laws, np.full(len(zero), h * (step - self._led)), (where[step] - zero, speed[step])
            )
        if self._plant.setup is Setup.STAND:
            self._carry()

    def _carry(self) -> None:
        """Put rotors where they carry what the links that they move were measured to need; on the floor feet carry some of it.

        What a servo that stands still gives says little of it: its friction takes any part.
        """
        model, dof = self._plant.model, self._plant.dof
        data, loads = mujoco.MjData(model), []
        for segment in self._segments:
            mujoco.mj_setState(model, data, segment.state, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            ends: Array = segment.start + ACCELERATION_S * np.array([-1.0, 1.0])
            speed = self._rollouts.measured[segment.run].at(ends)[1]
            acceleration, moves = np.zeros(model.nv), np.zeros(model.nv)
            acceleration[dof] = (speed[1] - speed[0]) / (2 * ACCELERATION_S)
            mujoco.mj_mulM(model, data, moves, acceleration)
            loads.append((moves + data.qfrc_bias - model.dof_armature * acceleration)[dof])
        load = np.repeat(loads, self._n, axis=0)
        for law in self._laws:
            if isinstance(law, Transmission):
                law.carry(*self._servos.state, load)

    def _controls(self, longest: int) -> NDArray[np.float32]:
        """(segments · robots, steps, joints) rad, setpoints as they act: late, scattered, lost, filtered."""
        plant, h = self._plant, self._plant.timestep
        out = np.zeros((len(self._segments), self._n, longest, len(plant.joints)), np.float32)
        for s, segment in enumerate(self._segments):
            steps = self._led + len(segment.control)
            edges: Array = self._start(segment) + h * np.arange(steps + 1, dtype=np.float64)
            known: dict[tuple[bytes, bytes], Array] = {}
            for r, robot in enumerate(self._robots):
                alike = robot.delay.tobytes(), robot.lag.tobytes()
                mean = None if _scatters(robot) else known.get(alike)
                if mean is None:
                    mean = self._control(segment, robot, edges)
                if not _scatters(robot):
                    known[alike] = mean
                out[s, r, :steps] = mean - robot.zero
                out[s, r, steps:] = out[s, r, steps - 1]
        return out.reshape(-1, longest, len(plant.joints))

    def _control(self, segment: RunStretch, robot: Robot, edges: Array) -> Array:
        plant, h = self._plant, self._plant.timestep
        commands = segment.commands
        random, delay = _scatters(robot), robot.delay + plant.lead_s
        if not random and not delay.any():
            mean = np.concatenate([commands.mean(edges[: self._led + 1]), segment.control[:, plant.ctrl]])
        elif not random and (delay == delay[0]).all():
            mean = commands.mean(edges - delay[0])
        else:
            mean = np.empty((len(edges) - 1, len(plant.joints)))
            times = commands.times
            one_packet = robot.form is None or robot.form.one_packet
            packet = self._read_at(robot, times) if one_packet else None
            shared = self._lost(robot, times, 0) if robot.shared_dropout else None
            for j in range(len(plant.joints)):
                late = packet if packet is not None else self._read_at(robot, times)
                lost = shared if shared is not None else self._lost(robot, times, j)
                column = dataclasses.replace(commands, times=late, values=_without(commands.values[:, j : j + 1], lost))
                mean[:, j] = column.mean(edges - delay[j])[:, 0]
        if robot.lag.any():
            mean = mean.copy()
            # What a servo still follows when a window begins was commanded before it.
            back = edges[0] - h * np.arange(round(REMEMBERS * float(robot.lag.max()) / h), -1, -1)
            for filtered in np.flatnonzero(robot.lag):
                before = commands.mean(back - delay[filtered])[:, filtered]
                whole = np.concatenate([before, mean[:, filtered]])
                mean[:, filtered] = _filtered(whole, h / float(robot.lag[filtered]))[len(before) :]
        return mean

    def _read_at(self, robot: Robot, times: Array) -> Array:
        """When commands that were due at these times act, in order."""
        if robot.jitter_s <= 0:
            return times
        jitter = self._rng.normal(0.0, robot.jitter_s, len(times))
        if robot.form is not None and robot.form.never_early:
            jitter = np.maximum(jitter, 0.0)
        late: Array = np.maximum.accumulate(times + jitter)
        return late

    def _lost(self, robot: Robot, times: Array, j: int) -> NDArray[np.bool_]:
        """Which commands never arrive: stretches of up to `longest_s`, together `dropout` of all."""
        lost = np.zeros(len(times), bool)
        share = float(robot.dropout[j] if not robot.shared_dropout else robot.dropout.max())
        if share <= 0:
            return lost
        period = float(np.median(np.diff(times))) if len(times) > 1 else 0.02
        most = max(1, round(robot.longest_s / max(period, 1e-6)))
        while lost.mean() < share:
            start, length = int(self._rng.integers(1, len(times))), int(self._rng.integers(1, most + 1))
            lost[start : start + length] = True
        return lost

    def _cable(self) -> _Cable | None:
        cables = [robot.cable for robot in self._robots]
        if self._plant.free_joint is None or not any(
            c.force_n.any() or c.damping_n_s_m or c.stiffness_n_m for c in cables
        ):
            return None
        return _Cable(self._batch, self._plant, [cable for _ in self._segments for cable in cables])

    def _sample(self, states: _States, out: dict[str, NDArray[np.float32]]) -> None:
        h, encoder_late = self._plant.timestep, self._plant.encoder_delay_s
        for s, segment in enumerate(self._segments):
            steps = len(segment.control)
            at = segment.step + segment.fraction
            for r, robot in enumerate(self._robots):
                k = s * self._n + r
                for name, values in out.items():
                    late = sum(robot.log_delay.get(group, 0.0) for group in LATE_WITH.get(name, (name,)))
                    late -= 0.0 if name in ("pos", "vel") else encoder_late  # which rows come later by
                    when = at - late / h
                    found = states.at(name, k, np.clip(when, 0.0, steps), steps, robot)
                    if name == "pos" and late >= h and (before := when < 0).any():
                        # Where joints were before the start is in the log.
                        found[before] = self._rollouts.measured[segment.run].at(segment.start + at[before] * h)[0]
                    values[r, segment.row] = found


class _States:
    """All states of a batch, until they are sampled."""

    def __init__(self, batch: Batch, plant: Plant, sims: int, steps: int, *, base: bool, told: bool) -> None:
        n, self._h = len(plant.joints), plant.timestep
        self.pos, self.vel = np.empty((2, steps + 1, sims, n), np.float32)
        self.torque, self.share = np.zeros((2, steps + 1 if told else 0, sims, n), np.float32)
        self._base = base and plant.free_joint is not None
        if self._base:
            joint = plant.free_joint
            adr, dof = int(plant.model.jnt_qposadr[joint]), int(plant.model.jnt_dofadr[joint])
            self._qpos, self._qvel = batch.bind("qpos")[:, adr : adr + 7], batch.bind("qvel")[:, dof : dof + 6]
            self.place = np.empty((steps + 1, sims, 7), np.float32)
            self.twist = np.empty((steps + 1, sims, 6), np.float32)
            self._gravity = batch.expanded("opt.gravity")
            self._given = plant.model.opt.gravity.copy()

    def keep(self, step: int, state: tuple[Array, Array], given: tuple[Array, Array] | None) -> None:
        self.pos[step], self.vel[step] = state
        if given is not None:
            self.torque[step], self.share[step] = given
        elif len(self.torque):
            self.torque[step], self.share[step] = self.torque[step - 1], self.share[step - 1]
        if self._base:
            self.place[step], self.twist[step] = self._qpos, self._qvel

    def at(self, name: str, sim: int, when: Array, steps: int, robot: Robot) -> Array:
        """(rows, columns) of a signal at times in steps."""
        low = np.minimum(np.floor(when).astype(int), steps - 1)
        share = (when - low)[:, None]

        def mixed(values: NDArray[np.float32]) -> Array:
            mix: Array = values[low, sim] * (1 - share) + values[low + 1, sim] * share
            return mix

        if name == "pos":
            return mixed(self.pos) + robot.zero
        if name == "vel":
            return mixed(self.vel)
        if name == "torque":
            # What a servo says it gives is what it gave last: a command sent beside the reading is not in it yet.
            given: Array = self.torque[np.maximum(low - 1, 0), sim].astype(np.float64)
            return given
        if name == "volt":
            return mixed(self.share)
        place = mixed(self.place)
        quat = place[:, 3:] / np.linalg.norm(place[:, 3:], axis=1, keepdims=True)
        turn = _rotation(robot.imu_rotation)
        if name == "gyro":
            return mixed(self.twist)[:, 3:] @ turn + robot.gyro_bias
        if name == "acc":
            span = max(1, round(ACCELERATION_S / self._h))
            ahead, behind = np.minimum(low + span, steps), np.maximum(low - span, 0)
            change = (self.twist[ahead, sim, :3] - self.twist[behind, sim, :3]) / ((ahead - behind)[:, None] * self._h)
            gravity = self._given if self._gravity is None else self._gravity[sim]
            return _to_body(quat, change - gravity) @ turn + robot.acc_bias
        if name == "yaw":
            yaw: Array = np.unwrap(2 * np.arctan2(quat[:, 3], quat[:, 0]))[:, None] + robot.base_yaw
            return yaw
        c, s = np.cos(robot.base_yaw), np.sin(robot.base_yaw)
        out = place[:, :3] * robot.base_scale
        return np.stack([c * out[:, 0] - s * out[:, 1], s * out[:, 0] + c * out[:, 1], out[:, 2]], axis=1)


class _Cable:
    def __init__(self, batch: Batch, plant: Plant, cables: Sequence[Cable]) -> None:
        torso, joint = torso_body(plant.model, plant), plant.free_joint
        assert joint is not None
        adr, dof = int(plant.model.jnt_qposadr[joint]), int(plant.model.jnt_dofadr[joint])
        self._wrench = batch.bind("xfrc_applied")[:, torso]
        self._place, self._speed = batch.bind("qpos")[:, adr : adr + 3], batch.bind("qvel")[:, dof : dof + 3]
        self._force = np.array([cable.force_n for cable in cables])
        self._damping = np.array([[cable.damping_n_s_m] for cable in cables])
        self._spring = np.array([[cable.stiffness_n_m] for cable in cables])
        self._anchor = self._place.copy()

    def __call__(self) -> None:
        self._wrench[:, :3] = self._force - self._damping * self._speed - self._spring * (self._place - self._anchor)


def _column(batch: Batch, name: str, dof: NDArray[np.int64]) -> Array:
    values: Array = batch.expand(name)[:, dof].copy()
    return values


def _without(values: Array, lost: NDArray[np.bool_]) -> Array:
    source = np.maximum.accumulate(np.where(lost, 0, np.arange(len(values))))
    out: Array = values[source]
    return out


def _filtered(values: Array, ratio: float) -> Array:
    """First-order lag, exact for a piecewise constant input, from rest at the first value."""
    from scipy.signal import lfilter  # a second to load

    keep = float(np.exp(-ratio))
    out, _ = lfilter([1 - keep], [1, -keep], values, zi=[keep * values[0]])
    filtered: Array = out
    return filtered


def _rotation(vector: Array) -> Array:
    """(3, 3) that turns vectors of the sensor's frame into the body's, for a rotation vector in rad."""
    quat, matrix = np.zeros(4), np.zeros(9)
    angle = float(np.linalg.norm(vector))
    mujoco.mju_axisAngle2Quat(quat, vector / angle if angle else np.array([0.0, 0.0, 1.0]), angle)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _to_body(quat: Array, vectors: Array) -> Array:
    """World vectors in the frames of quaternions (rows, 4)."""
    w, u = quat[:, :1], -quat[:, 1:]
    cross = np.cross(u, vectors)
    out: Array = vectors + 2 * (w * cross + np.cross(u, cross))
    return out
