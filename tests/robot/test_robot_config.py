"""robot.toml and its folder: what a builder edits stays, what cannot be is named with line and remedy."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import datetime
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sources import modules

from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.robot.config import _SECTIONS as SECTIONS
from openant_tools.robot.config import (
    ACTION_PRESETS,
    EffectEntry,
    MotorSection,
    Provenance,
    RobotConfig,
    parse_config,
    read_document,
)
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES, JOINTS
from openant_tools.robot.kit import KITS
from openant_tools.robot.platform_config import export_platform_config, read_platform_config

MEASURED = Provenance(
    how="measured",
    command="openant calib zeros",
    recording="recordings/zeros.mcap",
    date=datetime.datetime(2026, 3, 1, 12, 0, tzinfo=datetime.UTC),
    low=0.78,
    high=0.80,
)


@pytest.fixture
def ant(tmp_path: Path) -> RobotFolder:
    return create_robot(tmp_path / "ant")


def rewrite(folder: RobotFolder, *changes: tuple[str, str]) -> None:
    """Edit robot.toml as its owner would."""
    text = folder.config_file.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    folder.config_file.write_text(text, encoding="utf-8")


def line_of(folder: RobotFolder, text: str) -> int:
    lines = folder.config_file.read_text(encoding="utf-8").splitlines()
    return next(n for n, line in enumerate(lines, 1) if text in line)


def refusal(folder: RobotFolder) -> str:
    with pytest.raises(BadInput) as error:
        folder.config()
    return str(error.value)


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `openant …`."""
    with pytest.raises(SystemExit) as error:
        main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert isinstance(error.value.code, int)
    assert "Traceback" not in captured.err
    return error.value.code, captured.out, captured.err


# A new robot


@pytest.mark.parametrize("kit", list(KITS))
def test_a_new_robot_is_consistent_and_nominal(tmp_path: Path, kit: str) -> None:
    folder = create_robot(tmp_path / "my ant", kit)
    config, problems = folder.check()
    assert problems == []
    assert config is not None
    assert config == folder.config()
    assert (config.name, config.kit, tuple(config.motors)) == ("my ant", kit, JOINT_NAMES)
    assert config.ids == (10, 11, 20, 21, 30, 31, 40, 41)
    for motor in config.motors.values():
        assert motor.model == KITS[kit].servo(motor.kind).name
        assert motor.max_rad == -motor.min_rad == pytest.approx(math.radians(45 if motor.kind == "hip" else 70))
    source = config.provenance_of("motors.hip_rr.zero_offset_rad")
    assert source is not None
    assert source.how == "nominal"
    assert folder.model_path().is_file()
    assert folder.recordings.is_dir()


def test_a_robot_is_not_made_twice(ant: RobotFolder, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"there is a robot\.toml already"):
        create_robot(ant.path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="is a file, but a robot is a folder"):
        create_robot(tmp_path / "file")
    with pytest.raises(BadInput, match="there is no kit 'heavy'"):
        create_robot(tmp_path / "other", "heavy")
    assert not (tmp_path / "other").exists()


def test_the_folder_may_be_named_by_its_file(ant: RobotFolder) -> None:
    assert RobotFolder.at(ant.config_file) == RobotFolder.at(ant.path) == ant
    assert ant.relative(ant.recordings / "a.mcap") == "recordings/a.mcap"
    with pytest.raises(BadInput, match=r"there is no robot.toml here → make one with `openant config new"):
        RobotFolder.at(ant.path / "elsewhere")


def test_awkward_names_are_quoted(tmp_path: Path) -> None:
    name = 'Ameise "acht" \\ 12 # é'
    assert create_robot(tmp_path / "a", name=name).config().name == name


# What cannot be


