"""Servo loops, motors, gears and friction of one robot, (n,) arrays, SI at the output.

A loop of its own period compares the goal with the quantised encoder: u = clip(k·e/limit, ±1), and the motor gives
τ = limit·u·V/V₀ − d_e·ω. Friction is LuGre's (σ₀z + σ₁ż) or a regularised Coulomb law, F·tanh(v/v₀). The motor's inertia is
the joint's (Drake adds it to the body) or turns behind a spring with play, integrated here.
"""

from __future__ import annotations

import math

import numpy as np
from answer import Answer, Effect
from machine import Machine

__all__ = ["COUNT_RAD", "Drives"]

COUNT_RAD = 2 * math.pi / 4096
#: of the catalogue: stiffness and limit, damping, friction (N·m), zero
STIFFNESS, DAMPING, FRICTION_NM, ZERO_RAD = 0.15, 0.25, 0.02, math.radians(0.5)
#: data sheets at 12 V: N·m and A at stall
STALL = {"hip": (1.9, 1.4), "knee": (4.1, 2.3)}
HEAT_S = 0.05


class Drives:
    """What turns goals into torques at the joints."""

    def __init__(self, machine: Machine, answer: Answer, armature: np.ndarray, dt: float, chance: np.random.Generator):
        n = len(machine.joints)
        self.n, self.dt = n, dt
        servos = [machine.servos[kind] for kind in machine.kinds]

        def scattered(values: list[float], tolerance: float) -> np.ndarray:
            part = float(chance.uniform(0.2, 0.8))
            off = part * chance.uniform(-1, 1) + (1 - part) * chance.uniform(-1, 1, n)
            return np.array(values) * (1 + tolerance * off)

        self.limit = scattered([s.limit for s in servos], 0.7 * STIFFNESS)
        # Stiffness is what a count of error gives; the limit scatters by itself.
        self.stiffness = scattered([s.stiffness for s in servos], 0.9 * STIFFNESS)
        damping = scattered([s.damping for s in servos], 0.9 * DAMPING)
        share = float(chance.uniform(0.0, 0.15))
        self.braking, self.viscous = share * damping, (1 - share) * damping
        friction = scattered([s.friction for s in servos], 0.0) + 0.8 * FRICTION_NM * chance.uniform(-1, 1, n)
        self.kinetic = np.stack([friction, friction])  # towards minus and plus
        self.static_share = float(chance.uniform(1.0, 1.15))
        self.breakaway = self.kinetic.max(0) * (self.static_share - 1)
        self.stribeck = np.full(n, float(chance.uniform(0.03, 0.15)))
        self.by_load, self.quadratic = np.zeros(n), np.zeros(n)
        self.zero = 0.9 * ZERO_RAD * chance.uniform(-1, 1, n)
        self.supply_v, self.ohm = 12.0 * float(chance.uniform(0.99, 1.01)), float(chance.uniform(0.0, 0.05))
        self.kt = np.array([STALL[kind][0] / STALL[kind][1] for kind in machine.kinds])
        self.strength = np.ones(n)
        self.cap, self.fall = np.full(n, np.inf), np.zeros(n)
        self.dead, self.cogging, self.periods = np.zeros(n), np.zeros(n), np.ones(n)
        self.phase = chance.uniform(0, 2 * math.pi, n)
        self.derating, self.derating_s = np.zeros(n), np.zeros(n)
        self.every = max(1, round(float(chance.choice([1e-3, 1.25e-3, 2e-3, 2.5e-3])) / dt))
        self.encoder_rad = float(chance.uniform(5e-5, 5e-4))
        self.lugre = bool(chance.random() < 0.65)
        self.bristle_rad = float(np.exp(chance.uniform(math.log(3e-4), math.log(2e-3))))
        self.creep = float(np.exp(chance.uniform(math.log(3e-3), math.log(1.5e-2))))
        self.ambient = float(chance.uniform(18, 28))
        self.case = self.ambient + chance.uniform(3, 25) * chance.uniform(0.6, 1.4, n)
        self.winding = self.case.copy()
        # Faults that the catalogue has no name for.
        self.soft, self.integral, self.runout = np.zeros(n), np.zeros(n), np.zeros(n)
        self.slips, self.chipped, self.hysteresis = np.full(n, np.inf), np.zeros(n), np.zeros(n)
        self.gear, self.play = chance.uniform(300.0, 900.0, n), chance.uniform(0.0, 8e-4, n)
        behind = bool(chance.random() < 0.3)
        for effect in answer.effects:
            behind |= effect.name in ("backlash", "joint_compliance")
            self._apply(machine.at(effect.joints), effect)
        if answer.outside:
            self._apply_outside(machine, answer)
        #: kg·m², of what turns with the joint and of the motor, where a spring lies between
        self.behind = behind
        share = float(
            chance.uniform(0.08, 0.25)
        )  # drawn either way: a healthy robot and an ill one differ in nothing else
        at_joint = share if behind else 1.0
        self.at_joint, self.rotor = at_joint * armature, (1 - at_joint) * armature
        self.inertia = np.maximum(self.rotor, self.at_joint)
        self.gear_damping = 2 * float(chance.uniform(0.1, 0.4)) * np.sqrt(self.gear * self.at_joint)
        self.derated = np.clip(self.derating * (self.case - 25.0), 0, 0.95)
        self.chance = chance
        # What most robots have not costs them nothing.
        self.capped, self.falls = bool(np.isfinite(self.cap).any()), bool(self.fall.any())
        self.derates, self.springs, self.loose = (
            bool(self.derating.any()),
            bool(self.hysteresis.any()),
            bool(np.isfinite(self.slips).any()),
        )
        self.uneven = bool(self.cogging.any() or self.quadratic.any() or self.chipped.any())
        self.off_axis = bool(self.runout.any())
        self.loads = bool(self.by_load.any())
        self.heats_every, self.follows = max(1, round(HEAT_S / dt)), 1 - math.exp(-dt / 2e-3)
        self.start(np.zeros(n))

    def _apply(self, at: np.ndarray, effect: Effect) -> None:
        p = effect.parameters
        match effect.name:
            case "stiffness_error":
                self.stiffness[at] *= p["scale"]
            case "damping_error":
                self.viscous[at] *= p["scale"]
                self.braking[at] *= p["scale"]
            case "electrical_damping":
                whole = self.viscous[at] + self.braking[at]
                self.braking[at], self.viscous[at] = p["share"] * whole, (1 - p["share"]) * whole
            case "weak_joint":
                self.strength[at] = p["scale"]
            case "coulomb_friction":
                self.kinetic[:, at] = p["torque_nm"]
                self.breakaway[at] = p["torque_nm"] * (self.static_share - 1)
            case "stribeck_friction":
                self.kinetic[:, at] = p["coulomb_nm"]
                self.breakaway[at], self.stribeck[at] = p["static_nm"] - p["coulomb_nm"], p["velocity_rad_s"]
            case "asymmetric_friction":
                self.kinetic[0, at], self.kinetic[1, at] = p["negative_nm"], p["positive_nm"]
            case "load_friction":
                self.by_load[at] = p["coefficient"]
            case "viscous_nonlinear":
                self.quadratic[at] = p["coefficients"]
            case "torque_limit":
                self.cap[at] = p["torque_nm"]
            case "speed_limit":
                self.fall[at] = 1 / p["no_load_rad_s"]
            case "voltage_sag":
                self.ohm = p["resistance_ohm"]
            case "thermal_derating":
                self.derating[at], self.derating_s[at] = p["loss_per_c"], p["time_constant_s"]
            case "backlash":
                self.play[at] = p["gap_rad"]
            case "joint_compliance":
                self.gear[at] = p["stiffness_nm_rad"]
            case "cogging":
                self.cogging[at], self.periods[at] = p["amplitude_nm"], p["periods"]
            case "dead_zone":
                self.dead[at] = p["width_rad"] / 2
            case "zero_offset":
                self.zero[at] += p["angle_rad"]
            case _:
                pass  # of bodies, clocks or sensors

    def _apply_outside(self, machine: Machine, answer: Answer) -> None:
        at, strength = machine.at((str(answer.parameters["joint"]),)), float(answer.parameters["strength"])
        match answer.outside:
            case "soft_gain":
                self.soft[:] = min(0.75, 0.5 * strength)
            case "spring_hysteresis":
                self.hysteresis[at] = 0.3 * strength
            case "slipping_horn":
                self.slips[at] = np.where(np.array(machine.kinds)[at] == "hip", 0.10, 0.16) / strength
            case "chipped_tooth":
                self.chipped[at] = 0.8 * strength
            case "forgotten_integral":
                self.integral[:] = 4.0 * strength
            case "eccentric_encoder":
                self.runout[at] = 0.12 * strength
            case _:
                pass

    def start(self, q: np.ndarray) -> None:
        """At rest at these joint angles."""
        n = self.n
        self.turned, self.rate = q.copy(), np.zeros(n)
        self.z, self.spring, self.sum, self.slipped = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        self.volts, self.u = self.supply_v, np.zeros(n)
        self.load, self.current = np.zeros(n), np.zeros(n)
        self.encoder = q + self.zero
        self.k = 0
        self.noise = np.zeros((0, n))

    def step(self, goal: np.ndarray, on: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """(n,) N·m at the joints; afterwards `current`, `volts`, `u` and `encoder` are what sensors can see."""
        dt = self.dt
        self.encoder = q + self.zero + self.slipped
        if self.off_axis:
            self.encoder = self.encoder + self.runout * np.sin(q + 0.7)
        if self.k % self.every == 0:
            self._control(goal)
        if self.k % self.heats_every == 0:
            self._heat()
        self.k += 1
        turned, rate = (self.turned, self.rate) if self.behind else (q, v)
        u = self.u * on
        electric = self.limit * u * (self.volts / 12.0) - self.braking * rate * on
        drawn = electric / self.kt
        # The supply follows in 2 ms. A full u is half the duty, and draws half of what flows in the winding.
        self.volts += (self.supply_v - 0.5 * self.ohm * float(u @ drawn) - self.volts) * self.follows
        if self.capped:
            electric = np.minimum(np.maximum(electric, -self.cap), self.cap)
        self.current = electric / self.kt
        torque = electric * self.strength
        if self.derates:
            torque = torque * (1 - self.derated)
        if self.falls:
            most = self.limit * np.maximum(0.0, 1 - np.abs(rate) * self.fall)
            torque = np.where(torque * rate > 0, np.minimum(np.maximum(torque, -most), most), torque)
        inner = torque - self._friction(rate)
        if self.uneven:
            inner = inner + self.cogging * np.sin(self.periods * turned + self.phase)
            inner = inner - self.quadratic * rate * np.abs(rate) - self._bumps(turned, rate)
        if not self.behind:
            # Drake has the viscous part, implicitly.
            self.load = torque
            out = inner
        else:
            twist = turned - q
            squeezed = np.sign(twist) * np.maximum(np.abs(twist) - self.play / 2, 0.0)
            out = self.gear * squeezed + self.gear_damping * (rate - v) * (squeezed != 0)
            out = np.where(out * squeezed > 0, out, 0.0)
            self.rate = (rate + dt / self.rotor * (inner - out)) / (1 + dt * self.viscous / self.rotor)
            self.turned = turned + dt * self.rate
            self.load = out
        if self.springs:
            out = out - self._hysteretic(q, v)
        if self.loose:
            self.slipped = self.slipped + np.where(np.abs(out) > self.slips, np.sign(out) * dt, 0.0)
        return out

    def _control(self, goal: np.ndarray) -> None:
        if not len(self.noise):
            self.noise = self.chance.standard_normal((512, self.n)) * self.encoder_rad
        row, self.noise = self.noise[0], self.noise[1:]
        error = (np.rint(goal / COUNT_RAD) - np.rint((self.encoder + row) / COUNT_RAD)) * COUNT_RAD
        error = np.sign(error) * np.maximum(np.abs(error) - self.dead, 0.0)
        # A gain that depends on the angle: soft in the middle of the range.
        gain = self.stiffness * (1 - self.soft * np.exp(-np.square((goal + 0.3) / 0.5)))
        if self.integral.any():
            self.sum = np.clip(self.sum + self.integral * error * self.dt * self.every, -0.2, 0.2)
            error = error + self.sum
        self.u = np.clip(gain * error / self.limit, -1.0, 1.0)

    def _heat(self) -> None:
        copper = np.square(self.current) * 3.0
        flow = (self.winding - self.case) / 4.0
        self.winding = self.winding + HEAT_S * (copper - flow) / 6.0
        self.case = self.case + HEAT_S * (flow - (self.case - self.ambient) / 15.0) / 50.0
        target = np.clip(self.derating * (self.case - 25.0), 0, 0.95)
        self.derated = self.derated + (target - self.derated) * (
            1 - np.exp(-HEAT_S / np.maximum(self.derating_s, 1e-3))
        )

    def _bumps(self, turned: np.ndarray, rate: np.ndarray) -> np.ndarray:
        phase = (turned + 0.07) % 0.25
        return np.where(phase < 0.035, self.chipped * np.tanh(rate / 0.05), 0.0)

    def _friction(self, rate: np.ndarray) -> np.ndarray:
        dt = self.dt
        level = np.where(rate < 0, self.kinetic[0], self.kinetic[1]) + self.breakaway * np.exp(
            -np.square(rate / self.stribeck)
        )
        if self.loads:
            level = level + self.by_load * np.abs(self.load)
        if not self.lugre:
            # As steep as the step allows: friction must not turn the motion round.
            slope = np.maximum(self.creep, level * dt / (0.6 * self.inertia))
            return level * np.tanh(rate / slope)
        sigma = level / self.bristle_rad
        z = (self.z + dt * rate) / (1 + dt * np.abs(rate) / self.bristle_rad)
        bent = 0.5 * np.sqrt(sigma * self.inertia) * (z - self.z) / dt
        self.z = z
        return sigma * z + bent

    def _hysteretic(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Bouc and Wen's: a spring that gives back less than it takes."""
        self.spring = self.spring + self.dt * (v - np.abs(v) * self.spring / 0.15)
        return self.hysteresis * (1.5 * q + self.spring / 0.15)
