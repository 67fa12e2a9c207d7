"""Gears rub more the more torque they carry.

A gear carries what the motor gives on its one side and what the link asks on its other; standing still the two are the
same. In motion they differ by what inertia and friction take, and which of them the teeth feel is a matter of the gear. Each form
has a coefficient of its own; what they say adds up. The usual one takes the mean of both sides: on a real servo
(docs/effects.md) it explains more than either alone or the greater of them. Damping that is back-EMF is lost in the motor and
never reaches the gears: `electrical` says how much of the joint's is. Loaded gears also stick: `at_rest` is what the
coefficient is larger by while they stand still, and dies out with speed as Stribeck's does.
"""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Effect, Ints, Parameter, Scope, Table, Values, amount, share
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Law, Step
from openant_tools.effects.stribeck_friction import USUAL_VELOCITY_RAD_S

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("load_friction", "coefficient")[joints] += values["coefficient"]
    robot.law("load_friction", "electrical")[joints] = values["electrical"]


def _law(values: Table) -> Law:
    motor = values["motor_side"] + values["coefficient"] / 2
    link = values["link_side"] + values["coefficient"] / 2
    greater, at_rest = values["greater_side"], values["at_rest"] / 2
    electrical = values["electrical"]
    brakes, sticks = bool(electrical.any()), bool(at_rest.any())

    def act(step: Step) -> None:
        given, asked = step.motor_torque, np.abs(step.load)
        if brakes:
            given = given - np.where(step.on, electrical * step.damping * step.velocity, 0.0)
        given = np.abs(given)
        step.friction += motor * given + link * asked + greater * np.maximum(given, asked)
        if sticks:
            step.friction += at_rest * (given + asked) * np.exp(-((step.velocity / USUAL_VELOCITY_RAD_S) ** 2))

    return act


effect = Effect(
    name="load_friction",
    family="friction",
    words="friction grows with the torque that the gears carry",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    # How much of the damping is back-EMF, which the gears do not carry, no data sheet of a model says.
    quantities=(amount("coefficient", "N·m/(N·m)", 0.06, 0.6), share("electrical")),
    enter=_enter,
    native=False,
    law=_law,
    order=30,
    parameters=(
        Parameter("coefficient", "N·m/(N·m)", 0.25, high=0.9, shown_by="`slow-reversals` in loaded poses"),
        Parameter("motor_side", "N·m/(N·m)", 0.25, high=0.9),
        Parameter("link_side", "N·m/(N·m)", 0.25, high=0.9),
        Parameter("greater_side", "N·m/(N·m)", 0.25, high=0.9),
        Parameter("at_rest", "N·m/(N·m)", 0.25, high=0.9),
        Parameter("electrical", "1", 0.5, high=1.0),
    ),
    restored=lambda given, x, reference, joints: {"electrical": 0.0, **given},
)
