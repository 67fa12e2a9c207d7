"""Derating: less torque the warmer a servo is, so that a robot learns on instead of shutting down.

A pure rule of temperature in, share of torque out; `robot.toml` carries it as

    [derating]
    knee_fl = { start_c = 62.0, stop_c = 70.0, least = 0.45 }

Whoever commands the robot multiplies with `share`: an environment scales its actions about the joint's resting centre, a
driver its PWM limit. `openant thermal forecast --derate` finds the numbers for one robot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from openant_tools.errors import BadInput

__all__ = ["DeratedJoint", "Derating", "derating_of"]


@dataclass(frozen=True)
class DeratedJoint:
    """The rule of one joint.

    Attributes:
        start_c: up to here all of the torque. stop_c: from here on `least`; a straight line between.
        least: share of torque at which the servo cools again, or holds its temperature.
    """

    start_c: float
    stop_c: float
    least: float

    def share(self, temperature_c: float) -> float:
        """Share of torque, `least` … 1; an unknown temperature (NaN) is taken as cold."""
        if math.isnan(temperature_c):
            return 1.0
        over = (temperature_c - self.start_c) / (self.stop_c - self.start_c)
        return 1.0 - (1.0 - self.least) * min(max(over, 0.0), 1.0)


@dataclass(frozen=True)
class Derating:
    """The rules of a robot: joint → rule; joints without one keep all of their torque."""

    joints: Mapping[str, DeratedJoint]

    def share(self, temperature_c: Mapping[str, float]) -> dict[str, float]:
        """Joint → share of torque, for joints whose temperature is given."""
        return {
            joint: self.joints[joint].share(value) if joint in self.joints else 1.0
            for joint, value in temperature_c.items()
        }

    def as_table(self) -> dict[str, dict[str, float]]:
        """As it stands below `derating` in `robot.toml`."""
        return {name: {key: round(float(v), 3) for key, v in vars(rule).items()} for name, rule in self.joints.items()}


def derating_of(table: Mapping[str, Any], where: str = "robot.toml") -> Derating | None:
    """The rules in a parsed `robot.toml`, None where it has none.

    Raises:
        BadInput: a rule that cannot be, with its place.
    """
    rules = table.get("derating")
    if rules is None:
        return None
    if not isinstance(rules, Mapping):
        raise BadInput("derating is not a table", where=where, remedy="write [derating] and a joint a line")
    joints = {}
    for name, rule in rules.items():
        place = f"{where}, derating.{name}"
        if not isinstance(rule, Mapping) or set(rule) != {"start_c", "stop_c", "least"}:
            raise BadInput(
                "a rule needs start_c, stop_c and least",
                where=place,
                remedy="as `openant thermal forecast --derate` writes",
            )
        numbers = {key: value for key, value in rule.items() if isinstance(value, int | float) and math.isfinite(value)}
        if len(numbers) < 3 or isinstance(rule["least"], bool):
            raise BadInput("start_c, stop_c and least are numbers", where=place)
        if not (rule["start_c"] < rule["stop_c"] and 0 <= rule["least"] <= 1):
            raise BadInput("start_c is below stop_c, and least is 0 … 1", where=place, remedy="mend it there")
        joints[str(name)] = DeratedJoint(float(rule["start_c"]), float(rule["stop_c"]), float(rule["least"]))
    return Derating(joints)
