"""Writing servo values back into the MJCF they came from, as text: names, comments, order and structure stay.

The file is edited, not generated: an element gets the attributes whose compiled values differ, and nothing else moves.
`<include>`d content is taken in, and folders of assets are re-pointed, so that the written file stands on its own.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.files import write_text
from openant_tools.model.plant import (
    KD,
    KP,
    MOTOR_CONSTANT,
    RESISTANCE,
    VMAX,
    Plant,
    Setup,
    is_motor,
    load_plant,
    samples_for,
)

__all__ = ["write_model"]

#: attributes of <compiler> that name folders relative to the model's file
ASSET_FOLDERS = ("assetdir", "meshdir", "texturedir")


def write_model(
    source: Path, variant: mujoco.MjModel, out: Path, *, joints: Sequence[str] | None = None, note: str | None = None
) -> Path:
    """Write `source` with the servo values of `variant` to `out`, with sensors `pos.J` and `vel.J` (formats, section 5).

    Args:
        source: the MJCF to start from.
        variant: a model compiled from it as it is (with its free joint), in which some of these differ: stiffness and
            velocity gain of actuators, their force range; damping, armature, friction and zero of joints.
        out: the file to write, atomically.
        joints: the servo joints; default all.
        note: a line for the comment at the top.

    Raises:
        BadInput: the source cannot be read, or keeps a joint where it cannot be edited.
    """
    plant = load_plant(source, joints, Setup.FLOOR)
    tree = _read(source)
    root = tree.getroot()
    _repoint_assets(root, source.parent, out.parent)
    degrees = _in_degrees(root)
    actuators = [element for section in root.iter("actuator") for element in section if isinstance(element.tag, str)]
    for j, name in enumerate(plant.joints):
        element = next((e for e in root.iter("joint") if e.get("name") == name and _in_world(e)), None)
        if element is None:
            raise BadInput(
                f"the joint {name!r} is not written out in the file (made by <replicate> or <attach>?)",
                where=source,
                remedy="save the expanded model first: python -m mujoco.studio, or MjSpec.to_xml()",
            )
        _write_joint(element, plant, variant, j, degrees)
        if is_motor(variant, int(plant.actuator[j])) and not is_motor(plant.model, int(plant.actuator[j])):
            _write_motor(actuators[plant.actuator[j]], variant, int(plant.actuator[j]))
        else:
            _write_actuator(actuators[plant.actuator[j]], plant, variant, j)
        _write_delay(actuators[plant.actuator[j]], plant, variant, j)
    _append_sensors(root, plant.joints)
    if note:
        root.insert(0, etree.Comment(f" {note.replace('--', '−−')} "))
        root[0].tail = root.text or "\n  "
    write_text(out, etree.tostring(tree, encoding="unicode", pretty_print=False) + "\n")
    _check(out, plant, variant)
    return out


def _read(path: Path) -> etree._ElementTree:
    try:
        tree = etree.parse(str(path), etree.XMLParser(remove_blank_text=False, remove_comments=False))
    except etree.XMLSyntaxError as error:
        raise BadInput(f"not well-formed XML: {error.msg}", where=path) from error
    for include in list(tree.getroot().iter("include")):
        inner = _read(path.parent / str(include.get("file")))
        parent = include.getparent()
        assert parent is not None
        at = parent.index(include)
        children = list(inner.getroot())
        for k, child in enumerate(children):
            parent.insert(at + k, child)
        if children:
            children[-1].tail = include.tail
        parent.remove(include)
    return tree


def _in_world(element: etree._Element) -> bool:
    return any(ancestor.tag == "worldbody" for ancestor in element.iterancestors())


def _in_degrees(root: etree._Element) -> bool:
    given = [str(e.get("angle")) for e in root.iter("compiler") if e.get("angle")]
    return not given or given[-1] == "degree"


def _repoint_assets(root: etree._Element, source: Path, out: Path) -> None:
    here = Path(os.path.relpath(source.resolve(), out.resolve()))
    if here == Path("."):
        return
    compilers = list(root.iter("compiler"))
    given = [(e, name) for e in compilers for name in ASSET_FOLDERS if e.get(name) is not None]
    for element, name in given:
        element.set(name, str(here / str(element.get(name))))
    if not given and any(e.get("file") for e in root.iter("mesh", "texture", "hfield", "skin", "flexcomp")):
        if not compilers:
            compilers = [etree.Element("compiler")]
            compilers[0].tail = "\n  "
            root.insert(0, compilers[0])
        compilers[0].set("assetdir", str(here))


def _number(value: float) -> str:
    return f"{value:.10g}"


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(_number(float(value)) for value in values)


def _differ(a: float, b: float) -> bool:
    return not math.isclose(a, b, rel_tol=1e-12, abs_tol=1e-15)


def _write_joint(element: etree._Element, plant: Plant, variant: mujoco.MjModel, j: int, degrees: bool) -> None:
    given, dof, adr = plant.model, plant.dof[j], plant.qpos[j]
    joint = int(given.dof_jntid[dof])
    scale = math.degrees(1.0) if degrees and given.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE else 1.0
    if _differ(given.dof_damping[dof], variant.dof_damping[dof]):
        higher = np.trim_zeros(given.dof_dampingpoly[dof], "b")
        element.set("damping", _numbers([variant.dof_damping[dof], *higher]))
    if _differ(given.dof_armature[dof], variant.dof_armature[dof]):
        element.set("armature", _number(variant.dof_armature[dof]))
    if _differ(given.dof_frictionloss[dof], variant.dof_frictionloss[dof]):
        element.set("frictionloss", _number(variant.dof_frictionloss[dof]))
    if _differ(given.qpos0[adr], variant.qpos0[adr]):
        element.set("ref", _number(variant.qpos0[adr] * scale))
        if given.jnt_limited[joint]:
            element.set("range", _numbers(variant.jnt_range[joint] * scale))
        if given.jnt_stiffness[joint]:
            element.set("springref", _number(variant.qpos_spring[adr] * scale))


def _write_actuator(element: etree._Element, plant: Plant, variant: mujoco.MjModel, j: int) -> None:
    given, i = plant.model, plant.actuator[j]
    before, after = given.actuator_biasprm[i], variant.actuator_biasprm[i]
    stiffness, velocity = _differ(before[1], after[1]), _differ(before[2], after[2])
    if element.tag == "general":
        if stiffness or velocity:
            element.set("biasprm", _numbers(after[:3]))
            element.set("gainprm", _numbers(variant.actuator_gainprm[i][:3]))
    else:
        if stiffness:
            element.set("kp", _number(-after[1]))
        if velocity or (stiffness and element.get("dampratio") is not None):
            # A damping ratio would follow the new stiffness; what was identified is the gain itself.
            element.attrib.pop("dampratio", "")
            element.set("kv", _number(-after[2]))
    if any(_differ(a, b) for a, b in zip(given.actuator_forcerange[i], variant.actuator_forcerange[i], strict=True)):
        element.set("forcerange", _numbers(variant.actuator_forcerange[i]))


def _write_motor(element: etree._Element, variant: mujoco.MjModel, i: int) -> None:
    """Put a DC motor in a position servo's place (plant.motor_form): same name, joint, order and control."""
    motor = variant.actuator_gainprm[i]
    kept = {name: value for name, value in element.attrib.items() if name in _KEPT_BY_MOTOR}
    element.tag = "dcmotor"
    element.attrib.clear()
    for name, value in kept.items():
        element.set(name, value)
    element.set("input", "pos")
    element.set("motorconst", _numbers([motor[MOTOR_CONSTANT]] * 2))
    element.set("resistance", _number(motor[RESISTANCE]))
    element.set("controller", _numbers([motor[KP], 0, motor[KD], 0, 0, motor[VMAX]]))
    if variant.actuator_ctrllimited[i]:
        element.set("ctrlrange", _numbers(variant.actuator_ctrlrange[i]))


