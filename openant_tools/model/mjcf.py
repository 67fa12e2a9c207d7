"""Writing servo values back into the MJCF they came from, as text: names, comments, order and structure stay.

The file is edited, not generated: an element gets the attributes whose compiled values differ, and nothing else moves.
`<include>`d content is taken in, and folders of assets are re-pointed, so that the written file stands on its own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.files import write_text
from openant_tools.model.attribute import Attribute, Stated
from openant_tools.model.engines import state
from openant_tools.model.plant import (
    KD,
    KP,
    MOTOR_CONSTANT,
    RESISTANCE,
    VMAX,
    Plant,
    Setup,
    is_filtered,
    is_motor,
    load_plant,
    samples_for,
)
from openant_tools.robot.model_file import parser
from openant_tools.robot.pair import mark

__all__ = ["actuator_element", "document_text", "in_degrees", "joint_element", "number", "numbers", "write_model"]

#: attribute of <compiler> that names the folder, relative to the model's file, of what these elements read;
#: `assetdir` stands for both
ASSET_FOLDERS = {"meshdir": ("mesh", "hfield", "skin", "flexcomp"), "texturedir": ("texture",)}


def write_model(
    source: Path,
    variant: mujoco.MjModel,
    out: Path,
    *,
    joints: Sequence[str] | None = None,
    note: str | None = None,
    stated: Stated | None = None,
    pair: str | None = None,
) -> Path:
    """Write `source` with the servo values of `variant` to `out`, with sensors `pos.J` and `vel.J` (formats, section 5).

    Args:
        source: the MJCF to start from.
        variant: a model compiled from it as it is (with its free joint), in which some of these differ: stiffness and
            velocity gain of actuators, their force range, delay and lag; damping, armature, friction and zero of joints;
            mass and inertia of bodies, together; friction, softness and adhesion of geoms.
        out: the file to write, atomically.
        joints: the servo joints; default all.
        note: a line for the comment at the top.
        stated: attributes of the file that the variant was compiled with other values of.
        pair: the mark of what it was fitted with (`robot.pair`); default that of the source.

    Raises:
        BadInput: the source cannot be read, or keeps a joint where it cannot be edited.
    """
    plant = load_plant(source, joints, Setup.FLOOR)
    taken_in: list[tuple[etree._Element, Path]] = []
    tree = _read(source, source.parent, taken_in)
    root = tree.getroot()
    _name_from_main(root, source.parent, taken_in)
    _repoint_assets(root, source.parent, out.parent)
    # MuJoCo decides what the file means before it takes its place; beside it, because folders of assets are relative.
    trial = out.with_name(f".{out.name}.trial.xml")
    try:
        if stated:
            _write_stated(root, stated, source)
            write_text(trial, document_text(tree))
            plant = replace(load_plant(trial, joints, Setup.FLOOR), path=source)
        spec = mujoco.MjSpec.from_file(str(trial if stated else source))
        ratios = _write_servos(root, plant, variant)
        _write_bodies(root, plant, variant, spec)
        _write_contacts(root, plant, variant)
        _append_sensors(root, plant.joints)
        if pair is not None:
            mark(root, pair)
        if note:
            root.insert(0, etree.Comment(f" {note.replace('--', '−−')} "))
            root[0].tail = root.text or "\n  "
        write_text(trial, document_text(tree))
        if ratios:
            _set_damping_ratios(ratios, trial, plant, variant)
            write_text(trial, document_text(tree))
        _check(trial, plant, variant)
        if note:
            state(root, load_plant(trial, joints, Setup.FLOOR).model)
    finally:
        trial.unlink(missing_ok=True)
    write_text(out, document_text(tree))
    return out


def _write_servos(root: etree._Element, plant: Plant, variant: mujoco.MjModel) -> dict[int, etree._Element]:
    """Set what differs in joints and actuators; returns those whose velocity gain must yet be given as a damping ratio."""
    degrees = in_degrees(root)
    ratios = {}
    for j, name in enumerate(plant.joints):
        joint = joint_element(root, name, plant.path)
        actuator = actuator_element(root, plant, j)
        _write_joint(joint, plant, variant, j, degrees)
        if is_motor(variant, int(plant.actuator[j])) and not is_motor(plant.model, int(plant.actuator[j])):
            _write_motor(actuator, variant, int(plant.actuator[j]))
        elif _write_actuator(actuator, plant, variant, j):
            ratios[j] = actuator
        _write_delay(actuator, plant, variant, j)
    return ratios


#: where elements of a kind stand, and their tags there; None for any
_SECTIONS: dict[str, tuple[str, tuple[str, ...] | None]] = {
    "joint": ("worldbody", ("joint", "freejoint")),
    "geom": ("worldbody", ("geom",)),
    "body": ("worldbody", ("body",)),
    "inertial": ("worldbody", ("body",)),
    "site": ("worldbody", ("site",)),
    "actuator": ("actuator", None),
    "tendon": ("tendon", None),
    "pair": ("contact", ("pair",)),
    "equality": ("equality", None),
}


def _write_stated(root: etree._Element, values: Stated, source: Path) -> None:
    """Set attributes as they stand in the file, with as many numbers as it gives, or as are needed."""
    for attribute, wanted in values.items():
        element = _stated_element(root, attribute)
        if element is None:
            raise _not_written_out(f"the {attribute}", source)
        given = len(str(element.get(attribute.attribute, "")).split())
        needed = len(np.trim_zeros(np.array(wanted), "b"))
        element.set(attribute.attribute, numbers(wanted[: max(given, needed, 1)]))


def _stated_element(root: etree._Element, attribute: Attribute) -> etree._Element | None:
    if attribute.element == "option":
        # The last <option> counts, attribute by attribute.
        found = list(root.iter("option"))
        if not found:
            found = [etree.Element("option")]
            found[0].tail = "\n  "
            root.insert(0, found[0])
        return next((e for e in found[::-1] if e.get(attribute.attribute)), found[-1])
    section, tags = _SECTIONS[attribute.element]
    for part in root.iter(section):
        for element in part.iter() if section == "worldbody" else part:
            if element.get("name") == attribute.name and (tags is None or element.tag in tags):
                return element if attribute.element != "inertial" else element.find("inertial")
    return None


def _not_written_out(what: str, source: Path) -> BadInput:
    return BadInput(
        f"{what} is not written out in the file (made by <replicate> or <attach>?)",
        where=source,
        remedy="save the expanded model first: python -m mujoco.studio, or MjSpec.to_xml()",
    )


def document_text(tree: etree._ElementTree) -> str:
    """The document with a line for each comment around its root, whose line ends a parser does not keep."""
    root = tree.getroot()
    before = [etree.tostring(e, encoding="unicode", with_tail=False) for e in root.itersiblings(preceding=True)]
    after = [etree.tostring(e, encoding="unicode", with_tail=False) for e in root.itersiblings()]
    return "\n".join([*before[::-1], etree.tostring(root, encoding="unicode", with_tail=False), *after]) + "\n"


def _read(path: Path, main: Path, taken_in: list[tuple[etree._Element, Path]]) -> etree._ElementTree:
    """The document with every <include> replaced by what it stands for.

    Args:
        path: the file.
        main: the folder of the outermost file; includes are looked for there, then beside the file that includes.
        taken_in: gets every element that came by an include, with the folder of the file it stood in.
    """
    try:
        tree = etree.parse(str(path), parser())
    except etree.XMLSyntaxError as error:
        raise BadInput(f"not well-formed XML: {error.msg}", where=path) from error
    for include in list(tree.getroot().iter("include")):
        named = str(include.get("file"))
        file = next((folder / named for folder in (main, path.parent) if (folder / named).is_file()), main / named)
        inner = _read(file, main, taken_in).getroot()
        taken_in += [(element, file.parent) for element in inner.iter() if _files(element)]
        parent = include.getparent()
        assert parent is not None
        at = parent.index(include)
        children = list(inner)
        for k, child in enumerate(children):
            parent.insert(at + k, child)
        if children:
            children[-1].tail = include.tail
        parent.remove(include)
    return tree


def _name_from_main(root: etree._Element, main: Path, taken_in: Sequence[tuple[etree._Element, Path]]) -> None:
    """MuJoCo looks for an included file's assets beside that file too; taken in, they must be named from the main one."""
    folders = {"model": main}
    for name, tags in ASSET_FOLDERS.items():
        given = [e.get(which) for which in ("assetdir", name) for e in root.iter("compiler") if e.get(which)]
        folders |= dict.fromkeys(tags, main / str(given[-1]) if given else main)
    for element, beside in taken_in:
        folder = folders.get(str(element.tag), main)
        for name, value in _files(element):
            if not (folder / value).is_file() and (beside / value).is_file():
                element.set(name, os.path.relpath(beside / value, folder))


