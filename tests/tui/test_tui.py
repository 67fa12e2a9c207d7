"""The terminal program: what each screen shows, and a builder who walks, hesitates, stops, and looks back."""

from __future__ import annotations

import asyncio
import datetime
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from rich.text import Text
from textual.app import App
from textual.pilot import Pilot
from textual.widgets import Input

from openant_tools.bringup.gait import first_look
from openant_tools.bringup.walk import WALK
from openant_tools.calib.wires import engine_config
from openant_tools.cli import main
from openant_tools.comms import messages
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.ring import columns
from openant_tools.errors import HardwareFault
from openant_tools.files import write_text
from openant_tools.gap.diagnosis import Diagnosis, Found, Span
from openant_tools.procedure.finding import Evidence, Finding, keep
from openant_tools.procedure.step import Ask, Bench, Intent, Live, Procedure, Progress, Say, Step
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run, write_table
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.app import SCENARIOS, SCREENS, OpenAnt
from openant_tools.tui.bars import bars
from openant_tools.tui.choices import Choices
from openant_tools.tui.dialogs import Question
from openant_tools.tui.faults import FaultList, condition
from openant_tools.tui.feeds import History, ReplayFeed
from openant_tools.tui.leg_map import REST_S, LegMap
from openant_tools.tui.marks import plain
from openant_tools.tui.page import Page
from openant_tools.tui.process import Process
from openant_tools.tui.screens import settings
from openant_tools.tui.screens.gap import GapScreen
from openant_tools.tui.screens.learn import LearnScreen
from openant_tools.tui.screens.live import LiveScreen
from openant_tools.tui.screens.step import StepScreen
from openant_tools.tui.screens.walk import WalkScreen
from openant_tools.tui.training import TrainingProcess, curve_so_far
from openant_tools.virtual.process import virtual_robot

SIZES = [(80, 24), (120, 40)]
#: of a test on a loaded machine
PATIENCE_S = 60.0


@pytest.fixture(autouse=True)
def unicode_terminal() -> Iterator[None]:
    plain(False)
    yield
    plain(False)


@pytest.fixture
def robot(tmp_path: Path) -> RobotFolder:
    """A robot whose owner has walked the first steps: one is green, one is not."""
    folder = create_robot(tmp_path / "my-ant")
    day = datetime.datetime(2026, 11, 20, 9, 30, tzinfo=datetime.UTC)
    keep(
        Finding(
            "connect", True, "the bus is /dev/ttyUSB0, the IMU /dev/ttyACM0",
            (Evidence("latency timer", 1.0, "ms", "driver of /dev/ttyUSB0"),), "", "openant calib connect", date=day,
        ),
        folder,
    )  # fmt: skip
    keep(
        Finding(
            "estop", False, "torque stays on: do not go on",
            (Evidence("still on after the stop key", 1.0, "", "register 64"),),
            "pull the power plug", "openant calib estop",
            date=day + datetime.timedelta(minutes=5), problems=("id 1: torque_enable reads 1",),
        ),
        folder,
    )  # fmt: skip
    return folder


def a_run(folder: Path, seconds: float = 12.0) -> Run:
    """A table as any software might write it: all joints swing, one falls silent for a second."""
    t = np.arange(0.0, seconds, 0.02)
    columns = {}
    for k, joint in enumerate(JOINT_NAMES):
        pos = 0.4 * np.sin(2 * np.pi * 0.4 * t + k)
        if joint == "knee_fl":
            pos[(t > 8) & (t < 9)] = np.nan
        columns |= {f"pos.{joint}": pos, f"cmd.{joint}": pos.copy(), f"volt.{joint}": np.full(len(t), 11.8)}
    run = Run("walk", Facts(tuple(JOINT_NAMES)), t, columns)
    write_table(run, folder / "walk.parquet")
    return read_run(folder / "walk.parquet")


def a_diagnosis(robot: RobotFolder) -> Path:
    """One knee's servo is softer than its model; friction was asked, too."""
    found = Diagnosis(
        model=str(robot.model_path()), runs=("stand-1", "floor-1"), held_out=("stand-2",), verdict="stiffness_error",
        confidence=0.93, selected=("stiffness_error",), ambiguous_with=(), next_experiment=None,
        effects=(
            Found("stiffness_error", ("knee_fl",), {"scale": Span(0.62, 0.6, 0.64)}, 0.93, 0.81, 0.7, 0.9, True, {"scale": -0.478}),
            Found("coulomb_friction", "all", {"torque_nm": Span(0.02, 0.0, 0.04)}, 0.11, 0.04, -0.1, 0.1, True, {"torque_nm": 0.1}),
        ),
        gap={"before": 0.0065, "after": 0.0013, "floor": 0.0004, "floor_from": "repeats"},
        where=[
            {"signal": "pos", "joint": "knee_fl", "regime": "fast", "share": 0.61},
            {"signal": "pos", "joint": "hip_fl", "regime": "slow", "share": 0.12},
        ],
        removal={"stiffness_error": 0.52}, notes=("judged by 3360 simulated robots that played these commands",),
    )  # fmt: skip
    path = robot.diagnoses / "20261124T031500Z.json"
    write_text(path, json.dumps(found.as_json()))
    return path


