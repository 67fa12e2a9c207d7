"""The torso carries something."""

from __future__ import annotations

import mujoco
import numpy as np
from lxml import etree

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, amount
from openant_tools.effects.kind import Kind
from openant_tools.effects.robot import Reference, Robot
from openant_tools.model.body import scale_mass, torso_body
from openant_tools.model.mjcf import number, numbers
from openant_tools.model.plant import Plant

__all__ = ["effect"]


def _robot(reference: Reference, joints: Ints) -> float:
    return reference.robot_kg


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.payload_kg += values["mass_kg"]
    robot.payload_m[:2] = values["x_m"], values["y_m"]


def _write(document: Document) -> None:
    robot = document.robot
    if not robot.payload_kg:
        return
    body = etree.SubElement(document.torso(), "body", name="payload", pos=numbers(robot.payload_m))
    # A geom, not an inertial: the compiler may have been told to take inertia from geoms.
    etree.SubElement(
        body, "geom", name="payload", type="sphere", size="0.005", mass=number(robot.payload_kg), contype="0",
        conaffinity="0", group="1",
    )  # fmt: skip
    body.tail = "\n    "


_hang_a_mass = Action("hang a known mass", "weigh the robot, or record once more with 100 g on the torso")


def _read(model: mujoco.MjModel, plant: Plant, j: int) -> float:
    return float(model.body_mass[torso_body(model, plant)])


def _set(model: mujoco.MjModel, plant: Plant, j: int, value: float) -> None:
    torso = torso_body(model, plant)
    scale_mass(model, np.array([torso]), value / float(model.body_mass[torso]))


def _carried(model: mujoco.MjModel, plant: Plant) -> bool:
    """Whether the robot's torso is a body of its own, with mass, that its joints do not move."""
    torso = torso_body(model, plant)
    joints = set(model.jnt_bodyid[model.dof_jntid[plant.dof]].tolist())
    return bool(model.body_mass[torso] > 0 and torso not in joints)


effect = Effect(
    name="payload",
    family="inertia",
    words="the torso carries something",
    scopes=(Scope.BODY,),
    quantities=(
        amount("mass_kg", "kg", 0.06, 0.5, scale=_robot, tolerance=0.03),
        amount("x_m", "m", 0.01, 0.06, signed=True),
        amount("y_m", "m", 0.01, 0.06, signed=True),
    ),
    enter=_enter,
    native=True,
    writer=Writer(70, body=_write),
    kinds=(
        # ±0.03 kg of the Open Ant's torso of 0.32 kg are two deviations (effects.md).
        Kind(
            "torso_mass",
            "kg",
            _read,
            _set,
            0.05,
            low=1e-9,
            constants=True,
            holds=lambda model, plant, j: _carried(model, plant),
            body=True,
            shown_by="`full`, on the floor",
            told_from={"link_mass": "`drops` on the stand, where the torso is held"},
        ),
    ),
    shows=lambda reference: reference.floor,
    told_from={
        "torque_limit": _hang_a_mass,
        "stiffness_error": _hang_a_mass,
        "link_mass": Action(
            "stand and floor", "weigh one leg; legs show on the stand, the torso's load on the floor only"
        ),
    },
)
