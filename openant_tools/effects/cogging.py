"""Torque that comes and goes with the joint's angle, as a motor's magnets or a bad tooth make it."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Quantity, Values
from openant_tools.effects.step import Law, Step

__all__ = ["EFFECT"]

#: where no number is given
USUAL_PERIODS = 12.0


def _law(values: Values) -> Law:
    amplitude = values["amplitude_nm"]
    periods = np.where(values["periods"] > 0, values["periods"], USUAL_PERIODS)

    def act(step: Step) -> None:
        step.torque += amplitude * np.sin(periods * step.position)

    return act


EFFECT = Effect(
    name="cogging",
    family="transmission",
    words="a torque that repeats with the joint's angle",
    quantities=(Quantity("amplitude_nm", "N·m", 0.05), Quantity("periods", "per turn", 12.0, high=2000.0)),
    order=25,
    law=_law,
)
