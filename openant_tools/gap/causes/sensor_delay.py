"""A signal of the log is older than its row says."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    for signal in ("pos", "vel", "imu"):
        robot.late[signal] = robot.late.get(signal, 0.0) + values[signal]


CAUSE = Cause(
    name="sensor_delay",
    family="timing",
    words="a signal is logged later than it was measured",
    scopes=(Scope.ALL, Scope.BODY),
    quantities=(
        amount("pos", "s", 0.004, 0.06),
        amount("vel", "s", 0.012, 0.08),
        amount("imu", "s", 0.004, 0.06),
    ),
    enter=_enter,
    native=True,
    together=True,
    unseen=frozenset({"vel", "imu"}),
    stated=lambda values, reference, joints: {
        f"{signal}.delay_s": value for signal, value in values.items() if value > 0
    },
    restored=lambda given, x, reference, joints: {
        signal: given.get(f"{signal}.delay_s", 0.0) for signal in ("pos", "vel", "imu")
    },
)
