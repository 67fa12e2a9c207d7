"""The walk from loose motors to a robot that learns: its steps, in the order in which one builds, and how far it got."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from openant_tools.comms.restart import RULES, MotionStopped, StopCause
from openant_tools.errors import BadInput, OpenAntError, StorageFault
from openant_tools.procedure.finding import Finding, keep, latest
from openant_tools.procedure.step import Ask, Bench, Declined, Face, Say, Step, StepAt, drive
from openant_tools.procedure.unfinished import Unfinished, unfinished

if TYPE_CHECKING:
    from openant_tools.robot.folder import RobotFolder

__all__ = [
    "BENCH",
    "BESIDE",
    "WALK",
    "Standing",
    "State",
    "beside",
    "do",
    "next_step",
    "standing",
    "step",
    "walk",
]

#: key of a finding's data: the `StopCause` of what ended its motion
STOPPED = "stop_cause"
#: what one may do where a step says no
AGAIN, GO_ON = "do it again", "go on"
#: name → step, in order.
WALK: Mapping[str, Step] = {
    step.name: step
    for step in (
        Step(
            "connect",
            "Connect",
            "Find the bus, the IMU and the camera, and see that the adapter answers at once.",
            "openant_tools.calib.connect:connect",
            table="the U2D2 and the flight controller plugged in, or a virtual robot",
            changes="the ports in robot.toml",
            sees=True,
            minutes=1,
        ),
        Step(
            "estop",
            "Emergency stop",
            "Prove that the stop key switches torque off, before anything moves.",
            "openant_tools.calib.estop:estop",
            needs=("connect",),
            table="one servo on the cable, lying free; 12 V on",
            changes="nothing for good; torque goes on and off",
            holds=True,
            minutes=1,
        ),
        Step(
            "ids",
            "Motor IDs",
            "Give every bare servo its id, one at a time; or remap servos that are wired already.",
            "openant_tools.calib.ids:ids",
            needs=("connect", "estop"),
            table="the eight servos, one cable; a pen to write the joint on each",
            changes="id, baud rate and return delay of each servo",
            moves=True,
            minutes=10,
        ),
        Step(
            "centre",
            "Centring",
            "Turn each bare servo to its mounting angle and hold it there while the horn goes on.",
            "openant_tools.calib.centre:centre",
            needs=("ids",),
            table="servos without horns, horns and screws",
            changes="operating mode of each servo; torque goes on and off",
            moves=True,
            minutes=15,
        ),
        Step(
            "legs",
            "Leg by leg",
            "Prove each leg (cable, range, nudge) before the next is built and the shell is closed.",
            "openant_tools.calib.legs:legs",
            needs=("ids",),
            table="the legs, built one after the other, the torso on its stand",
            changes="nothing for good; torque goes on and off",
            moves=True,
            minutes=15,
        ),
        Step(
            "inventory",
            "Inventory",
            "Compare every setting in every servo's memory with what it should be, and mend what differs.",
            "openant_tools.calib.inventory:inventory",
            needs=("ids",),
            table="the whole robot on its cable",
            changes="settings in the servos' memory that differ, and their return delay",
            minutes=3,
        ),
        Step(
            "zeros",
            "Zeros and directions",
            "Find each joint's zero from straight legs, and prove by nudges which leg moves and which way.",
            "openant_tools.calib.zeros:zeros",
            needs=("ids", "inventory"),
            table="the robot on its stand, legs free",
            changes="zero offsets and directions in robot.toml",
            moves=True,
            minutes=5,
        ),
        Step(
            "bounds",
            "Observation bounds",
            "Find the joints' ranges by hand and by a slow sweep, then the bounds of all observations from many motions.",
            "openant_tools.calib.bounds:bounds",
            needs=("zeros",),
            table="the robot on its stand",
            changes="limits and observation bounds in robot.toml",
            moves=True,
            minutes=10,
        ),
        Step(
            "imu",
            "IMU",
            "Find scale, bias, noise and mounting of the flight controller from a few poses.",
            "openant_tools.calib.imu:imu",
            needs=("connect",),
            table="the robot in your hands",
            changes="[imu] in robot.toml",
            minutes=4,
        ),
        Step(
            "arena",
            "Arena",
            "Camera, tags, origin and circle, and how late the picture is.",
            "openant_tools.calib.arena:arena",
            needs=("zeros", "imu"),
            table="the camera above the floor, the origin's tag, the robot on the floor",
            changes="[camera] and [arena] in robot.toml",
            moves=True,
            sees=True,
            minutes=10,
        ),
        Step(
            "comms",
            "Comms health",
            "Measure losses and rate of the bus, at rest and while the legs swing, and say what loses the answers.",
            "openant_tools.bringup.comms_step:comms_step",
            needs=("inventory", "zeros"),
            table="the whole robot on its stand, cables as they will be",
            changes="[bus] in robot.toml",
            moves=True,
            minutes=3,
        ),
        Step(
            "thermal",
            "Thermal soak",
            "Let the robot hold its pose for a while, watch it warm and cool, and forecast how long it can work.",
            "openant_tools.thermal.step:thermal_soak",
            needs=("zeros",),
            table="the robot on its stand",
            changes="[bench.thermal] in robot.toml",
            moves=True,
            minutes=13,
        ),
        Step(
            "identify",
            "Identification",
            "Move every joint, record it, and adjust the simulation until it moves alike.",
            "openant_tools.bringup.identification:identification",
            needs=("zeros", "bounds"),
            table="the robot on its stand",
            changes="calibrated.xml and [identified] in robot.toml",
            moves=True,
            minutes=15,
        ),
        Step(
            "gap",
            "Gap check",
            "Measure how far the calibrated simulation is from the robot on a motion that it has not seen.",
            "openant_tools.bringup.gap_check:gap_check",
            needs=("identify",),
            changes="nothing",
            minutes=1,
        ),
        Step(
            "passport",
            "Passport",
            "One page with everything known about this robot, and what to train next.",
            "openant_tools.bringup.passport:passport_step",
            needs=("zeros",),
            changes="passport.html and passport.md",
            minutes=1,
        ),
    )
}

#: name → procedure of the bench, each by itself.
BENCH: Mapping[str, Step] = {
    step.name: step
    for step in (
        Step(
            "knee-torque",
            "Torque table",
            "What the knees must bear on four, three and two legs, against what their servos can hold.",
            "openant_tools.sysid.bench.steps:knee_torque",
            table="a scale that weighs the whole robot",
            changes="nothing",
        ),
        Step(
            "stiffness",
            "Kitchen scale",
            "Press one foot against a scale, and say how stiff the joint is by the scale and by its servo's own duty.",
            "openant_tools.sysid.bench.steps:stiffness",
            needs=("zeros",),
            table="the torso fixed on its stand, a kitchen scale or a block under one foot",
            changes="[bench] in robot.toml",
            moves=True,
            minutes=5,
        ),
        Step(
            "floor-friction",
            "Tilted plate",
            "Tilt a plate of the floor's material until the robot slides, and say how slippery it is.",
            "openant_tools.sysid.bench.steps:floor_friction",
            needs=("zeros", "imu"),
            table="a plate of the floor's material, the robot on it",
            changes="[bench] in robot.toml",
            moves=True,
            minutes=5,
        ),
    )
}

#: name → step that has no place in the order of the walk.
BESIDE: Mapping[str, Step] = {
    "check": Step(
        "check",
        "Daily check",
        "Two minutes before a session: bus, supply, zeros, friction of each joint, IMU, heat, and what changed since the "
        "passport.",
        "openant_tools.bringup.check:check",
        needs=("bounds",),
        table="the robot on its stand, as it will be used",
        changes="nothing",
        moves=True,
        minutes=2,
    ),
    **BENCH,
    "undo": Step(
        "undo",
        "Undo",
        "Take back the last step's writes to the servos' memory, newest first, as journal.jsonl has them.",
        "openant_tools.calib.undo:undo",
        table="the servos that were written to, plugged in as they were then",
        changes="registers back to what they were",
    ),
}

State = Literal["todo", "ok", "failed", "unsure", "stale"]


@dataclass(frozen=True)
class Standing:
    """How far one step got.

    Attributes:
        finding: its newest; None where it has not been done.
        state: `stale` where a step that it needs has been done again since.
        waits_for: steps that it needs and whose findings do not serve yet.
        left: how far it was when it was left in the middle; None where it was not.
        virtual: whether it said yes on a virtual robot, where that counts for nothing.
    """

    step: Step
    finding: Finding | None
    state: State
    waits_for: tuple[str, ...]
    left: Unfinished | None = None
    virtual: bool = False


def standing(folder: RobotFolder, *, real: bool = False) -> dict[str, Standing]:
    """Every step of the walk, in order, as the robot's `findings/` tell; the walk resumes from it.

    Args:
        real: whether what was found on a virtual robot counts for nothing.
    """
    found = {name: latest(folder, name, real=real) for name in WALK}
    # A passport tells of every step.
    return {
        name: _standing(folder, step, found, tuple(found) if name == "passport" else step.needs, real)
        for name, step in WALK.items()
    }


def beside(folder: RobotFolder, step: Step, *, real: bool = False) -> Standing:
    """The same of a step that has no place in the order."""
    found = {one: latest(folder, one, real=real) for one in (*step.needs, step.name)}
    return _standing(folder, step, found, (), real)  # each is a measurement by itself: no other makes it stale


def _standing(
    folder: RobotFolder, step: Step, found: Mapping[str, Finding | None], told: Iterable[str], real: bool
) -> Standing:
    """Args: found: step → its newest finding. told: steps of which its finding tells, so that newer ones make it stale."""
    finding = found[step.name]
    state: State = "todo"
    if finding is not None:
        newer = any(other.date > finding.date for name in told if (other := found[name]) is not None)
        state = "stale" if newer else "ok"
        if not finding.ok:
            state = "unsure" if finding.ok is None else "failed"
    waits = tuple(name for name in step.needs if (seen := found[name]) is None or not seen.serves)
    passed_over = latest(folder, step.name) if real and finding is None else None
    virtual = passed_over is not None and bool(passed_over.ok)
    left = unfinished(folder, step.name, virtual=False)
    if not real:
        left = unfinished(folder, step.name, virtual=True) or left
    return Standing(step, finding, state, waits, left, virtual)


def step(name: str) -> Step:
    """A step of the walk by name; raises BadInput for any other."""
    try:
        return WALK[name]
    except KeyError:
        raise BadInput(f"there is no step {name!r}", remedy=f"the steps are {', '.join(WALK)}") from None


def do(step: Step, bench: Bench, face: Face) -> Finding:
    """Do one step and keep its finding; what kept it from being done is its finding, too.

    Raises:
        Declined: an intent was not granted. Nothing is kept then, nor after Ctrl-C: the step is still to be done.
        MotionStopped, StorageFault: the disk takes no more, a finding neither.
    """
    data: dict[str, Any] = {}
    try:
        finding = drive(step.start(bench), face)
    except (Declined, StorageFault):
        raise
    except OpenAntError as error:
        if isinstance(error, MotionStopped):
            if error.cause is StopCause.STORAGE:
                raise
            data = {STOPPED: error.cause.value}
        what = f"{error.where}: {error.what}" if error.where else error.what
        command = f"openant calib {step.name}"
        finding = Finding(step.name, False, what, (), error.remedy or "", command, data=data, problems=(what,))
    keep(finding, bench.folder, virtual=bench.virtual)
    return finding


def walk(
    bench: Bench,
    face: Face,
    *,
    again: bool = False,
) -> dict[str, Finding]:
    """All steps in order; those that stand are not done again, those whose needs do not serve are left out. The face is told
    of each that begins, and of its finding (`StepAt`).

    Whoever is asked may do a step again that says no. A stop that ends motion for good (`comms.restart`) ends the walk: what it would move next waits for a new command.

    Args:
        again: do every step, also those that stand.

    Returns:
        step → its newest finding, for the steps that have one.

    Raises:
        Declined: an intent was not granted; the walk resumes at that step.
    """
    for place, (name, step) in enumerate(WALK.items(), 1):
        now = standing(bench.folder, real=not bench.virtual)[name]
        if now.state == "ok" and not again:
            continue
        if now.waits_for:
            titles = ", ".join(WALK[other].title for other in now.waits_for)
            face.answer(Say(f"{step.title} is left out: it needs {titles}", "warn"))
            continue
        while True:
            face.answer(StepAt(step, place, len(WALK)))
            found = do(step, bench, face)
            face.answer(StepAt(step, place, len(WALK), found))
            cause = found.data.get(STOPPED)
            if cause is not None and not RULES[StopCause(cause)].faces:
                face.answer(Say("motion has ended for good: look at the robot, then begin the walk again", "fail"))
                return _findings(bench.folder, real=not bench.virtual)
            question = f"{step.title} says no. Once it is mended: do it again, or go on without it?"
            if found.ok is not False or face.answer(Ask(question, (AGAIN, GO_ON), default=GO_ON)) != AGAIN:
                break
    return _findings(bench.folder, real=not bench.virtual)


def _findings(folder: RobotFolder, *, real: bool = False) -> dict[str, Finding]:
    """step → its newest finding, for the steps that have one; `real`: as `standing` has it."""
    return {name: now.finding for name, now in standing(folder, real=real).items() if now.finding is not None}


def next_step(folder: RobotFolder, *, real: bool = False) -> Standing | None:
    """Where the walk goes on: its first step that does not stand and waits for none; None where all stand.

    Args:
        real: as `standing` has it.
    """
    return next((now for now in standing(folder, real=real).values() if now.state != "ok" and not now.waits_for), None)
