"""Why a motion was stopped, where a cycle's answers alone do not tell: the servos are asked, torque being off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus
from openant_tools.comms.faults import BrokenAnswer, NoAnswer
from openant_tools.comms.guards import Trip
from openant_tools.comms.hardware import Hardware
from openant_tools.comms.lateness import REMEDY
from openant_tools.comms.line import PortGone
from openant_tools.comms.restart import StopCause
from openant_tools.comms.servos import BLOCK_ADDRESS, BLOCK_SIZE, Servo
from openant_tools.comms.silence import PATIENCE_S, ask, diagnose
from openant_tools.errors import HardwareFault, OpenAntError
from openant_tools.numbers import number
from openant_tools.recording.writer import RecordingStopped

__all__ = ["cause_of", "examined", "watchdogs_tripped"]


def cause_of(error: OpenAntError) -> StopCause:
    """What ended motion, where an error did."""
    if isinstance(error, RecordingStopped):
        return StopCause.STORAGE
    if isinstance(error, PortGone):
        return StopCause.PORT
    return StopCause.SILENCE if isinstance(error, (NoAnswer, BrokenAnswer)) else StopCause.UNKNOWN


def watchdogs_tripped(hardware: Hardware, seconds: float) -> Trip | None:
    """Whether the servos' watchdogs have stopped the motion behind our back, since this process was held up so long."""
    try:
        tripped = hardware.servos.tripped_watchdogs()
    except HardwareFault:
        return None  # the guard against silence will see to it
    if not tripped:
        return None
    return Trip(
        f"this computer stood still for {number(seconds, 's')}, and the servos' Bus Watchdog stopped the motion",
        "close what else keeps it busy, or let it not go to sleep",
        cause=StopCause.STALL,
    )


def examined(trip: Trip, hardware: Hardware) -> Trip:
    """The same stop, said more exactly where it asks for that; everyone is released first."""
    late = hardware.port.clock.lateness
    if trip.joint is None and trip.cause is StopCause.SILENCE and late.busy and late.words:
        # Most servos at once: a computer that comes late loses answers as noise does.
        return replace(trip, what=f"{trip.what}; {late.words}", remedy=f"{REMEDY}; if it happens again: {trip.remedy}")
    if trip.joint is None or not trip.examine or hardware.port.bus.restless:
        return trip
    try:
        hardware.servos.torque_off_now()
        if trip.examine == "silence":
            return _who_is_silent(trip, hardware)
        if trip.examine == "behind":
            return _why_behind(trip, hardware)
        errors = hardware.servos.hardware_errors(trip.joint)
    except HardwareFault:
        return trip
    if not errors:
        return trip
    servo = hardware.servos[trip.joint]
    names = ", ".join(error.name for error in errors)
    what = f"{servo.called} reports {names}"
    return Trip(what, errors[0].advice, trip.joint, cause=StopCause.HARDWARE_ERROR)


def _why_behind(trip: Trip, hardware: Hardware) -> Trip:
    """The register that keeps a joint from where it was sent, where one differs."""
    hardware.settings.read()
    mine = [one for one in hardware.settings.differences if one.joint == trip.joint]
    if not mine:
        return trip
    return replace(trip, what=f"{trip.what}; {mine[0].what}", remedy=mine[0].mended)


def _who_is_silent(trip: Trip, hardware: Hardware) -> Trip:
    """Each servo asked alone: in a common read those behind a silent one wait for it and seem silent, too."""
    servos, bus, late = hardware.servos, hardware.port.bus, hardware.port.clock.lateness
    silent, broken = _asked_alone(bus, servos.servos)
    if not silent or len(broken) > 1 or (broken and len(silent) > 1):
        if not late.busy or broken:
            return trip
        return Trip(f"{trip.what}; {late.words}", REMEDY, trip.joint, cause=trip.cause)
    first, names = silent[0], ", ".join(servo.called for servo in silent)
    if broken:
        [other] = broken
        return Trip(
            f"{names} is silent and what comes from {other.called} is broken",
            f"probably both have id {other.id}: unplug {other.joint}, and `openant comms scan` shows it",
            first.joint,
            cause=trip.cause,
        )
    why = diagnose(bus, [servo.id for servo in silent], servos.ids, hardware.config.chain, was_there=True)
    before = f"{trip.what}: " if first.joint == trip.joint else ""
    return Trip(before + why.what, why.remedy, first.joint, cause=trip.cause)


def _asked_alone(bus: Bus, servos: Sequence[Servo]) -> tuple[list[Servo], list[Servo]]:
    """Who is silent, and from whom mostly broken answers come; waited for so long that a busy host hears a late answer, too.

    Each is asked as often as any: of two servos with one id an answer comes through whole now and then.
    """
    silent, broken = list[Servo](), list[Servo]()
    for servo in servos:
        question, answered, garbage = p2.read(servo.id, BLOCK_ADDRESS, BLOCK_SIZE).encode(), 0, 0
        for wait_s in PATIENCE_S:
            heard = ask(bus, question, wait_s, lambda h: h.answer_s is not None, servo.id)
            answered += heard.answer_s is not None
            garbage += heard.garbage > 0
        if garbage > len(PATIENCE_S) / 2:
            broken.append(servo)
        elif not answered:
            silent.append(servo)
    return silent, broken
