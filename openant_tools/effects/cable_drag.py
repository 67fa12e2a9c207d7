"""A cable pulls at the torso."""

from __future__ import annotations

from lxml import etree

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.effect import Action, Effect, Ints, Scope, Values, amount
from openant_tools.effects.robot import Reference, Robot
from openant_tools.model.body import torso_body
from openant_tools.model.mjcf import number, numbers

__all__ = ["effect"]

#: m from the torso to where the cable's tendons end: their direction and length change by a per cent while it walks a metre
FAR_M = 100.0


def _weight(reference: Reference, joints: Ints) -> float:
    return 9.81 * reference.robot_kg


def _enter(robot: Robot, joints: Ints, values: Values) -> None:
    robot.cable.force_n[:2] += values["force_x_n"], values["force_y_n"]
    robot.cable.damping_n_s_m += values["damping_n_s_m"]


def _write(document: Document) -> None:
    """Long tendons along the world's axes: each pulls with a force that hardly changes, and brakes along its axis."""
    cable = document.robot.cable
    if not (cable.force_n.any() or cable.damping_n_s_m or cable.stiffness_n_m):
        return
    model = document.plant.model
    body = torso_body(model, document.plant)
    etree.SubElement(
        document.torso(), "site", name="cable", pos=numbers(model.body_ipos[body]), size="0.001", group="5"
    )
    world, tendons = next(document.root.iter("worldbody")), document.last("tendon")
    place = model.body_pos[body]
    for k, axis in enumerate("xyz"):
        force = float(cable.force_n[k])
        end = place.copy()
        end[k] += FAR_M if force >= 0 else -FAR_M
        etree.SubElement(world, "site", name=f"cable.{axis}", pos=numbers(end), size="0.001", group="5")
        stiffness = cable.stiffness_n_m or abs(force) / FAR_M
        rest = FAR_M - abs(force) / stiffness if stiffness else FAR_M
        tendon = etree.SubElement(
            tendons, "spatial", name=f"cable.{axis}", stiffness=number(stiffness), damping=number(cable.damping_n_s_m),
            springlength=number(max(rest, 0.0)),
        )  # fmt: skip
        etree.SubElement(tendon, "site", site="cable")
        etree.SubElement(tendon, "site", site=f"cable.{axis}")


effect = Effect(
    name="cable_drag",
    family="environment",
    words="a cable pulls at the torso",
    scopes=(Scope.BODY,),
    quantities=(
        amount("force_x_n", "N", 0.015, 0.15, signed=True, scale=_weight),
        amount("force_y_n", "N", 0.015, 0.15, signed=True, scale=_weight),
        amount("damping_n_s_m", "N·s/m", 0.05, 0.5, scale=_weight),
    ),
    enter=_enter,
    native=True,
    writer=Writer(85, body=_write),
    vector=True,
    shows=lambda reference: reference.floor,
    told_from={
        "floor_friction": Action("hold the cable up", "record `gait` with the cable held up, and once more without")
    },
)