@pytest.mark.parametrize(
    ("changes", "key", "message"),
    [
        ([("id = 21", "id = 20")], "motors.knee_fr.id", "20 is also the id of hip_fr → two servos cannot share an id"),
        ([("id = 21", 'id = "21"')], "motors.knee_fr.id", "is text, but a whole number is needed"),
        ([("id = 21", "id = 254")], "motors.knee_fr.id", "254 cannot be → give a whole number from 0 to 252"),
        ([("id = 21", "id = true")], "motors.knee_fr.id", "is true or false, but a whole number is needed"),
        ([("XM430-W350-T\"\ndir", "XM430-350\"\ndir")], "motors.knee_rr.model", "did you mean 'XM430-W350-T'?"),
        ([("direction = 1", "direction = 0")], "motors.hip_rr.direction", "0 is no direction → use one of 1, -1"),
        ([("zero_offset_rad = 3.141592653589793", "zero_offset_rad = 300")], "motors.hip_rr.zero_offset_rad",
         "300 rad cannot be → angles stand in rad; if degrees were meant write 5.23599"),
        ([("zero_offset_rad = 3.141592653589793", "zero_offset_rad = nan")], "motors.hip_rr.zero_offset_rad",
         "nan rad cannot be"),
        ([("zero_offset_rad = 3.141592653589793", 'zero_offset_rad = "0.0"')], "motors.hip_rr.zero_offset_rad",
         "leave out the quotes"),
        ([("\nzero_offset_rad", "\nzero_offest_rad")], "motors.hip_rr.zero_offset_rad",
         "is missing → is 'motors.hip_rr.zero_offest_rad' a slip of it?"),
        ([("min_rad = -0.7853981633974483", "min_rad = 0.8")], "motors.hip_rr.min_rad", "is not below max_rad"),
        ([("[motors.hip_rr]", "[motors.hip_r]")], "motors.hip_r", "there is no such joint → did you mean 'hip_rr'?"),
        ([("baud = 1_000_000", "baud = 500_000")], "bus.baud", "500000 is no baud rate that servos have"),
        ([("return_delay_s = 0.0", "return_delay_s = 250")], "bus.return_delay_s", "250 s cannot be"),
        ([("dt_s = 0.12", "dt_s = 120")], "timing.dt_s", "give a value from 0.002 to 2 s"),
        ([('kit = "standard"', 'kit = "standart"')], "kit", "'standart' is no kit → did you mean 'standard'?"),
        ([('preset = "platform"', 'preset = "ppo"')], "actions.preset", "use one of platform, sac, sarsa"),
        ([("gyro_bias_rad_s = [0.0, 0.0, 0.0]", "gyro_bias_rad_s = [0.0]")], "imu.gyro_bias_rad_s", "list of 3"),
        ([('model = "nominal.xml"', 'model = "calibrated.xml"')], "model", "there is no file"),
        ([('schema = "openant.robot/1"', 'schema = "openant.robot/7"')], "schema", "update it"),
        ([("[motors.hip_rr]", '[motors."a\\nb"]')], "'motors.a\\nb'", "there is no such joint"),
        ([("[bus]", "[bus]\nchain = [['hip_rr', 'hip_rr']]")], "bus.chain", "hip_rr stands in it twice"),
        ([("[timing]", "[timing]\n[[effect]]\neffect = 'x'\njoints = 'knee_fl'")], "effect[1].joints",
         'write ["knee_fl"]'),
        ([("[observation]", "[observation]\n'pos.hip_rr' = [1, -1] #")], "observation.pos.hip_rr", "low must be below"),
    ],
)  # fmt: skip
def test_each_impossible_value_is_named_with_its_line(
    ant: RobotFolder, changes: list[tuple[str, str]], key: str, message: str
) -> None:
    rewrite(ant, *changes)
    said = refusal(ant)
    assert message in said
    assert f"robot.toml, line {line_of(ant, changes[0][1].splitlines()[-1].split('=')[0])}" in said or key in said
    assert key in said
    assert len(said.splitlines()) == 1


def test_the_line_is_the_values_own(ant: RobotFolder) -> None:
    rewrite(ant, ("id = 31", "id = 999  # oops"))
    assert f"robot.toml, line {line_of(ant, '999')}, motors.knee_fl.id: 999 cannot be" in refusal(ant)


def test_all_problems_are_listed_at_once_by_line(ant: RobotFolder, capsys: pytest.CaptureFixture[str]) -> None:
    rewrite(ant, ("id = 41", "id = 40"), ("baud = 1_000_000", "baud = 5"), ("dt_s = 0.12", "dt_s = 'fast'"))
    code, out, _ = run(capsys, "config", "check", "--robot", ant.path)
    assert code == 1
    keys = [line.split(": ")[0].rsplit(", ", 1)[1] for line in out.splitlines()]
    assert keys == ["bus.baud", "motors.knee_rl.id", "timing.dt_s"]
    assert "`openant config check` lists 2 more" in refusal(ant)


