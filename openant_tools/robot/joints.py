"""The eight joints of an Open Ant: names, servo ids, legs, and how each stands in the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

__all__ = ["JOINTS", "JOINT_NAMES", "LEGS", "Joint", "Kind", "Leg"]

Kind = Literal["hip", "knee"]


@dataclass(frozen=True)
class Leg:
    """One leg.

    Attributes:
        name: two letters, front or rear and left or right.
        words: the name spelled out.
        x_sign, y_sign: on which side of the torso's centre it stands (x forward, y left).
    """

    name: str
    words: str
    x_sign: int
    y_sign: int

    @property
    def knee_axis(self) -> tuple[int, int, int]:
        """The knee's axis before normalisation, in the torso's frame at hip 0; + lifts the tip of every leg."""
        return (self.y_sign, -self.x_sign, 0)


@dataclass(frozen=True)
class Joint:
    """One joint and the id that its servo carries on a robot built by the platform's guide."""

    name: str
    id: int
    leg: Leg
    kind: Kind

    @property
    def axis(self) -> tuple[int, int, int]:
        """The positive axis, not normalised, in the torso's frame at hip 0: + turns a hip counter-clockwise seen
        from above and lifts the tip of the leg at a knee."""
        return (0, 0, 1) if self.kind == "hip" else self.leg.knee_axis

    @property
    def words(self) -> str:
        return f"{self.leg.words} {self.kind}"


#: In the order of the platform's servo ids and of its MJCF.
LEGS: tuple[Leg, ...] = (
    Leg("rr", "rear right", -1, -1),
    Leg("fr", "front right", 1, -1),
    Leg("fl", "front left", 1, 1),
    Leg("rl", "rear left", -1, 1),
)

_KINDS: tuple[Kind, Kind] = ("hip", "knee")

#: name → joint, in the order of actions and observations.
JOINTS: Mapping[str, Joint] = {
    f"{kind}_{leg.name}": Joint(f"{kind}_{leg.name}", 10 * (n + 1) + k, leg, kind)
    for n, leg in enumerate(LEGS)
    for k, kind in enumerate(_KINDS)
}

JOINT_NAMES: tuple[str, ...] = tuple(JOINTS)
