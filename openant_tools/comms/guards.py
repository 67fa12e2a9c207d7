"""What stops a motion: joint angles, effort, heat, voltage, alerts and silence. Functions of data in and reason out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from openant_tools.comms.bus import Answer
from openant_tools.comms.faults import Cause
from openant_tools.comms.restart import StopCause
from openant_tools.comms.servos import Block, Servo
from openant_tools.numbers import number, span

__all__ = ["Guards", "Trip", "Watch"]


@dataclass(frozen=True)
class Guards:
    """Limits that stop a motion; None switches one off.

    Attributes:
        angle_margin_rad: how far beyond its limits a joint may be measured: overshoot, not a wrong way.
        current_share, load_share: of the servo's stall current, or of its full load, over `effort_s`.
        temperature_margin_k: below the servo's own limit, at which it would shut down.
        temperature_s: for how long it must read so: whoever soaks for hours meets answers with a wrong byte.
        silent_s: a servo that does not answer for so long is lost, once it has been asked `silent_cycles` times in
            vain, too: a noisy line loses answers by chance, a busy host asks seldom.
        lost_s: a servo that does not answer for so long is lost, however often it was asked. A pause that is longer, in which nobody
            was asked, is no silence, once until it answers: more of them are slow questions.
        behind_rad: how far a joint may stand from a command that rests, beside what its gain explains; None where something may
            rightly hold it back (a scale, a stop).
    """

    angle_margin_rad: float | None = 0.2
    current_share: float | None = 0.9
    load_share: float | None = 0.95
    effort_s: float = 0.5
    temperature_margin_k: float | None = 5.0
    temperature_s: float = 0.0
    voltage: bool = True
    silent_s: float | None = 0.25
    silent_cycles: int = 20
    lost_s: float = 0.4
    behind_rad: float | None = 0.1


@dataclass(frozen=True)
class Trip:
    """Why the motion was stopped.

    Attributes:
        examine: what to look into once torque is off, to say it more exactly.
        cause: what faces decide by whether motion may go on, see `restart`.
    """

    what: str
    remedy: str
    joint: str | None = None
    examine: Literal["", "alert", "silence", "behind"] = ""
    cause: StopCause = StopCause.UNKNOWN


@dataclass
class Watch:
    """The guards over time, for one robot.

    Attributes:
        limits_rad: joint → (low, high), joint angle.
        limits_c: joint → temperature limit, as the servo has it; the maker's where it is not known.
    """

    guards: Guards
    servos: Sequence[Servo]
    limits_rad: Mapping[str, tuple[float, float]]
    limits_c: Mapping[str, float] = field(default_factory=dict)
    _strained_since: dict[int, float] = field(default_factory=dict)
    _hot_since: dict[int, float] = field(default_factory=dict)
    _heard: dict[int, float] = field(default_factory=dict)
    _missed: dict[int, Counter[Cause]] = field(default_factory=dict)
    #: when all were asked last, s, and who has not answered since a pause before that
    _asked: float = 0.0
    _excused: set[int] = field(default_factory=set)

    def reset(self, t: float) -> None:
        """Torque comes on at `t`: what was before does not count."""
        self._strained_since.clear()
        self._hot_since.clear()
        self._missed.clear()
        self._excused.clear()
        self._heard = {servo.id: t for servo in self.servos}
        self._asked = t

    def check(self, t: float, answers: Sequence[tuple[Answer, Block | None]]) -> Trip | None:
        """The first guard that trips on this cycle's answers at time `t`, if any."""
        if t - self._asked > self.guards.lost_s:
            for id in {servo.id for servo in self.servos} - self._excused:
                self._heard[id] = t
                self._missed.pop(id, None)
                self._excused.add(id)
        self._asked = t
        for servo, (answer, block) in zip(self.servos, answers, strict=True):
            if block is None:
                trip = self._silence(t, servo, answer)
            else:
                self._heard[servo.id] = t
                self._missed.pop(servo.id, None)
                self._excused.discard(servo.id)
                trip = self._measured(t, servo, answer, block)
            if trip is not None:
                return trip
        return None

    def _silence(self, t: float, servo: Servo, answer: Answer) -> Trip | None:
        silent = t - self._heard.setdefault(servo.id, t)
        missed = self._missed.setdefault(servo.id, Counter())
        missed[answer.cause or Cause.SHORT] += 1
        limit = self.guards.silent_s
        if (
            limit is None
            or silent < limit
            or (missed.total() < self.guards.silent_cycles and silent < self.guards.lost_s)
        ):
            return None
        everyone: Counter[Cause] = sum(self._missed.values(), Counter())
        if len(self._missed) > len(self.servos) / 2 and _broken(everyone) > everyone.total() / 25:
            return Trip(
                f"{len(self._missed)} of {len(self.servos)} servos have not been heard for up to {number(silent, 's', decimals=2)}, what "
                f"comes is broken ({_words(everyone)})",
                "noise on the bus, or a loose connector near the adapter: look at the first cables and the ground",
                cause=StopCause.SILENCE,
            )
        causes = _words(missed)
        broken = _broken(missed) > missed.total() / 4
        return Trip(
            f"{servo.called} has not answered for {number(silent, 's', decimals=2)} ({causes})",
            "its answers come broken: two servos with one id, a loose connector, or noise"
            if broken
            else "`openant comms scan` asks why",
            servo.joint,
            "silence",
            StopCause.SILENCE,
        )

    def _measured(self, t: float, servo: Servo, answer: Answer, block: Block) -> Trip | None:
        guards, model, place = self.guards, servo.model, servo.called
        if answer.alert:
            remedy = "read its hardware error status"
            return Trip(f"{place} raises its alert bit", remedy, servo.joint, "alert", StopCause.HARDWARE_ERROR)
        if guards.angle_margin_rad is not None and servo.joint in self.limits_rad:
            angle = servo.to_joint(model.registers["present_position"].to_si(block.position))
            low, high = self.limits_rad[servo.joint]
            if not low - guards.angle_margin_rad <= angle <= high + guards.angle_margin_rad:
                return Trip(
                    f"{place} is at {number(angle, 'rad')}, outside its limits {span(low, high, 'rad')}",
                    "look for a wrong zero, a reversed joint, or something that pushes it",
                    servo.joint,
                    cause=StopCause.LIMITS,
                )
        strained = (
            guards.current_share is not None
            and abs(model.effort.to_si(block.effort)) > guards.current_share * model.stall_current_a
            if model.has_current_sensor
            else guards.load_share is not None and abs(model.effort.to_si(block.effort)) > guards.load_share
        )
        if strained:
            since = self._strained_since.setdefault(servo.id, t)
            if t - since >= guards.effort_s:
                amount = model.effort.to_si(block.effort)
                unit = " A" if model.has_current_sensor else " of full load"
                return Trip(
                    f"{place} pushes with {number(amount, unit)} for {number(t - since, 's', decimals=1)}",
                    "free the joint: is a leg blocked, or the load too much?",
                    servo.joint,
                    cause=StopCause.OVERLOAD,
                )
        else:
            self._strained_since.pop(servo.id, None)
        if guards.temperature_margin_k is not None:
            limit = self.limits_c.get(servo.joint, model.temperature_limit_c)
            if block.temperature < limit - guards.temperature_margin_k:
                self._hot_since.pop(servo.id, None)
            elif t - self._hot_since.setdefault(servo.id, t) >= guards.temperature_s:
                return Trip(
                    f"{place} is at {block.temperature} °C, {number(limit, '°C')} is its limit",
                    "let it cool for 20 minutes and take load off this joint",
                    servo.joint,
                    cause=StopCause.HEAT,
                )
        if guards.voltage:
            volts, (low, high) = block.voltage * 0.1, model.supply_range_v
            if not low <= volts <= high + 0.5:
                return Trip(
                    f"{place} is supplied with {number(volts, 'V', decimals=1)}, it needs {span(low, high, 'V', decimals=1)}",
                    "look at the power connector and the supply under load",
                    servo.joint,
                    cause=StopCause.VOLTAGE,
                )
        return None


def _broken(missed: Counter[Cause]) -> int:
    """Answers that came, but not as they were sent."""
    return missed[Cause.CRC] + missed[Cause.SHORT]


_READS = {
    Cause.TIMEOUT: "no answer", Cause.CRC: "broken", Cause.SHORT: "cut short", Cause.LATE: "too late", Cause.PORT: "port gone",
}  # fmt: skip


def _words(missed: Counter[Cause]) -> str:
    return ", ".join(f"{count} × {_READS.get(cause, cause.value)}" for cause, count in missed.most_common())
