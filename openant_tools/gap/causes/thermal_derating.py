"""Torque falls as the servo warms up."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount, shape
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.derating[joints] += values["loss_per_c"]
    robot.derating_s, robot.heat_c = values["time_constant_s"], values["start_c"]


CAUSE = Cause(
    name="thermal_derating",
    family="torque supply",
    words="torque falls as the servo warms up",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(
        amount("loss_per_c", "1/°C", 0.005, 0.06),
        shape("time_constant_s", "s", 5.0, 40.0),
        shape("start_c", "°C", 0.5, 30.0),
    ),
    enter=_enter,
    native=False,
    # How warm it was as a recording began is the recording's, not the robot's.
    stated=lambda values, reference, joints: {name: values[name] for name in ("loss_per_c", "time_constant_s")},
    restored=lambda given, x, reference, joints: {**given, "start_c": x.get("start_c", 0.0)},
)
