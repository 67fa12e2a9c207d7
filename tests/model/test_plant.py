"""A model set up for a run: its servos found by the names the run uses, its contacts what they should be, its errors clear."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import plants
import pytest

from openant_tools.errors import BadInput
from openant_tools.model.plant import Setup, load_plant, setup_of
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import KITS
from openant_tools.robot.mjcf import nominal_mjcf, nominal_model_path

every_kit = pytest.mark.parametrize("kit", list(KITS))
Pairs = set[frozenset[str]]

#: one leg on a base that floats above a floor and a table; the leg hangs on a bracket that is a body of its own
WALKER = """\
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="table" pos="0 0 0.1"><geom name="top" type="plane" size="1 1 0.05"/></body>
    <body name="base" pos="0 0 0.3">
      <freejoint/>
      <geom name="base" type="sphere" size="0.1" mass="1"/>
      <body name="bracket" pos="0.1 0 0">
        <geom name="bracket" type="box" size="0.03 0.03 0.03" mass="0.1"/>
        <body pos="0.02 0 0">
          <joint name="hip" axis="0 1 0"/>
          <geom name="thigh" type="capsule" size="0.02" fromto="0 0 0 0.1 0 0" mass="0.1"/>
          <body name="shank" pos="0.1 0 0">
            <joint name="knee" axis="0 1 0"/>
            <geom name="shank" type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact>
    <pair geom1="floor" geom2="shank"/>
    <pair geom1="base" geom2="shank"/>
  </contact>
  <actuator>
    <position name="hip" joint="hip" kp="5"/>
    <position name="knee" joint="knee" kp="5"/>
  </actuator>
</mujoco>
"""


def touching(model: Any, joints: dict[str, float], *, lift: float = 0.0) -> Pairs:
    """The pairs of geoms in contact at these joint angles, by name (of the body where a geom has none)."""
    data = mujoco.MjData(model)
    for name, angle in joints.items():
        data.joint(name).qpos = angle
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        data.qpos[2] += lift
    mujoco.mj_forward(model, data)

    def name(geom: int) -> str:
        own = model.geom(geom).name
        return own or f"{model.body(model.geom_bodyid[geom]).name} {geom - model.body_geomadr[model.geom_bodyid[geom]]}"

    return {frozenset((name(c.geom1), name(c.geom2))) for c in data.contact}


def without_excludes(text: str) -> str:
    """The platform's own file has none: there the torso is kept from its legs by MuJoCo's filter of parents alone."""
    return re.sub(r"<exclude[^>]*/>", "", text)


@every_kit
@pytest.mark.parametrize("strip", [str, without_excludes], ids=["as written", "without excludes"])
def test_on_the_stand_the_robot_touches_itself_as_in_the_air(
    kit: str, strip: Callable[[str], str], tmp_path: Path
) -> None:
    path = plants.write(tmp_path / "ant.xml", strip(nominal_mjcf(kit)))
    stand, floor = load_plant(path).model, load_plant(path, setup=Setup.FLOOR).model
    chance = np.random.default_rng(0)
    met: Pairs = set()
    for _ in range(200):
        pose = dict(zip(JOINT_NAMES, chance.uniform(-2.4, 2.4, 8), strict=True))
        in_the_air = touching(floor, pose, lift=5.0)
        assert touching(stand, pose) == in_the_air
        met |= in_the_air
    assert met, "some poses fold a leg against the body"


def test_the_stand_keeps_contacts_with_the_world_away(tmp_path: Path) -> None:
    path = plants.write(tmp_path / "walker.xml", WALKER)
    reach = {"hip": 1.4, "knee": 0.0}
    assert frozenset(("floor", "shank")) in touching(load_plant(path, setup=Setup.FLOOR).model, reach)
    assert frozenset(("top", "shank")) in touching(load_plant(path, setup=Setup.FLOOR).model, reach)
    assert touching(load_plant(path).model, reach) == set()


@pytest.mark.parametrize("filtered", [True, False])
def test_the_stand_keeps_contacts_of_a_robot_with_itself(filtered: bool, tmp_path: Path) -> None:
    """Pairs by name included, and those that the model's own filter of parents leaves, or does not."""
    flag = "" if filtered else '<option><flag filterparent="disable"/></option>'
    path = plants.write(tmp_path / "walker.xml", WALKER.replace("<worldbody>", flag + "<worldbody>"))
    stand, floor = load_plant(path).model, load_plant(path, setup=Setup.FLOOR).model
    chance = np.random.default_rng(1)
    met: Pairs = set()
    for _ in range(100):
        pose = {"hip": chance.uniform(-3, 3), "knee": chance.uniform(-3, 3)}
        assert touching(stand, pose) == touching(floor, pose, lift=5.0)
        met |= touching(stand, pose)
    assert frozenset(("base", "shank")) in met
    assert (frozenset(("bracket", "thigh")) in met) is not filtered