def frozen(app: OpenAnt, run: Run, at_s: float) -> ReplayFeed:
    """A replay that stands still, shown by the app."""
    feed = ReplayFeed(run, clock=lambda: 0.0)
    feed.playing = False
    app.session.play(feed)
    feed.seek(at_s)
    app.tick()
    return feed


def screen_text(app: OpenAnt) -> str:
    """What stands on the screen, line by line."""
    width, height = app.size
    lines = app.screen._compositor.render_strips()
    return "\n".join("".join(segment.text for segment in line) for line in lines[:height]) + "\n" * (width == 0)


def says(app: OpenAnt, words: str) -> bool:
    """Whether the words stand on the screen, wherever its lines are folded; of two columns in the right one."""
    lines = (line.rpartition("│")[2] for line in screen_text(app).splitlines())
    return "".join(words.split()) in "".join("".join(lines).split())


async def until(pilot: Pilot[int], what: Callable[[], bool]) -> None:
    give_up = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up, screen_text(pilot.app)  # type: ignore[arg-type]
        await pilot.pause(0.02)
    await pilot.pause()


# ---- what the screens look like --------------------------------------------------------------------------------------


async def _walk(pilot: Pilot[int]) -> None:
    await pilot.pause()


async def _step(pilot: Pilot[int]) -> None:
    pilot.app.open_step("estop")  # type: ignore[attr-defined]
    await pilot.pause()


async def _go(pilot: Pilot[int], name: str) -> None:
    pilot.app.action_go(name)  # type: ignore[attr-defined]
    await pilot.pause()


def a_worked_folder(robot: RobotFolder, monkeypatch: pytest.MonkeyPatch) -> Run:
    """A robot with a recording, a learning curve and a diagnosis, of always the same date."""
    monkeypatch.setenv("TEXTUAL_ANIMATIONS", "none")
    monkeypatch.setattr(settings, "_facts", lambda: Text("openant-tools 1, textual 8\nPython 3 on Linux"))
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    monkeypatch.chdir(robot.path.parent)
    run = a_run(robot.path.parent)
    write_table(run, robot.recordings / "walk.csv")
    os.utime(robot.recordings / "walk.csv", (1_795_000_000, 1_795_000_000))
    curve = robot.runs / "sac-0" / "learning_curve.csv"
    curve.parent.mkdir(parents=True)
    rows = [f"{step},{0.12 * step:.2f},{0.04 * (1 - np.exp(-step / 8000)):.5f}" for step in range(100, 12_001, 100)]
    curve.write_text("\n".join(["step,seconds,average_reward_m_s", *rows]) + "\n")
    a_diagnosis(robot)
    return run


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
@pytest.mark.parametrize("name", ["walk", *SCREENS, "step"])
def test_every_screen_looks_as_it_did(
    name: str,
    size: tuple[int, int],
    robot: RobotFolder,
    snap_compare: Callable[..., bool],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = a_worked_folder(robot, monkeypatch)
    app = OpenAnt(Path("my-ant"), ticking=False)

    async def before(pilot: Pilot[int]) -> None:
        if name in SCREENS:
            await _go(pilot, name)
        elif name == "step":
            await _step(pilot)
        if name == "live":
            app.session.selected = "knee_fl"
            frozen(app, run, 10.0)
            await pilot.pause(2 * REST_S)
        for one in app.screen.query(Input):
            one.cursor_blink = False  # a picture shows the cursor, whenever it is taken
        await pilot.pause()

    assert snap_compare(app, terminal_size=size, run_before=before)


def test_every_widget_that_takes_keys_explains_itself(robot: RobotFolder) -> None:
    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(120, 40)) as pilot:
            for name in ["walk", *SCREENS]:
                if name != "walk":
                    await _go(pilot, name)
                assert isinstance(app.screen, Page)
                assert app.screen.focus_chain, name
                await pilot.press("f1")
                await pilot.pause()
                assert "STOP" in screen_text(app), name
                assert len(screen_text(app).split()) > 60, name
                heading = next(
                    (line[2:] for line in app.screen_stack[-2].HELP.splitlines() if line.startswith("# ")), ""
                )
                assert heading in screen_text(app), f"{name}: what the screen is for comes first"
                await pilot.press("escape")

    asyncio.run(look())


def test_only_the_command_line_loads_textual_and_only_when_asked() -> None:
    code = "import sys, openant_tools.cli, openant_tools.bringup.walk; print('textual' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_without_a_terminal_openant_prints_its_manual() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "openant_tools.cli"], stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "the terminal program" in done.stderr


def test_options_of_the_terminal_program_before_a_command_are_refused() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "openant_tools.cli", "--robot", "x", "rec"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "give them after it" in done.stderr


# ---- a recording on every screen -------------------------------------------------------------------------------------