def _files(element: etree._Element) -> list[tuple[str, str]]:
    """The attributes that name a file (a cube texture has six) and what they name."""
    return [(str(name), str(value)) for name, value in element.attrib.items() if str(name).startswith("file")]


def joint_element(root: etree._Element, name: str, source: Path) -> etree._Element:
    """The element of a joint of that name."""
    for element in root.iter("joint"):
        if element.get("name") == name and any(ancestor.tag == "worldbody" for ancestor in element.iterancestors()):
            return element
    raise _not_written_out(f"the joint {name!r}", source)


def in_degrees(root: etree._Element) -> bool:
    given = [str(e.get("angle")) for e in root.iter("compiler") if e.get("angle")]
    return not given or given[-1] == "degree"


def _repoint_assets(root: etree._Element, source: Path, out: Path) -> None:
    here = Path(os.path.relpath(source.resolve(), out.resolve()))
    if here == Path("."):
        return

    def moved(value: object) -> str:
        # Relative, also where it was absolute: an absolute path that leads elsewhere is followed by nobody.
        named = Path(str(value))
        return os.path.relpath(named, out.resolve()) if named.is_absolute() else str(here / named)

    compilers = list(root.iter("compiler"))
    given = {name for e in compilers for name in ("assetdir", *ASSET_FOLDERS) if e.get(name) is not None}
    for element in compilers:
        for name in given:
            if element.get(name) is not None:
                element.set(name, moved(element.get(name)))
    for name, tags in ASSET_FOLDERS.items():
        if not given & {name, "assetdir"} and any(_files(e) for e in root.iter(*tags)):
            if not compilers:
                compilers = [etree.Element("compiler")]
                compilers[0].tail = "\n  "
                root.insert(0, compilers[0])
            compilers[0].set(name, str(here))
    for element in root.iter("model"):
        for name, value in _files(element):
            element.set(name, moved(value))