def test_a_robot_bolted_to_the_bench_can_still_hit_its_own_base(tmp_path: Path) -> None:
    """Its base cannot move and is a part of the robot; the bench cannot move either and is not."""
    path = plants.write(
        tmp_path / "arm.xml",
        """\
<mujoco>
  <worldbody>
    <body name="bench"><geom name="bench" type="box" size="1 1 0.01" pos="0 0 -0.1"/></body>
    <body name="base">
      <geom name="base" type="box" size="0.02 0.02 0.05" pos="0.1 0 0"/>
      <body>
        <joint name="arm" axis="0 1 0"/>
        <geom name="arm" type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="arm" kp="5"/></actuator>
</mujoco>
""",
    )
    stand = load_plant(path).model
    assert touching(stand, {"arm": 0.0}) == set()
    assert touching(stand, {"arm": -np.pi / 2}) == {frozenset(("base", "arm"))}


@every_kit
def test_the_torso_stays_where_the_model_puts_it(kit: str) -> None:
    plant = load_plant(nominal_model_path(kit))
    assert plant.free_joint is None
    assert plant.model.nq == plant.model.nv == 8
    data = mujoco.MjData(plant.model)
    mujoco.mj_step(plant.model, data, 50)
    assert data.body("torso").xpos == pytest.approx([0, 0, 0.4])
    assert data.body("torso").xquat == pytest.approx([1, 0, 0, 0])
    assert plant.model.opt.gravity[2] == pytest.approx(-9.81)


def test_joints_come_in_the_order_they_are_asked_for() -> None:
    wanted = ("knee_fl", "hip_rr", "knee_rl")
    for setup in Setup:
        plant = load_plant(nominal_model_path("standard"), wanted, setup)
        assert plant.joints == wanted
        for k, joint in enumerate(wanted):
            assert plant.qpos[k] == plant.model.joint(joint).qposadr[0]
            assert plant.dof[k] == plant.model.joint(joint).dofadr[0]
            assert plant.actuator[k] == plant.model.actuator(joint).id


def test_legs_are_trees_of_their_own_on_the_stand_alone() -> None:
    stand = load_plant(nominal_model_path("standard"))
    assert [int(tree) for tree in stand.tree] == [0, 0, 1, 1, 2, 2, 3, 3]
    floor = load_plant(nominal_model_path("standard"), setup=Setup.FLOOR)
    assert len(set(floor.tree.tolist())) == 1


def test_an_actuator_of_the_joints_name_counts_before_others_on_the_same_joint(tmp_path: Path) -> None:
    helper = '<position name="spring" joint="joint" kp="1"/>'
    text = plants.pendulum(helper + f'<position {plants.SERVO} kp="8"/>')
    plant = load_plant(plants.write(tmp_path / "two.xml", text))
    assert plant.model.actuator(int(plant.actuator[0])).name == "joint"


@pytest.mark.parametrize(
    "servo",
    [
        f"<motor {plants.SERVO}/>",
        f'<velocity {plants.SERVO} kv="2"/>',
        f'<intvelocity {plants.SERVO} kp="8" actrange="-1 1"/>',
        f'<pid {plants.SERVO} kp="8" kv="0.2" input="vel"/>',
        f'<dcmotor {plants.SERVO} motorconst="0.1" resistance="2"/>',
        f'<damper {plants.SERVO} kv="2" ctrlrange="0 1"/>',
    ],
)
def test_an_actuator_whose_control_is_no_position_is_none_of_ours(servo: str, tmp_path: Path) -> None:
    path = plants.write(tmp_path / "arm.xml", plants.pendulum(servo))
    with pytest.raises(BadInput, match="no joint of the model is driven by a position servo → use <position>") as info:
        load_plant(path)
    assert info.value.where == str(path)


