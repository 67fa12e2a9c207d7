"""A written model is the given file with other numbers in it: what a person wrote there, and in which order, stays."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
import plants
import pytest
from lxml import etree

from openant_tools.errors import BadInput
from openant_tools.model.mjcf import write_model
from openant_tools.model.plant import Setup, load_plant
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.parameter import Parameter, apply, choose

SERVO = plants.SERVO


def moved(source: Path, kinds: Sequence[str], u: float = 1.0, joints: Sequence[str] | None = None) -> Any:
    """The model of a file with these kinds of parameters moved by `u` prior deviations in these joints (default: all)."""
    plant = load_plant(
        source, setup=Setup.FLOOR, electrical="electrical_damping" in kinds, lagging="actuator_lag" in kinds
    )
    chosen: list[Parameter] = choose(plant, kinds)
    assert chosen
    return apply(plant, chosen, np.array([u if joints is None or p.label in joints else 0.0 for p in chosen]))


def same_physics(written: Any, variant: Any) -> None:
    """Every number of the two compiled models is the same, but for the sensors that were added and their names."""
    for field in dir(variant):
        added = ("_", "sensor", "name", "nsensor", "nnames", "nbuffer", "paths", "signature", "npaths", "text_")
        if field.startswith((*added, "mat_", "tex_", "ntex")):  # looks are not loaded for simulation
            continue
        value = getattr(variant, field)
        if field == "qpos_spring" and not variant.jnt_stiffness.any():
            continue  # a spring that is none rests anywhere
        if field == "jnt_range" and not variant.jnt_limited.any():
            continue
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            theirs = getattr(written, field)
            assert theirs.shape == value.shape, field
            assert np.allclose(theirs, value, rtol=1e-8, atol=1e-12, equal_nan=True), field


def changed(given: Path, written: Path) -> dict[str, dict[str, tuple[str | None, str | None]]]:
    """Element (tag and name) → attribute → (before, after), for two files of the same structure, added sensors aside."""
    before = [e for e in etree.parse(str(given)).iter() if isinstance(e.tag, str)]
    after = [e for e in etree.parse(str(written)).iter() if isinstance(e.tag, str)]
    there = {e.get("name") for e in before if e.tag in ("jointpos", "jointvel")}
    after = [e for e in after if e.tag not in ("jointpos", "jointvel") or e.get("name") in there]
    if not any(e.tag == "sensor" for e in before):
        after = [e for e in after if e.tag != "sensor"]
    assert [e.tag for e in after] == [e.tag for e in before]
    out = {}
    for a, b in zip(before, after, strict=True):
        differing = {k: (a.get(k), b.get(k)) for k in {*a.keys(), *b.keys()} if a.get(k) != b.get(k)}
        if differing:
            out[f"{a.tag} {a.get('name')}"] = differing
    return out


COMMENTED = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- My robot. Do not lose this line. -->
<mujoco model="mine">
  <compiler angle="radian"/>   <!-- radians, as it should be -->
  <custom><numeric name="serial" data="42"/></custom>

  <worldbody>
    <light name="lämp"  pos="0 0 3"/>
    <body name="a">
      <!-- first joint -->
      <joint   name="first" axis="0 1 0"  damping="0.1" armature="0.01"   frictionloss="0.02"/>
      <geom size="0.05" mass="0.2" pos="0 0 -0.1"/>
      <body name="b" pos="0 0 -0.2">
        <joint name="second" axis="0 1 0" damping="0.1" armature="0.01"/>
        <geom size="0.05" mass="0.2" pos="0 0 -0.1"/>
      </body>
    </body>
  </worldbody>

  <actuator>
    <!-- the order of these is that of the controls -->
    <motor name="fan" joint="first" gear="0.001"/>
    <position name="second" joint="second" kp="7" forcerange="-2 2" ctrlrange="-1 1" user="3"/>
    <position name="first"  joint="first"  kp="8" kv="0.1"/>
  </actuator>

  <sensor>
    <jointpos name="mine" joint="second"/>
    <!-- last of mine -->
  </sensor>

  <keyframe><key name="home" qpos="0.1 0.2" ctrl="0 0.2 0.1"/></keyframe>
</mujoco>
<!-- after all -->
"""


