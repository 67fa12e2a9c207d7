"""Motion primitives: what the actions of SARSA(λ) stand for, half a second of commands each.

A hip follows a straight ramp from where it was last sent to one end of its range; a knee a half-sine, up (+1: lift the
leg) or down (−1: push it into the ground), and back to the middle. Legs move in pairs, because primitives of one leg
alone do not carry the robot (the paper's appendix on motion primitives; the table is the platform's).

A joint that a primitive leaves idle keeps its last command. (The platform's software sends an idle hip to the middle of
its range at once, a jump of up to 30°, and starts its next ramp from where it then no longer is.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import exact

__all__ = ["LEGS", "PRIMITIVES", "SECONDS", "PrimitiveGait"]

#: s, the length of a primitive (the paper's agent step).
SECONDS = 0.5

#: legs in the order of the table, each with joints `hip_LEG` and `knee_LEG`
LEGS = ("rr", "fr", "fl", "rl")
#: one word a leg: where the hip goes (+ counter-clockwise seen from above) and what the knee does; `.` keeps still.
PRIMITIVES: Sequence[str] = (
    "+down  -up    -down  +up",
    "-up    +down  +up    -down",
    "-down  +up    +down  -up",
    "+up    -down  -up    +down",
    "+down  .      +down  .",
    "-up    .      -up    .",
    ".      -down  .      -down",
    ".      +up    .      +up",
)  # fmt: skip
_WORDS: Mapping[str, tuple[int, int]] = MappingProxyType(
    {"+up": (1, 1), "+down": (1, -1), "-up": (-1, 1), "-down": (-1, -1), ".": (0, 0)}
)

Array = NDArray[np.float64]


class PrimitiveGait:
    """Turns primitives into actions of an environment, and remembers where each joint was last sent.

    Args:
        joints: names in the order of the environment's actions.
        dt: s, the environment's step.

    Raises:
        BadInput: joints that are not an Open Ant's, or a step that does not divide half a second.
    """

    def __init__(self, joints: Sequence[str], dt: float) -> None:
        wanted = [f"{part}_{leg}" for leg in LEGS for part in ("hip", "knee")]
        if sorted(joints) != sorted(wanted):
            raise BadInput(
                f"motion primitives move hips and knees of {', '.join(LEGS)}, not {', '.join(joints) or 'nothing'}",
                remedy="use SARSA(λ) on an Open Ant",
            )
        self.steps = round(SECONDS / dt) if dt > 0.0 else 0
        if self.steps < 1 or abs(self.steps * dt - SECONDS) > 1e-6:
            raise BadInput(
                f"steps of {exact(dt, 's')} do not divide a motion primitive of {exact(SECONDS, 's')}",
                remedy="use dt = 0.05, the paper's, or 0.1",
            )
        table = np.array([[_WORDS[word] for word in line.split()] for line in PRIMITIVES], float)
        # (primitives, joints) in the order of the actions: end of a hip's ramp, sign of a knee's half-sine, 0 for idle
        by_name = {f"hip_{leg}": table[:, k, 0] for k, leg in enumerate(LEGS)}
        by_name |= {f"knee_{leg}": table[:, k, 1] for k, leg in enumerate(LEGS)}
        self._aim = np.stack([by_name[joint] for joint in joints], axis=1)
        self._hip = np.array([joint.startswith("hip") for joint in joints])
        # Samples at the ends of the steps: the last ends the ramp, and a knee is back in the middle.
        share = np.arange(1, self.steps + 1) / self.steps
        self._ramp = share[:, None]
        self._sine = np.sin(math.pi * share)[:, None]
        self.last = np.zeros(len(joints))

    def __len__(self) -> int:
        return len(self._aim)

    def actions(self, primitive: int) -> Array:
        """(steps, joints) in −1…1: the actions of one primitive from where the joints are now."""
        aim = self._aim[primitive]
        moves = aim != 0.0
        ramp = self.last + self._ramp * (aim - self.last)
        sequence = np.where(moves, np.where(self._hip, ramp, self._sine * aim), self.last)
        sequence[-1] = np.where(moves & ~self._hip, 0.0, sequence[-1])  # sin π is not quite 0
        return sequence

    def sent(self, action: NDArray[Any]) -> None:
        """Remember the action that was sent last."""
        self.last = np.array(action, float)

    def rest(self) -> None:
        """The robot was set up anew: its joints stand at action 0."""
        self.last = np.zeros_like(self.last)
