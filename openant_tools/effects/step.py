"""What stands between two steps of a simulation: the servos, as effects see and change them.

MuJoCo computes a step from a model that does not change meanwhile. Effects that it has no feature for act between steps,
by changing what the next one is computed from: friction that follows the load, gains that follow the supply. The same
laws act on many simulations at once (`rollout`) and on the one of an environment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["DAMPED", "HARD", "TINY", "Law", "Step"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: share of the stiffest spring that a step can integrate, for what is to be hard
HARD = 0.15
#: share of critical damping in a spring
DAMPED = 0.3
#: numbers that only must not be zero
TINY = 1e-9


@dataclass
class Step:
    """One step of n simulations of robots with the same joints; arrays are (n, joints) unless said otherwise.

    A servo's torque is clip(stiffness · (setpoint − position) − velocity_gain · velocity, ±limit) − back_emf · velocity,
    and nothing where its torque is off. Its joint's own damping, and friction, come on top.

    Attributes:
        dt: s, of the step. time: (n,) s since each simulation's start.
        position, velocity: rad, rad/s; read only.
        load: N·m that gravity and motion ask of each joint's servo (bias force, one step old); read only.
        on: whether torque is on; read only.
        setpoint: rad, where the servo is told to go.
        stiffness, velocity_gain, limit, back_emf: of the servo: N·m/rad, N·m·s/rad, N·m, N·m·s/rad; a law that changes them
            puts other arrays in their place.
        damping: N·m·s/rad, of the joint itself, which stays with torque off; read only.
        friction: N·m, the most that dry friction in the joint holds.
        torque: N·m put on the joint beside all this.
        supply: share of the nominal voltage that reaches the servo, which stiffness, gains and limit already follow.
    """

    dt: float
    time: Array
    position: Array
    velocity: Array
    load: Array
    on: Bools
    setpoint: Array
    stiffness: Array
    velocity_gain: Array
    limit: Array
    back_emf: Array
    damping: Array
    friction: Array
    torque: Array
    supply: Array

    @property
    def motor_torque(self) -> Array:
        """What the servos' motors give with everything as it stands now, N·m."""
        asked = self.stiffness * (self.setpoint - self.position) - self.velocity_gain * self.velocity
        # What np.clip does, in a third of its time: robots have few joints.
        given = np.maximum(np.minimum(asked, self.limit), -self.limit) - self.back_emf * self.velocity
        return np.where(self.on, given, 0.0)


#: Acts once a step, in place; may keep what it needs from step to step.
Law = Callable[[Step], None]
