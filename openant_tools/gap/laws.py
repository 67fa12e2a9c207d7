"""What acts between the steps of a simulated robot beside the effects of `openant_tools.effects`.

The laws here stand for effects that MuJoCo has features for. A written model uses those; simulations of many robots at once
cannot, because a hinge or a motor more would be another model, and so have them as laws. Both are compared in the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.step import Law, Step
from openant_tools.effects.thermal_derating import Heating
from openant_tools.gap.robot import Robot

__all__ = ["Fields", "Transmission", "back_emf", "first_laws", "last_laws"]

Array = NDArray[np.float64]

#: share of the stiffest spring that a step can integrate, for what is to be hard
HARD = 0.15
#: share of critical damping in a spring
DAMPED = 0.3
#: share of a servo's inertia that turns with its output, behind play or spring; next to none where a hinge stands for them
OUTPUT, BARE = 0.1, 1e-3
#: N·m/rad of teeth, and N·m from which more torque bends them no further as a simulation begins
TEETH, HELD = 200.0, 0.5
#: numbers that only must not be zero
TINY = 1e-9


@dataclass(frozen=True)
class Fields:
    """Live model fields of the simulations, (n, joints): what a servo's rotor brings to its joint.

    Attributes:
        armature, damping, friction: kg·m², N·m·s/rad, N·m. link: kg·m², inertia of the joint's links without the rotor.
        damp: gives the joints another damping, (n, joints) N·m·s/rad, from the step on that comes.
    """

    armature: Array
    damping: Array
    friction: Array
    link: Array
    damp: Callable[[Array], None]


def first_laws(robots: Sequence[Robot], generated: Array, heat_c: Array, asked: Array) -> list[Law]:
    """The laws on what the servo is asked and may give.

    Args:
        generated: what `back_emf` says of them.
        heat_c: (robots, joints) °C, how warm servos are as the simulation begins.
        asked: (robots, joints) rad, where a setpoint of limited rate is as the simulation begins; NaN: where it is asked to be.
    """
    laws: list[Law] = []
    slew, no_load = _table(robots, "slew"), _table(robots, "no_load")
    derating = _table(robots, "derating")
    if np.isfinite(slew).any():
        laws.append(_slewing(slew, asked))
    steps = np.array([[robot.form.encoder_rad if robot.form else 0.0] for robot in robots])
    if steps.any():
        laws.append(_rounding(steps, _table(robots, "zero")))
    if derating.any():
        seconds = np.array([[robot.derating_s] for robot in robots])
        laws.append(Heating({"loss_per_c": derating, "time_constant_s": seconds}, heat_c))
    if np.isfinite(no_load).any():
        laws.append(_fading(no_load))
    if generated.any():
        laws.append(_generating(generated))
    return laws


def last_laws(robots: Sequence[Robot], generated: Array, fields: Fields) -> list[Law]:
    """The laws on what reaches the link."""
    laws: list[Law] = []
    if generated.any():
        laws.append(_braking(generated))
    low, high = _table(robots, "stop_low"), _table(robots, "stop_high")
    if np.isfinite(low).any() or np.isfinite(high).any():
        # What stops behind play or a spring is the link alone.
        behind = (_table(robots, "play") > 0) | (_table(robots, "compliance") > 0)
        laws.append(_stopping(low, high, np.where(behind, fields.link, fields.armature + fields.link)))
    smooth = np.array([[robot.form.smooth_friction if robot.form else 0.0] for robot in robots])
    if smooth.any():
        laws.append(_smoothing(smooth))
    bristle = np.array([[robot.form.bristle if robot.form else 0.0] for robot in robots])
    if bristle.any():
        laws.append(_bending(bristle, fields.armature + fields.link))
    play, compliance = _table(robots, "play"), _table(robots, "compliance")
    if play.any() or compliance.any():
        before = np.array([[robot.form is not None and not robot.form.loop_behind] for robot in robots])
        laws.append(Transmission(play, compliance, fields, before))
    return laws


def back_emf(robots: Sequence[Robot], fields: Fields) -> Array:
    """(robots, joints) N·m·s/rad of what was damping in the joints and is back-EMF."""
    electrical = _table(robots, "electrical")
    slope: Array = electrical * fields.damping / np.maximum(1 - electrical, TINY)
    return slope


def _table(robots: Sequence[Robot], name: str) -> Array:
    return np.array([getattr(robot, name) for robot in robots])


def _slewing(rate: Array, begun: Array) -> Law:
    at: list[Array] = []

    def act(step: Step) -> None:
        if not at:
            at.append(np.where(np.isnan(begun), step.setpoint, begun))
        at[0] += np.clip(step.setpoint - at[0], -rate * step.dt, rate * step.dt)
        step.setpoint = at[0].copy()

    return act


def _rounding(steps: Array, zero: Array) -> Law:
    """The loop sees its joint in the encoder's steps; what it then asks for is a setpoint that is off by as much."""
    size = np.maximum(steps, TINY)

    def act(step: Step) -> None:
        read = step.position + zero
        step.setpoint = step.setpoint + np.where(steps > 0, read - np.round(read / size) * size, 0.0)

    return act