def actuator_element(root: etree._Element, plant: Plant, j: int) -> etree._Element:
    """The element that became the actuator of joint j, by the joint that it names and its own name."""
    name = plant.model.actuator(int(plant.actuator[j])).name
    elements = [e for section in root.iter("actuator") for e in section if isinstance(e.tag, str)]
    named = [e for e in elements if e.get("joint") == plant.joints[j] and (e.get("name") or "") == name]
    if len(named) != 1:
        raise _not_written_out(f"the actuator of joint {plant.joints[j]!r}", plant.path)
    return named[0]


def number(value: float) -> str:
    return f"{value:.10g}"  # for a file


def numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(number(float(value)) for value in values)


def _differ(a: float, b: float) -> bool:
    return not math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-15)


def _write_joint(element: etree._Element, plant: Plant, variant: mujoco.MjModel, j: int, degrees: bool) -> None:
    given, dof, adr = plant.model, plant.dof[j], plant.qpos[j]
    joint = int(given.dof_jntid[dof])
    scale = math.degrees(1.0) if degrees and given.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else 1.0
    if _differ(given.dof_damping[dof], variant.dof_damping[dof]):
        higher = np.trim_zeros(given.dof_dampingpoly[dof], "b")
        element.set("damping", numbers([variant.dof_damping[dof], *higher]))
    if _differ(given.dof_armature[dof], variant.dof_armature[dof]):
        element.set("armature", number(variant.dof_armature[dof]))
    if _differ(given.dof_frictionloss[dof], variant.dof_frictionloss[dof]):
        element.set("frictionloss", number(variant.dof_frictionloss[dof]))
    if (given.dof_solimp[dof] != variant.dof_solimp[dof]).any():
        element.set("solimpfriction", numbers(variant.dof_solimp[dof]))
    if _differ(given.qpos0[adr], variant.qpos0[adr]):
        element.set("ref", number(variant.qpos0[adr] * scale))
        if given.jnt_limited[joint]:
            element.set("range", numbers(variant.jnt_range[joint] * scale))
        if given.jnt_stiffness[joint]:
            element.set("springref", number(variant.qpos_spring[adr] * scale))


