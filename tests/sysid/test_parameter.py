"""What identification may change: kinds known by name, and what a user declares; found again where they are known."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import plain
import plants
import pytest
import tomlkit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from openant_tools.cli.sysid_fit import fit
from openant_tools.errors import BadInput
from openant_tools.model.mjcf import write_model
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.recording.tables import write_table
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path
from openant_tools.sysid.declared import Declaration, declared_parameters, read_declarations
from openant_tools.sysid.identify import Identification, Value, applicable, calibrated, identify, restated
from openant_tools.sysid.kinds import KINDS
from openant_tools.sysid.parameter import apply, choose, restatements
from openant_tools.sysid.protocols import CommandSpace, protocol
from openant_tools.sysid.result import write_fit, write_robot

#: the fit's step; what is recorded is stepped sixteen times as finely
MODEL = plants.pendulum(option=plants.COARSE)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return plants.write(tmp_path / "pendulum.xml", MODEL)


def record(text: str, name: str, seed: int = 0, *, reach: float = 0.5, seconds: float = 4.0) -> Run:
    """What the robot of this MJCF logs on its stand."""
    robot = mujoco.MjModel.from_xml_string(text)
    robot.opt.timestep = 0.000125
    robot.geom_contype[0] = robot.geom_conaffinity[0] = 0  # the bench
    t = plants.jittering(seconds, 100.0)
    command = plants.sweep(t, 1, reach=reach + 0.05 * seed, high_hz=2.0 + 0.2 * seed)
    columns = plants.drive(robot, ["joint"], t, command, noise=3e-4, quantum=plants.ENCODER_RAD, seed=seed)
    return plants.run_of(columns, t, ["joint"], name)


def fitted(text: str, model: Path, kinds: Sequence[str], **more: Any) -> Identification:
    return identify([record(text, "a", **more)], model, [record(text, "b", 1, **more)], kinds=kinds)


def value(result: Identification, name: str) -> Value:
    return next(value for value in result.values if value.name == name)


# --- kinds known by name -----------------------------------------------------------------------------------------------


def test_a_lag_is_told_from_a_delay(model: Path, tmp_path: Path) -> None:
    robot = MODEL.replace('kp="8"', 'kp="7.4" timeconst="0.035"')
    kinds = ["stiffness", "damping", "coulomb_friction", "actuator_lag", "action_delay"]
    result = fitted(robot, model, kinds)
    lag = value(result, "actuator_lag.joint")
    assert lag.low <= 0.035 <= lag.high
    assert lag.value == pytest.approx(0.035, abs=0.002)
    assert value(result, "action_delay.joint").value < 0.002
    assert result.after.full < 0.05 * result.before.full
    write_fit(result, tmp_path / "fit")
    assert 'timeconst="0.0' in (tmp_path / "fit" / "calibrated.xml").read_text()
    # And the same figure in plain MuJoCo, from the written file and the table alone.
    write_table(result.held_out[0].runs[0], tmp_path / "b.csv")
    table = plain.read_table(tmp_path / "b.csv")
    theirs = plain.play(plain.on_stand(tmp_path / "fit" / "calibrated.xml"), table, ["joint"])
    assert plain.gap(table, theirs, ["joint"]) < 0.06 * result.before.full


def test_a_filter_without_lag_is_the_given_model(model: Path) -> None:
    run = record(MODEL, "a")
    given, lagging = (Rollouts(load_plant(model, lagging=lagging), [run])().pos for lagging in (False, True))
    assert np.abs(given - lagging).max() < 1e-12


def test_a_speed_limit_shows_where_torque_saturates(model: Path) -> None:
    robot = MODEL.replace('forcerange="-1.5 1.5"', 'forcerange="-1.2 1.2"').replace('damping="0.12"', 'damping="0.15"')
    result = fitted(robot, model, ["stiffness", "torque_limit", "speed_limit", "coulomb_friction"], reach=1.2)
    assert value(result, "torque_limit.joint").value == pytest.approx(1.2, rel=0.03)
    assert value(result, "speed_limit.joint").value == pytest.approx(1.2 / 0.15, rel=0.03)
    assert calibrated(result).dof_damping[0] == pytest.approx(0.15, rel=0.03)


def test_a_speed_limit_and_damping_are_two_words_for_one_thing(model: Path) -> None:
    with pytest.raises(BadInput, match=r"two words for one thing: .* → fit one of them"):
        fitted(MODEL, model, ["damping", "speed_limit"])


@pytest.mark.parametrize("saturates", [False, True])
def test_velocity_gain_and_damping_are_apart_only_where_torque_saturates(saturates: bool, tmp_path: Path) -> None:
    """Within the limit only their sum brakes; at the limit the velocity gain, which is clipped with it, does not."""
    given = MODEL.replace('kp="8"', 'kp="8" kv="0.1"').replace("-1.5 1.5", "-1.2 1.2" if saturates else "-20 20")
    model = plants.write(tmp_path / "both.xml", given)
    robot = given.replace('kv="0.1"', 'kv="0.13"').replace('damping="0.12"', 'damping="0.1"')
    kinds = ["stiffness", "velocity_gain", "damping", "coulomb_friction"]
    result = fitted(robot, model, kinds, reach=1.2 if saturates else 0.4)
    gain, damping = value(result, "velocity_gain.joint"), value(result, "damping.joint")
    if saturates:
        assert {gain.verdict, damping.verdict} == {"identified"}
        assert gain.value == pytest.approx(0.13, rel=0.15)
        assert damping.value == pytest.approx(0.1, rel=0.05)
    else:
        assert {gain.verdict, damping.verdict} == {"tied"}
        assert (gain.tied_to, damping.tied_to) == (damping.name, gain.name)
        assert "saturating-steps" in gain.record_next
        assert gain.value + damping.value == pytest.approx(0.23, rel=0.05)


def test_a_heavier_link_is_found_with_its_inertia(model: Path) -> None:
    robot = MODEL.replace('mass="0.3"', 'mass="0.321"').replace('mass="0.02"', 'mass="0.0214"')
    result = fitted(robot, model, ["stiffness", "damping", "coulomb_friction", "link_mass"])
    mass = value(result, "link_mass.joint")
    assert mass.low <= 0.3424 <= mass.high
    assert result.after.full < result.before.full
    written = calibrated(result)
    assert written.body_mass[1] == pytest.approx(mass.value)
    given = load_plant(model, setup=Setup.FLOOR).model
    assert np.allclose(written.body_inertia[1] / given.body_inertia[1], mass.value / mass.given)


def test_links_of_one_mass_are_one_part(tmp_path: Path) -> None:
    plant = load_plant(nominal_model_path("standard"), setup=Setup.FLOOR)
    chosen = choose(plant, ["link_mass", "torso_mass", "floor_friction"])
    assert [p.name for p in chosen] == ["link_mass.hip", "link_mass.knee", "torso_mass.body", "floor_friction.body"]
    assert [len(p.joints) for p in chosen] == [4, 4, 8, 8]


def test_what_a_model_cannot_have_is_not_fitted(tmp_path: Path) -> None:
    """An arm on a bench has no torso, a pid no filter, an unlimited servo no speed limit."""
    pid = f'<pid {plants.SERVO} kp="8" kv="0.1"/>'
    plant = load_plant(plants.write(tmp_path / "pid.xml", plants.pendulum(pid)), lagging=True)
    assert choose(plant, ["torso_mass", "actuator_lag", "speed_limit", "torque_limit"]) == []


#: what of the Ant and its floor the fit below does not know
FLOOR_FRICTION, TORSO_KG = 0.75, 0.40


@pytest.fixture(scope="module")
def on_floor(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Identification]:
    """An Ant that scrubs: hips pull against each other until feet slip. Only its encoders are logged."""
    text = nominal_model_path("standard").read_text()
    path = plants.write(
        tmp_path_factory.mktemp("ant") / "ant.xml", text.replace('timestep="0.001"', 'timestep="0.002"')
    )
    robot = mujoco.MjModel.from_xml_string(text)
    robot.geom_friction[robot.geom("floor").id, 0] = FLOOR_FRICTION
    address = [robot.joint(joint).qposadr[0] for joint in JOINT_NAMES]

    def scrub(name: str, seed: int) -> Run:
        command = protocol("scrub", 6.0).commands(CommandSpace.around_home(), 50.0, seed)
        data = mujoco.MjData(robot)
        data.qpos[address] = data.ctrl[:] = command[0]
        data.qpos[2] = 0.25
        mujoco.mj_step(robot, data, 2000)
        position = np.empty(command.shape)
        for k, row in enumerate(command):
            position[k] = data.qpos[address]
            data.ctrl[:] = row
            mujoco.mj_step(robot, data, 20)
        columns = {f"cmd.{joint}": command[:, j] for j, joint in enumerate(JOINT_NAMES)}
        position = np.round(position / plants.ENCODER_RAD) * plants.ENCODER_RAD
        columns |= {f"pos.{joint}": position[:, j] for j, joint in enumerate(JOINT_NAMES)}
        return plants.run_of(columns, np.arange(len(command)) / 50.0, JOINT_NAMES, name, setup="floor")

    return path, identify([scrub("a", 0)], path, [scrub("b", 1)], kinds=["floor_friction"])


def test_feet_that_slip_tell_the_friction_of_the_floor(on_floor: tuple[Path, Identification]) -> None:
    _, result = on_floor
    friction = value(result, "floor_friction.body")
    assert friction.value == pytest.approx(FLOOR_FRICTION, rel=0.05)
    assert friction.verdict == "conflict", "it is a third less than the given model says"
    assert friction.joints == ()
    assert result.after.full < 0.3 * result.before.full
    assert result.after.horizon < result.before.horizon


def test_the_floor_is_written_and_nothing_else(on_floor: tuple[Path, Identification], tmp_path: Path) -> None:
    path, result = on_floor
    out = write_model(path, calibrated(result), tmp_path / "out.xml")
    before, after = path.read_text().splitlines(), out.read_text().splitlines()
    differing = [b for a, b in zip(before, after, strict=True) if a != b]
    assert len(differing) == 1
    assert '<geom name="floor"' in differing[0]


def test_what_belongs_to_the_body_stands_so_in_robot_toml(
    on_floor: tuple[Path, Identification], tmp_path: Path
) -> None:
    _, result = on_floor
    folder = create_robot(tmp_path / "ant", "standard")
    write_robot(result, folder)
    table = tomllib.loads(folder.config_file.read_text())
    assert table["identified"] == {"floor_friction": {"body": pytest.approx(FLOOR_FRICTION, rel=0.05)}}
    assert folder.check()[1] == []


def test_the_floor_is_fitted_by_itself_where_a_robot_stood_on_it(on_floor: tuple[Path, Identification]) -> None:
    plant = load_plant(on_floor[0], setup=Setup.FLOOR)
    found = applicable(None, plant, limp=False, on_floor=True)
    assert {"floor_friction", "contact_softness"} < set(found)
    assert "torso_mass" not in found
    arm = load_plant(plants.write(on_floor[0].with_name("arm.xml"), MODEL), setup=Setup.FLOOR)
    bolted = applicable(None, arm, limp=False, on_floor=True)
    assert "floor_friction" not in bolted, "an arm that is bolted down walks on nothing"


@pytest.mark.parametrize("kind", [kind for kind in KINDS if KINDS[kind].effect is None])
def test_every_kind_is_read_as_it_was_written(kind: str) -> None:
    plant = load_plant(
        nominal_model_path("standard"),
        setup=Setup.FLOOR,
        electrical=kind == "electrical_damping",
        lagging=kind == "actuator_lag",
    )
    chosen = choose(plant, [kind])
    assert chosen
    for u in (0.0, 0.3, 0.6):
        moved = apply(plant, chosen, np.full(len(chosen), u))
        for parameter in chosen:
            for j in parameter.joints:
                wanted = parameter.value(KINDS[kind].read(plant.model, plant, j), u)
                if kind != "action_delay":  # which is beside the model
                    assert KINDS[kind].read(moved, plant, j) == pytest.approx(wanted, abs=1e-4)


# --- declared parameters -----------------------------------------------------------------------------------------------

BOB = """
kinds = ["stiffness", "damping", "coulomb_friction"]

