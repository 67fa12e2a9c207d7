"""The supply's voltage falls with what all servos draw together."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Action, Effect, Ints, Parameter, Scope, Table, Values, amount
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Law, Step
from openant_tools.robot.kit import PLATFORM_PWM_LIMIT

__all__ = ["effect"]

#: V, of the supply without load; the share of the drop is what counts
NOMINAL_V = 12.0
#: A per N·m at the output of the Ant's servos (XM430-W350: 2.3 A at 4.1 N·m, XC430-W240: 1.4 A at 1.9 N·m)
AMPERE_PER_NM = 0.6
#: no servo runs below
LEAST_SHARE = 0.4


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("voltage_sag", "resistance_ohm")[:] += values["resistance_ohm"]


def _law(values: Table) -> Law:
    resistance = values["resistance_ohm"]

    def act(step: Step) -> None:
        torque = np.abs(step.motor_torque)
        # A chopped motor draws its current only for the part of the time that the duty says; at its limit that is the platform's.
        duty = PLATFORM_PWM_LIMIT * np.minimum(torque / np.maximum(step.limit, 1e-9), 1.0)
        current = (AMPERE_PER_NM * torque * duty).sum(axis=1, keepdims=True)
        share = np.maximum(1.0 - resistance * current / NOMINAL_V, LEAST_SHARE)
        step.stiffness = step.stiffness * share
        step.velocity_gain = step.velocity_gain * share
        step.limit = step.limit * share
        step.supply = step.supply * share

    return act


effect = Effect(
    name="voltage_sag",
    family="torque supply",
    words="the supply's voltage falls with what all servos draw",
    scopes=(Scope.ALL,),
    # A supply and its cables have up to as many ohms as the tolerance on any robot.
    quantities=(amount("resistance_ohm", "Ω", 0.15, 4.0, tolerance=0.05),),
    enter=_enter,
    native=False,
    law=_law,
    order=10,
    parameters=(Parameter("resistance_ohm", "Ω", 0.5, high=20.0),),
    shared=True,
    told_from={
        "load_friction": Action(
            "one joint alone, then all",
            "record `one-by-one` with the supply's voltage logged: sag is shared, friction is not",
        ),
        "torque_limit": Action(
            "one joint alone, then all", "record `one-by-one`: a limit does not care what others do"
        ),
    },
)
