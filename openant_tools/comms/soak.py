"""A soak of the bus: hours of traffic at full rate while the robot moves, so that a rare loss is seen and its cause told.

The legs swing gently around the home pose and rest now and then, so that angles, loads and shaking all vary. The log is
one recording that keeps what is not as it should be, with the raw bytes around it, and few of the healthy cycles. After
a stop the table of `restart` says whether the legs swing again; where they do not, the soak goes on listening, torque off:
it is the losses that are wanted here. A recording that is not written any more ends it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.restart import Interlock, MotionStopped, Restart, StopCause
from openant_tools.comms.state import refusal, stopping
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.numbers import exact
from openant_tools.procedure.step import Progress, Say, Subroutine
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD

__all__ = ["THIN_S", "BusSoaked", "soak", "soak_motion", "soaked_seconds"]

Array = NDArray[np.float64]

#: s between two healthy cycles that are kept
THIN_S = 0.1
#: rad that joints swing to either side of home, and the share of their way to a limit that they take at most
SWING_RAD, LIMIT_SHARE = 0.25, 0.8
#: s of swinging and of rest in one piece; Hz of the joints, no two alike, none a multiple of another
MOVE_S, REST_S = 24.0, 6.0
SLOWEST_HZ, FASTEST_HZ = 0.23, 1.1
#: s to wait before going on after a stop
PAUSE_S = 5.0


@dataclass(frozen=True)
class BusSoaked:
    """What came of a soak.

    Attributes:
        path: the recording. cycles: rows kept in it. seconds: of soaking, earlier parts included.
        statistics: of the bus, as `openant comms watch` has them, of this part.
        stops: what stopped it meanwhile.
        ended: why motion ended for good; "" where it did not, or nothing was to move.
        whole: whether it lasted as long as was asked for.
    """

    path: Path
    cycles: int
    seconds: float
    statistics: Mapping[str, Any]
    stops: tuple[str, ...]
    ended: str
    whole: bool


def soak_motion(
    joints: tuple[str, ...], limits: Mapping[str, tuple[float, float]], rate_hz: float, piece: int
) -> Array:
    """(n, joints) rad of one piece: a swing of all joints around home, then rest.

    Args:
        piece: number of the piece; each has phases of its own.
    """
    t = np.arange(round((MOVE_S + REST_S) * rate_hz)) / rate_hz
    chance = np.random.default_rng(piece)
    hz = chance.permutation(np.geomspace(SLOWEST_HZ, FASTEST_HZ, len(joints)))
    out = np.empty((len(t), len(joints)))
    # Begin and end at rest: a swing that grows and dies away.
    shape = np.clip(np.minimum(t, MOVE_S - t) / 2.0, 0.0, 1.0)
    for k, joint in enumerate(joints):
        home = HOME_RAD[JOINTS[joint].kind] if joint in JOINTS else 0.0
        low, high = limits.get(joint, (home - SWING_RAD, home + SWING_RAD))
        home = min(max(home, low), high)
        reach = min(SWING_RAD, LIMIT_SHARE * min(high - home, home - low))
        out[:, k] = home + reach * shape * np.sin(2 * np.pi * hz[k] * t + chance.uniform(0, 2 * np.pi))
    return out


def soaked_seconds(path: Path) -> float:
    """How long a soak that stands there lasted so far, s, without the pauses after which it was gone on with.

    Raises:
        BadInput: it is no recording, or one torn before its first row.
    """
    recording = read_recording(path)
    paused = sum(float(event["pause_s"]) for event in recording.events if event["kind"] == "resumed")
    return recording.run.duration_s - paused


def soak(
    config: EngineConfig,
    out: Path,
    seconds: float,
    *,
    move: bool = True,
    resume: bool = False,
    thin_s: float | None = THIN_S,
    robot_toml: str | None = None,
) -> Subroutine[BusSoaked]:
    """Soak until the log is `seconds` (s) long; the words of its progress say what was lost until then.

    Args:
        config: the robot, see `comms.setup`.
        move: swing the legs; else the robot stays limp.
        resume: go on with the soak that stands at `out`.
        thin_s: one healthy cycle in so many s is kept; None keeps all.

    Raises:
        HardwareFault: the robot does not answer at the start.
        KeyboardInterrupt: torque is off and the recording whole when it arrives.
    """
    joints = tuple(servo.joint for servo in config.servos)
    before = soaked_seconds(out) if resume and out.exists() else 0.0
    stops: list[str] = []
    done = before
    with EngineProcess(config) as engine:
        for words in engine.notices():
            yield Say(words)
        wrong = stopping(engine.description["differences"])
        if move and wrong and not config.anyway:
            what, remedy = refusal(wrong)
            raise HardwareFault(what, where=config.port, remedy=f"{remedy}, and --still moves nothing")
        facts = Facts(joints=joints, setup="stand", protocol="comms soak", extra={"rate_hz": config.rate_hz})
        engine.ask(messages.Record(str(out), facts, robot_toml, resume=resume and out.exists(), thin_s=thin_s))
        statistics: Mapping[str, Any] = engine.ask(messages.Statistics())
        piece = int(before // (MOVE_S + REST_S))
        interlock, restart = Interlock("comms soak"), None
        moving, pause_s = False, 0.0
        while done < seconds:
            length = min(pause_s or MOVE_S + REST_S, seconds - done)
            try:
                if move and not pause_s:
                    if not moving:
                        engine.ask(messages.Torque(True, restart))
                        moving = True
                    commands = soak_motion(joints, config.limits_rad, config.rate_hz, piece)
                    engine.ask(messages.Play(commands[: max(2, round(length * config.rate_hz))], "soak"))
                else:
                    engine.ask(messages.LetPass(length))
                pause_s = 0.0
            except MotionStopped as fault:
                stops.append(str(fault))
                moving, length = False, 0.0
                if fault.cause in (StopCause.STORAGE, StopCause.BY_HAND):
                    interlock.end(fault.what)
                    break
                restart = interlock.stopped(fault.cause, fault.what, done)
                move, pause_s = restart is not None, PAUSE_S
                yield Say(f"{fault}; {_what_follows(restart)}", "warn")
            piece += 1
            done += length
            with contextlib.suppress(HardwareFault):  # a port that is gone has nothing to add
                statistics = engine.ask(messages.Statistics())
            yield Progress(min(1.0, done / seconds), _losses(statistics))
        if moving:
            engine.ask(messages.Torque(False))
        try:
            path, cycles = engine.ask(messages.StopRecording())
        except MotionStopped as fault:
            if not stops:  # the last rows did not reach the disk
                stops.append(str(fault))
                interlock.end(fault.what)
            path, cycles = str(out), _rows_of(out)
    whole = done >= seconds and not interlock.ended
    return BusSoaked(Path(path), cycles, done, statistics, tuple(stops), interlock.ended, whole)


def _losses(statistics: Mapping[str, Any]) -> str:
    asked = sum(servo["asked"] for servo in statistics["servos"])
    answered = sum(servo["answered"] for servo in statistics["servos"])
    return f"{asked - answered} of {asked} answers lost"


def _what_follows(restart: Restart | None) -> str:
    if restart is None:
        return "motion has ended for good, and the soak goes on listening, torque off"
    return f"going on in {exact(PAUSE_S, 's')}, {restart.count} of {restart.times}"


def _rows_of(path: Path) -> int:
    """Rows that a recording holds which ended by a fault of the disk."""
    try:
        return len(read_recording(path).run.t)
    except (BadInput, OSError):
        return 0
