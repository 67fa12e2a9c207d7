"""What the engine records: every cycle, and what happens in between, into one file at a time; thinned where asked for."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from openant_tools.comms import messages
from openant_tools.comms.bus import Answer
from openant_tools.comms.engine_port import EnginePort
from openant_tools.comms.faults import Cause
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.servo_settings import ServoSettings
from openant_tools.comms.servos import Block, Servo
from openant_tools.comms.thinning import Thinning
from openant_tools.errors import BadInput
from openant_tools.recording.resume import continuation
from openant_tools.recording.telemetry import Cycle, ServoChannel
from openant_tools.recording.telemetry import RecordedAnswer as RecordedAnswer
from openant_tools.recording.writer import RecordingStopped, RecordingWriter

__all__ = ["Recorder"]

#: s between two losses whose raw bytes a thin recording keeps: a line that is dead says the same each time.
RAW_PERIOD_S = 0.05
_UNANSWERED = {cause: RecordedAnswer(None, False, cause.value) for cause in Cause}


class Recorder:
    """Writes a recording from `begin` to `end`; in between two of them it does nothing.

    Attributes:
        writer: of the recording under way; None where there is none.
        pictures: whether it is to hold the camera's pictures.
        stopped: why the one that was asked for is not written any more, until whoever records is told.
    """

    def __init__(self, config: EngineConfig, port: EnginePort) -> None:
        self._config, self._port = config, port
        self.writer: RecordingWriter | None = None
        self.pictures = False
        self.stopped: RecordingStopped | None = None
        self._thinning: Thinning | None = None
        self._effort: Sequence[str] = ()
        #: when the raw bytes of a loss were kept last, s
        self._bytes_at = -float("inf")

    def begin(
        self,
        command: messages.Record,
        servos: Sequence[Servo],
        settings: ServoSettings,
        extra: Mapping[str, Any],
    ) -> RecordingWriter:
        """Begin a recording, or go on with one.

        Args:
            settings: in force. extra: facts besides those of the command; where both speak, the command's count.

        Raises:
            BadInput: the file or its facts cannot be.
        """
        config, clock, bus = self._config, self._port.clock, self._port.bus
        channels = [_channel(servo) for servo in servos]
        self._effort = ["cur" if servo.model.has_current_sensor else "load" for servo in servos]
        link = {
            "baud": config.baud,
            "latency_timer_ms": bus.timing.latency_timer_s * 1e3,
            "return_delay_s": bus.timing.return_delay_s,
        }
        facts = replace(
            command.facts, joints=tuple(servo.joint for servo in servos), extra={**link, **extra, **command.facts.extra}
        )
        if command.thin_s is not None:
            facts = replace(facts, extra={**facts.extra, "rate_hz": config.rate_hz, "thinned_s": command.thin_s})
        if settings.differences:
            told = [difference.as_fact() for difference in settings.differences]
            facts = replace(facts, extra={**facts.extra, "differences": told})
        continued = None
        if command.resume:
            continued = continuation(command.path, channels, clock.now(), wall_counts=not clock.stepped)
        try:
            writer = RecordingWriter(
                command.path,
                facts=facts,
                channels=channels,
                registers=settings.registers,
                config=command.config,
                clock=clock.now,
                continued=continued,
            )
        except (TypeError, ValueError, AttributeError) as error:
            raise BadInput(f"Record.facts cannot be recorded: {error}", where=command.path) from error
        self.writer, self.pictures = writer, command.pictures
        self._port.beat()
        self._thinning = None if command.thin_s is None else Thinning(command.thin_s, facts.joints)
        bus.failed = None
        if continued is not None:
            writer.event("resumed", pause_s=clock.now() + continued.shift_s - continued.last_s)
        return writer

    def event(self, kind: str, **payload: Any) -> None:
        """Keep what happened now, where something is recorded."""
        if self.writer is not None:
            self.writer.event(kind, **payload)

    def cycle(
        self,
        writer: RecordingWriter,
        times: tuple[float, float | None, float],
        counts: Sequence[int] | None,
        torque: list[bool],
        answers: Sequence[tuple[Answer, Block | None]],
        agent: tuple[float, float] | None,
    ) -> None:
        """Record one turn of the loop.

        Args:
            times: s, when the servos were asked and when the goals were sent (None: no goals), and how late it was.
            counts: the goals in force; None where there are none. torque: whether it is on, each joint's.
            agent: s, when the observation was made and the action chosen that began with it; None where none did.

        Raises:
            RecordingStopped: the disk takes no more.
        """
        recorded = [
            RecordedAnswer(
                {
                    "pos": block.position, "vel": block.velocity, self._effort[k]: block.effort, "pwm": block.pwm,
                    "volt": block.voltage, "temp": block.temperature, "tick": block.tick,
                },
                answer.ok, answer.word, answer.rtt or 0.0,
            )
            if block is not None
            else _UNANSWERED[answer.cause or Cause.SHORT]
            for k, (answer, block) in enumerate(answers)
        ]  # fmt: skip
        t, cmd_t, late = times
        goals: list[int | None] = [None] * len(recorded) if counts is None else list(counts)
        cycle = Cycle(t, goals, cmd_t, late, recorded, torque, *(agent or (None, None)))
        if self._thinning is None:
            writer.cycle(cycle)
        else:
            self._thinned(self._thinning, writer, cycle)

    def _thinned(self, thinning: Thinning, writer: RecordingWriter, cycle: Cycle) -> None:
        for kept in thinning.take(cycle):
            writer.cycle(kept)
        bus = self._port.bus
        if bus.failed is not None:
            (asked, heard), bus.failed = bus.failed, None
            if cycle.t - self._bytes_at >= RAW_PERIOD_S:
                self._bytes_at = cycle.t
                writer.event("bytes", asked=asked.hex(), heard=heard.hex())
        counts = thinning.counts(cycle.t)
        if counts is not None:
            writer.event("counts", **counts)

    def end(self) -> tuple[str, int] | None:
        """Close it: its path and how many cycles it has; None where nothing is recorded.

        Raises:
            RecordingStopped: the disk did not take its end.
        """
        if self.writer is None:
            return None
        writer, self.writer, self.pictures = self.writer, None, False
        if self._thinning is not None:
            for kept in self._thinning.flush():
                writer.cycle(kept)
            writer.event("counts", **self._thinning.rest(self._port.clock.now()))
        writer.close()
        return str(writer.path), writer.cycles

    def failed(self, error: RecordingStopped) -> None:
        """Close what is left, and keep why for whoever asks for the recording's end."""
        with contextlib.suppress(RecordingStopped):
            self.end()
        self.stopped = error


def _channel(servo: Servo) -> ServoChannel:
    table = servo.model.registers
    names = {
        "pos": "present_position", "vel": "present_velocity", "pwm": "present_pwm",
        "volt": "present_input_voltage", "temp": "present_temperature", "tick": "realtime_tick",
    }  # fmt: skip
    scales = {name: table[register].scale for name, register in names.items()}
    scales["cur" if servo.model.has_current_sensor else "load"] = servo.model.effort.scale
    return ServoChannel(servo.joint, servo.model.name, servo.id, servo.direction, servo.zero_rad, scales)
