"""The servo gives less (or more) torque than the model lets it."""

from __future__ import annotations

import math

import numpy as np

from openant_tools.effects.effect import Effect, Ints, Scope, Values, factor
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.servo import torque_limit, write_torque_limit

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.weaken("torque_limit", joints, values["limit"])


_limit = factor("limit", 0.18, 1.3, tolerance=0.15)
effect = Effect(
    name="torque_limit",
    family="torque supply",
    words="the servo gives less torque than the model lets it",
    scopes=(Scope.JOINT, Scope.SERVO, Scope.ALL),
    quantities=(_limit,),
    enter=_enter,
    native=True,
    kinds=(
        Kind(
            "torque_limit",
            "N·m",
            torque_limit,
            write_torque_limit,
            _limit.tolerance / 2,
            low=1e-6,
            holds=lambda model, plant, j: math.isfinite(torque_limit(model, plant, j)),
            shown_by="`saturating-steps`",
            told_from={
                "speed_limit": "`saturating-steps`: slow ones stop at the torque limit, long ones at the speed limit"
            },
        ),
    ),
    shows=lambda reference: bool(np.isfinite(reference.limit).any()),
)
