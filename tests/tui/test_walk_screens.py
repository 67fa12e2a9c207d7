"""The walk by the screens of the terminal program, from loose motors; and the mistakes that builders make on the way."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import walker
from builder import COARSE, RUBS, SMALL_PICTURES, coarsen
from walker import AGAIN, BY_ITSELF, Reply, Walker

from openant_tools.bringup.persistent_robot import persistent_robot
from openant_tools.bringup.walk import WALK, do, standing
from openant_tools.cli import main
from openant_tools.comms.clock import VirtualControl
from openant_tools.procedure.finding import Finding
from openant_tools.procedure.journal import Journal
from openant_tools.procedure.step import Step
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.screens.walk import WalkScreen
from openant_tools.virtual.process import VIRTUAL_DEFAULT, virtual_robot

pytestmark = pytest.mark.usefixtures("quarter_rate")
WIDE = (120, 40)
BLIND = "[camera]\npresent = false\n"


@dataclass
class Robot:
    """A virtual robot in stepped time, in a process of its own, and the folder that its builder keeps."""

    folder: RobotFolder
    addresses: Mapping[str, str | None]
    memory: Path

    def __post_init__(self) -> None:
        self.remote = VirtualControl(str(self.addresses["control"]))

    def torque(self) -> list[bool]:
        return [bool(on) for on in self.remote.ask("state")["torque_enable"].values()]

    def ids(self) -> dict[str, int]:
        return dict(self.remote.ask("state")["id"])

    def truth(self) -> object:
        """What nobody may change unasked: torque, and the permanent memory of every servo."""
        return self.torque(), self.memory.read_text() if self.memory.is_file() else ""

    def walk(self, steps: Callable[[Walker], Awaitable[None]], replies: Mapping[str, Reply] | None = None) -> str:
        """Let a builder walk with the terminal program; all that it said. Torque is off when it has been left."""
        said = walker.walk(self.folder.path, self.addresses, steps, replies, size=WIDE, truth=self.truth)
        assert not any(self.torque())
        return said

    def plug(self, *joints: str) -> Callable[[Walker], Awaitable[str | None]]:
        """A builder's own hands, which plug these in and say that it is done."""

        async def hands(walker: Walker) -> str | None:
            for joint in joints:
                self.remote.ask("plug", joint=joint)
            return BY_ITSELF

        return hands


@contextlib.contextmanager
def robot(folder: Path, scenario: str) -> Iterator[Robot]:
    """The robot of a scenario; what its servos remember stands in a file."""
    memory, path = folder / "memory.json", folder / "scenario.toml"
    path.write_text(scenario.replace("[robot]\n", f"{COARSE}eeprom = {json.dumps(str(memory))}\n", 1))
    with virtual_robot(str(path), clock="stepped") as found:
        one = Robot(create_robot(folder / "my-ant"), found, memory)
        yield one
        one.remote.close()


def steps(*names: str) -> Callable[[Walker], Awaitable[None]]:
    """Walk these steps, each from the first screen, and back to it."""

    async def walk(walker: Walker) -> None:
        for name in names:
            await walker.do(name)
            await walker.choose("Back to the walk")

    return walk


# ---- mistakes at the bench ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loose(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """Eight motors in their boxes."""
    with robot(tmp_path_factory.mktemp("loose"), f'[robot]\nsetup = "loose"\n{BLIND}') as ant:
        yield ant


@pytest.fixture
def box(loose: Robot) -> Iterator[Robot]:
    """The same; nothing is plugged in when a test begins."""
    for joint in JOINT_NAMES:
        loose.remote.ask("unplug", joint=joint)
    return loose


def only(*joints: str) -> Callable[[Walker], Awaitable[None]]:
    """The step Motor IDs, which is left once it asks for a joint that is none of these."""

    async def walk(walker: Walker) -> None:
        last = JOINT_NAMES[JOINT_NAMES.index(joints[-1]) + 1]

        walker.replies[f"({last})"] = Walker.stop
        await walker.do("ids")

    return walk


