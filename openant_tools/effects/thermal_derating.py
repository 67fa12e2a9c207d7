"""A servo gives less the warmer it is.

How warm it is follows the square of the torque that it gives, with one time constant: standing at its limit for good it
ends `FULL_HEAT_C` above where it began. Every degree takes a share of its gains and of its torque, down to `COLDEST`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.effect import Action, Effect, Ints, Parameter, Scope, Table, Values, amount, shape
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import TINY, Step

__all__ = ["FULL_HEAT_C", "Heating", "effect"]

#: °C by which a winding that gives all its torque warms up in the end
FULL_HEAT_C = 60.0
#: least share of the torque that heat leaves
COLDEST = 0.2
#: s, where only a loss is named
USUAL_S = 20.0


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.derating[joints] += values["loss_per_c"]
    robot.derating_s, robot.heat_c = values["time_constant_s"], values["start_c"]


class Heating:
    """heat' = (FULL_HEAT_C (torque/limit)² − heat) / time constant, explicitly; share left = 1 − loss · heat.

    Args:
        values: (n, joints) or (n, 1) of each quantity.
        start_c: (n, 1) °C, how warm it is at the first step already.

    Attributes:
        state: (n, joints) °C above where it began.
    """

    def __init__(self, values: Table, start_c: NDArray[np.float64] | float = 0.0) -> None:
        self._loss = values["loss_per_c"]
        seconds = values["time_constant_s"]
        self._seconds = np.where(seconds > 0.0, seconds, USUAL_S)
        self.state: NDArray[np.float64] = np.broadcast_to(start_c, self._loss.shape).copy()

    def __call__(self, step: Step) -> None:
        share = np.minimum(np.abs(step.motor_torque) / np.maximum(step.limit, TINY), 1.0)
        self.state += step.dt / self._seconds * (FULL_HEAT_C * share**2 - self.state)
        left = np.maximum(1 - self._loss * self.state, COLDEST)
        step.stiffness = step.stiffness * left
        step.velocity_gain = step.velocity_gain * left
        step.limit = step.limit * left


_warm_it_up = Action("warm it up", "record the same motion cold and after five minutes of work")

effect = Effect(
    name="thermal_derating",
    family="torque supply",
    words="torque falls as the servo warms up",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        # Copper's resistance grows by the tolerance, so that any motor's torque falls by it.
        amount("loss_per_c", "1/°C", 0.005, 0.06, tolerance=0.0039),
        shape("time_constant_s", "s", 5.0, 40.0),
        shape("start_c", "°C", 0.5, 30.0),
    ),
    enter=_enter,
    native=False,
    law=Heating,
    order=5,
    parameters=(Parameter("loss_per_c", "1/°C", 0.01, high=0.1), Parameter("time_constant_s", "s", 10.0, high=3600.0)),
    # How warm it was as a recording began is the recording's, not the robot's.
    stated=lambda values, reference, joints: {name: values[name] for name in ("loss_per_c", "time_constant_s")},
    restored=lambda given, x, reference, joints: {**given, "start_c": x.get("start_c", 0.0)},
    told_from={"voltage_sag": _warm_it_up, "torque_limit": _warm_it_up, "weak_joint": _warm_it_up},
)
