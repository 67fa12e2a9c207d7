"""A stop stands where none should be: a screw, a cable, a printed part."""

from __future__ import annotations

from openant_tools.gap.cause import Cause, Ints, Scope, Values, amount
from openant_tools.gap.robot import Reference, Robot

__all__ = ["CAUSE"]


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


CAUSE = Cause(
    name="blocked_joint",
    family="geometry",
    words="a stop stands where none should be",
    scopes=(Scope.JOINT,),
    quantities=(amount("inside", "1", 0.08, 0.9, signed=True),),
    enter=_enter,
    native=True,
    stated=_stated,
    restored=_restored,
)
