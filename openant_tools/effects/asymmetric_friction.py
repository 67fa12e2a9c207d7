"""Dry friction that differs by the direction of motion."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Quantity, Values
from openant_tools.effects.step import Law, Step

__all__ = ["EFFECT"]

#: rad/s; at rest it is the torque that tells which way the joint would go
AT_REST_RAD_S = 0.01


def _law(values: Values) -> Law:
    positive, negative = values["positive_nm"], values["negative_nm"]

    def act(step: Step) -> None:
        pushed = step.motor_torque - step.load
        forward = np.where(np.abs(step.velocity) > AT_REST_RAD_S, step.velocity, pushed) > 0
        step.friction += np.where(forward, positive, negative)

    return act


EFFECT = Effect(
    name="asymmetric_friction",
    family="friction",
    words="dry friction differs by direction",
    quantities=(Quantity("positive_nm", "N·m", 0.1), Quantity("negative_nm", "N·m", 0.1)),
    order=30,
    law=_law,
)
