"""A number in a model by which identification fits an effect: how it is read and set, its bounds, and how well it is known."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import mujoco

from openant_tools.model.plant import Plant

__all__ = ["Kind"]


@dataclass(frozen=True)
class Kind:
    """A physical quantity that a joint or its servo has.

    Attributes:
        name: as in fit.json, `name.JOINT`.
        unit: SI.
        read: its value in a compiled model, for the joint at an index of the plant.
        write: sets that value in a model of the same layout.
        relative_std: the prior's standard deviation of log(value), where the model states a value. Half the tolerance
            within which robots of one build differ (effects.md), because a tolerance is taken as two deviations.
        absolute_std: the prior's standard deviation where the model has none, from the joint's torque limit in N·m; NaN where
            it always has one.
        low, high: hard physical bounds of the value.
        constants: whether a change alters constants that MuJoCo derives from the model (mj_setConst).
        valley: whether the cost has a valley at each end of its range, so that a fit must start from both.
        prior: the value that physics suggests, where that is not what the given model says.
        holds: whether a joint can have it at all; default every one.
        body: of the body or the world: one number whatever the joints, which moves all of them.
        alike: of links: those of the same mass are the same part, and share it.
        shown_by: the protocols that show it best. told_from: kind → what separates this one from it; said with one of the two.
        effect: the effect and its parameter, for what acts between steps because MuJoCo has no feature for it.
    """

    name: str
    unit: str
    read: Callable[[mujoco.MjModel, Plant, int], float]
    write: Callable[[mujoco.MjModel, Plant, int, float], None]
    relative_std: float | None
    absolute_std: Callable[[float], float] = lambda limit: math.nan
    low: float = 0.0
    high: float = math.inf
    constants: bool = False
    valley: bool = False
    prior: float | None = None
    holds: Callable[[mujoco.MjModel, Plant, int], bool] = lambda model, plant, j: True
    body: bool = False
    alike: bool = False
    effect: tuple[str, str] | None = None
    shown_by: str = ""
    told_from: Mapping[str, str] = field(default_factory=dict, hash=False)
