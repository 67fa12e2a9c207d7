"""A bus in this process: the virtual line and its servo firmware, a still motor behind each, and a clock that jumps."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.lateness import Lateness
from openant_tools.comms.line import PortGone
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import kit
from openant_tools.virtual.bus import BusSettings, Wire
from openant_tools.virtual.servo import ServoDevice
from openant_tools.virtual.servo_power import Loop, Sensed

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
class MemoryLine:
    """`comms.line.Line` and `comms.clock.Clock` in one: time jumps to whatever comes next. Subclasses say what `write` brings."""

    baud: int = 1_000_000
    path: str = "memory"
    written: int = 0
    received: int = 0
    stepped: bool = True

    def __post_init__(self) -> None:
        self.lateness = Lateness(real=False)
        self._t = 1.0
        #: (when it is there, its number, bytes), the next one first
        self._coming: list[tuple[float, int, bytes]] = []
        self._count = 0
        self._arrivals: list[tuple[int, float]] = []

    def bring(self, data: bytes, t: float) -> None:
        """Let these bytes be there from `t` on."""
        self._count += 1
        heapq.heappush(self._coming, (t, self._count, data))

    def fileno(self) -> int:
        return -1

    def read(self) -> bytes:
        out, self._arrivals = b"", []
        while self._coming and self._coming[0][0] <= self._t:
            at, _, data = heapq.heappop(self._coming)
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

    def write_from(self, t: float) -> None:
        self.sleep_until(t)

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


@dataclass(kw_only=True)
class WireLine(MemoryLine):
    """The virtual wire, with its servos."""

    wire: Wire
    path: str = "wire"
    unplugged: bool = False

    def write(self, data: bytes) -> None:
        if self.unplugged:
            raise PortGone(self.path)
        self.written += len(data)
        for reply in self.wire.receive(data, self._t, self.baud):
            self.bring(reply.data, reply.t)

    def read(self) -> bytes:
        if self.unplugged:
            raise PortGone(self.path)
        return super().read()

    def sleep_until(self, t: float) -> None:
        super().sleep_until(t)
        for servo in self.wire.servos:
            servo.watch_bus(self._t)


def ant(
    timing: BusTiming | None = None, *, firmware: int = 46, settings: BusSettings | None = None, seed: int = 0
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
    line = WireLine(wire=Wire(servos, settings, lambda t: None, seed=seed))
    names = {joint.id: joint.name for joint in JOINTS.values()}
    bus = Bus(line, line, timing or BusTiming(return_delay_s=0.0, latency_timer_s=1e-3), names)
    bus.guarded = True  # these servos end with this process
    return bus, line
