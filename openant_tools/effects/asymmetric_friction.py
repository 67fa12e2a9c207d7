"""Dry friction differs by direction."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Ints, Parameter, Scope, Table, Values, amount, usual_torque
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Law, Step

__all__ = ["effect"]

#: rad/s; at rest it is the torque that tells which way the joint would go
AT_REST_RAD_S = 0.01


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    for name in ("positive_nm", "negative_nm"):
        robot.law("asymmetric_friction", name)[joints] += values[name]


def _law(values: Table) -> Law:
    positive, negative = values["positive_nm"], values["negative_nm"]

    def act(step: Step) -> None:
        pushed = step.motor_torque - step.load
        forward = np.where(np.abs(step.velocity) > AT_REST_RAD_S, step.velocity, pushed) > 0
        step.friction += np.where(forward, positive, negative)

    return act


effect = Effect(
    name="asymmetric_friction",
    family="friction",
    words="dry friction differs by direction",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        amount("positive_nm", "N·m", 0.035, 0.35, scale=usual_torque),
        amount("negative_nm", "N·m", 0.035, 0.35, scale=usual_torque),
    ),
    enter=_enter,
    native=False,
    law=_law,
    order=30,
    parameters=(Parameter("positive_nm", "N·m", 0.1), Parameter("negative_nm", "N·m", 0.1)),
    vector=True,
)
