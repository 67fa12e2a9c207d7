"""Dry friction is larger at rest than in motion."""

from __future__ import annotations

import math

import numpy as np

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Effect, Ints, Parameter, Scope, Table, Values, amount, shape, usual_torque
from openant_tools.effects.robot import Robot
from openant_tools.effects.step import Law, Step

__all__ = ["BRISTLE_RAD", "USUAL_VELOCITY_RAD_S", "effect"]

#: rad/s; where no velocity is given: between what small geared servos show
USUAL_VELOCITY_RAD_S = 0.3
#: rad that teeth bend before they slide (LuGre), the share of the stiffest spring that a step can follow, and the share of
#: its critical damping: more of it is carried into the sliding
BRISTLE_RAD, BRISTLE_STEP, BRISTLE_DAMPING = 3e-4, 0.2, 0.05
#: share of the friction at rest that is left at speed at least: with none, bristles have nothing to slide on
LEAST_SLIDING = 0.05


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.law("stribeck_friction", "static_nm")[joints] += values["static_nm"]
    robot.law("stribeck_friction", "velocity_rad_s")[joints] = values["velocity_rad_s"]


def _law(values: Table) -> Law:
    coulomb = values["coulomb_nm"]
    more = np.maximum(values["static_nm"] - coulomb, 0.0)
    velocity = np.where(values["velocity_rad_s"] > 0, values["velocity_rad_s"], USUAL_VELOCITY_RAD_S)

    def act(step: Step) -> None:
        # Armstrong's form: the surplus at rest dies out as a Gaussian of velocity.
        step.friction += coulomb + more * np.exp(-((step.velocity / velocity) ** 2))

    return act


def _write(document: Document, j: int) -> None:
    static, coulomb, velocity = (
        document.law("stribeck_friction", name, j) for name in ("static_nm", "coulomb_nm", "velocity_rad_s")
    )
    if not static:
        return
    model, dof, timestep = document.plant.model, document.plant.dof[j], document.plant.timestep
    # The joint's own dry friction slides on the same bristles.
    own = float(model.dof_frictionloss[dof])
    document.joint(j).set("frictionloss", "0")
    inertia = max(float(model.dof_M0[dof]), 1e-6)
    rest = own + static
    stiffness = min(rest / BRISTLE_RAD, BRISTLE_STEP * inertia / timestep**2)
    bristles = [stiffness, 2 * BRISTLE_DAMPING * math.sqrt(stiffness * inertia)]
    sliding = max(own + coulomb, LEAST_SLIDING * rest)
    document.gear(j, "friction", "lugre", [*bristles, sliding, rest, velocity])


effect = Effect(
    name="stribeck_friction",
    family="friction",
    words="dry friction is larger at rest than in motion",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("static_nm", "N·m", 0.03, 0.6, scale=usual_torque), shape("velocity_rad_s", "rad/s", 0.05, 0.6)),
    enter=_enter,
    native=True,
    writer=Writer(31, joint=_write),
    law=_law,
    order=30,
    parameters=(
        Parameter("coulomb_nm", "N·m", 0.1),
        Parameter("static_nm", "N·m", 0.15),
        Parameter("velocity_rad_s", "rad/s", 0.3, high=5.0),
    ),
    stated=lambda values, reference, joints: {"coulomb_nm": 0.0, **values},
)
