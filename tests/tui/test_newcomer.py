"""What a newcomer stumbled over: silence while something runs, numbers without a unit, keys that act unseen, values of then."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest
from test_looks import Ended, held
from test_tui import a_diagnosis, a_run, frozen, robot, says, screen_text, unicode_terminal, until  # noqa: F401
from textual.pilot import Pilot
from textual.widgets import Input

from openant_tools.bringup.walk import BESIDE, WALK
from openant_tools.comms.ring import columns
from openant_tools.procedure.finding import Finding, keep
from openant_tools.recording.tables import write_table
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.app import SCREENS, OpenAnt
from openant_tools.tui.choices import Choices
from openant_tools.tui.dialogs import DOCS, Help
from openant_tools.tui.faults import condition
from openant_tools.tui.feeds import History
from openant_tools.tui.joint_table import JointTable
from openant_tools.tui.process import Process
from openant_tools.tui.screens.recordings import RecordingsScreen
from openant_tools.tui.screens.step import StepScreen
from openant_tools.tui.screens.walk import WalkScreen
from openant_tools.tui.step_help import step_doc
from openant_tools.tui.training import PlayProcess


def with_program(
    path: Path, do: Callable[[OpenAnt, Pilot[int]], Awaitable[None]], size: tuple[int, int] = (80, 24)
) -> None:
    async def run() -> None:
        app = OpenAnt(path, ticking=False)
        try:
            async with app.run_test(size=size) as pilot:
                await pilot.pause()
                await do(app, pilot)
        finally:
            app.session.close()

    asyncio.run(run())


# ---- what runs says how far it is ----


def test_a_command_tells_its_screen_how_far_it_is_and_what_it_said_this_time(robot: RobotFolder) -> None:  # noqa: F811
    table = robot.path.parent / "walk.csv"
    write_table(a_run(robot.path.parent), table)
    process = Process(("rec", "import", str(table), "--out", str(robot.path / "a.mcap")), robot.path / "a.log")
    process.log.write_text("what another run said before\n")
    process.start()
    give_up = time.monotonic() + 60.0
    while process.running:
        assert time.monotonic() < give_up
        time.sleep(0.05)
    assert process.progress == "0 %  importing walk"
    assert process.exit_code == 0, process.said
    assert process.said
    assert "before" not in " ".join(process.said)
    process.close()


@pytest.mark.parametrize("size", [(80, 24), (120, 40)], ids=["80x24", "120x40"])
def test_an_evaluation_shows_its_progress_and_then_its_figures_below_the_curve(
    size: tuple[int, int],
    robot: RobotFolder,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = robot.runs / "sac-0"
    run.mkdir(parents=True)
    curve = "".join(f"{n * 100},{n * 12},{0.001 * n}\n" for n in range(40))
    (run / "learning_curve.csv").write_text(f"step,seconds,average_reward_m_s\n{curve}")
    figures = (
        "openant: my-ant was never identified: this is the kit's nominal model, not that robot (`openant sysid fit`)\n"
        "sampled, as in training: +3.9 cm/s over 120 s, median of 15 starts (+2.1 to +4.4); 4.61 m walked, 3 turns\n"
        "likeliest action, without chance: +1.2 cm/s over 120 s, median of 15 starts (+0.0 to +4.0); stood still for good "
        "in 4 of 15; 1.40 m walked, 1 turns\npolicy of step 3900\n"
    )

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.action_go("learn")
        await pilot.pause()
        playing = app.session.training = PlayProcess(("eval", str(run), "--env", "sim"), run)
        monkeypatch.setattr(Process, "running", True)
        monkeypatch.setattr(Process, "progress", "12 %  start 3 of 15, sampled +3.9 cm/s")
        app.screen.query_one("#progress").refresh()
        await pilot.pause()
        lines = screen_text(app).splitlines()
        assert any(line.strip().startswith("… 12 %  start 3 of 15, sampled +3.9 cm/s") for line in lines)
        assert sum("│" in line for line in lines) >= 3, "the curve of what is evaluated stays"
        monkeypatch.setattr(Process, "running", False)
        playing._process = Ended(0)  # type: ignore[assignment]
        playing.log.write_text(figures)
        app.screen.query_one("#progress").refresh()
        await pilot.pause()
        said = screen_text(app)
        assert says(app, "sampled, as in training: +3.9 cm/s")
        assert says(app, "stood still for good in 4 of 15")
        assert said.rindex("│") < said.index("sampled, as in training"), "below the curve"
        assert sum("│" in line for line in said.splitlines()) >= 3
        app.session.training = None

    with_program(robot.path, look, size)


# ---- the joint table ----


def test_current_and_load_have_a_column_and_a_unit_each(robot: RobotFolder) -> None:  # noqa: F811
    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.session.history = held()
        app.push_screen(StepScreen(WALK["connect"]))
        await until(pilot, lambda: "hip_rr" in screen_text(app))
        lines = screen_text(app).splitlines()
        head = next(line for line in lines if "servo" in line)
        hip, knee = (next(line for line in lines if joint in line) for joint in ("hip_rr", "knee_rl"))
        load, current = (slice(at - 5, at) for at in (head.index("load") + 4, head.index(" A") + 2))
        assert (hip[load].strip(), hip[current].strip()) == ("12 %", "-")
        assert (knee[load].strip(), knee[current].strip()) == ("-", "−0.16")

    with_program(robot.path, look, (120, 40))


def row_of(history: History, joint: str) -> str:
    return JointTable(history)._joint(joint).plain


def test_servos_that_are_no_joints_yet_have_rows_of_their_own() -> None:
    history = History(("id 10", "id 11"))
    history.read({"id 10": 0.1, "id 11": 0.2}, 0.0)
    lines = JointTable(history)._table().plain.splitlines()
    assert [line[:8].strip() for line in lines] == ["joint", "id 10", "id 11"]
    assert "+5.7°" in lines[1]


def test_a_joint_that_falls_silent_keeps_its_last_values_and_says_since_when() -> None:
    history = held()
    names = columns(JOINT_NAMES)
    row = history.rows[-1].copy()
    for name in (name for name in names if name.endswith(".knee_rl")):
        row[names.index(name)] = 0.0 if name.startswith("ok.") else np.nan
    for second in range(1, 41):  # longer than the window of the strips
        row[0] = 2.0 + 0.5 * second
        history.add(row[None].copy())
    assert condition(history, "knee_rl").word == "silent"
    assert "silent 20 s" in row_of(history, "knee_rl")
    assert "+18.8°     - −0.16  38 11.8" in row_of(history, "knee_rl")
    assert "✓ ok" in row_of(history, "hip_rr")
    then, now = (JointTable(history)._joint(joint) for joint in ("knee_rl", "hip_rr"))
    assert [str(span.style) for span in then.spans].count("dim") == 2, "the angle, and what stands after it"
    assert "dim" not in [str(span.style) for span in now.spans]


def test_what_nobody_reads_any_more_is_dimmed_and_says_how_long_ago_it_was(robot: RobotFolder) -> None:  # noqa: F811
    live = held()
    live.live = True
    live.wait(3.4)
    assert "unread 3 s" in row_of(live, "hip_rr"), "an engine that has come to a stop"
    left = live.left()
    left.wait(125.0)
    assert "2 min ago" in row_of(left, "hip_rr")
    assert "12 %" in row_of(left, "hip_rr")
    one = History(("hip_rr",), live=True, before=left)
    assert "last read" in row_of(one, "hip_rr")
    assert "38 11.8" in row_of(one, "knee_rl"), "of a joint that is not on the bus now"
    assert row_of(History(JOINT_NAMES), "hip_rr").split() == ["hip_rr", "·", "no", "data"]

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.session.read({"hip_rr": 0.5})
        app.session._heard -= 7.0
        app.tick()
        assert condition(app.session.history, "hip_rr").since == "7 s ago"
        app.session.read({"hip_rr": 0.6})
        assert condition(app.session.history, "hip_rr").word == "ok"
        frozen(app, a_run(robot.path.parent), 5.0)
        app.session._heard -= 7.0
        app.tick()
        assert condition(app.session.history, "hip_rr").word == "ok", "a replay that stands is not stale"

    with_program(robot.path, look)


def test_when_the_engine_dies_its_last_values_stay_and_one_can_watch_anew(tmp_path: Path) -> None:
    scenario = tmp_path / "blind.toml"
    scenario.write_text("[camera]\npresent = false\n")

    async def watch() -> None:
        app = OpenAnt(create_robot(tmp_path / "my-ant").path, virtual=str(scenario))
        async with app.run_test(size=(120, 40)) as pilot:
            await until(pilot, lambda: app.session.virtual is not None and not app.session.doing)
            await pilot.press("c")
            await until(pilot, lambda: len(app.session.history.rows) > 20)
            engine = app.session._engine
            assert engine is not None
            os.kill(engine.pid, signal.SIGKILL)
            await until(pilot, lambda: app.session.feed is None)
            assert any("the engine has ended" in fault.words for fault in app.session.faults.unseen)
            await until(pilot, lambda: " s ago" in condition(app.session.history, "hip_rr").since)
            assert np.isfinite(app.session.history.last_known("temp.hip_rr"))
            await pilot.press("escape", "c")
            await until(pilot, lambda: condition(app.session.history, "hip_rr").word == "ok")
        app.session.close()

    asyncio.run(watch())


# ---- the gap ----


def test_long_names_of_recordings_take_one_line_each_and_say_when_they_were_made(robot: RobotFolder) -> None:  # noqa: F811
    a_diagnosis(robot)
    for number in range(3):
        path = (
            robot.recordings
            / f"a-recording-whose-name-is-much-longer-than-its-list-is-wide-even-with-room-{number}.mcap"
        )
        path.parent.mkdir(exist_ok=True)
        path.touch()
        os.utime(path, (1_795_000_000 + number,) * 2)

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.action_go("gap")
        await pilot.pause()
        lines = [line.partition("│")[0].strip() for line in screen_text(app).splitlines()]
        runs = lines[lines.index("Runs") + 1 :]
        assert [line[:11] for line in runs[:6:2]] == ["[ ] a-recor"] * 3
        assert all(line.endswith("…") for line in runs[:6:2])
        assert runs[1:6:2] == ["18.11.2026 11:06 UTC"] * 3
        assert says(app, "compared: nominal.xml with stand-2, 24.11.2026 03:15 UTC")
        assert says(app, "floor 0.40 mrad: what no model could beat, by how much repeats of the same commands differ")

    with_program(robot.path, look, (120, 50))


# ---- a window that is too small ----


def test_in_too_small_a_window_only_stop_and_quit_act(robot: RobotFolder) -> None:  # noqa: F811
    async def press(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.action_go("learn")
        await pilot.pause()
        field = app.screen.query_one("#minutes", Input)
        field.focus()
        await pilot.resize_terminal(79, 24)
        screen, chosen = app.screen, app.screen.query_one("#choices", Choices).highlighted
        for key in ("1", "x", "down", "enter", "escape", "q", "f1", "f8", "ctrl+p", "ctrl+o", "ctrl+q", "tab", "space"):
            await pilot.press(key)
        await pilot.pause()
        assert app.screen is screen
        assert app.session.training is None
        assert (field.value, app.screen.query_one("#choices", Choices).highlighted) == ("60", chosen)
        assert "only Space (stop), Ctrl-C (quit) and Ctrl-Z (suspend) act" in screen_text(app)
        await pilot.resize_terminal(80, 24)
        await until(pilot, lambda: field.has_focus)
        await pilot.press("7")
        assert field.value == "7", "with room again it takes what is typed"
        await pilot.resize_terminal(80, 23)
        await pilot.press("ctrl+c")
        await until(pilot, lambda: app.return_code == 130)

    with_program(robot.path, press)


def test_a_question_that_a_small_window_hides_is_not_answered(robot: RobotFolder) -> None:  # noqa: F811
    async def press(app: OpenAnt, pilot: Pilot[int]) -> None:
        await pilot.press("b")
        await pilot.pause()
        assert "On the bench" in screen_text(app)
        await pilot.resize_terminal(60, 14)
        await pilot.pause()
        assert "Make the window larger" in screen_text(app)
        assert "Torque table" not in screen_text(app)
        await pilot.press("enter", "escape")
        await pilot.resize_terminal(80, 24)
        await pilot.pause()
        assert "Torque table" in screen_text(app)

    with_program(robot.path, press)


# ---- a virtual robot's steps ----


def test_what_was_done_on_a_virtual_robot_counts_while_one_is_in_use(robot: RobotFolder) -> None:  # noqa: F811
    keep(Finding("ids", True, "8 servos have their id", (), "", "ids"), robot, virtual=True)

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        walk = app.screen
        assert isinstance(walk, WalkScreen)
        assert "Continue my-ant · 1 of 15" in screen_text(app)
        assert "3 Motor IDs             · done, virtual" in screen_text(app)
        await pilot.press("3")
        await pilot.pause()
        assert says(app, "done on a virtual robot: it does not count for the real one")
        app.session.virtual = {}
        app.refresh_walk()
        await pilot.pause()
        assert "Continue my-ant · 2 of 15" in screen_text(app)
        assert "3 Motor IDs             ✓ ok" in screen_text(app)
        app.action_go("findings")
        await until(pilot, lambda: says(app, "UTC, ids, on a virtual robot"))

    with_program(robot.path, look)


def test_the_walk_offers_replay_by_the_key_that_opens_what_can_be_replayed(robot: RobotFolder) -> None:  # noqa: F811
    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        keys = screen_text(app).splitlines()[-1]
        assert "r Replay" in keys
        assert "All" in keys, "there is room for all of them"
        await pilot.press("r")
        await until(pilot, lambda: isinstance(app.screen, RecordingsScreen))

    with_program(robot.path, look)


# ---- what is offered ----


def test_a_diagnosis_is_offered_once_there_is_something_to_diagnose(robot: RobotFolder) -> None:  # noqa: F811
    run = robot.runs / "sac-0"
    (run / "recordings").mkdir(parents=True)
    (run / "learning_curve.csv").write_text("step,seconds,average_reward_m_s\n100,12.0,-0.023\n")

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.action_go("learn")
        await pilot.pause()
        await pilot.press("down", "d")
        await pilot.pause()
        assert "Diagnose" not in screen_text(app)
        (run / "recordings" / "a.mcap").touch()
        await pilot.press("escape")
        app.action_go("learn")
        await pilot.press("down")
        await pilot.pause()
        assert "Diagnose what sac-0 did on the robot (d)" in screen_text(app)
        assert "d Diagnose" in screen_text(app)

    with_program(robot.path, look)


# ---- F1 ----


@pytest.mark.parametrize("by", ["key", "mouse"])
def test_the_page_that_says_more_opens_from_help(robot: RobotFolder, by: str) -> None:  # noqa: F811
    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.action_go("gap")
        await pilot.pause()
        await pilot.press("f1")
        await pilot.pause()
        assert "o opens docs/gap.md" in screen_text(app)
        if by == "key":
            await pilot.press("o")
        else:
            lines = screen_text(app).splitlines()
            y = next(k for k, line in enumerate(lines) if "docs/gap.md" in line)
            await pilot.click(offset=(lines[y].index("docs/gap.md") + 2, y))
        await pilot.pause()
        heading = (DOCS / "gap.md").read_text().partition("\n")[0].removeprefix("# ")
        await until(pilot, lambda: heading in screen_text(app))
        assert sum(isinstance(screen, Help) for screen in app.screen_stack) == 2
        await pilot.press("escape", "escape")
        assert not any(isinstance(screen, Help) for screen in app.screen_stack)

    with_program(robot.path, look)


def test_where_a_program_came_without_its_pages_their_names_are_text(
    robot: RobotFolder,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.setattr("openant_tools.tui.dialogs.DOCS", tmp_path)

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        await pilot.press("f1")
        await pilot.pause()
        assert "; more in docs/bring-up.md." in screen_text(app)

    with_program(robot.path, look)


def test_every_screen_and_step_names_a_page_that_is_there() -> None:
    pages = {kind.DOC for kind, _ in SCREENS.values()} | {step_doc(step) for step in (*WALK.values(), *BESIDE.values())}
    assert [page for page in pages if not (DOCS / page).is_file()] == []
