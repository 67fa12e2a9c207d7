"""Servos of compiled models, laid open for laws: the same for a batch of simulations and for a single one."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch
from numpy.typing import NDArray

from openant_tools.effects.step import Law, Step
from openant_tools.model.plant import KD, KP, MOTOR_CONSTANT, RESISTANCE, TORQUE_OFF_GROUP, VMAX, Plant, is_motor

__all__ = ["Servos", "as_slice", "batch_of", "single"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
#: setpoint filters of a position servo (`timeconst`): the servo follows their state instead of its control
FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
#: fields of the models that servos are read from and written to
_READ = (
    "actuator_group", "actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "dof_damping", "dof_frictionloss",
)  # fmt: skip


@dataclass(frozen=True)
class Fields:
    """Live arrays of n models and their states; the first axis is the simulation's."""

    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array
    qfrc_applied: Array
    qfrc_bias: Array
    actuator_group: NDArray[np.int32]
    actuator_gainprm: Array
    actuator_biasprm: Array
    actuator_forcerange: Array
    dof_damping: Array
    dof_frictionloss: Array


class Servos:
    """The joints of n simulations of one plant, and what laws do to them.

    Args:
        plant: whose servos.
        base: the model that all share, but for the fields.
        fields: what the laws read and write.
    """

    def __init__(self, plant: Plant, base: mujoco.MjModel, fields: Fields) -> None:
        self.plant, self._fields, self._n, self._dt = plant, fields, len(fields.qpos), plant.timestep
        i = plant.actuator
        self._motor = np.array([is_motor(base, int(k)) for k in i])
        self._limited = np.array([bool(base.actuator_forcelimited[k]) for k in i])
        fixed = int(mujoco.mjtGain.mjGAIN_FIXED)
        self._fixed = np.array([int(base.actuator_gaintype[k]) == fixed for k in i])
        self._filtered = np.array([int(base.actuator_dyntype[k]) in FILTERS for k in i])
        self._act = np.where(self._filtered, base.actuator_actadr[i], 0)
        self._group = fields.actuator_group[:, i].copy()
        self._on = np.ones((self._n, len(i)), bool)
        self._rest = self._read()
        self._full = np.ones((self._n, len(i)))
        self._qpos, self._dof, self._ctrl = as_slice(plant.qpos), as_slice(plant.dof), as_slice(plant.ctrl)
        self._filters = bool(self._filtered.any())
        motors, others = np.flatnonzero(self._motor), np.flatnonzero(~self._motor)
        # Of each sort of servo its joints and its actuators; None where there is none.
        self._motors, self._others, self._proportional, self._bounded = (
            (as_slice(joints), as_slice(i[joints])) if len(joints) else None
            for joints in (motors, others, others[self._fixed[others]], others[self._limited[others]])
        )
        # Of the gain on the setpoint to that on the position; from here, so that no rounding piles up from step to step.
        stiffness = -fields.actuator_biasprm[:, i, 1]
        self._ratio = fields.actuator_gainprm[:, i, 0] / np.where(stiffness == 0.0, 1.0, stiffness)
        self._changed = dict.fromkeys(("stiffness", "velocity_gain", "limit"), False)

    @property
    def state(self) -> tuple[Array, Array]:
        """Positions (rad) and velocities (rad/s) now, (n, joints) each."""
        return self._fields.qpos[:, self._qpos].copy(), self._fields.qvel[:, self._dof].copy()

    def switch(self, rows: slice, off: NDArray[np.bool_]) -> None:
        """Torque off at the joints marked, on at the others, in these simulations."""
        self._on[rows] = ~off
        self._fields.actuator_group[rows, self.plant.actuator] = np.where(off, TORQUE_OFF_GROUP, self._group[rows])

    def prepare(
        self, laws: Sequence[Law], time: Array, state: tuple[Array, Array], supply: Array | None = None
    ) -> None:
        """Let the laws act on what the next step is computed from.

        Args:
            laws: in the order in which they act.
            time: (n,) s since the start.
            state: what `state` says now.
            supply: (n, joints) shares of the nominal voltage; None for all of it.
        """
        rest, fields = self._rest, self._fields
        setpoint = fields.ctrl[:, self._ctrl].copy()
        told = np.where(self._filtered, fields.act[:, self._act], setpoint) if self._filters else setpoint
        view = self.view(self._dt, time, state, told, supply=supply)
        for law in laws:
            law(view)
        fields.ctrl[:, self._ctrl] = (
            np.where(self._filtered, setpoint, view.setpoint) if self._filters else view.setpoint
        )
        fields.dof_frictionloss[:, self._dof] = view.friction
        fields.qfrc_applied[:, self._dof] = view.torque
        changed = {"stiffness": view.stiffness, "velocity_gain": view.velocity_gain, "limit": view.limit}
        for name, value in changed.items():
            if self._changed[name] or not (value is rest[name] or np.array_equal(value, rest[name])):
                self._changed[name] = True
                self._put(name, value)

    def view(
        self,
        dt: float,
        time: Array,
        state: tuple[Array, Array],
        setpoint: Array,
        *,
        supply: Array | None = None,
        rows: slice = slice(None),
    ) -> Step:
        """These simulations' servos as laws see them, before any has acted.

        Args:
            dt: s, of the step. setpoint: (rows, joints) rad. rows: which simulations; the others as in `prepare`.
        """
        rest = self._rest if rows == slice(None) else {name: values[rows] for name, values in self._rest.items()}
        servo = {name: rest[name] for name in ("stiffness", "velocity_gain", "limit")}
        if supply is not None:
            servo = {name: values * supply for name, values in servo.items()}
        friction = rest["friction"].copy()
        return Step(
            dt=dt,
            time=time,
            position=state[0],
            velocity=state[1],
            load=self._fields.qfrc_bias[rows, self._dof].copy(),
            on=self._on[rows],
            setpoint=setpoint,
            **servo,
            back_emf=rest["back_emf"],
            damping=rest["damping"],
            friction=friction,
            torque=np.zeros(friction.shape),
            supply=self._full[rows] if supply is None else supply,
        )

    def _read(self) -> dict[str, Array]:
        i, motor, fields = self.plant.actuator, self._motor, self._fields
        gain, bias, force = (
            fields.actuator_gainprm[:, i],
            fields.actuator_biasprm[:, i],
            fields.actuator_forcerange[:, i, 1],
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            back_emf = np.where(motor, gain[..., MOTOR_CONSTANT] ** 2 / gain[..., RESISTANCE], 0.0)
            stall = gain[..., MOTOR_CONSTANT] * gain[..., VMAX] / gain[..., RESISTANCE]
        rest = {
            "stiffness": np.where(motor, gain[..., KP], -bias[..., 1]),
            "velocity_gain": np.where(motor, gain[..., KD] - back_emf, -bias[..., 2]),
            "limit": np.where(motor, stall, np.where(self._limited, force, np.inf)),
            "back_emf": back_emf,
            "damping": fields.dof_damping[:, self.plant.dof].copy(),
            "friction": fields.dof_frictionloss[:, self.plant.dof].copy(),
        }
        for values in rest.values():
            values.flags.writeable = False  # every step begins with these very arrays
        return rest

    def _put(self, name: str, value: Array) -> None:
        """Write one number of every servo, (n, joints), into the models of all simulations."""
        gain, bias, force = (
            self._fields.actuator_gainprm,
            self._fields.actuator_biasprm,
            self._fields.actuator_forcerange,
        )
        motors, others = self._motors, self._others
        if name == "stiffness":
            if motors:
                gain[:, motors[1], KP] = value[:, motors[0]]
            if self._proportional:
                joints, actuators = self._proportional
                gain[:, actuators, 0] = self._ratio[:, joints] * value[:, joints]
            if others:
                bias[:, others[1], 1] = -value[:, others[0]]
        elif name == "velocity_gain":
            if motors:
                gain[:, motors[1], KD] = value[:, motors[0]] + self._rest["back_emf"][:, motors[0]]
            if others:
                bias[:, others[1], 2] = -value[:, others[0]]
        else:
            if motors:
                joints, k = motors
                gain[:, k, VMAX] = value[:, joints] * gain[:, k, RESISTANCE] / gain[:, k, MOTOR_CONSTANT]
            if self._bounded:
                joints, k = self._bounded
                most = value[:, joints]
                force[:, k, 0], force[:, k, 1] = -most, most


def as_slice(ids: Ints) -> Ints | slice:
    """Ids that follow each other as a slice, which reads and writes several times as fast."""
    first = int(ids[0])
    return slice(first, first + len(ids)) if np.array_equal(ids, first + np.arange(len(ids))) else ids


@functools.cache
def _fields() -> tuple[str, ...]:
    """Arrays of a model that may differ from simulation to simulation of a batch; others are options."""
    return tuple(name for name in sorted(MODEL_FIELDS) if hasattr(mujoco.MjModel, name))


def batch_of(plant: Plant, models: Sequence[mujoco.MjModel], copies: int, nthread: int = 0) -> tuple[Batch, Servos]:
    """`copies` simulations of each of `models` (variants of the plant's), the variants of each copy side by side."""
    base = copy.copy(models[0])
    base.opt.disableactuator |= 1 << TORQUE_OFF_GROUP
    batch = Batch(base, copies * len(models), nthread)
    for name in _fields() if len(models) > 1 else ():
        values = np.array([getattr(model, name) for model in models])
        if (values != values[0]).any():
            field = batch.expand(name)
            field[:] = np.tile(values.reshape(len(models), *field.shape[1:]), (copies, *[1] * (field.ndim - 1)))
    states = {name: batch.bind(name) for name in ("qpos", "qvel", "act", "ctrl", "qfrc_applied", "qfrc_bias")}
    fields = Fields(**states, **{name: batch.expand(name) for name in _READ})
    return batch, Servos(plant, base, fields)


def single(plant: Plant, model: mujoco.MjModel, data: mujoco.MjData) -> Servos:
    """One simulation; the laws write into `model` itself."""
    states = {name: getattr(data, name)[None] for name in ("qpos", "qvel", "act", "ctrl", "qfrc_applied", "qfrc_bias")}
    return Servos(plant, model, Fields(**states, **{name: getattr(model, name)[None] for name in _READ}))
