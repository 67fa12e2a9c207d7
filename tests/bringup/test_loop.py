"""From simulation to robot and back: every command but those that need a robot's bus is the real one.

What plays the robot here is another simulation, softer than the one that is trained in; that its recording says so is taken for
granted, for a diagnosis takes minutes (`make docs-check` has the whole).
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

pytest.importorskip("torch")
from openant_tools.bringup import stages
from openant_tools.bringup.loop import Loop, result_of
from openant_tools.bringup.loop_report import draw_rewards, loop_report, verdict, what_was_found
from openant_tools.bringup.stages import StageFailed
from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.files import write_text
from openant_tools.gap.diagnosis import Diagnosis, Found, Span
from openant_tools.procedure.intervals import Interval
from openant_tools.report import plots
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES

SOFT = 0.85
Command = Sequence[str]
Runner = Callable[..., int]


def diagnosis(verdict: str, selected: tuple[str, ...]) -> Diagnosis:
    found = Found("stiffness_error", "all", {"scale": Span(SOFT, 0.84, 0.86)}, 0.9, 0.8, 0.7, 0.9, True)
    return Diagnosis(
        model="nominal.xml", runs=("walk.mcap",), held_out=(), verdict=verdict, confidence=0.9, effects=(found,),
        selected=selected, ambiguous_with=(), next_experiment="record the stand protocol" if not selected else None,
        gap={"before": 0.02, "after": 0.004, "floor": 0.001}, where=[],
    )  # fmt: skip


SOFTER = diagnosis("stiffness_error", ("stiffness_error",))


@pytest.fixture(scope="module")
def ant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a robot that may walk."""
    calibrated = {"motors": Provenance("measured", "openant calib zeros")}
    folder = tmp_path_factory.mktemp("robot") / "ant"
    create_robot(folder, values={"camera.body_tag_id": 12}, provenance=calibrated)
    return folder


def option(command: Command, name: str) -> str:
    return command[list(command).index(name) + 1]


def real(truth: Path, found: Diagnosis) -> Runner:
    """Runs commands in this process: the robot is the simulation in `truth`, its diagnosis is known."""

    def run(command: Command, *_: Any) -> int:
        if command[:2] == ("gap", "diagnose"):
            write_text(option(command, "--json"), json.dumps(found.as_json()))
            return 0
        words = list(command)
        if "hardware" in words:
            assert "--yes" in words
            assert "--virtual" in words
            at = words.index("--env")
            words[at : at + 7] = ["--robot", str(truth)]
        with pytest.raises(SystemExit) as end:
            main(words)
        if "hardware" in command:
            file = Path(option(command, "--json"))
            write_text(file, json.dumps(json.loads(file.read_text()) | {"recordings": ["walk.mcap"]}))
        return int(end.value.code or 0)

    return run


@pytest.fixture(scope="module")
def done(ant: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Loop, list[Command]]:
    """A loop that has gone the whole way through the command, and what it ran."""
    here = tmp_path_factory.mktemp("loop")
    with contextlib.redirect_stdout(None):
        main_quiet("config", "new", "--from", str(ant), "--robot", str(here / "truth"))
        write_text(here / "gap.json", json.dumps(SOFTER.as_json()))
        main_quiet("gap", "apply", str(here / "gap.json"), "--model", str(ant / "nominal.xml"), "--robot",
                   str(here / "truth"), "--out", str(here / "truth" / "soft.xml"))  # fmt: skip
    settings = {"learning_start": 20, "batch": 16}
    (here / "settings.json").write_text(json.dumps({"agent": "sac", "settings": settings}))
    ran: list[Command] = []
    run = real(here / "truth", SOFTER)

    def noting(command: Command, *rest: Any) -> int:
        ran.append(command)
        return run(command, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "openant", noting)
        main_quiet(
            "loop", "--robot", str(ant), "--virtual", "--steps", "40", "--fine-tune-steps", "30", "--seed", "1",
            "--seconds", "1.2", "--starts", "2", "--settings", str(here / "settings.json"), "--out", str(here / "out"),
            "--yes", "--json", str(here / "out.json"),
        )  # fmt: skip
    loop = Loop(here / "out", ant, "default", 40, 30, 1, 1.2, 2, here / "settings.json")
    return loop, ran