[[parameter]]
name = "bob mass"
element = "geom"
match = "b*b"
attribute = "mass"
std = 0.1
low = 0.1
high = 0.6
unit = "kg"
"""


def declare(folder: Path, text: str) -> Declaration:
    return read_declarations(plants.write(folder / "mine.toml", text))


def test_what_a_user_declares_is_found_and_written(model: Path, tmp_path: Path) -> None:
    robot = MODEL.replace('mass="0.3"', 'mass="0.34"')
    runs = [record(robot, "a"), record(robot, "b", 1)]
    result = identify(runs[:1], model, runs[1:], declared=declare(tmp_path, BOB))
    mass = value(result, "bob mass.all")
    assert mass.low <= 0.34 <= mass.high
    assert (mass.given, mass.unit, mass.verdict) == (pytest.approx(0.3), "kg", "identified")
    assert result.after.full < 0.5 * result.before.full
    assert restated(result)
    write_fit(result, tmp_path / "fit")
    text = (tmp_path / "fit" / "calibrated.xml").read_text()
    assert f'<geom name="bob" type="sphere" pos="0 0 -0.1" size="0.04" mass="{mass.value:.10g}"/>' in text
    assert '<geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.02"/>' in text


def test_a_declared_model_moves_in_plain_mujoco_as_in_a_rollout(model: Path, tmp_path: Path) -> None:
    entry = '[[parameter]]\nname="{0}"\nelement="{1}"\nmatch="{2}"\nattribute="{3}"\nstd=0.1\nmode="{4}"\n'
    text = entry.format("where", "geom", "bob", "pos", "add") + "index = 2\n"
    text += entry.format("weight", "option", "", "gravity", "scale") + "index = 2\n"
    text += entry.format("pull", "actuator", "joint", "forcerange", "scale")
    text += entry.format("rub", "joint", "joint", "damping", "scale") + "index = 0\n"
    plant = load_plant(model, setup=Setup.FLOOR)
    chosen = declared_parameters(plant, declare(tmp_path, text))
    u = np.array([-0.2, 0.5, -1.0, 0.7])
    variant = apply(plant, chosen, u)
    assert variant.opt.gravity[2] == pytest.approx(-9.81 * math.exp(0.05))
    assert variant.actuator_forcerange[0, 1] == pytest.approx(1.5 * math.exp(-0.1))
    out = write_model(model, variant, tmp_path / "out.xml", stated=restatements(model, chosen, u))
    run = record(MODEL, "a", seconds=2.0)
    write_table(run, tmp_path / "run.csv")
    stand = load_plant(model)
    ours = Rollouts(stand, [run])([apply(stand, chosen, u)]).pos[0]
    theirs = plain.play(plain.on_stand(out), plain.read_table(tmp_path / "run.csv"), ["joint"])
    assert np.ptp(theirs) > 0.2
    assert np.abs(ours - theirs).max() < 1e-7


LEGS = """\
<mujoco>
  <compiler angle="degree"/>
  <default><geom mass="0.2" friction="0.7"/></default>
  <worldbody>
    <body name="a">
      <joint name="left" axis="0 1 0" damping="0.1" ref="5" range="-60 60" limited="true"/>
      <geom name="shin left" size="0.03" pos="0 0 -0.1"/>
    </body>
    <body name="b" pos="0 0.2 0">
      <joint name="right" axis="0 1 0" damping="0.2"/>
      <inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>
      <geom name="shin right" size="0.03" pos="0 0 -0.1" mass="0.25"/>
    </body>
  </worldbody>
  <contact><pair name="touch" geom1="shin left" geom2="shin right" solref="0.02 1"/></contact>
  <tendon><fixed name="belt" stiffness="0.3"><joint joint="left" coef="1"/><joint joint="right" coef="-1"/></fixed></tendon>
  <actuator>
    <position name="left" joint="left" kp="8" forcerange="-2 2"/>
    <position name="right" joint="right" kp="8" forcerange="-2 2"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("entry", "read", "names"),
    [
        (
            'element="geom" match="shin*" attribute="mass" tie="each"',
            lambda m: [m.body("a").mass[0] / 0.2],
            ["mine.shin left", "mine.shin right"],
        ),
        ('element="geom" match="shin left" attribute="mass"', lambda m: [m.body("a").mass[0] / 0.2], ["mine.all"]),
        (
            'element="joint" match="*t" attribute="damping" index=0',
            lambda m: [m.dof_damping[0] / 0.1, m.dof_damping[1] / 0.2],
            ["mine.all"],
        ),
        ('element="joint" match="left" attribute="ref"', lambda m: [m.qpos0[0] / math.radians(5)], ["mine.all"]),
        (
            'element="joint" match="left" attribute="range" index=[0, 1]',
            lambda m: [*m.jnt_range[0] / math.radians(60) * [-1, 1]],
            ["mine.all"],
        ),
        ('element="inertial" match="b" attribute="mass"', lambda m: [m.body("b").mass[0] / 0.3], ["mine.all"]),
        ('element="inertial" match="b" attribute="diaginertia"', lambda m: [*m.body("b").inertia / 1e-3], ["mine.all"]),
        ('element="pair" match="touch" attribute="solref" index=0', lambda m: [m.pair_solref[0, 0] / 0.02], ["mine.all"]),
        ('element="tendon" match="belt" attribute="stiffness" index=0', lambda m: [m.tendon_stiffness[0] / 0.3], ["mine.all"]),
        ('element="body" match="b" attribute="pos" index=1', lambda m: [m.body("b").pos[1] / 0.2], ["mine.all"]),
        ('element="option" attribute="gravity" index=2', lambda m: [m.opt.gravity[2] / -9.81], ["mine.all"]),
    ],
)  # fmt: skip
def test_any_number_can_be_declared(
    entry: str, read: Callable[[Any], list[float]], names: list[str], tmp_path: Path
) -> None:
    source = plants.write(tmp_path / "legs.xml", LEGS)
    lines = "\n".join(part.strip() for part in entry.replace('" ', '"\n').split("\n"))
    declaration = declare(tmp_path, f'[[parameter]]\nname="mine"\nstd=0.1\n{lines}\n')
    plant = load_plant(source, setup=Setup.FLOOR)
    chosen = declared_parameters(plant, declaration)
    assert [parameter.name for parameter in chosen] == names
    u = np.full(len(chosen), 1.5)
    variant = apply(plant, chosen, u)
    assert read(variant) == pytest.approx([math.exp(0.15)] * len(read(variant)))
    out = write_model(source, variant, tmp_path / "out.xml", stated=restatements(source, chosen, u))
    written = mujoco.MjModel.from_xml_path(str(out))
    assert read(written) == pytest.approx(read(variant))


