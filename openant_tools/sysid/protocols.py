"""Excitations as data: what a robot on its stand is asked to do so that its parameters can be told.

A protocol is a row of segments; each begins and ends at rest in the middle of the allowed range, and the whole begins
and ends at rest in the home pose. All that chance decides comes from one seed, so that a repeat plays the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD, HOME_RAD

__all__ = [
    "PROTOCOLS",
    "Chirp",
    "CommandSpace",
    "Holds",
    "Multisine",
    "Protocol",
    "Rest",
    "Segment",
    "SlowReversals",
    "Steps",
    "protocol",
]

Array = NDArray[np.float64]

#: Shares of the way round a circle that are as far apart as can be for any number of joints.
GOLDEN = (5**0.5 - 1) / 2
#: s in which an excitation fades in and out.
FADE_S = 0.5
#: from home to the middle of the range and back, s, with a rest behind each
APPROACH_S, APPROACH_REST_S = 0.8, 0.3


@dataclass(frozen=True)
class CommandSpace:
    """Where commands may go.

    Attributes:
        joints: names, in order.
        home: (joints,) rad, where it begins and ends.
        low, high: (joints,) rad, bounds of all commands.
        speed: rad/s, fastest command of smooth segments.
    """

    joints: tuple[str, ...]
    home: Array
    low: Array
    high: Array
    speed: float = 3.0

    @property
    def centre(self) -> Array:
        return (self.low + self.high) / 2

    @property
    def half(self) -> Array:
        return (self.high - self.low) / 2

    @classmethod
    def around_home(
        cls,
        limits_rad: Mapping[str, tuple[float, float]] | None = None,
        joints: Sequence[str] = tuple(JOINTS),
        *,
        reach_rad: float = 0.6,
        margin_rad: float = 0.05,
    ) -> CommandSpace:
        """Within `reach_rad` of the home pose and `margin_rad` inside the limits (default: the kit's)."""
        limits = dict(limits_rad or {})
        for joint in joints:
            angle = ANGLE_LIMIT_RAD[JOINTS[joint].kind]
            limits.setdefault(joint, (-angle, angle))
        home = np.array([HOME_RAD[JOINTS[joint].kind] for joint in joints])
        low = np.array([limits[joint][0] + margin_rad for joint in joints])
        high = np.array([limits[joint][1] - margin_rad for joint in joints])
        narrow = [joint for joint, a, b, h in zip(joints, low, high, home, strict=True) if not a <= h <= b]
        if narrow:
            raise BadInput(
                f"the limits of {', '.join(narrow)} leave no room around the home pose",
                remedy="widen min_rad and max_rad in robot.toml",
            )
        return cls(tuple(joints), home, np.maximum(low, home - reach_rad), np.minimum(high, home + reach_rad))


class Segment(Interface):
    """One piece of a protocol.

    Attributes:
        seconds: how long it takes.
    """

    @property
    def seconds(self) -> float: ...

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        """Commands relative to the middle, (n, joints) rad, at times `t` (n,) s since it began; zero at both ends."""
        ...


@dataclass(frozen=True)
class Rest:
    """Nothing moves."""

    seconds: float

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        return np.zeros((len(t), len(space.joints)))


@dataclass(frozen=True)
class Chirp:
    """A sine whose frequency rises from `low_hz` to `high_hz` exponentially; its speed is bounded by the space's.

    x(t) = a(t) sin(2π f₀ (kᵗ − 1)/ln k + φ), k = (f₁/f₀)^(1/T), a(t) = min(share · half range, speed / (2π f(t))).
    Each joint has a phase φ and, within ±15 %, frequencies of its own, so that no two move alike.
    """

    seconds: float
    low_hz: float = 0.2
    high_hz: float = 4.0
    share: float = 0.8

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        joints = np.arange(len(space.joints))
        pace = 1.0 + 0.3 * ((GOLDEN * (joints + 1)) % 1.0 - 0.5)
        rate = np.log(self.high_hz / self.low_hz) / self.seconds
        frequency = self.low_hz * np.exp(rate * t)[:, None] * pace
        angle = 2 * np.pi * (frequency - self.low_hz * pace) / rate + 2 * np.pi * GOLDEN * joints
        amplitude = np.minimum(self.share * space.half, space.speed / (2 * np.pi * frequency))
        out: Array = amplitude * np.sin(angle) * _fade(t, self.seconds)[:, None]
        return out


@dataclass(frozen=True)
class Steps:
    """Sudden changes of one joint after another, `every_s` apart for each joint, no larger than `largest_rad`."""

    seconds: float
    every_s: float = 1.0
    largest_rad: float = 0.35
    share: float = 0.9

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        n = len(space.joints)
        out = np.zeros((len(t), n))
        for k in range(n):
            at, level = self.every_s * ((GOLDEN * (k + 1)) % 1.0), 0.0
            reach = self.share * space.half[k]
            while at < self.seconds - self.every_s / 2:
                new = float(np.clip(chance.uniform(-reach, reach), level - self.largest_rad, level + self.largest_rad))
                level = new
                out[t >= at, k] = level
                at += self.every_s * chance.uniform(0.7, 1.3)
        # The last change of every joint leads back to the middle, gently.
        last = max(self.seconds - self.every_s / 2, 0.0)
        back = 1.0 - _smooth((t - last) / max(self.seconds - last - 0.1, 1e-9))
        return out * back[:, None]


@dataclass(frozen=True)
class Holds:
    """Smooth ways between poses of chance that are held: what stiffness, gravity and zeros are read from."""

    seconds: float
    move_s: float = 0.5
    hold_s: float = 0.8
    share: float = 0.9

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        poses = max(1, int((self.seconds - self.move_s) / (self.move_s + self.hold_s)))
        period = (self.seconds - self.move_s) / poses
        levels = chance.uniform(-1, 1, (poses, len(space.joints))) * self.share * space.half
        levels = np.vstack([np.zeros(len(space.joints)), levels, np.zeros(len(space.joints))])
        out = np.zeros((len(t), len(space.joints)))
        for k in range(poses + 1):
            out += _smooth((t - k * period) / self.move_s)[:, None] * (levels[k + 1] - levels[k])
        return out


@dataclass(frozen=True)
class SlowReversals:
    """A slow triangle about the middle: friction and play show at its corners and nowhere else."""

    seconds: float
    speed_rad_s: float = 0.15
    amplitude_rad: float = 0.12

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        amplitude = np.minimum(self.amplitude_rad, 0.9 * space.half)
        # A whole number of periods, joint by joint, so that it ends where it began.
        periods = np.maximum(1, np.round(self.seconds * self.speed_rad_s / (4 * amplitude)))
        phase = np.clip(t / self.seconds, 0, 1)[:, None] * periods
        triangle = 2 * np.abs(2 * ((phase + 0.25) % 1) - 1) - 1
        out: Array = -amplitude * triangle
        return out


@dataclass(frozen=True)
class Multisine:
    """Several sines at once, at random phases: all frequencies all the time."""

    seconds: float
    low_hz: float = 0.2
    high_hz: float = 5.0
    lines: int = 12
    share: float = 0.8

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        frequencies = np.geomspace(self.low_hz, self.high_hz, self.lines)
        phases = chance.uniform(0, 2 * np.pi, (self.lines, len(space.joints)))
        waves = np.sin(2 * np.pi * frequencies[:, None, None] * t[None, :, None] + phases[:, None, :])
        # Equal speed per line, then scaled so that neither range nor speed is passed.
        summed = np.einsum("l,lnj->nj", 1 / frequencies, waves)
        speed = np.abs(np.diff(summed, axis=0)).max(0) / max(float(np.diff(t).mean()), 1e-9)
        scale = np.minimum(self.share * space.half / np.abs(summed).max(0), space.speed / speed)
        out: Array = scale * summed * _fade(t, self.seconds)[:, None]
        return out


@dataclass(frozen=True)
class Protocol:
    """What is played, from rest at home to rest at home.

    Attributes:
        name: what `--protocol` calls it, and the run's facts.
        words: one line for people.
        segments: in order.
    """

    name: str
    words: str
    segments: tuple[Segment, ...]

    @property
    def seconds(self) -> float:
        return sum(segment.seconds for segment in self.segments) + 2 * (APPROACH_S + APPROACH_REST_S)

    def commands(self, space: CommandSpace, rate_hz: float, seed: int = 0) -> Array:
        """(n, joints) rad at `rate_hz`; the same for the same seed."""
        chance = np.random.default_rng(seed)
        n = round((APPROACH_S + APPROACH_REST_S) * rate_hz)
        approach = _smooth(np.arange(n) / (APPROACH_S * rate_hz))[:, None] * (space.centre - space.home) + space.home
        parts = [approach]
        for segment in self.segments:
            t = np.arange(round(segment.seconds * rate_hz)) / rate_hz
            parts.append(space.centre + segment.offsets(t, space, chance))
        parts.append(approach[::-1])
        return np.clip(np.vstack(parts), np.minimum(space.low, space.home), np.maximum(space.high, space.home))


def _smooth(share: Array) -> Array:
    """Minimum jerk from 0 to 1 over share 0…1."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _fade(t: Array, seconds: float) -> Array:
    fade = min(FADE_S, seconds / 4)
    return _smooth(t / fade) * _smooth((seconds - t) / fade)


def _stand(seconds: float) -> tuple[Segment, ...]:
    return (
        Chirp(0.35 * seconds),
        Steps(0.25 * seconds),
        Holds(0.2 * seconds),
        SlowReversals(0.2 * seconds),
    )


#: name → (one line for people, default seconds, segments that fill a time)
PROTOCOLS: Mapping[str, tuple[str, float, Callable[[float], tuple[Segment, ...]]]] = {
    "stand": ("chirp, steps, holds and slow reversals: everything a first fit needs", 24.0, _stand),
    "chirp": ("a sine of rising frequency: inertia, damping, delay", 12.0, lambda s: (Chirp(s),)),
    "steps": ("sudden changes, joint after joint: delay, torque limit", 12.0, lambda s: (Steps(s),)),
    "holds": ("poses that are held: stiffness, gravity, zeros", 12.0, lambda s: (Holds(s),)),
    "multisine": ("many sines at once: all frequencies all the time", 12.0, lambda s: (Multisine(s),)),
    "slow-reversals": ("a slow triangle: friction, play", 12.0, lambda s: (SlowReversals(s),)),
}
SHORTEST_S = 5.0


def protocol(name: str, seconds: float | None = None) -> Protocol:
    """A protocol by name, of about `seconds` in all; raises BadInput for an unknown name or too short a time."""
    try:
        words, default, segments = PROTOCOLS[name]
    except KeyError:
        raise BadInput(f"there is no protocol {name!r}", remedy=f"use one of {', '.join(PROTOCOLS)}") from None
    total = default if seconds is None else seconds
    if not total >= SHORTEST_S:
        raise BadInput(f"{total} s is too short for {name}", remedy=f"give it {SHORTEST_S:.0f} s or more")
    return Protocol(name, words, segments(total - 2 * (APPROACH_S + APPROACH_REST_S)))
