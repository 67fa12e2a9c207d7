"""Some commands never arrive; the one before stays in force."""

from __future__ import annotations

import numpy as np

from openant_tools.effects.effect import Chance, Effect, Ints, Parameter, Scope, Values, amount, shape
from openant_tools.effects.robot import Robot

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.dropout[joints] = np.maximum(robot.dropout[joints], values["fraction"])
    robot.longest_s = values["longest_s"]
    robot.shared_dropout = len(joints) == robot.joints


effect = Effect(
    name="command_dropout",
    family="communication",
    words="some commands never arrive",
    scopes=(Scope.JOINT, Scope.ALL),
    quantities=(amount("fraction", "1", 0.03, 0.4), shape("longest_s", "s", 0.02, 0.25)),
    enter=_enter,
    native=False,
    parameters=(Parameter("fraction", "1", high=0.95), Parameter("longest_s", "s", high=10.0)),
    acts_on="commands",
    random=Chance.LOST,
)
