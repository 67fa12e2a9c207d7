"""Robots drawn from what the identification found: every fitted value within its interval, and nothing beside it.

`robot.toml` says of each fitted value between what it lies (95 %). A draw takes the interval as that of a normal
distribution, cut off at its ends; what the intervals do not say is not varied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.rollout import EffectValues
from openant_tools.errors import BadInput
from openant_tools.files import read_toml
from openant_tools.model.plant import Plant
from openant_tools.robot.config import RobotConfig
from openant_tools.robot.folder import RobotFolder

__all__ = ["FittedInterval", "Randomiser", "intervals_of"]

Array = NDArray[np.float64]

#: standard deviations from the middle to the end of a 95 % interval
END = 1.96
#: share by which a model's own value may differ from the one that was identified and still be the same
SAME = 1e-3


@dataclass(frozen=True)
class FittedInterval:
    """One fitted value.

    Attributes:
        kind: of `sysid.kinds`, as in fit.json. joint: whose; a word for the body's.
        value, low, high: in the kind's unit.
    """

    kind: str
    joint: str
    value: float
    low: float
    high: float


def intervals_of(folder: RobotFolder, config: RobotConfig) -> tuple[FittedInterval, ...]:
    """What `robot.toml` says was fitted, with intervals.

    Raises:
        BadInput: nothing was.
    """
    identified = read_toml(folder.config_file).get("identified", {})
    found = []
    for kind, values in identified.items() if isinstance(identified, Mapping) else ():
        for joint, value in values.items() if isinstance(values, Mapping) else ():
            entry = config.provenance_of(f"identified.{kind}.{joint}")
            if entry is not None and entry.how == "fitted" and entry.low is not None and entry.high is not None:
                found.append(FittedInterval(kind, joint, float(value), entry.low, entry.high))
    if not found:
        raise BadInput(
            "nothing was identified yet whose interval could be drawn from",
            where=folder.config_file,
            remedy="run `openant sysid fit … --robot DIR`, or leave randomise out",
        )
    return tuple(found)


class Randomiser:
    """Draws robots.

    Args:
        plant: the calibrated robot; draws are written into its model.
        intervals: what may be drawn. Values that this model does not carry are left as they are (`fixed`).
        effects: what acts between steps, of which fitted parameters are drawn, too.

    Attributes:
        fixed: names of what is not varied.
        drawn: (draws,) standard normal numbers behind the robot at hand; zeros for the one that was identified.
    """

    def __init__(self, plant: Plant, intervals: tuple[FittedInterval, ...], effects: EffectValues) -> None:
        # The house keeps one definition of what a stiffness is in a model, and it is the fit's.
        from openant_tools.sysid.kinds import KINDS

        self._plant, self._effects = plant, effects
        self._kinds = KINDS
        varied, fixed = list[FittedInterval](), list[FittedInterval]()
        for interval in intervals:
            kind = KINDS.get(interval.kind)
            known = kind is not None and (kind.body or interval.joint in plant.joints)
            if known and kind is not None and kind.effect is None:
                here = kind.read(plant.model, plant, self._at(interval))
                known = bool(abs(here - interval.value) <= SAME * max(abs(interval.value), 1e-6))
            elif known and kind is not None:
                known = kind.effect in effects
            (varied if known else fixed).append(interval)
        self._varied = tuple(varied)
        self.fixed = tuple(f"{interval.kind}.{interval.joint}" for interval in fixed)
        # What several joints have in common is one value, and is drawn once.
        shared = {(one.kind, one.value, one.low, one.high): 0 for one in varied}
        for k, key in enumerate(shared):
            shared[key] = k
        self._draw_of = [shared[one.kind, one.value, one.low, one.high] for one in varied]
        self.drawn: Array = np.zeros(len(shared))

    def draw(self, random: np.random.Generator) -> None:
        """Make the model another robot that the identification allows."""
        numbers = random.normal(size=len(self.drawn))
        beyond = np.abs(numbers) > END
        while beyond.any():
            numbers[beyond] = random.normal(size=int(beyond.sum()))
            beyond = np.abs(numbers) > END
        self.become(numbers)

    def become(self, numbers: Array) -> None:
        """Make the model the robot of these standard normal numbers, (draws,)."""
        self.drawn = np.asarray(numbers, float).copy()
        model, constants = self._plant.model, False
        for interval, k in zip(self._varied, self._draw_of, strict=True):
            kind = self._kinds[interval.kind]
            if kind.effect is None:
                kind.write(model, self._plant, self._at(interval), self._value(interval, self.drawn[k]))
                constants = constants or kind.constants
        if constants:
            mujoco.mj_setConst(model, mujoco.MjData(model))

    @property
    def effects(self) -> EffectValues:
        """What acts between the steps of the robot at hand."""
        out = {key: values.copy() for key, values in self._effects.items()}
        for interval, k in zip(self._varied, self._draw_of, strict=True):
            kind = self._kinds[interval.kind]
            if kind.effect is not None:
                rows = slice(None) if kind.body else self._at(interval)
                out[kind.effect][rows] = self._value(interval, self.drawn[k])
        return out

    def _value(self, interval: FittedInterval, number: float) -> float:
        kind = self._kinds[interval.kind]
        side = interval.high - interval.value if number > 0 else interval.value - interval.low
        return float(np.clip(interval.value + number / END * side, kind.low, kind.high))

    def _at(self, interval: FittedInterval) -> int:
        return self._plant.joints.index(interval.joint) if interval.joint in self._plant.joints else 0
