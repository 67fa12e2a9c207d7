"""Feet or floor are softer or harder than in the model."""

from __future__ import annotations

from openant_tools.effects.effect import Effect, Ints, Scope, Values, factor
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.body import contact_number

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.softness *= values["time_constant"]


_read, _set = contact_number("solref", 1)
_read_impedance, _set_impedance = contact_number("solimp", 1)
_time_constant = factor("time_constant", 0.35, 1.7, tolerance=0.30)
effect = Effect(
    name="contact_softness",
    family="contact",
    words="feet or floor are softer or harder",
    scopes=(Scope.BODY,),
    quantities=(_time_constant,),
    enter=_enter,
    native=True,
    kinds=(
        Kind(
            "contact_softness",
            "s",
            _read,
            _set,
            _time_constant.tolerance / 2,
            low=1e-6,
            holds=lambda model, plant, j: _read(model, plant, j) > 0,
            body=True,
            shown_by="`full`, on the floor",
        ),
        # `solimp` is tuned, not measured: between MuJoCo's default of 0.9 and the platform's 0.7.
        Kind(
            "contact_impedance",
            "1",
            _read_impedance,
            _set_impedance,
            0.15,
            low=1e-4,
            high=0.9999,
            holds=lambda model, plant, j: _read_impedance(model, plant, j) > 0,
            body=True,
            shown_by="`full`, on the floor",
        ),
    ),
    shows=lambda reference: reference.floor,
)