def _fading(no_load: Array) -> Law:
    def act(step: Step) -> None:
        along = step.motor_torque * step.velocity > 0
        left = np.clip(1 - np.abs(step.velocity) / no_load, TINY, 1.0)
        step.limit *= np.where(along, left, 1.0)

    return act


def _generating(slope: Array) -> Law:
    """What follows from a motor's torque follows from what its back-EMF leaves."""

    def act(step: Step) -> None:
        step.back_emf = step.back_emf + slope

    return act


def _braking(slope: Array) -> Law:
    """Models of many robots at once have no back-EMF to be changed: it acts as a torque beside the servo's."""

    def act(step: Step) -> None:
        step.back_emf = step.back_emf - slope
        step.torque -= np.where(step.on, slope * step.velocity, 0.0)

    return act


def _stopping(low: Array, high: Array, inertia: Array) -> Law:
    def act(step: Step) -> None:
        spring, damper = HARD * inertia / step.dt**2, HARD * inertia / step.dt
        beyond = np.maximum(step.position - high, 0.0) + np.minimum(step.position - low, 0.0)
        step.torque -= np.where(beyond != 0, spring * beyond + damper * step.velocity, 0.0)

    return act


def _smoothing(reach: Array) -> Law:
    def act(step: Step) -> None:
        smooth = reach > 0
        step.torque -= np.where(smooth, step.friction * np.tanh(step.velocity / np.maximum(reach, TINY)), 0.0)
        step.friction = np.where(smooth, 0.0, step.friction)

    return act


def _bending(bristle: Array, inertia: Array) -> Law:
    """LuGre's friction (Canudas de Wit 1995): z' = v − |v| σ₀ z / level, torque σ₀ z + σ₁ z', z taken implicitly."""
    mine = np.broadcast_to(bristle > 0, inertia.shape)
    bent: list[Array] = []

    def act(step: Step) -> None:
        level = np.maximum(step.friction, TINY)
        stiff = np.minimum(level / np.maximum(bristle, TINY), HARD * inertia / step.dt**2)
        if not bent:
            # At rest the bristles hold what the motor and gravity push.
            bent.append(np.clip(step.motor_torque - step.load, -level, level) / stiff)
        moved = (bent[0] + step.dt * step.velocity) / (1 + step.dt * stiff * np.abs(step.velocity) / level)
        damper = 2 * DAMPED * np.sqrt(stiff * inertia) * (moved - bent[0]) / step.dt
        step.torque -= np.where(mine, stiff * moved + damper, 0.0)
        bent[0] = moved
        step.friction = np.where(mine, 0.0, step.friction)

    return act