def test_what_a_person_wrote_stays(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "mine.xml", COMMENTED)
    variant = moved(source, ["stiffness", "damping"], joints=["second"])
    out = write_model(source, variant, tmp_path / "out.xml", note="calibrated -- on a Monday")
    text = out.read_text(encoding="utf-8")
    lines = [re.sub(r"(?<=\S) +", " ", line).strip() for line in text.splitlines()]
    for line in COMMENTED.splitlines()[1:]:
        if "second" not in line and "sensor" not in line:
            assert re.sub(r"(?<=\S) +", " ", line).strip() in lines, line
    assert "calibrated −− on a Monday" in text
    assert changed(source, out) == {
        "joint second": {"damping": ("0.1", f"{0.1 * math.exp(0.125):.10g}")},
        "position second": {"kp": ("7", f"{7 * math.exp(0.075):.10g}")},
    }
    assert source.read_text(encoding="utf-8") == COMMENTED


def test_the_written_file_compiles_to_the_variant(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "mine.xml", COMMENTED)
    kinds = ["stiffness", "velocity_gain", "damping", "armature", "coulomb_friction", "zero_offset"]
    for u in (0.4, 1.3):
        variant = moved(source, kinds, u)
        written = mujoco.MjModel.from_xml_path(str(write_model(source, variant, tmp_path / "out.xml")))
        same_physics(written, variant)


@pytest.mark.parametrize("kit", ["standard", "lite"])
def test_the_ants_file_keeps_its_names_and_order(kit: str, tmp_path: Path) -> None:
    source = nominal_model_path(kit)
    variant = moved(
        source, ["stiffness", "damping", "armature", "coulomb_friction", "zero_offset", "torque_limit"], 0.7
    )
    out = write_model(source, variant, tmp_path / "ant.xml")
    written = mujoco.MjModel.from_xml_path(str(out))
    same_physics(written, variant)
    given = mujoco.MjModel.from_xml_path(str(source))
    assert written.names == given.names, "every name in every list, in order"
    assert set(changed(source, out)) == {f"{tag} {joint}" for tag in ("joint", "position") for joint in JOINT_NAMES}
    assert out.read_text().count("<!--") == source.read_text().count("<!--")


def test_a_model_that_did_not_move_is_written_as_it_was(tmp_path: Path) -> None:
    source = nominal_model_path("standard")
    out = write_model(source, load_plant(source, setup=Setup.FLOOR).model, tmp_path / "same.xml")
    assert out.read_text().strip() == source.read_text().strip(), "it has its encoders already"


def test_sensors_come_behind_those_already_there(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "mine.xml", COMMENTED)
    given = load_plant(source, setup=Setup.FLOOR)
    out = write_model(source, given.model, tmp_path / "out.xml")
    model = mujoco.MjModel.from_xml_path(str(out))
    names = [model.sensor(k).name for k in range(model.nsensor)]
    assert names == ["mine", *(f"{signal}.{joint}" for joint in given.joints for signal in ("pos", "vel"))]
    data = mujoco.MjData(model)
    data.joint("first").qpos, data.joint("second").qvel = 0.3, -1.5
    mujoco.mj_forward(model, data)
    assert data.sensor("pos.first").data[0] == 0.3
    assert data.sensor("vel.second").data[0] == -1.5
    again = write_model(out, load_plant(out, setup=Setup.FLOOR).model, tmp_path / "again.xml")
    assert again.read_text() == out.read_text(), "what is there is not added twice"


