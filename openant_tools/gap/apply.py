"""A diagnosis put to use: the model with the effects that were found, and a file of those that MuJoCo has no feature for."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import NDArray

from openant_tools.effects.catalogue import acting, catalogue
from openant_tools.effects.document import Document
from openant_tools.effects.entries import as_toml, entries_of
from openant_tools.effects.native import edit
from openant_tools.effects.robot import Reference, Robot, Seen
from openant_tools.effects.zero_offset import read_zero, write_zero
from openant_tools.errors import BadInput
from openant_tools.files import json_text, write_text
from openant_tools.gap.diagnosis import Diagnosis, Found
from openant_tools.gap.nuisance import BODY, adjust
from openant_tools.model.body import floor_contacts
from openant_tools.model.engines import carries, elsewhere, state
from openant_tools.model.mjcf import document_text, write_model
from openant_tools.model.plant import Plant, Setup, load_plant
from openant_tools.numbers import stored
from openant_tools.robot.config import EffectEntry, Provenance
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.pair import PLAIN, mark_of

__all__ = ["Applied", "apply", "robot_of", "write_robot"]

#: rad: farther than any joint of a legged robot goes
ANYWHERE_RAD = 10.0


@dataclass(frozen=True)
class Applied:
    """What was written.

    Attributes:
        written: the files.
        carried: lines on what stands where.
        notes: lines on what is not as it was simulated.
    """

    written: tuple[Path, ...]
    carried: tuple[str, ...]
    notes: tuple[str, ...]


def apply(found: Diagnosis, model: Path, out: Path, *, robot: Path | None = None, engine: str | None = None) -> Applied:
    """Write the improved model of a diagnosis, and beside it what MuJoCo does not carry.

    Args:
        model: the MJCF that was diagnosed. out: the file to make.
        robot: a robot's folder whose robot.toml gets the effects and names the model, in place of a file beside it.
        engine: that is to play the model (a name in `model.engines`); what it does not carry stands beside the model, too.

    Raises:
        BadInput: the model lacks a joint of the diagnosis, or keeps one where it cannot be edited.
    """
    folder = None if robot is None else RobotFolder.at(robot)
    if folder is not None:
        folder.refuse_if_held()
    plant = load_plant(model, None, Setup.FLOOR)
    selected = [one for one in found.effects if one.effect in found.selected and (one.parameters or one.coordinates)]
    lacks = [one for one in selected if engine is not None and not carries(engine, one.effect)]
    improved = robot_of(plant, [one for one in selected if one not in lacks], found.calibration)
    entries = _entries(plant, [one for one in selected if one not in lacks], improved) + [_entry(one) for one in lacks]
    if engine is not None and not carries(engine, "action_delay") and improved.delay.any():  # as calibrated
        entries += entries_of({("action_delay", "delay_s"): improved.delay.copy()}, plant.joints)
        improved.delay[:] = 0.0
    effects_file = out.with_name(f"{out.stem}.effects.toml")
    with (
        folder.hold() if folder is not None else contextlib.nullcontext()
    ):  # between reading its effects and writing them
        others = [] if folder is None else _others(folder, found, mark_of(plant.model))
        acts = [entry for entry in (*entries, *others) if entry.effect in acting() and entry.enabled]
        word = _mark(found, model, acts) if acts else PLAIN
        entries = [replace(entry, pair=word) if entry in acts else entry for entry in entries]
        others = [replace(entry, pair=word) if entry.pair and entry in acts else entry for entry in others]
        edited = write_robot(model, improved, out, note=f"Written by `openant gap apply`: {found.verdict}", pair=word)
        written = [out]
        if folder is not None:
            _into_folder(folder, out, [*others, *entries], found)
            written.append(folder.config_file)
        elif entries:
            write_text(effects_file, as_toml(entries, f"What MuJoCo has no feature for; goes with {out.name}"))
            written.append(effects_file)
        else:
            effects_file.unlink(missing_ok=True)  # of an earlier diagnosis, which would act beside this model
    where = "robot.toml" if folder is not None else effects_file.name
    carried = [
        f"{one.effect} ({_where(one)}): "
        + (
            where
            if any(entry.effect == one.effect for entry in entries)
            else f"MuJoCo, in {out.name}{elsewhere(one.effect)}"
        )
        for one in selected
    ]
    if not selected:
        carried.append("no effect was selected: the model is the given one, calibrated as far as the diagnosis went")
    return Applied(tuple(written), tuple(carried), tuple(edited.notes))


def robot_of(
    plant: Plant, selected: tuple[Found, ...] | list[Found], calibration: Mapping[str, Mapping[str, float]]
) -> Robot:
    """The robot that a diagnosis says this is.

    Args:
        plant: the given model.
        selected: its effects, entered by their parameters.
        calibration: kind → joint → factor, or amount of what has none.

    Raises:
        BadInput: an effect that is not in the catalogue, a joint that is not in the model, a parameter that is missing.
    """
    n = len(plant.joints)
    reach = np.full(n, ANYWHERE_RAD)
    reference = Reference.of(
        plant, floor=True, imu=True, tracker=True, seen=Seen(np.ones(n), -reach, reach, 0.0)
    )  # fmt: skip
    robot = Robot(n, -reach, reach)
    for kind, values in calibration.items():
        for name, value in values.items():
            try:
                adjust(robot, kind, [] if name == BODY else _rows(plant, (name,), kind).tolist(), value)
            except KeyError:
                raise BadInput(f"the diagnosis calibrates {kind!r}", remedy="make it anew with this version") from None
    robot.delay[:] = np.maximum(robot.delay, 0.0)  # nothing acts before it was sent
    for one in selected:
        cause = catalogue().get(one.effect)
        if cause is None:
            raise BadInput(f"no effect is called {one.effect!r}", remedy="see the catalogue in docs/gap.md")
        joints = np.arange(n) if isinstance(one.joints, str) else _rows(plant, one.joints, one.effect)
        given = {name: span.value for name, span in one.parameters.items()}
        try:
            values = cause.restored(given, one.coordinates, reference, joints)
            cause.enter(robot, joints, values)
        except KeyError as error:
            raise BadInput(
                f"{one.effect} lacks its parameter {error}", remedy="make the diagnosis anew with this version"
            ) from None
    robot.delay[:] = np.maximum(robot.delay, 0.0)
    return robot


def write_robot(source: Path, robot: Robot, out: Path, *, note: str, pair: str | None = None) -> Document:
    """Write an MJCF that moves as this robot does, by MuJoCo's own features as far as those go (formats, section 5).

    Args:
        pair: the mark of what acts beside it (`robot.pair`); default the source's.

    Raises:
        BadInput: the source cannot be edited so that it compiles to this.
    """
    plant = load_plant(source, None, Setup.FLOOR)
    variant = _variant(plant, robot)
    partial = out.with_name(f".{out.name}.partial.xml")
    hinged = bool(robot.play.any() or robot.compliance.any())
    if hinged:
        note += ". It has hinges beside the servos' own: for openant_env and plain MuJoCo, not for code that counts coordinates"
    try:
        write_model(source, variant, partial, note=note, pair=pair)
        written = load_plant(partial, plant.joints, Setup.FLOOR)
        tree = etree.parse(str(partial), etree.XMLParser(remove_blank_text=False))
        done = edit(tree.getroot(), written, robot)
        if hinged:
            _lengthen_keys(tree.getroot(), written, done)
        write_text(partial, document_text(tree))
        for setup in Setup:
            whole = load_plant(partial, plant.joints, setup)
        state(tree.getroot(), whole.model)
    finally:
        partial.unlink(missing_ok=True)
    write_text(out, document_text(tree))
    return done


def _variant(plant: Plant, robot: Robot) -> mujoco.MjModel:
    """What of a robot a compiled model of the same layout says, but for what is written as a body or option of its own."""
    plain = robot.copy()
    plain.payload_kg, plain.tilt = 0.0, np.zeros(2)
    variant = plain.model(plant)
    for j in np.flatnonzero(robot.zero):
        write_zero(variant, plant, int(j), read_zero(variant, plant, int(j)) + float(robot.zero[j]))
    if robot.adhesion_n:
        variant.geom_adhesion[floor_contacts(plant.model).geoms] = robot.adhesion_n
    return variant


def _lengthen_keys(root: etree._Element, plant: Plant, done: Document) -> None:
    """Keyframes count coordinates: those of the added hinges are 0."""
    added: list[tuple[int, int]] = []
    for joint, hinges in done.hinges.items():
        j = plant.joints.index(joint)
        added.append((int(plant.qpos[j]) + 1, len(hinges)))
    dofs = {int(plant.qpos[k]) + 1: int(plant.dof[k]) + 1 for k in range(len(plant.joints))}
    for key in root.iter("key"):
        for name, of in (("qpos", lambda at: at), ("qvel", dofs.__getitem__)):
            numbers = str(key.get(name) or "").split()
            if numbers:
                for at, count in sorted(added, reverse=True):
                    numbers[of(at) : of(at)] = ["0"] * count
                key.set(name, " ".join(numbers))


def _entries(plant: Plant, selected: list[Found], robot: Robot) -> list[EffectEntry]:
    """What stands beside the model: laws that act between steps, and what acts on commands and sensors."""
    laws: dict[tuple[str, str], NDArray[np.float64]] = {
        key: values for key, values in robot.laws.items() if not catalogue()[key[0]].native
    }
    entries = [
        EffectEntry(entry.effect, "all" if acting()[entry.effect].shared else entry.joints, entry.parameters)
        for entry in entries_of(laws, plant.joints)
    ]
    for one in selected:
        if catalogue()[one.effect].native or any(entry.effect == one.effect for entry in entries):
            continue
        entries.append(_entry(one))
    return entries


def _entry(one: Found) -> EffectEntry:
    return EffectEntry(one.effect, one.joints, {name: stored(span.value) for name, span in one.parameters.items()})


def _others(folder: RobotFolder, found: Diagnosis, given: str | None) -> list[EffectEntry]:
    """The robot's entries that a diagnosis says nothing of, but for those that were fitted with another model than was diagnosed.

    Args:
        given: that model's mark.
    """
    considered = {one.effect for one in found.effects}
    return [
        entry
        for entry in folder.config().effects
        if entry.effect not in considered and (entry.pair in (None, given) or not entry.enabled)
    ]


def _mark(found: Diagnosis, model: Path, acts: Sequence[EffectEntry]) -> str:
    """The mark of an improved model and its effects (`robot.pair`)."""
    told = [[entry.effect, entry.joints, dict(entry.parameters)] for entry in acts]
    text = json_text({"model": model.name, "calibration": found.calibration, "effects": told})
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _into_folder(folder: RobotFolder, out: Path, effects: Sequence[EffectEntry], found: Diagnosis) -> None:
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    folder.update(
        {"model": folder.relative(out.resolve())},
        provenance={"model": Provenance("fitted", "openant gap apply", ", ".join(found.runs), now)},
        effects=effects,
    )


def _rows(plant: Plant, joints: tuple[str, ...], what: str) -> NDArray[np.int64]:
    for joint in joints:
        if joint not in plant.joints:
            raise BadInput(
                f"the diagnosis says {what} of {joint!r}, which the model does not have",
                where=plant.path,
                remedy="name the model that was diagnosed with --model",
            )
    return np.array([plant.joints.index(joint) for joint in joints], np.int64)


def _where(one: Found) -> str:
    return one.joints if isinstance(one.joints, str) else ", ".join(one.joints)
