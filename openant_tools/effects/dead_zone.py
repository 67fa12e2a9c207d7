"""A position loop that does nothing about small errors."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Quantity, Values
from openant_tools.effects.step import Law, Step

__all__ = ["EFFECT"]


def _law(values: Values) -> Law:
    half = values["width_rad"] / 2

    def act(step: Step) -> None:
        error = step.setpoint - step.position
        # Beyond the zone the whole error counts again, less the zone: the loop has no step in its torque.
        step.setpoint = step.position + np.sign(error) * np.maximum(np.abs(error) - half, 0.0)

    return act


EFFECT = Effect(
    name="dead_zone",
    family="transmission",
    words="the position loop ignores errors smaller than half a width",
    quantities=(Quantity("width_rad", "rad", 0.01, high=0.5),),
    order=20,
    law=_law,
)