def test_declared_and_known_kinds_change_the_same_file(tmp_path: Path) -> None:
    """A declared mass, and all links heavier: neither is taken twice."""
    source = plants.write(tmp_path / "legs.xml", LEGS)
    plant = load_plant(source, setup=Setup.FLOOR)
    text = '[[parameter]]\nname="mine"\nstd=0.1\nelement="geom"\nmatch="shin left"\nattribute="mass"\n'
    chosen = [*choose(plant, ["link_mass", "stiffness"]), *declared_parameters(plant, declare(tmp_path, text))]
    u = np.array([1.0] * len(chosen))
    variant = apply(plant, chosen, u)
    out = write_model(source, variant, tmp_path / "out.xml", stated=restatements(source, chosen, u))
    written = mujoco.MjModel.from_xml_path(str(out))
    assert np.allclose(written.body_mass, variant.body_mass, rtol=1e-8)
    assert np.allclose(written.actuator_biasprm, variant.actuator_biasprm)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('element = "geon"', "no element is called 'geon' → did you mean 'geom'?"),
        ('match = "bop"', "no geom is called 'bop' → did you mean 'bob'?"),
        ('attribute = "mas"', "a geom has no number called 'mas' → did you mean 'mass'?"),
        ('attribute = "type"', "a geom has no number called 'type'"),
        ("index = 3", "mass has no number 3 → count from 0 to 0"),
        (f"std = 1{400 * '0'}", "has a whole number of more than 64 bits"),
        ("std = -1", "std is -1 → give the prior's standard deviation, above 0"),
        ('std = "wide"', "std is 'wide' → give a number"),
        ('mode = "multiply"', "mode is 'multiply' → choose 'scale' or 'add'"),
        ('tie = "none"', "tie is 'none' → choose 'all' or 'each'"),
        ("low = 0.7", "low 0.7 is not below high 0.6 → swap them"),
        ("low = 0.4", "the mass of geom 'bob' is 0.3, outside 0.4 … 0.6 → widen low and high"),
        ('name = "stiffness"', "not a name for it"),
        ('name = "a.b"', "not a name for it"),
        ('atribute = "mass"', "unknown key 'atribute' → did you mean 'attribute'?"),
    ],
)
def test_a_bad_entry_gets_one_line_that_says_what_to_do(line: str, words: str, model: Path, tmp_path: Path) -> None:
    key = line.partition(" ")[0]
    kept = [own for own in BOB.splitlines() if own.partition(" ")[0] != key]
    with pytest.raises(BadInput) as info:
        declared_parameters(load_plant(model), declare(tmp_path, "\n".join([*kept, line])))
    message = str(info.value)
    assert words in message
    assert "mine.toml" in message
    assert "\n" not in message


