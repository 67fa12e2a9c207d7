"""Links are heavier or lighter than in the model."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, factor
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("link_mass")[joints] *= values["scale"]


CAUSE = Cause(
    name="link_mass",
    family="inertia",
    words="links are heavier or lighter than in the model",
    scopes=(Scope.SERVO, Scope.ALL),
    quantities=(factor("scale", 0.08, 0.9),),
    enter=_enter,
    native=True,
)
