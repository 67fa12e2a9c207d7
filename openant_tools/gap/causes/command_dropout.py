"""Some commands never arrive; the one before stays in force."""

from __future__ import annotations

import numpy as np

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount, shape
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.dropout[joints] = np.maximum(robot.dropout[joints], values["fraction"])
    robot.longest_s = values["longest_s"]
    robot.shared_dropout = len(joints) == robot.joints


CAUSE = Cause(
    name="command_dropout",
    family="communication",
    words="some commands never arrive",
    scopes=(Scope.JOINT, Scope.ALL),
    quantities=(
        amount("fraction", "1", 0.03, 0.4),
        shape("longest_s", "s", 0.02, 0.25),
    ),
    enter=_enter,
    native=False,
    random=True,
    # A command that is lost is late, too, while a clock that jitters loses none.
    shows_as=("clock_jitter",),
)