def test_a_recording_plays_on_every_screen_and_can_be_stepped(robot: RobotFolder) -> None:
    run = a_run(robot.path.parent)
    robot.recordings.mkdir(exist_ok=True)
    write_table(run, robot.recordings / "walk.csv")

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await pilot.press("r")
            await pilot.pause()
            await pilot.press("enter")
            await until(pilot, lambda: isinstance(app.screen, LiveScreen) and app.session.replay is not None)
            replay = app.session.replay
            assert replay is not None
            await pilot.press("p")
            assert not replay.playing
            replay.seek(8.5)
            app.tick()
            await pilot.pause()
            assert "8.5 of 12.0 s" in screen_text(app)
            knee = next(line for line in screen_text(app).splitlines() if line.startswith("knee_fl"))
            assert "silent" in knee
            assert app.session.faults.unseen == (), "what a recording shows is no fault of now"
            await pilot.press("right_square_bracket")
            app.tick()
            assert replay.position_s == pytest.approx(12.0 - 0.02)
            await pilot.press("comma")
            assert replay.position_s == pytest.approx(11.88)
            for name in SCREENS:
                await _go(pilot, name)
                assert "of 12.0 s" in screen_text(app), name
            await _go(pilot, "live")
            await pilot.press("x")
            await pilot.pause()
            assert app.session.replay is None
            assert "of 12.0 s" not in screen_text(app)

    asyncio.run(look())


def test_a_run_that_is_none_is_refused_in_words(robot: RobotFolder, tmp_path: Path) -> None:
    (tmp_path / "none.csv").write_text("a,b\n1,2\n")

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(120, 40)) as pilot:
            await pilot.press("r")
            await pilot.press("n")
            await pilot.press(*str(tmp_path / "none.csv"), "enter")
            await until(pilot, lambda: "there is no column t" in screen_text(app))

    asyncio.run(look())


def test_a_tick_that_was_due_as_the_program_closed_does_nothing(robot: RobotFolder) -> None:
    async def close() -> OpenAnt:
        app = OpenAnt(robot.path)
        async with app.run_test(size=(80, 24)):
            pass
        return app

    app = asyncio.run(close())
    assert not app.screen_stack
    app.tick()


def test_a_fault_stays_until_it_has_been_seen(robot: RobotFolder) -> None:
    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            app.session.faults.note("knee_fl", "does not answer")
            app.session.faults.is_over("knee_fl")
            for name in ["findings", "learn"]:
                await _go(pilot, name)
                assert "FAULT knee_fl: does not answer (over now)" in screen_text(app)
            await pilot.press("f8")
            await pilot.pause()
            assert "FAULT" not in screen_text(app)

    asyncio.run(look())


def test_what_no_page_was_written_of_is_not_among_the_findings(robot: RobotFolder) -> None:
    keep(Finding("estop", True, "torque goes off", (), "", "estop"), robot)
    (robot.findings / "sysid-fit-20261129T101112Z.json").write_text('{"values": []}')

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await _go(pilot, "findings")
            await pilot.pause()
            shown = screen_text(app)
            assert "torque goes off" in shown
            assert "sysid-fit" not in shown

    asyncio.run(look())


def test_an_observation_outside_its_bounds_is_shown_and_stays_until_seen(robot: RobotFolder) -> None:
    robot.update({"observation.pos.hip_fl": [-0.5, 0.5], "observation.gyro.z": [-1.0, 1.0]})
    rows = np.zeros((1, len(columns(JOINT_NAMES))))
    for name in columns(JOINT_NAMES):
        if name.startswith("ok."):
            rows[0, columns(JOINT_NAMES).index(name)] = 1.0
    history = History(JOINT_NAMES, robot.config().observation)
    faults = FaultList()
    history.add(rows)
    faults.watch(history)
    assert faults.unseen == ()
    rows[0, columns(JOINT_NAMES).index("pos.hip_fl")] = 0.6
    rows[0, columns(JOINT_NAMES).index("gyro.z")] = -1.5
    history.add(rows)
    assert (condition(history, "hip_fl").mark, condition(history, "hip_fl").word) == ("warn", "outside")
    assert condition(history, "knee_fl").word == "ok"
    faults.watch(history)
    assert [str(fault) for fault in faults.unseen] == [
        "hip_fl: pos.hip_fl is 34.4°, outside its bounds −28.6 to 28.6°",
        "gyro.z: gyro.z is −85.9 °/s, outside its bounds −57.3 to 57.3 °/s",
    ]


def test_a_replay_shows_what_was_outside_the_bounds_of_this_robot(robot: RobotFolder) -> None:
    robot.update({"observation.pos.hip_fl": [-0.1, 0.1]})
    run = a_run(robot.path.parent)

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await _go(pilot, "live")
            frozen(app, run, 7.0)
            await pilot.pause()
            assert any(line.startswith("hip_fl") and "outside" in line for line in screen_text(app).splitlines())

    asyncio.run(look())


# ---- the gap ---------------------------------------------------------------------------------------------------------


def test_a_model_is_written_from_a_diagnosis_once_the_builder_has_said_so(robot: RobotFolder) -> None:
    a_diagnosis(robot)
    given = robot.model_path()

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(120, 40)) as pilot:
            await pilot.press("g")
            await pilot.pause()
            assert says(app, "(knee_fl): stiffness is not what the model")
            await pilot.press("w")
            await pilot.pause()
            await pilot.press("down", "enter")
            assert app.session.diagnosing is None
            await pilot.press("w")
            await pilot.pause()
            await pilot.press("enter")
            await until(pilot, lambda: "✓ done" in screen_text(app))
            assert says(app, f"openant gap apply {robot.diagnoses / '20261124T031500Z.json'}")
        app.session.close()

    asyncio.run(look())
    assert robot.model_path() == robot.path / "improved.xml" != given
    knee, before = (mujoco.MjModel.from_xml_path(str(path)).actuator("knee_fl") for path in (robot.model_path(), given))
    assert knee.gainprm[0] / before.gainprm[0] == pytest.approx(0.62, abs=0.01)


