"""Rollouts with effects that act between steps.

The same runs, segments, clocks and samples as `model.rollout`, whose contract holds here too; only that every step is
taken singly, for all simulations together, and laws act before each. It costs some tens of microseconds a step, however
many simulations there are: few variants of one pendulum are ten times slower than without laws, many of a whole robot
hardly.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch
from numpy.typing import NDArray

from openant_tools.effects.catalogue import effect
from openant_tools.effects.step import Law, Step
from openant_tools.model.plant import KD, KP, MOTOR_CONSTANT, RESISTANCE, TORQUE_OFF_GROUP, VMAX, Plant, is_motor
from openant_tools.model.rollout import Rollouts, Trajectories

__all__ = ["EffectValues", "laws_of", "rollout"]

Array = NDArray[np.float64]
#: steps whose commands are laid out at a time
CHUNK = 256
#: (effect, parameter) → value per joint, (joints,)
EffectValues = Mapping[tuple[str, str], Array]


def laws_of(values: Sequence[EffectValues], joints: int) -> list[Law]:
    """The laws for simulations with these values each, in the order in which they act.

    Args:
        values: one mapping a simulation; what one lacks is 0 there.
        joints: how many there are.
    """
    names = {name for one in values for (name, _), value in one.items() if np.any(value)}
    laws = []
    for found in sorted((effect(name) for name in names), key=lambda found: found.order):
        table = {
            quantity.name: np.array(
                [np.broadcast_to(one.get((found.name, quantity.name), 0.0), joints) for one in values], float
            )
            for quantity in found.quantities
        }
        laws.append(found.law(table))
    return laws


def rollout(
    rollouts: Rollouts,
    models: Sequence[mujoco.MjModel],
    effects: Sequence[EffectValues],
    delays: Array | None = None,
    *,
    measured_supply: bool = False,
) -> Trajectories:
    """Roll out every run on each of `models`, with that variant's effects.

    Args:
        rollouts: the runs, prepared.
        models: variants of the plant's model.
        effects: each variant's.
        delays: (variants, joints) s, as `Rollouts` takes them.
        measured_supply: gains and torque limits follow the logged voltage where a run has it, from its nominal supply on.
    """
    plant, segments, nv = rollouts.plant, rollouts.segments, len(models)
    lengths = np.array([len(segment.control) for segment in segments])
    longest = int(lengths[0])
    servos = _Servos(plant, [rollouts.lean(model) for model in models], len(segments), rollouts.nthread)
    servos.start(np.repeat([segment.state for segment in segments], nv, axis=0))
    laws = laws_of([effects[v] for _ in segments for v in range(nv)], len(plant.joints))
    supply = _Supply(rollouts, nv) if measured_supply else None
    samples = _Samples(rollouts, nv)
    flips: dict[int, list[int]] = {}
    for s, segment in enumerate(segments):
        for step in segment.torque_off:
            flips.setdefault(step, []).append(s)
    control: Array = np.empty(0)
    before = servos.state
    for step in range(longest):
        active = int((lengths > step).sum())
        if step % CHUNK == 0:
            control = _controls(rollouts, active, nv, step, min(step + CHUNK, longest), delays)
        for s in flips.get(step, ()):
            servos.switch(slice(s * nv, (s + 1) * nv), segments[s].torque_off[step])
        volts = None if supply is None else supply.share(step)
        servos.step(before, control[: active * nv, step % CHUNK], volts, laws, active * nv)
        after = servos.state
        samples.take(step, before, after)
        before = after
    return Trajectories(samples.pos, samples.vel, rollouts.rows)


def _controls(rollouts: Rollouts, active: int, nv: int, begin: int, end: int, delays: Array | None) -> Array:
    """(active · variants, steps, nu) of the longest segments, the ends of the shorter ones padded."""
    control = np.zeros((active, nv, end - begin, rollouts.plant.model.nu))
    for s, segment in enumerate(rollouts.segments[:active]):
        part = segment.control[begin:end]
        control[s, :, : len(part)] = part
    if delays is not None:
        rollouts.delay(control, delays, begin)
    return control.reshape(active * nv, end - begin, -1)


class _Supply:
    """The logged voltage over the nominal one, at every step of every segment; 1 where either is unknown."""

    def __init__(self, rollouts: Rollouts, nv: int) -> None:
        plant, h = rollouts.plant, rollouts.plant.timestep
        longest = max(len(segment.control) for segment in rollouts.segments)
        self._nv = nv
        self._share = np.ones((len(rollouts.segments), longest, len(plant.joints)), np.float32)
        for s, segment in enumerate(rollouts.segments):
            run = rollouts.runs[segment.run]
            nominal = run.facts.supply_v
            if not nominal:
                continue
            times = segment.start + h * (np.arange(len(segment.control)) + 0.5)
            for j, volts in enumerate(run.signal("volt", plant.joints).T):
                seen = np.isfinite(volts) & (volts > 0)
                if seen.any():
                    self._share[s, : len(times), j] = np.interp(times, run.t[seen], volts[seen]) / nominal

    def share(self, step: int) -> Array:
        """(segments · variants, joints) at a step."""
        return np.repeat(self._share[:, step], self._nv, axis=0).astype(np.float64)


class _Samples:
    """Positions and velocities at the rows of all runs, taken as the steps on both sides of a row become known."""

    def __init__(self, rollouts: Rollouts, nv: int) -> None:
        segments, nj = rollouts.segments, len(rollouts.plant.joints)
        step = np.concatenate([segment.step for segment in segments])
        order = np.argsort(step, kind="stable")
        self._edges = np.searchsorted(step[order], np.arange(int(step.max()) + 2))
        whose = np.repeat(np.arange(len(segments)), [len(segment.step) for segment in segments])
        self._segment = whose[order]
        self._row = np.concatenate([segment.row for segment in segments])[order]
        self._fraction = np.concatenate([segment.fraction for segment in segments])[order]
        shape = (rollouts.rows[-1].stop, nv, nj)
        self._pos, self._vel = np.full(shape, np.nan), np.full(shape, np.nan)
        self._by_segment = len(segments), nv, nj

    @property
    def pos(self) -> Array:
        """(variants, rows, joints) rad."""
        return np.ascontiguousarray(self._pos.swapaxes(0, 1))

    @property
    def vel(self) -> Array:
        """(variants, rows, joints) rad/s."""
        return np.ascontiguousarray(self._vel.swapaxes(0, 1))

    def take(self, step: int, before: tuple[Array, Array], after: tuple[Array, Array]) -> None:
        """Note the rows between the states (positions, velocities) before and after a step."""
        here = slice(self._edges[step], self._edges[step + 1])
        if here.start == here.stop:
            return
        segment, row, share = self._segment[here], self._row[here], self._fraction[here][:, None, None]
        for out, a, b in ((self._pos, before[0], after[0]), (self._vel, before[1], after[1])):
            first, second = a.reshape(self._by_segment)[segment], b.reshape(self._by_segment)[segment]
            out[row] = first * (1 - share) + second * share


class _Servos:
    """The joints of a batch of simulations, laid open for laws.

    Simulations stand segment by segment, the variants of each side by side.
    """

    def __init__(self, plant: Plant, models: Sequence[mujoco.MjModel], segments: int, nthread: int) -> None:
        base = copy.copy(models[0])
        base.opt.disableactuator |= 1 << TORQUE_OFF_GROUP
        self.plant, self._n = plant, segments * len(models)
        self.batch = Batch(base, self._n, nthread)
        for name in sorted(MODEL_FIELDS):
            if name.startswith("opt."):
                continue
            values = np.array([getattr(model, name) for model in models]) if hasattr(base, name) else np.empty(0)
            if not len(values) or (values == values[0]).all():
                continue
            field = self.batch.expand(name)
            field[:] = np.tile(values.reshape(len(models), *field.shape[1:]), (segments, *[1] * (field.ndim - 1)))
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._ctrl, self._applied = self.batch.bind("ctrl"), self.batch.bind("qfrc_applied")
        self._bias = self.batch.bind("qfrc_bias")
        self._group = self.batch.expand("actuator_group")
        self._friction = self.batch.expand("dof_frictionloss")
        self._gain, self._bias_of_force = self.batch.expand("actuator_gainprm"), self.batch.expand("actuator_biasprm")
        self._range = self.batch.expand("actuator_forcerange")
        self._own_group = self._group[:, plant.actuator].copy()
        self._on = np.ones((self._n, len(plant.joints)), bool)
        self._motor = np.array([is_motor(base, int(i)) for i in plant.actuator])
        self._limited = np.array([bool(base.actuator_forcelimited[i]) for i in plant.actuator])
        fixed = int(mujoco.mjtGain.mjGAIN_FIXED)
        self._fixed = np.array([int(base.actuator_gaintype[i]) == fixed for i in plant.actuator])
        self._rest = self._read()
        self._changed = dict.fromkeys(("stiffness", "velocity_gain", "limit"), False)
        self._steps = 0

    def start(self, states: Array) -> None:
        """Put every simulation into its state (n, nstate)."""
        self.batch.state[:] = states
        self.batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))

    @property
    def state(self) -> tuple[Array, Array]:
        """Positions and velocities, (n, joints) each."""
        return self._qpos[:, self.plant.qpos], self._qvel[:, self.plant.dof]

    def switch(self, rows: slice, off: NDArray[np.bool_]) -> None:
        """Torque off at the joints marked, on at the others, in these simulations."""
        self._on[rows] = ~off
        self._group[rows, self.plant.actuator] = np.where(off, TORQUE_OFF_GROUP, self._own_group[rows])

    def step(
        self, state: tuple[Array, Array], control: Array, supply: Array | None, laws: Sequence[Law], active: int
    ) -> None:
        """One step of the first `active` simulations.

        Args:
            state: what `state` says now. control: (active, nu). supply: (n, joints) shares of the nominal one, None for 1.
            laws: what acts before the step.
        """
        plant, rest = self.plant, self._rest
        self._ctrl[:active] = control
        share = 1.0 if supply is None else supply
        view = Step(
            dt=plant.timestep,
            time=np.full(self._n, self._steps * plant.timestep),
            position=state[0],
            velocity=state[1],
            load=self._bias[:, plant.dof],
            on=self._on,
            setpoint=self._ctrl[:, plant.ctrl],
            stiffness=rest["stiffness"] * share,
            velocity_gain=rest["velocity_gain"] * share,
            limit=rest["limit"] * share,
            back_emf=rest["back_emf"],
            friction=rest["friction"].copy(),
            torque=np.zeros(rest["friction"].shape),
        )
        for law in laws:
            law(view)
        self._write(view)
        self.batch.step(ids=np.arange(active, dtype=np.int32))
        self._steps += 1

    def _read(self) -> dict[str, Array]:
        i, motor = self.plant.actuator, self._motor
        gain, bias, force = self._gain[:, i], self._bias_of_force[:, i], self._range[:, i, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            back_emf = np.where(motor, gain[..., MOTOR_CONSTANT] ** 2 / gain[..., RESISTANCE], 0.0)
            stall = gain[..., MOTOR_CONSTANT] * gain[..., VMAX] / gain[..., RESISTANCE]
        return {
            "stiffness": np.where(motor, gain[..., KP], -bias[..., 1]),
            "velocity_gain": np.where(motor, gain[..., KD] - back_emf, -bias[..., 2]),
            "limit": np.where(motor, stall, np.where(self._limited, force, np.inf)),
            "back_emf": back_emf,
            "friction": self._friction[:, self.plant.dof].copy(),
        }

    def _write(self, view: Step) -> None:
        plant, rest = self.plant, self._rest
        self._ctrl[:, plant.ctrl] = view.setpoint
        self._friction[:, plant.dof] = view.friction
        self._applied[:, plant.dof] = view.torque
        for name, value in (
            ("stiffness", view.stiffness),
            ("velocity_gain", view.velocity_gain),
            ("limit", view.limit),
        ):
            if self._changed[name] or not np.array_equal(value, rest[name]):
                self._changed[name] = True
                for j in range(len(plant.joints)):
                    self._put(name, j, value[:, j])

    def _put(self, name: str, j: int, value: Array) -> None:
        """Write one number of joint j's servo into the models of all simulations."""
        i, motor = int(self.plant.actuator[j]), self._motor[j]
        gain, bias = self._gain[:, i], self._bias_of_force[:, i]
        if name == "stiffness":
            if motor:
                gain[:, KP] = value
            else:
                if self._fixed[j]:
                    gain[:, 0] *= value / -bias[:, 1]
                bias[:, 1] = -value
        elif name == "velocity_gain":
            if motor:
                gain[:, KD] = value + self._rest["back_emf"][:, j]
            else:
                bias[:, 2] = -value
        elif motor:
            gain[:, VMAX] = value * gain[:, RESISTANCE] / gain[:, MOTOR_CONSTANT]
        elif self._limited[j]:
            self._range[:, i, 0], self._range[:, i, 1] = -value, value
