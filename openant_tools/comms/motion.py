"""What the engine plays: ramps that never jump, and sampled commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["RAMP_SPEED_RAD_S", "Motion", "catch", "held", "hold", "play", "ramp"]

Array = NDArray[np.float64]

#: fastest speed of a ramp: a leg that swings to its start so slowly can be caught by hand
RAMP_SPEED_RAD_S = 1.0
#: s; a shorter ramp over a few counts would be a jerk
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
        limp: (n, joints), where torque is off; None where it is on throughout.
        number: of the command that it came with, for those that telemetry is to tell apart.
        measured: whether where the joints are is to be read once more when it has ended.
        agent: s, when the observation was made and the action chosen that this carries out; None where nobody said.
        arrives: whether it has ended only when the joints are there.
        judged: whether joints that do not go where they are sent stop it; a learner may push where it likes.
    """

    name: str
    commands: Array
    done: int = 0
    limp: NDArray[np.bool_] | None = None
    number: int = 0
    measured: bool = True
    agent: tuple[float, float] | None = None
    arrives: bool = False
    judged: bool = True

    @property
    def ended(self) -> bool:
        return self.done >= len(self.commands)

    def step(self, cycles: int) -> Array:
        """The row now due after `cycles` more cycles (more than one where the loop was late), (joints,)."""
        self.done = min(self.done + cycles, len(self.commands))
        row: Array = self.commands[self.done - 1]
        return row

    @property
    def limp_now(self) -> NDArray[np.bool_]:
        """(joints,), which joints have no torque in the row that `step` gave last."""
        if self.limp is None:
            return np.zeros(self.commands.shape[1], bool)
        row: NDArray[np.bool_] = self.limp[max(self.done - 1, 0)]
        return row


def ramp(start: Array, end: Array, rate_hz: float, *, speed_rad_s: float = RAMP_SPEED_RAD_S) -> Motion:
    """Minimum jerk from `start` to `end` (joints,), all joints arriving together, none faster than `speed_rad_s`."""
    distance = float(np.abs(end - start).max())
    seconds = max(_PEAK_OVER_MEAN * distance / speed_rad_s, SHORTEST_RAMP_S)
    share = _minimum_jerk(np.arange(1, round(seconds * rate_hz) + 1) / round(seconds * rate_hz))
    return Motion("ramp", start + share[:, None] * (end - start), arrives=True)


def hold(position: Array, seconds: float, rate_hz: float) -> Motion:
    """Stay at `position` (joints,)."""
    return Motion("hold", held(position, seconds, rate_hz))


def held(position: Array, seconds: float, rate_hz: float) -> Array:
    """(n, joints), the same row again and again; not to be written to, since all are one: hours of it take no memory."""
    return np.broadcast_to(position, (max(1, round(seconds * rate_hz)), len(position)))


def play(
    start: Array, commands: Array, rate_hz: float, name: str, limp: NDArray[np.bool_] | None = None
) -> list[Motion]:
    """`commands` (n, joints), preceded by a ramp from where the robot is, unless it is there already."""
    motions = []
    if float(np.abs(commands[0] - start).max()) > RAMP_SPEED_RAD_S / rate_hz:
        motions.append(ramp(start, commands[0], rate_hz))
    return [*motions, Motion(name, commands.copy(), limp=limp)]


def catch(commands: Array, row: int, joint: int, angle: float, rate_hz: float) -> None:
    """Let a joint's `commands` (n, joints) start at `angle` in `row` and come back to themselves by a ramp, in place."""
    apart = angle - float(commands[row, joint])
    seconds = max(_PEAK_OVER_MEAN * abs(apart) / RAMP_SPEED_RAD_S, SHORTEST_RAMP_S)
    rows = np.arange(min(len(commands) - row, round(seconds * rate_hz)))
    commands[row + rows, joint] += apart * (1 - _minimum_jerk(rows / (seconds * rate_hz)))


def _minimum_jerk(share: Array) -> Array:
    out: Array = share**3 * (10 - 15 * share + 6 * share**2)
    return out
