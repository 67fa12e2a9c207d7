"""The rotor's inertia, seen through the gear, is not what the model says."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, factor
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.servo import read_armature, write_armature

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("armature")[joints] *= values["scale"]


_scale = factor("scale", 0.34, 1.8, tolerance=0.30)
effect = Effect(
    name="armature_error",
    family="inertia",
    words="the rotor's inertia is not what the model says",
    scopes=(Scope.SERVO, Scope.ALL),
    quantities=(_scale,),
    enter=_enter,
    native=True,
    kinds=(
        # The rotor's inertia behind the gear of such a servo is of this order, in kg·m² per N·m of its torque limit.
        Kind(
            "armature",
            "kg·m²",
            read_armature,
            write_armature,
            _scale.tolerance / 2,
            lambda limit: 0.005 * limit,
            constants=True,
            shown_by="`chirp`",
            told_from={"damping": "`chirp`: inertia rules above the resonance, damping at it"},
        ),
    ),
)
