"""A model and the effects that were fitted with it go together, wherever they are; with another model they would count twice."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import plants
import pytest
from plants import COARSE, ENCODER_RAD, pendulum, sweep, write

import openant_env  # noqa: F401  (registers the environments)
from openant_tools import sysid
from openant_tools.bringup.gap_check import gap_check
from openant_tools.cli import main
from openant_tools.effects.entries import as_toml, read_effects
from openant_tools.effects.rollout import rollout
from openant_tools.errors import BadInput
from openant_tools.gap.measure import measure
from openant_tools.model.mjcf import write_model
from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.numbers import number
from openant_tools.procedure.finding import Finding, keep
from openant_tools.procedure.step import Bench
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table
from openant_tools.robot.config import EffectEntry
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.pair import PLAIN, mark_of
from openant_tools.sysid.identify import Identification, identify
from openant_tools.sysid.result import stating_both, write_fit, write_robot

LOAD = ("load_friction", "coefficient")
KNEES = tuple(joint for joint in JOINT_NAMES if "knee" in joint)
COUNTS_TWICE = "load_friction was fitted with another model than"


def command(*words: object) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(word) for word in words])
    return int(left.value.code or 0)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    text = pendulum(option=COARSE).replace('name="joint"', 'name="knee_fl"').replace('joint="joint"', 'joint="knee_fl"')
    return write(tmp_path_factory.mktemp("given") / "pendulum.xml", text)


@pytest.fixture(scope="module")
def runs(given: Path) -> list[Run]:
    """Of a pendulum whose gear rubs the more the more it bears."""
    plant, t, out = load_plant(given), np.arange(0.0, 3.0, 0.01), []
    for k in range(2):
        cmd = sweep(t, 1 + k, 0.9)[:, -1]
        facts = Facts(("knee_fl",), resolution={"pos": ENCODER_RAD})
        run = Run(f"run{k}", facts, t, {"cmd.knee_fl": cmd, "pos.knee_fl": 0 * t})
        pos = rollout(Rollouts(plant, [run]), [plant.model], [{LOAD: np.array([0.3])}]).pos[0, :, 0]
        out.append(replace(run, columns={"cmd.knee_fl": cmd, "pos.knee_fl": np.round(pos / ENCODER_RAD) * ENCODER_RAD}))
    return out


@pytest.fixture(scope="module")
def fits(given: Path, runs: list[Run]) -> tuple[Identification, Identification]:
    """Plain, and with friction that follows the load."""
    plain = identify(runs[:1], given, runs[1:], kinds=["stiffness", "coulomb_friction"])
    richer = identify(runs[:1], given, runs[1:], kinds=["load_friction"])
    return plain, richer


@pytest.fixture(scope="module")
def written(fits: tuple[Identification, Identification], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fit")
    write_fit(replace(fits[0], with_effects=fits[1]), out)
    return out


def test_each_pair_measures_as_its_fit_says_and_neither_file_goes_with_the_other(
    written: Path, fits: tuple[Identification, Identification], runs: list[Run], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    log = tmp_path / "log.csv"
    write_table(runs[1], log)
    beside = written / "with-effects"
    told = json.loads((written / "fit.json").read_text())["pairs"]
    assert told["wins"] == "with_effects"
    assert told["with_effects"]["model"] == "with-effects/calibrated.xml"

    def gap(*words: object) -> float:
        asked = ("gap", "measure", log, *words, "--horizon", "full", "--json", tmp_path / "gap.json")
        assert command(*asked) == 0
        return float(json.loads((tmp_path / "gap.json").read_text())["signals"]["pos"]["gap"])

    effects = beside / "calibrated.effects.toml"
    plain = gap("--model", written / "calibrated.xml")
    rich = gap("--model", beside / "calibrated.xml", "--effects", effects)
    assert plain == pytest.approx(told["plain"]["gap_full_rad"], rel=0.02)
    assert rich == pytest.approx(told["with_effects"]["gap_full_rad"], rel=0.02)
    assert rich < 0.5 * plain
    assert json.loads((tmp_path / "gap.json").read_text())["effects"][0]["effect"] == "load_friction"
    assert "was fitted with effects" not in capsys.readouterr().err

    # The model of the pair without them is not the best without.
    gap("--model", beside / "calibrated.xml")
    assert "calibrated.xml was fitted with effects that do not act here" in capsys.readouterr().err
    for other in (written / "calibrated.xml", fits[0].model):
        assert command("gap", "measure", log, "--model", other, "--effects", effects) == 2
        line = capsys.readouterr().err
        assert COUNTS_TWICE in line
        assert str(effects) in line
        assert "calibrated.effects.toml" in line.split("→")[1]


def test_from_python_a_pair_is_judged_as_its_fit_says_and_refused_apart(
    written: Path, fits: tuple[Identification, Identification], runs: list[Run]
) -> None:
    beside = written / "with-effects"
    rich = sysid.judge(runs[1], beside / "calibrated.xml", effects=beside / "calibrated.effects.toml")
    assert rich.gap.full == pytest.approx(fits[1].after.full, rel=0.02)
    assert sysid.judge(runs[1], fits[1]).gap.full == pytest.approx(fits[1].after.full, rel=1e-9)
    assert rich.notes == ()
    (alone,) = sysid.judge(runs[1], beside / "calibrated.xml").notes
    assert "was fitted with effects that do not act here" in alone
    with pytest.raises(BadInput, match=COUNTS_TWICE) as refused:
        sysid.judge(runs[1], written / "calibrated.xml", effects=beside / "calibrated.effects.toml")
    assert "calibrated.effects.toml: load_friction was" in str(refused.value)


def test_a_pair_that_was_moved_renamed_and_edited_is_still_one(written: Path, runs: list[Run], tmp_path: Path) -> None:
    beside, there = written / "with-effects", tmp_path / "elsewhere"
    there.mkdir()
    text = (beside / "calibrated.xml").read_text().replace('kp="', 'user="1" kp="')
    (there / "leg.xml").write_text(text.replace('<geom name="rod"', '<geom rgba="1 0 0 1" name="rod"'))
    (there / "gears.toml").write_text(
        (beside / "calibrated.effects.toml").read_text().replace("coefficient = 0.", "coefficient = 0.1")
    )
    # A scene that takes the model in, and what MuJoCo itself makes of it when it saves it.
    write(there / "scene.xml", '<mujoco><include file="leg.xml"/></mujoco>')
    write(there / "saved.xml", mujoco.MjSpec.from_file(str(there / "leg.xml")).to_xml())
    effects = read_effects(there / "gears.toml", ["knee_fl"])
    for name in ("leg.xml", "scene.xml", "saved.xml"):
        assert measure(runs, there / name, effects=effects).effects
        # Fitted on, it goes by the same rule; its plain fit is of no pair.
        with pytest.raises(BadInput, match=COUNTS_TWICE):
            measure(runs, written / "calibrated.xml", effects=effects)


def test_effects_that_nobody_fitted_act_beside_any_model_and_a_doubt_is_said(
    written: Path, given: Path, runs: list[Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, by_hand = tmp_path / "log.csv", tmp_path / "mine.effects.toml"
    write_table(runs[1], log)
    by_hand.write_text(as_toml([EffectEntry("load_friction", ("knee_fl",), {"coefficient": 0.3})]))
    assert command("gap", "measure", log, "--model", given, "--effects", by_hand) == 0
    assert "counts twice" not in capsys.readouterr().err
    assert command("gap", "measure", log, "--model", written / "calibrated.xml", "--effects", by_hand) == 0
    assert "calibrated.xml was fitted without effects: what it lacked of load_friction" in capsys.readouterr().err
    for text, words in (
        ('[[effect]]\neffect = "load_friction"\njoints = ["elbow"]\n', "there is no joint 'elbow'"),
        ('[[effect]]\neffect = "load_friction"\npair = 7\n', "is a whole number, but text is needed"),
        ("effect = 3", "is no list of tables"),
    ):
        by_hand.write_text(text)
        assert command("gap", "measure", log, "--model", given, "--effects", by_hand) == 2
        assert words in capsys.readouterr().err


def test_a_fit_goes_on_from_a_pair_and_its_entries_go_along(
    fits: tuple[Identification, Identification], runs: list[Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = create_robot(tmp_path / "ant")
    other, off = (
        EffectEntry("dead_zone", ("hip_fl",), {"width_rad": 0.01}),
        EffectEntry("cogging", "all", {"amplitude_nm": 0.1}, False),
    )
    robot.update(effects=[other, off])
    write_robot(fits[1], robot)
    first = mark_of(load_plant(robot.model_path()).model)
    assert first not in (None, PLAIN)
    assert [(one.effect, one.pair) for one in robot.config().effects] == [
        ("dead_zone", None), ("cogging", None), ("load_friction", first),
    ]  # fmt: skip

    # The other fit of the same robot: what was found of friction stays as it is, and belongs to the new model.
    few = [run.between(0.0, 1.5) for run in runs]
    now = robot.config().effects
    again = identify(few[:1], robot.model_path(), few[1:], kinds=["stiffness"], effects=now)
    again = replace(again, u=again.u + 0.1)  # whatever was found, it is another model
    write_robot(again, robot)
    second = mark_of(load_plant(robot.model_path()).model)
    assert second not in (None, PLAIN, first)
    assert robot.config().effects[-1].pair == second
    measure(runs, robot.model_path(), effects=robot.config().effects)

    log = tmp_path / "log.csv"
    write_table(runs[0], log)
    refit = ("sysid", "fit", log, "--model", fits[0].model, "--robot", robot.path, "--out", tmp_path / "fit")
    assert command(*refit) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert COUNTS_TWICE in line
    assert "--no-effects" in line.split("→")[1]
    assert not (tmp_path / "fit").exists()

    # A plain fit from another model takes the pair's place, with all that belonged to it.
    with pytest.raises(BadInput, match=COUNTS_TWICE):
        identify(few[:1], fits[0].model, few[1:], kinds=["stiffness"], effects=robot.config().effects)
    write_robot(fits[0], robot)
    assert mark_of(load_plant(robot.model_path()).model) == PLAIN
    assert list(robot.config().effects) == [other, off]


def test_what_was_tried_is_stated_where_it_does_not_pay_too(fits: tuple[Identification, Identification]) -> None:
    plain, richer = fits
    won, lost = stating_both(plain, richer), stating_both(richer, plain)
    left = [number(one.after.full, "rad", name="gap") for one in (plain, richer)]
    figures = "plain {}, with effects {} over full runs".format(*left)
    assert figures in won.notes[-1]
    assert won.with_effects is not None
    assert figures in won.with_effects.notes[-1]
    assert "both are in with-effects" in won.notes[-1]
    assert "the plain model is the best" in lost.notes[-1]
    assert lost.with_effects is None


# ---- in a robot's folder ----


@pytest.fixture
def ant(tmp_path: Path) -> RobotFolder:
    """A robot whose folder has a model with effects, as a fit leaves it, and a plain one besides."""
    folder = create_robot(tmp_path / "ant")
    nominal = folder.path / "nominal.xml"
    model = load_plant(nominal, setup=Setup.FLOOR).model
    write_model(nominal, model, folder.path / "plain.xml", pair=PLAIN)
    write_model(nominal, model, folder.path / "calibrated.xml", pair="0123456789ab")
    rubbing = EffectEntry("load_friction", KNEES, {"coefficient": 0.3}, pair="0123456789ab")
    folder.update({"model": "calibrated.xml"}, effects=[rubbing])
    return folder


def test_the_environment_refuses_effects_of_another_model(ant: RobotFolder, caplog: pytest.LogCaptureFixture) -> None:
    gymnasium.make("openant/Ant-v0", robot=ant.path)
    assert ant.check()[1] == []
    for other in ("plain.xml", "nominal.xml"):
        ant.update({"model": other})
        with pytest.raises(BadInput, match=COUNTS_TWICE):
            gymnasium.make("openant/Ant-v0", robot=ant.path)
        gymnasium.make("openant/Ant-v0", robot=ant.path, effects=False)
        (problem,) = ant.check()[1]
        assert COUNTS_TWICE in str(problem)
        assert "[[effect]]" in ant.config_file.read_text().splitlines()[(problem.line or 0) - 1]
    # Written under another name, in place of the model that robot.toml names.
    shutil.move(ant.path / "calibrated.xml", ant.path / "nominal.xml")
    gymnasium.make("openant/Ant-v0", robot=ant.path)
    assert not caplog.messages
    # By hand, without a mark: it acts, and the doubt is said once.
    ant.update({"model": "plain.xml"}, effects=[replace(ant.config().effects[0], pair=None)])
    for _ in range(2):
        gymnasium.make("openant/Ant-v0", robot=ant.path)
    assert [
        message for message in caplog.messages if "plain.xml was fitted without effects" in message
    ] == caplog.messages
    assert len(caplog.messages) == 1


def test_the_gap_check_judges_the_robots_model_with_what_acts_beside_it(ant: RobotFolder) -> None:
    t = np.arange(0.0, 3.0, 0.02)
    plant = load_plant(ant.model_path(), JOINT_NAMES, Setup.STAND)
    middle = np.array([-0.8 if "knee" in joint else 0.0 for joint in JOINT_NAMES])
    cmd = middle + sweep(t, 8, 0.3)
    columns = {f"cmd.{joint}": cmd[:, j] for j, joint in enumerate(JOINT_NAMES)}
    columns |= {f"pos.{joint}": np.full(len(t), cmd[0, j]) for j, joint in enumerate(JOINT_NAMES)}
    run = plants.run_of(columns, t, JOINT_NAMES, "held-out", setup="stand", resolution={"pos": ENCODER_RAD})
    values = {LOAD: np.where(["knee" in joint for joint in JOINT_NAMES], 0.3, 0.0)}
    pos = rollout(Rollouts(plant, [run]), [plant.model], [values]).pos[0]
    columns |= {f"pos.{joint}": np.round(pos[:, j] / ENCODER_RAD) * ENCODER_RAD for j, joint in enumerate(JOINT_NAMES)}
    write_table(replace(run, columns=columns), ant.recordings / "held-out.parquet")
    keep(Finding("identify", True, "fitted", (), "", "test", data={"held_out": ["recordings/held-out.parquet"]}), ant)

    asked = gap_check(Bench(ant))
    while True:
        try:
            next(asked)
        except StopIteration as done:
            found = done.value
            break
    figures = {one.name: one.value for one in found.evidence}
    assert found.ok is not False
    # The model itself is the nominal one: what closes the gap is the friction beside it.
    assert figures["position gap, calibrated"] < 0.3 * figures["position gap, nominal"]
    assert found.data["measure"]["effects"][0]["effect"] == "load_friction"
    # From Python, too, where the robot's folder is named; beside another model they do not act.
    recorded = sysid.load(ant.recordings / "held-out")
    assert sysid.judge(recorded, robot=ant.path).gap.horizon == pytest.approx(figures["position gap, calibrated"])
    other = sysid.judge(recorded, ant.path / "nominal.xml", robot=ant.path)
    assert other.gap.horizon == pytest.approx(figures["position gap, nominal"])