@pytest.mark.parametrize(
    "servo",
    [
        f'<pid {plants.SERVO} kp="8" kv="0.2" slewmax="3"/>',
        f'<pid {plants.SERVO} kp="8" ki="1" imax="1" input="pos"/>',
        f'<dcmotor {plants.SERVO} input="pos" motorconst="0.1" resistance="2" controller="8 0 0.1 0 0 12"/>',
        f'<general {plants.SERVO} gainprm="8" biastype="affine" biasprm="0 -8 0"/>',
    ],
)
def test_every_kind_of_position_servo_is_found(servo: str, tmp_path: Path) -> None:
    assert load_plant(plants.write(tmp_path / "arm.xml", plants.pendulum(servo))).joints == ("joint",)


def test_torque_off_disables_the_servo_and_leaves_the_joint(tmp_path: Path) -> None:
    servo = f'<position {plants.SERVO} kp="8" kv="0.3" damping="0.4" armature="0.02"/>'
    plant = load_plant(plants.write(tmp_path / "arm.xml", plants.pendulum(servo)))
    limp = plant.with_torque_off(plant.model, np.array([True]))
    data = mujoco.MjData(limp)
    data.qpos[0], data.qvel[0], data.ctrl[0] = 0.4, 2.0, -1.0
    mujoco.mj_forward(limp, data)
    assert data.actuator_force[0] == 0
    assert data.qfrc_passive[0] <= -0.12 * 2.0 + 1e-9, "the joint's own damping still brakes"
    assert plant.with_torque_off(plant.model, np.array([False])) is plant.model
    assert not plant.model.opt.disableactuator, "the plant's own model stays as it was"


@pytest.mark.parametrize(
    ("words", "setup"),
    [
        ("floor", Setup.FLOOR),
        (" Floor ", Setup.FLOOR),
        ("stand", Setup.STAND),
        ("my bench", Setup.STAND),
        (None, Setup.STAND),
    ],
)
def test_what_is_no_floor_is_a_fixed_base(words: str | None, setup: Setup) -> None:
    assert setup_of(words) is setup


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"nowhere\.xml: no such model file → name an MJCF with --model MODEL\.xml"):
        load_plant(tmp_path / "nowhere.xml")


@pytest.mark.parametrize(
    "text", ["", "<mujoco>", "<mujoco><worldbody><geom/></worldbody></mujoco>", "not XML at all", "\0\1"]
)
def test_a_file_that_mujoco_cannot_load_says_so_in_one_line(text: str, tmp_path: Path) -> None:
    path = plants.write(tmp_path / "broken.xml", text)
    with pytest.raises(BadInput, match="MuJoCo cannot load it: ") as info:
        load_plant(path)
    assert "\n" not in str(info.value)
    assert str(info.value).startswith(str(path))


