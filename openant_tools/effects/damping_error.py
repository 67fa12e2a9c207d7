"""Velocity gain and damping together are not what the model says."""

from __future__ import annotations

from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, factor
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.servo import read_damping, read_velocity_gain, write_damping, write_velocity_gain

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("damping")[joints] *= values["scale"]


def _usual(limit: float) -> float:
    """N·m·s/rad: the back-EMF slope of a small geared servo, about a fifth of its torque limit (1 / no-load speed)."""
    return 0.2 * limit


_scale = factor("scale", 0.28, 2.0, tolerance=0.25)
effect = Effect(
    name="damping_error",
    family="gain",
    words="velocity gain and damping are not what the model says",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(_scale,),
    enter=_enter,
    native=True,
    kinds=(
        Kind(
            "velocity_gain",
            "N·m·s/rad",
            read_velocity_gain,
            write_velocity_gain,
            _scale.tolerance / 2,
            _usual,
            shown_by="`chirp`",
            told_from={
                "damping": "`drops` or `saturating-steps`: without torque, or at its limit, only damping brakes",
                "electrical_damping": "`drops` or `saturating-steps`: without torque both vanish, at its limit one",
            },
        ),
        Kind(
            "damping",
            "N·m·s/rad",
            read_damping,
            write_damping,
            _scale.tolerance / 2,
            _usual,
            shown_by="`chirp`",
            told_from={"electrical_damping": "`releases` or `drops`: without torque only the mechanical share brakes"},
        ),
    ),
    told_from={
        "electrical_damping": Action("let it fall", "record `drops` and `releases`: without torque back-EMF is gone")
    },
)
