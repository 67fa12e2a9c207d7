"""Processes that do a part of a command's work, and end with it, however it ends: also where it is killed.

A process is told who its parent is and looks now and then whether that is still so, on every system alike. (Linux could send
a signal, but at the end of the thread that had started the process.)
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

__all__ = ["PROGRESS", "end_with", "end_with_who_started_us", "environment", "pass_on", "passed_on", "tied"]

#: s between two looks, and what a command has to save and to let go in
LOOK_S = 0.5
GRACE_S = 20.0
#: environment variable that names the process with which a command that it started is to end
ENDS_WITH = "OPENANT_ENDS_WITH"

#: environment variable that names the file descriptor on which whoever started a command wants to be told how far it is
PROGRESS = "OPENANT_PROGRESS"

_watching = threading.Event()


def end_with(parent: int, *, orderly: bool = False) -> None:
    """End this process once `parent` is not its parent any more, or is not now.

    Args:
        orderly: as SIGTERM does it, and only if that takes long at once.
    """
    if not _watching.is_set():
        _watching.set()
        threading.Thread(target=_watch, args=(parent, orderly), name="parent", daemon=True).start()


def _watch(parent: int, orderly: bool) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    if orderly:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE_S)
    os.kill(os.getpid(), signal.SIGKILL)


class tied:
    """A function as a task for processes of this machine, which end with this one: `joblib.delayed(tied(function))`."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._parent = os.getpid()

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        if os.getpid() != self._parent:
            end_with(self._parent)
        return self._function(*arguments, **named)


def environment() -> Mapping[str, str]:
    """For an `openant` command that this process starts and that is to end with it."""
    return {**os.environ, ENDS_WITH: str(os.getpid())}


def end_with_who_started_us() -> None:
    """What a command does first: obey who started it with `environment`, if anybody did."""
    parent = os.environ.pop(ENDS_WITH, "")
    if parent.isdigit():
        end_with(int(parent), orderly=True)


def pass_on(share: float, words: str) -> None:
    """Tell whoever started this command how far it is (share from 0 to 1), where that was asked for (`PROGRESS`)."""
    fd = _progress_fd()
    if fd is not None:
        with contextlib.suppress(OSError):  # nobody listens any more
            os.write(fd, f"{share:.4f} {words}\n".encode())  # for a file


def passed_on(line: str) -> tuple[float, str] | None:
    """What `pass_on` said in a line: the share from 0 to 1, and words; None where it is no such line."""
    share, _, words = line.rstrip("\n").partition(" ")
    try:
        return float(share), words
    except ValueError:
        return None


@functools.cache
def _progress_fd() -> int | None:
    # Taken out of the environment: in processes that this one starts the number is another file's.
    fd = os.environ.pop(PROGRESS, "")
    return int(fd) if fd.isdigit() else None