def test_a_folder_is_no_model(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such model file"):
        load_plant(tmp_path)


def test_a_model_without_actuators_gets_a_remedy(tmp_path: Path) -> None:
    path = plants.write(tmp_path / "limp.xml", plants.pendulum(""))
    with pytest.raises(
        BadInput, match="the model has no actuators → give each joint a <position> actuator in its MJCF"
    ):
        load_plant(path)


def test_a_joint_that_is_not_there_gets_the_nearest_name() -> None:
    path = nominal_model_path("standard")
    with pytest.raises(BadInput, match=r"no position-controlled joint 'kneefl' → did you mean 'knee_fl'\?"):
        load_plant(path, ["hip_rr", "kneefl"])
    with pytest.raises(BadInput, match="its position-controlled joints are hip_rr, knee_rr, "):
        load_plant(path, ["Rotation"])


# --- what is only drawn --------------------------------------------------------------------------------------------------

#: two links of an arm that hangs above a floor, each drawn by one mesh and collided by another
DRAWN_ARM = """\
<mujoco>
  <compiler angle="radian" {compiler}/>
  <asset>
    <mesh name="shell" file="lump.obj" scale="1 1 1.2" refpos="0 0 0.01"/>
    <mesh name="lump" file="lump.obj"/>
    {texture}
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1" {floor}/>
    <body name="upper" pos="0 0 0.16">
      <freejoint/>
      <geom name="upper shell" type="mesh" mesh="shell" contype="0" conaffinity="0" density="500"/>
      <geom name="upper" type="mesh" mesh="lump" euler="0.3 0.2 0.1" density="300"/>
      <body name="lower" pos="0.1 0 0">
        <inertial pos="0 0 -0.02" mass="0.2" diaginertia="1e-4 2e-4 1.5e-4"/>
        <joint name="elbow" axis="0 1 0" damping="0.05"/>
        <geom type="mesh" mesh="shell" contype="0" conaffinity="0"/>
        <geom name="lower" type="mesh" mesh="lump"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="2"/></actuator>
</mujoco>
"""
TEXTURE = (
    '<texture name="floor" type="2d" builtin="checker" rgb1=".1 .2 .3" rgb2=".2 .3 .4" width="1024" height="1024"/>'
    '<material name="floor" texture="floor"/>'
)


def write_lump(path: Path, rings: int = 40) -> None:
    """A ball with dents, whose hull has far fewer corners than it."""
    around = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    lines, n = [], 2 * rings
    for up in np.linspace(0, np.pi, rings):
        radius = 0.03 * (1 + 0.1 * np.sin(5 * up) * np.cos(4 * around))
        for r, a in zip(radius, around, strict=True):
            lines.append(
                f"v {r * np.sin(up) * np.cos(a) + 0.01} {1.5 * r * np.sin(up) * np.sin(a)} {2 * r * np.cos(up)}"
            )
    for ring in range(rings - 1):
        for k in range(n):
            a, b = ring * n + k + 1, ring * n + (k + 1) % n + 1
            lines += [f"f {a} {a + n} {b}", f"f {b} {a + n} {b + n}"]
    path.write_text("\n".join(lines), encoding="utf-8")


def drawn_arm(folder: Path, compiler: str = "", texture: str = TEXTURE) -> Path:
    write_lump(folder / "lump.obj")
    floor = 'material="floor"' if texture else ""
    return plants.write(folder / "arm.xml", DRAWN_ARM.format(compiler=compiler, texture=texture, floor=floor))


@pytest.mark.parametrize("compiler", ["", 'inertiafromgeom="true" inertiagrouprange="0 2"'])
@pytest.mark.parametrize("setup", list(Setup))
def test_what_is_only_drawn_is_not_simulated(setup: Setup, compiler: str, tmp_path: Path) -> None:
    """Every number of the physics is the file's, where a mesh gives a body its mass, too."""
    path = drawn_arm(tmp_path, compiler)
    small, whole = (load_plant(path, setup=setup, drawn=drawn).model for drawn in (False, True))
    assert mujoco.mj_sizeModel(whole) > 3e6
    assert mujoco.mj_sizeModel(small) < 0.2 * mujoco.mj_sizeModel(whole)
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_invweight0", "geom_bodyid"):
        assert np.allclose(getattr(small, field), getattr(whole, field), rtol=1e-9, atol=0), field
    assert [small.geom(k).name for k in range(small.ngeom)] == [whole.geom(k).name for k in range(whole.ngeom)]


def test_a_hull_lands_as_its_mesh_does(tmp_path: Path) -> None:
    path = drawn_arm(tmp_path)
    ends = []
    for drawn in (False, True):
        model = load_plant(path, setup=Setup.FLOOR, drawn=drawn).model
        data = mujoco.MjData(model)
        for _ in range(300):
            mujoco.mj_step(model, data)
        assert data.ncon
        ends.append(data.qpos.copy())
    assert np.allclose(*ends, atol=1e-4)


def test_looks_that_are_missing_do_not_keep_a_model_from_moving(tmp_path: Path) -> None:
    lost = '<texture name="floor" type="2d" file="lost.png"/><material name="floor" texture="floor"/>'
    path = drawn_arm(tmp_path, texture=lost)
    load_plant(path)
    with pytest.raises(BadInput, match=r"lost\.png"):
        load_plant(path, drawn=True)
