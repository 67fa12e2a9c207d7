"""Record excitations: torque on, home, play, home, torque off; whatever happens, a valid file of what was played."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig
from openant_tools.errors import BadInput
from openant_tools.numbers import number
from openant_tools.procedure.step import Kept, Progress, Say, Subroutine
from openant_tools.recording.run import Facts
from openant_tools.sysid.excitation import CommandSpace, Multisine
from openant_tools.sysid.plan_file import as_table
from openant_tools.sysid.protocols import Protocol

__all__ = ["Recorded", "Take", "record_takes", "takes"]

#: The legs swing after the ramp to the start; the recording begins when they are still.
SETTLE_S = 0.5
_VOLTS = "present_input_voltage"  # 0.1 V a count
_TEMPERATURE = "present_temperature"  # °C
#: Work between a cold run and its hot repeat: how long in one go, and the rise (K) at which it is enough.
WORK_S = 10.0
HOT_RISE_K = 10
#: s between two looks at what is played
LOOK_S = 0.05


@dataclass(frozen=True)
class Take:
    """One recording to be made.

    Attributes:
        seed: of all that chance decides in the protocol.
        repeat_of: the name of the recording that this one repeats.
        work_s: s of work before it, so that it is a hot repeat.
        held_out: recorded to judge a fit by, not to be fitted.
    """

    path: Path
    protocol: Protocol
    seed: int
    repeat_of: str | None = None
    work_s: float = 0.0
    held_out: bool = False


@dataclass(frozen=True)
class Recorded:
    """One recording made."""

    path: Path
    cycles: int


def takes(
    out: Path,
    protocols: Sequence[Protocol],
    seed: int = 0,
    *,
    repeats: int = 1,
    hold_out_seed: int | None = None,
    hot_s: float = 0.0,
) -> list[Take]:
    """What to record: each protocol `repeats` times, once more hot, and once with another seed to judge by.

    The first protocol goes to `out`, others beside it: `-floor` for those on the floor, with the heading in degrees where it
    is not 0; repeats are `-2`, `-3` …, a hot one `-hot`, the one to be held out `-held-out`.

    Raises:
        BadInput: what is to be held out would play the same.
    """
    if hold_out_seed == seed:
        raise BadInput(
            f"with seed {seed} the recording to hold out would play the same",
            remedy="give --hold-out-seed another number",
        )
    made = []
    for k, protocol in enumerate(protocols):
        place = ""
        if k:
            place = f"-{protocol.setup}"
            if protocol.heading_rad:
                place += f"-{round(math.degrees(protocol.heading_rad))}"  # for a file

        def path(what: str, place: str = place) -> Path:
            return out.with_name(f"{out.stem}{place}{what}{out.suffix}")

        first = path("")
        made += [
            Take(path(f"-{n}" if n > 1 else ""), protocol, seed, first.stem if n > 1 else None)
            for n in range(1, repeats + 1)
        ]
        if hold_out_seed is not None:
            made.append(Take(path("-held-out"), protocol, hold_out_seed, held_out=True))
        if hot_s and protocol.setup == "stand":
            made.append(Take(path("-hot"), protocol, seed, first.stem, hot_s))
    return made


def record_takes(
    config: EngineConfig,
    wanted: Sequence[Take],
    *,
    robot_toml: str | None = None,
    pictures: bool = False,
) -> Subroutine[list[Recorded]]:
    """Record one take after another, of a robot that stays where it is; each that is whole is said to be `Kept`.

    Args:
        config: the robot, see `comms.setup`.
        robot_toml: the robot's configuration as text, kept inside the recordings.
        pictures: record the overhead camera's, too.

    Raises:
        HardwareFault: a guard or the stop key stopped it; the recording up to there is kept.
        KeyboardInterrupt: torque is off and the recording closed when it arrives.
    """
    space = CommandSpace.around_home(dict(config.limits_rad), [servo.joint for servo in config.servos])
    total = sum(take.protocol.seconds + take.work_s for take in wanted)
    done: list[Recorded] = []
    past = 0.0
    with EngineProcess(config) as engine:
        for words in engine.notices():
            yield Say(words)
        found = np.asarray(engine.description["position"], float)
        engine.ask(messages.Torque(True))

        def play(protocol: Protocol, seed: int, words: str) -> Subroutine[None]:
            commands, limp = protocol.commands(space, config.rate_hz, seed), protocol.limp(space, config.rate_hz)
            motion = messages.Play(commands, protocol.name, limp if limp.any() else None)
            column, number, first = engine.columns.index("t"), engine.start(motion), None
            while not engine.done(number):  # raises where it was stopped
                for notice in engine.notices():
                    yield Say(notice)
                rows = engine.telemetry()
                if len(rows):
                    first = float(rows[0, column]) if first is None else first
                    played = min(protocol.seconds, float(rows[-1, column]) - first)
                    yield Progress((past + played) / total, words)
                time.sleep(LOOK_S)

        for nth, take in enumerate(wanted, 1):
            protocol, extra = take.protocol, dict[str, Any]()
            if take.work_s:
                extra["work_s"], extra["rise_k"] = yield from _work(engine, take.work_s, play)
                past += take.work_s
            yield Progress(past / total, "to the home pose")
            engine.ask(messages.Ramp(protocol.commands(space, config.rate_hz, take.seed)[0]))
            engine.ask(messages.Hold(SETTLE_S))
            facts = Facts(
                joints=space.joints,
                setup=protocol.setup,
                protocol=protocol.name,
                repeat_of=take.repeat_of,
                heading_rad=protocol.heading_rad if protocol.setup == "floor" else None,
                supply_v=round(statistics.fmean(engine.ask(messages.ReadRegister(_VOLTS)).values()) * 0.1, 2),
                extra={
                    "protocol_seed": take.seed,
                    "rate_hz": config.rate_hz,
                    "held_out": take.held_out,
                    "segments": [
                        {"start_s": round(start, 3), **as_table(segment)}
                        for start, segment in zip(protocol.starts(), protocol.segments, strict=True)
                    ],
                    **extra,
                },
            )
            engine.ask(messages.Record(str(take.path), facts, robot_toml, pictures=pictures))
            yield from play(protocol, take.seed, f"{protocol.name}, recording {nth} of {len(wanted)}")
            written, cycles = engine.ask(messages.StopRecording())
            done.append(Recorded(Path(written), cycles))
            yield Kept(take.path)
            past += protocol.seconds
        if wanted[-1].protocol.setup == "floor":
            # Standing, it would fall when it is let go: back to how it lay.
            limits = np.array([config.limits_rad.get(joint, (-np.inf, np.inf)) for joint in space.joints])
            engine.ask(messages.Ramp(np.clip(found, limits[:, 0], limits[:, 1])))
        engine.ask(messages.Torque(False))
        yield Progress(1.0, "done")
    return done


def _work(
    engine: EngineProcess,
    seconds: float,
    play: Callable[[Protocol, int, str], Subroutine[None]],
) -> Subroutine[tuple[float, int]]:
    """Move for `seconds`, or until a servo is warmer by HOT_RISE_K: (s, K) of what came of it."""
    before = engine.ask(messages.ReadRegister(_TEMPERATURE))
    worked, rise, joint = 0.0, 0, ""
    while worked < seconds and rise < HOT_RISE_K:
        piece = Protocol("work", "", (Multisine(max(1.0, min(WORK_S, seconds - worked))),))
        yield from play(piece, round(worked), "warming up")
        worked += piece.seconds
        now = engine.ask(messages.ReadRegister(_TEMPERATURE))
        joint, rise = max(((name, now[name] - before[name]) for name in now), key=lambda pair: pair[1])
    yield Say(f"{number(worked, 's')} of work: {joint} is {rise} K warmer")
    return worked, rise