def test_only_the_joints_asked_for_get_values_and_sensors(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "mine.xml", COMMENTED)
    variant = moved(source, ["stiffness"], joints=["first"])
    out = write_model(source, variant, tmp_path / "out.xml", joints=["first"])
    assert set(changed(source, out)) == {"position first"}
    assert "pos.first" in out.read_text()
    assert "pos.second" not in out.read_text()


DEFAULTS = """\
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default>
    <joint damping="0.3" axis="0 1 0" armature="0.01"/>
    <default class="strong">
      <joint frictionloss="0.1" range="-2 2"/>
      <position kp="20" forcerange="-3 3" DAMP/>
    </default>
  </default>
  <worldbody>
    <body childclass="strong">
      <joint name="one"/>
      <geom size="0.05" mass="0.2" pos="0 0 -0.1"/>
      <frame pos="0 0 -0.2">
        <body>
          <joint name="two"/>
          <geom size="0.05" mass="0.2" pos="0 0 -0.1"/>
        </body>
      </frame>
    </body>
  </worldbody>
  <actuator>
    <position class="strong" name="one" joint="one"/>
    <position class="strong" name="two" joint="two"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize("damp", ["", 'kv="0.4"', 'dampratio="0.7"', 'timeconst="0.03"'])
def test_values_of_a_default_class_are_overruled_where_they_moved(damp: str, tmp_path: Path) -> None:
    source = plants.write(tmp_path / "classes.xml", DEFAULTS.replace("DAMP", damp))
    kinds = ["stiffness", "damping", "armature", "coulomb_friction", "zero_offset", "torque_limit"]
    variant = moved(source, kinds, joints=["two"])
    out = write_model(source, variant, tmp_path / "out.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)
    # A ratio's gain follows the inertia that its joint feels, and that of the first has changed with the second's.
    also = {"position one"} if "dampratio" in damp else set()
    assert set(changed(source, out)) == {"joint two", "position two"} | also


@pytest.mark.parametrize("compiler", ["", '<compiler angle="degree"/>', '<compiler autolimits="true"/>'])
def test_angles_are_written_in_the_files_own_unit(compiler: str, tmp_path: Path) -> None:
    joint = 'damping="0.1" range="-70 80" ref="10" stiffness="0.2" springref="5"'
    source = plants.write(tmp_path / "degrees.xml", plants.pendulum(compiler=compiler, joint=joint))
    variant = moved(source, ["zero_offset"], 2.0)
    out = write_model(source, variant, tmp_path / "out.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)
    values = changed(source, out)["joint joint"]
    assert {name: [float(x) for x in after.split()] for name, (_, after) in values.items() if after} == {
        "ref": pytest.approx([11.0]),
        "range": pytest.approx([-69.0, 81.0]),
        "springref": pytest.approx([6.0]),
    }


def test_a_sliding_joint_is_in_metres_whatever_angles_are_in(tmp_path: Path) -> None:
    joint = 'type="slide" damping="3" range="-0.2 0.3" ref="0.1"'
    source = plants.write(tmp_path / "slide.xml", plants.pendulum(compiler="", joint=joint))
    variant = moved(source, ["zero_offset", "damping"], 1.0)
    out = write_model(source, variant, tmp_path / "out.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)


@pytest.mark.parametrize(
    ("servo", "joint"),
    [
        (f'<general {SERVO} gainprm="8" biastype="affine" biasprm="0 -8 -0.2"/>', ""),
        (f'<general {SERVO} gaintype="fixed" gainprm="8" biastype="affine" biasprm="0.5 -8 -0.2" gear="1"/>', ""),
        (f'<pid {SERVO} kp="8" ki="2" kv="0.1" imax="1" slewmax="3"/>', ""),
        (f'<position {SERVO} kp="8" dampratio="1"/>', 'armature="0.01"'),
        (f'<position {SERVO} kp="8" kv="0.2" timeconst="0.02" delay="0.01" nsample="20" interp="cubic"/>', ""),
        (f'<position {SERVO} kp="8" armature="0.02" damping="0.1"/>', ""),
        (f'<position {SERVO} kp="8"/>', 'damping="0.1 0.02 0.003"'),
        (f'<position {SERVO} kp="8" forcerange="-1 2"/>', 'damping="0.1"'),
    ],
)
def test_servos_of_every_kind_survive(servo: str, joint: str, tmp_path: Path) -> None:
    source = plants.write(tmp_path / "servo.xml", plants.pendulum(servo, joint=joint))
    kinds = ["stiffness", "velocity_gain", "damping", "armature", "coulomb_friction", "zero_offset"]
    variant = moved(source, kinds, 1.2)
    same_physics(mujoco.MjModel.from_xml_path(str(write_model(source, variant, tmp_path / "out.xml"))), variant)


def test_a_servo_found_electrical_becomes_a_motor_of_the_same_name_and_order(tmp_path: Path) -> None:
    source = nominal_model_path("standard")
    plant = load_plant(source, setup=Setup.FLOOR, electrical=True)
    variant = apply(plant, choose(plant, ["electrical_damping"]), np.full(8, 3.0))
    out = write_model(source, variant, tmp_path / "ant.xml")
    written = mujoco.MjModel.from_xml_path(str(out))
    same_physics(written, variant)
    assert [written.actuator(k).name for k in range(8)] == list(JOINT_NAMES)
    assert not [line for line in out.read_text().splitlines() if "<dcmotor" in line and "kp=" in line]


def test_a_motor_that_a_fit_has_written_is_fitted_again(tmp_path: Path) -> None:
    plant = load_plant(nominal_model_path("standard"), setup=Setup.FLOOR, electrical=True)
    first = write_model(
        nominal_model_path("standard"), apply(plant, choose(plant, ["electrical_damping"]), np.full(8, 3.0)), tmp_path / "first.xml"
    )  # fmt: skip
    again = load_plant(first, setup=Setup.FLOOR)
    chosen = choose(again, ["stiffness", "damping", "torque_limit"])
    variant = apply(again, chosen, np.full(len(chosen), 0.5))
    assert (variant.actuator_gainprm != again.model.actuator_gainprm).any()
    second = write_model(first, variant, tmp_path / "second.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(second)), variant)


@pytest.mark.parametrize("of", ["default", 'default class="servo"'])
def test_a_motor_takes_nothing_from_defaults_that_were_meant_for_the_servo(of: str, tmp_path: Path) -> None:
    """Its force range least of all, nor does it lose what its class said about delays and controls."""
    servo = '<position kp="8" forcerange="-1.5 1.5" ctrlrange="-1 1" delay="0.01" nsample="15" interp="linear"/>'
    defaults = f"<default>{servo}</default>" if of == "default" else f"<default><{of}>{servo}</default></default>"
    named = "" if of == "default" else 'class="servo"'
    text = plants.pendulum(f"<position {SERVO} {named}/>", compiler=f'<compiler angle="radian"/>{defaults}')
    source = plants.write(tmp_path / "classes.xml", text)
    plant = load_plant(source, setup=Setup.FLOOR, electrical=True)
    variant = apply(plant, choose(plant, ["electrical_damping", "stiffness"]), np.array([2.0, 0.5]))
    out = write_model(source, variant, tmp_path / "out.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)


def test_a_delay_comes_with_the_buffer_it_needs(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "plain.xml", plants.pendulum())
    plant = load_plant(source, setup=Setup.FLOOR, delayed=True)
    variant = apply(plant, [], np.array([]))
    variant.actuator_delay[0] = 0.0234
    out = write_model(source, variant, tmp_path / "out.xml")
    written = mujoco.MjModel.from_xml_path(str(out))
    assert written.actuator_delay[0] == pytest.approx(0.0234)
    assert written.actuator_history[0, 0] * written.opt.timestep > 0.0234


WALKER = """\
<mujoco>
  <compiler angle="radian"/>
  <default>
    <geom density="700" solref="0.02 1.2"/>
    <default class="foot"><geom friction="0.8 0.02 0.01" mass="0.05"/></default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" FLOOR/>
    <geom type="box" size="0.1 0.1 0.1" pos="2 0 0.1"/>
    <body name="torso" pos="0 0 0.4">
      <freejoint/>
      <geom size="0.07"/>
      <geom name="decor" size="0.09" mass="0" contype="0" conaffinity="0"/>
      <body pos="0.1 0 0">
        <joint name="left" axis="0 1 0" damping="0.1"/>
        <frame pos="0 0 -0.1"><geom size="0.03"/><body><geom class="foot" size="0.02" pos="0 0 -0.1"/></body></frame>
      </body>
      <body pos="-0.1 0 0">
        <inertial pos="0 0 -0.1" mass="0.2" fullinertia="1e-3 1e-3 1e-3 1e-5 0 0"/>
        <joint name="right" axis="0 1 0" damping="0.1"/>
        <geom size="0.03" pos="0 0 -0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="left" joint="left" kp="8" forcerange="-2 2"/>
    <position name="right" joint="right" kp="8" forcerange="-2 2"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize("inertia", ["auto", "true"])
