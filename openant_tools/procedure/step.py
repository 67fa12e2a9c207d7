"""A procedure is a generator that says what it does and asks for what it needs; any face can run it.

    def blink(bench: Bench) -> Procedure:
        yield Intent("blink the LED of hip_rr", (RegisterChange("hip_rr", "led", 0, 1),))
        ...
        return Finding(...)

It opens what it needs itself and gives it back in `finally`: a face that closes the generator at any yield (Ctrl-C, the
stop key, a closed terminal) leaves the robot with torque off, and the step can be begun again.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypeVar

from openant_tools.errors import OpenAntError
from openant_tools.procedure.finding import Finding

if TYPE_CHECKING:  # a manual that lists the steps opens without NumPy
    from openant_tools.robot.folder import RobotFolder

__all__ = [
    "Answer",
    "Ask",
    "Bench",
    "Declined",
    "Drawing",
    "Event",
    "Face",
    "Hands",
    "Intent",
    "Kept",
    "Live",
    "Procedure",
    "Progress",
    "RegisterChange",
    "Say",
    "Step",
    "StepAt",
    "change_lines",
    "confirmed",
    "drive",
]  # fmt: skip

T = TypeVar("T")


# ---- what a procedure says -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Progress:
    """How far it is: `share` of 1, None where that is not known. No answer."""

    share: float | None
    words: str


@dataclass(frozen=True)
class Say:
    """A sentence for the builder; `level` decides its glyph. No answer."""

    words: str
    level: Literal["info", "ok", "warn", "fail"] = "info"


@dataclass(frozen=True)
class RegisterChange:
    """One register that will be written; counts, `old` None where it has not been read.

    Attributes:
        means: what `old` and `new` are in words or units; "" where the counts say it.
    """

    joint: str
    register: str
    old: int | None
    new: int
    means: str = ""

    def __str__(self) -> str:
        return f"{self.joint}: {self.words}"

    @property
    def words(self) -> str:
        """What is written, without the joint."""
        was = "" if self.old is None else f" {self.old} →"
        return f"{self.register}{was} {self.new}" + (f" ({self.means})" if self.means else "")


def change_lines(changes: Sequence[RegisterChange]) -> list[str]:
    """What will be written, one line for all joints that are written alike, and for all that is written to one joint."""
    alike: dict[str, list[str]] = {}
    for change in changes:
        alike.setdefault(change.words, []).append(change.joint)
    together: dict[tuple[str, ...], list[str]] = {}
    for words, joints in alike.items():
        together.setdefault(tuple(joints), []).append(words)
    return [
        f"{joints[0] if len(joints) == 1 else f'{len(joints)} servos'}: {', '.join(words)}"
        for joints, words in together.items()
    ]


@dataclass(frozen=True)
class Intent:
    """What will be done next. Nothing is written or moved before it is granted: answered by True.

    A face that does not grant it need not answer: `drive` closes the procedure.
    """

    words: str
    registers: tuple[RegisterChange, ...] = ()
    moves: bool = False


@dataclass(frozen=True)
class Ask:
    """A question, answered by one of `choices` (a string), or by a number in `unit` where there are none.

    Attributes:
        default: what Enter and `--yes` take; None where the builder must say it.
        choices: words to choose from; empty for a number, or for free text where `unit` is "text".
    """

    question: str
    choices: tuple[str, ...] = ()
    unit: str = ""
    default: str | float | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Hands:
    """Something that the builder's hands must do; answered when it is done.

    Attributes:
        task: the same as data, for the hands of a virtual robot: `plug`, `unplug` (joint, or all), `assemble`,
            `straighten`, `turn` (joint, through `path_rad` at the joint), `tilt` (torso, by `path_rad` as a rotation
            vector), `place` (on `setup`), `free` (let everything go).
        while_watching: the procedure goes on reading meanwhile (range capture by hand): a face answers at once, and
            what is seen comes as `Live`.
    """

    words: str
    task: Literal["plug", "unplug", "assemble", "straighten", "turn", "tilt", "place", "free"]
    joint: str = ""
    path_rad: tuple[float, ...] = ()
    setup: Literal["stand", "floor", ""] = ""
    while_watching: bool = False


@dataclass(frozen=True)
class Live:
    """Values as they are now, joint → value in `unit`, for bars. Answered by True where the builder says "enough".

    Attributes:
        low, high: joint → the ends of its bar. marks: joint → a few words beside it.
        angles_rad: joint → where it is now, of all that were read, for the picture of the robot.
    """

    values: Mapping[str, float]
    unit: str
    words: str = ""
    low: Mapping[str, float] = field(default_factory=dict)
    high: Mapping[str, float] = field(default_factory=dict)
    marks: Mapping[str, str] = field(default_factory=dict)
    angles_rad: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Drawing:
    """A drawing in characters (80 columns, ASCII only), or a picture's file, that goes with what follows."""

    words: str
    drawing: str = ""
    picture: Path | None = None


