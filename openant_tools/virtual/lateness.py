"""How old bytes may be when a waiting process reads them, so that a busy host is not taken for a hasty client.

Between a client's write and our reading stand the kernel's own worker, which carries bytes through a pseudo-terminal,
and this process; either may wait while others compute. Linux tells how long this thread waited, and how many want a
processor right now; where more do than there are, nobody knows how long the kernel's worker waited.
"""

from __future__ import annotations

import contextlib
import os

__all__ = ["HOP_S", "WaitTimer"]

#: s from a write to our reading on an idle machine: pseudo-terminal and waking up (measured: 0.02 to 0.06 ms).
HOP_S = 6e-5
#: A wait that takes no longer has not slept: the bytes lay there already.
SLEPT_S = 3e-5
#: of the calling thread: ns on a processor, ns of readiness without one, time slices
_SCHEDSTAT = "/proc/thread-self/schedstat"
#: "0.20 0.18 0.12 1/80 11206": the fourth field is how many are ready to run, of all
_LOADAVG = "/proc/loadavg"


class WaitTimer:
    """A stop watch for one wait; where the system tells nothing it shows `HOP_S`."""

    def __init__(self) -> None:
        self._schedstat, self._loadavg = _open(_SCHEDSTAT), _open(_LOADAVG)
        self._processors = os.cpu_count() or 1
        self._mark = 0.0

    def start(self) -> None:
        """The wait begins."""
        self._mark = self._waited()

    def seconds(self, asleep_s: float, unseen_s: float) -> float:
        """How long ago what ended the wait may have been written, s.

        Args:
            asleep_s: since `start`. unseen_s: since nothing was there to read, which is the most it can be.
        """
        in_line = self._waited() - self._mark
        if asleep_s - in_line < SLEPT_S or self._crowded():
            return unseen_s
        return min(unseen_s, in_line + HOP_S)

    def close(self) -> None:
        for file in (self._schedstat, self._loadavg):
            if file is not None:
                os.close(file)
        self._schedstat = self._loadavg = None

    def _waited(self) -> float:
        """s that this thread was ready to run and did not, since it began."""
        fields = _fields(self._schedstat)
        return int(fields[1]) * 1e-9 if len(fields) > 1 else 0.0

    def _crowded(self) -> bool:
        """Whether more want a processor now than there are."""
        fields = _fields(self._loadavg)
        return len(fields) > 3 and int(fields[3].partition(b"/")[0]) > self._processors


def _open(path: str) -> int | None:
    try:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None


def _fields(file: int | None) -> list[bytes]:
    if file is not None:
        with contextlib.suppress(OSError):
            return os.pread(file, 128, 0).split()
    return []
