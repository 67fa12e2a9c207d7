"""Dry friction is not what the model says."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount, usual_torque
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.servo import read_friction, write_friction

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.more("coulomb_friction")[joints] += values["torque_nm"]


effect = Effect(
    name="coulomb_friction",
    family="friction",
    words="dry friction is not what the model says",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(amount("torque_nm", "N·m", 0.025, 0.4, signed=True, scale=usual_torque, tolerance=0.02),),
    enter=_enter,
    native=True,
    kinds=(
        # Of a small geared servo it is of the order of a tenth of the stall torque; a model that has none says nothing about it.
        Kind(
            "coulomb_friction",
            "N·m",
            read_friction,
            write_friction,
            None,
            lambda limit: 0.1 * limit,
            shown_by="`slow-reversals`",
            told_from={
                "damping": "`slow-reversals` beside `chirp`: dry friction stays where damping fades",
                "load_friction": "`slow-reversals` in loaded and in hanging poses",
            },
        ),
    ),
)
