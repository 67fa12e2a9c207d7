"""What an effect is: its name in the catalogue, its parameters, and how it enters a simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.step import Law

__all__ = ["Effect", "Quantity", "Values"]

#: parameter → its value at each joint of each simulation, (n, joints); 0 where the effect is absent
Values = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Quantity:
    """One parameter of an effect.

    Attributes:
        name, unit: as in the catalogue, SI.
        std: a size of which a robot's own is expected, one standard deviation of a fit's prior; of a torque (N·m), as a
            share of the servo's torque limit.
        low, high: between which it is physical.
    """

    name: str
    unit: str
    std: float
    low: float = 0.0
    high: float = float("inf")


@dataclass(frozen=True)
class Effect:
    """An effect that acts between steps.

    Attributes:
        name, family: in the catalogue.
        words: what happens, for people.
        quantities: its parameters; all at 0 is no effect.
        order: laws of lower order act first: supply, then setpoints, then torques, then what follows from torques.
        law: makes the law for given values.
        shared: what one joint does acts on all, and there is one value for the robot.
    """

    name: str
    family: str
    words: str
    quantities: tuple[Quantity, ...]
    order: int
    law: Callable[[Values], Law]
    shared: bool = False

    @property
    def chief(self) -> Quantity | None:
        """The parameter that is the effect's size in its usual form, where one is: others are other forms of it, or its shape."""
        first = self.quantities[0]
        return first if len(self.quantities) == 1 or first.name == "coefficient" else None

    def quantity(self, name: str) -> Quantity:
        return next(quantity for quantity in self.quantities if quantity.name == name)