def main_quiet(*words: str) -> None:
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 0, words


def test_the_whole_way_ends_with_five_rewards_a_verdict_and_a_page(done: tuple[Loop, list[Command]]) -> None:
    loop, ran = done
    assert [" ".join(command[:2]) for command in ran if command[0] != "eval"] == [
        "train sac", "gap diagnose", "config new", "gap apply", "train sac", "train sac",
    ]  # fmt: skip
    assert sum("hardware" in command for command in ran) == 3
    answer = json.loads((loop.folder.parent / "out.json").read_text())
    assert answer == json.loads(loop.result.read_text())
    assert set(answer["reward"]) >= {"sim_before", "robot_before", "sim_after", "robot_after", "control_after"}
    assert all(abs(reward) < 1.0 for reward in answer["reward"].values())
    assert (answer["verdict"], answer["improved"]) == ("stiffness_error", True)
    for name, span in answer["intervals"].items():
        assert span["low"] < answer["reward"][name] < span["high"]
        assert answer["reward"][name] == pytest.approx(np.mean(answer["starts"][name]))
    assert answer["updates"] == {"trained": 20, "control": 10, "tuned": 10}
    page = loop.report.read_text()
    for stage in loop.stages():
        for line in stage.command_lines:
            assert line.split("openant ")[1][:40] in page
    assert "average reward (cm/s)" in page
    assert re.search(r"\bcontrol\b", page)


def test_the_improved_simulation_is_a_robot_of_its_own_and_the_given_one_stays(
    done: tuple[Loop, list[Command]], ant: Path
) -> None:
    loop, _ = done
    given = mujoco.MjModel.from_xml_path(str(RobotFolder.at(ant).model_path()))
    improved = mujoco.MjModel.from_xml_path(str(RobotFolder.at(loop.improved).model_path()))
    for joint in JOINT_NAMES:
        assert improved.actuator(joint).gainprm[0] == pytest.approx(SOFT * given.actuator(joint).gainprm[0], rel=1e-3)
    facts = {run.name: json.loads((run / "run.json").read_text()) for run in (loop.tuned, loop.control)}
    assert facts["tuned"]["env"]["options"]["robot"] == str(loop.improved)
    assert facts["control"]["env"]["options"]["robot"] == str(ant)
    assert {one["seed"] for one in facts.values()} == {1}