def test_runs_that_cannot_be_diagnosed_are_refused_in_words(robot: RobotFolder) -> None:
    """One is wanted; the process says what is wrong with them, and the screen says it on."""
    run = a_run(robot.path.parent, seconds=3.0)
    still = {name: np.zeros(len(run.t)) for name in run.columns}
    for name in ("a", "b"):
        write_table(replace(run, columns=still), robot.recordings / f"{name}.csv")

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(120, 40)) as pilot:
            await pilot.press("g")
            await pilot.pause()
            assert "No diagnosis yet" in screen_text(app)
            await pilot.press("d")
            await pilot.pause()
            assert app.session.diagnosing is None
            await pilot.press("a", "a")
            assert "0 of 2 runs chosen" in screen_text(app)
            await pilot.press("a", "d")
            assert app.session.diagnosing is not None
            assert app.session.diagnosing.arguments[:2] == ("gap", "diagnose")
            await until(pilot, lambda: says(app, "nothing moves"))
        app.session.close()

    asyncio.run(look())


def test_a_diagnosis_that_is_none_is_said_to_be_none(robot: RobotFolder) -> None:
    a_diagnosis(robot).write_text('{"schema": "something else"}')

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(120, 40)) as pilot:
            await pilot.press("g")
            await pilot.pause()
            assert says(app, "is no diagnosis")

    asyncio.run(look())


# ---- a builder and a virtual robot -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def box() -> Iterator[Mapping[str, str | None]]:
    """Eight motors in their boxes, in stepped time."""
    with virtual_robot(str(SCENARIOS / "loose.toml"), clock="stepped", camera=False) as found:
        yield found


@pytest.fixture
def loose(box: Mapping[str, str | None]) -> Iterator[Mapping[str, str | None]]:
    """The same, all unplugged when the test has ended."""
    yield box
    with_control(box, lambda control: [control.ask("unplug", joint=joint) for joint in JOINT_NAMES])


def with_control(robot: Mapping[str, str | None], do: Callable[[VirtualControl], Any]) -> Any:
    control = VirtualControl(str(robot["control"]))
    try:
        return do(control)
    finally:
        control.close()


def torques(robot: Mapping[str, str | None]) -> list[bool]:
    state = with_control(robot, lambda control: control.ask("state"))
    return [bool(on) for on in state["torque_enable"].values()]


def offered(app: OpenAnt) -> list[str]:
    """The lines to choose from."""
    screen = app.screen
    return [choice.words for choice in screen.choices] if isinstance(screen, StepScreen) else []


async def choose(pilot: Pilot[int], words: str) -> None:
    """Go to the line that begins so with the arrow keys, and press Enter."""
    app = cast(OpenAnt, pilot.app)
    await until(pilot, lambda: any(line.startswith(words) for line in offered(app)))
    chooser = app.screen.query_one("#choices", Choices)
    at = next(k for k, line in enumerate(offered(app)) if line.startswith(words))
    for _ in range(abs(at - (chooser.highlighted or 0))):
        await pilot.press("down" if at > (chooser.highlighted or 0) else "up")
    await pilot.press("enter")
    await pilot.pause()


