"""The effects of a robot at work in one simulation, as they act in rollouts."""

from __future__ import annotations

import mujoco
import numpy as np

from openant_tools.effects.rollout import EffectValues, laws_of
from openant_tools.effects.servos import single
from openant_tools.model.plant import Plant

__all__ = ["Acting"]


class Acting:
    """Effects at work in one simulation.

    Args:
        plant: the robot; its model is the one that is stepped, and the laws write into it.
        data: the simulation.
        values: of the effects.
    """

    def __init__(self, plant: Plant, data: mujoco.MjData, values: EffectValues) -> None:
        self._model, self._data = plant.model, data
        self._servos = single(plant, plant.model, data)
        self._laws = laws_of([values], len(plant.joints))

    def step(self, count: int) -> None:
        """Advance the simulation by `count` steps, with the commands in `data.ctrl`."""
        commands = self._data.ctrl.copy()
        for _ in range(count):
            self._data.ctrl[:] = commands
            self._servos.prepare(self._laws, np.array([self._data.time]), self._servos.state)
            mujoco.mj_step(self._model, self._data)
        self._data.ctrl[:] = commands
