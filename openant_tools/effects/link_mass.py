"""Links are heavier or lighter than in the model."""

from __future__ import annotations

import mujoco

from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, factor
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Robot
from openant_tools.model.body import link_bodies, scale_mass
from openant_tools.model.plant import Plant

__all__ = ["effect"]


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.factor("link_mass")[joints] *= values["scale"]


def _read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    return float(model.body_mass[link_bodies(model, plant, j)].sum())


def _set(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    scale_mass(model, link_bodies(model, plant, j), value / _read(model, plant, j))


_scale = factor("scale", 0.08, 0.9, tolerance=0.05)
effect = Effect(
    name="link_mass",
    family="inertia",
    words="links are heavier or lighter than in the model",
    scopes=(Scope.SERVO, Scope.ALL),
    quantities=(_scale,),
    enter=_enter,
    native=True,
    kinds=(
        Kind(
            "link_mass",
            "kg",
            _read,
            _set,
            _scale.tolerance / 2,
            low=1e-9,
            constants=True,
            holds=lambda model, plant, j: _read(model, plant, j) > 0,
            alike=True,
            shown_by="`drops` and `long-holds`",
        ),
    ),
    told_from={
        "stiffness_error": Action("weigh one leg", "a scale of mass, gains and friction in common shows in no position")
    },
)
