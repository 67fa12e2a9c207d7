"""Record an excitation: torque on, home, play, home, torque off; whatever happens, a valid file of what was played."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.journal import append_writes
from openant_tools.comms.messages import EngineConfig
from openant_tools.recording.run import Facts
from openant_tools.sysid.protocols import CommandSpace, Protocol

__all__ = ["Recorded", "record_protocol", "repeat_paths"]

#: The legs swing after the ramp to the start; the recording begins when they are still.
SETTLE_S = 0.5
_VOLTS = "present_input_voltage"  # 0.1 V a count


@dataclass(frozen=True)
class Recorded:
    """One recording made."""

    path: Path
    cycles: int
    notices: tuple[str, ...] = ()


def repeat_paths(out: Path, repeats: int) -> list[Path]:
    """`out`, then `out-2`, `out-3` … beside it."""
    return [out, *(out.with_name(f"{out.stem}-{k}{out.suffix}") for k in range(2, repeats + 1))]


def record_protocol(
    config: EngineConfig,
    protocol: Protocol,
    out: Path,
    *,
    seed: int = 0,
    repeats: int = 1,
    setup: str = "stand",
    robot_toml: str | None = None,
    progress: Callable[[str, float], None] = lambda words, share: None,
    notice: Callable[[str], None] = lambda text: None,
    journal: Path | None = None,
) -> list[Recorded]:
    """Play a protocol `repeats` times and record each.

    Args:
        config: the robot, see `comms.setup`.
        out: the recording; repeats stand beside it as `-2`, `-3` ….
        setup: "stand" or "floor", into the facts.
        robot_toml: the robot's configuration as text, kept inside the recording.
        progress: called with what is being done and the share of all that is done.
        notice: called with what the user should know.
        journal: file that every write to a servo's permanent memory is added to.

    Raises:
        HardwareFault: a guard or the stop key stopped it; the recording up to there is kept.
        KeyboardInterrupt: torque is off and the recording closed when it arrives.
    """
    space = CommandSpace.around_home(dict(config.limits_rad), [servo.joint for servo in config.servos])
    commands = protocol.commands(space, config.rate_hz, seed)
    seconds = len(commands) / config.rate_hz
    done: list[Recorded] = []
    with EngineProcess(config) as engine:
        for event in engine.events():
            notice(_words(event))
        if journal is not None:
            append_writes(journal, engine.description["eeprom_writes"], "sysid record")
        engine.ask(messages.Torque(True))
        for k, path in enumerate(repeat_paths(out, repeats)):
            progress("to the home pose", k / repeats)
            engine.ask(messages.Ramp(commands[0]))
            engine.ask(messages.Hold(SETTLE_S))
            facts = Facts(
                joints=space.joints,
                setup=setup,
                protocol=protocol.name,
                repeat_of=out.stem if k else None,
                supply_v=round(statistics.fmean(engine.ask(messages.ReadRegister(_VOLTS)).values()) * 0.1, 2),
                extra={"protocol_seed": seed, "rate_hz": config.rate_hz},
            )
            engine.ask(messages.Record(str(path), facts, robot_toml))
            playing = engine.start(messages.Play(commands, protocol.name))
            for share in _while_playing(engine, playing, seconds, notice):
                progress(protocol.name, (k + share) / repeats)
            written, cycles = engine.ask(messages.StopRecording())
            done.append(Recorded(Path(written), cycles))
        engine.ask(messages.Torque(False))
        progress("done", 1.0)
    return done


def _while_playing(
    engine: EngineProcess, number: int, seconds: float, notice: Callable[[str], None]
) -> Iterator[float]:
    """Yield the share played until the motion has ended; raises where it was stopped."""
    column = engine.columns.index("t")
    first: float | None = None
    while not engine.done(number):
        for event in engine.events():
            if isinstance(event, messages.Notice):
                notice(event.text)
        rows = engine.telemetry()
        if len(rows):
            first = float(rows[0, column]) if first is None else first
            yield min(1.0, (float(rows[-1, column]) - first) / seconds)
        time.sleep(0.05)


def _words(event: messages.Event) -> str:
    return event.text if isinstance(event, messages.Notice) else str(event)
