"""The quantities that identification knows by name. What each is (unit, bounds, how it enters a model) stands with its effect.

Most belong to a joint or its servo. Some belong to the body or the world it stands on (`body`): they are one number whatever
the joints, and move all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import mujoco

from openant_tools.effects.catalogue import acting, catalogue
from openant_tools.effects.kind import Kind
from openant_tools.model.plant import Plant

__all__ = [
    "ACTION_DELAY",
    "ACTUATOR_LAG",
    "ELECTRICAL_DAMPING",
    "KINDS",
    "LOAD_FRICTION",
    "SPEED_LIMIT",
    "ZERO_OFFSET",
    "Kind",
    "said",
]

ACTION_DELAY = "action_delay"
ACTUATOR_LAG = "actuator_lag"
ELECTRICAL_DAMPING = "electrical_damping"
LOAD_FRICTION = "load_friction"
SPEED_LIMIT = "speed_limit"
ZERO_OFFSET = "zero_offset"
#: what is fitted, in the order in which it is set: what is a share of another, or a ratio to it, comes after that
NAMES = (
    "stiffness", "velocity_gain", "damping", "armature", "coulomb_friction", ELECTRICAL_DAMPING, ZERO_OFFSET, ACTION_DELAY,
    "torque_limit", SPEED_LIMIT, ACTUATOR_LAG, "link_mass", "torso_mass", "floor_friction", "contact_softness",
    "contact_impedance",
)  # fmt: skip


def _nothing(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    """A model knows nothing of what acts between its steps."""
    return 0.0


def _write_nothing(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    """What acts between steps is told to the rollout, beside the model (`effect_values`)."""


def _size(std: float, unit: str) -> Callable[[float], float]:
    """A prior's deviation: of a torque it is a share of the servo's limit."""
    return lambda limit: std * limit if unit == "N·m" else std


def _of_laws() -> Iterator[Kind]:
    """One kind for each parameter of each effect that acts between steps; the chief one bears the effect's own name."""
    for effect in acting().values():
        for parameter in effect.parameters:
            yield Kind(
                effect.name if parameter is effect.chief else f"{effect.name}_{parameter.name}",
                parameter.unit,
                _nothing,
                _write_nothing,
                None,
                _size(math.nan if parameter.std is None else parameter.std, parameter.unit),
                low=parameter.low,
                high=parameter.high,
                body=effect.shared,
                effect=(effect.name, parameter.name),
                shown_by=parameter.shown_by,
            )


_found = {kind.name: kind for effect in catalogue().values() for kind in effect.kinds}
KINDS: dict[str, Kind] = {name: _found[name] for name in NAMES} | {kind.name: kind for kind in _of_laws()}


def said(name: str) -> str:
    """The name of a value, `zero_offset.hip_rr`, as one says it."""
    kind, _, joint = name.partition(".")
    words = "dry friction" if kind == "coulomb_friction" else kind.replace("_", " ")
    return f"{words} of {joint}" if joint else words
