"""Dry friction that is larger at rest than in motion (Stribeck)."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Quantity, Values
from openant_tools.effects.step import Law, Step

__all__ = ["EFFECT"]

#: rad/s; where no velocity is given: between what small geared servos show
USUAL_VELOCITY_RAD_S = 0.3


def _law(values: Values) -> Law:
    coulomb = values["coulomb_nm"]
    more = np.maximum(values["static_nm"] - coulomb, 0.0)
    velocity = np.where(values["velocity_rad_s"] > 0, values["velocity_rad_s"], USUAL_VELOCITY_RAD_S)

    def act(step: Step) -> None:
        # Armstrong's form: the surplus at rest dies out as a Gaussian of velocity.
        step.friction += coulomb + more * np.exp(-((step.velocity / velocity) ** 2))

    return act


EFFECT = Effect(
    name="stribeck_friction",
    family="friction",
    words="dry friction is larger at rest than in motion",
    quantities=(
        Quantity("coulomb_nm", "N·m", 0.1),
        Quantity("static_nm", "N·m", 0.15),
        Quantity("velocity_rad_s", "rad/s", 0.3, high=5.0),
    ),
    order=30,
    law=_law,
)