def test_masses_change_where_the_file_states_them(inertia: str, tmp_path: Path) -> None:
    """In a geom's mass, its density, its class, or the inertial: and the inertia with them."""
    text = WALKER.replace("FLOOR", "").replace('angle="radian"', f'angle="radian" inertiafromgeom="{inertia}"')
    source = plants.write(tmp_path / "walker.xml", text)
    variant = moved(source, ["link_mass", "torso_mass"], 1.7)
    given = mujoco.MjModel.from_xml_string(text)
    assert np.isclose(variant.body_mass[1], given.body_mass[1] * math.exp(0.05 * 1.7))
    assert (variant.body_mass[2:] > given.body_mass[2:]).all()
    assert np.allclose(
        variant.body_inertia[1:].T / given.body_inertia[1:].T, variant.body_mass[1:] / given.body_mass[1:]
    )
    out = write_model(source, variant, tmp_path / "out.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)
    assert out.read_text().count('mass="0"') == 1, "decoration weighs nothing, as before"


@pytest.mark.parametrize("floor", ["", 'friction="0.5"', 'priority="1" friction="0.5" solimp="0.7 0.9 0.02"'])
def test_friction_and_softness_are_written_where_they_decide(floor: str, tmp_path: Path) -> None:
    source = plants.write(tmp_path / "walker.xml", WALKER.replace("FLOOR", floor))
    variant = moved(source, ["floor_friction", "contact_softness", "contact_impedance"], 0.4)
    out = write_model(source, variant, tmp_path / "out.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)
    elements = set(changed(source, out))
    assert "geom decor" not in elements
    if "priority" in floor:
        assert elements == {"geom floor"}


@pytest.mark.parametrize("stated", ["", 'friction="0.9 0.9 0.01 0.001 0.001" solref="0.03 1" solimp="0.8 0.9 0.01"'])
def test_a_pair_with_the_floor_is_written_too(stated: str, tmp_path: Path) -> None:
    """Whether it states its friction, or has it from its geoms; a pair of the robot with itself stays."""
    text = WALKER.replace("FLOOR", "").replace('<geom size="0.07"/>', '<geom name="belly" size="0.07"/>')
    text = text.replace('<geom class="foot"', '<geom name="foot" class="foot"')
    pairs = f'<contact><pair geom1="foot" geom2="floor" {stated}/><pair geom1="belly" geom2="foot" friction="0.3"/></contact>'
    source = plants.write(tmp_path / "walker.xml", text.replace("<actuator>", f"{pairs}<actuator>"))
    variant = moved(source, ["floor_friction", "contact_softness", "contact_impedance"], 0.4)
    given = load_plant(source, setup=Setup.FLOOR).model
    assert sorted(variant.pair_friction[:, 0] / given.pair_friction[:, 0]) == pytest.approx([1.0, math.exp(0.03)])
    out = write_model(source, variant, tmp_path / "out.xml")
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)


def test_geoms_that_cannot_be_told_apart_are_refused(tmp_path: Path) -> None:
    part = '<replicate count="2" offset="0 0.2 0"><body><geom size="0.01" mass="0.01"/></body></replicate>'
    source = plants.write(
        tmp_path / "many.xml", plants.pendulum().replace('<geom name="rod"', f'{part}<geom name="rod"')
    )
    with pytest.raises(BadInput, match="some body or geom is not written out in the file"):
        write_model(source, moved(source, ["link_mass"]), tmp_path / "out.xml")
    assert not (tmp_path / "out.xml").exists()
    same_physics(
        mujoco.MjModel.from_xml_path(str(write_model(source, moved(source, ["stiffness"]), tmp_path / "out.xml"))),
        moved(source, ["stiffness"]),
    )


@pytest.mark.parametrize(
    "servo",
    [
        f'<position {SERVO} kp="8" forcerange="-1 1"/>',
        f'<position {SERVO} kp="8" timeconst="0.02"/>',
        f'<general {SERVO} gainprm="8" biastype="affine" biasprm="0 -8 -0.2"/>',
    ],
)
def test_a_lag_is_written_as_the_filter_of_the_servo(servo: str, tmp_path: Path) -> None:
    source = plants.write(tmp_path / "servo.xml", plants.pendulum(servo))
    variant = moved(source, ["actuator_lag", "stiffness"], 1.3)
    lag = 0.02 * math.exp(0.3 * 1.3) if "timeconst" in servo else 0.02 * 1.3
    written = mujoco.MjModel.from_xml_path(str(write_model(source, variant, tmp_path / "out.xml")))
    assert written.actuator_dynprm[0, 0] == pytest.approx(lag)
    same_physics(written, variant)


def test_without_lag_a_filtered_servo_is_the_given_one(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "servo.xml", plants.pendulum())
    out = write_model(source, moved(source, ["actuator_lag"], 0.0), tmp_path / "out.xml")
    assert changed(source, out) == {}


# --- files in pieces ---------------------------------------------------------------------------------------------------


def test_includes_are_taken_in_at_any_depth(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    plants.write(
        tmp_path / "parts" / "inner.xml",
        '<mujocoinclude><!-- inner --><joint name="joint" axis="0 1 0" damping="0.1"/></mujocoinclude>',
    )
    plants.write(
        tmp_path / "parts" / "arm.xml",
        '<mujocoinclude><body><include file="INNER"/><geom size="0.05" mass="0.2" pos="0 0 -0.1"/></body></mujocoinclude>',
    )
    plants.write(tmp_path / "both.xml", f'<mujoco><actuator><position {SERVO} kp="8"/></actuator></mujoco>')
    source = plants.write(
        tmp_path / "robot.xml",
        '<mujoco><!-- outer --><worldbody><include file="parts/arm.xml"/></worldbody><include file="both.xml"/></mujoco>',
    )
    for inner in ("inner.xml", "parts/inner.xml"):
        arm = tmp_path / "parts" / "arm.xml"
        text = arm.read_text()
        arm.write_text(text.replace("INNER", inner))
        try:
            mujoco.MjModel.from_xml_path(str(source))
        except ValueError:
            arm.write_text(text)
            continue
        break
    variant = moved(source, ["stiffness", "damping"])
    out = write_model(source, variant, tmp_path / "out" / "robot.xml")
    text = out.read_text()
    assert "<include" not in text
    assert "mujocoinclude" not in text
    assert "<!-- inner -->" in text
    assert "<!-- outer -->" in text
    for part in (tmp_path / "parts" / "arm.xml", tmp_path / "both.xml"):
        part.unlink()
    same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)


BLOCK = (
    "".join(f"v {x} {y} {z}\n" for x in (0, 0.02) for y in (0, 0.02) for z in (0, 0.02)) + "f 1 2 4\nf 5 7 8\nf 1 5 6\n"
)


@pytest.mark.parametrize(
    ("compiler", "file", "at"),
    [
        ("<compiler/>", "block.obj", "block.obj"),
        ("", "block.obj", "block.obj"),
        ("", "meshes/block.obj", "meshes/block.obj"),
        ('<compiler meshdir="meshes"/>', "block.obj", "meshes/block.obj"),
        ('<compiler meshdir="meshes/"/>', "deep/block.obj", "meshes/deep/block.obj"),
        ('<compiler assetdir="assets"/>', "block.obj", "assets/block.obj"),
        ('<compiler assetdir="assets" texturedir="textures"/>', "block.obj", "assets/block.obj"),
        ('<compiler texturedir="textures"/>', "block.obj", "block.obj"),
        ('<compiler meshdir="ABSOLUTE"/>', "block.obj", "elsewhere/block.obj"),
    ],
)
def test_meshes_are_found_from_wherever_the_file_is_written(compiler: str, file: str, at: str, tmp_path: Path) -> None:
    given = tmp_path / "given"
    (given / at).parent.mkdir(parents=True)
    (given / at).write_text(BLOCK)
    text = plants.pendulum(compiler=compiler.replace("ABSOLUTE", str(given / "elsewhere")))
    text = text.replace("<worldbody>", f'<asset><mesh name="block" file="{file}" inertia="shell"/></asset><worldbody>')
    text = text.replace('<geom name="rod"', '<geom type="mesh" mesh="block" mass="0.1"/><geom name="rod"')
    source = plants.write(given / "robot.xml", text)
    variant = moved(source, ["stiffness"])
    for out in (given / "beside.xml", tmp_path / "far" / "away" / "robot.xml", given / "robot.xml"):
        write_model(source, variant, out)
        same_physics(mujoco.MjModel.from_xml_path(str(out)), variant)


@pytest.mark.parametrize("compiler", ["", '<compiler meshdir="meshes"/>'])
def test_meshes_that_lie_beside_an_included_file_are_found(compiler: str, tmp_path: Path) -> None:
    given = tmp_path / "given"
    (given / "parts").mkdir(parents=True)
    (given / "parts" / "block.obj").write_text(BLOCK)
    asset = '<mujocoinclude><asset><mesh name="block" file="block.obj" inertia="shell"/></asset></mujocoinclude>'
    plants.write(given / "parts" / "block.xml", asset)
    text = plants.pendulum(compiler=compiler).replace("<worldbody>", '<include file="parts/block.xml"/><worldbody>')
    text = text.replace('<geom name="rod"', '<geom type="mesh" mesh="block" mass="0.1"/><geom name="rod"')
    source = plants.write(given / "robot.xml", text)
    variant = moved(source, ["stiffness"])
    for out in (given / "beside.xml", tmp_path / "far" / "robot.xml"):
        same_physics(mujoco.MjModel.from_xml_path(str(write_model(source, variant, out))), variant)


def test_textures_and_meshes_have_folders_of_their_own(tmp_path: Path) -> None:
    given = tmp_path / "given"
    (given / "textures").mkdir(parents=True)
    (given / "block.obj").write_text(BLOCK)
    cv2.imwrite(str(given / "textures" / "wood.png"), np.zeros((4, 4, 3), np.uint8))
    assets = (
        '<asset><mesh name="block" file="block.obj" inertia="shell"/>'
        '<texture name="wood" type="2d" file="wood.png"/></asset>'
    )
    text = plants.pendulum(compiler='<compiler angle="radian" texturedir="textures"/>')
    text = text.replace("<worldbody>", assets + "<worldbody>")
    text = text.replace('<geom name="rod"', '<geom type="mesh" mesh="block" mass="0.1"/><geom name="rod"')
    source = plants.write(given / "robot.xml", text)
    variant = moved(source, ["stiffness"])
    same_physics(
        mujoco.MjModel.from_xml_path(str(write_model(source, variant, tmp_path / "far" / "robot.xml"))), variant
    )


def test_models_that_are_attached_are_found_too(tmp_path: Path) -> None:
    given = tmp_path / "given"
    given.mkdir()
    plants.write(
        given / "gripper.xml",
        '<mujoco><worldbody><body name="claw"><geom size="0.01" mass="0.05"/></body></worldbody></mujoco>',
    )
    text = plants.pendulum().replace("<worldbody>", '<asset><model name="g" file="gripper.xml"/></asset><worldbody>')
    text = text.replace('<geom name="rod"', '<attach model="g" body="claw" prefix="g_"/><geom name="rod"')
    source = plants.write(given / "robot.xml", text)
    variant = moved(source, ["stiffness"])
    same_physics(
        mujoco.MjModel.from_xml_path(str(write_model(source, variant, tmp_path / "far" / "robot.xml"))), variant
    )


# --- bad input ---------------------------------------------------------------------------------------------------------


def test_joints_that_are_not_written_out_are_refused(tmp_path: Path) -> None:
    """Nothing is left behind: not the file, not a part of it."""
    source = plants.write(
        tmp_path / "many.xml",
        """\
<mujoco>
  <worldbody>
    <replicate count="2" offset="0 0.2 0">
      <body><joint name="joint" axis="0 1 0"/><geom size="0.05" mass="0.1" pos="0 0 -0.1"/></body>
    </replicate>
  </worldbody>
  <actuator><position name="a" joint="joint0" kp="5"/><position name="b" joint="joint1" kp="5"/></actuator>
</mujoco>
""",
    )
    (tmp_path / "out").mkdir()
    with pytest.raises(BadInput, match="the joint 'joint0' is not written out in the file") as info:
        write_model(source, moved(source, ["stiffness"]), tmp_path / "out" / "many.xml")
    assert "MjSpec.to_xml()" in str(info.value.remedy)
    assert list((tmp_path / "out").iterdir()) == []


def test_a_value_that_the_file_cannot_carry_leaves_no_file(tmp_path: Path) -> None:
    """Here the variant is not of this file at all."""
    source = plants.write(tmp_path / "mine.xml", COMMENTED)
    variant = load_plant(source, setup=Setup.FLOOR).model
    variant.actuator_biasprm[1, 0] = 0.0
    variant.actuator_biasprm[1, 1] = -9.0  # and not its gain: a position actuator cannot be that
    (tmp_path / "out").mkdir()
    with pytest.raises(BadInput, match="the gain of joint 'second' does not survive in this file's structure"):
        write_model(source, variant, tmp_path / "out" / "mine.xml")
    assert list((tmp_path / "out").iterdir()) == []


def test_an_existing_file_survives_a_refusal(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "mine.xml", COMMENTED)
    variant = load_plant(source, setup=Setup.FLOOR).model
    variant.actuator_biasprm[1, 1] = -9.0
    kept = plants.write(tmp_path / "kept.xml", "what stood here before")
    with pytest.raises(BadInput, match="does not survive"):
        write_model(source, variant, kept)
    assert kept.read_text() == "what stood here before"


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    source = plants.write(tmp_path / "mine.xml", COMMENTED)
    blocker = plants.write(tmp_path / "file", "")
    with pytest.raises(OSError, match="file") as info:
        write_model(source, load_plant(source, setup=Setup.FLOOR).model, blocker / "out.xml")
    assert "file" in str(info.value.filename)
