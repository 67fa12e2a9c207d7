"""Which cycles of a long soak are kept: everything around what is not as it should be, and now and then a healthy one.

An hour of eight servos at 100 Hz is 84 MB; an hour in which nothing happens is told by ten rows a second and counts.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from openant_tools.recording.telemetry import Cycle

__all__ = ["Thinning"]

#: s kept before and after an exception
AROUND_S = 0.3
#: s; a loop later than this is an exception
LATE_S = 0.02
#: raw counts of the supply (0.1 V) below its slow mean
DIP_COUNTS = 4.0
#: share of a new reading in the slow mean of the supply
SLOW = 0.02
#: s between two events that hold counts
COUNTS_S = 60.0


@dataclass
class Thinning:
    """Lets cycles through.

    Attributes:
        every_s: one healthy cycle in so many s is kept.
    """

    every_s: float
    joints: Sequence[str]
    _waiting: deque[tuple[Cycle, bool]] = field(default_factory=deque)
    _kept_t: float = -1e18
    _until: float = -1e18
    _volts: float | None = None
    _counts: Counter[str] = field(default_factory=Counter)
    _counted_t: float | None = None

    def take(self, cycle: Cycle) -> list[Cycle]:
        """Those to be recorded now, in order: healthy ones wait for AROUND_S whether something strange follows."""
        self._count(cycle)
        if self._strange(cycle):
            self._until = cycle.t + AROUND_S
            kept = [one for one, _ in self._waiting] + [cycle]
            self._waiting.clear()
            self._kept_t = cycle.t
            return kept
        keep = cycle.t <= self._until or cycle.t - self._kept_t >= self.every_s - 1e-6
        if keep:
            self._kept_t = cycle.t
        self._waiting.append((cycle, keep))
        kept = []
        while self._waiting and self._waiting[0][0].t < cycle.t - AROUND_S:
            one, wanted = self._waiting.popleft()
            kept += [one] if wanted else []
        return kept

    def flush(self) -> list[Cycle]:
        """Those that still wait and are wanted, at the end."""
        kept = [one for one, wanted in self._waiting if wanted]
        self._waiting.clear()
        return kept

    def counts(self, t: float) -> dict[str, Any] | None:
        """What was counted since the last time, once a minute: cycles, and losses by joint and cause."""
        if self._counted_t is None:
            self._counted_t = t
        if t - self._counted_t < COUNTS_S:
            return None
        return self.rest(t)

    def rest(self, t: float) -> dict[str, Any]:
        """What was counted since the last time."""
        seconds, self._counted_t = t - (t if self._counted_t is None else self._counted_t), t
        cycles = self._counts.pop("cycles", 0)
        told = {"seconds": round(seconds, 3), "cycles": cycles, "lost": dict(self._counts)}
        self._counts.clear()
        return told

    def _count(self, cycle: Cycle) -> None:
        self._counts["cycles"] += 1
        for joint, answer in zip(self.joints, cycle.answers, strict=True):
            if not answer.ok:
                self._counts[f"{joint} {answer.err}"] += 1

    def _strange(self, cycle: Cycle) -> bool:
        strange = (cycle.wake or 0.0) > LATE_S
        for answer in cycle.answers:
            strange = strange or not answer.ok or answer.err != ""
            volts = None if answer.raw is None else answer.raw.get("volt")
            if volts:
                if self._volts is None:
                    self._volts = float(volts)
                strange = strange or volts < self._volts - DIP_COUNTS
                self._volts += SLOW * (volts - self._volts)
        return strange
