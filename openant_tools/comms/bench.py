"""How fast this bus can go, and how much quiet it needs between a write and a read. Torque stays off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from openant_tools.comms.bus import Bus
from openant_tools.comms.reply import STATUS_OVERHEAD
from openant_tools.comms.servos import BLOCK_ADDRESS, BLOCK_SIZE
from openant_tools.numbers import number, percent

__all__ = ["GapTrial", "RateTrial", "bus_limit_hz", "measure_gap", "measure_rate"]

#: Profile Velocity: four bytes, like a goal, and harmless to write as it is.
HARMLESS_ADDRESS, HARMLESS_SIZE = 112, 4
#: As the platform's authors did (40 reads a gap), around their threshold of 0.2 ms.
GAPS_S = (0.0, 0.1e-3, 0.2e-3, 0.3e-3, 0.5e-3, 1.0e-3)
TRIES = 40


@dataclass(frozen=True)
class RateTrial:
    """Cycles of "write 8 goals, read 8 blocks" as fast as they go.

    Attributes:
        hz: cycles a second. limit_hz: what the wire would allow, see `bus_limit_hz`.
        lost: share of answers that did not come.
    """

    cycles: int
    seconds: float
    hz: float
    limit_hz: float
    lost: float

    @property
    def share(self) -> float:
        return self.hz / self.limit_hz

    @property
    def believable(self) -> bool:
        """Whether a wire of this baud rate can be so fast. Cycles whose answers are lost take no time on it."""
        return self.hz <= self.limit_hz * 1.02 and self.lost < 0.5

    @property
    def words(self) -> str:
        """The rate as a sentence; none that the wire does not allow."""
        if self.believable:
            return f"up to {number(self.hz, decimals=0)} cycles/s"
        if self.lost >= 0.5:
            return f"no rate, as {percent(self.lost)} of the answers were lost"
        return f"no rate, as this port is faster than a wire of its baud rate, which allows {number(self.limit_hz, decimals=0)} cycles/s"

    def as_dict(self) -> dict[str, float]:
        return asdict(self) | {"share": self.share}


@dataclass(frozen=True)
class GapTrial:
    """Reads that failed with a certain quiet time after a broadcast write."""

    gap_s: float
    tries: int
    failed: int


def bus_limit_hz(baud: int, servos: int, *, fast: bool, gap_s: float, return_delay_s: float = 0.0) -> float:
    """Cycles a second if host and adapter took no time: bytes on the wire, the gap, return delays.

    Sync write of goals 14 + 5n bytes; request 14 + n; answers n (11 + 27), or joined 8 + n (4 + 27) bytes
    (ROBOTIS e-manual, Protocol 2.0; ten bits a byte).
    """
    goals = 14 + servos * (HARMLESS_SIZE + 1)
    request = 14 + servos
    answers = 8 + servos * (4 + BLOCK_SIZE) if fast else servos * (STATUS_OVERHEAD + BLOCK_SIZE)
    wire = 10 * (goals + request + answers) / baud
    return 1.0 / (wire + gap_s + servos * return_delay_s)


def measure_rate(bus: Bus, ids: Sequence[int], seconds: float = 3.0) -> RateTrial:
    """Write and read as fast as the bus goes, for `seconds`."""
    values = {id: bus.read(id, HARMLESS_ADDRESS, HARMLESS_SIZE) for id in ids}
    start, cycles, lost = bus.clock.now(), 0, 0
    while (now := bus.clock.now()) - start < seconds:
        bus.sync_write(HARMLESS_ADDRESS, HARMLESS_SIZE, values)
        lost += sum(not answer.ok for answer in bus.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, ids))
        cycles += 1
    took = now - start
    limit = bus_limit_hz(
        bus.line.baud,
        len(ids),
        fast=bus.fast.issuperset(ids),
        gap_s=bus.timing.write_read_gap_s,
        return_delay_s=bus.timing.return_delay_s,
    )
    return RateTrial(cycles, took, cycles / took, limit, lost / max(1, cycles * len(ids)))


def measure_gap(bus: Bus, ids: Sequence[int]) -> tuple[list[GapTrial], float | None]:
    """Failed reads per quiet time after a write; and the smallest gap from which on none fails, or None."""
    values = {id: bus.read(id, HARMLESS_ADDRESS, HARMLESS_SIZE) for id in ids}
    kept, trials = bus.timing, list[GapTrial]()
    try:
        for gap in GAPS_S:
            bus.timing = replace(kept, write_read_gap_s=gap)
            failed = 0
            for _ in range(TRIES):
                bus.sync_write(HARMLESS_ADDRESS, HARMLESS_SIZE, values)
                failed += any(not answer.ok for answer in bus.sync_read(BLOCK_ADDRESS, BLOCK_SIZE, ids))
            trials.append(GapTrial(gap, TRIES, failed))
    finally:
        bus.timing = kept
    best = None
    for trial in reversed(trials):
        if trial.failed:
            break
        best = trial.gap_s
    return trials, best