@dataclass(frozen=True)
class Kept:
    """A recording is whole: it stays, whatever becomes of what follows. No answer."""

    path: Path


@dataclass(frozen=True)
class StepAt:
    """A step of the walk begins; with its finding, it has ended. No answer.

    Attributes:
        place, count: the how manieth of how many.
    """

    step: Step
    place: int
    count: int
    finding: Finding | None = None


Event = Progress | Say | Intent | Ask | Hands | Live | Drawing | Kept | StepAt
Answer = bool | str | float | None
#: A part of a procedure, with a result of its own: `result = yield from part(...)`.
Subroutine = Generator[Event, Answer, T]
Procedure = Subroutine[Finding]


# ---- what runs it ----------------------------------------------------------------------------------------------------


class Face(Protocol):
    """Command line, terminal program or test: what shows events and answers them."""

    def answer(self, event: Event) -> Answer:
        """Show one event; what it is answered with. Raising (KeyboardInterrupt too) ends the procedure in order."""
        ...


class Declined(OpenAntError):
    """An intent was not granted: nothing was written and nothing moved from there on."""

    exit_code = 130


def drive(procedure: Subroutine[T], face: Face) -> T:
    """Run a procedure, or a part of one, to its result.

    Whatever ends it early (an error, Ctrl-C in the face, an intent that is not granted) lets it put the robot into
    order first: torque off, ports closed.

    Raises:
        Declined: an intent was not granted.
        OpenAntError: the procedure's own words.
    """
    answer: Answer = None
    try:
        while True:
            event = procedure.send(answer)
            answer = face.answer(event)
            if isinstance(event, Intent) and answer is not True:
                raise Declined(f"not done: {event.words}", remedy="nothing was changed from there on; run it again")
    except StopIteration as end:
        result: T = end.value
        return result
    finally:
        procedure.close()


# ---- what it works on ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bench:
    """The robot's folder, and where it is plugged in.

    Attributes:
        bus, imu, camera: where they were named by hand (or by a ready file); None for what `robot.toml` says, or what
            is found plugged in.
        control: the control socket of a virtual robot.
        joints: only these; empty for all.
    """

    folder: RobotFolder
    bus: str | None = None
    imu: str | None = None
    camera: str | None = None
    control: str | None = None
    joints: tuple[str, ...] = ()

    @property
    def virtual(self) -> bool:
        """Whether it is a virtual robot, of which nothing that is found says anything of the real one."""
        return self.control is not None


def confirmed(bench: Bench, question: str) -> Subroutine[bool]:
    """Ask what only eyes and hands at the robot can tell; whether it is so. Of a virtual robot it is pretended, and said."""
    if bench.virtual:
        yield Say(f"{question} (yes: this robot is virtual, that is pretended)")
        return True
    return (yield Ask(question, ("yes", "no"), default="yes")) == "yes"


@dataclass(frozen=True)
class Step:
    """One step of the walk.

    Attributes:
        name: as in `openant calib NAME` and in the names of its findings.
        title: as on the screen.
        does: one sentence.
        needs: steps whose findings must serve before; things on the table come in `table`.
        table: what must be at hand.
        changes: what it writes (registers, robot.toml); "" where it changes nothing.
        moves: whether the robot moves. holds: whether torque goes on although nothing moves.
        sees: whether it looks through the camera.
        minutes: of the builder's time, about.
        safe_to_repeat: nothing is lost by doing it again.
        procedure: "module:function", imported when it is run.
    """

    name: str
    title: str
    does: str
    procedure: str
    needs: tuple[str, ...] = ()
    table: str = ""
    changes: str = ""
    moves: bool = False
    holds: bool = False
    sees: bool = False
    minutes: float = 1.0
    safe_to_repeat: bool = True

    def start(self, bench: Bench) -> Procedure:
        """The procedure, not yet begun."""
        module, _, name = self.procedure.partition(":")
        function: Callable[[Bench], Procedure] = getattr(importlib.import_module(module), name)
        return function(bench)
