"""What the engine is to play, in order, who waits for the end of each piece, and the goal in force."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.motion import Motion

__all__ = ["MotionQueue"]


@dataclass
class MotionQueue:
    """The motions of one robot.

    Attributes:
        motions: the first one is being played.
        goal: (joints,) rad, what was commanded last; None while torque is off.
        counts: the same as the servos take it.
        number: of the command whose goal is in force, for those that telemetry is to tell apart; 0 for none.
    """

    motions: deque[Motion] = field(default_factory=deque)
    goal: NDArray[np.float64] | None = None
    counts: list[int] | None = None
    number: int = 0
    _waiting: list[tuple[int, Motion]] = field(default_factory=list)

    def add(self, number: int, motions: Sequence[Motion]) -> None:
        """Play `motions` after what is there; command `number` is answered when the last one has ended."""
        self.motions.extend(motions)
        self._waiting.append((number, motions[-1]))

    def replace(self, number: int, motion: Motion) -> None:
        """Play `motion` from now on; whoever waits for what it replaces waits on."""
        self.motions.clear()
        self.add(number, [motion])

    def waits_for(self, motion: Motion) -> bool:
        """Whether a command is answered when it has ended."""
        return any(one is motion for _, one in self._waiting)

    def answered(self, motion: Motion) -> list[int]:
        """Numbers of the commands that waited for its end, and do so no more."""
        numbers = [number for number, one in self._waiting if one is motion]
        self._waiting = [entry for entry in self._waiting if entry[1] is not motion]
        return numbers

    def give_up(self) -> list[int]:
        """Numbers of all commands that wait, which will not be answered by an end."""
        numbers = [number for number, _ in self._waiting]
        self._waiting.clear()
        return numbers

    def clear(self) -> None:
        """Torque is off: nothing is played, and no goal in force."""
        self.motions.clear()
        self.goal = self.counts = None
