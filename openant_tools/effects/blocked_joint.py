"""A stop stands where none should be: a screw, a cable, a printed part."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Reference, Robot
from openant_tools.effects.step import HARD, Law, Step
from openant_tools.model.mjcf import in_degrees, numbers

__all__ = ["effect", "stopping"]

Array = NDArray[np.float64]


def _stop(reach: tuple[float, float], inside: float) -> float:
    """Where the stop stands (rad) that takes a share of the way from the end of a joint's motion towards its middle."""
    low, high = reach
    half = (high - low) / 2
    return high - inside * half if inside >= 0 else low - inside * half


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    for j in joints:
        at = _stop((float(robot.low[j]), float(robot.high[j])), values["inside"])
        if values["inside"] >= 0:
            robot.stop_high[j] = min(robot.stop_high[j], at)
        else:
            robot.stop_low[j] = max(robot.stop_low[j], at)


def _stated(values: Values, reference: Reference, joints: Ints) -> dict[str, float]:
    j = int(joints[0])
    return {"angle_rad": _stop((float(reference.low[j]), float(reference.high[j])), values["inside"])}


def _restored(given: Values, x: Values, reference: Reference, joints: Ints) -> dict[str, float]:
    j = int(joints[0])
    low, high = float(reference.low[j]), float(reference.high[j])
    half, angle = (high - low) / 2, given["angle_rad"]
    above = x["inside"] >= 0 if "inside" in x else angle >= (low + high) / 2
    # Nothing but its sign says which side it stands on, so that a stop at the very end is a little inside.
    return {"inside": max((high - angle) / half, 1e-9) if above else min((low - angle) / half, -1e-9)}


def stopping(low: Array, high: Array, inertia: Array) -> Law:
    """The law, for (robots, joints) rad, ∓inf for none, and kg·m² of what is stopped."""

    def act(step: Step) -> None:
        spring, damper = HARD * inertia / step.dt**2, HARD * inertia / step.dt
        beyond = np.maximum(step.position - high, 0.0) + np.minimum(step.position - low, 0.0)
        step.torque -= np.where(beyond != 0, spring * beyond + damper * step.velocity, 0.0)

    return act


def _write(document: Document, j: int) -> None:
    robot, plant = document.robot, document.plant
    low, high = float(robot.stop_low[j]), float(robot.stop_high[j])
    if not (math.isfinite(low) or math.isfinite(high)):
        return
    model, joint = plant.model, int(plant.model.dof_jntid[plant.dof[j]])
    element = document.joint(j)
    reading = float(robot.zero[j])
    given = model.jnt_range[joint] if model.jnt_limited[joint] else (-2 * math.pi, 2 * math.pi)
    ends = np.array([max(given[0], low + reading), min(given[1], high + reading)])
    element.set("range", numbers(np.degrees(ends) if document.turns(j) and in_degrees(document.root) else ends))
    element.set("limited", "true")
    # It throws back as the law's does.
    document.stop(element, plant.timestep / (HARD / 2), math.sqrt(HARD) / 2)


effect = Effect(
    name="blocked_joint",
    family="geometry",
    words="a stop stands where none should be",
    scopes=(Scope.JOINT,),
    quantities=(amount("inside", "1", 0.08, 0.9, signed=True),),
    enter=_enter,
    native=True,
    writer=Writer(20, joint=_write),
    stated=_stated,
    restored=_restored,
)