class Transmission:
    """A rotor behind play or a spring; the servo's loop closes over both, as the encoder sits on the output, or `before` them.

    The rotor is integrated here, the link by MuJoCo. Both take what passes between them implicitly, as teeth are far too stiff
    for steps that long: a spring k that is seen where it will be at the step's end is a spring and a damper k·dt.

    Args:
        play: (robots, joints) rad. compliance: the same in rad per N·m. before: (robots, 1).
    """

    def __init__(self, play: Array, compliance: Array, fields: Fields, before: NDArray[np.bool_]) -> None:
        self._mine, self._before, self._fields = (play > 0) | (compliance > 0), before, fields
        output = np.where(self._mine, np.where(before, BARE, OUTPUT), 1.0)
        self._rotor = np.where(self._mine, (1 - output) * fields.armature, 1.0)
        self._damping = np.where(self._mine, fields.damping, 0.0)
        fields.armature[:] *= output
        fields.damping[self._mine] = 0.0
        self._spring = np.where(compliance > 0, 1 / np.maximum(compliance, 1 / TEETH), TEETH)
        inertia = np.minimum(fields.link + fields.armature, self._rotor)
        self._damper = 2 * DAMPED * np.sqrt(self._spring * inertia)
        self._half = play / 2
        self._angle: Array | None = None
        self._speed, self._link_speed = np.zeros(play.shape), np.zeros(play.shape)

    def carry(self, position: Array, velocity: Array, load: Array) -> None:
        """Put rotors where they carry a load.

        Args:
            position, velocity: (robots, joints) rad and rad/s of the links. load: N·m that these get.
        """
        held = np.clip(load, -HELD, HELD)
        self._angle = position + np.where(self._mine, self._half * np.sign(held) + held / self._spring, 0.0)
        self._speed, self._link_speed = velocity.copy(), velocity.copy()

    def __call__(self, step: Step) -> None:
        h, mine, half, spring, rotor = step.dt, self._mine, self._half, self._spring, self._rotor
        if self._angle is None:
            # At rest the teeth that carry the load are the ones that touch.
            self.carry(step.position, step.velocity, step.motor_torque)
        assert self._angle is not None
        angle, speed, position, velocity = self._angle, self._speed, step.position, step.velocity
        step.position, step.velocity = np.where(self._before, angle, position), np.where(self._before, speed, velocity)
        driven = step.motor_torque + step.torque
        step.position, step.velocity = position, velocity
        # The link goes on as it did: what it gets and what the rotor loses are then the same to the second order.
        going = 2 * velocity - self._link_speed
        self._link_speed = velocity.copy()
        velocity = going
        twist = angle - position
        ahead = twist + h * (speed - velocity)
        side = np.where(half > 0, np.sign(ahead), 1.0)
        touching = (np.abs(ahead) > half) | (half == 0)
        for _ in range(2):
            k, c = np.where(touching, spring, 0.0), np.where(touching, self._damper, 0.0)
            heavy = rotor + h * (self._damping + c + h * k)
            faster = (rotor * speed + h * (driven - k * (twist - h * velocity - side * half) + c * velocity)) / heavy
            slowed = np.sign(faster) * np.maximum(np.abs(faster) - h * step.friction / heavy, 0.0)
            pushed = k * (twist + h * (slowed - velocity) - side * half) + c * (slowed - velocity)
            # Teeth push and never pull.
            touching &= (half == 0) | (pushed * side > 0)
        self._speed = np.where(mine, slowed, step.velocity)
        self._angle = np.where(mine, angle + h * self._speed, position)
        passed = k * (self._angle - position - side * half) + c * self._speed
        step.torque = np.where(mine, passed, step.torque)
        self._fields.damp(np.where(mine, c + h * k, self._fields.damping))
        step.friction = np.where(mine, 0.0, step.friction)
        step.stiffness = np.where(mine, TINY, step.stiffness)
        step.velocity_gain = np.where(mine, TINY, step.velocity_gain)
