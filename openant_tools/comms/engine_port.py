"""The engine's serial port: the line, the bus on it, its clock, and the guardian that holds the same port.

It outlives the line: a port that vanished is opened again, with the bus and its statistics as they were.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus, BusTiming
from openant_tools.comms.clock import Clock, RealClock, SteppedClock, VirtualControl
from openant_tools.comms.guardian_process import PATIENCE_S, GuardianProcess
from openant_tools.comms.line import SerialLine
from openant_tools.comms.messages import WATCHDOG_UNIT_S, EngineConfig
from openant_tools.comms.ports import WANTED_LATENCY_MS, Host, udev_rule
from openant_tools.comms.silence import reader_words
from openant_tools.comms.troubles import SILENCE

__all__ = ["EnginePort"]

#: How long the engine waits for a port that vanished to come back, between two tries.
REOPEN_PERIOD_S = 0.5


class EnginePort:
    """Port, bus and clock, guarded from the beginning.

    Args:
        notice: tells a builder a line.

    Attributes:
        lost: the port has vanished.
        alive_at: when we last were seen to be at work, s of this computer.
        asked_at: when the servos were last asked, s of `clock`.
        patience_s: silence of this process after which torque goes off.
        latency_timer_s: the adapter's, as the host tells; None where it cannot.

    Raises:
        HardwareFault: it cannot be opened, or no guardian can be started.
    """

    def __init__(self, config: EngineConfig, notice: Callable[[str], None]) -> None:
        self._config, self._notice = config, notice
        self.lost = False
        #: it went while torque was on, and nobody has switched that off since
        self.holding = False
        self._reopen_at = 0.0
        self.alive_at = -float("inf")
        self.asked_at = 0.0
        self.patience_s = max(PATIENCE_S, config.watchdog_s)
        control = VirtualControl(config.control) if config.control else None
        self.clock: Clock = RealClock(None if control is None else control.robot_pid)
        self.line = SerialLine(config.port, config.baud)
        try:
            if control is not None and control.ask("now")["stepped"]:
                self.clock = SteppedClock(control, bus=self.line)
            self.latency_timer_s = self._set_latency_timer()
            timing = BusTiming(
                write_read_gap_s=config.write_read_gap_s,
                latency_timer_s=self.latency_timer_s or BusTiming.latency_timer_s,
            )
            self.bus = Bus(self.line, self.clock, timing)
            reader = reader_words(config.port)
            if reader:
                notice(f"{reader} → {SILENCE['second_reader'].do}")
            packet = p2.sync_write(64, 1, dict.fromkeys((servo.id for servo in config.servos), b"\0")).encode()
            # A stepped robot's time stands still while nobody asks for it: then silence means nothing.
            self.guardian = GuardianProcess(packet, 0.0 if self.clock.stepped else self.patience_s)
            self.guardian.start(self.line.fileno())
        except BaseException:
            self.line.close()
            raise

    def _set_latency_timer(self) -> float | None:
        """The adapter's timer, s, set to 1 ms where that is allowed; None where the host cannot tell."""
        host, port = Host(), self._config.port
        now = host.latency_timer_ms(port)
        if now is not None and now > WANTED_LATENCY_MS and not host.set_latency_timer_ms(port):
            self._notice(
                f"the adapter's latency timer is {now} ms, each read waits so long; this sets it to 1 ms for good:\n"
                + udev_rule()
            )
        now = host.latency_timer_ms(port)
        return None if now is None else now * 1e-3

    def beat(self) -> None:
        """Tell the guardian whether torque is on."""
        self.alive_at = time.monotonic()
        self.guardian.tell(self.bus.guarded)

    def busy_reading(self) -> None:
        """Reading many registers takes a busy host a second: who reads has not stood still, and the guardian is told so."""
        self.beat()
        now = self.clock.now()
        # The servos' watchdog hears these questions, too; a longer pause is looked into by the next cycle.
        if now - self.asked_at < self._config.watchdog_s - WATCHDOG_UNIT_S:
            self.asked_at = now

    def lose(self) -> None:
        self.lost = True
        self._reopen_at = self.clock.now() + REOPEN_PERIOD_S
        self.line.close()

    def reopen(self) -> bool:
        """Whether it is there again, with a guardian; asked as often as one likes, tried every REOPEN_PERIOD_S.

        Raises:
            HardwareFault: it is still away.
        """
        if self.clock.now() < self._reopen_at:
            return False
        self._reopen_at = self.clock.now() + REOPEN_PERIOD_S
        self.guardian.dismiss()
        self.line = SerialLine(self._config.port, self._config.baud)
        self.bus.line = self.line
        if isinstance(self.clock, SteppedClock):
            self.clock.attach(bus=self.line)
        self.guardian.start(self.line.fileno())
        self.lost = False
        return True
