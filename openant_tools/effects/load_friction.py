"""Gears rub more the more torque they carry."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Quantity, Values
from openant_tools.effects.step import Law, Step

__all__ = ["EFFECT"]


def _law(values: Values) -> Law:
    coefficient = values["coefficient"]

    def act(step: Step) -> None:
        # A tooth carries what the motor gives on one side and what the link asks on the other.
        step.friction += coefficient * np.maximum(np.abs(step.motor_torque), np.abs(step.load))

    return act


EFFECT = Effect(
    name="load_friction",
    family="friction",
    words="friction grows with the torque that the gears carry",
    quantities=(Quantity("coefficient", "N·m/(N·m)", 0.15, high=0.9),),
    order=30,
    law=_law,
)
