"""What acts between the steps of a simulated robot beside the laws that `[[effect]]` entries name: in which order it acts.

It stands for effects that MuJoCo has features for. A written model uses those; simulations of many robots at once cannot, because
a hinge or a motor more would be another model, and so have laws. Those of the effects stand with them; here are those of the
simulation's numerical form. Both are compared in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.blocked_joint import stopping
from openant_tools.effects.electrical_damping import braking, generating
from openant_tools.effects.robot import Robot
from openant_tools.effects.slew_limit import slewing
from openant_tools.effects.speed_limit import fading
from openant_tools.effects.step import DAMPED, HARD, TINY, Law, Step
from openant_tools.effects.thermal_derating import Heating
from openant_tools.effects.transmission import Fields, Transmission
from openant_tools.model.rollout import VELOCITY_SPAN_S

__all__ = ["Fields", "Transmission", "back_emf", "first_laws", "last_laws"]

Array = NDArray[np.float64]


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
        laws.append(slewing(slew, asked))
    steps = np.array([[robot.form.encoder_rad if robot.form else 0.0] for robot in robots])
    if steps.any():
        laws.append(_rounding(steps, _table(robots, "zero")))
    if derating.any():
        seconds = np.array([[robot.derating_s] for robot in robots])
        laws.append(Heating({"loss_per_c": derating, "time_constant_s": seconds}, heat_c))
    if np.isfinite(no_load).any():
        laws.append(fading(no_load))
    if generated.any():
        laws.append(generating(generated))
    return laws


def last_laws(robots: Sequence[Robot], generated: Array, fields: Fields) -> list[Law]:
    """The laws on what reaches the link."""
    laws: list[Law] = []
    if generated.any():
        laws.append(braking(generated))
    low, high = _table(robots, "stop_low"), _table(robots, "stop_high")
    if np.isfinite(low).any() or np.isfinite(high).any():
        # What stops behind play or a spring is the link alone.
        behind = (_table(robots, "play") > 0) | (_table(robots, "compliance") > 0)
        laws.append(stopping(low, high, np.where(behind, fields.link, fields.armature + fields.link)))
    smooth = np.array([[robot.form.smooth_friction if robot.form else 0.0] for robot in robots])
    if smooth.any():
        laws.append(_smoothing(smooth))
    bristle = np.array([[robot.form.bristle if robot.form else 0.0] for robot in robots])

    def rubbing(inertia: Array) -> Law | None:
        return _bending(bristle, inertia) if bristle.any() else None

    play, compliance = _table(robots, "play"), _table(robots, "compliance")
    if play.any() or compliance.any():
        before = np.array([[robot.form is not None and not robot.form.loop_behind] for robot in robots])
        laws.append(Transmission(play, compliance, fields, before, rubbing))
    elif (bending := rubbing(fields.armature + fields.link)) is not None:
        laws.append(bending)
    return laws


def back_emf(robots: Sequence[Robot], fields: Fields) -> Array:
    """(robots, joints) N·m·s/rad of what was damping in the joints and is back-EMF."""
    electrical = _table(robots, "electrical")
    slope: Array = electrical * fields.damping / np.maximum(1 - electrical, TINY)
    return slope


def _table(robots: Sequence[Robot], name: str) -> Array:
    return np.array([getattr(robot, name) for robot in robots])


def _rounding(steps: Array, zero: Array) -> Law:
    """The loop sees its joint in the encoder's steps; what it then asks for is a setpoint that is off by as much."""
    size = np.maximum(steps, TINY)

    def act(step: Step) -> None:
        read = step.position + zero
        step.setpoint = step.setpoint + np.where(steps > 0, read - np.round(read / size) * size, 0.0)

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
            # At rest the bristles hold what the motor and gravity push; sliding they are bent all the way.
            held = np.clip(step.motor_torque - step.load, -level, level)
            slides = np.abs(step.velocity) * VELOCITY_SPAN_S > level / stiff
            bent.append(np.where(slides, np.sign(step.velocity) * level, held) / stiff)
        moved = (bent[0] + step.dt * step.velocity) / (1 + step.dt * stiff * np.abs(step.velocity) / level)
        damper = 2 * DAMPED * np.sqrt(stiff * inertia) * (moved - bent[0]) / step.dt
        step.torque -= np.where(mine, stiff * moved + damper, 0.0)
        bent[0] = moved
        step.friction = np.where(mine, 0.0, step.friction)

    return act
