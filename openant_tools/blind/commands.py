"""What the robots of a set are made to do: one table of commands for all of them.

Three runs on the stand and four on the floor, the last of each with another seed, to be held out. On the stand a mix that
saturates, then slow reversals, poses held under gravity and releases with torque off; on the floor weight shifts and scrub in
two headings, legs lifted one by one, and a trot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.robot.joints import JOINTS
from openant_tools.sysid.excitation import (
    Chirp,
    CommandSpace,
    Holds,
    Multisine,
    Releases,
    Segment,
    SlowReversals,
    Steps,
)
from openant_tools.sysid.floor_motion import Gait, LegLifts, Scrub, WeightShifts
from openant_tools.sysid.protocols import SATURATING_RAD, Protocol

__all__ = ["RATE_HZ", "Motion", "motions"]

RATE_HZ = 50.0
_LARGE = SATURATING_RAD


@dataclass(frozen=True)
class Motion:
    """One run that every robot of a set plays.

    Attributes:
        commands: (n, joints) rad, at RATE_HZ. limp: (n, joints), where torque is off.
        held_out: played to judge by, with another seed.
    """

    name: str
    protocol: str
    setup: str
    heading_rad: float
    commands: NDArray[np.float64]
    limp: NDArray[np.bool_]
    held_out: bool

    @property
    def seconds(self) -> float:
        return len(self.commands) / RATE_HZ


_STAND: tuple[tuple[str, tuple[Segment, ...]], ...] = (
    ("mix", (Chirp(3.2), Steps(3.2, every_s=0.8, largest_rad=_LARGE))),
    ("holds", (SlowReversals(3.2), Holds(2.6), Releases(3.0, limp_s=0.8))),
    (
        "mix-and-holds",
        (
            Multisine(2.2),
            Steps(2.2, every_s=0.8, largest_rad=_LARGE),
            SlowReversals(1.6, speed_rad_s=0.3),
            Releases(3.0, limp_s=0.8),
        ),
    ),
)
_FLOOR: tuple[tuple[str, float, tuple[Segment, ...]], ...] = (
    ("shifts", 0.0, (WeightShifts(3.8), Scrub(3.4))),
    ("shifts", math.pi / 2, (WeightShifts(3.8), Scrub(3.4))),
    ("lifts", 0.0, (LegLifts(7.4),)),
    ("gait-and-shifts", 0.0, (Gait(3.6), WeightShifts(3.6))),
)


def motions(seed: int) -> tuple[Motion, ...]:
    """The runs of a set, the same for the same seed."""
    space = CommandSpace.around_home(joints=tuple(JOINTS))
    parts = [(name, "stand", 0.0, segments) for name, segments in _STAND]
    parts += [(name, "floor", heading, segments) for name, heading, segments in _FLOOR]
    last = {setup: max(k for k, part in enumerate(parts) if part[1] == setup) for setup in ("stand", "floor")}
    found, count = [], dict.fromkeys(last, 0)
    for k, (name, setup, heading, segments) in enumerate(parts):
        count[setup] += 1
        protocol = Protocol(name, "", segments, setup, heading)
        found.append(
            Motion(
                f"{setup}-{count[setup]}", name, setup, heading, protocol.commands(space, RATE_HZ, seed + 1009 * k),
                protocol.limp(space, RATE_HZ), k == last[setup],
            )
        )  # fmt: skip
    return tuple(found)
