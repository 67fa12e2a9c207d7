"""The effects of a robot at work in one simulation, as they act in rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.rollout import EffectValues, laws_of
from openant_tools.effects.servos import single
from openant_tools.model.plant import Plant

__all__ = ["Acting"]

Array = NDArray[np.float64]


class Acting:
    """Effects at work in one simulation.

    Args:
        plant: the robot; its model is the one that is stepped, and the laws write into it.
        data: the simulation.
        values: of the effects.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData, values: EffectValues) -> None:
        self._plant, self._model, self._data = plant, plant.model, data
        self._servos = single(plant, plant.model, data)
        self._laws = laws_of([values], len(plant.joints))

    def step(self, count: int) -> None:
        """Advance the simulation by `count` steps, with the commands in `data.ctrl`."""
        commands = self._data.ctrl.copy()
        for _ in range(count):
            self._data.ctrl[:] = commands
            self._step()
        self._data.ctrl[:] = commands

    def play(self, setpoints: Array) -> None:
        """Advance by one step for each of (steps, joints) setpoints, rad; the last one stays in `data.ctrl`."""
        at = self._plant.ctrl
        if not len(setpoints):
            return
        for row in setpoints:
            self._data.ctrl[at] = row
            self._step()
        self._data.ctrl[at] = setpoints[-1]

    def _step(self) -> None:
        if self._laws:
            self._servos.prepare(self._laws, np.array([self._data.time]), self._servos.state)
        mujoco.mj_step(self._model, self._data)

    def reset(self) -> None:
        """Forget what laws have gathered, such as heat."""
        for state in self._states():
            state[:] = 0.0

    def get_state(self) -> list[Array]:
        """What the next step depends on beside the physics: what laws have gathered, and the load as of one step ago."""
        return [self._data.qfrc_bias.copy(), *(state.copy() for state in self._states())]

    def set_state(self, states: Sequence[Any]) -> None:
        """Go on where `get_state` was called."""
        for mine, given in zip([self._data.qfrc_bias, *self._states()], states, strict=True):
            mine[:] = np.asarray(given)

    def _states(self) -> list[Array]:
        return [law.state for law in self._laws if hasattr(law, "state")]
