"""What joints are asked to do so that their parameters can be told: motions within a space of commands, as data.

A segment begins and ends at rest in the middle of its space. All that chance decides comes from one generator, so that
a repeat plays the same. Segments are plain numbers, written to and read from plans (`plan_file`).
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD, HOME_RAD

__all__ = [
    "Around", "Chirp", "CommandSpace", "Holds", "InTurn", "Multisine", "Releases", "Rest", "Segment", "Sine",
    "SlowReversals", "Square", "Steps", "fade", "smooth",
]  # fmt: skip

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: Shares of the way round a circle that are as far apart as can be for any number of joints.
GOLDEN = (5**0.5 - 1) / 2
#: s in which an excitation fades in and out.
FADE_S = 0.5
#: to another pose and back, s, with a rest behind each
MOVE_S, REST_S = 0.6, 0.2


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

    def standing(self) -> CommandSpace:
        """What of it lies evenly about home, where a robot on its feet stands."""
        reach = np.minimum(self.high - self.home, self.home - self.low)
        return replace(self, low=self.home - reach, high=self.home + reach)

    def around(self, shares: Array) -> CommandSpace:
        """What of it lies evenly about another middle, `shares` (joints,) of the half range away from this one."""
        reach = self.half * (1 - np.abs(shares))
        middle = self.centre + shares * self.half
        return replace(self, low=middle - reach, high=middle + reach)


@dataclass(frozen=True)
class Segment(abc.ABC):
    """One piece of a protocol.

    Attributes:
        seconds: how long it takes.
    """

    seconds: float

    @abc.abstractmethod
    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        """Commands relative to the middle, (n, joints) rad, at times `t` (n,) s since it began; zero at both ends."""

    def limp(self, t: Array, space: CommandSpace) -> Bools:
        """(n, joints), where a joint's torque is off: nowhere, unless a segment says otherwise."""
        return np.zeros((len(t), len(space.joints)), bool)


@dataclass(frozen=True)
class Rest(Segment):
    """Nothing moves."""

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        return np.zeros((len(t), len(space.joints)))


@dataclass(frozen=True)
class Chirp(Segment):
    """A sine whose frequency rises from `low_hz` to `high_hz` exponentially; its speed is bounded by the space's.

    x(t) = a(t) sin(2π f₀ (kᵗ − 1)/ln k + φ), k = (f₁/f₀)^(1/T), a(t) = min(share · half range, speed / (2π f(t))).
    Each joint has a phase φ and, within ±15 %, frequencies of its own, so that no two move alike.
    """

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
        out: Array = amplitude * np.sin(angle) * fade(t, self.seconds)[:, None]
        return out


@dataclass(frozen=True)
class Steps(Segment):
    """Sudden changes of one joint after another, `every_s` apart for each joint, no larger than `largest_rad`."""

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
        back = 1.0 - smooth((t - last) / max(self.seconds - last - 0.1, 1e-9))
        return out * back[:, None]


@dataclass(frozen=True)
class Holds(Segment):
    """Smooth ways between poses of chance that are held: what stiffness, gravity and zeros are read from."""

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
            out += smooth((t - k * period) / self.move_s)[:, None] * (levels[k + 1] - levels[k])
        return out


@dataclass(frozen=True)
class SlowReversals(Segment):
    """A slow triangle about the middle: friction and play show at its corners and nowhere else."""

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
class Multisine(Segment):
    """Several sines at once, at random phases: all frequencies all the time."""

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
        out: Array = scale * summed * fade(t, self.seconds)[:, None]
        return out


@dataclass(frozen=True)
class Sine(Segment):
    """One sine, all joints together, a quarter period apart from joint to joint: tracking as one looks at it by eye."""

    hz: float = 0.5
    share: float = 0.6

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        amplitude = np.minimum(self.share * space.half, space.speed / (2 * np.pi * self.hz))
        phase = np.pi / 2 * np.arange(len(space.joints))
        out: Array = amplitude * np.sin(2 * np.pi * self.hz * t[:, None] + phase) * fade(t, self.seconds)[:, None]
        return out


@dataclass(frozen=True)
class Square(Segment):
    """Up and down between two levels, every second joint the other way: delay and rise time as one looks at them by eye.

    The joints do not step at the same moment: eight servos that start at once draw more than the supply gives.
    """

    hz: float = 0.5
    amplitude_rad: float = 0.15

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        amplitude = np.minimum(self.amplitude_rad, 0.9 * space.half)
        joints = np.arange(len(space.joints))
        periods = max(1, round(self.seconds * self.hz))
        # Rest, up, down, rest, each a quarter period, less what a joint comes later than the first.
        turn = (t / self.seconds * periods)[:, None] - 0.2 * ((GOLDEN * (joints + 1)) % 1.0)
        level = ((turn % 1.0 >= 0.25) & (turn % 1.0 < 0.5)).astype(float)
        level -= (turn % 1.0 >= 0.5) & (turn % 1.0 < 0.75)
        out: Array = np.where(turn < 0, 0.0, level) * np.where(joints % 2, -1.0, 1.0) * amplitude
        return out