def test_two_motors_the_wrong_model_and_a_cable_that_comes_out(box: Robot) -> None:
    tried = iter([box.plug("hip_rr", "hip_fr"), box.plug("knee_rr"), None, None])

    async def plug(walker: Walker) -> str | None:
        hands = next(tried)
        return await hands(walker) if hands is not None else None

    pulled = []

    async def pull_the_cable(walker: Walker) -> str | None:
        if not pulled:
            pulled.append(box.remote.ask("unplug", joint="hip_rr"))
        return None

    async def walk(walker: Walker) -> None:
        before = box.truth()
        await walker.do("ids")
        assert "hip_rr (id 1) does not answer at 57600 baud" in walker.said
        assert box.truth() == before
        assert not list(box.folder.findings.glob("ids-*"))
        box.remote.ask("unplug", joint="hip_rr")
        await walker.begin(AGAIN)

    replies = {
        "(hip_rr)": plug,
        "two servos answer at once": "try again",
        "this is a XM430-W350-T": "try again",
        "make this XC430-W240-T": pull_the_cable,
        "(knee_rr)": Walker.stop,
    }
    said = box.walk(walk, replies)
    assert "hip_rr: two servos answer at once under id 1 → unplug all but one" in said
    assert "this is a XM430-W350-T, but the place is for a XC430-W240-T → it belongs into a knee" in said
    assert box.ids()["hip_rr"] == 10
    assert box.ids()["knee_rr"] == 1
    assert {entry.write.joint for entry in Journal(box.folder.journal).open_entries()} == {"hip_rr"}


def test_the_terminal_closed_in_mid_step_and_opened_again_goes_on_where_it_was(box: Robot) -> None:
    """hip_rr has its id by now; what was written stands in the journal, and the step is still to be done."""

    class Closed(Exception):
        pass

    async def close(walker: Walker) -> None:
        raise Closed

    with pytest.raises(Closed):
        box.walk(steps("ids"), {"make this XM430-W350-T": close})
    assert not any(box.torque())
    assert box.ids()["knee_rr"] == 1

    async def look(walker: Walker) -> None:
        assert isinstance(walker.app.screen, WalkScreen)
        assert standing(box.folder)["ids"].state == "todo"

    box.walk(look)


# ---- mistakes of building ------------------------------------------------------------------------------------------------


def test_what_was_built_wrong_is_named_on_the_screen_and_taken_into_account(tmp_path: Path) -> None:
    """A horn on the wrong spline, ids exchanged, a mirrored mount, and a cable that is out."""
    built = """[robot]
setup = "stand"
[[servo]]
joint = "knee_rr"
spline_offset = 1
[[servo]]
joint = "hip_rr"
id = 20
[[servo]]
joint = "hip_fr"
id = 10
reversed = true
"""
    with robot(tmp_path, built + BLIND) as ant:
        ant.remote.ask("unplug", joint="knee_fl")

        async def walk(walker: Walker) -> None:
            await walker.do("inventory")
            assert "look at the cable between hip_fl and knee_fl" in walker.said
            ant.remote.ask("plug", joint="knee_fl")
            ant.remote.ask("advance", to=ant.remote.ask("now")["t"] + 1.0)
            await walker.begin(AGAIN)
            await walker.choose("Next: Zeros and directions")
            await walker.begin()

        said = ant.walk(walk)
        assert "hip_rr was moved, but the servo with the id of hip_fr turned" in said
        assert "hip_fr and hip_rr are swapped" in said
        assert "knee_rr: its horn is on the wrong spline, 1 × 45° beyond" in said
        assert "hip_fr: reversed, its servo turns backwards" in said
        motors = ant.folder.config().motors
        assert (motors["hip_rr"].id, motors["hip_fr"].id, motors["hip_fr"].direction) == (20, 10, -1)
        assert motors["knee_rr"].zero_offset_rad == pytest.approx(math.pi * 5 / 4, abs=0.01)
        assert standing(ant.folder)["zeros"].state == "ok"


@pytest.mark.slow
def test_a_tag_of_another_size_is_named_on_the_screen(tmp_path: Path, brisk: None) -> None:
    with robot(tmp_path, f'[robot]\nsetup = "stand"\n{SMALL_PICTURES}\n[camera.body]\nsize = 0.03\n') as ant:
        said = ant.walk(steps("arena"))
        assert "the body's tag is declared 45 mm, but everything fits only if its edge is about 30 mm" in said
        assert standing(ant.folder)["arena"].state == "failed"


# ---- the whole walk ------------------------------------------------------------------------------------------------------


