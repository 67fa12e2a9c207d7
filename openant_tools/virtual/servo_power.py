"""A servo under power: boot, torque, protection, the Bus Watchdog, its position, and what it tells its motor to do.

What it knows of its motor comes through `Motor`, which the physics implements, so that any plant can stand behind it.
Where the vendor's manual is silent a choice is made here, marked "unpublished".
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from openant_tools.robot.control_table import AMPERE_PER_COUNT
from openant_tools.robot.registers import EEPROM_END, PULSES_PER_TURN, PWM_FULL, RAD_S_PER_COUNT
from openant_tools.robot.servo import BAUD_CODES, ServoModel
from openant_tools.virtual.servo_registers import (
    CURRENT_MODE,
    MEMORY,
    POSITION_MODE,
    PWM_MODE,
    REVERSED,
    TIME_BASED,
    ServoRegisters,
)

__all__ = ["Loop", "Motor", "PoweredServo", "Sensed", "ServoSnapshot"]

#: Bits of Hardware Error Status (70) and of the mask Shutdown (63).
VOLTAGE_ERROR, HEAT_ERROR, ENCODER_ERROR, SHOCK_ERROR, OVERLOAD_ERROR = 0x01, 0x04, 0x08, 0x10, 0x20

PULSES_S_PER_COUNT = RAD_S_PER_COUNT * PULSES_PER_TURN / (2 * math.pi)
#: s, a count of the Bus Watchdog (98)
WATCHDOG_UNIT_S = 0.02
#: from here on the Bus Watchdog's one byte is below zero: it has stopped the motion
TRIPPED = 128
#: ms after which the Realtime Tick (120) begins anew
TICK_WRAP = 32768
#: In position mode an offset beyond a quarter of a turn is ignored (e-manual, Homing Offset).
HOMING_LIMIT_POSITION = 1024

# Unpublished: how near to the goal "in position" is, and how far behind the trajectory "following error" is.
IN_POSITION_PULSES = 20
FOLLOWING_ERROR_PULSES = 128

_DYNAMIC = struct.Struct("<HBBhhiiiiHB")  # 120 … 146
DYNAMIC_AT, DYNAMIC_END = 120, 147
_I32 = struct.Struct("<i")
#: Set to their defaults by a new operating mode.
RAM_CHANGED_BY_MODE = (
    "velocity_i_gain", "velocity_p_gain", "position_d_gain", "position_i_gain", "position_p_gain",
    "feedforward_2nd_gain", "feedforward_1st_gain",
)  # fmt: skip
GOALS = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})


@dataclass(slots=True)
class Sensed:
    """What a servo's electronics measure at one instant, in the shaft's own frame (+ counter-clockwise).

    Attributes:
        pulses: encoder, counted on over turns since power-on (1/4096 turn).
        velocity: rad/s, as the firmware's filter gives it.
        current: A in the winding. duty: applied, −1…1. voltage: V at the servo. temperature: °C of the case.
        trajectory, trajectory_velocity: the profile's position in pulses of the control table, and pulses/s.
        profile_active: a profile runs. profile_shape: 0 none, 1 rectangle, 2 triangle, 3 trapezoid.
    """

    pulses: float
    velocity: float = 0.0
    current: float = 0.0
    duty: float = 0.0
    voltage: float = 12.0
    temperature: float = 25.0
    trajectory: float = 0.0
    trajectory_velocity: float = 0.0
    profile_active: bool = False
    profile_shape: int = 0


@dataclass(slots=True)
class Loop:
    """Settings of the control loop as registers hold them (counts; gains not yet divided).

    `present = direction · encoder + offset`, in pulses of the control table.
    """

    torque: bool = False
    mode: int = POSITION_MODE
    direction: int = 1
    offset: float = 0.0
    p_gain: float = 0.0
    i_gain: float = 0.0
    d_gain: float = 0.0
    velocity_p_gain: float = 0.0
    velocity_i_gain: float = 0.0
    feedforward_velocity: float = 0.0
    feedforward_acceleration: float = 0.0
    pwm_limit: float = PWM_FULL
    goal_pwm: float = 0.0
    goal_current: float = 0.0
    goal_velocity: float = 0.0


class Motor(Protocol):
    """The motor side of one servo."""

    def sense(self) -> Sensed:
        """What the electronics measure now."""

    def set_loop(self, loop: Loop) -> None:
        """Take new loop settings at once."""

    def set_goal(self, pulses: float, *, velocity: float, acceleration: float, time_based: bool) -> None:
        """A new goal position with the profile registers in force (counts, or ms where `time_based`)."""

    def hold(self, pulses: float) -> None:
        """Stand at a position without a profile: torque-on, boot, watchdog."""


@dataclass(slots=True)
class ServoSnapshot:
    """What survives a power cut: the EEPROM area and the backup."""

    eeprom: bytes
    backup: bytes | None = None


@dataclass(slots=True)
class _Pending:
    """What takes effect once the reply has left."""

    baud: bool = False
    reboot: bool = False


class PoweredServo(ServoRegisters):
    """One servo, without a bus.

    Args:
        model: its control table and ratings.
        motor: the motor behind it.
        firmware: its version; decides which registers and instructions exist.
        persist: called with a `ServoSnapshot` whenever what survives a power cut has changed.
        reboot_s: how long it is mute after a reboot or power-on (unpublished; 0.3…0.5 s).
        clock_ppm: parts per million by which the servo's crystal runs fast.

    Attributes:
        shut_down: shutdown has switched torque off until a reboot.
    """

    def __init__(
        self,
        model: ServoModel,
        motor: Motor,
        firmware: int = 46,
        persist: Callable[[ServoSnapshot], None] | None = None,
        reboot_s: float = 0.4,
        clock_ppm: float = 0.0,
    ) -> None:
        super().__init__(model, firmware)
        self.motor, self.persist, self.reboot_s, self.clock_ppm = motor, persist, reboot_s, clock_ppm
        self.shut_down, self.powered = False, True
        self._backup: bytes | None = None
        self._reg_write: tuple[int, bytes] | None = None
        self._base = 0
        self._mute_until = 0.0
        self.booted_at = 0.0
        self._heard_at = 0.0
        self._pending = _Pending()
        self._baud = 0
        self.load_defaults(0, EEPROM_END)
        self.boot(0.0, mute=False)

    @property
    def baud(self) -> int:
        """The rate in force, bits/s: a written one comes into force after the reply."""
        return self._baud

    # ---- power ----

    def boot(self, now: float, *, mute: bool = True) -> None:
        """Power-on or reboot: RAM to its defaults, position folded to one turn, mute for `reboot_s`."""
        self.load_defaults(EEPROM_END, MEMORY)
        self.shut_down = False
        self._reg_write = None
        self._pending = _Pending()
        self._baud = BAUD_CODES[self.memory[8]]
        self.booted_at = self._heard_at = now
        self._mute_until = now + self.reboot_s if mute else now
        self.set("goal_pwm", self.get("pwm_limit"))
        if "goal_current" in self.registers:
            self.set("goal_current", self.get("current_limit"))
        startup = self.get("startup_configuration") if "startup_configuration" in self.registers else 0
        if "backup_ready" in self.registers:
            self.set("backup_ready", int(self._backup is not None))
        if startup & 2 and self._backup is not None:
            self._restore_ram(self._backup)
        self.memory[64] = 0
        self._fold()
        self._stand()
        self._push_loop()
        if startup & 1:
            self._torque_on()

    def replied(self, now: float) -> None:
        """The reply has left (or there was none to send): changed baud rate and reboot come into force."""
        if self._pending.reboot:
            self.boot(now)
        elif self._pending.baud:
            self._baud = BAUD_CODES[self.memory[8]]
        else:
            return
        self._pending = _Pending()

    def settle(self) -> None:
        """Take registers that were set from outside into force."""
        self._baud = BAUD_CODES[self.memory[8]]
        self._push_loop()

    def power_off(self) -> None:
        self.powered = False
        self.memory[64] = 0
        self._push_loop()

    def power_on(self, now: float) -> None:
        self.powered = True
        self.boot(now)

    def snapshot(self) -> ServoSnapshot:
        return ServoSnapshot(bytes(self.memory[:EEPROM_END]), self._backup)

    def load(self, snapshot: ServoSnapshot) -> None:
        """Take the EEPROM of a servo that ran before, and start from power-on without the mute time."""
        self.memory[:EEPROM_END] = snapshot.eeprom
        self.memory[0:2] = self.model.number.to_bytes(2, "little")
        self.memory[6] = self.firmware
        self._backup = snapshot.backup
        self.boot(0.0, mute=False)

    def _restore_ram(self, backup: bytes) -> None:
        for register in self.registers.values():
            if register.area == "RAM" and register.writable and register.name not in ("torque_enable", *GOALS):
                self.memory[register.address : register.end] = backup[register.address : register.end]

    def _saved(self) -> None:
        if self.persist is not None:
            self.persist(self.snapshot())

    # ---- position ----

    @property
    def _homing(self) -> int:
        offset = self.get("homing_offset")
        return 0 if self.mode == POSITION_MODE and abs(offset) > HOMING_LIMIT_POSITION else offset

    @property
    def _direction(self) -> int:
        return -1 if self.memory[10] & REVERSED else 1

    def _fold(self) -> None:
        """Count turns from here: the encoder alone knows one turn."""
        raw = self._direction * round(self.motor.sense().pulses)
        self._base = raw % PULSES_PER_TURN - raw

    @property
    def _offset(self) -> int:
        return self._base + self._homing

    def _present(self, sensed: Sensed) -> int:
        return self._direction * round(sensed.pulses) + self._offset

    def _loop(self) -> Loop:
        get = self.get
        return Loop(
            torque=self.torque and self.powered,
            mode=self.mode,
            direction=self._direction,
            offset=float(self._offset),
            p_gain=get("position_p_gain"),
            i_gain=get("position_i_gain"),
            d_gain=get("position_d_gain"),
            velocity_p_gain=get("velocity_p_gain"),
            velocity_i_gain=get("velocity_i_gain"),
            feedforward_velocity=get("feedforward_1st_gain"),
            feedforward_acceleration=get("feedforward_2nd_gain"),
            pwm_limit=min(get("pwm_limit"), abs(get("goal_pwm"))) if self.mode != PWM_MODE else get("pwm_limit"),
            goal_pwm=get("goal_pwm"),
            goal_current=get("goal_current") if "goal_current" in self.registers else 0,
            goal_velocity=get("goal_velocity"),
        )

    def _push_loop(self) -> None:
        self.motor.set_loop(self._loop())

    def _stand(self) -> None:
        """Goal and trajectory to where the shaft is."""
        present = self._present(self.motor.sense())
        self.set("goal_position", present)
        self.motor.hold(present)

    def _goal(self) -> None:
        self.motor.set_goal(
            self.get("goal_position"),
            velocity=self.get("profile_velocity"),
            acceleration=self.get("profile_acceleration"),
            time_based=bool(self.memory[10] & TIME_BASED) and self.firmware >= 42,
        )

    def _torque_on(self) -> None:
        if self.shut_down or not self.powered:
            return
        if self.mode == POSITION_MODE:
            self._fold()
        self.memory[64] = 1
        self._stand()
        self._push_loop()

    def _mode_changed(self) -> None:
        self.set("profile_velocity", 0)
        self.set("profile_acceleration", 0)
        self.set("goal_pwm", self.get("pwm_limit"))
        self.set("goal_velocity", 0)
        if "goal_current" in self.registers:
            self.set("goal_current", self.get("current_limit"))
        for name in RAM_CHANGED_BY_MODE:
            self.set(name, self.registers[name].default or 0)
        if self.mode == POSITION_MODE:
            self._fold()
        self._stand()

    def _torque_off(self) -> None:
        self.memory[64] = 0
        self._push_loop()

    def refresh(self, now: float) -> None:
        """Bring the dynamic registers 120…146 up to date."""
        sensed, memory, direction = self.motor.sense(), self.memory, self._direction
        present = self._present(sensed)
        velocity = round(direction * sensed.velocity / RAD_S_PER_COUNT)
        goal, threshold = _I32.unpack_from(memory, 116)[0], _I32.unpack_from(memory, 24)[0]
        moving = abs(velocity) > threshold or sensed.profile_active
        status = sensed.profile_shape << 4
        if abs(goal - present) <= IN_POSITION_PULSES:
            status |= 0x01
        if sensed.profile_active:
            status |= 0x02
        if memory[64] and abs(sensed.trajectory - present) > FOLLOWING_ERROR_PULSES:
            status |= 0x08
        if self.model.has_current_sensor:
            effort = max(-32768, min(32767, round(direction * sensed.current / AMPERE_PER_COUNT)))
        else:
            effort = max(-1000, min(1000, round(direction * sensed.duty * 1000)))
        tick = int((now - self.booted_at) * 1000 * (1 + self.clock_ppm * 1e-6)) % TICK_WRAP
        _DYNAMIC.pack_into(
            memory, DYNAMIC_AT, tick, moving, status, round(direction * sensed.duty * PWM_FULL), effort, velocity,
            present, round(sensed.trajectory_velocity / PULSES_S_PER_COUNT), round(sensed.trajectory),
            max(0, round(sensed.voltage * 10)), max(0, min(255, int(sensed.temperature))),
        )  # fmt: skip

    # ---- time and protection ----

    def listening(self, now: float) -> bool:
        """Whether it hears instructions at all (at its baud rate)."""
        return self.powered and now >= self._mute_until and self.memory[13] == 2

    def watch_bus(self, now: float) -> None:
        """The Bus Watchdog: counts while torque is on. Called every few milliseconds."""
        watchdog = self.memory[98]
        if not (0 < watchdog < TRIPPED and self.memory[64]):
            return
        if "bus_watchdog" in self.registers and now - self._heard_at > watchdog * WATCHDOG_UNIT_S:
            self._trip_watchdog()

    def protect(self, voltage: float, temperature: float) -> None:
        """Compare supply (V) and temperature (°C) with their limits."""
        memory = self.memory
        decivolts = round(voltage * 10)
        low, high = memory[34] | memory[35] << 8, memory[32] | memory[33] << 8
        if not low <= decivolts <= high:
            self.raise_hardware_error(VOLTAGE_ERROR)
        if int(temperature) > memory[31]:
            self.raise_hardware_error(HEAT_ERROR)

    def raise_hardware_error(self, bit: int) -> None:
        """Latch a bit of Hardware Error Status, and shut down where the mask has it."""
        self.memory[70] |= bit
        if bit & self.memory[63] and not self.shut_down:
            self.shut_down = True
            self._torque_off()

    def _trip_watchdog(self) -> None:
        self.set("bus_watchdog", -1)
        self.set("profile_velocity", 0)
        self.set("profile_acceleration", 0)
        self.set("goal_velocity", 0)
        if self.mode in (PWM_MODE, CURRENT_MODE):
            self.set("goal_pwm" if self.mode == PWM_MODE else "goal_current", 0)
        self._stand()
        self._push_loop()

    @property
    def watchdog_tripped(self) -> bool:
        return self.memory[98] >= TRIPPED and "bus_watchdog" in self.registers
