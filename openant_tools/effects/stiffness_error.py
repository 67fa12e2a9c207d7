"""Stiffness is not what the model says."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, factor
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.servo import read_stiffness, write_stiffness

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("stiffness")[joints] *= values["scale"]


_scale = factor("scale", 0.18, 1.1, tolerance=0.15)
effect = Effect(
    name="stiffness_error",
    family="gain",
    words="stiffness is not what the model says",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(_scale,),
    enter=_enter,
    native=True,
    kinds=(
        Kind(
            "stiffness",
            "N·m/rad",
            read_stiffness,
            write_stiffness,
            _scale.tolerance / 2,
            low=1e-6,
            shown_by="`long-holds`",
            told_from={
                "zero_offset": "`long-holds` in poses on both sides of the vertical",
                "link_mass": "`long-holds` with a known mass on the foot, or `openant sysid scale`",
                "torque_limit": "`saturating-steps`: only there the limit shows",
                "coulomb_friction": "`holds` and `slow-reversals`: poses that are reached from both sides",
            },
        ),
    ),
)
