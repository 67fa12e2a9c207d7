"""An MJCF that is being edited so that it moves as a simulated robot does, by MuJoCo's own features."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import mujoco
from lxml import etree

from openant_tools.effects.robot import Robot
from openant_tools.model.mjcf import joint_element, number, numbers
from openant_tools.model.plant import Plant, samples_for

__all__ = ["NO_MOTOR", "Document", "Element", "Writer"]

Element = etree._Element

#: what stands in for none where MuJoCo wants a positive motor constant: its back-EMF is the square
NO_MOTOR = 1e-5


@dataclass
class Document:
    """A file on its way.

    Attributes:
        root: of the document, as written for the plant. plant: compiled from it, on the floor.
        robot: how it differs; what `Robot.model` changes is in the document already.
        notes: what it does not carry as simulated, one line each.
        hinges: joint → the hinges put in series with it.
    """

    root: Element
    plant: Plant
    robot: Robot
    notes: list[str] = field(default_factory=list)
    hinges: dict[str, list[str]] = field(default_factory=dict)

    def joint(self, j: int) -> Element:
        """The element of joint j."""
        return joint_element(self.root, self.plant.joints[j], self.plant.path)

    def turns(self, j: int) -> bool:
        """Whether joint j is a hinge."""
        model = self.plant.model
        return bool(model.jnt_type[model.dof_jntid[self.plant.dof[j]]] == mujoco.mjtJoint.mjJNT_HINGE)

    def stop(self, element: Element, seconds: float, damping: float) -> None:
        """Give a joint's ends a time constant and a damping ratio; next to nothing of their spring gives way."""
        element.set("solreflimit", numbers([seconds, damping]))
        element.set("solimplimit", "0.99 0.9999 0.0001")

    def law(self, effect: str, parameter: str, j: int) -> float:
        """An effect's parameter at joint j."""
        values = self.robot.laws.get((effect, parameter))
        return 0.0 if values is None else float(values[j])

    def last(self, tag: str) -> Element:
        """The last section of that name, made where there is none."""
        found = [element for element in self.root if element.tag == tag]
        if found:
            return found[-1]
        made = etree.SubElement(self.root, tag)
        made.text, made.tail = "\n    ", "\n"
        return made

    def torso(self) -> Element:
        """The body that carries all others."""
        bodies = [element for element in self.joint(0).iterancestors() if element.tag == "body"]
        return bodies[-1]

    def gear(self, j: int, what: str, attribute: str, values: Sequence[float]) -> None:
        """A motor beside the servo that has no control: what gears do stays without torque."""
        joint = self.plant.joints[j]
        element = etree.SubElement(
            self.last("actuator"), "dcmotor", name=f"{what}.{joint}", joint=joint, input="none",
            motorconst=numbers([NO_MOTOR, NO_MOTOR]), resistance="1",
        )  # fmt: skip
        element.set(attribute, numbers(values))
        element.tail = "\n  "

    def encoder(self, signal: str, j: int) -> Element:
        """The sensor `pos.J` or `vel.J`."""
        name = f"{signal}.{self.plant.joints[j]}"
        return next(
            e for section in self.root.iter("sensor") for e in section
            if isinstance(e.tag, str) and e.get("name") == name
        )  # fmt: skip

    def inertial(self) -> list[Element]:
        """The sensors of the IMU."""
        sensors = [e for section in self.root.iter("sensor") for e in section if e.tag in ("gyro", "accelerometer")]
        note = "the model has no gyro and no accelerometer that could be turned or late"
        if not sensors and note not in self.notes:
            self.notes.append(note)
        return sensors

    def delayed(self, sensor: Element, delay: float) -> None:
        """Let a sensor say what was so many s ago."""
        if delay > 0:
            sensor.set("delay", number(delay))
            sensor.set("nsample", str(samples_for(delay, self.plant.timestep)))
            sensor.set("interp", "linear")


@dataclass(frozen=True)
class Writer:
    """What of an effect a compiled model of the same layout does not say, put into a document.

    Attributes:
        order: those of lower order write first: servos, then stops and gears, then what stands behind these, then sensors.
        joint: for each joint. body: for the robot as a whole.
    """

    order: int
    joint: Callable[[Document, int], None] | None = None
    body: Callable[[Document], None] | None = None
