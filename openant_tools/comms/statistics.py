"""What the bus did so far, per servo: losses by cause, retries, how long answers took, and the latency timer's comb."""

from __future__ import annotations

import cmath
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from openant_tools.comms.faults import Cause

__all__ = ["LATENCY_BIN_S", "BusStatistics", "Comb", "ServoStatistics", "find_comb"]

#: width of a histogram's bin; the last bin holds everything above
LATENCY_BIN_S = 0.25e-3
LATENCY_BINS = 160

#: A host that has never been told otherwise waits so long; Windows drivers ship with the same.
DEFAULT_TIMER_S = 16e-3
#: How alike the phases of arrivals must be (1: all the same), and for how long answers must have waited.
COMB_STRENGTH, COMB_WAIT_S = 0.7, 3e-3
#: answers by which it is judged
COMB_MINIMUM = 50


@dataclass(frozen=True)
class Comb:
    """Answers arrive at the ticks of an adapter's latency timer.

    Attributes:
        period_s: of the timer.
        strength: length of the mean phase vector of the arrivals, 0…1.
        wait_s: median of what answers take beyond `wire_s`.
    """

    period_s: float
    strength: float
    wait_s: float


def find_comb(arrivals: Sequence[float], rtt: Sequence[float]) -> Comb | None:
    """Whether answers come in the beat of a latency timer instead of when they are sent.

    Args:
        arrivals: times (s) at which answers were there, one a cycle.
        rtt: s from each request's first byte to that answer.
    """
    if len(arrivals) < COMB_MINIMUM:
        return None
    turns = [cmath.exp(2j * math.pi * (t / DEFAULT_TIMER_S)) for t in arrivals]
    strength = abs(sum(turns)) / len(turns)
    wait = sorted(rtt)[len(rtt) // 2]
    return Comb(DEFAULT_TIMER_S, strength, wait) if strength > COMB_STRENGTH and wait > COMB_WAIT_S else None


@dataclass
class ServoStatistics:
    """One servo's answers.

    Attributes:
        asked, answered: requests that wanted an answer, and valid answers in time.
        lost: cause → how many.
        retries: requests that were sent again; each is in `asked` too.
        alerts: answers with the alert bit.
        latency: counts per `LATENCY_BIN_S` of the time from the request's first byte to the answer's last.
    """

    asked: int = 0
    answered: int = 0
    retries: int = 0
    alerts: int = 0
    lost: dict[Cause, int] = field(default_factory=dict)
    latency: list[int] = field(default_factory=lambda: [0] * LATENCY_BINS)

    @property
    def loss(self) -> float:
        """Share of requests without a valid answer in time."""
        return 1.0 - self.answered / self.asked if self.asked else 0.0

    def latency_quantile(self, share: float) -> float | None:
        """The time (s) within which `share` of the answers came, by the upper edge of the bin."""
        goal, total = share * self.answered, 0
        for k, count in enumerate(self.latency):
            total += count
            if total >= goal and total:
                return (k + 1) * LATENCY_BIN_S
        return None


@dataclass
class BusStatistics:
    """All servos of a bus, and bytes that belonged to none."""

    noise_bytes: int = 0
    #: requests that came back to the host beside their answers
    echoes: int = 0
    #: joined reads that ended early, and returns to them after a while of whole plain ones
    fast_read_fallbacks: int = 0
    fast_read_returns: int = 0
    #: (when, rtt) of the last answer of each of the last requests, s
    arrivals: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=1000))
    _servos: dict[int, ServoStatistics] = field(default_factory=dict)
    #: (ids, bin of the latency, of each or of all) → requests that all of them answered; taken apart when looked at
    _whole: dict[tuple[tuple[int, ...], tuple[int, ...] | int], int] = field(default_factory=dict)

    @property
    def servos(self) -> dict[int, ServoStatistics]:
        """id → its statistics."""
        for (ids, bins), times in self._whole.items():
            for id, bin in zip(ids, bins if isinstance(bins, tuple) else (bins,) * len(ids), strict=True):
                servo = self._servos.setdefault(id, ServoStatistics())
                servo.asked += times
                servo.answered += times
                servo.latency[min(bin, LATENCY_BINS - 1)] += times
        self._whole.clear()
        return self._servos

    @property
    def comb(self) -> Comb | None:
        """The beat of an untouched latency timer, where it shows."""
        return find_comb([when for when, _ in self.arrivals], [rtt for _, rtt in self.arrivals])

    def of(self, id: int) -> ServoStatistics:
        return self.servos.setdefault(id, ServoStatistics())

    def count(self, id: int, cause: Cause | None, rtt: float | None, alert: bool) -> None:
        """One request to one servo: answered (`cause` None, after `rtt` s), or lost."""
        servo = self.of(id)
        servo.asked += 1
        if cause is None:
            servo.answered += 1
            servo.alerts += alert
            if rtt is not None:
                servo.latency[min(int(rtt / LATENCY_BIN_S), LATENCY_BINS - 1)] += 1
        else:
            servo.lost[cause] = servo.lost.get(cause, 0) + 1

    def count_whole(self, ids: tuple[int, ...], rtt: Sequence[float] | float) -> None:
        """One request that all of `ids` answered without alert, each after its `rtt` (s), or all at once."""
        if isinstance(rtt, float):
            key: tuple[tuple[int, ...], tuple[int, ...] | int] = ids, int(rtt / LATENCY_BIN_S)
        else:
            key = ids, tuple(int(one / LATENCY_BIN_S) for one in rtt)
        self._whole[key] = self._whole.get(key, 0) + 1

    def as_dict(self, names: Mapping[int, str] | None = None) -> dict[str, object]:
        """For JSON: per servo loss, causes, retries and latency quantiles."""
        comb = self.comb
        return {
            "comb_period_s": comb.period_s if comb else None,
            "noise_bytes": self.noise_bytes,
            "echoes": self.echoes,
            "fast_read_fallbacks": self.fast_read_fallbacks,
            "fast_read_returns": self.fast_read_returns,
            "servos": [
                {
                    "id": id,
                    **({"joint": names[id]} if names and id in names else {}),
                    "asked": servo.asked,
                    "answered": servo.answered,
                    "loss": servo.loss,
                    "lost": {cause.value: count for cause, count in sorted(servo.lost.items()) if count},
                    "retries": servo.retries,
                    "alerts": servo.alerts,
                    "latency_p50_s": servo.latency_quantile(0.5),
                    "latency_p99_s": servo.latency_quantile(0.99),
                }
                for id, servo in sorted(self.servos.items())
            ],
        }