def test_the_first_steps_from_the_box_and_the_terminal_closed_and_opened_again(
    tmp_path: Path, loose: Mapping[str, str | None]
) -> None:
    async def build() -> None:
        app = OpenAnt(tmp_path)
        app.session.virtual = loose
        async with app.run_test(size=(80, 24)) as pilot:
            await pilot.press("enter")
            await pilot.pause()
            assert "All that is found out about a robot is kept in a folder" in screen_text(app)
            await pilot.press("enter")
            await choose(pilot, "Begin")
            await choose(pilot, "Next: Emergency stop")
            await choose(pilot, "Begin")
            await choose(pilot, "Let the virtual robot's hands do it")
            await choose(pilot, "Yes, do it")
            await until(pilot, lambda: "stop" in offered(app))
            assert any(torques(loose))
            await pilot.press("space")
            await until(pilot, lambda: "Next: Motor IDs" in offered(app))
            assert not any(torques(loose))
            await pilot.press("escape")
            await pilot.pause()
            assert screen_text(app).count("✓ ok") == 2
        app.session.close()

    async def look_again() -> None:
        app = OpenAnt(tmp_path / "my-ant", ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await pilot.pause()
            assert screen_text(app).count("· done, virtual") == 2
            assert "Connect  about 1 min" in screen_text(app), "the real robot begins at its beginning"
            app.session.virtual = loose
            await pilot.press("2", "enter")
            await pilot.press("escape")
            await pilot.pause()
            assert screen_text(app).count("✓ ok") == 2
            assert "Continue my-ant · 2 of 15 · next: Motor IDs" in screen_text(app), "it goes on where it stopped"

    asyncio.run(build())
    asyncio.run(look_again())


async def _to_the_first_motor(pilot: Pilot[int], app: OpenAnt) -> None:
    app.open_step("ids")
    await choose(pilot, "Begin")
    await until(pilot, lambda: "It is done already" in offered(app))
    assert "Plug in one servo for the rear right hip" in screen_text(app)


def test_nothing_is_written_that_was_not_granted(robot: RobotFolder, loose: Mapping[str, str | None]) -> None:
    before = with_control(loose, lambda control: control.ask("state"))["id"]

    async def refuse() -> None:
        app = OpenAnt(robot.path)
        app.session.virtual = loose
        async with app.run_test(size=(120, 40)) as pilot:
            await _to_the_first_motor(pilot, app)
            await choose(pilot, "Let the virtual robot's hands do it")
            await until(pilot, lambda: "Yes, do it" in offered(app))
            assert "hip_rr: id 1 → 10" in screen_text(app)
            assert "The robot moves." in screen_text(app)
            await choose(pilot, "No, leave everything as it is")
            await choose(pilot, "Back to the walk")
            assert isinstance(app.screen, WalkScreen)
        app.session.close()

    asyncio.run(refuse())
    assert with_control(loose, lambda control: control.ask("state"))["id"] == before
    assert not robot.journal.exists()
    assert not list(robot.findings.glob("ids-*"))


def test_two_motors_plugged_at_once_are_told_in_words(robot: RobotFolder, loose: Mapping[str, str | None]) -> None:
    async def mistake() -> None:
        app = OpenAnt(robot.path)
        app.session.virtual = loose
        async with app.run_test(size=(120, 40)) as pilot:
            await _to_the_first_motor(pilot, app)
            for joint in ("hip_rr", "hip_fr"):
                with_control(loose, lambda control, joint=joint: control.ask("plug", joint=joint))
            await choose(pilot, "It is done already")
            await until(pilot, lambda: "try again" in offered(app))
            assert "two servos answer at once" in screen_text(app)
            await pilot.press("escape")
            await pilot.pause()
            assert "Leave this step?" in screen_text(app)
            await pilot.press("enter")
            await until(pilot, lambda: isinstance(app.screen, WalkScreen))
        app.session.close()

    asyncio.run(mistake())
    assert not any(torques(loose))
    assert not robot.journal.exists()


def test_the_stop_key_ends_a_step_wherever_it_is(robot: RobotFolder, loose: Mapping[str, str | None]) -> None:
    async def stop() -> None:
        app = OpenAnt(robot.path)
        app.session.virtual = loose
        async with app.run_test(size=(80, 24)) as pilot:
            await _to_the_first_motor(pilot, app)
            await pilot.press("f1", "space")
            await pilot.press("escape")
            await until(pilot, lambda: "Begin again" in offered(app))
            assert "stopped by hand" in screen_text(app)
            await choose(pilot, "Begin again")
            await until(pilot, lambda: "It is done already" in offered(app))
            await pilot.press("space")
            await until(pilot, lambda: "Begin again" in offered(app))
        app.session.close()

    asyncio.run(stop())
    assert not any(torques(loose))


def test_a_robot_is_watched_live_and_the_stop_key_lets_it_go(tmp_path: Path) -> None:
    scenario = tmp_path / "blind.toml"
    scenario.write_text("[camera]\npresent = false\n")

    async def watch() -> None:
        app = OpenAnt(create_robot(tmp_path / "my-ant").path, virtual=str(scenario))
        async with app.run_test(size=(120, 40)) as pilot:
            await pilot.press("c")
            await until(pilot, lambda: len(app.session.history.rows) > 50)
            assert app.session.virtual is not None
            assert "torque off" in screen_text(app)
            assert "live" in screen_text(app)
            assert app.session._engine is not None
            with pytest.raises(HardwareFault, match="torque stays off: this program only watches"):
                app.session._engine.ask(messages.Torque(True))
            app.session.disconnect()
            app.session._engine = engine = EngineProcess(engine_config(app.session.bench()))
            engine.ask(messages.Torque(True))
            assert all(torques(app.session.virtual))
            await until(pilot, lambda: "torque ON" in screen_text(app))
            await pilot.press("space")
            await until(pilot, lambda: "torque off" in screen_text(app))
            assert not any(torques(app.session.virtual))
            assert "stopped by hand" in screen_text(app), "it stays until it has been seen"
            with_control(
                app.session.virtual, lambda control: control.ask("fault", cause="broken_wire", where="knee_rl")
            )
            await until(pilot, lambda: any(fault.where == "knee_rl" for fault in app.session.faults.unseen))
        app.session.close()

    asyncio.run(watch())


def swing(bench: Bench) -> Procedure:
    """A procedure that moves for longer than anybody waits, and does not look up meanwhile."""
    yield Intent("swing all legs for a minute", moves=True)
    with EngineProcess(engine_config(bench)) as engine:
        start = engine.ask(messages.Torque(True))
        engine.ask(messages.Play(np.tile(start, (6000, 1)), "swing"))
    return Finding("swing", True, "it has swung", (), "", "none")


def test_the_stop_key_reaches_a_robot_that_moves(tmp_path: Path) -> None:
    scenario = tmp_path / "blind.toml"
    scenario.write_text("[camera]\npresent = false\n")
    step = Step("swing", "Swing", "Swings.", f"{__name__}:swing", moves=True)

    async def stop() -> None:
        app = OpenAnt(create_robot(tmp_path / "my-ant").path, virtual=str(scenario))
        async with app.run_test(size=(120, 40)) as pilot:
            await until(pilot, lambda: app.session.virtual is not None and not app.session.doing)
            assert app.session.virtual is not None
            app.push_screen(StepScreen(step))
            await choose(pilot, "Begin")
            await choose(pilot, "Yes, do it")
            await until(pilot, lambda: "torque ON" in screen_text(app))
            await pilot.press("space")
            await until(pilot, lambda: not any(torques(app.session.virtual or {})))
            await until(pilot, lambda: "Begin again" in offered(app))
            assert "stopped by hand" in screen_text(app)
        app.session.close()

    asyncio.run(stop())


HEEDED = threading.Event()


def asks(bench: Bench) -> Procedure:
    """A procedure with one question."""
    yield Ask("Is it so?", ("yes", "no"), default="yes")
    return Finding("asks", True, "it is so", (), "", "none")


def test_a_key_that_is_pressed_twice_answers_once(robot: RobotFolder) -> None:
    async def press() -> None:
        app = OpenAnt(robot.path)
        async with app.run_test(size=(80, 24)) as pilot:
            app.push_screen(StepScreen(Step("asks", "Asks", "Asks.", f"{__name__}:asks")))
            for words in ("Begin", "yes"):
                await until(pilot, lambda words=words: offered(app)[:1] == [words])  # type: ignore[misc]
                app.simulate_key("enter")
                app.simulate_key("enter")
            await until(pilot, lambda: "Begin again" in offered(app))
            app.push_screen(Question("Quit?", "Stay", "Quit"))
            await pilot.pause()
            app.simulate_key("enter")
            app.simulate_key("enter")
            await until(pilot, lambda: isinstance(app.screen, StepScreen))
            await pilot.press("escape")
            await until(pilot, lambda: isinstance(app.screen, WalkScreen))
            app.simulate_key("enter")
            app.simulate_key("enter")
            await until(pilot, lambda: isinstance(app.screen, StepScreen))
            await pilot.pause(0.2)
            assert sum(isinstance(screen, StepScreen) for screen in app.screen_stack) == 1
        app.session.close()

    asyncio.run(press())


def moves(bench: Bench) -> Procedure:
    """A procedure that looks, asks, and then takes its time without a word; many numbers come of it."""
    yield Progress(0.3, "looking")
    yield Intent("move", moves=True)
    yield Live({"x": 1.0}, "mm", "moving")
    HEEDED.wait(PATIENCE_S)
    return Finding(
        "moves", True, "it moved", tuple(Evidence(f"number {k}", k, "mm", "here") for k in range(40)), "", "none"
    )


def test_what_was_granted_is_under_way_and_the_page_keys_scroll_what_came_of_it(robot: RobotFolder) -> None:
    HEEDED.clear()

    async def scroll() -> None:
        app = OpenAnt(robot.path)
        async with app.run_test(size=(80, 24)) as pilot:
            app.push_screen(StepScreen(Step("moves", "Moves", "Moves.", f"{__name__}:moves", moves=True)))
            await choose(pilot, "Begin")
            await choose(pilot, "Yes, do it")
            await until(pilot, lambda: "Under way: move." in screen_text(app))
            await until(pilot, lambda: "running 30 %" in screen_text(app))
            assert "looking" not in screen_text(app), "that was before it asked"
            HEEDED.set()
            await until(pilot, lambda: "Begin again" in offered(app))
            assert "number 39" not in screen_text(app)
            await pilot.press("pagedown", "pagedown", "pagedown")
            await until(pilot, lambda: "number 39" in screen_text(app))
            assert "it moved" in screen_text(app)
            await pilot.press("pageup", "pageup", "pageup")
            await until(pilot, lambda: "number 0" in screen_text(app))
            chooser = app.screen.query_one("#choices", Choices)
            assert chooser.has_focus
            assert chooser.highlighted == 0, "what is asked stays as it was"
        app.session.close()

    asyncio.run(scroll())


def test_help_on_a_question_is_about_the_step_below_it(robot: RobotFolder) -> None:
    async def ask() -> None:
        app = OpenAnt(robot.path)
        async with app.run_test(size=(80, 24)) as pilot:
            app.push_screen(StepScreen(WALK["centre"]))
            await until(pilot, lambda: "Begin" in offered(app))
            app.push_screen(Question("Leave this step?", "Leave", "Stay"))
            await pilot.pause()
            await pilot.press("f1")
            await until(pilot, lambda: "Horn: the disc on the servo's shaft" in screen_text(app))
            assert "SPACE: STOP" in screen_text(app), "whatever lies over it"
            await pilot.press("f1")
            await until(pilot, lambda: isinstance(app.screen, Question))
        app.session.close()

    asyncio.run(ask())


def heedless(bench: Bench) -> Procedure:
    """A procedure that goes on to its finding whatever happens meanwhile."""
    yield Say("it has begun")
    HEEDED.wait(PATIENCE_S)
    return Finding("heedless", True, "all is well", (), "", "none")


@pytest.mark.parametrize("key", ["space", "ctrl+c"])
def test_what_was_stopped_finds_nothing(robot: RobotFolder, key: str) -> None:
    HEEDED.clear()

    async def stop() -> None:
        app = OpenAnt(robot.path)
        async with app.run_test(size=(80, 24)) as pilot:
            app.push_screen(StepScreen(Step("heedless", "Heedless", "Goes on.", f"{__name__}:heedless")))
            await choose(pilot, "Begin")
            await until(pilot, lambda: "it has begun" in screen_text(app))
            await pilot.press(key)
            HEEDED.set()
            await until(pilot, lambda: "Begin again" in offered(app) or app.return_code is not None)
        app.session.close()

    asyncio.run(stop())
    assert not list(robot.findings.glob("heedless-*"))


def breaks(bench: Bench) -> Procedure:
    """A procedure whose engine is gone once the robot was stopped."""
    yield Say("it has begun")
    HEEDED.wait(PATIENCE_S)
    raise HardwareFault("stopped by hand", where="/dev/ttyUSB0")


def test_a_step_that_was_suspended_says_so_and_not_what_broke_off_by_it(robot: RobotFolder) -> None:
    HEEDED.clear()

    async def suspend() -> None:
        app = OpenAnt(robot.path)
        async with app.run_test(size=(80, 24)) as pilot:
            screen = StepScreen(Step("breaks", "Breaks", "Breaks.", f"{__name__}:breaks"))
            app.push_screen(screen)
            await choose(pilot, "Begin")
            await until(pilot, lambda: "it has begun" in screen_text(app))
            screen.end("suspended")
            HEEDED.set()
            await until(pilot, lambda: "Begin again" in offered(app))
            assert "suspended → torque is off" in screen_text(app)
            assert "stopped by hand" not in screen_text(app)
        app.session.close()

    asyncio.run(suspend())


def test_a_step_shows_the_robot_beside_it_from_its_first_moment_where_there_is_room(robot: RobotFolder) -> None:
    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(120, 40)) as pilot:
            app.push_screen(StepScreen(WALK["centre"]))
            await until(pilot, lambda: "Begin" in offered(app))
            assert "servo             angle  load     A  °C    V" in screen_text(app)
        app.session.close()

    asyncio.run(look())


