"""The effects that a robot's description names, acting in one simulation as they act in rollouts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.rollout import EffectValues, laws_of
from openant_tools.effects.servos import single
from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant
from openant_tools.robot.config import Effect as Entry

__all__ = ["Acting", "values_of"]


def values_of(entries: Sequence[Entry], joints: Sequence[str], where: str | Path | None = None) -> EffectValues:
    """What `[[effect]]` entries say, by effect, parameter and joint.

    Args:
        entries: of robot.toml or a file of effects; those that are not enabled count for nothing.
        joints: the plant's, in order.
        where: the file, for messages.

    Raises:
        BadInput: an effect that cannot act between steps, a parameter that it does not have, or a value out of bounds.
    """
    values: dict[tuple[str, str], NDArray[np.float64]] = {}
    for entry in entries:
        if not entry.enabled:
            continue
        effect = catalogue().get(entry.effect)
        if effect is None:
            raise BadInput(
                f"the effect {entry.effect} cannot act in this simulation yet",
                where=where,
                remedy="simulate without: effects=False, `--no-effects`, or enabled = false in the file",
            )
        known = {quantity.name: quantity for quantity in effect.quantities}
        chosen = list(joints) if isinstance(entry.joints, str) else list(entry.joints)
        rows = [list(joints).index(joint) for joint in chosen if joint in joints]
        for name, value in entry.parameters.items():
            if name not in known:
                raise BadInput(
                    f"{entry.effect} has no parameter {name!r}", where=where, remedy=f"it has {', '.join(known)}"
                )
            number = value[0] if isinstance(value, list) and len(value) == 1 else value
            quantity = known[name]
            if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
                raise BadInput(
                    f"{entry.effect}.{name} is no number: {value!r}", where=where, remedy=f"in {quantity.unit}"
                )
            if not quantity.low <= number <= quantity.high:
                raise BadInput(
                    f"{entry.effect}.{name} = {number:g} {quantity.unit} is not physical",
                    where=where,
                    remedy=f"it lies between {quantity.low:g} and {quantity.high:g}",
                )
            values.setdefault((entry.effect, name), np.zeros(len(joints)))[rows] = float(number)
    return values


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