@pytest.mark.minutes
@pytest.mark.timeout(1800)
def test_the_whole_walk_from_loose_motors_to_the_passport_and_on_to_learning(
    tmp_path: Path, brisk: None, sweeping: None, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """By the command from the box to the built legs, where Ctrl-C ends it; from there by the screens; then it learns."""
    folder, given, report = tmp_path / "ant", tmp_path / "box.toml", tmp_path / "walk.json"
    left = '[[servo]]\njoint = "hip_fl"\nbaud = 4500000\n'  # somebody has played with one motor
    given.write_text(f'{COARSE}setup = "loose"\n[clock]\ndoze = true\n{SMALL_PICTURES}{RUBS}{left}')

    def bringup(source: str) -> tuple[object, str]:
        with pytest.raises(SystemExit) as end:  # in this process, where motions can be short
            main(["bringup", "--virtual", source, "--robot", str(folder), "--yes", "--json", str(report)])
        return end.value.code, "".join(capfd.readouterr())

    def interrupted(step: Step, *rest: Any) -> Finding:
        if step.name == "inventory":
            raise KeyboardInterrupt
        return do(step, *rest)

    with monkeypatch.context() as at_the_keyboard:
        at_the_keyboard.setattr("openant_tools.bringup.walk.do", interrupted)
        code, words = bringup(str(given))
    assert code == 130, words[-4000:]
    assert "id 1, 4500000 baud" in words
    assert "8 of 8 servos have their id, read back" in words
    names = list(WALK)
    built, rest = names[: names.index("inventory")], names[names.index("inventory") :]
    states = {name: now.state for name, now in standing(RobotFolder.at(folder)).items()}
    assert states == dict.fromkeys(built, "ok") | dict.fromkeys(rest, "todo"), words[-4000:]

    coarsen(folder / "nominal.xml")
    said = dict[str, str]()

    async def walk(walker: Walker) -> None:
        said["inventory"] = await walker.do("inventory")
        for name in rest[1:]:
            await walker.choose(f"Next: {WALK[name].title}")
            said[name] = await walker.begin()

    with persistent_robot(VIRTUAL_DEFAULT, folder) as box:  # what was written to its servos is still there
        box.builder.resume(assembled=True)
        addresses = {"bus": box.bus, "imu": box.imu, "camera": box.camera, "control": box.control}
        ant = Robot(RobotFolder.at(folder), addresses, folder / "virtual-eeprom.json")
        ant.walk(walk, {"while the legs swing. For how long?": "0.1", "Soak for how long?": "0.3"})
        ant.remote.close()
    states = {name: now.state for name, now in standing(ant.folder).items()}
    failed = [name for name, state in states.items() if state != "ok"]
    assert not failed, "\n".join(f"{name} {states[name]}: {said.get(name, '')[-3000:]}" for name in failed)
    for name in ("robot.toml", "calibrated.xml", "journal.jsonl", "passport.html", "passport.md"):
        assert (folder / name).is_file()
    config = ant.folder.config()
    assert config.model == "calibrated.xml"
    assert config.arena.centre_m == pytest.approx((0.75, -0.30), abs=0.03)
    assert len(Journal(ant.folder.journal).open_entries()) >= 24
    page = (folder / "passport.md").read_text()
    assert "no" not in {cell.strip() for line in page.splitlines() for cell in line.split("|")}

    code, words = bringup("default")
    assert code == 0, words[-4000:]
    assert "1/15" not in words, "what stands is not done again"
    walked = json.loads(report.read_text())
    assert walked["ok"]
    assert {now["state"] for now in walked["steps"].values()} == {"ok"}
    pytest.importorskip("torch")
    # On the bus a step takes the bus's time: enough of them to see that it walks, records and learns from this folder. (The
    # demo learns in the simulation of one.)
    command = [sys.executable, "-m", "openant_tools.cli", "train", "sac", "--robot", str(folder)]
    floor = tmp_path / "floor.toml"
    floor.write_text(f'{COARSE}setup = "floor"\n[clock]\nmode = "stepped"\n{SMALL_PICTURES}')
    how = [
        "--steps",
        "10",
        "--learn",
        "sync",
        "--env",
        "hardware",
        "--virtual",
        str(floor),
        "--yes",
        "--out",
        str(folder / "runs" / "virtual"),
    ]
    trained = subprocess.run([*command, *how], capture_output=True, text=True, check=False)
    assert trained.returncode == 0, trained.stderr[-2000:]
    assert (folder / "runs" / "virtual" / "learning_curve.csv").is_file()
