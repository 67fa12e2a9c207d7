"""The errors that a user sees: one line that says what is wrong, where, and what to do about it."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path

__all__ = ["BadInput", "HardwareFault", "OpenAntError", "StorageFault", "system_fault", "system_faults"]

#: characters of a part of a message: files may hold names of any length, and they are quoted
LONGEST = 400
#: what to do about an error of the operating system; {again} is what to do once that is done
_MAKE_ROOM = "make room there, or choose another place, and {again}"
_OTHER_PLACE = "choose a place that you may write to"
_REMEDIES = {
    errno.ENOSPC: _MAKE_ROOM,
    errno.EDQUOT: _MAKE_ROOM,
    errno.EFBIG: _MAKE_ROOM,
    errno.EACCES: _OTHER_PLACE,
    errno.EPERM: _OTHER_PLACE,
    errno.EROFS: _OTHER_PLACE,
    errno.ENOTDIR: "a part of this path is a file: choose another place",
}


class OpenAntError(Exception):
    """An error meant for the person at the keyboard; the command line prints it as one line, never as a traceback.

    Args:
        what: what is wrong, in plain words.
        where: the file, and the place in it (line, column, joint, key), or the port and the servo.
        remedy: what to do about it.
    """

    exit_code = 2

    def __init__(self, what: str, *, where: str | Path | None = None, remedy: str | None = None) -> None:
        self.what = what
        self.where = None if where is None else str(where)
        self.remedy = remedy
        super().__init__(what)

    def __str__(self) -> str:
        what, where, remedy = (_one_line(part) for part in (self.what, self.where, self.remedy))
        line = f"{where}: {what}" if where else what
        return f"{line} → {remedy}" if remedy else line


def _one_line(words: str | None) -> str:
    """Words without line ends, without what would steer a terminal, and of a length that one reads."""
    text = " ".join((words or "").split())
    if not text.isprintable():
        text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} … {text[-LONGEST // 2 :]}"


class BadInput(OpenAntError):
    """Something given to us (a file, an option, a model) cannot be used as it is."""


class StorageFault(OpenAntError):
    """The disk takes no more of what is being made; what it took before is kept."""

    exit_code = 1


class HardwareFault(OpenAntError):
    """A robot, real or virtual, that does not answer as it should."""


def system_fault(error: OSError, *, where: str | Path | None = None, again: str = "repeat the command") -> OpenAntError:
    """An error of the operating system as one of ours: a full disk, a missing directory, a permission.

    Args:
        where: the place, where the error names no file.
        again: what to do once the cause is gone.
    """
    remedy = _REMEDIES.get(error.errno or 0)
    return OpenAntError(
        error.strerror or str(error),
        where=error.filename or where,
        remedy=None if remedy is None else remedy.format(again=again),
    )


@contextlib.contextmanager
def system_faults(*, where: str | Path | None = None, again: str = "repeat the command") -> Iterator[None]:
    """A block whose errors of the operating system become `system_fault`s."""
    try:
        yield
    except OSError as error:
        raise system_fault(error, where=where, again=again) from error