def _write_actuator(element: etree._Element, plant: Plant, variant: mujoco.MjModel, j: int) -> bool:
    """Set what differs; True where the velocity gain must yet be given as a damping ratio (`_set_damping_ratios`)."""
    given, i = plant.model, plant.actuator[j]
    before, after = given.actuator_biasprm[i], variant.actuator_biasprm[i]
    stiffness, velocity = _differ(before[1], after[1]), _differ(before[2], after[2])
    as_ratio = False
    if element.tag == "general":
        if stiffness or velocity:
            element.set("biasprm", numbers(after[:3]))
            element.set("gainprm", numbers(variant.actuator_gainprm[i][:3]))
    elif is_motor(variant, int(i)):
        if (given.actuator_gainprm[i] != variant.actuator_gainprm[i]).any():
            _set_motor(element, variant.actuator_gainprm[i])
    else:
        if stiffness:
            element.set("kp", number(-after[1]))
        # A damping ratio would follow the new stiffness and inertia; what was identified is the gain itself.
        own = element.attrib.pop("dampratio", "") != ""
        as_ratio = element.get("kv") is None and _ratio_by_default(element)
        if (velocity or own) and not as_ratio:
            element.set("kv", number(-after[2]))
    if is_filtered(variant, int(i)) and _differ(_lag(given, int(i)), _lag(variant, int(i))):
        if element.tag == "general":
            element.set("dyntype", "filterexact")
            element.set("dynprm", number(_lag(variant, int(i))))
        else:
            element.set("timeconst", number(_lag(variant, int(i))))
    if any(_differ(a, b) for a, b in zip(given.actuator_forcerange[i], variant.actuator_forcerange[i], strict=True)):
        element.set("forcerange", numbers(variant.actuator_forcerange[i]))
    return as_ratio


def _lag(model: mujoco.MjModel, actuator: int) -> float:
    return float(model.actuator_dynprm[actuator, 0]) if is_filtered(model, actuator) else 0.0


def _ratio_by_default(element: etree._Element) -> bool:
    """Whether a default class may give this actuator a damping ratio, beside which MuJoCo accepts no kv."""
    tree = element.getroottree()
    return any(e.get("dampratio") for default in tree.iter("default") for e in default.iter(str(element.tag)))


def _set_damping_ratios(
    elements: Mapping[int, etree._Element], trial: Path, plant: Plant, variant: mujoco.MjModel
) -> None:
    """Give these actuators the damping ratios that come to the variant's velocity gains (the gain is proportional to it)."""
    compiled = load_plant(trial, plant.joints, Setup.FLOOR)
    for j, element in elements.items():
        now = -float(compiled.model.actuator_biasprm[compiled.actuator[j], 2])
        wanted = -float(variant.actuator_biasprm[plant.actuator[j], 2])
        if not math.isclose(now, wanted, rel_tol=1e-9):
            # Its class's ratio counts where it has none of its own; which that is, a ratio of 1 tells.
            element.set("dampratio", "1")
            write_text(trial, document_text(element.getroottree()))
            again = load_plant(trial, plant.joints, Setup.FLOOR)
            of_one = -float(again.model.actuator_biasprm[again.actuator[j], 2])
            element.set("dampratio", number(wanted / of_one))


def _set_motor(element: etree._Element, motor: NDArray[np.float64]) -> None:
    """What a DC motor is and how its loop works, from its gain parameters."""
    element.set("motorconst", numbers([motor[MOTOR_CONSTANT]] * 2))
    element.set("resistance", number(motor[RESISTANCE]))
    element.set("controller", numbers([motor[KP], 0, motor[KD], 0, 0, motor[VMAX]]))


def _write_motor(element: etree._Element, variant: mujoco.MjModel, i: int) -> None:
    """Put a DC motor in a position servo's place (plant.motor_form): same name, joint, order and control."""
    motor = variant.actuator_gainprm[i]
    kept = {name: value for name, value in element.attrib.items() if name in _KEPT_BY_MOTOR}
    element.tag = "dcmotor"
    element.attrib.clear()
    for name, value in kept.items():
        element.set(name, value)
    element.set("input", "pos")
    _set_motor(element, motor)
    # It leaves its class, which was made for the servo, and takes along what else stood there.
    if variant.actuator_ctrllimited[i]:
        element.set("ctrlrange", numbers(variant.actuator_ctrlrange[i]))
    samples, interpolation = (int(value) for value in variant.actuator_history[i])
    if samples:
        element.set("nsample", str(samples))
        element.set("interp", ("zoh", "linear", "cubic")[interpolation])
        element.set("delay", number(variant.actuator_delay[i]))
    for name, value in (("armature", variant.actuator_armature[i]), ("damping", variant.actuator_damping[i])):
        if value:
            element.set(name, number(value))
    if variant.actuator_group[i]:
        element.set("group", str(variant.actuator_group[i]))
    main = element.getroottree().getroot().find("default")
    if main is not None and any(e.get("forcerange") or e.get("forcelimited") for e in main if isinstance(e.tag, str)):
        element.set("class", _class_without_force_range(main))


