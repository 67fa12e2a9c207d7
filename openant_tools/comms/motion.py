"""What the engine plays: ramps that never jump, and sampled commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["RAMP_SPEED_RAD_S", "Motion", "hold", "play", "ramp"]

Array = NDArray[np.float64]

#: fastest speed of a ramp: a leg that swings to its start so slowly can be caught by hand
RAMP_SPEED_RAD_S = 1.0
SHORTEST_RAMP_S = 0.3
#: peak speed of the minimum-jerk profile over its mean: 15/8
_PEAK_OVER_MEAN = 1.875


@dataclass
class Motion:
    """Commands at the loop's rate, one row a cycle; the last row is held when it has ended.

    Attributes:
        name: for messages and progress.
        commands: (n, joints) rad.
        done: rows played so far.
    """

    name: str
    commands: Array
    done: int = 0

    @property
    def ended(self) -> bool:
        return self.done >= len(self.commands)

    def step(self, cycles: int) -> Array:
        """The row now due after `cycles` more cycles (more than one where the loop was late), (joints,)."""
        self.done = min(self.done + cycles, len(self.commands))
        row: Array = self.commands[self.done - 1]
        return row


def ramp(
    start: Array, end: Array, rate_hz: float, *, speed_rad_s: float = RAMP_SPEED_RAD_S, name: str = "ramp"
) -> Motion:
    """Minimum jerk from `start` to `end` (joints,), all joints arriving together, none faster than `speed_rad_s`."""
    distance = float(np.abs(end - start).max())
    seconds = max(_PEAK_OVER_MEAN * distance / speed_rad_s, SHORTEST_RAMP_S)
    s = np.arange(1, round(seconds * rate_hz) + 1) / round(seconds * rate_hz)
    share = s**3 * (10 - 15 * s + 6 * s**2)
    return Motion("ramp", start + share[:, None] * (end - start))


def hold(position: Array, seconds: float, rate_hz: float) -> Motion:
    """Stay at `position` (joints,)."""
    return Motion("hold", np.repeat(position[None, :], max(1, round(seconds * rate_hz)), axis=0))


def play(start: Array, commands: Array, rate_hz: float, name: str) -> list[Motion]:
    """`commands` (n, joints), preceded by a ramp from where the robot is, unless it is there already."""
    motions = []
    if float(np.abs(commands[0] - start).max()) > RAMP_SPEED_RAD_S / rate_hz:
        motions.append(ramp(start, commands[0], rate_hz))
    return [*motions, Motion(name, commands)]