def test_a_slip_of_an_optional_key_is_a_note_and_no_failure(
    ant: RobotFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(ant, ("watchdog_s = 0.2", "watchdogs = 0.2"), ("[timing]", "[colours]\nshin = 'orange'\n[timing]"))
    code, out, _ = run(capsys, "config", "check", "--robot", ant.path)
    assert code == 0
    assert "note:" in out
    assert "bus.watchdogs: is not known; is 'watchdog_s' meant?" in out
    assert out.count("watchdogs") == 1
    assert out.count("colours: is not known: nothing reads it") == 1, "the owner's own stays, and does nothing"
    assert ant.config().unknown == ("colours",)


def test_a_setting_that_was_retired_says_what_took_its_place(
    ant: RobotFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(ant, ("[bus]\n", "[bus]\nlatency_timer_ms = 1\nlatency_timer = 1\n"))
    code, out, _ = run(capsys, "config", "check", "--robot", ant.path)
    assert code == 0
    assert "bus.latency_timer_ms: is read no more: the adapter itself is asked" in out
    assert "bus.latency_timer: is not known" in out
    assert "latency_timer_ms = 1" in ant.config_file.read_text(), "what is not known stays"


def reads_of_settings() -> dict[str, set[str]]:
    """Section of robot.toml → the names of its settings that some code of ours reads.

    A setting is read as an attribute of what stands for its section: `config.bus.baud`, a name that a section was given to
    (`seen = robot.camera`; `seen.focal_px`), a parameter that is declared as one (`motor: Motor`), or of itself within
    its class.
    """
    sections = {one.name: type(one.default).__name__ for one in dataclasses.fields(RobotConfig) if one.name in SECTIONS}
    classes = {name: section for section, name in sections.items()} | {"Motor": "motors", "CameraFacts": "camera"}
    found: dict[str, set[str]] = {section: set() for section in classes.values()}
    for module in modules():
        nodes, text = module.nodes, module.text
        stands: dict[str, str] = {"motor": "motors", "m": "motors"}
        for node in nodes:
            pairs: list[tuple[ast.expr, ast.expr]] = []
            if isinstance(node, ast.Assign):
                for target in node.targets:
                    both = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                    pairs += zip(target.elts, node.value.elts, strict=True) if both else [(target, node.value)]
            elif isinstance(node, ast.arg) and node.annotation is not None:
                kind = ast.unparse(node.annotation).rpartition(".")[2]
                if kind in classes:
                    stands[node.arg] = classes[kind]
            for target, value in pairs:
                if isinstance(target, ast.Name) and isinstance(value, ast.Attribute) and value.attr in sections:
                    stands[target.id] = value.attr
        for kind in [node for node in nodes if isinstance(node, ast.ClassDef) and node.name in classes]:
            found[classes[kind.name]] |= {n.attr for n in ast.walk(kind) if isinstance(n, ast.Attribute)}
        for node in nodes:
            if not isinstance(node, ast.Attribute):
                continue
            of = node.value
            section = (
                of.attr if isinstance(of, ast.Attribute) and of.attr in sections
                else stands.get(of.id) if isinstance(of, ast.Name)
                else "motors" if "motors" in text and "motors" in ast.unparse(of) else None
            )  # fmt: skip
            if section in found:
                found[section].add(node.attr)
    return found


def test_no_setting_is_read_by_nobody() -> None:
    read = reads_of_settings()
    declared = {
        **{name: {field.metadata.get("key") or field.name for field in dataclasses.fields(kind) if field.metadata}
           for name, kind in SECTIONS.items()},
        "motors": {field.name for field in dataclasses.fields(MotorSection) if field.metadata},
    }  # fmt: skip
    idle = [f"{section}.{name}" for section, names in declared.items() for name in sorted(names - read[section])]
    assert not idle, f"settings of robot.toml that no code reads: {', '.join(idle)}; let them act, or take them away"


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
def test_a_file_cut_anywhere_is_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = create_robot(tmp_path_factory.mktemp("cut") / "ant")
    whole = folder.config_file.read_bytes()
    length = data.draw(st.integers(0, len(whole) - 1))
    zeros = data.draw(st.sampled_from([0, 512]))
    folder.config_file.write_bytes(whole[:length] + b"\0" * zeros)
    if zeros == 0 and length > whole.rindex(b"max_rad = "):
        # What comes after the last motor may be missing, and a number cut short is one; at least it is noted.
        with contextlib.suppress(BadInput):
            _, located = folder.check(simulate=False)
            cut_short = [entry for entry in located if "is the file cut short?" in str(entry)]
            assert bool(cut_short) == (whole[length - 1] != ord("\n"))
    else:
        said = refusal(folder)
        assert len(said.splitlines()) == 1
        assert "robot.toml" in said


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data[:900] + b"\0" * 400, "holds zero bytes, as a power cut leaves them"),
        (lambda data: data[:900] + b"\xff\xfe", "is no UTF-8 text"),
        (lambda data: data + b'\nname = "', "is not TOML"),
        (lambda data: data.replace(b"[bus]", b"[ports]"), "is not TOML"),
    ],
)
def test_a_damaged_file_names_the_newest_backup(
    ant: RobotFolder, capsys: pytest.CaptureFixture[str], damage: Callable[[bytes], bytes], message: str
) -> None:
    ant.update({"ports.bus": "/dev/ttyUSB0"})
    ant.config_file.write_bytes(damage(ant.config_file.read_bytes()))
    code, _, err = run(capsys, "config", "check", "--robot", ant.path)
    assert code == 2
    assert message in err
    assert f"bring back {ant.newest_backup}" in err