def _class_without_force_range(main: etree._Element) -> str:
    """The name of a default class whose motors have no force range, made where it is missing.

    A force range in the file's main defaults reaches every actuator; a DC motor inherits it and has no attribute to say no.
    """
    name = "motor_without_force_range"
    if not any(e.get("class") == name for e in main.iter("default")):
        made = etree.SubElement(main, "default", {"class": name})
        etree.SubElement(made, "general", forcelimited="false", forcerange="0 0")
        made.tail = main.text
    return name


def _write_delay(element: etree._Element, plant: Plant, variant: mujoco.MjModel, j: int) -> None:
    i = plant.actuator[j]
    delay = float(variant.actuator_delay[i])
    if not _differ(plant.model.actuator_delay[i], delay):
        return
    element.set("delay", number(delay))
    element.set("nsample", str(max(int(plant.model.actuator_history[i, 0]), samples_for(delay, plant.timestep))))
    element.set("interp", "linear")


def _write_bodies(root: etree._Element, plant: Plant, variant: mujoco.MjModel, spec: mujoco.MjSpec) -> None:
    """Make the bodies denser whose mass differs: where the file states it, in the inertial or in the geoms."""
    given = plant.model
    heavier = np.flatnonzero(~np.isclose(variant.body_mass, given.body_mass, rtol=1e-12, atol=0.0))
    if not len(heavier):
        return
    bodies, geoms = _in_order(root, plant)
    for body in heavier:
        factor = float(variant.body_mass[body] / given.body_mass[body])
        for inertial in bodies[body].findall("inertial"):
            inertial.set("mass", number(float(inertial.get("mass", "0")) * factor))
            for name in ("diaginertia", "fullinertia"):
                if inertial.get(name):
                    inertial.set(name, numbers([float(x) * factor for x in str(inertial.get(name)).split()]))
        for k in np.flatnonzero(given.geom_bodyid == body):
            # What a default class says of it is what the spec says; a mass stands before a density.
            mass, density = float(spec.geoms[k].mass), float(spec.geoms[k].density)
            if math.isnan(mass):
                geoms[k].set("density", number(density * factor))
            elif mass:
                geoms[k].set("mass", number(mass * factor))


def _write_contacts(root: etree._Element, plant: Plant, variant: mujoco.MjModel) -> None:
    given = plant.model
    for attribute in ("friction", "solref", "solimp", "adhesion"):
        differing = _differing(given, variant, f"geom_{attribute}")
        if len(differing):
            _, geoms = _in_order(root, plant)
            for k in differing:
                geoms[k].set(attribute, numbers(np.atleast_1d(getattr(variant, f"geom_{attribute}")[k])))
        for k in _differing(given, variant, f"pair_{attribute}") if attribute != "adhesion" else ():
            names = {given.geom(int(given.pair_geom1[k])).name, given.geom(int(given.pair_geom2[k])).name}
            found = [e for e in root.iter("pair") if {e.get("geom1"), e.get("geom2")} == names]
            if len(found) != 1:
                raise _not_written_out(f"the contact pair of {' and '.join(sorted(names))}", plant.path)
            found[0].set(attribute, numbers(getattr(variant, f"pair_{attribute}")[k]))


def _differing(given: mujoco.MjModel, variant: mujoco.MjModel, field: str) -> NDArray[np.int64]:
    before, after = getattr(given, field), getattr(variant, field)
    differs = ~np.isclose(before, after, rtol=1e-12, atol=1e-15)
    return np.flatnonzero(differs if differs.ndim == 1 else differs.any(axis=1)).astype(np.int64)


def _in_order(root: etree._Element, plant: Plant) -> tuple[list[etree._Element], list[etree._Element]]:
    """The elements that became the model's bodies (the world first) and geoms, by their ids.

    MuJoCo numbers bodies depth first, and geoms body by body.
    """
    worlds = list(root.iter("worldbody"))
    bodies: list[list[etree._Element]] = [worlds]
    for world in worlds:
        bodies += [[body] for body in world.iter("body")]
    geoms = [geom for body in bodies for part in body for geom in _own(part, "geom")]
    model = plant.model
    named = [(model.body(k).name, e[0]) for k, e in enumerate(bodies[: model.nbody]) if k]
    named += [(model.geom(k).name, e) for k, e in enumerate(geoms[: model.ngeom])]
    if len(bodies) != model.nbody or len(geoms) != model.ngeom or any((e.get("name") or "") != n for n, e in named):
        raise _not_written_out("some body or geom", plant.path)
    return [body[0] for body in bodies], geoms


