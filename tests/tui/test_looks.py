"""How every screen reads in each of its states, one golden file a screen; and that nothing on it is cut or overlaps.

The pictures of all screens are in `test_tui.py`. A golden file is written anew by `pytest --snapshot-update`.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.segment import Segment
from syrupy.assertion import SnapshotAssertion
from syrupy.extensions.single_file import SingleFileSnapshotExtension, WriteMode
from test_tui import a_worked_folder, frozen, robot, unicode_terminal  # noqa: F401
from textual.pilot import Pilot
from textual.widget import Widget
from textual.widgets import Footer, Input, OptionList

from openant_tools.comms.ring import columns
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Event, Hands, Intent, Live, Progress, RegisterChange, Say
from openant_tools.recording.run import Run
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui import leg_map
from openant_tools.tui.app import SCREENS, OpenAnt
from openant_tools.tui.dialogs import Question
from openant_tools.tui.feeds import History
from openant_tools.tui.found import numbers_lines
from openant_tools.tui.marks import plain
from openant_tools.tui.page import Page
from openant_tools.tui.process import Process
from openant_tools.tui.screens.step import StepScreen
from openant_tools.tui.training import TrainingProcess

SIZES = [(80, 24), (120, 40)]
#: s between two drawings of the robot, here
BRIEF_S = 0.01
ALL = ["walk", *SCREENS, "step"]

#: what a procedure says and asks, each after what stands before it
SAID: Mapping[str, tuple[Event, ...]] = {
    "running": (
        Progress(0.4, "nudging hip_fr"),
        Say("one servo answers, at 57600 baud", "ok"),
        Say("its firmware is old: no fast reads", "warn"),
    ),
    "grant": (
        Intent(
            "make this XC430-W240-T (id 1, 57600 baud, firmware 46) the rear right hip",
            (
                RegisterChange("hip_rr", "id", 1, 10),
                RegisterChange("hip_rr", "baud_rate", 1, 3, "57600 → 1000000 baud"),
                *(RegisterChange(joint, "return_delay_time", 250, 0, "500 → 0 µs") for joint in JOINT_NAMES),
            ),
            moves=True,
        ),
    ),
    "number": (Ask("How long shall the legs swing? An hour finds what is rare.", unit="min", default=1.0, low=0, high=600),),
    "hands": (
        Hands("Move the rear right hip from stop to stop, twice, gently.", "turn", while_watching=True),
        Live({"hip_rr": 0.3}, "rad", "range by hand", {"hip_rr": -0.8}, {"hip_rr": 0.8}, {"hip_rr": "now to the other end"}),
    ),
    "bars": (
        Live(
            {joint: 0.1 * k - 0.4 for k, joint in enumerate(JOINT_NAMES)}, "rad", "reached so far",
            dict.fromkeys(JOINT_NAMES, -1.3), dict.fromkeys(JOINT_NAMES, 1.2), {"knee_fl": "upper stop missing"},
        ),
    ),
}  # fmt: skip

NUMBERS = (
    *(
        Evidence(
            f"residual of {joint}", 0.02 * k - 0.03, "rad", "straight legs, from the 45° grid", least=-0.1, most=0.1
        )
        for k, joint in enumerate(JOINT_NAMES)
    ),
    *(
        Evidence(f"nudge of {joint}", 0.05 + 0.01 * k, "rad", "encoder", least=0.07)
        for k, joint in enumerate(JOINT_NAMES)
    ),
    Evidence("answers lost", 0.002, "share", "500 reads at 100 Hz", 0.0, 0.0041, most=0.005),
)
FOUND = {
    "ok": Finding("estop", True, "the stop key and a killed program both leave torque off", NUMBERS[-1:], "", "estop"),
    "finding": Finding(
        "estop", False, "not every zero and direction is sure", NUMBERS, "mend what is listed and run it again", "estop",
        problems=(
            "knee_rl: +6.3° beside the grid of horn positions → was the leg straight? else its horn or gear slips",
            "hip_rr: did not follow (+2.9°) → is it blocked, or its horn screw loose?",
        ),
    ),
    "many": Finding(
        "estop", False, "nothing is as it should be", NUMBERS, "mend what is listed and run it again", "estop",
        problems=tuple(f"{joint}: is not as it should be → see to it" for joint in JOINT_NAMES),
    ),
}  # fmt: skip


class TextFile(SingleFileSnapshotExtension):
    """A golden file that reads as the screen does."""

    _file_extension = "txt"
    _write_mode = WriteMode.TEXT


#: exit codes of a command that was started on a screen
ENDED: Mapping[str, int] = {"done": 0, "stopped": 130, "failed": 1}


class Ended:
    """A process that is over."""

    def __init__(self, code: int) -> None:
        self._code = code

    def poll(self) -> int:
        return self._code


class Quiet:
    """A run of a step that does nothing."""

    def reply(self, answer: object) -> None: ...
    def end(self, why: str) -> None: ...
    def enough(self) -> None: ...


def seen(app: OpenAnt, marked: bool = False) -> str:
    """The screen line by line, without blanks at the ends; what is inverted between angles where it is `marked`."""

    def text(one: Segment) -> str:
        inverted = one.style is not None and one.style.reverse
        return f"«{one.text}»" if marked and inverted else one.text

    lines = app.screen._compositor.render_strips()
    return "\n".join("".join(map(text, line)).rstrip() for line in lines)


def held() -> History:
    """All joints, read for two seconds, torque on."""
    t = np.arange(0.0, 2.0, 0.02)
    values: dict[str, Any] = {"t": t, "torque": 1.0}
    for k, joint in enumerate(JOINT_NAMES):
        values |= {f"pos.{joint}": 0.5 * np.sin(k), f"ok.{joint}": 1.0, f"err.{joint}": 0.0, f"volt.{joint}": 11.8}
        values |= {f"temp.{joint}": 31.0 + k}
        values |= {f"cur.{joint}": 0.125 - 0.041 * k} if "knee" in joint else {f"load.{joint}": 0.12 + 0.01 * k}
    history = History(JOINT_NAMES)
    history.add(np.column_stack([np.broadcast_to(values.get(name, np.nan), t.shape) for name in columns(JOINT_NAMES)]))
    return history


async def settle(app: OpenAnt, pilot: Pilot[int]) -> None:
    await pilot.pause()
    for one in app.screen.query(Input):
        one.cursor_blink = False
    for _ in range(2):
        if isinstance(app.screen, Page):
            app.screen.draw()
        await pilot.pause(2 * BRIEF_S)


async def open_screen(name: str, app: OpenAnt, pilot: Pilot[int]) -> None:
    if name in SCREENS:
        app.action_go(name)
    elif name == "step":
        app.open_step("estop")
    await settle(app, pilot)


Look = Callable[[str], None]


async def look_at(name: str, app: OpenAnt, pilot: Pilot[int], run: Run, look: Look) -> None:
    """Bring a screen into each of its states and look at it."""
    await open_screen(name, app, pilot)
    look("as it opens")
    if isinstance(app.screen, StepScreen):
        await look_at_step(app.screen, app, pilot, look)
        return
    if name not in ("live", "settings"):
        await pilot.press("down")
        await settle(app, pilot)
        look("the next line")
    app.session.training = TrainingProcess("sac", Path("my-ant"), 30000, 0, Path("my-ant/runs/sac-0"))
    app.session.diagnosing = Process(("gap", "diagnose", "a.mcap"), Path("my-ant/gap/gap.log"))
    frozen(app, run, 10.0)
    app.session.selected = "knee_fl"
    for draw in ("draw_progress", "draw_process"):
        getattr(app.screen, draw, lambda: None)()
    await settle(app, pilot)
    look("running")
    if name in ("learn", "gap"):
        for state, code in ENDED.items():
            for process in (app.session.training, app.session.diagnosing):
                process._process = Ended(code)  # type: ignore[assignment]
            for draw in ("draw_progress", "draw_process"):
                getattr(app.screen, draw, lambda: None)()
            await settle(app, pilot)
            look(state)
    app.session.faults.note("knee_fl", "does not answer")
    app.session.faults.note("bus", "8 of 8 servos do not answer: power, first cable, or a busy computer")
    await settle(app, pilot)
    look("fault")


async def look_at_step(screen: StepScreen, app: OpenAnt, pilot: Pilot[int], look: Look) -> None:
    screen._run = Quiet()  # type: ignore[assignment]
    screen._found = None
    app.session.history = held()
    screen.offer("", [])
    for state, events in SAID.items():
        screen._pending = None
        screen.offer("", [])
        for event in events:
            screen.shown(event)
        await settle(app, pilot)
        look(state)
    app.session.faults.note("knee_fl", "does not answer")
    await settle(app, pilot)
    look("fault")
    app.session.faults.see()
    for state, finding in FOUND.items():
        screen.ended(finding, "")
        await settle(app, pilot)
        look(state)
    screen._found = None
    screen.ended(None, "the bus: nothing answered at 1000000 baud → is 12 V on, and the cable in to the click?")
    await settle(app, pilot)
    look("without a finding")


def walk_through(
    name: str, size: tuple[int, int], run: Run, look: Callable[[str, OpenAnt], None], path: str = "my-ant"
) -> None:
    async def go() -> None:
        app = OpenAnt(Path(path), ticking=False)
        async with app.run_test(size=size) as pilot:
            await look_at(name, app, pilot, run, lambda state: look(state, app))
            if isinstance(app.screen, StepScreen):
                app.screen._run = None

    asyncio.run(go())


@pytest.fixture
def worked(robot: RobotFolder, monkeypatch: pytest.MonkeyPatch) -> Run:  # noqa: F811
    run = a_worked_folder(robot, monkeypatch)
    monkeypatch.setattr(leg_map, "REST_S", BRIEF_S)
    monkeypatch.setattr(Process, "running", property(lambda self: self._process is None))
    monkeypatch.setattr(Process, "progress", "12 %  judging 400 of 3360 simulated robots")
    monkeypatch.setattr(Process, "last_words", "the bus: nothing answered at 1000000 baud → is 12 V on?")
    monkeypatch.setattr(Process, "stop", lambda self: None)
    return run


@pytest.mark.parametrize("name", ALL)
def test_every_state_of_a_screen_reads_as_it_did(
    name: str, worked: Run, snapshot: SnapshotAssertion, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shown, wrong = list[str](), list[str]()

    def look(state: str, app: OpenAnt) -> None:
        wrong.extend(f"{state}: {words}" for words in faults_of(app, SIZES[0]))
        shown.append(f"==== {state}\n{seen(app, 'no colour' in state)}")

    walk_through(name, SIZES[0], worked, look)

    async def once(state: str, path: str) -> None:
        app = OpenAnt(Path(path), ticking=False)
        async with app.run_test(size=SIZES[0]) as pilot:
            await settle(app, pilot)
            if name != "step" or path == "my-ant":
                await open_screen(name, app, pilot)
            else:
                app.open_step("estop")
                await pilot.pause(2 * BRIEF_S)
            look(state, app)

    (tmp_path / "empty").mkdir()
    asyncio.run(once("empty", str(Path("empty"))))
    monkeypatch.setenv("NO_COLOR", "1")
    asyncio.run(once("no colour", "my-ant"))
    monkeypatch.delenv("NO_COLOR")
    plain(True)
    asyncio.run(once("ASCII", "my-ant"))
    assert all(ord(character) < 127 for character in shown[-1].split("\n", 1)[1]), "ASCII is ASCII"
    assert "\n".join(shown) + "\n" == snapshot(extension_class=TextFile)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(("size", "ascii_only"), [(SIZES[1], False), (SIZES[0], True)], ids=["120x40", "ASCII"])
@pytest.mark.parametrize("name", ALL)
def test_nothing_is_cut_and_nothing_overlaps(name: str, size: tuple[int, int], ascii_only: bool, worked: Run) -> None:
    plain(ascii_only)
    wrong = list[str]()

    def look(state: str, app: OpenAnt) -> None:
        strange = {character for character in seen(app) if ord(character) > 126} if ascii_only else ()
        wrong.extend([f"{state}: {strange}"] if strange else [])
        wrong.extend(f"{state}: {words}" for words in faults_of(app, size))

    walk_through(name, size, worked, look)
    assert not wrong, "\n".join(wrong)


def faults_of(app: OpenAnt, size: tuple[int, int]) -> list[str]:
    """What of the widgets that are shown does not lie on the screen, lies on another, or has no room for its words."""
    shown = [
        one for one in app.screen.walk_children(Widget) if one.display and one.region.area and not list(one.children)
    ]
    stop = "[SPACE: STOP]" if plain() else "SPACE: STOP"
    out = [] if stop in seen(app).splitlines()[0] or len(app.screen_stack) > 2 else ["no stop key"]
    for one in shown:
        inside = scrolled(one)
        x, y = one.region.right, one.region.bottom
        if not inside and (one.region.x < 0 or one.region.y < 0 or x > size[0] or y > size[1]):
            out.append(f"{one} is not on the screen: {one.region}")
        if isinstance(one, OptionList) or inside or isinstance(one, Footer):
            continue  # these scroll
        room = one.region.size
        if one.virtual_size.height > room.height or one.virtual_size.width > room.width:
            out.append(f"{one} is cut: {one.virtual_size} in {room}")
    fixed = [one for one in shown if not scrolled(one)]
    out += [
        f"{a} and {b} overlap" for a, b in combinations(fixed, 2) if a.region.overlaps(b.region) and not within(a, b)
    ]
    return out


def scrolled(one: Widget) -> bool:
    """Whether it lies in something that scrolls."""
    return any(getattr(above, "allow_vertical_scroll", False) for above in one.ancestors if isinstance(above, Widget))


def within(a: Widget, b: Widget) -> bool:
    return a in b.ancestors or b in a.ancestors


@pytest.mark.parametrize("ascii_only", [False, True], ids=["colour", "ASCII"])
def test_dialogs_read_as_they_did(ascii_only: bool, worked: Run, snapshot: SnapshotAssertion) -> None:
    plain(ascii_only)
    shown = list[str]()

    async def look() -> None:
        app = OpenAnt(Path("my-ant"), ticking=False)
        async with app.run_test(size=SIZES[0]) as pilot:
            for key in ("f1", "ctrl+o"):
                await pilot.press(key)
                await settle(app, pilot)
                shown.append(f"==== {key}\n{seen(app)}")
                assert not faults_of(app, SIZES[0])
                await pilot.press("escape")
                await settle(app, pilot)
            app.push_screen(Question("Is it on the floor, its cables untangled?", "Yes, train", "No"))
            await settle(app, pilot)
            shown.append(f"==== a question\n{seen(app)}")

    asyncio.run(look())
    assert "\n".join(shown) + "\n" == snapshot(extension_class=TextFile)


@pytest.mark.parametrize("ascii_only", [False, True])
def test_too_small_a_window_has_the_verdict_the_stop_key_and_what_to_do(worked: Run, ascii_only: bool) -> None:
    plain(ascii_only)

    async def look() -> str:
        app = OpenAnt(Path("my-ant"), ticking=False)
        async with app.run_test(size=(60, 14)) as pilot:
            await open_screen("step", app, pilot)
            return seen(app)

    text = asyncio.run(look())
    assert "SPACE: STOP" in text
    assert "torque stays on: do not go on" in text
    assert "Make the window larger: 80 columns and 24 lines at least." in text
    assert text.isascii() or not ascii_only
    assert json.dumps(text)  # one line of the screen is one line here


def test_of_numbers_that_read_alike_none_is_marked_as_the_worst() -> None:
    alike, other = (
        tuple(Evidence(f"off the grid of {joint}", k * step, "rad", "encoder") for k, joint in enumerate(JOINT_NAMES))
        for step in (1e-6, 1e-2)
    )
    for evidence, marked in ((alike, False), (other, True)):
        lines = numbers_lines(Finding("zeros", True, "zeros", evidence, "", "zeros"))
        assert any("the largest of its column" in line.plain for line in lines) == marked


@pytest.mark.parametrize("width", [52, 76, 92])
def test_an_interval_widens_no_row_beyond_the_page(width: int) -> None:
    evidence = (
        Evidence("distance by size over distance by height", 1.0, "1", "robot lying on the floor"),
        Evidence("camera angle over gyro angle", 0.9959, "1", "the same motion", 0.9945, 0.9973),
    )
    lines = [line.plain for line in numbers_lines(Finding("arena", True, "arena", evidence, "", "arena"), width)]
    assert max(map(len, lines)) <= width
    assert "(0.9945 to 0.9973)" in " ".join(lines)
    assert next(line for line in lines if "distance by size" in line).split()[-1] != "height"
