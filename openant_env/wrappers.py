"""Wrappers that know what an Open Ant's observations mean."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput

__all__ = ["NormaliseByBounds"]


class NormaliseByBounds(gymnasium.ObservationWrapper):  # type: ignore[misc]
    """Observations mapped from bounds to −1…1, each on its own: 2 (o − low) / (high − low) − 1.

    Args:
        env: with observations in a vector.
        low, high: (observations,), in the units of the observations. None: what was measured on the robot
            (`observation_bounds` of the environment), nominal where nothing was.
        clip: keep the result within −1…1, as a tile coder needs it; else what lies beyond a bound stays visible.

    Raises:
        BadInput: a bound that is none.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        *,
        low: NDArray[Any] | None = None,
        high: NDArray[Any] | None = None,
        clip: bool = False,
    ) -> None:
        super().__init__(env)
        shape = env.observation_space.shape
        if low is None or high is None:
            own_low, own_high = env.get_wrapper_attr("observation_bounds")
            low, high = own_low if low is None else low, own_high if high is None else high
        self.low, self.high = np.asarray(low, np.float32), np.asarray(high, np.float32)
        for bound in (self.low, self.high):
            if bound.shape != shape or not np.isfinite(bound).all():
                raise BadInput(f"bounds of shape {bound.shape} do not fit observations of {shape}")
        narrow = np.flatnonzero(self.high <= self.low)
        if len(narrow):
            raise BadInput(
                f"the bounds of observation {narrow[0]} leave no room: {self.low[narrow[0]]} to {self.high[narrow[0]]}",
                remedy="measure them again, or give wider ones",
            )
        self._clip = clip
        self._scale = 2.0 / (self.high - self.low)
        edge = np.ones(shape, np.float32) if clip else np.full(shape, np.inf, np.float32)
        self.observation_space = gymnasium.spaces.Box(-edge, edge, dtype=np.float32)

    def observation(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        scaled = (observation - self.low) * self._scale - np.float32(1.0)
        return np.clip(scaled, -1.0, 1.0) if self._clip else scaled
