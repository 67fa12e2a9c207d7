"""The demo from end to end, in small; going on after an interruption, and what it says when something fails."""

from __future__ import annotations

import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
from builder import COARSE, coarsen

from openant_env import rendering
from openant_tools.bringup import robot_picture
from openant_tools.bringup.demo import Demo
from openant_tools.bringup.demo_report import compare, truth, write_report
from openant_tools.bringup.gait import walks_at
from openant_tools.bringup.stages import Stage, StageFailed, openant
from openant_tools.cli import main
from openant_tools.errors import BadInput
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.mjcf import nominal_model_path

PATIENCE_S = 240.0
#: the whole way may take minutes where other programs have the cores
pytestmark = pytest.mark.timeout(900)
PNG = b"\x89PNG\r\n\x1a\n"


def small(folder: Path) -> Demo:
    """A demo that is over soon: short recordings, hardly any training."""
    return Demo(folder, steps=150, record_s=8.0, eval_s=1.2, starts=2)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    """A demo that has gone the whole way, with robot and model in steps of 2 ms."""
    demo = small(tmp_path_factory.mktemp("demo") / "ant")
    demo.prepare()
    demo.scenario.write_text(demo.scenario.read_text().replace("[robot]\n", COARSE, 1))
    for stage in demo.stages():
        assert not demo.stands(stage)
        shares: list[float] = []
        demo.run(stage, lambda share, words, shares=shares: shares.append(share))
        assert demo.stands(stage), stage.name
        assert shares == sorted(shares)
        assert stage.name == "robot" or 0.9 < shares[-1] <= 1.0, stage.name
        if stage.name == "robot":
            coarsen(demo.nominal)
    demo_figures = write_report(demo)
    (demo.folder / "figures.json").write_text(json.dumps(demo_figures))
    return demo


def test_the_whole_way_leaves_a_calibrated_robot_a_policy_and_a_report(done: Demo) -> None:
    folder = RobotFolder.at(done.folder)
    config = folder.config()
    assert config.model == "calibrated.xml"
    assert folder.check()[1] == []
    measured = json.loads((done.training / "eval.json").read_text())
    assert (measured["starts"], len(measured["plays"]["sampled"])) == (2, 2)
    page = done.report.read_text()
    if done.video.exists():  # there is OpenGL here
        assert "data:image/webp" in page
        assert done.video.stat().st_size < rendering.VIDEO_BYTES
        assert "prefers-reduced-motion" in page
    speed = f"{100 * measured['sampled']['median']:.1f}".replace("-", "−")
    assert f"{speed} cm/s" in page
    said = walks_at(measured["sampled"]["median"]).split(" (")[0]
    for words in ("held-out error", "settings recovered", said, "openant sysid fit", "data:image/png"):
        assert words in page
    assert "http://" not in re.sub(r'xmlns(:\w+)?="[^"]+"', "", page), "a report opens offline"
    for name in ("robot", "gap", "settings", "learning", "overview"):
        assert (done.pictures / f"{name}.png").read_bytes().startswith(PNG)


def test_the_fit_finds_what_is_wrong_with_the_virtual_robot(done: Demo) -> None:
    figures = json.loads((done.folder / "figures.json").read_text())
    assert figures["gap_after_rad"] < 0.1 * figures["gap_before_rad"]
    assert figures["gap_after_rad"] < 1.5 * figures["floor_rad"]
    rows = compare(json.loads((done.fit / "fit.json").read_text()), truth(done.scenario))
    outside = [row.name for row in rows if row.determined and not row.inside]
    # 95 % intervals: of some forty, two or three may miss.
    assert len(outside) <= 3, outside
    stiffness = {row.joint: row for row in rows if row.kind == "stiffness"}
    for row in stiffness.values():
        assert row.truth == pytest.approx(0.85 * row.given)
        assert row.value == pytest.approx(row.truth, rel=0.03)


def test_what_stands_is_not_done_again_and_what_follows_from_a_change_is(done: Demo) -> None:
    again = small(done.folder)
    assert all(again.stands(stage) for stage in again.stages())

    longer = Demo(done.folder, steps=200, record_s=8.0, eval_s=1.2, starts=2)
    assert [stage.name for stage in longer.stages() if not longer.stands(stage)] == ["learn"]

    now = time.time() + 5
    os.utime(done.scenario, (now, now))
    assert [stage.name for stage in again.stages() if not again.stands(stage)] == ["record"]
    os.utime(done.scenario, (0, 0))

    away = done.fitted.with_suffix(".away")
    done.fitted.rename(away)
    assert not again.stands(again.stages()[1])
    away.rename(done.fitted)