def test_a_bar_begins_at_zero_and_has_a_sign_only_where_it_can_be_negative() -> None:
    plain(True)
    angles = Live(
        {"hip_rr": -0.4, "knee_rr": 0.4}, "rad", "", {"hip_rr": -0.8, "knee_rr": -0.8}, {"hip_rr": 0.8, "knee_rr": 0.8}
    )
    left, right = bars(angles, 80).plain.splitlines()
    assert ("-22.9" in left, "+22.9" in right) == (True, True)
    for line, runs in ((left, "|=+"), (right, "+=|")):
        assert runs == "".join(dict.fromkeys(char for char in line.split(" deg ")[-1][9:-6] if char in "|=+"))
    [warm] = bars(Live({"hip_rr": 25.0}, "°C", "", {"hip_rr": 15.0}, {"hip_rr": 80.0}), 80).plain.splitlines()
    assert "+" not in warm
    assert " 25 C " in warm


def drawn(angles_rad: Mapping[str, float]) -> str:
    """The lines of the robot from above, with these joints read, without what stands at its joints."""

    async def draw() -> str:
        history = History(tuple(angles_rad))
        history.read(angles_rad, 0.0)
        app = App[None]()
        async with app.run_test(size=(36, 14)) as pilot:
            await app.mount(LegMap(history))
            await pilot.pause()
            lines = app.screen._compositor.render_strips()
            return "".join(char for line in lines for segment in line for char in segment.text if char > "\u2800")

    return asyncio.run(draw())


