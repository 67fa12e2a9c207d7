"""How late this computer is: one measure for the engine's loop, for a single question, and for recordings.

Late is what the system took beyond what it was asked for: a wait that returned after its deadline, a thread that was
ready to run and did not. A servo, a cable or an adapter cannot cause either, so what is lost meanwhile is no finding
about them. A virtual robot in real time is a process of this computer, and its share counts, too.
"""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.numbers import number, percent
from openant_tools.recording.run import Run

__all__ = [
    "LATE_S", "REMEDY", "Lateness", "Losses", "late_rows", "lateness_words", "losses", "of_wake", "processor_s",
]  # fmt: skip

#: What a deadline leaves to the operating system (`bus.BusTiming.margin_s`): later than that, answers are missed.
LATE_S = 4e-3
#: Fewer late cycles than this say nothing of a whole measurement: every desktop has some.
SHARE = 0.005
#: Share of time in which somebody waited for a processor, from which on a computer is called busy.
BUSY = 0.25
#: Rows, and share of all rows, that must be left to conclude anything about servos and cables.
FEWEST, ENOUGH = 100, 0.05
REMEDY = "close what keeps this computer busy, and run it again"
#: of a thread: ns on a processor, ns of readiness without one, time slices
_OWN, _OF = "/proc/thread-self/schedstat", "/proc/{}/schedstat"
_PRESSURE = "/proc/pressure/cpu"


@dataclass
class Lateness:
    """One process's waits, and what it and a virtual robot waited for a processor.

    Attributes:
        robot_pid: of a virtual robot that runs in real time on this computer.
        real: whether this computer's time counts; a stepped robot's stands still meanwhile, and only what is noted counts.
        cycles, late: turns of a loop, and those that were late by more than `LATE_S`.
        worst_s: the latest.
    """

    robot_pid: int | None = None
    real: bool = True
    cycles: int = 0
    late: int = 0
    worst_s: float = 0.0
    _noted_s: float = 0.0
    _files: tuple[int, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        paths = [_OWN] + ([_OF.format(self.robot_pid)] if self.robot_pid else [])
        self._files = tuple(file for file in map(_open, paths) if file is not None) if self.real else ()
        self._queued_s = self._queue()
        self._began = time.monotonic(), _pressure_s() if self.real else None

    def note(self, seconds: float) -> None:
        """A wait returned so many s after it should have; negative where it did not."""
        if seconds > self._noted_s:
            self._noted_s = seconds
            self.worst_s = max(self.worst_s, seconds)

    def mark(self) -> None:
        """A cycle begins here: what was before belongs to none."""
        self._queued_s, self._noted_s = self._queue(), 0.0

    def cycle(self, wake_s: float = 0.0) -> float:
        """How late (s) the cycle was that ends now, by its wake-up `wake_s`, its waits and the run queues; counted."""
        queued = self._queue()
        seconds = max(wake_s, self._noted_s, queued - self._queued_s)
        self._queued_s, self._noted_s = queued, 0.0
        self.cycles += 1
        self.late += seconds > LATE_S
        self.worst_s = max(self.worst_s, seconds)
        return seconds

    @property
    def share(self) -> float:
        """Of the cycles, those that were late."""
        return self.late / self.cycles if self.cycles else float(self.worst_s > LATE_S)

    @property
    def pressure(self) -> float:
        """Share of the time since this measure began in which some process waited for a processor; 0 where the system
        does not tell."""
        (began, before), now = self._began, _pressure_s()
        return 0.0 if before is None or now is None else min(1.0, (now - before) / max(time.monotonic() - began, 1e-3))

    @property
    def busy(self) -> bool:
        """Whether this computer was late often enough that losses may be its own."""
        return self.share > SHARE

    @property
    def words(self) -> str:
        """How late it was, as a sentence; empty where it was not."""
        said = lateness_words(self.worst_s, self.late, self.cycles)
        if said and self.pressure > BUSY:
            said += f" (programs waited for a processor {percent(self.pressure)} of the time)"
        return said

    def close(self) -> None:
        for file in self._files:
            with contextlib.suppress(OSError):
                os.close(file)
        self._files = ()

    def _queue(self) -> float:
        """s that this thread and the robot's were ready to run and did not."""
        total = 0
        for file in self._files:
            try:
                fields = os.pread(file, 64, 0).split()
            except OSError:
                continue  # the robot is gone
            total += int(fields[1]) if len(fields) > 1 else 0
        return total * 1e-9


def of_wake(wake: NDArray[np.float64]) -> str:
    """How late the computer was that recorded these wake-ups, (n,) s, as a sentence; empty where it was not."""
    known = wake[np.isfinite(wake)]
    return lateness_words(float(known.max()), int((known > LATE_S).sum()), len(known)) if len(known) else ""


@dataclass(frozen=True)
class Losses:
    """What a run says of the bus, apart from what this computer missed.

    Attributes:
        lost: (n, joints) answers that did not come while this computer was punctual.
        rows: (n,) the rows in which it was.
        words: how late it was and what it missed by that, as a sentence; empty where that is nothing.
        judged: whether enough rows are left to conclude anything from.
    """

    joints: tuple[str, ...]
    lost: NDArray[np.bool_]
    rows: NDArray[np.bool_]
    words: str
    judged: bool

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(reads, joints) what was lost in the rows that count; of no reads where nothing can be concluded."""
        return self.lost[self.rows] if self.judged else self.lost[:0]


def losses(run: Run) -> Losses:
    """The losses of a recording that are no fault of this computer: a late answer is none, either."""
    missed = run.signal("ok", default=1.0) < 0.5
    wake = run.column("wake")
    late = late_rows(wake)
    word = np.column_stack([run.columns.get(f"err.{joint}", np.full(len(run.t), "")) == "late" for joint in run.joints])
    lost = missed & ~late[:, None] & ~word
    excused = float((missed & ~lost).mean()) if missed.size else 0.0
    words = ""
    if excused > 0:
        how = of_wake(wake) or "answers came late"
        words = f"{how}: {percent(excused, decimals=1)} of all answers were missed by that, and say nothing of servos and cables"
    enough = int((~late).sum()) >= max(FEWEST, ENOUGH * len(late))
    return Losses(run.joints, lost, ~late, words, enough or not excused)


def late_rows(wake: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(n,) the rows of which nothing is to be concluded: the computer was late in them, or in one beside them.

    Args:
        wake: (n,) s, how late it was in each row; NaN where nobody knows.
    """
    late = np.nan_to_num(wake) > LATE_S
    around: NDArray[np.bool_] = late | np.r_[late[1:], False] | np.r_[False, late[:-1]]
    return around


def lateness_words(worst_s: float, late: int, cycles: int) -> str:
    """How late it was, as a sentence; empty where it was not."""
    if worst_s <= LATE_S or (cycles and late <= SHARE * cycles):
        return ""
    often = f" in {percent(late / cycles)} of cycles" if cycles else ""
    return f"this computer was late by up to {number(worst_s, 's')}{often}"


def processor_s(pid: int) -> float | None:
    """s that a process and those that it started have had a processor, so far; None where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        children = [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()]
    except (OSError, ValueError):
        return None
    used = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return used + sum(processor_s(child) or 0.0 for child in children)


def _pressure_s() -> float | None:
    """s in which some process waited for a processor, since this computer started."""
    try:
        with open(_PRESSURE, encoding="ascii") as file:
            return int(file.readline().rpartition("total=")[2]) * 1e-6
    except (OSError, ValueError):
        return None


def _open(path: str) -> int | None:
    try:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None
