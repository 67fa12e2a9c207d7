"""The servos' control loops, motors and gears, all joints at once: the firmware at 1 kHz, the windings, the supply.

One call of `step` computes, from joint angles and speeds, the torque of every motor at its output shaft. Everything is
an array over the n servos, since a scalar loop would be ten times slower; what few servos have (profiles, modes other
than position, play in the gear) runs only where it occurs.

Electrics: I = (d·V − ke·ω)/R with the bridge's duty d, τ = kt·I. A bridge that is on brakes at duty 0; torque off opens
it. All servos hang on one supply with resistance Rs, so that V = V0 − Rs·(ΣI_standby + Σ d·I), solved exactly.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.robot.control_table import AMPERE_PER_COUNT
from openant_tools.robot.registers import PULSES_PER_TURN, PWM_FULL, RAD_S_PER_COUNT
from openant_tools.virtual.body import Body
from openant_tools.virtual.hands import Grip, grip_torque
from openant_tools.virtual.motor import MotorSettings
from openant_tools.virtual.profile import Trajectory, start_trajectory
from openant_tools.virtual.servo_power import Loop, Sensed
from openant_tools.virtual.servo_registers import (
    CURRENT_MODE,
    CURRENT_POSITION_MODE,
    EXTENDED_MODE,
    POSITION_MODE,
    PWM_MODE,
    VELOCITY_MODE,
)

__all__ = ["Drive", "Drives"]

Array = NDArray[np.float64]

PULSES_PER_RAD = PULSES_PER_TURN / (2 * math.pi)
#: share of the critical damping of the gear's teeth
GEAR_DAMPING = 0.25
#: (angular frequency of the stiffest spring) × (time step) stays below this, well inside what symplectic Euler bears
SPRING_STEP = 0.5
#: rad/s, below which a joint stands; encoder noise alone shakes it by less
REST_RAD_S = 5e-3
_NOISE_BLOCK = 4096
#: K over the room at which `case_air_k_w` holds, where the exchange with air is not linear
AIR_RISE_K = 30.0


class Drives:
    """Loops, motors and gears of n servos in front of a body.

    Args:
        motors: settings of each, in the order of the body's joints.
        sign, mount_rad: shaft angle = sign · joint angle + mount, (n,).
        seed: of encoder and current noise and of random delays.
    """

    def __init__(
        self, body: Body, motors: Sequence[MotorSettings], sign: Array, mount_rad: Array, *, seed: int = 0
    ) -> None:
        n = len(motors)
        self.body, self.motors, self.n = body, list(motors), n
        self.dt = body.settings.timestep_s
        self.time = 0.0
        #: s, until when the body's last state is carried on in a straight line; the world sets it
        self.now = 0.0
        self.sign, self.mount = sign.astype(float), mount_rad.astype(float)
        self._random = np.random.default_rng(seed)
        # state of the loops
        self.torque_on = np.zeros(n)
        self.goal = np.zeros(n)
        self.effective_goal = np.zeros(n)
        self.direction = np.ones(n)
        self.offset = np.zeros(n)
        self.p_gain, self.i_gain, self.d_gain = np.zeros(n), np.zeros(n), np.zeros(n)
        self.pwm_limit = np.full(n, float(PWM_FULL))
        self._error, self._sum, self._pwm = np.zeros(n), np.zeros(n), np.zeros(n)
        self._has_i = self._has_d = False
        self.loops: list[Loop] = [Loop() for _ in range(n)]
        self._special: list[int] = []
        self._velocity_sum = np.zeros(n)
        self._moves: dict[int, Trajectory] = {}
        self._queue: list[tuple[float, int, int, tuple[float, float, float, bool]]] = []
        self._count = 0
        #: counts what may set anything in motion
        self.touched = 0
        self._dropped_until = np.full(n, -1.0)
        #: joints that somebody has in hand
        self.grips: dict[int, Grip] = {}
        # what the sensors show
        self.duty, self.current = np.zeros(n), np.zeros(n)
        #: rad/s at the joint, as the firmware's filter gives it
        self._filtered_velocity, self._velocity_change = np.zeros(n), np.zeros(n)
        self.voltage = 12.0
        # the supply
        self.supply_v, self.supply_ohm, self.supply_a = 12.0, 0.0, 0.0
        self.lowest_voltage = 12.0
        #: 1 where the supply reaches a servo, 0 behind an open connector
        self.path: Array | None = None
        #: s below each servo's reset voltage, without a break
        self.starved_s, self.starving = np.zeros(n), False
        self.powered = np.ones(n)
        # heat, of winding and case
        self.ambient = 25.0
        self.winding, self.case = np.full(n, 25.0), np.full(n, 25.0)
        self._derating = np.zeros(n)
        #: W/K between cases, (n, n) symmetric, diagonal 0; None where none touch
        self.touching: Array | None = None
        #: servo → share of its answers in which the temperature is garbled
        self.garbled: dict[int, float] = {}
        self._garbling = np.random.default_rng(seed + 4211)
        self.configure()

    # ---- settings ----

    def configure(self) -> None:
        """Take the motors' settings anew, after any of them has changed."""
        m = self.motors

        def column(name: str) -> Array:
            return np.array([float(getattr(motor, name)) for motor in m])

        self.kt, self.ke, self._r_cold = column("kt"), column("ke"), column("resistance")
        self._back_per_v = self.ke * self.sign
        self.resistance = self._r_cold.copy()
        self.strength = column("strength")
        self._armature = column("armature")
        self._coulomb, self._viscous = column("coulomb_nm"), column("viscous")
        self._static = np.maximum(column("static_nm"), self._coulomb)
        self._stribeck_rad_s = column("stribeck_rad_s")
        self._bias, self._load_friction = column("friction_bias_nm"), column("load_friction")
        self._quadratic = column("viscous_quadratic")
        self._cogging, self._periods = column("cogging_nm"), column("cogging_periods")
        self._has_cogging = bool(self._cogging.any())
        self._torque_limit = column("torque_limit_nm")
        self._torque_limit[self._torque_limit == 0] = np.inf
        self._dead_zone = column("dead_zone_rad") / 2 * PULSES_PER_RAD
        self._has_dead_zone = bool(self._dead_zone.any())
        lag = column("lag_s")
        self._lag_share = np.where(lag > 0, 1 - np.exp(-self.dt / np.maximum(lag, 1e-9)), 1.0)
        self._slew = column("slew_rad_s") * PULSES_PER_RAD * self.dt
        self._slew[self._slew == 0] = np.inf
        self._velocity_share = 1 - np.exp(-self.dt / np.maximum(column("velocity_filter_s"), 1e-9))
        self._standby = column("standby_a")
        self._reset_v = column("reset_v")
        self._highest_reset_v = float(self._reset_v.max(initial=0.0))
        self._copper, self._magnet = column("copper_per_k"), column("magnet_per_k")
        self._winding_j_k, self._case_j_k = column("winding_j_k"), column("case_j_k")
        self._winding_case, self._case_air = column("winding_case_k_w"), column("case_air_k_w")
        sink, housing = column("heat_sink_k_w"), np.minimum(column("housing_k_w"), self._case_air)
        outside = self._case_air - housing
        with_sink = housing + outside * sink / np.maximum(outside + sink, 1e-9)
        self._case_air = np.where(sink > 0, with_sink, self._case_air)
        self._case_j_k = self._case_j_k + np.where(sink > 0, column("heat_sink_j_k"), 0.0)
        self._air_exponent = column("air_exponent")
        self._free_air = bool(self._air_exponent.any())
        self._derating_per_k, self._derating_s = column("derating_per_k"), column("derating_s")
        self._p_divisor, self._i_divisor, self._d_divisor = (
            column("p_divisor"), column("i_divisor"), column("d_divisor"),
        )  # fmt: skip
        self._stiffness_scale = column("stiffness_scale")
        # One period for all: the firmware of every X430 is of one family.
        self._every = max(1, round(m[0].control_period_s / self.dt)) if m else 1
        self._noise = column("encoder_noise_rad") * PULSES_PER_RAD
        self._current_noise = column("current_noise_a")
        self._noisy = bool(self._noise.any())
        self._shaft_gain = self.sign * PULSES_PER_RAD
        self._shaft_zero = self.mount * PULSES_PER_RAD
        self._fill_noise()
        self._varying_friction = bool(self._load_friction.any() or (self._static > self._coulomb).any())
        self._extra_torque = bool(self._bias.any() or self._quadratic.any() or self._cogging.any())
        self._limited = bool(np.isfinite(self._torque_limit).any())
        self._filtered_goal = bool((self._lag_share < 1).any() or np.isfinite(self._slew).any())
        self._derated = bool(self._derating_per_k.any())
        self._sensor_delay = column("sensor_delay_s")
        # Positions and velocities of the recent past, the newest last, where any answer is old.
        keep = round(float(self._sensor_delay.max(initial=0.0)) / self.dt) + 1
        self._past: deque[tuple[Array, Array]] | None = deque(maxlen=keep) if keep > 1 else None
        self.elastic = any(motor.elastic for motor in m)
        self._set_gear(column("backlash_rad"), column("gear_stiffness"))
        self._warm(0.0)
        for k, loop in enumerate(self.loops):
            self._take(k, loop)

    def _set_gear(self, backlash: Array, stiffness: Array) -> None:
        body = self.body
        if not self.elastic:
            body.set_gear(self._coulomb, self._viscous, self._armature)
            self._centre_braking()
            return
        # Every rotor is ours then; a gear without play of its own is a stiff spring.
        body.set_gear(np.zeros(self.n), np.zeros(self.n), np.zeros(self.n))
        inertia = np.maximum(body.link_inertia(), 1e-6)
        self._half_gap = backlash / 2
        self._gear_k = np.minimum(stiffness, np.minimum(inertia, self._armature) * (SPRING_STEP / self.dt) ** 2)
        self._gear_c = 2 * GEAR_DAMPING * np.sqrt(self._gear_k * inertia)
        if not hasattr(self, "rotor"):
            self.rotor, self.rotor_velocity = body.q.copy(), body.v.copy()

    def _centre_braking(self) -> None:
        """Let back-EMF and viscous friction brake by the mean of the speeds before and after a step.

        A step takes back-EMF at the speed before it and friction in the joint at the speed after it, which acts like b·dt/2
        of inertia less or more, b being the slope: several percent of a rotor's. (A + b·dt/2)·Δv/dt = τ − b·v is the mean.
        """
        braking = self.kt * self.strength * self.ke / self._r_cold * self.torque_on
        inertia = self._armature + self.dt / 2 * (braking - self._viscous)
        self.body.armature[:] = np.maximum(inertia, self._armature / 2)

    def _fill_noise(self) -> None:
        self._noise_rows = list(self._random.standard_normal((_NOISE_BLOCK, self.n)) * self._noise)
        self._noise_row = 0

    # ---- what the firmware does to its loop ----

    def set_loop(self, k: int, loop: Loop) -> None:
        self.touched += 1
        was = self.loops[k]
        if loop.torque and not was.torque:
            self._error[k] = self._sum[k] = self._velocity_sum[k] = 0.0
        self.loops[k] = loop
        self._take(k, loop)

    def _take(self, k: int, loop: Loop) -> None:
        self.torque_on[k] = float(loop.torque)
        if not self.elastic:
            self._centre_braking()
        self.direction[k], self.offset[k] = loop.direction, loop.offset
        self.p_gain[k] = loop.p_gain / self._p_divisor[k] * self._stiffness_scale[k]
        self.i_gain[k] = loop.i_gain / self._i_divisor[k]
        self.d_gain[k] = loop.d_gain / self._d_divisor[k]
        self.pwm_limit[k] = loop.pwm_limit
        self._has_i, self._has_d = bool(self.i_gain.any()), bool(self.d_gain.any())
        # What a step needs of all this, multiplied out.
        self._duty_per_count = self.torque_on * self.direction / PWM_FULL
        self._lowest_pwm = -self.pwm_limit
        self._turned = bool((self.direction != 1).any() or self.offset.any())
        plain = loop.mode in (POSITION_MODE, EXTENDED_MODE)
        feeds = loop.feedforward_velocity or loop.feedforward_acceleration
        self._special = [i for i in self._special if i != k]
        if not plain or feeds:
            self._special.append(k)

    def hold(self, k: int, pulses: float) -> None:
        self.touched += 1
        self._moves.pop(k, None)
        self._queue = [entry for entry in self._queue if entry[2] != k]
        heapq.heapify(self._queue)
        self.goal[k] = self.effective_goal[k] = pulses

    def set_goal(
        self, k: int, arrival: float, pulses: float, velocity: float, acceleration: float, time_based: bool
    ) -> None:
        """A goal that arrived at `arrival` (s); the loop's next turn after it and the motor's delay takes it up, unless
        it is lost. One that is in force already changes nothing."""
        motor = self.motors[k]
        if motor.dropout_fraction > 0 and self._lost(k, motor):
            return
        late = motor.action_delay_s
        if motor.jitter_s > 0:
            late = max(0.0, late + motor.jitter_s * float(self._random.standard_normal()))
        if pulses == self.goal[k] and k not in self._moves and all(entry[2] != k for entry in self._queue):
            return
        self.touched += 1
        self._count += 1
        heapq.heappush(self._queue, (arrival + late, self._count, k, (pulses, velocity, acceleration, time_based)))

    def _lost(self, k: int, motor: MotorSettings) -> bool:
        if self.time < self._dropped_until[k]:
            return True
        # Runs of random length up to the longest; on average their share of the time is the fraction.
        if motor.dropout_s <= 0:
            return bool(self._random.random() < motor.dropout_fraction)
        mean_run = motor.dropout_s / 2
        pause = mean_run * (1 - motor.dropout_fraction) / motor.dropout_fraction
        since = self.time - self._dropped_until[k]
        if self._dropped_until[k] < 0 or (since > 0 and self._random.random() < min(1.0, since / pause) * 0.5):
            self._dropped_until[k] = self.time + self._random.uniform(0.0, motor.dropout_s)
            return bool(self._dropped_until[k] > self.time)
        return False

    def _take_goals(self) -> None:
        while self._queue and self._queue[0][0] <= self.time + 1e-9:
            _, _, k, (pulses, velocity, acceleration, time_based) = heapq.heappop(self._queue)
            moving = self._moves.pop(k, None)
            speed = moving.velocity if moving else 0.0
            trajectory = start_trajectory(
                float(self.goal[k]), speed, pulses,
                velocity_count=velocity, acceleration_count=acceleration, time_based=time_based,
            )  # fmt: skip
            if trajectory is None:
                self.goal[k] = pulses
            else:
                self._moves[k] = trajectory

    @property
    def at_rest(self) -> bool:
        """Whether nothing moves and nothing is about to."""
        return (
            not self._moves
            and not self._queue
            and not self.grips
            and bool(np.abs(self.body.v).max(initial=0.0) < REST_RAD_S)
        )

    # ---- one step ----

    def step(self, count: int) -> None:
        """One time step: sense, control, torque, mechanics. `count` numbers the steps, for the loop's period."""
        body = self.body
        if self._queue:
            self._take_goals()
        if self._moves:
            for k, move in list(self._moves.items()):
                if not move.step(self.dt):
                    del self._moves[k]
                self.goal[k] = move.position
        if self._filtered_goal:
            change = (self.goal - self.effective_goal) * self._lag_share
            self.effective_goal += np.minimum(np.maximum(change, -self._slew), self._slew)
            goal = self.effective_goal
        else:
            goal = self.goal
        velocity = self.rotor_velocity if self.elastic else body.v
        if count % self._every == 0:
            self._control(goal)
        self.duty = d = self._pwm * self._duty_per_count
        back = self._back_per_v * velocity
        volts = self.supply_v
        if self.supply_ohm:
            over_r = d / self.resistance
            draw, push = float(over_r @ d), float(over_r @ back)
            volts = (volts - self.supply_ohm * (self.supply_a - push)) / (1 + self.supply_ohm * draw)
        self.voltage = volts
        if volts < self.lowest_voltage:
            self.lowest_voltage = volts
        current = d * volts
        if self.path is not None:
            current *= self.path
        current -= back
        current /= self.resistance
        current *= self.torque_on
        self.current = current
        change = np.subtract(velocity, self._filtered_velocity, out=self._velocity_change)
        change *= self._velocity_share
        self._filtered_velocity += change
        torque = self._joint_nm_per_a * current
        if self._limited:
            torque = np.minimum(np.maximum(torque, -self._torque_limit), self._torque_limit)
        if self._extra_torque:
            torque += self._extra()
        if self.elastic:
            self._step_rotors(torque)
        else:
            if self._varying_friction:
                body.frictionloss[:] = self._friction(body.v, torque)
            body.torque[:] = torque
        if self.grips:
            body.torque += grip_torque(self.grips, body.q, body.v, self.time)
        if self._past is not None:
            self._past.append((body.q.copy(), self._filtered_velocity * self.sign))
        body.step()
        self.time += self.dt

    def _control(self, goal: Array) -> None:
        pulses = self._shaft_gain * self.body.q
        pulses += self._shaft_zero
        if self._noisy:
            if self._noise_row == _NOISE_BLOCK:
                self._fill_noise()
            pulses += self._noise_rows[self._noise_row]
            self._noise_row += 1
        np.rint(pulses, out=pulses)
        if self._turned:
            pulses *= self.direction
            pulses += self.offset
        error = np.subtract(goal, pulses, out=pulses)
        if self._has_dead_zone:
            error = np.sign(error) * np.maximum(np.abs(error) - self._dead_zone, 0.0)
        pwm = self.p_gain * error
        if self._has_i:
            # The sum never asks for more than the limit: the firmware has to stop it somewhere.
            self._sum += error * self.torque_on
            room = self.pwm_limit / np.maximum(self.i_gain, 1e-12)
            self._sum = np.minimum(np.maximum(self._sum, -room), room)
            pwm += self.i_gain * self._sum
        if self._has_d:
            pwm += self.d_gain * (error - self._error)
        self._error = error
        for k in self._special:
            self._control_specially(k, pwm)
        np.maximum(pwm, self._lowest_pwm, out=pwm)
        np.minimum(pwm, self.pwm_limit, out=pwm)
        self._pwm = np.trunc(pwm, out=pwm)

    def _control_specially(self, k: int, pwm: Array) -> None:
        """Feed-forward, and the modes that are not position control."""
        loop = self.loops[k]
        move = self._moves.get(k)
        if loop.mode in (POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE) and move is not None:
            # Unpublished: the velocity's unit. Pulses per control period are taken, as the D gain sees them.
            pwm[k] += loop.feedforward_velocity / 4 * move.velocity * self._every * self.dt
        if loop.mode == PWM_MODE:
            pwm[k] = loop.goal_pwm
        elif loop.mode == VELOCITY_MODE:
            velocity = self.direction[k] * self.sign[k] * self._filtered_velocity[k] / RAD_S_PER_COUNT
            error = loop.goal_velocity - velocity
            self._velocity_sum[k] += error
            pwm[k] = loop.velocity_p_gain / 128 * error + loop.velocity_i_gain / 65536 * self._velocity_sum[k]
        elif loop.mode in (CURRENT_MODE, CURRENT_POSITION_MODE):
            # The bridge gives what drives this current against back-EMF.
            wanted = abs(loop.goal_current) * AMPERE_PER_COUNT
            shaft = self.sign[k] * (self.rotor_velocity if self.elastic else self.body.v)[k]
            back = self.direction[k] * self.ke[k] * shaft
            volts = max(self.voltage, 1.0)
            if loop.mode == CURRENT_MODE:
                drive = math.copysign(wanted, loop.goal_current)
                pwm[k] = (drive * self.resistance[k] + back) / volts * PWM_FULL
            else:
                low = (-wanted * self.resistance[k] + back) / volts * PWM_FULL
                high = (wanted * self.resistance[k] + back) / volts * PWM_FULL
                pwm[k] = min(max(pwm[k], low), high)

    def _friction(self, velocity: Array, torque: Array) -> Array:
        """(n,) N·m: f = c + (s − c)·exp(−(ω/ωs)²) + µ·|τ|."""
        fall = np.exp(-np.square(velocity / self._stribeck_rad_s))
        return self._coulomb + (self._static - self._coulomb) * fall + self._load_friction * np.abs(torque)

    def _extra(self) -> Array:
        v = self.rotor_velocity if self.elastic else self.body.v
        # Friction larger one way than the other is symmetric friction and a constant torque: p for ω > 0 and n for
        # ω < 0 are (p + n)/2 against the motion plus (n − p)/2 always.
        extra = -self._bias - self._quadratic * v * np.abs(v)
        if self._has_cogging:
            angle = (self.rotor if self.elastic else self.body.q) * self.sign + self.mount
            extra += self._cogging * np.sin(self._periods * angle)
        return extra

    def _step_rotors(self, torque: Array) -> None:
        """Rotors behind gears with play and spring; friction acts on the rotor, by a step that may stop it."""
        body, dt = self.body, self.dt
        twist = self.rotor - body.q
        squeeze = np.sign(twist) * np.maximum(np.abs(twist) - self._half_gap, 0.0)
        touching = squeeze != 0
        gear = self._gear_k * squeeze
        gear += self._gear_c * (self.rotor_velocity - body.v) * touching
        # Teeth push, they do not pull.
        gear = np.where(gear * squeeze > 0, gear, 0.0)
        body.torque[:] = gear
        friction = self._friction(self.rotor_velocity, gear) if self._varying_friction else self._coulomb
        velocity = self.rotor_velocity + dt * (torque - gear) / self._armature
        velocity /= 1 + dt * self._viscous / self._armature
        stop = dt * friction / self._armature
        self.rotor_velocity = np.sign(velocity) * np.maximum(np.abs(velocity) - stop, 0.0)
        self.rotor += dt * self.rotor_velocity

    # ---- slow things ----

    def heat(self, dt: float) -> None:
        """Warm winding and case over dt (s): two nodes each, explicit, dt far below their time constants."""
        loss = np.square(self.current) * self.resistance
        idle = self._standby * self.voltage * self.powered
        flow = (self.winding - self.case) / self._winding_case
        self.winding += dt * (loss - flow) / self._winding_j_k
        rise = self.case - self.ambient
        to_air = rise / self._case_air
        if self._free_air:
            to_air *= (np.abs(rise) / AIR_RISE_K) ** self._air_exponent
        gain = flow + idle - to_air
        if self.touching is not None:
            gain += self.touching @ self.case - self.touching.sum(axis=1) * self.case
        self.case += dt * gain / self._case_j_k
        self._warm(dt)

    def _warm(self, dt: float) -> None:
        rise = self.winding - 25.0
        self.resistance = self._r_cold * (1 + self._copper * rise)
        self.kt_warm = self.kt * (1 - self._magnet * rise)
        pull = self.kt_warm * self.strength
        if self._derated:
            share = np.where(self._derating_s > 0, 1 - np.exp(-dt / np.maximum(self._derating_s, 1e-9)), 1.0)
            self._derating += (self._derating_per_k * (self.case - 25.0) - self._derating) * share
            pull *= np.clip(1 - self._derating, 0.0, 1.0)
        self._joint_nm_per_a = pull * self.sign

    @property
    def joint_torque(self) -> Array:
        """(n,) N·m of the motors, at the joints."""
        torque: Array = np.clip(self._joint_nm_per_a * self.current, -self._torque_limit, self._torque_limit)
        return torque

    def set_path(self, path: Array) -> None:
        """Which servos the supply reaches, (n,) of 0 and 1."""
        path_now = None if path.all() else path
        self.touched += path_now is not None or self.path is not None
        self.path = path_now

    def voltage_at(self, k: int) -> float:
        """V at servo k."""
        return self.voltage if self.path is None else self.voltage * float(self.path[k])

    def watch_supply(self, dt: float) -> None:
        """Note how long each servo has been below its reset voltage, by the lowest since the last call."""
        self.supply_a = float(self._standby @ self.powered)
        if self.path is not None or self.lowest_voltage < self._highest_reset_v:
            low = self.lowest_voltage * (1.0 if self.path is None else self.path) < self._reset_v
            self.starved_s = np.where(low, self.starved_s + dt, 0.0)
            self.starving = bool(low.any())
        elif self.starving:
            self.starved_s, self.starving = np.zeros(self.n), False
        self.lowest_voltage = self.voltage

    def sense(self, k: int, time: float) -> Sensed:
        """What servo k's electronics measure at `time` (s), at most a step after the last one done."""
        ahead = time - self.time
        q, v = float(self.body.q[k]), float(self.body.v[k])
        velocity = float(self._filtered_velocity[k] * self.sign[k])
        if self._past and self._sensor_delay[k] > 0:
            old = max(0, len(self._past) - round(float(self._sensor_delay[k]) / self.dt))
            if old < len(self._past):
                q, velocity = float(self._past[old][0][k]), float(self._past[old][1][k])
                v = velocity * float(self.sign[k])
        pulses = float(self._shaft_gain[k]) * (q + v * ahead) + float(self._shaft_zero[k])
        if self._noisy:
            pulses += float(self._noise_rows[self._noise_row - 1][k])
        current = float(self.current[k]) + float(self._current_noise[k]) * float(self._random.standard_normal())
        move = self._moves.get(k)
        return Sensed(
            pulses=pulses,
            velocity=velocity,
            current=current,
            duty=float(self.duty[k]),
            voltage=self.voltage_at(k),
            temperature=self._reported_temperature(k),
            trajectory=float(self.goal[k]),
            trajectory_velocity=move.velocity if move else 0.0,
            profile_active=move is not None,
            profile_shape=move.shape if move else 0,
        )

    def _reported_temperature(self, k: int) -> float:
        """°C; a garbled answer has anything that fits into its byte."""
        if k in self.garbled and self._garbling.random() < self.garbled[k]:
            return float(self._garbling.integers(0, 256))
        return float(self.case[k])


class Drive:
    """One servo's view of the drives: the `Motor` of its firmware."""

    def __init__(self, drives: Drives, k: int) -> None:
        self._drives, self._k = drives, k

    def sense(self) -> Sensed:
        return self._drives.sense(self._k, max(self._drives.now, self._drives.time))

    def set_loop(self, loop: Loop) -> None:
        self._drives.set_loop(self._k, loop)

    def set_goal(self, pulses: float, *, velocity: float, acceleration: float, time_based: bool) -> None:
        arrival = max(self._drives.now, self._drives.time)
        self._drives.set_goal(self._k, arrival, pulses, velocity, acceleration, time_based)

    def hold(self, pulses: float) -> None:
        self._drives.hold(self._k, pulses)