def test_a_servo_that_is_in_no_leg_yet_bends_none() -> None:
    assert drawn({"knee_fr": 2.9}) == drawn({"knee_fr": 0.0})
    assert drawn({"hip_fr": 0.0, "knee_fr": 1.2}) != drawn({"hip_fr": 0.0, "knee_fr": 0.0})


def test_ctrl_c_leaves_with_130_and_nothing_running(robot: RobotFolder, loose: Mapping[str, str | None]) -> None:
    async def leave() -> int | None:
        app = OpenAnt(robot.path)
        app.session.virtual = loose
        async with app.run_test(size=(80, 24)) as pilot:
            await _to_the_first_motor(pilot, app)
            await pilot.press("ctrl+c")
            await until(pilot, lambda: app.return_code is not None)
        app.session.close()
        return app.return_code

    assert asyncio.run(leave()) == 130
    assert not any(torques(loose))


def test_training_on_the_robot_asks_before_it_moves_and_the_stop_key_reaches_it(
    robot: RobotFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = list[str]()
    monkeypatch.setattr(TrainingProcess, "start", lambda self: told.append(f"start {self.where}"))
    monkeypatch.setattr(TrainingProcess, "running", property(lambda self: "stop" not in told))
    monkeypatch.setattr(TrainingProcess, "stop", lambda self: told.append("stop"))

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(120, 40)) as pilot:
            await _go(pilot, "learn")
            for answer in ("down", "enter"):
                chooser = app.screen.query_one("#choices", Choices)
                chooser.focus()
                chooser.highlighted = next(k for k, line in enumerate(chooser.options) if line.id == "sac robot")
                await pilot.press("enter")
                assert "inside the circle, facing its reward" in screen_text(app)
                await pilot.press(*(["down"] if answer == "down" else []), "enter")
                assert told == ([] if answer == "down" else ["start robot"])
            await pilot.press("space")
            assert told == ["start robot", "stop"]

    asyncio.run(look())