def test_a_run_whose_own_model_lacks_what_was_declared_is_named(model: Path, tmp_path: Path) -> None:
    other = plants.write(tmp_path / "other.xml", MODEL.replace('name="bob"', 'name="weight"'))
    runs = [record(MODEL, "a", seconds=2.0), record(MODEL, "b", 1, seconds=2.0)]
    runs[1] = replace(runs[1], facts=replace(runs[1].facts, model=str(other)))
    with pytest.raises(BadInput, match=r"other.xml: no geom is called 'bob' → there are bench, rod, weight"):
        identify(runs, model, declared=declare(tmp_path, BOB))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[parameter]\n", "not TOML"),
        ("", r"no \[\[parameter\]\] in it → declare one"),
        ("[parameter]\nname = 'x'\n", r"no \[\[parameter\]\] in it"),
        ("[[parameters]]\nname = 'x'\n", "unknown key 'parameters'"),
        ("[[parameter]]\nname = 'x'\n", "parameter 'x': no element → an entry needs"),
        ("[[parameter]]\nelement = 'x'\n", "parameter 1: no name"),
        (BOB + BOB.partition("\n\n")[2], "two parameters are called 'bob mass'"),
        (BOB.replace('["stiffness", "damping", "coulomb_friction"]', '"stiffness"'), "kinds is not a list of words"),
        (BOB.replace('"coulomb_friction"', "3"), "kinds is not a list of words"),
    ],
)
def test_a_bad_file_of_parameters_is_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=words):
        declare(tmp_path, text)