@dataclass(frozen=True)
class InTurn(Segment):
    """Another segment by one joint alone, then by the next, each with its share of the time; the others rest.

    What joints have in common (supply, gravity of the legs above) acts only where they move together.
    """

    of: Segment

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        out = np.zeros((len(t), len(space.joints)))
        for k, (rows, segment) in enumerate(self._shares(t, space)):
            if rows.any():
                out[rows, k] = segment.offsets(t[rows] - t[rows][0], space, chance)[:, k]
        return out

    def limp(self, t: Array, space: CommandSpace) -> Bools:
        out = super().limp(t, space)
        for k, (rows, segment) in enumerate(self._shares(t, space)):
            if rows.any():
                out[rows, k] = segment.limp(t[rows] - t[rows][0], space)[:, k]
        return out

    def _shares(self, t: Array, space: CommandSpace) -> list[tuple[Bools, Segment]]:
        each = self.seconds / len(space.joints)
        index = np.minimum((t / each + 1e-9).astype(int), len(space.joints) - 1)
        segment = replace(self.of, seconds=each)
        return [(index == k, segment) for k in range(len(space.joints))]


@dataclass(frozen=True)
class Around(Segment):
    """Another segment about another middle: `shares` of the half range away, one for each joint, or one for all.

    Gravity pulls otherwise in another pose, so that offsets, masses and what depends on load show.
    """

    of: Segment
    shares: tuple[float, ...] = (0.3,)

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        shares, inside = self._shares(space), self._inside(t)
        there = smooth(t / MOVE_S) * smooth((self.seconds - t) / MOVE_S)
        out: Array = there[:, None] * shares * space.half
        # In one sample nothing moves: a short pose in a slow protocol may have no more.
        if np.count_nonzero(inside) > 1:
            out[inside] += self._inner().offsets(t[inside] - t[inside][0], space.around(shares), chance)
        return out

    def limp(self, t: Array, space: CommandSpace) -> Bools:
        out, inside = super().limp(t, space), self._inside(t)
        if inside.any():
            out[inside] = self._inner().limp(t[inside] - t[inside][0], space.around(self._shares(space)))
        return out

    def _shares(self, space: CommandSpace) -> Array:
        if len(self.shares) not in (1, len(space.joints)):
            raise BadInput(
                f"a middle for {len(self.shares)} joints, where {len(space.joints)} move",
                remedy="give one share for all, or one for each joint",
            )
        return np.broadcast_to(np.asarray(self.shares, float), (len(space.joints),))

    def _inside(self, t: Array) -> Bools:
        inside: Bools = (t >= MOVE_S + REST_S) & (t < self.seconds - MOVE_S - REST_S)
        return inside

    def _inner(self) -> Segment:
        return replace(self.of, seconds=max(self.seconds - 2 * (MOVE_S + REST_S), 1e-3))


@dataclass(frozen=True)
class Releases(Segment):
    """Torque off in the middle of a swing, or from a pose that was held: the leg coasts or falls, hangs, and is caught.

    Without torque a servo's gains and back-EMF are gone; what is left is friction, inertia and gravity. Each cycle swings
    the other way.
    """

    speed_rad_s: float = 1.5
    share: float = 0.5
    limp_s: float = 0.7
    from_rest: bool = False

    #: s, about what a cycle needs until the leg that was caught is back
    CYCLE_S = 3.0
    PREPARE_S = 0.5

    def _cycles(self) -> tuple[int, float]:
        n = max(1, int(self.seconds / self.CYCLE_S + 1e-9))
        return n, self.seconds / n

    def _sweep_s(self, space: CommandSpace) -> float:
        # Minimum jerk has 15/8 of its mean speed in the middle.
        longest = 2 * self.share * float(space.half.max())
        return 1.875 * longest / self.speed_rad_s

    def _release_s(self, space: CommandSpace) -> float:
        return self.PREPARE_S + (0.3 if self.from_rest else self._sweep_s(space) / 2)

    def offsets(self, t: Array, space: CommandSpace, chance: np.random.Generator) -> Array:
        _, period = self._cycles()
        cycle, at = np.divmod(t, period)
        sign = np.where(cycle % 2, -1.0, 1.0)
        release, sweep = self._release_s(space), self._sweep_s(space)
        share = smooth(at / self.PREPARE_S)  # from rest: up first, for knees
        if not self.from_rest:
            share = 2 * smooth((at - self.PREPARE_S) / sweep) - share
        # By the time it is caught the command is in the middle again; the engine starts from where the leg hangs.
        share = np.where(at < release + self.limp_s, share, 0.0)
        out: Array = (sign * share)[:, None] * self.share * space.half
        return out

    def limp(self, t: Array, space: CommandSpace) -> Bools:
        _, period = self._cycles()
        at = t % period
        release = self._release_s(space)
        off = (at >= release) & (at < min(release + self.limp_s, period - 0.3))
        return np.repeat(off[:, None], len(space.joints), axis=1)


def smooth(share: Array) -> Array:
    """Minimum jerk from 0 to 1 over share 0…1."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def fade(t: Array, seconds: float) -> Array:
    """From 0 to 1 and back to 0 within FADE_S at both ends."""
    each = min(FADE_S, seconds / 4)
    return smooth(t / each) * smooth((seconds - t) / each)
