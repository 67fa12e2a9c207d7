"""Damping grows with the square of speed."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Effect, Ints, Parameter, Scope, Table, Values, amount
from openant_tools.effects.robot import Reference, Robot
from openant_tools.effects.step import Law, Step
from openant_tools.model.mjcf import numbers

__all__ = ["effect"]


def _damping(reference: Reference, joints: Ints) -> float:
    return float(reference.damping[joints].mean())


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("viscous_nonlinear", "coefficients")[joints] += values["coefficients"]


def _law(values: Table) -> Law:
    quadratic = values["coefficients"]

    def act(step: Step) -> None:
        step.torque -= quadratic * step.velocity * np.abs(step.velocity)

    return act


def _write(document: Document, j: int) -> None:
    quadratic = document.law("viscous_nonlinear", "coefficients", j)
    if quadratic:
        plant = document.plant
        document.joint(j).set("damping", numbers([plant.model.dof_damping[plant.dof[j]], quadratic]))


effect = Effect(
    name="viscous_nonlinear",
    family="friction",
    words="damping grows with the square of speed",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("coefficients", "N·m·s²/rad²", 0.12, 1.2, scale=_damping),),
    enter=_enter,
    native=True,
    writer=Writer(30, joint=_write),
    law=_law,
    order=25,
    parameters=(Parameter("coefficients", "N·m·s²/rad²", 0.02),),
)
