"""The library of protocols: which motions are recorded under which name, on the stand and on the floor.

A protocol is what one recording holds: segments from rest at home to rest at home. What tells effects apart best takes
several, on the stand and on the floor in two headings (`FULL`); `protocols` gives them in the order in which they are played.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import exact
from openant_tools.sysid.excitation import (
    Around,
    Chirp,
    CommandSpace,
    Holds,
    InTurn,
    Multisine,
    Releases,
    Segment,
    Sine,
    SlowReversals,
    Square,
    Steps,
    smooth,
)
from openant_tools.sysid.floor_motion import Gait, LegLifts, PushUps, Scrub, Twitch, WeightShifts

__all__ = ["FULL", "PROTOCOLS", "CommandSpace", "Part", "Protocol", "protocol", "protocols"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: from home to the middle of the range and back, s, with a rest behind each
APPROACH_S, APPROACH_REST_S = 0.8, 0.3
#: the protocol that is played where none is named
FULL = "full"


@dataclass(frozen=True)
class Protocol:
    """What one recording holds, from rest at home to rest at home.

    Attributes:
        name: what `--protocol` calls it, and the run's facts.
        words: one line for people.
        segments: in order.
        setup: "stand" or "floor".
        heading_rad: of the robot on the floor at the start.
    """

    name: str
    words: str
    segments: tuple[Segment, ...]
    setup: str = "stand"
    heading_rad: float = 0.0

    @property
    def seconds(self) -> float:
        return sum(segment.seconds for segment in self.segments) + 2 * self._approach_s

    @property
    def _approach_s(self) -> float:
        # On its feet a robot is in the middle already.
        return APPROACH_REST_S if self.setup == "floor" else APPROACH_S + APPROACH_REST_S

    def space(self, space: CommandSpace) -> CommandSpace:
        """What of a space the protocol uses: on the floor only what lies evenly about the stand."""
        return space.standing() if self.setup == "floor" else space

    def commands(self, space: CommandSpace, rate_hz: float, seed: int = 0) -> Array:
        """(n, joints) rad at `rate_hz`; the same for the same seed."""
        chance = np.random.default_rng(seed)
        used = self.space(space)
        n = round(self._approach_s * rate_hz)
        approach = smooth(np.arange(n) / (APPROACH_S * rate_hz))[:, None] * (used.centre - used.home) + used.home
        parts = [approach]
        for segment in self.segments:
            parts.append(used.centre + segment.offsets(self._times(segment, rate_hz), used, chance))
        parts.append(approach[::-1])
        return np.clip(np.vstack(parts), np.minimum(used.low, used.home), np.maximum(used.high, used.home))

    def limp(self, space: CommandSpace, rate_hz: float) -> Bools:
        """(n, joints), where torque is off: in the rows of `commands`."""
        used = self.space(space)
        still = np.zeros((round(self._approach_s * rate_hz), len(used.joints)), bool)
        parts = [segment.limp(self._times(segment, rate_hz), used) for segment in self.segments]
        return np.vstack([still, *parts, still])

    def starts(self) -> list[float]:
        """When each segment begins, s."""
        at = np.cumsum([self._approach_s, *(segment.seconds for segment in self.segments)])
        return [float(value) for value in at[:-1]]

    @staticmethod
    def _times(segment: Segment, rate_hz: float) -> Array:
        times: Array = np.arange(round(segment.seconds * rate_hz)) / rate_hz
        return times


@dataclass(frozen=True)
class Part:
    """One recording of a protocol of the library.

    Attributes:
        seconds: how long it is played unless said otherwise.
        segments: what fills a given time.
    """

    seconds: float
    segments: Callable[[float], tuple[Segment, ...]]
    setup: str = "stand"
    heading_rad: float = 0.0


def _stand(seconds: float) -> tuple[Segment, ...]:
    return (
        Chirp(0.35 * seconds),
        Steps(0.25 * seconds),
        Holds(0.2 * seconds),
        SlowReversals(0.2 * seconds),
    )


def _air(seconds: float) -> tuple[Segment, ...]:
    return (
        Multisine(0.22 * seconds),
        Steps(0.22 * seconds, every_s=0.8, largest_rad=SATURATING_RAD),
        SlowReversals(0.19 * seconds),
        Holds(0.2 * seconds),
        Releases(0.17 * seconds),
    )


def _floor(seconds: float) -> tuple[Segment, ...]:
    return (
        WeightShifts(0.19 * seconds),
        LegLifts(0.4 * seconds),
        Scrub(0.19 * seconds),
        Gait(0.22 * seconds),
    )


#: Several times the error at which any servo of a kit gives all its torque (0.1 rad at an XM430, half duty).
SATURATING_RAD = 1.0
SHIFTS = "the body leans one way after another, in two headings: tilt from cable, softness"

#: name → one line for people, and its recordings
PROTOCOLS: Mapping[str, tuple[str, tuple[Part, ...]]] = {
    # Runs and times after a comparison on simulated robots (runs of about 36 s): in the air a mix with holds; on the floor
    # shifts in two headings, lifts, scrub and gait. Hops and push-ups are left out: impacts differ between simulators.
    FULL: (
        "what tells effects apart best",
        (
            Part(20.0, _air),
            Part(16.0, _floor, "floor"),
            Part(4.0, lambda s: (WeightShifts(s),), "floor", math.pi / 2),
        ),
    ),
    "stand": ("chirp, steps, holds and slow reversals: everything a first fit needs", (Part(24.0, _stand),)),
    "chirp": ("a sine of rising frequency: inertia, damping, delay", (Part(12.0, lambda s: (Chirp(s),)),)),
    "steps": ("sudden changes, joint after joint: delay, torque limit", (Part(12.0, lambda s: (Steps(s),)),)),
    "saturating-steps": (
        "large random steps at the torque limit: torque and speed limit, damping",
        (Part(12.0, lambda s: (Steps(s, every_s=0.9, largest_rad=SATURATING_RAD),)),),
    ),
    "holds": ("poses that are held: stiffness, gravity, zeros", (Part(12.0, lambda s: (Holds(s),)),)),
    "long-holds": (
        "poses held for long under gravity: creep, warmth, zeros",
        (Part(20.0, lambda s: (Holds(s, move_s=0.6, hold_s=3.0),)),),
    ),
    "multisine": ("many sines at once: all frequencies all the time", (Part(12.0, lambda s: (Multisine(s),)),)),
    "sine": (
        "sine tracking, slow then fast: lag and delay by eye",
        (Part(12.0, lambda s: (Sine(s / 2, hz=0.5), Sine(s / 2, hz=2.0, share=0.3))),),
    ),
    "square": ("square tracking: delay and rise time by eye", (Part(12.0, lambda s: (Square(s),)),)),
    "slow-reversals": ("a slow triangle: friction, play", (Part(12.0, lambda s: (SlowReversals(s),)),)),
    "releases": (
        "torque off in mid-swing, the leg coasts and is caught: friction without the motor's brake",
        (Part(14.0, lambda s: (Releases(s),)),),
    ),
    "drops": (
        "torque off in a pose that was held, the leg falls and is caught: mass, friction",
        (Part(14.0, lambda s: (Releases(s, share=0.8, limp_s=1.0, from_rest=True),)),),
    ),
    "one-by-one": (
        "each joint alone, then all together: what they share, such as the supply",
        (Part(30.0, lambda s: (InTurn(0.8 * s, Multisine(1.0, low_hz=0.5)), Multisine(0.2 * s, low_hz=0.5))),),
    ),
    "poses": (
        "many sines about three poses: load on the gears",
        (Part(21.0, lambda s: tuple(Around(s / 3, Multisine(1.0, low_hz=0.5), (x,)) for x in (-0.5, 0.0, 0.5))),),
    ),
    "shifts": (
        SHIFTS,
        (
            Part(8.0, lambda s: (WeightShifts(s, holds=8),), "floor"),
            Part(8.0, lambda s: (WeightShifts(s, holds=8),), "floor", math.pi / 2),
        ),
    ),
    "lifts": (
        "one leg after another off the floor: mass, friction, softness",
        (Part(10.0, lambda s: (LegLifts(s),), "floor"),),
    ),
    "scrub": (
        "hips pull against each other until feet slip: floor friction",
        (Part(8.0, lambda s: (Scrub(s),), "floor"),),
    ),
    "gait": ("a trot on the floor: everything at once", (Part(8.0, lambda s: (Gait(s),), "floor"),)),
    "push-ups": ("all knees together: payload, stiffness under load", (Part(8.0, lambda s: (PushUps(s),), "floor"),)),
    "twitch": (
        "fast and small on the floor: contacts must not let it travel",
        (Part(6.0, lambda s: (Twitch(s),), "floor"),),
    ),
}
SHORTEST_S = 5.0
#: s, of one recording: servos grow warm
LONGEST_S = 600.0


def protocols(name: str, seconds: float | None = None, setup: str | None = None) -> tuple[Protocol, ...]:
    """The recordings of a protocol of the library, of about `seconds` in all.

    Args:
        setup: only those on the "stand" or on the "floor".

    Raises:
        BadInput: an unknown name, too short a time, or none in that setup.
    """
    words, parts = _entry(name)
    chosen = tuple(part for part in parts if setup in (None, part.setup))
    if not chosen:
        other = parts[0].setup
        raise BadInput(f"{name} is played on the {other}, not on the {setup}", remedy=f"leave out --setup {setup}")
    return _filled(name, words, chosen, seconds)


def protocol(name: str, seconds: float | None = None) -> Protocol:
    """The first recording of a protocol alone, of about `seconds`; see `protocols`."""
    words, parts = _entry(name)
    return _filled(name, words, parts[:1], seconds)[0]


def _entry(name: str) -> tuple[str, tuple[Part, ...]]:
    try:
        return PROTOCOLS[name]
    except KeyError:
        raise BadInput(f"there is no protocol {name!r}", remedy=f"use one of {', '.join(PROTOCOLS)}") from None


def _filled(name: str, words: str, parts: tuple[Part, ...], seconds: float | None) -> tuple[Protocol, ...]:
    default = sum(part.seconds for part in parts)
    total = default if seconds is None else seconds
    # In a row of recordings the shortest must still hold its motion.
    shortest = SHORTEST_S if len(parts) == 1 else max(SHORTEST_S, default / 2)
    if not total >= shortest:
        raise BadInput(
            f"{exact(total, 's')} is too short for {name}",
            remedy=f"give it {exact(math.ceil(shortest), 's')} or more"
            + (f", which its {len(parts)} recordings share, or record one: --protocol stand" if len(parts) > 1 else ""),
        )
    if total > LONGEST_S * len(parts):
        raise BadInput(
            f"{exact(total, 's')} is too long for {name}",
            remedy=f"record for {exact(LONGEST_S, 's')} at most, and repeat",
        )
    played = []
    for part in parts:
        empty = Protocol(name, words, (), part.setup, part.heading_rad)
        segments = part.segments(part.seconds * total / default - empty.seconds)
        played.append(Protocol(name, words, segments, part.setup, part.heading_rad))
    return tuple(played)
