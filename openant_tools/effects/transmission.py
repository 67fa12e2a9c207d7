"""Play and springs between a servo's rotor and its joint: as a law between steps, and as hinges in a written model.

A written model has hinges in series; simulations of many robots at once cannot, because a hinge more would be another model,
and so have a law. Both are compared in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from openant_tools.effects.document import Document, Writer
from openant_tools.effects.step import DAMPED, TINY, Law, Step
from openant_tools.model.mjcf import in_degrees, number, numbers

__all__ = ["Fields", "Transmission", "hinges"]

Array = NDArray[np.float64]

#: share of a servo's inertia that turns with its output, behind play or spring; next to none where a hinge stands for them
OUTPUT, BARE = 0.1, 1e-3
#: N·m/rad of teeth, and N·m from which more torque bends them no further as a simulation begins
TEETH, HELD = 200.0, 0.5


@dataclass(frozen=True)
class Fields:
    """Live model fields of the simulations, (n, joints): what a servo's rotor brings to its joint.

    Attributes:
        armature, damping, friction: kg·m², N·m·s/rad, N·m. link: kg·m², inertia of the joint's links without the rotor.
        weigh: gives the joints another armature, (n, joints) kg·m², from the step on that comes.
    """

    armature: Array
    damping: Array
    friction: Array
    link: Array
    weigh: Callable[[Array], None]


class Transmission:
    """A rotor behind play or a spring; the servo's loop closes over both, as the encoder sits on the output, or `before` them.

    The rotor is integrated here, the link by MuJoCo, both by one implicit step, since teeth are far too stiff for steps that long: how
    fast the rotor will be is a linear function of how fast the link will be, put into the link's own equation (its Schur complement).
    What that adds to the link goes with its acceleration, so it is an armature: a contact then meets a link that carries its rotor,
    as far as teeth are stiff and touch.

    Args:
        play: (robots, joints) rad. compliance: the same in rad per N·m. before: (robots, 1).
        rubbing: makes the law of what else rubs, on rotors here and elsewhere on joints, of what inertia that is, kg·m².
    """

    def __init__(
        self,
        play: Array,
        compliance: Array,
        fields: Fields,
        before: NDArray[np.bool_],
        rubbing: Callable[[Array], Law | None] = lambda inertia: None,
    ) -> None:
        self._mine, self._before, self._fields = (play > 0) | (compliance > 0), before, fields
        output = np.where(self._mine, np.where(before, BARE, OUTPUT), 1.0)
        self._rotor = np.where(self._mine, (1 - output) * fields.armature, 1.0)
        self._rubbing = rubbing(np.where(self._mine, self._rotor, fields.armature + fields.link))
        self._damping = np.where(self._mine, fields.damping, 0.0)
        fields.armature[:] *= output
        fields.damping[self._mine] = 0.0
        self._spring = np.where(compliance > 0, 1 / np.maximum(compliance, 1 / TEETH), TEETH)
        inertia = np.minimum(fields.link + fields.armature, self._rotor)
        self._damper = 2 * DAMPED * np.sqrt(self._spring * inertia)
        self._half = play / 2
        self._angle: Array | None = None
        self._speed, self._link_speed = np.zeros(play.shape), np.zeros(play.shape)
        self._moved: Callable[[Array], Array] | None = None

    def carry(self, position: Array, velocity: Array, load: Array) -> None:
        """Put rotors where they carry a load.

        Args:
            position, velocity: (robots, joints) rad and rad/s of the links. load: N·m that these get.
        """
        held = np.clip(load, -HELD, HELD)
        self._angle = position + np.where(self._mine, self._half * np.sign(held) + held / self._spring, 0.0)
        self._speed, self._link_speed, self._moved = velocity.copy(), velocity.copy(), None

    def __call__(self, step: Step) -> None:
        h, mine, half, spring, rotor = step.dt, self._mine, self._half, self._spring, self._rotor
        if self._angle is None:
            # At rest the teeth that carry the load are the ones that touch.
            self.carry(step.position, step.velocity, step.motor_torque)
        assert self._angle is not None
        position, velocity = step.position, step.velocity
        if self._moved is not None:  # now it is known how fast the link has become
            self._speed = np.where(mine, self._moved(velocity), velocity)
            self._angle = np.where(mine, self._angle + h * self._speed, position)
        angle, speed = self._angle, self._speed
        if self._rubbing is not None:
            step.velocity = np.where(mine, speed, velocity)
            self._rubbing(step)
        step.position, step.velocity = np.where(self._before, angle, position), np.where(self._before, speed, velocity)
        driven = step.motor_torque + step.torque
        step.position, step.velocity = position, velocity
        friction = step.friction
        # Which teeth touch, and whether the rotor sticks, is told as if the link went on as it did.
        going = 2 * velocity - self._link_speed
        self._link_speed = velocity.copy()
        twist = angle - position
        ahead = twist + h * (speed - going)
        side = np.where(half > 0, np.sign(ahead), 1.0)
        touching = (np.abs(ahead) > half) | (half == 0)
        for _ in range(2):
            k, c = np.where(touching, spring, 0.0), np.where(touching, self._damper, 0.0)
            heavy, stiff = rotor + h * (self._damping + c + h * k), c + h * k
            free = (rotor * speed + h * (driven - k * (twist - side * half))) / heavy

            def moved(link: Array, free: Array = free, heavy: Array = heavy, stiff: Array = stiff) -> Array:
                faster = free + h * stiff / heavy * link
                out: Array = np.sign(faster) * np.maximum(np.abs(faster) - h * friction / heavy, 0.0)
                return out

            slowed = moved(going)
            pushed = k * (twist - side * half) + stiff * (slowed - going)
            # Teeth push and never pull.
            touching &= (half == 0) | (pushed * side > 0)
        self._moved = moved
        # A rotor that sticks gives way to nothing; one that turns follows the link by this share.
        share = np.where(slowed != 0, h * stiff / heavy, 0.0)
        along = slowed - share * going
        held = stiff * (1 - share)
        step.torque = np.where(mine, k * (twist - side * half) + stiff * along - held * velocity, step.torque)
        self._fields.weigh(np.where(mine, self._fields.armature + h * held, self._fields.armature))
        step.friction = np.where(mine, 0.0, step.friction)
        step.stiffness = np.where(mine, TINY, step.stiffness)
        step.velocity_gain = np.where(mine, TINY, step.velocity_gain)


def _write(document: Document, j: int) -> None:
    """Hinges behind the servo: play, and a spring; and its encoder behind them."""
    root, plant, robot = document.root, document.plant, document.robot
    play, compliance = float(robot.play[j]), float(robot.compliance[j])
    if not (play or compliance):
        return
    joint, model, dof = plant.joints[j], plant.model, int(plant.dof[j])
    element = document.joint(j)
    shape = {name: str(value) for name, value in element.attrib.items() if name in ("axis", "pos", "class")}
    turn = math.degrees(1.0) if document.turns(j) and in_degrees(root) else 1.0
    both = bool(play and compliance)
    rotor = max(float(model.dof_armature[dof]), 1e-6)
    link = max(float(model.dof_M0[dof]) - float(model.dof_armature[dof]), 1e-6)
    made = []
    for name, there in (("play", play), ("spring", compliance)):
        if not there:
            continue
        hinge = etree.Element("joint", {**shape, "name": f"{name}.{joint}"})
        if element.get("type"):
            hinge.set("type", str(element.get("type")))
        # What its class says of the servo's joint is not true of it.
        for attribute in ("damping", "frictionloss", "stiffness", "ref", "springref"):
            hinge.set(attribute, "0")
        hinge.set("armature", "1e-5" if both else "0")
        if name == "play":
            hinge.set("range", numbers([-play / 2 * turn, play / 2 * turn]))
            hinge.set("limited", "true")
            # As stiff, and as damped, as the teeth of `laws`, between the two inertias that they part.
            between = link * rotor / (link + rotor)
            ratio = DAMPED * math.sqrt(min(link, rotor) / between)
            document.stop(hinge, math.sqrt(between / TEETH) / ratio, ratio)
        else:
            stiffness = 1 / compliance
            hinge.set("limited", "false")
            hinge.set("stiffness", number(stiffness))
            hinge.set("damping", number(2 * DAMPED * math.sqrt(stiffness * min(link, rotor))))
        made.append(hinge)
    at = element
    for hinge in made:
        hinge.tail = element.tail
        at.addnext(hinge)
        at = hinge
    names = [str(hinge.get("name")) for hinge in made]
    document.hinges[joint] = names
    fixed = etree.SubElement(document.last("tendon"), "fixed", name=f"output.{joint}")
    fixed.tail = "\n  "
    for name in (joint, *names):
        etree.SubElement(fixed, "joint", joint=name, coef="1")
    what = "play" if play else "spring"
    document.notes.append(
        f"{joint}: MuJoCo's servo measures before its {what}; pos.{joint} reads behind it, as an encoder does"
    )
    for signal, tag in (("pos", "tendonpos"), ("vel", "tendonvel")):
        sensor = document.encoder(signal, j)
        sensor.tag = tag
        del sensor.attrib["joint"]
        sensor.set("tendon", f"output.{joint}")


hinges = Writer(40, joint=_write)
