"""The servo follows its command through a first-order filter."""

from __future__ import annotations

import mujoco

from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.effects.servo_form import servo
from openant_tools.model.plant import Plant, is_filtered, set_lag

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.lag[joints] += values["time_constant_s"]


def _read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    i = int(plant.actuator[j])
    return float(model.actuator_dynprm[i, 0]) if is_filtered(model, i) else 0.0


def _set(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    set_lag(model, int(plant.actuator[j]), value)


effect = Effect(
    name="actuator_lag",
    family="timing",
    words="the servo follows a filtered command",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("time_constant_s", "s", 0.006, 0.12),),
    enter=_enter,
    native=True,
    writer=servo,
    kinds=(
        # A servo that filters its setpoint at all does so within a few periods of its loop, and the platform's MJCF up to 0.6 s.
        Kind(
            "actuator_lag",
            "s",
            _read,
            _set,
            0.3,
            lambda limit: 0.02,
            high=1.0,
            holds=lambda model, plant, j: is_filtered(model, int(plant.actuator[j])),
            shown_by="`steps` and `square`",
        ),
    ),
)
