"""Many robots through one motion at once: own servo code around MuJoCo's mechanics, as the other side of the check.

One array step for all robots computes firmware (1 kHz, on the quantised encoder), windings and supply, and rotors behind
gears with play, spring and friction; then every robot's own model takes its step of half a millisecond.

Electrics: I = (d·V − ke·ω)/R, τ = kt·I, on a supply V = V₀ − Rs·ΣdI that all servos of a robot share. Friction is LuGre's on
the rotor (Canudas de Wit et al., IEEE TAC 40, 1995): F = σ₀z + σ₁ż with ż = v − σ₀|v|z/g(v), g = Fc + (Fs − Fc)·exp(−(v/vs)²) +
µ|τ_gear|, by an implicit step. The encoder is at the output; play is a contact between two inertias that only pushes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.blind.clockwork import Schedule, goals, schedule
from openant_tools.blind.commands import Motion
from openant_tools.blind.mechanics import STEP_S, build
from openant_tools.blind.robot import Servos, TrueRobot
from openant_tools.robot.joints import JOINTS, LEGS
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT_COUNTS
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE

__all__ = ["Trace", "simulate"]

Array = NDArray[np.float64]
Single = NDArray[np.float32]

SETTLE_S = {"stand": 0.5, "floor": 1.3}
#: control period in steps; heat every so many steps
LOOP_EVERY, HEAT_EVERY = 2, 40
#: s, time constant of the reported velocity
VELOCITY_FILTER_S = 0.005
#: heat of one servo: J/K of winding and case, K/W between them and to the air (orders of magnitude)
WINDING_J_K, CASE_J_K, WINDING_CASE_K_W, CASE_AIR_K_W = 8.0, 40.0, 5.0, 12.0
COPPER_PER_K = 0.0039
#: °C of the winding at which a data sheet's figures hold: a servo at work
WARM_C = 35.0
#: rad/s at which a horn slips
SLIP_RAD_S = 1.5


@dataclass(frozen=True)
class Trace:
    """What truly happened to one robot in one run, at every step: (steps, joints), body (steps, 6 or 7)."""

    plan: Schedule
    position: Single
    velocity: Single
    current: Single
    duty: Single
    volts: Single
    case_c: tuple[Array, Array]
    imu: Single
    base: Single | None


def simulate(robots: Sequence[TrueRobot], motion: Motion, number: int) -> list[Trace]:
    """Play one motion, the `number`-th of the session, on each of the robots."""
    chances = [np.random.default_rng([robot.seed, number]) for robot in robots]
    plans = [schedule(robot.clocks, motion, STEP_S, chance) for robot, chance in zip(robots, chances, strict=True)]
    steps = max(plan.steps for plan in plans)
    goal, on = np.empty((steps, len(robots), 8)), np.empty((steps, len(robots), 8))
    for b, (robot, plan) in enumerate(zip(robots, plans, strict=True)):
        found, torque = goals(plan, robot.clocks, motion, STEP_S)
        goal[: len(found), b], on[: len(found), b] = found, torque
        goal[len(found) :, b], on[len(found) :, b] = found[-1], torque[-1]
    bodies = _Bodies(robots, motion)
    drives = _Drives(robots, bodies, number)
    for k in range(round(SETTLE_S[motion.setup] / STEP_S)):
        bodies.step(drives.step(goal[0], on[0], k))
    start = drives.case.copy()
    position, velocity, current, duty = (np.empty((steps, len(robots), 8), np.float32) for _ in range(4))
    volts = np.empty((steps, len(robots)), np.float32)
    imu = np.empty((steps, len(robots), 6), np.float32)
    base = np.empty((steps, len(robots), 7), np.float32) if motion.setup == "floor" else None
    for k in range(steps):
        gear = drives.step(goal[k], on[k], k)
        position[k], velocity[k], current[k], duty[k] = drives.encoder, drives.filtered, drives.current, drives.duty
        volts[k] = drives.volts[:, 0]
        bodies.step(gear)
        bodies.look(imu[k], None if base is None else base[k])
    return [
        Trace(
            plans[b], position[:, b], velocity[:, b], current[:, b], duty[:, b], volts[:, b],
            (start[b], drives.case[b].copy()), imu[:, b], None if base is None else base[:, b],
        )
        for b in range(len(robots))
    ]  # fmt: skip


class _Bodies:
    """One model for each robot; `q` and `v` are (robots, joints)."""

    def __init__(self, robots: Sequence[TrueRobot], motion: Motion) -> None:
        self.floor = motion.setup == "floor"
        self.worlds = [build(robot.mechanics, motion.setup, motion.heading_rad) for robot in robots]
        self.q, self.v = np.empty((len(robots), 8)), np.empty((len(robots), 8))
        self._places = [_places(model) for model, _ in self.worlds]
        self._pulls = [
            _pull(robot, model) if self.floor else None for robot, (model, _) in zip(robots, self.worlds, strict=True)
        ]
        self._read()

    def _read(self) -> None:
        for b, (_, data) in enumerate(self.worlds):
            rows, dofs = self._places[b]
            self.q[b], self.v[b] = data.qpos[rows], data.qvel[dofs]

    def step(self, torque: Array) -> None:
        step = mujoco.mj_step
        for b, (model, data) in enumerate(self.worlds):
            pull = self._pulls[b]
            if pull is not None:
                pull(data)
            rows, dofs = self._places[b]
            data.qfrc_applied[dofs] = torque[b]
            step(model, data)
            self.q[b] = data.qpos[rows]
            self.v[b] = data.qvel[dofs]

    def look(self, imu: Single, base: Single | None) -> None:
        """Gyro and accelerometer come first among the sensors; the free joint first among the coordinates."""
        for b, (_, data) in enumerate(self.worlds):
            imu[b] = data.sensordata[:6]
            if base is not None:
                base[b] = data.qpos[:7]


def _places(model: mujoco.MjModel) -> tuple[Any, Any]:
    """Where the joints are among coordinates and velocities: a slice, which is a view, unless something lies between."""
    rows = np.array([model.joint(name).qposadr[0] for name in JOINTS])
    dofs = np.array([model.joint(name).dofadr[0] for name in JOINTS])
    if (np.diff(rows) == 1).all():
        return slice(rows[0], rows[0] + 8), slice(dofs[0], dofs[0] + 8)
    return rows, dofs


def _pull(robot: TrueRobot, model: mujoco.MjModel) -> Callable[[mujoco.MjData], None] | None:
    """What pulls at torso or feet on the floor, where anything does."""
    m = robot.mechanics
    if m.cable is None and not m.adhesion_n:
        return None
    torso = model.body("torso").id
    feet = {model.geom(f"lower_{leg.name}").id: model.body(f"lower_leg_{leg.name}").id for leg in LEGS}
    floor = model.geom("floor").id

    def pull(data: mujoco.MjData) -> None:
        if m.cable is not None:
            force, damping, stiffness, anchor = m.cable
            data.xfrc_applied[torso, :3] = force - damping * data.qvel[:3] - stiffness * (data.qpos[:3] - anchor)
        if m.adhesion_n:
            pairs, places = data.contact.geom, data.contact.pos
            on_floor = (pairs == floor).any(axis=1)
            for geom, body in feet.items():
                data.xfrc_applied[body] = 0.0
                mine = on_floor & (pairs == geom).any(axis=1)
                if mine.any():
                    # It sticks where it touches, which turns the leg about its own centre besides.
                    down = np.array([0.0, 0.0, -m.adhesion_n])
                    data.xfrc_applied[body, :3] = down
                    data.xfrc_applied[body, 3:] = np.cross(places[mine].mean(axis=0) - data.xipos[body], down)

    return pull


class _Drives:
    """Loops, motors and gears of all robots, (robots, joints) arrays."""

    def __init__(self, robots: Sequence[TrueRobot], bodies: _Bodies, number: int) -> None:
        def stack(name: str) -> Array:
            return np.stack([np.broadcast_to(getattr(robot.servos, name), (8,)) for robot in robots]).astype(float)

        columns: dict[str, Any] = {field.name: stack(field.name) for field in fields(Servos)}
        self.s = Servos(**columns)
        s, shape = self.s, (len(robots), 8)
        self.bodies = bodies
        self.supply_v, self.supply_ohm = s.supply_v[:, :1], s.supply_ohm[:, :1]  # type: ignore[index]
        self.volts = self.supply_v.copy()
        self.noise = np.array([[robot.senses.encoder_rad] for robot in robots])
        self.chances = [np.random.default_rng([robot.seed, number, 7]) for robot in robots]
        self.slip = np.zeros(shape)
        self.rotor, self.rate = bodies.q.copy(), np.zeros(shape)
        self.bristle, self.gear = np.zeros(shape), np.zeros(shape)
        self.filtered, self.current, self.duty = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self.pwm, self.sum = np.zeros(shape), np.zeros(shape)
        # Servos warm up over a session, each as it may.
        warm = np.array([[robot.ambient_c + 2 + robot.warming_k * number / 6] for robot in robots])
        spread = np.stack([np.random.default_rng([robot.seed, 3]).uniform(0.5, 1.5, 8) for robot in robots])
        ambient = np.array([[robot.ambient_c] for robot in robots])
        self.ambient = ambient
        self.case = ambient + (warm - ambient) * spread
        self.winding = self.case + 0.0
        self.loss = s.derating * (self.case - 25.0)
        level = s.static + s.positive + s.negative + s.load_friction
        self.sigma = level / s.bristle_rad
        self.sigma_dot = 0.6 * np.sqrt(self.sigma * s.rotor)
        self.has_load, self.has_bias = bool(s.load_friction.any()), bool((s.positive + s.negative).any())
        self.has_chips, self.has_slip = bool(s.chipped.any()), bool(np.isfinite(s.slip_nm).any())
        self.has_cogging, self.has_quadratic = bool(s.cogging.any()), bool(s.quadratic.any())
        self.has_fall, self.has_integral = bool(s.fall.any()), bool(s.i_gain.any())
        self.has_runout, self.has_dead = bool(s.runout.any()), bool(s.dead_zone.any())
        self.limited = bool(np.isfinite(s.torque_limit).any())
        self.dead = s.dead_zone / 2 / RAD_PER_PULSE
        self._noise: Array = np.zeros((0, *shape))
        self._noise_row = 0
        self._warm(0.0)
        self.encoder = self._sense()

    def _sense(self) -> Array:
        shaft = self.bodies.q + self.s.zero
        if self.has_slip:
            shaft = shaft + self.slip
        if self.has_runout:
            shaft = shaft + self.s.runout * np.sin(shaft + 0.7)
        return shaft

    def _warm(self, dt: float) -> None:
        s = self.s
        heat = np.square(self.current) * s.resistance
        flow = (self.winding - self.case) / WINDING_CASE_K_W
        self.winding += dt * (heat - flow) / WINDING_J_K
        self.case += dt * (flow + 0.5 - (self.case - self.ambient) / CASE_AIR_K_W) / CASE_J_K
        self.resistance = s.resistance * (1 + COPPER_PER_K * (self.winding - WARM_C))
        self.per_ohm = 1 / self.resistance
        share = np.where(s.derating_s > 0, 1 - np.exp(-dt / np.maximum(s.derating_s, 1e-9)), 1.0)
        self.loss += (s.derating * (self.case - 25.0) - self.loss) * share
        self.pull = s.kt * s.strength * np.clip(1 - self.loss, 0.0, 1.0)

    def _control(self, goal: Array) -> None:
        s = self.s
        if self._noise_row == len(self._noise):
            self._noise = np.stack([chance.standard_normal((1000, 8)) for chance in self.chances], axis=1) * self.noise
            self._noise_row = 0
        pulses = np.rint((self.encoder + self._noise[self._noise_row]) / RAD_PER_PULSE)
        self._noise_row += 1
        error = np.rint(goal / RAD_PER_PULSE) - pulses
        if self.has_dead:
            error = np.sign(error) * np.maximum(np.abs(error) - self.dead, 0.0)
        pwm = s.p_gain * error
        if self.has_integral:
            self.sum = np.clip(self.sum + s.i_gain * error, -PLATFORM_PWM_LIMIT_COUNTS, PLATFORM_PWM_LIMIT_COUNTS)
            pwm = pwm + self.sum
        self.pwm = np.trunc(np.clip(pwm, -PLATFORM_PWM_LIMIT_COUNTS, PLATFORM_PWM_LIMIT_COUNTS))

    def step(self, goal: Array, on: Array, k: int) -> Array:
        """(robots, joints) N·m that the gears give the joints."""
        s, dt, rate = self.s, STEP_S, self.rate
        self.encoder = self._sense()
        if k % LOOP_EVERY == 0:
            self._control(goal)
        if k % HEAT_EVERY == 0:
            self._warm(HEAT_EVERY * dt)
        duty = self.pwm * on * (1.0 / PWM_FULL)
        back = s.ke * rate
        over = duty * self.per_ohm
        draw, push = (over * duty).sum(1, keepdims=True), (over * back).sum(1, keepdims=True)
        self.volts = (self.supply_v + self.supply_ohm * push) / (1 + self.supply_ohm * draw)
        self.current = (duty * self.volts - back) * self.per_ohm * on
        torque = self.pull * self.current
        if self.limited:
            torque = np.clip(torque, -s.torque_limit, s.torque_limit)
        if self.has_fall:
            most = self.pull * 0.5 * self.supply_v * self.per_ohm * np.maximum(1 - np.abs(rate) * s.fall, 0.0)
            torque = np.where(torque * rate > 0, np.clip(torque, -most, most), torque)
        self.duty = duty
        shaft = self.bodies.q + self.slip if self.has_slip else self.bodies.q
        if self.has_cogging:
            torque = torque + s.cogging * np.sin(s.periods * self.rotor)
        if self.has_quadratic:
            torque = torque - s.quadratic * rate * np.abs(rate)
        gap = 0.5 * s.gap
        if self.has_chips:
            # Every quarter of a radian, over two hundredths, a tooth is missing: play, and a bump before it.
            phase = (self.rotor + 0.05) % 0.25
            gap = np.where((phase < 0.03) & (s.chipped > 0), 0.02, gap)
            torque = torque - np.where((phase > 0.03) & (phase < 0.05), s.chipped * np.sign(rate), 0.0)
        friction = self._friction(rate, dt)
        twist = self.rotor - shaft
        squeeze = np.sign(twist) * np.maximum(np.abs(twist) - gap, 0.0)
        gear = s.gear_stiffness * squeeze + s.gear_damping * (rate - self.bodies.v) * (squeeze != 0)
        gear = np.where(gear * squeeze > 0, gear, 0.0)
        self.gear = gear
        if self.has_slip:
            self.slip += np.where(np.abs(gear) > s.slip_nm, np.sign(gear) * SLIP_RAD_S * dt, 0.0)
        rate = (rate + dt / s.rotor * (torque - friction - gear)) / (1 + dt * s.viscous / s.rotor)
        self.rate = rate
        self.rotor = self.rotor + dt * rate
        self.filtered = self.filtered + (rate - self.filtered) * (dt / VELOCITY_FILTER_S)
        return gear

    def _friction(self, rate: Array, dt: float) -> Array:
        s = self.s
        level = s.coulomb + (s.static - s.coulomb) * np.exp(-np.square(rate / s.stribeck))
        if self.has_load:
            level = level + s.load_friction * np.abs(self.gear)
        if self.has_bias:
            level = level + np.where(rate > 0, s.positive, s.negative)
        bristle = (self.bristle + dt * rate) / (1 + dt * self.sigma * np.abs(rate) / np.maximum(level, 1e-6))
        friction = self.sigma * bristle + self.sigma_dot * (bristle - self.bristle) / dt
        self.bristle = bristle
        return friction
