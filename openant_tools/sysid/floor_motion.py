"""What an Open Ant is asked to do on the floor, standing, so that body, floor and contact can be told.

All are offsets from the stand (see `excitation.Segment`): hips turn counter-clockwise seen from above, knees lift.
Signs come from where the legs stand, so that on level ground nothing pushes the robot along unless it is to walk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINTS, LEGS, Leg
from openant_tools.sysid.excitation import CommandSpace, Segment, fade, smooth

__all__ = ["Gait", "LegLifts", "PushUps", "Scrub", "Twitch", "WeightShifts"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Legs:
    """Where the legs' joints are among the columns of a space.

    Attributes:
        hip, knee: (4,) columns, in the order of LEGS.
        angle: (4,) rad, direction in which each leg points from the torso.
    """

    hip: NDArray[np.int64]
    knee: NDArray[np.int64]
    angle: Array

    @classmethod
    def of(cls, space: CommandSpace) -> _Legs:
        if set(space.joints) != set(JOINTS):
            raise BadInput(
                "motions on the floor need the eight joints of an Open Ant",
                remedy="use a protocol for the stand, see `openant sysid record --list`",
            )
        columns = {name: k for k, name in enumerate(space.joints)}
        return cls(
            np.array([columns[f"hip_{leg.name}"] for leg in LEGS]),
            np.array([columns[f"knee_{leg.name}"] for leg in LEGS]),
            np.array([_direction(leg) for leg in LEGS]),
        )


def _direction(leg: Leg) -> float:
    return float(np.arctan2(leg.y_sign, leg.x_sign))


@dataclass(frozen=True)
class WeightShifts(Segment):
    """The body leans one way after another and stays there: what stiffness, softness, tilt and a cable change.

    The knees on the side it leans to give way by A cos(φ − direction), those on the other side straighten.
    """

    holds: int = 4
    move_s: float = 0.3
    share: float = 0.7

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        legs = _Legs.of(space)
        out = np.zeros((len(t), len(space.joints)))
        first = chance.uniform(0, 2 * np.pi)
        directions = first + 2 * np.pi * np.arange(self.holds) / self.holds
        levels = self.share * np.cos(legs.angle - directions[:, None])
        levels = np.vstack([np.zeros(4), levels, np.zeros(4)])
        move = min(self.move_s, self.seconds / (self.holds + 1))
        period = (self.seconds - move) / self.holds
        for k in range(self.holds + 1):
            out[:, legs.knee] += smooth((t - k * period) / move)[:, None] * (levels[k + 1] - levels[k])
        out[:, legs.knee] *= space.half[legs.knee]
        return out


@dataclass(frozen=True)
class LegLifts(Segment):
    """One leg after another off the floor, while the other three carry the robot.

    Three feet in a right angle carry a body only on their edge: the neighbours first turn towards the leg that is lifted.
    """

    lift_share: float = 0.8
    support_rad: float = 0.25

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        legs = _Legs.of(space)
        out = np.zeros((len(t), len(space.joints)))
        each = self.seconds / len(legs.hip)
        lift = self.lift_share * space.half[legs.knee]
        for k in range(len(legs.hip)):
            at = t - k * each
            support = smooth(at / (0.25 * each)) * smooth((each - at) / (0.25 * each))
            up = smooth((at - 0.25 * each) / (0.15 * each)) * smooth((0.75 * each - at) / (0.15 * each))
            # Towards the lifted leg by the shorter way; the opposite one, half a turn away, stays.
            away = np.angle(np.exp(1j * (legs.angle[k] - legs.angle)))
            turn = np.where(np.abs(np.abs(away) - np.pi / 2) < 1e-6, np.sign(away), 0.0)
            reach = np.minimum(self.support_rad, space.half[legs.hip])
            out[:, legs.hip] += support[:, None] * turn * reach
            out[:, legs.knee[k]] += up * lift[k]
        return out


@dataclass(frozen=True)
class Scrub(Segment):
    """Neighbouring legs pull against each other until their feet slip: floor friction, and nothing that moves the body.

    The pairs that pull take turns: front and rear pair, then left and right.
    """

    hz: float = 0.6
    amplitude_rad: float = 0.3

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        legs = _Legs.of(space)
        out = np.zeros((len(t), len(space.joints)))
        sign = -np.sign(np.sin(2 * legs.angle))
        amplitude = np.minimum(self.amplitude_rad, space.half[legs.hip])
        wave = np.sin(2 * np.pi * self.hz * t) * fade(t, self.seconds)
        out[:, legs.hip] = wave[:, None] * sign * amplitude
        return out


@dataclass(frozen=True)
class Gait(Segment):
    """A trot: diagonal legs swing together, feet up while they go forward."""

    hz: float = 1.0
    stride_rad: float = 0.3
    lift_share: float = 0.7

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        legs = _Legs.of(space)
        out = np.zeros((len(t), len(space.joints)))
        diagonal = np.sign(np.sin(2 * legs.angle))  # + front left and rear right
        left = np.sign(np.sin(legs.angle))
        phase = 2 * np.pi * self.hz * t[:, None] + np.pi * (diagonal > 0)
        whole = fade(t, self.seconds)[:, None]
        stride = np.minimum(self.stride_rad, space.half[legs.hip])
        # A left leg's foot goes forward where its hip turns clockwise.
        out[:, legs.hip] = -whole * left * stride * np.sin(phase)
        out[:, legs.knee] = whole * self.lift_share * space.half[legs.knee] * np.maximum(np.cos(phase), 0.0)
        return out


@dataclass(frozen=True)
class PushUps(Segment):
    """All knees together: the body's weight up and down, never off the floor."""

    hz: float = 0.7
    share: float = 0.8

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        legs = _Legs.of(space)
        out = np.zeros((len(t), len(space.joints)))
        amplitude = np.minimum(self.share * space.half[legs.knee], space.speed / (2 * np.pi * self.hz))
        wave = np.sin(2 * np.pi * self.hz * t) * fade(t, self.seconds)
        out[:, legs.knee] = wave[:, None] * amplitude
        return out


@dataclass(frozen=True)
class Twitch(Segment):
    """Fast and small, legs against each other: a simulated robot whose contacts are right does not travel by it."""

    hz: float = 8.0
    amplitude_rad: float = 0.05

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        legs = _Legs.of(space)
        out = np.zeros((len(t), len(space.joints)))
        sign = np.sign(np.sin(2 * legs.angle))
        wave = np.sin(2 * np.pi * self.hz * t)[:, None] * fade(t, self.seconds)[:, None]
        for columns, quarter in ((legs.hip, 1.0), (legs.knee, -1.0)):
            amplitude = np.minimum(self.amplitude_rad, space.half[columns])
            out[:, columns] = quarter * wave * sign * amplitude
        return out