def test_what_was_learned_is_evaluated_played_compared_and_diagnosed_from_its_screen(
    robot: RobotFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = list[str]()
    monkeypatch.setattr(Process, "start", lambda self: told.append(self.command))
    run = robot.runs / "sac-0"
    (run / "recordings").mkdir(parents=True)
    (run / "learning_curve.csv").write_text("step,seconds,average_reward_m_s\n100,12.0,-0.023\n")
    for name in ("a", "b"):
        (run / "recordings" / f"{name}.mcap").touch()
    os.utime(run / "recordings" / "a.mcap", (1, 1))

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await _go(pilot, "learn")
            await pilot.pause()
            assert "sac-0  does not walk yet (−2.3 cm/s)" in screen_text(app)
            assert screen_text(app).count("│") >= 8, "a curve that one can read"
            chooser = app.screen.query_one("#choices", Choices)
            chooser.focus()
            for id_ in ("evaluate", "compare", "play"):
                chooser.highlighted = next(k for k, line in enumerate(chooser.options) if line.id == id_)
                await pilot.press("enter")
                with monkeypatch.context() as while_it_runs:
                    while_it_runs.setattr(Process, "running", True)
                    cast(LearnScreen, app.screen_stack[1]).draw_progress()
                    await pilot.pause()
                    assert "playing   openant" in screen_text(app) or id_ == "play"
                    assert [line.id for line in chooser.options] == ["stop"], "one thing at a time"
                cast(LearnScreen, app.screen_stack[1]).draw_progress()
            assert "inside the circle, facing its reward" in screen_text(app), "what moves asks"
            await pilot.press("escape", "d")
            await pilot.pause()
            assert isinstance(app.screen, GapScreen)
            assert re.search(r"sac-0/b.mcap.*sac-0/a.mcap", screen_text(app), re.DOTALL), "newest first"

    asyncio.run(look())
    there = f"--robot {robot.path}"
    assert told[:2] == [
        f"openant eval {run} --env sim {there}",
        f"openant policies play --policies {robot.runs} --on {robot.path} --json {robot.runs / 'compared.json'}",
    ]
    assert told[2].startswith(f"openant gap diagnose {run / 'recordings' / 'b.mcap'} {there} --json ")


def test_minutes_that_are_no_number_are_said_and_stay_said(robot: RobotFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Process, "start", lambda self: pytest.fail("it started"))

    async def look() -> None:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24), notifications=True) as pilot:
            await _go(pilot, "learn")
            app.screen.query_one("#minutes", Input).value = ""
            app.screen.query_one("#choices", Choices).focus()
            await pilot.press("enter")
            await pilot.pause(0.2)
            assert "minutes and seed are whole numbers" in screen_text(app)

    asyncio.run(look())


@pytest.mark.parametrize(("agent", "steps"), [("sac", 30_000), ("sarsa", 72_000)])
def test_an_hour_is_as_many_steps_as_the_command_says(
    agent: str, steps: int, robot: RobotFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Process, "start", lambda self: None)

    async def commanded() -> str:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await _go(pilot, "learn")
            cast(LearnScreen, app.screen).start(agent)
            assert app.session.training is not None
            return app.session.training.command

    assert f" --steps {steps} " in asyncio.run(commanded())
    with pytest.raises(SystemExit):
        main(["train", agent, "--help"])
    told = " ".join(capsys.readouterr().out.split())
    assert f"{steps} steps of" in told, "as the command itself has it"
    assert f"[default: {steps};" in told


@pytest.mark.parametrize(("cm_s", "drawn"), [(1.0, False), (4.0, False), (5.0, True), (20.0, True)])
def test_the_paper_is_said_to_be_dotted_where_it_is_drawn(
    cm_s: float, drawn: bool, robot: RobotFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = robot.runs / "sac-0"
    run.mkdir(parents=True)
    curve = "".join(f"{n},{n},{cm_s / 100 * n / 9}\n" for n in range(10))
    (run / "learning_curve.csv").write_text(f"step,seconds,average_reward_m_s\n{curve}")

    async def look() -> str:
        app = OpenAnt(robot.path, ticking=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await _go(pilot, "learn")
            return screen_text(app)

    text = asyncio.run(look())
    assert "13 to 23 cm/s" in text
    assert ("dotted, the paper" in text) == ("┄" in text) == drawn


def test_training_is_the_command_that_one_would_type(robot: RobotFolder) -> None:
    training = TrainingProcess("sac", robot.path, 2000, 1, robot.runs / "sac-1")
    assert (
        training.command == f"openant train sac --robot {robot.path} --steps 2000 --seed 1 --out {robot.runs / 'sac-1'}"
    )
    assert curve_so_far(robot.runs / "sac-1") == []
    real = replace(training, where="robot")
    assert real.command == f"{training.command} --env hardware --yes"
    assert replace(training, where="virtual").command == f"{real.command} --virtual"
    first = replace(training, options=first_look())
    assert "--steps 2000 --learning-start 500 --entropy-start 0.1 --batch 128 --seed 1" in first.command
    training.folder.mkdir(parents=True)
    (training.folder / "learning_curve.csv").write_text("step,seconds,average_reward_m_s\n100,12.0,0.01\n200,2")
    assert [point.step for point in curve_so_far(training.folder)] == [100]
