"""The tracker measures in another scale or heading."""

from __future__ import annotations

import math

from openant_tools.effects.effect import Action, Effect, Ints, Parameter, Scope, Values, amount
from openant_tools.effects.robot import Robot

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.base_scale *= 1 + values["scale_error"]
    robot.base_yaw += values["yaw_rad"]
    robot.log_delay["base"] = robot.log_delay.get("base", 0.0) + values["latency_s"]


effect = Effect(
    name="tracker_scale",
    family="sensing",
    words="the tracker measures in another scale or heading",
    scopes=(Scope.BODY,),
    quantities=(
        amount("scale_error", "1", 0.03, 0.2, signed=True),
        amount("yaw_rad", "rad", 0.03, 0.25, signed=True),
        amount("latency_s", "s", 0.02, 0.2),
    ),
    enter=_enter,
    native=False,
    parameters=(
        Parameter("scale", "1", low=0.1, high=10.0, absent=1.0),
        Parameter("yaw_rad", "rad", low=-math.pi, high=math.pi),
        Parameter("latency_s", "s", high=2.0),
    ),
    acts_on="sensors",
    shows=lambda reference: reference.tracker,
    signal="base",
    stated=lambda values, reference, joints: {
        "scale": 1 + values["scale_error"],
        "yaw_rad": values["yaw_rad"],
        "latency_s": values["latency_s"],
    },
    restored=lambda given, x, reference, joints: {
        "scale_error": given["scale"] - 1,
        "yaw_rad": given["yaw_rad"],
        "latency_s": given["latency_s"],
    },
    told_from={
        "floor_friction": Action(
            "move it by hand", "push it a metre along a ruler with torque off: a scale shows at once"
        )
    },
)
