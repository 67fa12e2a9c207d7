"""Damping that does not grow in proportion to speed."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Quantity, Values
from openant_tools.effects.step import Law, Step

__all__ = ["EFFECT"]


def _law(values: Values) -> Law:
    quadratic = values["coefficients"]

    def act(step: Step) -> None:
        step.torque -= quadratic * step.velocity * np.abs(step.velocity)

    return act


EFFECT = Effect(
    name="viscous_nonlinear",
    family="friction",
    words="damping grows with the square of speed",
    quantities=(Quantity("coefficients", "N·m·s²/rad²", 0.02),),
    order=25,
    law=_law,
)