def _own(body: etree._Element, tag: str) -> list[etree._Element]:
    """The elements of a body, not those of the bodies in it; a <frame> is none."""
    out = []
    for child in body:
        if child.tag == tag:
            out.append(child)
        elif child.tag == "frame":
            out += _own(child, tag)
    return out


#: attributes of a position servo that a DC motor has too, with the same meaning
_KEPT_BY_MOTOR = ("name", "joint", "user")


def _append_sensors(root: etree._Element, joints: Sequence[str]) -> None:
    """After the sensors already there: what the encoder of every servo joint would measure."""
    there = {e.get("name") for section in root.iter("sensor") for e in section if isinstance(e.tag, str)}
    sections = list(root.iter("sensor"))
    if sections:
        section = sections[-1]
    else:
        section = etree.SubElement(root, "sensor")
        section.text, section.tail = "\n  ", "\n"
        previous = section.getprevious()
        if previous is not None:
            previous.tail = "\n  "
    wanted = [(f"{signal}.{joint}", tag, joint) for joint in joints for signal, tag in _SENSORS]
    for name, tag, joint in wanted:
        if name in there:
            continue
        if len(section):
            section[-1].tail = "\n    "
        else:
            section.text = "\n    "
        element = etree.SubElement(section, tag, name=name, joint=joint)
        element.tail = "\n  "


_SENSORS = (("pos", "jointpos"), ("vel", "jointvel"))


def _check(out: Path, plant: Plant, variant: mujoco.MjModel) -> None:
    """The written file must compile to the variant: a value lost in a default class would be a wrong model."""
    written = load_plant(out, plant.joints, Setup.FLOOR)
    for j, joint in enumerate(plant.joints):
        i, k, dof, adr = written.actuator[j], plant.actuator[j], plant.dof[j], plant.qpos[j]
        pairs = {
            "stiffness": (written.model.actuator_biasprm[i, 1:3], variant.actuator_biasprm[k, 1:3]),
            "gain": (written.model.actuator_gainprm[i], variant.actuator_gainprm[k]),
            "torque limit": (written.model.actuator_forcerange[i], variant.actuator_forcerange[k]),
            "lag": (_lag(written.model, int(i)), _lag(variant, int(k))),
            "delay": (written.model.actuator_delay[i], variant.actuator_delay[k]),
            "damping": (written.model.dof_damping[written.dof[j]], variant.dof_damping[dof]),
            "armature": (written.model.dof_armature[written.dof[j]], variant.dof_armature[dof]),
            "friction loss": (written.model.dof_frictionloss[written.dof[j]], variant.dof_frictionloss[dof]),
            "softness of friction (solimp)": (written.model.dof_solimp[written.dof[j]], variant.dof_solimp[dof]),
            "reference": (written.model.qpos0[written.qpos[j]], variant.qpos0[adr]),
        }
        for what, (got, wanted) in pairs.items():
            if not np.allclose(got, wanted, rtol=1e-8, atol=1e-12):
                raise BadInput(
                    f"the {what} of joint {joint!r} does not survive in this file's structure",
                    where=plant.path,
                    remedy=EXPAND,
                )
    for what, field in _OF_BODIES:
        got, wanted = getattr(written.model, field), getattr(variant, field)
        if got.shape != wanted.shape or not np.allclose(got, wanted, rtol=1e-7, atol=1e-12):
            raise BadInput(f"{what} does not survive in this file's structure", where=plant.path, remedy=EXPAND)


EXPAND = "save the expanded model first with MjSpec.to_xml(), and fit that"
_OF_BODIES = (
    ("the mass of a body", "body_mass"),
    ("the inertia of a body", "body_inertia"),
    ("the friction of a geom", "geom_friction"),
    ("the softness of a geom (solref)", "geom_solref"),
    ("the softness of a geom (solimp)", "geom_solimp"),
    ("the adhesion of a geom", "geom_adhesion"),
    ("the friction of a pair", "pair_friction"),
    ("the softness of a pair (solref)", "pair_solref"),
    ("the softness of a pair (solimp)", "pair_solimp"),
)
