"""The bench by the screens of the terminal program: each of its procedures by itself, on a virtual robot's ports."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path

import pytest
import walker
from builder import COARSE
from walker import Reply, Walker

from openant_tools.bringup.walk import BENCH
from openant_tools.comms.clock import VirtualControl
from openant_tools.procedure.finding import Finding, latest
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.tui.dialogs import Question
from openant_tools.tui.screens.step import StepScreen
from openant_tools.virtual.process import virtual_robot

SIZE = (80, 24)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mapping[str, str | None]]:
    """A healthy robot on its stand, in stepped time."""
    scenario = tmp_path_factory.mktemp("bench") / "stand.toml"
    scenario.write_text(f'{COARSE}setup = "stand"\npose = "home"\n[camera]\npresent = false\n')
    with virtual_robot(str(scenario), clock="stepped", camera=False) as found:
        yield found


@pytest.fixture
def folder(tmp_path: Path) -> RobotFolder:
    return create_robot(tmp_path / "my-ant")


def walk(
    folder: RobotFolder,
    robot: Mapping[str, str | None] | None,
    steps: Callable[[Walker], Awaitable[None]],
    replies: Mapping[str, Reply] | None = None,
) -> str:
    """Let a builder use the program; all that it said."""
    return walker.walk(folder.path, robot, steps, replies, size=SIZE)


def torque_is_on(robot: Mapping[str, str | None]) -> bool:
    control = VirtualControl(str(robot["control"]))
    try:
        return any(control.ask("state")["torque_enable"].values())
    finally:
        control.close()


def do(name: str) -> Callable[[Walker], Awaitable[None]]:
    async def steps(walker: Walker) -> None:
        await walker.do(name)

    return steps


def found(folder: RobotFolder, name: str) -> Finding:
    finding = latest(folder, name)
    assert finding is not None
    return finding


def test_the_bench_is_a_line_of_the_first_screen_and_each_of_its_procedures_a_screen(folder: RobotFolder) -> None:
    async def look(walker: Walker) -> None:
        for number, step in enumerate(BENCH.values()):
            walker.press("b")
            await walker.until(lambda: isinstance(walker.app.screen, Question))
            walker.press(*["down"] * number, "enter")
            await walker.until(lambda: isinstance(walker.app.screen, StepScreen) and bool(walker.screen.choices))
            assert walker.screen.step is step
            assert step.title in walker.screen.about
            await walker.choose("Back to the walk")

    walk(folder, None, look)


def test_the_torque_table_needs_no_robot_and_shows_what_is_allowed(folder: RobotFolder) -> None:
    walk(folder, None, do("knee-torque"), {"weigh": "3.9"})
    finding = found(folder, "knee-torque")
    assert finding.verdict == "not ok"
    assert "knees give way" in finding.what
    assert [one.outside for one in finding.evidence if one.wanted].count(True) > 0


def test_a_virtual_builder_holds_the_foot_and_types_grams(folder: RobotFolder, robot: Mapping[str, str | None]) -> None:
    weights = iter(("many", "0", "190", "380", "570", "760", "950"))

    async def weigh(walker: Walker) -> str | None:
        return next(weights)

    said = walk(
        folder, robot, do("stiffness"),
        {"Whose": "knee_fl", "hold the foot": "a kitchen scale", "what does the scale show": weigh},
    )  # fmt: skip
    assert "'many' is no number of grams" in said
    finding = found(folder, "stiffness")
    assert [w["grams"] for w in finding.data["weighings"]] == [0, 190, 380, 570, 760, 950]
    assert "the P divisor is 128" in finding.what
    assert "bench.scale_stiffness.knee_fl" in folder.config().provenance
    assert not torque_is_on(robot)


def test_the_stop_key_at_the_scale_lets_go(folder: RobotFolder, robot: Mapping[str, str | None]) -> None:
    async def stop(walker: Walker) -> str | None:
        assert torque_is_on(robot)
        return await walker.stop()

    said = walk(folder, robot, do("stiffness"), {"hold the foot": "something that", "Slide something": stop})
    assert "STOP" in said
    assert latest(folder, "stiffness") is None
    assert not torque_is_on(robot)


def test_the_plates_angle_is_read_by_the_robot_until_enter(
    folder: RobotFolder, robot: Mapping[str, str | None]
) -> None:
    async def tilt(walker: Walker) -> None:
        walk = asyncio.create_task(walker.do("floor-friction"))
        while not walk.done():
            screen = walker.app.screen
            live = screen._live if isinstance(screen, StepScreen) else None
            if live is not None and live.values["plate"] > 0.53:  # it slides
                walker.press("enter")
            await asyncio.sleep(0.05)
        await walk

    walk(folder, robot, tilt, {"How often": "1"})
    finding = found(folder, "floor-friction")
    assert finding.unsure  # one reading has no interval
    assert finding.evidence[0].value == pytest.approx(0.6, abs=0.05)
    assert not torque_is_on(robot)


def test_angles_of_a_protractor_are_typed_in_degrees(folder: RobotFolder) -> None:
    angles = iter(("31", "30.5", "31.5", "0", "0"))

    async def read(walker: Walker) -> str | None:
        return next(angles)

    walk(folder, None, do("floor-friction"), {"What reads": "a protractor", "At which angle": read})
    assert found(folder, "floor-friction").parameters[0].value == pytest.approx(0.601, abs=0.001)
