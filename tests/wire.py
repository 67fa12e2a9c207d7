"""A bus in this process: the virtual line and its servo firmware, a still motor behind each, and a clock that jumps."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from openant_tools.comms.bus import Bus, Timing
from openant_tools.comms.lateness import Lateness
from openant_tools.comms.line import PortGone
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import kit
from openant_tools.virtual.bus import BusSettings
from openant_tools.virtual.bus import Line as Wire
from openant_tools.virtual.servo import Loop, Sensed, ServoDevice

IDS = [joint.id for joint in JOINTS.values()]


@dataclass
class StillMotor:
    """Holds where it was put; torque moves it to its goal at once."""

    sensed: Sensed = field(default_factory=lambda: Sensed(pulses=2048.0))
    loop: Loop = field(default_factory=Loop)

    def sense(self) -> Sensed:
        return self.sensed

    def set_loop(self, loop: Loop) -> None:
        self.loop = loop

    def set_goal(self, pulses: float, *, velocity: float, acceleration: float, time_based: bool) -> None:
        if self.loop.torque:
            self.sensed.pulses = pulses

    def hold(self, pulses: float) -> None:
        pass


@dataclass
class WireLine:
    """`comms.line.Line` and `comms.clock.Clock` in one, over the virtual wire."""

    wire: Wire
    baud: int = 1_000_000
    path: str = "wire"
    written: int = 0
    received: int = 0
    stepped: bool = True
    unplugged: bool = False
    lateness: Lateness = field(default_factory=lambda: Lateness(real=False))

    def __post_init__(self) -> None:
        self._t = 1.0
        self._coming: deque[tuple[float, bytes]] = deque()
        self._arrivals: list[tuple[int, float]] = []

    def fileno(self) -> int:
        return -1

    def write(self, data: bytes) -> None:
        if self.unplugged:
            raise PortGone(self.path)
        self.written += len(data)
        self._coming.extend((reply.t, reply.data) for reply in self.wire.receive(data, self._t, self.baud))

    def read(self) -> bytes:
        if self.unplugged:
            raise PortGone(self.path)
        out = b""
        self._arrivals = []
        while self._coming and self._coming[0][0] <= self._t:
            at, data = self._coming.popleft()
            out += data
            self.received += len(data)
            self._arrivals.append((self.received, at))
        return out

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        pass

    def now(self) -> float:
        return self._t

    def sleep_until(self, t: float) -> None:
        self._t = max(self._t, t)
        for servo in self.wire.servos:
            servo.watch_bus(self._t)

    def wait_readable(self, line: object, deadline: float) -> bool:
        if self._coming and self._coming[0][0] <= max(deadline, self._t):
            self._t = max(self._t, self._coming[0][0])
            return True
        self.sleep_until(deadline)
        return False

    def arrivals(self, line: object) -> list[tuple[int, float]]:
        return self._arrivals

    def in_time(self, at: float, deadline: float) -> bool:
        return at <= deadline


def ant(
    timing: Timing | None = None, *, firmware: int = 46, settings: BusSettings | None = None, seed: int = 0
) -> tuple[Bus, WireLine]:
    """A bus with the eight servos of a standard Ant, set up as the guide says."""
    servos = []
    for joint in JOINTS.values():
        servo = ServoDevice(kit("standard").servo(joint.kind), StillMotor(), firmware)
        for name, counts in {"id": joint.id, "baud_rate": 3, "return_delay_time": 0}.items():
            servo.set(name, counts)
        servo.settle()
        servos.append(servo)
    settings = settings or BusSettings()
    settings.chains = [[0, 1], [2, 3], [4, 5], [6, 7]]
    line = WireLine(Wire(servos, settings, lambda t: None, seed=seed))
    names = {joint.id: joint.name for joint in JOINTS.values()}
    bus = Bus(line, line, timing or Timing(return_delay_s=0.0, latency_timer_s=1e-3), names)
    bus.guarded = True  # these servos end with this process
    return bus, line
