"""The tracker measures in another scale or heading."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Robot

__all__ = ["CAUSE"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.base_scale *= 1 + values["scale_error"]
    robot.base_yaw += values["yaw_rad"]
    robot.late["base"] = robot.late.get("base", 0.0) + values["latency_s"]


CAUSE = Cause(
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
)
