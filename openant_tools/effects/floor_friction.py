"""The floor is more or less slippery than in the model."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, factor
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.body import contact_number

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.floor_friction *= values["sliding"]


_read, _set = contact_number("friction", 2)
_sliding = factor("sliding", 0.18, 1.2, tolerance=0.15)
effect = Effect(
    name="floor_friction",
    family="contact",
    words="the floor is more or less slippery",
    scopes=(Scope.BODY,),
    quantities=(_sliding,),
    enter=_enter,
    native=True,
    kinds=(
        Kind(
            "floor_friction",
            "1",
            _read,
            _set,
            _sliding.tolerance / 2,
            low=1e-6,
            holds=lambda model, plant, j: _read(model, plant, j) > 0,
            body=True,
            shown_by="`full`, on the floor",
        ),
    ),
    shows=lambda reference: reference.floor,
)