VALUES = st.one_of(
    st.text(max_size=8), st.integers(), st.floats(), st.booleans(), st.lists(st.integers(-3, 3), max_size=3)
)
ENTRY = st.fixed_dictionaries(
    {},
    optional={
        "name": VALUES | st.just("mine"),
        "element": VALUES | st.sampled_from(["geom", "joint", "option", "inertial", "actuator"]),
        "match": VALUES | st.just("*"),
        "attribute": VALUES | st.sampled_from(["mass", "friction", "gravity", "damping", "pos", "axis"]),
        "std": VALUES | st.floats(0.01, 1.0),
        "index": VALUES,
        "mode": VALUES | st.sampled_from(["add", "scale"]),
        "low": VALUES,
        "high": VALUES,
        "tie": VALUES | st.sampled_from(["all", "each"]),
        "unit": VALUES,
    },
)


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(entry=ENTRY)
def test_whatever_stands_in_an_entry_is_fitted_or_refused_in_one_line(
    entry: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.getbasetemp()
    model = plants.write(folder / "any.xml", MODEL)
    path = plants.write(folder / "any.toml", tomlkit.dumps({"parameter": [entry]}))
    chosen, words = [], ""
    try:
        chosen = declared_parameters(load_plant(model), read_declarations(path))
    except BadInput as refusal:
        words = str(refusal)
    assert bool(chosen) != bool(words)
    assert len(words.splitlines()) <= 1
    for parameter in chosen:
        low, high = parameter.bounds(parameter.definition.read(load_plant(model).model, load_plant(model), 0))
        assert low <= 0.0 <= high


def test_a_number_that_the_file_does_not_state_is_refused(model: Path, tmp_path: Path) -> None:
    model.write_text(MODEL.replace('mass="0.3"', ""))
    with pytest.raises(BadInput, match=r"geom 'bob' does not say its mass → .*density for mass"):
        declared_parameters(load_plant(model), declare(tmp_path, BOB))
    zero = BOB.replace('"mass"', '"solmix"').replace("low = 0.1\nhigh = 0.6", "")
    model.write_text(MODEL.replace('mass="0.3"', 'mass="0.3" solmix="0"'))
    with pytest.raises(BadInput, match='is 0, and cannot be scaled → use mode = "add"'):
        declared_parameters(load_plant(model), declare(tmp_path, zero))


def test_a_missing_file_of_parameters_leaves_no_folder(model: Path, tmp_path: Path) -> None:
    write_table(record(MODEL, "a", seconds=2.0), tmp_path / "a.csv")
    words = [str(tmp_path / "a.csv"), "--model", str(model), "--out", str(tmp_path / "fit")]
    with pytest.raises(BadInput, match=r"no such file of parameters → name one with --parameters FILE.toml"):
        fit.main([*words, "--parameters", str(tmp_path / "none.toml")], standalone_mode=False)
    assert not (tmp_path / "fit").exists()
