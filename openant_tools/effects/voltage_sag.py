"""A supply whose voltage falls with what all servos draw together."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Quantity, Values
from openant_tools.effects.step import Law, Step
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT

__all__ = ["EFFECT"]

#: V, of the supply without load; the share of the drop is what counts
NOMINAL_V = 12.0
#: A per N·m at the output of the Ant's servos (XM430-W350: 2.3 A at 4.1 N·m, XC430-W240: 1.4 A at 1.9 N·m)
AMPERE_PER_NM = 0.6
#: no servo runs below
LEAST_SHARE = 0.4


def _law(values: Values) -> Law:
    resistance = values["resistance_ohm"]

    def act(step: Step) -> None:
        torque = np.abs(step.motor_torque)
        # A chopped motor draws its current only for the part of the time that the duty says; at its limit that is the platform's.
        duty = PLATFORM_PWM_LIMIT * np.minimum(torque / np.maximum(step.limit, 1e-9), 1.0)
        current = (AMPERE_PER_NM * torque * duty).sum(axis=1, keepdims=True)
        share = np.maximum(1.0 - resistance * current / NOMINAL_V, LEAST_SHARE)
        step.stiffness *= share
        step.velocity_gain *= share
        step.limit *= share
        step.supply = step.supply * share

    return act


EFFECT = Effect(
    name="voltage_sag",
    family="torque supply",
    words="the supply's voltage falls with what all servos draw together",
    quantities=(Quantity("resistance_ohm", "Ω", 0.5, high=20.0),),
    order=10,
    law=_law,
    shared=True,
)
