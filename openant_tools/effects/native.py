"""Effects written into an MJCF with MuJoCo's own features: edits of the text that `model.mjcf.write_model` has written.

What an effect writes stands with it. Friction and cogging of gears stay without torque, so they stand in a `dcmotor` of their own
that has no control (`input="none"`): the file has no more controls than before. Play and compliance are hinges in series.
"""

from __future__ import annotations

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.document import Document, Element, Writer
from openant_tools.effects.robot import Robot
from openant_tools.model.mjcf import number
from openant_tools.model.plant import Plant

__all__ = ["edit"]


def edit(root: Element, plant: Plant, robot: Robot) -> Document:
    """Put into a document what a compiled variant cannot say.

    Args:
        root: of the document, as written for the plant.
        plant: compiled from it, on the floor.
        robot: how it differs; what `Robot.model` changes is in the document already.
    """
    document = Document(root, plant, robot)
    # Effects that decide one element together share its writer.
    writers = dict.fromkeys([*(one.writer for one in catalogue().values() if one.writer is not None), contacts])
    ordered = sorted(writers, key=lambda writer: writer.order)
    for j in range(len(plant.joints)):
        for writer in ordered:
            if writer.joint is not None:
                writer.joint(document, j)
    for writer in ordered:
        if writer.body is not None:
            writer.body(document)
    return document


def _contacts(document: Document) -> None:
    """The form of contacts, which is no effect: how steep friction is."""
    robot = document.robot
    if robot.impratio != 1:
        # Of the compiled variant, which had it too, only its elements are written.
        given = float(document.plant.model.opt.impratio)
        document.last("option").set("impratio", number(given * robot.impratio))


contacts = Writer(80, body=_contacts)