def test_a_loop_that_stands_is_not_done_again_and_another_one_is_refused_its_folder(
    done: tuple[Loop, list[Command]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    loop, _ = done
    assert all(loop.stands(stage) for stage in loop.stages())
    loop.prepare()
    other = Loop(loop.folder, loop.robot, "default", 40, 30, 2, 1.2, 2, loop.settings)
    with pytest.raises(BadInput, match="holds a loop with seed 1, not 2"):
        other.prepare()
    (tmp_path / "mine").touch()
    with pytest.raises(BadInput, match="no loop"):
        Loop(tmp_path, loop.robot, "default", 40, 30, 2).prepare()


def test_a_loop_whose_robot_was_calibrated_anew_meanwhile_is_refused(ant: Path, tmp_path: Path) -> None:
    robot = Path(shutil.copytree(ant, tmp_path / "ant"))
    loop = Loop(tmp_path / "out", robot, "default", 40, 30, 1)
    loop.prepare()
    loop.prepare()
    with (robot / "nominal.xml").open("a") as model:
        model.write("<!-- better -->\n")
    with pytest.raises(BadInput, match="began with another model"):
        loop.prepare()


def quick(found: Diagnosis, ran: list[Command], dies_at: int | None = None) -> Runner:
    """Writes what commands would, at once; killed while it does its nth."""

    def run(command: Command, *_: Any) -> int:
        ran.append(command)
        if len(ran) == dies_at:
            raise KeyboardInterrupt
        if command[:2] == ("config", "new"):
            folder = Path(option(command, "--robot"))
            shutil.copytree(option(command, "--from"), folder, copy_function=shutil.copy)
        elif command[:2] == ("gap", "apply"):
            write_text(option(command, "--out"), "<mujoco/>")
        else:
            content: dict[str, Any] = {"steps": int(option(command, "--steps"))} if command[0] == "train" else {}
            if content:
                write_text(
                    Path(option(command, "--out")) / "run.json", json.dumps({"settings": {"learning_start": 35}})
                )
            if command[0] == "eval":
                tuned = command[1].endswith("tuned")
                plays = [{"average_reward_m_s": r + 0.05 * tuned, "helped": {"fell": 1}} for r in (0.10, 0.11, 0.12)]
                content = {"plays": {"sampled": plays}, "step": 7, "recordings": ["walk.mcap"]}
            elif command[0] == "gap":
                content = found.as_json()
            write_text(option(command, "--json"), json.dumps(content))
        return 0

    return run


def walked(loop: Loop) -> None:
    """What the command does with a loop's stages."""
    place = 0
    while place < len(now := loop.stages()):
        if not loop.stands(now[place]):
            loop.run(now[place])
        place += 1


@pytest.mark.parametrize("nth", [1, 4, 6, 7, 12])
def test_a_loop_killed_at_a_command_goes_on_at_that_stage(
    nth: int, ant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, before, after = Loop(tmp_path / "out", ant, "default", 40, 30, 1), list[Command](), list[Command]()
    monkeypatch.setattr(stages, "openant", quick(SOFTER, before, dies_at=nth))
    with pytest.raises(KeyboardInterrupt):
        walked(loop)
    monkeypatch.setattr(stages, "openant", quick(SOFTER, after))
    walked(loop)
    begun = 2 if before[-1][:2] == ("gap", "apply") else 1  # the improved folder is made anew as a whole
    assert after[:begun] == before[-begun:]
    assert len(before) + len(after) == 12 + begun
    assert all(loop.stands(stage) for stage in loop.stages())


def test_what_follows_from_a_result_that_is_gone_is_done_anew(
    ant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Loop(tmp_path / "out", ant, "default", 40, 30, 1)
    monkeypatch.setattr(stages, "openant", quick(SOFTER, []))
    walked(loop)
    loop.played("robot_before").unlink()
    old = loop.tuned / "checkpoint.pt"
    old.touch()
    ran: list[Command] = []
    monkeypatch.setattr(stages, "openant", quick(SOFTER, ran))
    walked(loop)
    assert [command[0] for command in ran] == ["eval", "gap", "config", "gap", "train", "eval", "eval"]
    assert not old.exists(), "an agent trained on in a simulation that is gone"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none", "as small as between two robots of one build"),
        ("unexplained", "no effect that is known here explains it"),
        ("ambiguous", "cannot be told apart"),
    ],
)
def test_where_nothing_is_named_the_control_stands_for_both_and_that_is_said(
    name: str, words: str, ant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Loop(tmp_path / "out", ant, "default", 40, 30, 1)
    ran: list[Command] = []
    monkeypatch.setattr(stages, "openant", quick(diagnosis(name, ()), ran))
    walked(loop)
    assert [command[0] for command in ran] == ["train", "eval", "eval", "gap", "train", "eval", "eval"]
    result = result_of(loop)
    answer = result.as_json()
    assert (answer["verdict"], answer["improved"], answer["after_minus_control"]) == (name, False, None)
    assert answer["reward"]["robot_after"] == answer["reward"]["control_after"]
    assert answer["reward"]["sim_after"] == answer["reward"]["control_sim_after"]
    assert words in what_was_found(result)
    assert "the control stands for both" in what_was_found(result)
    assert "nothing to improve" in verdict(result)
    page = loop_report(loop, result).html(loop.folder)
    assert "To settle what the diagnosis leaves open, record the stand protocol." in page
    assert "improved simulation</td>" not in page


def test_a_gain_is_told_with_its_interval_against_the_control(
    ant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = Loop(tmp_path / "out", ant, None, 40, 30, 1)
    monkeypatch.setattr(stages, "openant", quick(SOFTER, []))
    walked(loop)
    result = result_of(loop)
    gain = result.gain_m_s
    assert gain is not None
    assert gain.value == pytest.approx(0.05)
    assert gain.low > 0.0
    assert verdict(result).endswith("+5.0 cm/s (2.7 to 7.3), more than the control.")
    assert result.plays["robot_after"].helped == 3
    assert result.updates == {"trained": 5, "tuned": 0, "control": 0}
    assert "No update was made in control and tuned" in loop_report(loop, result).html()
    figure, axes = plots.figure()
    draw_rewards(axes, {"trained": (result.sim_before, result.robot_before)})
    assert axes.get_xlabel() == "average reward (cm/s)"
    assert axes.get_legend_handles_labels()[1] == ["in simulation", "on the robot"]
    assert figure is axes.figure


def test_on_the_robot_itself_somebody_has_to_say_that_it_may_walk(
    ant: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for words, line in (
        (("--virtual",), "the robot would walk and nobody is there to ask"),
        (("--yes",), "the robot has no flight controller yet"),
        (("--yes", "--virtual", str(tmp_path / "no.toml")), "there is no such scenario"),
        (("--yes", "--virtual", "--settings", str(ant / "robot.toml")), "this is not JSON"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["loop", "--robot", str(ant), "--out", str(tmp_path / "out"), *words])
        assert end.value.code == 2
        said = capfd.readouterr().err
        assert line in said
        assert said.count("\n") == 1
        assert not (tmp_path / "out").exists()


def test_a_sealed_robot_needs_its_key_and_the_floor(ant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENANT_SCENARIO_KEY", raising=False)
    for setup, says in (("stand", "does not stand on the floor"), ("floor", None)):
        plain, sealed, key = tmp_path / "plain.toml", tmp_path / f"{setup}.toml", tmp_path / "key"
        plain.write_text(f'[robot]\nsetup = "{setup}"\n')
        main_quiet("virtual", "seal", str(plain), "--key-file", str(key), "--out", str(sealed))
        loop = Loop(tmp_path / setup, ant, str(sealed), 40, 30, 1)
        with pytest.raises(BadInput, match="is sealed"):
            loop.prepare()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("OPENANT_SCENARIO_KEY", str(key))
            if says is None:
                loop.prepare()
            else:
                with pytest.raises(BadInput, match=says):
                    loop.prepare()


def test_a_command_that_fails_ends_the_loop_with_its_words(
    ant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(command: Command, log: Any, *_: Any) -> int:
        log.write("openant: the disk is full\n")
        return 2

    monkeypatch.setattr(stages, "openant", run)
    loop = Loop(tmp_path / "out", ant, "default", 40, 30, 1)
    with pytest.raises(StageFailed, match="openant train sac") as failure:
        walked(loop)
    assert failure.value.said == "openant: the disk is full"


def test_intervals_of_means_are_students() -> None:
    values = [1.0, 2.0, 3.0, 4.0]
    mean = Interval.of_mean(values)
    # t(3) = 3.182 at 97.5 %, s = 1.291
    assert (mean.value, mean.high - mean.value) == (2.5, pytest.approx(3.1824 * 1.29099 / 2.0, rel=1e-4))
    apart = Interval.of_difference(values, [value - 1.0 for value in values])
    # equal variances: t(6) = 2.447
    assert (apart.value, apart.high - apart.value) == (1.0, pytest.approx(2.4469 * 1.29099 / 2**0.5, rel=1e-4))
    assert np.isnan(Interval.of_mean([1.0]).low)
    assert Interval.of_mean([1.0, 1.0]) == Interval(1.0, 1.0, 1.0)
