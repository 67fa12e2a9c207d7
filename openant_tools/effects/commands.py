"""What befalls commands on their way to the servos: when they act scatters, and some never arrive.

A driver sends the command in force a hundred times a second, so what is lost is late, and seldom lost for good.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.model.rollout import Staircase

__all__ = ["SEND_S", "CommandEffects", "CommandPath"]

Array = NDArray[np.float64]

#: s between two sendings of a command, about: the rate of the engine's loop
SEND_S = 0.01


@dataclass(frozen=True)
class CommandEffects:
    """`clock_jitter` and `command_dropout`.

    Attributes:
        jitter_s: standard deviation of the time from a sending to its effect. Nothing acts before it was sent first.
        fraction: (joints,) share of the sendings that do not arrive.
        longest_s: for which they do not arrive at a stretch; stretches up to that are equally likely.
        shared: all joints lose the same ones.
    """

    jitter_s: float
    fraction: Array
    longest_s: float
    shared: bool


class CommandPath:
    """The way of commands in one simulation that goes on.

    Args:
        effects: what befalls them.
        timestep: s, of the simulation.
    """

    def __init__(self, effects: CommandEffects, timestep: float) -> None:
        self._effects, self._timestep = effects, timestep
        fraction = effects.fraction.max(keepdims=True) if effects.shared else effects.fraction
        self._most = max(1, round(effects.longest_s / SEND_S))
        mean_length = (1 + self._most) / 2
        # Between two stretches of mean length L lie (1 − p)/p sendings that arrive: fraction = L / (L + 1/p − 1).
        share = np.maximum(fraction, 1e-12)
        self._begins = np.where(fraction > 0.0, 1.0 / (1.0 + mean_length * (1.0 - share) / share), 0.0)
        self._loses = bool(self._begins.any())
        self.reset(np.zeros(len(effects.fraction)))

    def reset(self, command: Array) -> None:
        """As if `command` (joints,) had been in force for ever."""
        self._now = 0.0
        self._times, self._values = np.array([-np.inf]), command[None].copy()
        self._left = np.zeros(len(self._begins), np.int64)

    def play(self, command: Array, steps: int, random: np.random.Generator) -> Array:
        """Send a command for so many steps of the simulation; (steps, joints) rad that act in each.

        Args:
            command: (joints,) rad.
            random: what chance decides with; jitter first, then what is lost.
        """
        effects, span = self._effects, steps * self._timestep
        count = max(1, round(span / SEND_S))
        sent = self._now + span / count * np.arange(count)
        if effects.jitter_s > 0.0:
            sent = sent + random.normal(0.0, effects.jitter_s, count)
        arriving = np.maximum.accumulate(np.concatenate([self._times[-1:], sent]))[1:]
        values = np.repeat(command[None], count, axis=0)
        before = self._values[-1]
        for k in range(count):
            lost = self._lost(random)
            if lost is not None:
                values[k] = np.where(lost, before, values[k])
            before = values[k]
        way = Staircase(np.concatenate([self._times, arriving]), np.concatenate([self._values, values]))
        edges: Array = self._now + self._timestep * np.arange(steps + 1, dtype=np.float64)
        acting = way.mean(edges)
        # Time starts anew with every step of the environment, so that days of it are as exact as the first second.
        kept = max(0, int(np.searchsorted(way.times, edges[-1], side="right")) - 1)
        self._times, self._values = way.times[kept:] - edges[-1], way.values[kept:]
        self._now = 0.0
        return acting

    def _lost(self, random: np.random.Generator) -> NDArray[np.bool_] | None:
        """Which joints' sending does not arrive, (joints,); None for none."""
        if not self._loses:
            return None
        begins = (self._left == 0) & (random.random(len(self._begins)) < self._begins)
        if begins.any():
            self._left[begins] = random.integers(1, self._most + 1, int(begins.sum()))
        lost: NDArray[np.bool_] = self._left > 0
        self._left -= lost
        return np.broadcast_to(lost, len(self._effects.fraction)) if self._effects.shared else lost

    def get_state(self) -> dict[str, Any]:
        """What `set_state` needs to go on, as arrays."""
        return {"times": self._times.copy(), "values": self._values.copy(), "left": self._left.copy()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on where `get_state` was called."""
        self._times, self._values = np.array(state["times"], float), np.array(state["values"], float)
        self._left = np.array(state["left"], np.int64)
