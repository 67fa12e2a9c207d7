"""Gear or shell give way like a spring."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, rate
from openant_tools.effects.robot import Reference, Robot
from openant_tools.effects.transmission import hinges

__all__ = ["effect"]


def _stiffness(reference: Reference, joints: Ints) -> float:
    return float(reference.stiffness[joints].mean())


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.compliance[joints] += 1 / values["stiffness_nm_rad"]


effect = Effect(
    name="joint_compliance",
    family="transmission",
    words="gear or shell give way like a spring",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(rate("stiffness_nm_rad", "N·m/rad", 0.25, 6.0, _stiffness),),
    enter=_enter,
    native=True,
    writer=hinges,
)
