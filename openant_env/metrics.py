"""Average reward per second, the paper's measure of performance, in one place."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

__all__ = ["WINDOW_S", "AverageReward"]

#: s, the window of the paper's learning curves.
WINDOW_S = 120.0


class AverageReward:
    """The mean of r/Δt over the last `window_s` seconds (the paper's equation for the average reward per second).

    Steps may differ in length, so each is weighted with the time that it took: Σ r / Σ Δt over the window. With
    steps of one length that is the paper's mean of r/Δt over N = window/Δt steps. Until a whole window has passed,
    the mean is over what there is.

    Args:
        window_s: s, how far back to look; infinity for "since the start".
    """

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self.window_s = window_s
        self.clear()

    def clear(self) -> None:
        """Forget every step."""
        self._steps: deque[tuple[float, float]] = deque()
        self._reward = 0.0
        self._time = 0.0
        self._since_sum = 0

    def add(self, reward: float, duration_s: float) -> None:
        """Count one step.

        Args:
            reward: m, the step's reward (a displacement along the reward direction).
            duration_s: s, the time the step took.
        """
        self._reward += reward
        self._time += duration_s
        if self.window_s == math.inf:
            return
        steps = self._steps
        steps.append((reward, duration_s))
        # Half a step of tolerance: 120 s of 0.12 s steps are 1000 steps, whatever the rounding of their sum.
        while len(steps) > 1 and self._time > self.window_s + 0.5 * steps[0][1]:
            gone_reward, gone_duration = steps.popleft()
            self._reward -= gone_reward
            self._time -= gone_duration
            self._since_sum += 1
        if self._since_sum > len(steps):
            # Once a window, sum afresh, so that rounding errors do not pile up over days.
            self._reward = math.fsum(reward for reward, _ in steps)
            self._time = math.fsum(duration for _, duration in steps)
            self._since_sum = 0

    @property
    def value(self) -> float:
        """m/s, 0 before the first step."""
        return self._reward / self._time if self._time > 0.0 else 0.0

    @property
    def seconds(self) -> float:
        """s, how much time the mean is over."""
        return self._time

    def get_state(self) -> dict[str, Any]:
        """Everything that `set_state` needs to go on bit for bit, as plain lists and numbers."""
        return {
            "steps": list(self._steps), "reward": self._reward, "time": self._time, "since_sum": self._since_sum
        }  # fmt: skip

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on where `get_state` was called."""
        self._steps = deque((float(reward), float(duration)) for reward, duration in state["steps"])
        self._reward = float(state["reward"])
        self._time = float(state["time"])
        self._since_sum = int(state["since_sum"])