def test_a_model_without_a_joint_fails_the_check(ant: RobotFolder) -> None:
    text = (ant.path / "nominal.xml").read_text(encoding="utf-8")
    ant.path.joinpath("nominal.xml").write_text(
        re.sub(r'<position name="knee_fl".*/>|<key name.*/>', "", text), encoding="utf-8"
    )
    assert "no actuator of" in str(ant.check()[1][0])
    ant.path.joinpath("nominal.xml").write_text("<mujoco>", encoding="utf-8")
    (problem,) = ant.check()[1]
    assert "MuJoCo cannot load" in str(problem)
    assert len(str(problem).splitlines()) == 1


# Changing values


def test_an_update_changes_one_line_and_says_where_it_came_from(ant: RobotFolder) -> None:
    rewrite(ant, ("id = 31", "id = 31   # the loud one"), ("[timing]", "[my.notes]\nx = [1,  2]\n\n[timing]"))
    before = ant.config_file.read_text(encoding="utf-8").splitlines()
    config = ant.update({"motors.knee_fl.id": 33}, provenance=MEASURED)
    after = ant.config_file.read_text(encoding="utf-8").splitlines()
    assert config == ant.config()
    assert config.motors["knee_fl"].id == 33
    assert config.provenance_of("motors.knee_fl.id") == MEASURED
    changed = [line for line in after if line not in before]
    assert changed[0] == "id = 33   # the loud one"
    assert changed[1].startswith('"motors.knee_fl.id" = {how = "measured"')
    assert len(changed) == 2
    assert len(after) == len(before) + 1


def test_what_stood_there_before_is_kept_under_its_date(ant: RobotFolder) -> None:
    contents = [ant.config_file.read_bytes()]
    for port in ("/dev/a", "/dev/b"):
        ant.update({"ports.bus": port})
        contents.append(ant.config_file.read_bytes())
    backups = sorted(ant.backups.iterdir())
    assert [backup.read_bytes() for backup in backups] == contents[:2]
    assert backups[-1] == ant.newest_backup
    ant.update({"ports.bus": "/dev/b"})
    assert len(list(ant.backups.iterdir())) == 2, "nothing changed, nothing written"


def test_a_value_that_cannot_be_leaves_the_file_as_it_was(ant: RobotFolder) -> None:
    before = ant.config_file.read_bytes()
    with pytest.raises(BadInput, match=r"20 is also the id of .*; the file was left as it is"):
        ant.update({"motors.hip_rr.id": 20})
    with pytest.raises(BadInput, match=r"there is no model calibrated\.xml to name"):
        ant.update({"model": "calibrated.xml"})
    with pytest.raises(BadInput, match="name is no table"):
        ant.update({"name.first": "x"})
    assert ant.config_file.read_bytes() == before
    there = sorted(path.name for path in ant.path.iterdir() if not path.name.startswith("."))
    assert there == ["findings", "nominal.xml", "recordings", "robot.toml"]


def test_numbers_of_numpy_and_bounds_go_in(ant: RobotFolder) -> None:
    config = ant.update(
        {
            "motors.hip_rr.zero_offset_rad": np.float64(0.25),
            "imu.gyro_bias_rad_s": np.array([0.01, 0.0, -0.02]),
            "observation.pos.hip_rr": (-0.8, 0.8),
            "observation.gyro.x": [-3, 3],
            "bus.chain": (("hip_rr", "knee_rr"), ("hip_fr",)),
        }
    )
    assert config.motors["hip_rr"].zero_offset_rad == 0.25
    assert config.imu.gyro_bias_rad_s == (0.01, 0.0, -0.02)
    assert config.observation == {"pos.hip_rr": (-0.8, 0.8), "gyro.x": (-3.0, 3.0)}
    assert config.bus.chain == (("hip_rr", "knee_rr"), ("hip_fr",))
    assert '"pos.hip_rr" = [-0.8, 0.8]' in ant.config_file.read_text(encoding="utf-8")


