"""Who works on a folder: a lock that dies with its holder, however it ends, and that says who holds it.

The lock stands on a small file of its own, which is never removed nor replaced: two that look for it always find the same
one. The file names its holder, for whoever is refused.

The one file that knows how a system locks: `flock` on Linux and macOS; on Windows, where only a fake has been tried, a byte
beyond the file's end.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import itertools
import os
import shlex
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from openant_tools.errors import BadInput

__all__ = ["Claim", "Holder", "command_line", "held", "holder", "wait_for"]

#: s for which a claim is tried again: whoever only asks who holds a lock holds it for a moment, too
PATIENCE_S = 0.5
#: whether this system has `flock`; Windows has not
FLOCK: bool = importlib.util.find_spec("fcntl") is not None
#: the byte that is locked where a lock is on bytes
LOCKED_BYTE = 2**30
#: environment variable that tells the processes we start which of their ancestors' folders they work on, too
ANCESTORS = "OPENANT_HELD_BY"


@dataclass(frozen=True)
class Holder:
    """A process that holds a lock; pid 0 where it has not said who it is."""

    pid: int
    command: str

    def __str__(self) -> str:
        return f"{self.command} (process {self.pid})" if self.pid else "another program"


class Claim:
    """An exclusive lock on `path`, until `release` or until this process ends.

    Args:
        path: the lock's own file, made where it is missing, with its folder.
        words: for whoever is refused, with {} for the holder: "this robot is held by {}".
        remedy: what to do then.
        wait_s: how long to wait for whoever holds it.

    Raises:
        BadInput: another process, or another claim of this one, holds it; it is named.
        OSError: the file cannot be made.
    """

    def __init__(self, path: Path, words: str, *, remedy: str, wait_s: float = PATIENCE_S) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: IO[bytes] = path.open("ab+")
        give_up = time.monotonic() + wait_s
        while not _locked(self._file):
            if time.monotonic() > give_up:
                who = _named(self._file)
                self._file.close()
                raise BadInput(words.format(who), where=path.parent, remedy=remedy)
            time.sleep(0.003)
        self._file.truncate(0)
        self._file.write(f"{os.getpid()}\n{_own_command()}\n".encode(errors="replace"))
        self._file.flush()

    def release(self) -> None:
        """May be called again."""
        if not self._file.closed:
            self._file.truncate(0)
            self._file.close()


def holder(path: Path) -> Holder | None:
    """Who holds the lock `path`; None where nobody does, or this process, or one that started it and works on it, too."""
    if path.resolve() in _mine:
        return None
    try:
        with path.open("rb") as file:
            who = None if _locked(file, shared=True) else _named(file)
    except FileNotFoundError:
        return None
    return None if who is None or who.pid in _ancestors() else who


@contextlib.contextmanager
def held(path: Path, words: str, *, remedy: str) -> Iterator[None]:
    """Hold `path` for a block, within which this process, and those that it starts, may hold it again.

    Raises:
        BadInput: as `Claim`.
    """
    key = path.resolve()
    with _guard:
        mine = _mine.setdefault(key, _Mine())
        mine.blocks += 1
        try:
            if mine.blocks == 1 and not _held_by_ancestor(path):
                mine.claim = _claim(path, words, remedy)
        except BaseException:
            _leave(key)
            raise
    try:
        yield
    finally:
        with _guard:
            _leave(key)


@dataclass
class _Mine:
    """What this process holds: by how many blocks, and the lock; None where an ancestor has that, or nobody can."""

    blocks: int = 0
    claim: Claim | None = None


#: by the lock file's real path
_mine: dict[Path, _Mine] = {}
_guard = threading.Lock()


def _claim(path: Path, words: str, remedy: str) -> Claim | None:
    """A claim that our children know of; None in a folder that nothing can be written into."""
    try:
        claim = Claim(path, words, remedy=remedy)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EROFS):
            return None
        raise
    os.environ[ANCESTORS] = ",".join(map(str, sorted(_ancestors() | {os.getpid()})))
    return claim


def _leave(key: Path) -> None:
    mine = _mine[key]
    mine.blocks -= 1
    if not mine.blocks:
        del _mine[key]
        if mine.claim is not None:
            mine.claim.release()


def _held_by_ancestor(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return not _locked(file, shared=True) and _named(file).pid in _ancestors()
    except FileNotFoundError:
        return False


def _ancestors() -> set[int]:
    return {int(pid) for pid in os.environ.get(ANCESTORS, "").split(",") if pid.isdigit()}


def wait_for(file: IO[bytes]) -> None:
    """Lock an open file until it is closed, however long another holds it."""
    while not _locked(file):
        time.sleep(0.003)


def _locked(file: IO[bytes], *, shared: bool = False) -> bool:
    """Whether the lock was free, and now is ours until the file is closed.

    Args:
        shared: others may have it so, too: only to see whether somebody has it alone.
    """
    if not FLOCK:
        return _locked_byte(file)
    import fcntl

    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _locked_byte(file: IO[bytes]) -> bool:
    """On Windows nobody else can read what is locked: not the name of the holder, but a byte that the file does not have."""
    import msvcrt

    at = file.tell()
    file.seek(LOCKED_BYTE)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    except OSError:
        return False
    finally:
        file.seek(at)
    return True


def _named(file: IO[bytes]) -> Holder:
    """Who the file says holds it, if that process is there."""
    file.seek(0)
    pid, _, command = file.read(4096).decode(errors="replace").partition("\n")
    try:
        if FLOCK:  # signal 0 would be Ctrl-C on Windows, where a lock dies with its holder all the same
            os.kill(int(pid), 0)
    except PermissionError:
        pass  # another user's
    except (ValueError, OverflowError, OSError):
        return Holder(0, "")
    return Holder(int(pid) if pid.isdigit() else 0, " ".join(command.split()))


def _own_command() -> str:
    """This process as its user typed it, to the first option."""
    program = Path(sys.argv[0] if sys.argv else "").name
    return command_line("openant" if program in ("openant", "__main__.py") else program or "python", sys.argv[1:])


def command_line(program: str, given: Sequence[str]) -> str:
    """A program with the words that it was given, to the first option: three at most."""
    words = itertools.takewhile(lambda word: not word.startswith("-"), given[:3])
    return shlex.join([program, *words])
