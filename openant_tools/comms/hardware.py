"""A robot that the engine has taken over: its servos set up for motion, their settings, what guards them, its sensors.

Whatever an earlier program left is told and put right first. From the moment that the servos are known, torque goes off
however the engine ends.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.bench import bus_limit_hz
from openant_tools.comms.body_sensors import BodySensors
from openant_tools.comms.engine_port import EnginePort
from openant_tools.comms.faults import BrokenAnswer, NeverSilent, NoAnswer
from openant_tools.comms.following import Following
from openant_tools.comms.guards import Watch
from openant_tools.comms.line import PortGone
from openant_tools.comms.messages import WATCHDOG_UNIT_S, EngineConfig
from openant_tools.comms.servo_settings import ServoSettings
from openant_tools.comms.servos import Servo, Servos
from openant_tools.comms.silence import explaining
from openant_tools.comms.state import EXTENDED_POSITION, POSITION, in_words, refusal, stopping
from openant_tools.errors import HardwareFault, StorageFault
from openant_tools.numbers import exact, number, percent
from openant_tools.procedure.journal import EepromWrite, Journal
from openant_tools.robot.registers import PWM_FULL

__all__ = ["Hardware", "changes", "report_leftovers", "take_over", "torque_off"]

#: From this firmware on servos have a Bus Watchdog.
WATCHDOG_FIRMWARE = 38
#: Bits with which a servo switches torque on by itself (firmware ≥ 45): at a goal, and as it starts.
UNASKED_FIRMWARE, UNASKED = 45, {"drive_mode": 8, "startup_configuration": 1}
#: How long torque off is sent again where servos do not confirm it.
RELEASE_S = 0.5
#: How long a program that ends waits for a port that went while torque was on, and how often it looks.
PLUGGED_IN_S, LOOK_S = 3.0, 0.05


def torque_off(port: EnginePort, servos: Servos, notice: Callable[[str], None]) -> list[str]:
    """Release every servo, again and again until each has confirmed or time is up: the line may be bad.

    Returns:
        Joints that do not confirm it.
    """
    port.holding |= port.lost and port.bus.guarded
    port.bus.guarded = False
    if port.lost:
        return []
    left, give_up = list(servos.joints), port.clock.now() + RELEASE_S
    try:
        while left:
            servos.torque_off_now()
            left = servos.still_on(left)
            if port.clock.now() > give_up:
                break
    except PortGone:
        port.lose()
        port.holding = True
        return []
    if left:
        notice(
            f"torque off was sent to {', '.join(left)}, but they do not confirm: the servos' own watchdog stops them"
        )
    return left


def report_leftovers(servos: Servos, notice: Callable[[str], None]) -> None:
    """What an earlier program left: torque on and tripped watchdogs, which end here, and hardware errors."""
    on = [joint for joint, value in servos.read_all("torque_enable").items() if value]
    tripped = servos.tripped_watchdogs()
    if on:
        notice(f"torque was still on at {', '.join(on)}: it is off now")
        servos.set_torque(False, on)
    for joint in tripped:
        servos.write_counts("bus_watchdog", joint, 0)
    if tripped:
        notice(
            f"the Bus Watchdog of {', '.join(tripped)} had tripped, since nothing reached them for a while, "
            "and had locked the goals: cleared"
        )
    for joint, status in servos.read_all("hardware_error_status").items():
        if status:
            for error in servos.hardware_errors(joint):
                notice(f"{servos[joint].called} reports {error.name}: {error.advice}")


@dataclass
class Hardware:
    """Servos and sensors behind an open port.

    Attributes:
        following: judges whether joints go where they are sent; None where something may rightly hold them back.
        eeprom_writes: what was written to the servos' memory to set them up.
    """

    config: EngineConfig
    port: EnginePort
    servos: Servos
    settings: ServoSettings
    watch: Watch
    following: Following | None
    sensors: BodySensors
    eeprom_writes: list[EepromWrite]
    _notice: Callable[[str], None]
    #: whether servos without a Bus Watchdog were named
    _unwatched_told: bool = field(default=False, init=False)

    def description(self) -> dict[str, Any]:
        """What a face is told of it when it is connected."""
        return {
            "joints": self.servos.joints,
            "firmware": {servo.joint: servo.firmware for servo in self.servos.servos},
            "registers": self.settings.registers,
            "differences": self.settings.differences,
            "position": self.measure(),
            "stepped": self.port.clock.stepped,
            "eeprom_writes": self.eeprom_writes,
            "latency_timer_s": self.port.bus.timing.latency_timer_s,
            "pid": os.getpid(),
            "guardian_pid": self.port.guardian.pid,
        }

    def measure(self) -> NDArray[np.float64]:
        """Joint angles (joints,) rad, as of now."""
        positions = self.servos.read_all("present_position")
        return np.array(self.servos.joint_rad([positions[joint] for joint in self.servos.joints]))

    def look_at_registers(self, *, moves: bool) -> None:
        """Read what is set in the servos anew.

        Raises:
            HardwareFault: something is to move, and they make its motion wrong or unsafe.
        """
        new = self.settings.read()
        if self.following is not None:
            self.following.take(self.settings.registers)
        for words in in_words(new):
            self._notice(words)
        wrong = stopping(self.settings.differences)
        if wrong and moves and not self.config.anyway:
            what, remedy = refusal(wrong)
            raise HardwareFault(what, where=self.config.port, remedy=remedy)

    def switch_on(self) -> list[int]:
        """Torque on where the robot stands, guarded before: goals are set to what is measured before and after.

        Returns:
            The goals, counts.
        """
        servos = self.servos
        self._guard()
        # A motion that was gentle, and was killed, has left its limit behind.
        for joint, counts in servos.read_all("goal_pwm").items():
            full = self.settings.registers[joint]["pwm_limit"]
            if counts != full:
                servos.write_counts("goal_pwm", joint, full)
        positions = servos.read_all("present_position")
        goals = [positions[joint] for joint in servos.joints]
        servos.write_goals(goals)
        servos.set_torque(True)
        servos.write_goals(goals)
        return goals

    def _guard(self) -> None:
        """What must be before torque is: a guardian, and the Bus Watchdog of every servo that has one, armed."""
        port, servos = self.port, self.servos
        if port.guardian.pid is None:
            port.guardian.start(port.line.fileno())
        for joint in servos.tripped_watchdogs():
            servos.write_counts("bus_watchdog", joint, 0)  # or the goals stay locked
        able = [servo.joint for servo in servos.servos if (servo.firmware or 0) >= WATCHDOG_FIRMWARE]
        for joint in able:
            servos.write_counts("bus_watchdog", joint, round(self.config.watchdog_s / WATCHDOG_UNIT_S))
        unable = [joint for joint in servos.joints if joint not in able]
        if unable and not self._unwatched_told:
            self._unwatched_told = True
            self._notice(
                f"{', '.join(unable)} {'has' if len(unable) == 1 else 'have'} no Bus Watchdog (firmware below "
                f"{WATCHDOG_FIRMWARE}): should this program and its guardian die at once, nothing stops the motion"
            )
        port.bus.guarded = True
        port.beat()

    def torque_off(self) -> list[str]:
        """Joints that do not confirm it."""
        return torque_off(self.port, self.servos, self._notice)


# ---- taking over ---------------------------------------------------------------------------------------------------


def take_over(
    config: EngineConfig,
    port: EnginePort,
    sensors: BodySensors,
    owned: contextlib.ExitStack,
    notice: Callable[[str], None],
) -> Hardware:
    """Find the servos, set them up for motion unless `config.still`, and open the sensors.

    Args:
        owned: what is done when the engine ends, whatever happens; torque off joins it once the servos are known.

    Raises:
        HardwareFault: a servo is missing, or cannot be set up.
    """
    with explaining(port.bus, config.chain):
        found = Servos(port.bus, config.servos).identify()
        known = [replace(servo, firmware=found[servo.joint].firmware) for servo in config.servos]
        servos = Servos(port.bus, known, before_write=partial(_note_write, config.journal))
        owned.callback(_release, port, servos, notice)
        try:
            return _set_up(config, port, servos, sensors, notice)
        except (NoAnswer, BrokenAnswer) as fault:
            # An earlier program may have left torque on, and those who are asked why must not move.
            if not isinstance(fault, NeverSilent):
                torque_off(port, servos, notice)
            raise


def _set_up(
    config: EngineConfig,
    port: EnginePort,
    servos: Servos,
    sensors: BodySensors,
    notice: Callable[[str], None],
) -> Hardware:
    report_leftovers(servos, notice)
    model, timing = servos.servos[0].model, port.bus.timing
    longest = max(servos.read_all("return_delay_time").values()) * model.registers["return_delay_time"].scale
    port.bus.timing = replace(timing, return_delay_s=longest)
    _compare_rate(config, port, servos, notice)
    if port.latency_timer_s is None:
        measured = port.bus.measure_latency_timer(servos.ids[0])
        port.bus.timing = replace(port.bus.timing, latency_timer_s=round(measured, 3))
    if not config.still:
        for joint, table in config.registers.items():
            for register, counts in table.items():
                servos.write_counts(register, joint, counts)
        _ensure_position_mode(config, servos)
        _ensure_torque_waits(servos)
    eeprom_writes = list(servos.journal)
    for words in changes(eeprom_writes):
        notice(words)
    servos = Servos(port.bus, _on_this_turn(config, servos), before_write=servos.before_write)
    settings = ServoSettings(config, port, servos)
    for words in in_words(settings.differences):
        notice(words)
    following = None
    if config.guards.behind_rad is not None:
        following = Following(servos.servos, config.guards.behind_rad, settings.registers)
    hottest = {joint: float(table["temperature_limit"]) for joint, table in settings.registers.items()}
    watch = Watch(config.guards, servos.servos, config.limits_rad, hottest)
    sensors.open(config, port.clock, notice)
    return Hardware(config, port, servos, settings, watch, following, sensors, eeprom_writes, notice)


def _note_write(journal: str | None, change: EepromWrite) -> None:
    if journal is None:
        return
    try:
        Journal(Path(journal)).append(change, "engine")
    except OSError as error:
        raise StorageFault(
            f"the journal cannot be written ({error.strerror or error}), so {change.register} of {change.joint} was not "
            "written to its servo",
            where=journal,
            remedy="make room there, or make the robot's folder one that can be written to, and try again",
        ) from error


def _release(port: EnginePort, servos: Servos, notice: Callable[[str], None]) -> None:
    """The end of it all: where it fails the guardian, who is not sent home then, tries once more as this process ends.

    Where the port went with torque on it is waited for: servos whose watchdog has stopped them hold until they are told.
    """
    try:
        give_up = port.clock.now() + PLUGGED_IN_S
        while port.lost and port.holding and not port.clock.stepped and port.clock.now() < give_up:
            with contextlib.suppress(HardwareFault):
                if port.reopen():
                    report_leftovers(servos, notice)
                    break
                port.clock.sleep_until(port.clock.now() + LOOK_S)
        torque_off(port, servos, notice)
    except HardwareFault as error:
        port.guardian.forsake()
        notice(str(error))


def _compare_rate(config: EngineConfig, port: EnginePort, servos: Servos, notice: Callable[[str], None]) -> None:
    """Say where more cycles a second are wanted than the wire allows."""
    bus = port.bus
    limit = bus_limit_hz(
        config.baud, len(config.servos), fast=bus.fast.issuperset(servos.ids), gap_s=config.write_read_gap_s,
        return_delay_s=bus.timing.return_delay_s,
    )  # fmt: skip
    if config.rate_hz > limit:
        notice(
            f"{exact(config.rate_hz)} cycles/s are wanted, and {len(config.servos)} servos at {config.baud} baud allow "
            f"{number(limit, decimals=0)}: rows come as fast as they can → a higher baud rate, no return delay (`openant calib "
            "inventory`), or a lower rate"
        )


def _ensure_position_mode(config: EngineConfig, servos: Servos) -> None:
    """Position mode where the joint's range lies within the encoder's turn, else extended position mode."""
    for joint, mode in servos.read_all("operating_mode").items():
        servo = servos[joint]
        low, high = config.limits_rad.get(joint, (0.0, 0.0))
        ends = servo.to_servo(low) % (2 * np.pi), servo.to_servo(high) % (2 * np.pi)
        across_the_seam = (ends[1] - ends[0]) * servo.direction < 0
        if mode != EXTENDED_POSITION and (mode != POSITION or across_the_seam):
            servos.write_counts("operating_mode", joint, EXTENDED_POSITION)


def _ensure_torque_waits(servos: Servos) -> None:
    """No servo switches torque on by itself: one that starts anew after a drop of its supply would jump, unguarded."""
    able = [servo.joint for servo in servos.servos if (servo.firmware or 0) >= UNASKED_FIRMWARE]
    for register, bit in UNASKED.items() if able else ():
        for joint, value in servos.read_all(register, able).items():
            if value & bit:
                servos.write_counts(register, joint, value & ~bit)


def _on_this_turn(config: EngineConfig, servos: Servos) -> list[Servo]:
    """The servos with zeros moved by whole turns, so that each joint reads near the middle of its limits.

    In extended position mode a servo counts over turns, and which one it starts on is chance.
    """
    positions = servos.read_all("present_position")
    moved: list[Servo] = []
    for servo in servos.servos:
        low, high = config.limits_rad.get(servo.joint, (0.0, 0.0))
        seen = positions[servo.joint] * servo.model.registers["present_position"].scale
        turns = round((seen - servo.to_servo((low + high) / 2)) / (2 * np.pi))
        moved.append(replace(servo, zero_rad=servo.zero_rad + turns * 2 * np.pi))
    return moved


def changes(writes: Sequence[EepromWrite]) -> Iterator[str]:
    """What was written to the servos' memory, one line for all that got the same."""
    alike: dict[tuple[str, int, int], list[EepromWrite]] = {}
    for write in writes:
        alike.setdefault((write.register, write.old, write.new), []).append(write)
    for (register, old, new), found in alike.items():
        who = f"{len(found)} servos" if len(found) > 1 else f"{found[0].joint} (id {found[0].id})"
        change = f"{register} {old} → {new}"
        power = f"at most {percent(new / PWM_FULL)} of full power, as robot.toml says ({change})"
        yield f"{who}: {power if register == 'pwm_limit' else change}"