def test_bounds_in_tables_of_the_owners_stay_there(ant: RobotFolder) -> None:
    rewrite(ant, ("[provenance]", "[observation.pos]\nhip_rr = [-0.5, 0.5]  # mine\n\n[provenance]"))
    config = ant.update({"observation.pos.hip_rr": [-0.6, 0.6]})
    assert config.observation == {"pos.hip_rr": (-0.6, 0.6)}
    assert "hip_rr = [-0.6, 0.6]  # mine" in ant.config_file.read_text(encoding="utf-8")


def test_provenance_covers_whole_tables_and_every_joint(ant: RobotFolder) -> None:
    every, one = Provenance("imported"), Provenance("by hand")
    config = ant.update({}, provenance={"motors.hip_rr.id": one, "motors.*.id": every})
    assert config.provenance_of("motors.hip_rr.id") == every, "the newer entry is about this value too"
    config = ant.update({}, provenance={"motors.hip_rr.id": one})
    assert config.provenance_of("motors.hip_rr.id") == one
    assert config.provenance_of("motors.hip_fl.id") == every
    hip = config.provenance_of("motors.hip_fl.model")
    assert hip is not None
    assert hip.how == "nominal"
    assert config.provenance_of("timing.dt_s") is None


def test_effects_are_added_changed_and_taken_away(ant: RobotFolder) -> None:
    delay = EffectEntry("action_delay", "all", {"delay_s": 0.02})
    friction = EffectEntry("load_friction", ("knee_fl", "knee_rl"), {"coefficient": 0.12}, enabled=False)
    cable = EffectEntry("cable_drag", "body", {"force_n": 0.2, "direction": [1.0, 0.0, 0.0]})
    before = ant.config_file.read_text(encoding="utf-8")
    assert ant.update(effects=[delay, friction, cable]).effects == (delay, friction, cable)
    rewrite(ant, ('effect = "action_delay"', 'effect = "action_delay"  # measured twice'))
    changed = EffectEntry("action_delay", "all", {"delay_s": 0.021})
    assert ant.update(effects=[changed, friction, cable]).effects == (changed, friction, cable)
    assert "# measured twice" in ant.config_file.read_text(encoding="utf-8")
    assert ant.update(effects=[cable]).effects == (cable,)
    ant.update(effects=[])
    assert ant.config_file.read_text(encoding="utf-8").strip() == before.strip()


comments = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=20)
plain_values = st.one_of(
    st.integers(-(2**40), 2**40),
    st.floats(allow_nan=False),
    st.booleans(),
    comments.map(lambda text: json.dumps(text, ensure_ascii=False)),
)
bare_keys = st.from_regex(r"\A[a-z_]{1,8}\Z")
changes = st.one_of(
    st.tuples(
        st.sampled_from(JOINT_NAMES).map("motors.{}.zero_offset_rad".format), st.floats(-12, 12, allow_subnormal=False)
    ),
    st.tuples(st.sampled_from(JOINT_NAMES).map("motors.{}.direction".format), st.sampled_from([1, -1])),
    st.tuples(st.just("ports.bus"), comments),
    st.tuples(st.just("timing.dt_s"), st.floats(0.002, 2)),
    st.tuples(st.just("bus.return_delay_s"), st.floats(0, 508e-6)),
)


@st.composite
def owned(draw: st.DrawFn, text: str) -> str:
    """A robot.toml as its owner left it: comments, blank lines, keys and tables of their own, tables in any order."""
    head, *tables = text.split("\n[")
    strange = draw(st.dictionaries(bare_keys.map(lambda key: f"x_{key}"), plain_values, max_size=3))
    tables = [f"{table}\n" for table in draw(st.permutations(tables))]
    for key, value in strange.items():
        literal = value if isinstance(value, str) else json.dumps(value).replace("Infinity", "inf")
        where = draw(st.integers(0, len(tables)))
        tables.insert(where, f'{key}]\nvalue = {literal} # {draw(comments)}\n{key} . "b c" = {literal}\n')
    lines = "\n[".join([head, *tables]).split("\n")
    for _ in range(draw(st.integers(0, 4))):
        lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(["", "  ", "# " + draw(comments), "\t#"])))
    newline = draw(st.sampled_from(["\n", "\r\n"]))
    return newline.join(lines)


