"""What went wrong on the bus, in words that name the cause and the next thing to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum

from openant_tools.comms.protocol2 import Error
from openant_tools.comms.troubles import SILENCE
from openant_tools.errors import HardwareFault
from openant_tools.numbers import number

__all__ = [
    "REFUSALS", "BrokenAnswer", "Cause", "NeverSilent", "NoAnswer", "Refused", "missing_answers", "refusal_words",
]  # fmt: skip


class Cause(StrEnum):
    """Why a valid answer did not come in time; the words of `err.J` in a run table (formats, section 1)."""

    TIMEOUT = "timeout"
    CRC = "crc"
    SHORT = "short"
    LATE = "late"
    PORT = "port"
    #: a valid answer with its alert bit: no loss
    ALERT = "alert"


class _Unheard(HardwareFault):
    """Answers that did not come as they should.

    Attributes:
        ids: whose, where that is known. asked: of everyone who was asked, in order.
    """

    def __init__(
        self, what: str, *, where: str | None = None, remedy: str | None = None,
        ids: Sequence[int] = (), asked: Sequence[int] = (),
    ) -> None:  # fmt: skip
        super().__init__(what, where=where, remedy=remedy)
        self.ids, self.asked = tuple(ids), tuple(asked)


class NoAnswer(_Unheard):
    """One or more servos stayed silent. Why is for `silence` to find out, once torque is off."""


class BrokenAnswer(_Unheard):
    """Bytes came, but no answer could be read from them."""


class NeverSilent(BrokenAnswer):
    """The line talks without a pause: nobody's answer can be heard on it."""

    def __init__(self, path: str, baud: int, count: int, seconds: float) -> None:
        super().__init__(
            SILENCE["flood"].says.format(count=count, seconds=number(seconds, "s"), baud=baud),
            where=path,
            remedy=SILENCE["flood"].do,
        )


class Refused(HardwareFault):
    """The servo understood and said no.

    Attributes:
        id: which servo.
        code: its error code, see `protocol2.Error`.
    """

    def __init__(self, id: int, code: int, what: str, *, where: str | None = None, remedy: str | None = None) -> None:
        super().__init__(what, where=where, remedy=remedy)
        self.id = id
        self.code = code


#: error code → what it says, and what to do about it
REFUSALS: Mapping[int, tuple[str, str]] = {
    Error.RESULT_FAIL: (
        "it could not do it",
        "stop the motion and switch torque off first; after a shutdown reboot the servo",
    ),
    Error.INSTRUCTION: ("it does not know this instruction", "its firmware may be too old for it"),
    Error.CRC: ("our packet reached it broken", "look at the cable before this servo"),
    Error.DATA_RANGE: (
        "the value is outside the register's range, or the Bus Watchdog has tripped and locked the goals",
        "read bus_watchdog: where it reads -1, write 0 to clear it",
    ),
    Error.DATA_LENGTH: ("too few bytes for this register", "write the whole register"),
    Error.DATA_LIMIT: ("the value is beyond a limit that the servo is set to", "look at its limit registers"),
    Error.ACCESS: (
        "this register cannot be written now",
        "EEPROM is locked while torque is on: switch torque off first; read-only registers never take a write",
    ),
}


def refusal_words(code: int) -> tuple[str, str]:
    """What an error code says, and what to do about it."""
    return REFUSALS.get(code, (f"it answers with the unknown error code {code}", "look at the servo's manual"))


def missing_answers(
    asked: Sequence[str], answered: Sequence[bool], *, where: str, speed: str, ids: Sequence[int] = ()
) -> NoAnswer:
    """The error for a chain in which some servos did not answer: who is silent, and not yet why.

    Args:
        asked: the servos' names, in the order of the question. ids: theirs.
        answered: whether each did.
        where: the port.
        speed: the baud rate, spelled out.
    """
    silent = [name for name, ok in zip(asked, answered, strict=True) if not ok]
    if len(silent) == len(asked) == 1:
        what = f"{asked[0]} does not answer at {speed}"
    elif len(silent) == len(asked):
        what = f"nothing answered at {speed}: none of {len(asked)} servos"
    elif not any(answered[answered.index(False) :]):
        first = answered.index(False)
        what = f"the first {first} of {len(asked)} servos answered, then silence from {asked[first]}"
    else:
        what = f"{len(silent)} of {len(asked)} servos did not answer: {', '.join(silent)}"
    mute = [id for id, ok in zip(ids, answered, strict=True) if not ok] if ids else []
    return NoAnswer(what, where=where, remedy="`openant comms scan` asks why", ids=mute, asked=ids)