def _write_delay(element: etree._Element, plant: Plant, variant: mujoco.MjModel, j: int) -> None:
    i = plant.actuator[j]
    delay = float(variant.actuator_delay[i])
    if not _differ(plant.model.actuator_delay[i], delay):
        return
    element.set("delay", _number(delay))
    element.set("nsample", str(max(int(plant.model.actuator_history[i, 0]), samples_for(delay, plant.timestep))))
    element.set("interp", "linear")


#: attributes of a position servo that a DC motor has too, with the same meaning
_KEPT_BY_MOTOR = ("name", "joint", "group", "user", "nsample", "interp", "delay", "armature", "damping")


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
        pairs = [
            (written.model.actuator_biasprm[i, 1:3], variant.actuator_biasprm[k, 1:3]),
            (written.model.actuator_gainprm[i], variant.actuator_gainprm[k]),
            (written.model.actuator_forcerange[i], variant.actuator_forcerange[k]),
            (written.model.actuator_delay[i], variant.actuator_delay[k]),
            (written.model.dof_damping[written.dof[j]], variant.dof_damping[dof]),
            (written.model.dof_armature[written.dof[j]], variant.dof_armature[dof]),
            (written.model.dof_frictionloss[written.dof[j]], variant.dof_frictionloss[dof]),
            (written.model.qpos0[written.qpos[j]], variant.qpos0[adr]),
        ]
        for got, wanted in pairs:
            if not np.allclose(got, wanted, rtol=1e-8, atol=1e-12):
                out.unlink(missing_ok=True)
                raise BadInput(
                    f"the values of joint {joint!r} do not survive in this file's structure",
                    where=plant.path,
                    remedy="save the expanded model first with MjSpec.to_xml(), and fit that",
                )