@given(data=st.data())
@settings(suppress_health_check=list(HealthCheck), max_examples=20)
def test_whatever_the_owner_wrote_survives(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = create_robot(tmp_path_factory.mktemp("owned") / "ant")
    text = data.draw(owned(folder.config_file.read_text(encoding="utf-8")))
    folder.config_file.write_bytes(text.encode("utf-8"))
    before = folder.config()

    folder.update({})
    folder.update({"motors.hip_rr.id": before.motors["hip_rr"].id, "timing.dt_s": before.timing.dt_s})
    assert folder.config_file.read_bytes() == text.encode("utf-8"), "nothing changed, so not a byte changes"

    path, value = data.draw(changes)
    document = read_document(text.encode("utf-8"), "before")
    folder.update({path: value})
    after = folder.config_file.read_bytes()
    *keys, last = path.split(".")
    table: Any = document
    for key in keys:
        table = table[key]
    table[last] = value
    assert read_document(after, "after") == document, "exactly this value has changed"
    old_lines, new_lines = text.split("\n"), after.decode("utf-8").split("\n")
    assert len(old_lines) == len(new_lines)
    assert sum(a != b for a, b in zip(old_lines, new_lines, strict=True)) <= 1
    for a, b in zip(old_lines, new_lines, strict=True):
        assert a.partition("#")[2] == b.partition("#")[2] or "ports" in path


@given(
    junk=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.dates() | st.datetimes(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=5,
    ),
    path=st.sampled_from(
        ["name", "kit", "model", "ports", "bus", "bus.chain", "motors", "motors.hip_rr", "motors.hip_rr.id", "imu",
         "imu.mounting_rad", "camera", "timing.dt_s", "actions", "observation", "observation.pos", "effect",
         "provenance", "provenance.motors", "schema", "platform"]
    ),
)  # fmt: skip
@settings(max_examples=150)
def test_no_value_anywhere_breaks_the_reader(junk: Any, path: str) -> None:
    document: dict[str, Any] = {
        "name": "a", "kit": "lite", "model": "m.xml", "bus": {}, "imu": {}, "timing": {}, "observation": {},
        "provenance": {},
        "motors": {
            joint.name: {"id": joint.id, "model": "XL430-W250-T", "zero_offset_rad": 0, "min_rad": -1, "max_rad": 1}
            for joint in JOINTS.values()
        },
    }  # fmt: skip
    assert parse_config(document)[0] is not None
    *keys, last = path.split(".")
    table = document
    for key in keys:
        table = table[key]
    table[last] = junk
    config, problems = parse_config(document)
    assert (config is None) == any(problem.severity == "error" for problem in problems)


def test_an_action_range_is_a_preset_and_what_differs(ant: RobotFolder) -> None:
    assert ant.config().actions.range == ACTION_PRESETS["platform"]
    config = ant.update({"actions.preset": "sac", "actions.knee_half_range_rad": 0.3})
    assert config.actions.range.half_range("hip") == pytest.approx(math.radians(30))
    assert config.actions.range.half_range("knee") == 0.3
    assert config.actions.range.centre("knee") == pytest.approx(math.radians(-50))


# The platform's own file


def platform_object(**more: Any) -> dict[str, Any]:
    multiples = (1, 1, -1, 1, 1, 1, -1, -1)
    motors = [
        {
            "id": joint.id,
            "min_position": -0.7853981634 if joint.kind == "hip" else -1.2217304764,
            "max_position": 0.7853981634 if joint.kind == "hip" else 1.2217304764,
            "offset": multiple * math.pi / 4,
        }
        for joint, multiple in zip(JOINTS.values(), multiples, strict=True)
    ]
    return {
        "motor_port": "/dev/serial/by-id/usb-FTDI_U2D2", "motor_list": motors, "motor_baudrate": 1000000,
        "imu_port": "/dev/ttyACM0", "camera_id": 1, "camera_fov_diagonal_deg": 58,
        "camera_tag_sizes": {"origin": 0.1, "body": 0.03}, "camera_tag_ids": {"origin": 0, "body": 12}, **more,
    }  # fmt: skip


def write_platform(path: Path, data: Any) -> Path:
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def test_the_platforms_file_comes_in_and_goes_out_unchanged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = platform_object(onboard_camera_id=2, theirs={"a": [None, 1.5]}, nothing=None)
    data["motor_list"][3]["colour"] = "red"
    file, robot, out = (
        write_platform(tmp_path / "ant12.json", data),
        tmp_path / "robot",
        tmp_path / "out" / "ant12.json",
    )
    code, said, _ = run(capsys, "config", "import", file, "--robot", robot)
    assert (code, "note" in said) == (0, False)
    config = RobotFolder.at(robot).config()
    assert config.name == "ant12"
    assert config.motors["hip_fr"].zero_offset_rad == -math.pi / 4
    assert config.camera.body_tag_size_m == 0.03
    assert math.degrees(config.camera.fov_diagonal_rad) == pytest.approx(58)
    source = config.provenance_of("motors.knee_rl.zero_offset_rad")
    assert source is not None
    assert source.how == "imported"
    file.unlink()
    assert run(capsys, "config", "export", "--robot", robot, "--out", out)[0] == 0
    exported = json.loads(out.read_text(encoding="utf-8"))
    assert exported == data
    assert list(exported) == list(data)
    assert json.dumps(exported) == json.dumps(data), "58 stays 58 and does not become 58.0"


def test_missing_keys_are_accepted_and_the_tag_comes_from_the_name(tmp_path: Path) -> None:
    data = platform_object()
    for key in ("camera_tag_ids", "camera_tag_sizes", "camera_id", "motor_baudrate", "imu_port", "motor_port"):
        del data[key]
    del data["motor_list"][0]["offset"]
    platform = read_platform_config(write_platform(tmp_path / "ant34.json", data))
    assert platform.values["camera.body_tag_id"] == 34
    assert "motors.hip_rr.zero_offset_rad" not in platform.values
    assert "ports.bus" not in platform.values
    assert platform.notes == ()


def test_oddities_are_noted(tmp_path: Path) -> None:
    data = platform_object()
    data["motor_list"][0]["id"], data["motor_list"][1]["id"] = 11, 10
    data["motor_list"][2]["offset"] += math.radians(3)
    notes = "\n".join(read_platform_config(write_platform(tmp_path / "ant20.json", data)).notes)
    assert "hip_rr has id 11 (place 0 of the list); the platform's guide gives it 10" in notes
    assert "the offset of hip_fr, -0.733038 rad, is 3° off the multiples of 45°" in notes
    assert "the file's name says body tag 20, camera_tag_ids.body says 12" in notes


def test_an_import_into_a_robot_keeps_what_was_measured_otherwise(
    ant: RobotFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ant.update({"imu.gyro_bias_rad_s": [0.01, 0, 0], "motors.hip_rr.zero_offset_rad": 0.7}, provenance=MEASURED)
    file = write_platform(tmp_path / "ant12.json", platform_object())
    assert run(capsys, "config", "import", file, "--robot", ant.path)[0] == 0
    config = ant.config()
    assert config.name == "ant"
    assert config.imu.gyro_bias_rad_s[0] == 0.01
    assert config.provenance_of("imu.gyro_bias_rad_s") == MEASURED
    offset = config.provenance_of("motors.hip_rr.zero_offset_rad")
    assert offset is not None
    assert offset.how == "imported"
    code, _, err = run(capsys, "config", "import", file, "--robot", ant.path, "--kit", "lite")
    assert (code, "of the standard kit" in err) == (2, True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "is no JSON object"),
        ('{"motor_list": [', "line 1, column 17: this is not JSON: Expecting value → is the file cut short?"),
        ("{}", "has no list motor_list → is this a robot's configuration?"),
        (json.dumps(platform_object(motor_list=[])), "motor_list has 0 motors → an Open Ant has 8"),
        (json.dumps(platform_object(motor_list=[1] * 8)), "motor_list[0]: is no object"),
        (json.dumps(platform_object(motor_list=[{"offset": 45}] * 8)), "[0].offset: 45 rad cannot be → if degrees"),
        (json.dumps(platform_object(motor_list=[{"id": 7}] * 8)), "7 is also the id of hip_rr"),
        (json.dumps(platform_object(motor_list=[{"id": "7"}] * 8)), "motor_list[0].id: is no whole number"),
        (json.dumps(platform_object(camera_fov_diagonal_deg=600)), "600 ° cannot be"),
        (json.dumps(platform_object(camera_tag_sizes=3)), "camera_tag_sizes: is no object"),
        (json.dumps(platform_object(motor_port=True)), "motor_port: is neither a path nor a number"),
        (json.dumps(platform_object(motor_baudrate=123)), "123 is no baud rate that servos have"),
    ],
)  # fmt: skip
def test_a_bad_platform_file_is_refused_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, message: str
) -> None:
    file = tmp_path / "ant12.json"
    file.write_text(content, encoding="utf-8")
    code, _, err = run(capsys, "config", "import", file, "--robot", tmp_path / "robot")
    assert code == 2
    assert message in err
    assert len(err.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["ant12.json"]


def test_an_export_says_what_the_platform_cannot(ant: RobotFolder, capsys: pytest.CaptureFixture[str]) -> None:
    ant.update({"motors.hip_rr.zero_offset_rad": 0.8, "camera.body_tag_id": 12})
    code, out, err = run(capsys, "config", "export", "--robot", ant.path)
    assert (code, json.loads(out)["motor_list"][0]["offset"], err) == (0, 0.8, "")
    code, out, err = run(capsys, "config", "export", "--robot", ant.path, "--grid")
    assert json.loads(out)["motor_list"][0]["offset"] == pytest.approx(math.pi / 4)
    assert "rounding to 45° moves the zero of hip_rr by 0.8°" in err
    target = ant.path / "mine.json"
    assert "names its files after the tag on the torso, here ant12.json" in run(
        capsys, "config", "export", "--robot", ant.path, "--out", target
    )[2]  # fmt: skip
    code, _, err = run(capsys, "config", "export", "--robot", ant.path, "--out", ant.config_file)
    assert (code, "would replace robot.toml itself" in err) == (2, True)
    ant.update({"motors.knee_fl.direction": -1})
    code, _, err = run(capsys, "config", "export", "--robot", ant.path)
    assert (code, "knee_fl turn in reverse" in err) == (2, True)


@given(st.lists(st.integers(-8, 8), min_size=8, max_size=8))
def test_offsets_on_the_grid_go_out_as_they_came(multiples: list[int]) -> None:
    values = {"name": "a", "kit": "lite", "model": "m.xml", "motors": {}}
    motors: dict[str, Any] = {}
    for joint, multiple in zip(JOINTS.values(), multiples, strict=True):
        offset = multiple * math.pi / 4
        motors[joint.name] = {
            "id": joint.id, "model": "XL430-W250-T", "zero_offset_rad": offset, "min_rad": -1, "max_rad": 1,
        }  # fmt: skip
    config, _ = parse_config({**values, "motors": motors})
    assert config is not None
    for on_grid in (False, True):
        offsets = [motor["offset"] for motor in export_platform_config(config, on_grid=on_grid)["motor_list"]]
        assert offsets == [multiple * math.pi / 4 for multiple in multiples]


# The command line


def test_new_show_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENANT_ROBOT", str(tmp_path / "ant"))
    code, out, _ = run(capsys, "config", "new", "--kit", "lite", "--name", "Berta")
    assert (code, "nominal values of the lite kit" in out) == (0, True)
    RobotFolder.at(tmp_path / "ant").update({"motors.hip_rr.zero_offset_rad": 0.79}, provenance=MEASURED)
    code, out, _ = run(capsys, "config", "show", "--json", tmp_path / "show.json")
    assert code == 0
    assert "Berta (lite kit)" in out
    assert "measured in recordings/zeros.mcap on 2026-03-01 (44.7 to 45.8°)" in out
    shown = json.loads((tmp_path / "show.json").read_text(encoding="utf-8"))
    assert shown["motors"]["hip_rr"]["zero_offset_rad"] == 0.79
    code, out, _ = run(capsys, "config", "check", "--json", tmp_path / "check.json")
    assert (code, "is consistent" in out) == (0, True)
    assert json.loads((tmp_path / "check.json").read_text(encoding="utf-8")) == {"consistent": True, "problems": []}
    assert run(capsys, "config", "new")[0] == 2


def test_a_second_folder_of_a_robot_has_its_values_and_its_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = create_robot(tmp_path / "ant", "lite", values={"motors.hip_rr.zero_offset_rad": 0.79})
    (first.recordings / "a.mcap").touch()
    (first.path / "models").mkdir()
    (first.path / "nominal.xml").rename(first.path / "models" / "mine.xml")
    text = first.config_file.read_text(encoding="utf-8")
    first.config_file.write_text(text.replace("nominal.xml", "models/mine.xml"), encoding="utf-8")
    code, out, _ = run(capsys, "config", "new", "--from", first.path, "--robot", tmp_path / "other")
    assert (code, "with its model" in out) == (0, True)
    other = RobotFolder.at(tmp_path / "other")
    assert other.config() == dataclasses.replace(first.config(), model="mine.xml")
    assert other.check()[1] == []
    assert not other.recordings.exists()
    for words in (("--kit", "lite"), ()):
        code, _, err = run(capsys, "config", "new", "--from", first.path, "--robot", other.path, *words)
        assert (code, err.count("\n"), "→" in err) == (2, 1, True)


def test_a_robot_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("check", "show", "export"):
        code, _, err = run(capsys, "config", command, "--robot", tmp_path / "nobody")
        assert (code, "there is no robot.toml here" in err) == (2, True)
    code, _, err = run(capsys, "config", "import", tmp_path / "ant9.json", "--robot", tmp_path / "robot")
    assert (code, "ant9.json: there is no such file" in err) == (2, True)
