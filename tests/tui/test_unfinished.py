"""A walk that is taken up again: the robot's folder that lies here, a step that was left in the middle, a step by its number."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path

from rich.color import Color
from test_tui import screen_text, until
from textual.pilot import Pilot

from openant_tools.bringup.walk import standing
from openant_tools.procedure.finding import Evidence, Finding, keep
from openant_tools.procedure.step import Bench
from openant_tools.procedure.unfinished import Parts, unfinished
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.app import OpenAnt
from openant_tools.tui.dialogs import Question
from openant_tools.tui.page import STOP_STYLE
from openant_tools.tui.screens.step import StepScreen
from openant_tools.tui.screens.walk import WalkList, continues


def built_so_far(path: Path, *steps: str) -> RobotFolder:
    folder = create_robot(path)
    for step in steps:
        keep(Finding(step, True, "as it should be", (Evidence("reads", 8.0, "", "bus"),), "", step), folder)
    return folder


def with_program(path: Path, do: Callable[[OpenAnt, Pilot[int]], Awaitable[None]]) -> None:
    async def run() -> None:
        app = OpenAnt(path, ticking=False)
        try:
            async with app.run_test(size=(80, 24)) as pilot:
                await pilot.pause()
                await do(app, pilot)
        finally:
            app.session.close()

    asyncio.run(run())


def test_the_one_robot_that_lies_here_goes_on_with_the_cursor_on_its_next_step(tmp_path: Path) -> None:
    built_so_far(tmp_path / "my-ant", "connect", "estop")

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        await until(pilot, lambda: "Continue my-ant · 2 of 15 · next: Motor IDs" in screen_text(app))
        option = app.screen.query_one(WalkList).highlighted_option
        assert option is not None
        assert option.id == "ids"

    with_program(tmp_path, look)


def test_from_a_step_that_was_done_the_cursor_goes_on_to_the_next(tmp_path: Path) -> None:
    folder = built_so_far(tmp_path / "my-ant", "connect", "estop")

    async def do(app: OpenAnt, pilot: Pilot[int]) -> None:
        for done, following in ((False, "ids"), (True, "centre")):
            await pilot.press("3", "enter")
            await until(pilot, lambda: isinstance(app.screen, StepScreen))
            keep(Finding("ids", done, "as it is", (), "", "ids", problems=() if done else ("so",)), folder)
            await pilot.press("escape")
            option = app.screen.query_one(WalkList).highlighted_option
            assert option is not None
            assert option.id == following

    with_program(folder.path, do)


def test_the_virtual_robot_of_a_walk_is_offered_as_far_as_it_is_built(tmp_path: Path) -> None:
    steps = ("connect", "estop", "ids", "centre", "legs")
    for built, words in (
        (steps[:4], "Loose motors in their box"),
        (steps, "The robot of this walk, built, on its stand"),
    ):
        folder = built_so_far(tmp_path / f"ant-{len(built)}", *built)

        async def ask(app: OpenAnt, pilot: Pilot[int], words: str = words) -> None:
            await pilot.press("v")
            await until(pilot, lambda: "Which virtual robot?" in screen_text(app))
            assert words in screen_text(app)

        with_program(folder.path, ask)


def test_of_several_robots_one_is_chosen_and_a_kit_never_opens_another_kits_robot(tmp_path: Path) -> None:
    built_so_far(tmp_path / "my-ant", "connect")
    built_so_far(tmp_path / "older")
    before = (tmp_path / "my-ant" / "robot.toml").read_bytes()

    async def choose(app: OpenAnt, pilot: Pilot[int]) -> None:
        await until(pilot, lambda: "Continue my-ant · 1 of 15 · next: Emergency stop" in screen_text(app))
        assert isinstance(app.screen, Question)
        said = screen_text(app)
        assert "Continue older · 0 of 15 · next: Connect" in said
        assert "none here yet" not in said
        await pilot.press("down", "down", "down", "enter")  # a new one, of the Lite kit
        await until(pilot, lambda: "Continue my-ant-2 · 0 of 15" in screen_text(app))
        assert app.session.path == tmp_path / "my-ant-2"

    with_program(tmp_path, choose)
    assert (tmp_path / "my-ant" / "robot.toml").read_bytes() == before
    assert 'kit = "lite"' in (tmp_path / "my-ant-2" / "robot.toml").read_text()


def test_what_a_step_had_done_when_it_was_left_is_said_and_offered_to_go_on_with(tmp_path: Path) -> None:
    folder = built_so_far(tmp_path / "my-ant", "connect", "estop", "ids")
    parts = Parts(Bench(folder), "centre", JOINT_NAMES)
    for joint in JOINT_NAMES[:4]:
        parts.done(joint, off_rad=0.01)
    assert continues(folder) == "Continue my-ant · 3 of 15 · next: Centring, at 5 of 8"
    assert Parts(Bench(folder), "centre", JOINT_NAMES).words.startswith("it goes on at 5 of 8: hip_rr, knee_rr,")
    assert not Parts(Bench(folder), "centre", ["hip_rr"], ("hip_rr",)).before  # who names a joint wants it again

    async def look(app: OpenAnt, pilot: Pilot[int]) -> None:
        await until(pilot, lambda: "4 of 8 done" in screen_text(app))
        app.open_step("centre")
        await until(pilot, lambda: "Begin from the first" in screen_text(app))
        screen = app.screen
        assert isinstance(screen, StepScreen)
        words = [choice.words for choice in screen.choices]
        assert words == ["Go on at 5 of 8: hip_fl", "Begin from the first", "Back to the walk"]

    with_program(folder.path, look)
    # The real robot goes on where it was left itself, whatever a virtual one did since.
    Parts(Bench(folder, control="a virtual robot's"), "centre", JOINT_NAMES).done("hip_rr")
    assert standing(folder, real=True)["centre"].left == unfinished(folder, "centre", virtual=False)
    one, four = (unfinished(folder, "centre", virtual=virtual) for virtual in (True, False))
    assert one is not None
    assert four is not None
    assert (one.words, four.words) == ("1 of 8", "4 of 8")
    keep(Finding("centre", True, "8 of 8 horns are on", (), "", "x"), folder, virtual=True)
    assert standing(folder, real=True)["centre"].left == four
    keep(Finding("centre", True, "8 of 8 horns are on", (), "", "x"), folder)
    assert unfinished(folder, "centre", virtual=False) is None
    assert standing(folder)["centre"].left is None


def test_a_note_that_is_none_is_no_note(tmp_path: Path) -> None:
    folder = create_robot(tmp_path / "my-ant")
    path = folder.path / "unfinished" / "ids.json"
    path.parent.mkdir()
    good = {"schema": "openant.unfinished/1", "date": "2026-11-20T09:30:00+00:00", "of": ["a", "b"], "done": {"a": {}}}
    for text in ("", "[]", '{"schema": 3}', json.dumps({**good, "done": 3}), json.dumps({**good, "of": ["a"]})):
        path.write_text(text)
        assert unfinished(folder, "ids", virtual=False) is None
    path.write_text(json.dumps(good))
    left = unfinished(folder, "ids", virtual=False)
    assert left is not None
    assert (left.next, left.words) == ("b", "1 of 2")


def test_a_steps_number_and_enter_open_it_and_never_while_one_types(tmp_path: Path) -> None:
    folder = built_so_far(tmp_path / "my-ant")

    async def jump(app: OpenAnt, pilot: Pilot[int]) -> None:
        await pilot.press("1", "3")
        option = app.screen.query_one(WalkList).highlighted_option
        assert option is not None
        assert option.id == "identify"
        await pilot.press("enter")
        await until(pilot, lambda: isinstance(app.screen, StepScreen) and app.screen.step.name == "identify")
        await pilot.press("4")
        await until(pilot, lambda: "4 Centring: Enter opens it" in screen_text(app))
        await pilot.press("enter")
        await until(pilot, lambda: isinstance(app.screen, StepScreen) and app.screen.step.name == "centre")
        assert "Enter opens it" not in screen_text(app), "it is said as long as it holds"
        await pilot.press("f1")
        await until(pilot, lambda: "Horn: the disc on the servo's shaft" in screen_text(app))
        await pilot.press("escape", "escape")
        app.action_go("learn")
        await pilot.pause()
        field = app.screen.query_one("#seed")
        field.focus()
        await pilot.press("4", "enter")
        await pilot.pause()
        assert not isinstance(app.screen, StepScreen)

    with_program(folder.path, jump)


def test_who_holds_a_robot_is_asked_before_the_program_ends(tmp_path: Path) -> None:
    folder = built_so_far(tmp_path / "my-ant")

    async def leave(app: OpenAnt, pilot: Pilot[int]) -> None:
        app.session.virtual = {"bus": None}
        await pilot.press("escape")
        await until(pilot, lambda: isinstance(app.screen, Question))
        await pilot.press("escape")
        assert app.is_running
        app.session.virtual = None

    with_program(folder.path, leave)


def test_the_stop_key_is_the_brightest_thing_with_and_without_colour() -> None:
    ground = STOP_STYLE.split(" on ")[1]
    red, green, blue = Color.parse(ground).triplet or (0, 0, 0)
    assert 0.299 * red + 0.587 * green + 0.114 * blue > 210  # of 255; the theme's text is at 230, in thin strokes on 20