def test_the_command_skips_what_stands_and_says_where_everything_is(
    done: Demo, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The command has no options for short recordings; their stages stand by what the folder remembers.
    whole = Demo(done.folder, steps=150)
    remembered = done.state.read_text()
    done.state.write_text(json.dumps({stage.name: stage.commands for stage in whole.stages()}))
    monkeypatch.chdir(done.folder)
    with pytest.raises(SystemExit) as end:
        main(["demo", "--robot", str(done.folder), "--steps", "150", "--json", "figures-again.json"])
    done.state.write_text(remembered)
    said, progress = capfd.readouterr()
    assert end.value.code == 0
    assert progress.count("stands already") == len(whole.stages())
    for path in (done.report, done.folder / "calibrated.xml", done.fit / "report.html", done.scenario):
        assert str(path) in said
    assert "next:" in said
    assert json.loads(Path("figures-again.json").read_text()) == json.loads((done.folder / "figures.json").read_text())


def test_without_opengl_the_robot_is_drawn_and_nothing_fails(done: Demo, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise rendering.NoOpenGL("there is no OpenGL here")

    monkeypatch.setattr(rendering, "_gl_context", refuse)
    picture, how = robot_picture.robot_picture(done.fit / "calibrated.xml")
    assert picture is not None
    assert picture.startswith(PNG)
    assert "drawn" in how

    def fail(*_: object) -> bytes:
        raise RuntimeError("no fonts")

    monkeypatch.setattr(robot_picture, "draw", fail)
    assert robot_picture.robot_picture(done.fit / "calibrated.xml") == (None, "no picture of the robot: no fonts")
    write_report(done)
    assert "no picture of the robot: no fonts" in done.report.read_text()


def test_fresh_removes_what_the_demo_made_and_nothing_else(tmp_path: Path) -> None:
    demo = small(tmp_path / "ant")
    demo.prepare()
    demo.run(demo.stages()[0])
    mine = demo.folder / "runs" / "mine" / "checkpoint.pt"
    mine.parent.mkdir(parents=True)
    mine.touch()
    demo.scenario.write_text("# edited\n")
    demo.prepare(fresh=True)
    assert mine.exists()
    assert not (demo.folder / "robot.toml").exists()
    assert "stiffness_error" in demo.scenario.read_text()


def test_a_robot_of_ones_own_is_not_touched(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "my-ant")
    before = folder.config_file.read_bytes()
    for fresh in (False, True):
        with pytest.raises(BadInput, match="not the demo's"):
            Demo(folder.path).prepare(fresh=fresh)
    assert folder.config_file.read_bytes() == before


def test_a_stage_that_fails_says_how_to_repeat_it_and_its_last_words(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    demo = small(tmp_path / "ant")
    demo.prepare()
    command = ("config", "show", "--robot", str(tmp_path / "no where"))
    with pytest.raises(StageFailed) as failure:
        demo.run(Stage("show", "look at it", (command,), (), ()))
    assert failure.value.exit_code == 2
    assert "'show' ended with exit code 2" in str(failure.value)
    typed = f"openant config show --robot '{tmp_path}/no where'"
    assert f"repeat `{typed}`" in str(failure.value)
    assert "there is no robot.toml here" in failure.value.said
    assert demo.log.read_text().startswith(f"$ {typed}\n")
    assert capfd.readouterr() == ("", "")


def test_a_finding_that_says_no_is_passed_on(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "ant")
    text = folder.config_file.read_text()
    folder.config_file.write_text(text.replace("id = 11", "id = 10"))
    demo = small(tmp_path / "demo")
    demo.prepare()
    check = ("config", "check", "--robot", str(folder.path))
    with pytest.raises(StageFailed) as failure:
        demo.run(Stage("check", "read it over", (check,), (), ()))
    assert failure.value.exit_code == 1


def test_the_truth_of_a_healthy_robot_is_its_nominal_model(tmp_path: Path) -> None:
    scenario = tmp_path / "healthy.toml"
    scenario.write_text("")
    model = mujoco.MjModel.from_xml_path(str(nominal_model_path("standard")))
    true = truth(scenario)
    for joint in JOINT_NAMES:
        dof = model.joint(joint).dofadr[0]
        kp = -model.actuator(joint).biasprm[1]
        assert true[f"stiffness.{joint}"] == pytest.approx(kp, rel=1e-4)
        assert true[f"damping.{joint}"] == pytest.approx(model.dof_damping[dof], rel=1e-4)
        assert true[f"armature.{joint}"] == pytest.approx(model.dof_armature[dof], rel=1e-4)
        # What the PWM's whole counts add is small beside the gear's friction.
        assert model.dof_frictionloss[dof] < true[f"coulomb_friction.{joint}"] < 1.1 * model.dof_frictionloss[dof]
        assert true[f"zero_offset.{joint}"] == 0.0


def test_ctrl_c_ends_the_running_command_in_order_and_the_demo_goes_on_from_there(tmp_path: Path) -> None:
    folder = tmp_path / "ant"
    command = [sys.executable, "-m", "openant_tools.cli", "demo", "--robot", str(folder)]
    # Whoever runs the tests in the background may have told their processes to ignore Ctrl-C.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=heed)
    recording = folder / "recordings" / "stand.mcap"
    give_up = time.monotonic() + PATIENCE_S
    while not recording.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < give_up
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "Traceback" not in said
    assert "the same command goes on from here" in said
    assert running_with(str(folder)) == []
    demo = Demo(folder)
    robot, record = demo.stages()[:2]
    assert demo.stands(robot)
    assert not demo.stands(record)


def running_with(words: str) -> list[str]:
    """Command lines of processes that name `words`."""
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = file.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue  # it has ended
        if words in line:
            found.append(line)
    return found


def test_openant_runs_the_same_python_and_returns_the_exit_code(tmp_path: Path) -> None:
    assert openant(("config", "new", "--robot", str(tmp_path / "ant"))) == 0
    assert openant(("config", "new", "--robot", str(tmp_path / "ant"))) == 2
    assert np.isfinite(RobotFolder.at(tmp_path / "ant").config().timing.dt_s)
