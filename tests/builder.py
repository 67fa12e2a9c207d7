"""A builder at a virtual robot: a face that grants and answers, and hands that do what they are asked, or almost."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import pytest
from readable import unreadable

from openant_tools.bringup.simulated_builder import SimulatedBuilder
from openant_tools.calib import wires
from openant_tools.comms.setup import config_of_robot
from openant_tools.procedure.finding import Finding
from openant_tools.procedure.step import (
    Answer,
    Ask,
    Bench,
    Drawing,
    Event,
    Hands,
    Intent,
    Live,
    Procedure,
    Progress,
    Say,
    drive,
)  # fmt: skip
from openant_tools.robot.folder import RobotFolder, create_robot
from openant_tools.virtual.scenario import parse_scenario
from openant_tools.virtual.server import Server
from openant_tools.virtual.start import assemble

#: of a scenario: pictures small enough that a test need not wait for them
SMALL_PICTURES = "[camera]\nwidth = 640\nheight = 480\nfps = 15\n"
#: s, of mechanics that a procedure watches, none of whose figures hang on them: twice as coarse as elsewhere
COARSE_STEP_S = 0.002
#: of a scenario: the same; what belongs to the robot may follow
COARSE = f"[robot]\nstep_s = {COARSE_STEP_S}\n"
#: of a scenario: servos that rub enough for a calibration to be worth it, whatever noise there is
RUBS = "[motor]\ncoulomb_nm = 0.09\n"


T = TypeVar("T")


def finished(steps: Generator[Any, Any, T], said: list[str] | None = None) -> T:
    """The result of something that asks nothing; what it says meanwhile goes to `said`."""
    while True:
        try:
            event = next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
        if said is not None and isinstance(event, Say):
            said.append(event.words)


@contextlib.contextmanager
def engine_rate(rate_hz: float) -> Iterator[None]:
    """The engine of calibration goes round so many times a second: fewer packets than at 100, and every motion as long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wires, "config_of_robot", functools.partial(config_of_robot, rate_hz=rate_hz))
        yield


def coarsen(model: Path) -> None:
    """Let a nominal model take the steps of a coarse robot, to which it is to be fitted."""
    model.write_text(model.read_text().replace('timestep="0.001"', f'timestep="{COARSE_STEP_S}"', 1))


class Builder:
    """Grants, takes defaults unless told otherwise, and remembers every word.

    Args:
        answers: a part of a question → the answer to it.
        before: called before each event is answered; may raise, or do something to the robot.
    """

    def __init__(
        self,
        control: str,
        answers: Mapping[str, Answer] | None = None,
        mistakes: Mapping[str, str] | None = None,
        before: Callable[[Event], None] | None = None,
    ) -> None:
        self.hands = SimulatedBuilder(control, mistakes)
        self.answers, self.before = dict(answers or {}), before
        self.events = list[Event]()

    def answer(self, event: Event) -> Answer:
        self.events.append(event)
        if self.before is not None:
            self.before(event)
        match event:
            case Intent():
                return True
            case Hands():
                self.hands.do(event)
                return True
            case Ask():
                return next((a for part, a in self.answers.items() if part in event.question), event.default)
        return None

    @property
    def said(self) -> str:
        """Everything that was shown, one line an event."""
        words = []
        for event in self.events:
            match event:
                case Say() | Intent() | Hands() | Progress() | Drawing() | Live():
                    words.append(event.words)
                case Ask():
                    words.append(event.question)
        return "\n".join(words)

    @property
    def granted(self) -> list[str]:
        """Every register change that was granted, in words."""
        return [str(change) for event in self.events if isinstance(event, Intent) for change in event.registers]


class Robot:
    """A served virtual robot and the folder that a builder keeps for it."""

    def __init__(self, server: Server, folder: RobotFolder) -> None:
        self.server, self.folder = server, folder
        found = server.addresses
        self.control = str(found["control"])
        self.bench = Bench(folder, str(found["bus"]), str(found["imu"]), found["camera"], self.control)

    def builder(self, **more: Any) -> Builder:
        return Builder(self.control, **more)

    def do(self, procedure: Procedure, builder: Builder | None = None) -> tuple[Finding, Builder]:
        """Run a procedure; its finding, and who ran it."""
        builder = builder or self.builder()
        before = len(builder.events)
        try:
            found = drive(procedure, builder)
            shares = [e.share for e in builder.events[before:] if isinstance(e, Progress) and e.share is not None]
            assert shares == sorted(shares), f"what is done does not become undone: {shares}"
            told = (getattr(e, "words", getattr(e, "question", "")) for e in builder.events[before:])
            odd = unreadable("\n".join([found.as_markdown(), *told]))
            assert not odd, f"people read {odd}"
            return found, builder
        finally:
            builder.hands.close()

    def recorded(self) -> dict[str, bytes]:
        """Every recording of its folder: name → what it holds."""
        return {path.name: path.read_bytes() for path in self.folder.recordings.iterdir()}

    def torque(self) -> list[bool]:
        """Whether each servo of the real robot behind the wire has torque."""
        return [bool(servo.torque) for servo in self.server.world.servos]

    def register(self, joint: str, name: str) -> int:
        """What really stands in a servo's memory."""
        world = self.server.world
        servo = world.servos[world.joints.index(joint)]
        item = servo.model.register(name)
        return item.decode(bytes(servo.memory[item.address : item.end]))


@contextlib.contextmanager
def robot(folder: Path, *, sees: bool = False, kit: str = "standard", **table: Any) -> Iterator[Robot]:
    """A virtual robot of a scenario's tables, in stepped time, served by a thread of this process.

    Its mechanics are left out while it stands still, and go by coarse steps, unless the tables say otherwise.
    """
    coarse = {} if "effect" in table else {"step_s": COARSE_STEP_S}
    tables = {"clock": {"doze": True}, **table, "robot": {**coarse, **table.get("robot", {})}}
    server = assemble(parse_scenario(tables), clock="stepped", camera=sees)
    stop = threading.Event()
    thread = threading.Thread(target=server.run, args=(stop.is_set,))
    thread.start()
    try:  # what fails from here on must not leave the thread behind
        yield Robot(server, RobotFolder.at(folder) if (folder / "robot.toml").is_file() else create_robot(folder, kit))
    finally:
        stop.set()
        thread.join()
        server.close()
