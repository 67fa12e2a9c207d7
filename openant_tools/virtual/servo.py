"""A servo's firmware as the bus sees it: Protocol 2.0 instruction in, status out; no I/O and no clock of its own.

The device is driven by control-table data (`openant_tools.robot.servo`) and a firmware version. What it knows of its
motor comes through `Motor`, which the physics implements, so that the same device answers with any plant behind it.
Rules are those of the vendor's manual; where the manual is silent a choice is made here, marked "unpublished", and
named in docs/virtual-robot.md so that hardware can settle it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import accumulate
from typing import Protocol

from openant_tools.comms.protocol2 import ALERT_BIT, BROADCAST, MAX_ID, Error, Inst, Instruction, Status
from openant_tools.robot.control_table import AMPERE_PER_COUNT
from openant_tools.robot.registers import EEPROM_END, PULSES_PER_TURN, PWM_FULL, RAD_S_PER_COUNT, Register
from openant_tools.robot.servo import BAUD_CODES, ServoModel

__all__ = ["READS", "Loop", "Motor", "Sensed", "ServoDevice", "Snapshot", "read_requests"]

#: Instructions that Status Return Level 1 still answers.
READS = frozenset({Inst.READ, Inst.SYNC_READ, Inst.FAST_SYNC_READ, Inst.BULK_READ, Inst.FAST_BULK_READ, Inst.PING})
FAST_READ_FIRMWARE = 45
_FAST_READS = (Inst.FAST_SYNC_READ, Inst.FAST_BULK_READ)
_GROUP_READS = (Inst.SYNC_READ, Inst.BULK_READ, *_FAST_READS)
_GROUP_WRITES = (Inst.SYNC_WRITE, Inst.BULK_WRITE)
CLEAR_KEY = b"\x01DXL\x22"
BACKUP_STORE = b"\x01CTRL"
BACKUP_RESTORE = b"\x02CTRL"

VOLTAGE_ERROR, HEAT_ERROR, ENCODER_ERROR, SHOCK_ERROR, OVERLOAD_ERROR = 0x01, 0x04, 0x08, 0x10, 0x20

REVERSED, TIME_BASED, TORQUE_BY_GOAL = 0x01, 0x04, 0x08
POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE, PWM_MODE, VELOCITY_MODE, CURRENT_MODE = 3, 4, 5, 16, 1, 0
PULSES_S_PER_COUNT = RAD_S_PER_COUNT * PULSES_PER_TURN / (2 * math.pi)
WATCHDOG_UNIT_S = 0.02
#: from here on the Bus Watchdog's one byte is below zero: it has stopped the motion
TRIPPED = 128
TICK_WRAP = 32768
#: In position mode an offset beyond a quarter of a turn is ignored (e-manual, Homing Offset).
HOMING_LIMIT_POSITION = 1024

# Unpublished: how near to the goal "in position" is, and how far behind the trajectory "following error" is.
IN_POSITION_PULSES = 20
FOLLOWING_ERROR_PULSES = 128

_MEMORY = 1024
_DYNAMIC = struct.Struct("<HBBhhiiiiHB")  # 120 … 146
_DYNAMIC_AT, _DYNAMIC_END = 120, 147
_FIRST_INDIRECT_DATA = 224
_I32 = struct.Struct("<i")
_RAM_CHANGED_BY_MODE = (
    "velocity_i_gain", "velocity_p_gain", "position_d_gain", "position_i_gain", "position_p_gain",
    "feedforward_2nd_gain", "feedforward_1st_gain",
)  # fmt: skip
_GOALS = frozenset({"goal_pwm", "goal_current", "goal_velocity", "goal_position"})
#: Writing one of these changes what the position loop does.
_LOOP_REGISTERS = frozenset(
    {
        *_RAM_CHANGED_BY_MODE, "pwm_limit", "current_limit", "goal_pwm", "goal_current", "goal_velocity",
        "operating_mode", "drive_mode", "homing_offset",
    }
)  # fmt: skip


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
class Snapshot:
    """What survives a power cut: the EEPROM area and the backup."""

    eeprom: bytes
    backup: bytes | None = None


@dataclass(slots=True)
class _Pending:
    """What takes effect once the reply has left."""

    baud: bool = False
    reboot: bool = False


@dataclass(frozen=True, slots=True)
class _Item:
    """One write after checking: a register and its count, or a bare byte of indirect storage."""

    register: Register | None
    address: int
    value: int


class _Refused(Exception):
    def __init__(self, error: Error) -> None:
        self.error = error


def read_requests(instruction: Instruction) -> list[tuple[int, int, int]]:
    """(id, address, bytes) of every servo that a sync or bulk read asks, in turn; empty where it is malformed."""
    return _read_requests(instruction.code, instruction.params)


@lru_cache(maxsize=64)
def _wanted(code: int, params: bytes) -> dict[int, tuple[int, int]]:
    """id → (address, bytes); the first request counts where an id is asked twice."""
    return {id: (address, count) for id, address, count in reversed(_read_requests(code, params))}


@lru_cache(maxsize=64)  # each servo on the line looks at the same packet
def _read_requests(code: int, params: bytes) -> list[tuple[int, int, int]]:
    if code in (Inst.SYNC_READ, Inst.FAST_SYNC_READ):
        if len(params) < 5:
            return []
        address, count = struct.unpack_from("<HH", params)
        return [(id, address, count) for id in params[4:]]
    if len(params) % 5:
        return []
    return [struct.unpack_from("<BHH", params, at) for at in range(0, len(params), 5)]


@dataclass
class ServoDevice:
    """One servo on the bus.

    Args:
        model: its control table and ratings.
        motor: the motor behind it.
        firmware: its version; decides which registers and instructions exist.
        persist: called with a `Snapshot` whenever what survives a power cut has changed.
        reboot_s: how long it is mute after a reboot or power-on (unpublished; 0.3…0.5 s).
    """

    model: ServoModel
    motor: Motor
    firmware: int = 46
    persist: Callable[[Snapshot], None] | None = None
    reboot_s: float = 0.4
    #: parts per million by which the servo's crystal runs fast
    clock_ppm: float = 0.0
    memory: bytearray = field(init=False, repr=False)
    #: shutdown has switched torque off until a reboot
    shut_down: bool = field(default=False, init=False)
    powered: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        self.registers = {r.name: r for r in self.model.registers.values() if r.min_firmware <= self.firmware}
        #: name → (first byte, byte behind the last, whether it may be below zero)
        self._places = {name: (r.address, r.end, r.signed) for name, r in self.registers.items()}
        self._owner: list[Register | None] = [None] * _MEMORY
        for register in self.registers.values():
            for address in range(register.address, register.end):
                self._owner[address] = register
        #: undefined bytes below each address, so that a whole block is checked by one subtraction
        self._holes = list(accumulate((owner is None for owner in self._owner), initial=0))
        #: data cell → cell of the address that it takes its byte from
        self._indirect: dict[int, int] = {
            self.registers[name.replace("address", "data")].address: register.address
            for name, register in self.registers.items()
            if name.startswith("indirect_address_")
        }
        self.memory = bytearray(_MEMORY)
        self._backup: bytes | None = None
        self._reg_write: tuple[int, bytes] | None = None
        self._base = 0
        self._mute_until = 0.0
        self.booted_at = 0.0
        self._heard_at = 0.0
        self._pending = _Pending()
        self._baud = 0
        self._load_defaults(0, EEPROM_END)
        self.boot(0.0, mute=False)

    # ---- registers ----

    def get(self, name: str) -> int:
        """A register's count as it stands in memory (dynamic ones as of the last `refresh`)."""
        start, end, signed = self._places[name]
        return int.from_bytes(self.memory[start:end], "little", signed=signed)

    def set(self, name: str, counts: int) -> None:
        """Set a register without any rule: what a scenario or the firmware itself does."""
        start, end, _ = self._places[name]
        size = end - start
        self.memory[start:end] = (counts & ((1 << 8 * size) - 1)).to_bytes(size, "little")

    @property
    def id(self) -> int:
        return self.memory[7]

    @property
    def baud(self) -> int:
        """The rate in force, bits/s: a written one comes into force after the reply."""
        return self._baud

    @property
    def torque(self) -> bool:
        return self.memory[64] != 0

    @property
    def return_delay_s(self) -> float:
        return self.memory[9] * 2e-6

    @property
    def mode(self) -> int:
        return self.memory[11]

    def _load_defaults(self, low: int, high: int, keep: tuple[str, ...] = ()) -> None:
        for register in self.registers.values():
            if low <= register.address < high and register.name not in keep:
                self.set(register.name, register.default or 0)
        if low == 0:
            self.memory[6] = self.firmware

    # ---- power ----

    def boot(self, now: float, *, mute: bool = True) -> None:
        """Power-on or reboot: RAM to its defaults, position folded to one turn, mute for `reboot_s`."""
        self._load_defaults(EEPROM_END, _MEMORY)
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

    def snapshot(self) -> Snapshot:
        return Snapshot(bytes(self.memory[:EEPROM_END]), self._backup)

    def load(self, snapshot: Snapshot, now: float = 0.0) -> None:
        """Take the EEPROM of a servo that ran before, and start from power-on without the mute time."""
        self.memory[:EEPROM_END] = snapshot.eeprom
        self.memory[0:2] = self.model.number.to_bytes(2, "little")
        self.memory[6] = self.firmware
        self._backup = snapshot.backup
        self.boot(now, mute=False)

    def _restore_ram(self, backup: bytes) -> None:
        for register in self.registers.values():
            if register.area == "RAM" and register.writable and register.name not in ("torque_enable", *_GOALS):
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
            memory, _DYNAMIC_AT, tick, moving, status, round(direction * sensed.duty * PWM_FULL), effort, velocity,
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

    # ---- instructions ----

    def execute(self, instruction: Instruction, now: float) -> Status | None:
        """Do one instruction heard at this servo's baud rate.

        Returns what this servo says to it, with the ID in force when it arrived; None where it says nothing. For sync,
        bulk and broadcast instructions the line decides when it speaks. Call `replied` once the reply has left.
        """
        if not self.listening(now):
            return None
        self._heard_at = now
        addressee, code = instruction.id, instruction.code
        own = self.id
        # The real ID goes before the shadow ID.
        shadow = addressee == self.memory[12] <= MAX_ID and addressee != own
        if addressee not in (own, BROADCAST) and not shadow:
            return None
        error, params = Error.OK, b""
        try:
            result = self._do(instruction, now, shadow=shadow)
            if result is None:
                return None
            params = result
        except _Refused as refused:
            error = refused.error
        if shadow or (addressee == BROADCAST and code not in (READS - {Inst.READ})):
            return None
        level = self.get("status_return_level")
        if code != Inst.PING and (level == 0 or (level == 1 and code not in READS)):
            return None
        return Status(own, error | (ALERT_BIT if self.memory[70] else 0), params)

    def replied(self, now: float) -> None:
        """The reply has left (or there was none to send): changed baud rate and reboot come into force."""
        if self._pending.reboot:
            self.boot(now)
        elif self._pending.baud:
            self._baud = BAUD_CODES[self.memory[8]]
        else:
            return
        self._pending = _Pending()

    def _do(self, instruction: Instruction, now: float, *, shadow: bool) -> bytes | None:
        """Parameters of the reply; None where the instruction is not for this servo. Raises _Refused."""
        code, params, broadcast = instruction.code, instruction.params, instruction.id == BROADCAST
        if code in _GROUP_READS:
            if not broadcast:
                raise _Refused(Error.INSTRUCTION)
            if code in _FAST_READS and self.firmware < FAST_READ_FIRMWARE:
                return None
            wanted = _wanted(code, params).get(self.memory[7])
            return None if wanted is None else self.read(*wanted, now=now)
        if code in _GROUP_WRITES:
            if not broadcast:
                raise _Refused(Error.INSTRUCTION)
            writes, own, shadow_id = _group_writes(code, params), self.memory[7], self.memory[12]
            for address, data in writes.get(own, ()):
                self._apply(self._check(address, data))
            # A group write reaches a shadow ID too, as any write does.
            if shadow_id <= MAX_ID and shadow_id != own:
                for address, data in writes.get(shadow_id, ()):
                    self._apply(self._check(address, data, ram_only=True))
            return None
        if code == Inst.PING:
            return bytes(self.memory[0:2]) + bytes(self.memory[6:7])
        if code == Inst.READ:
            if len(params) != 4:
                raise _Refused(Error.DATA_LENGTH)
            return self.read(*struct.unpack("<HH", params), now=now)
        if code == Inst.WRITE:
            self._write(params, ram_only=shadow)
            return b""
        if code == Inst.REG_WRITE:
            if len(params) < 3:
                raise _Refused(Error.DATA_LENGTH)
            address, data = params[0] | params[1] << 8, params[2:]
            self._check(address, data, ram_only=shadow)
            self._reg_write = (address, data)
            self.set("registered_instruction", 1)
            return b""
        if code == Inst.ACTION:
            if self._reg_write is None:
                raise _Refused(Error.INSTRUCTION)
            address, data = self._reg_write
            self._reg_write = None
            self.set("registered_instruction", 0)
            self._apply(self._check(address, data, ram_only=shadow))
            return b""
        if code == Inst.REBOOT:
            self._pending.reboot = True
            return b""
        if code == Inst.FACTORY_RESET:
            self._factory_reset(params, broadcast=broadcast)
            return b""
        if code == Inst.CLEAR:
            self._clear(params, now)
            return b""
        if code == Inst.CONTROL_TABLE_BACKUP:
            self._back_up(params)
            return b""
        raise _Refused(Error.INSTRUCTION)

    # ---- reading and writing ----

    def read(self, address: int, count: int, *, now: float) -> bytes:
        """The bytes of a read; raises _Refused with ACCESS where an address is undefined."""
        if count == 0:
            raise _Refused(Error.DATA_LENGTH)
        end = address + count
        if end > _MEMORY or self._holes[end] != self._holes[address]:
            raise _Refused(Error.ACCESS)
        indirect: list[tuple[int, int | None]] = []
        if end > _FIRST_INDIRECT_DATA:
            indirect = [(at, self._target(at)) for at in range(address, end) if at in self._indirect]
        if (address < _DYNAMIC_END and end > _DYNAMIC_AT) or any(target is not None for _, target in indirect):
            self.refresh(now)
        data = bytearray(self.memory[address:end])
        for at, target in indirect:
            if target is not None:
                data[at - address] = self.memory[target]
        return bytes(data)

    def _target(self, cell: int) -> int | None:
        """The byte that an indirect data cell stands for; None where it stands for itself, as at power-on."""
        at = self._indirect[cell]
        target = self.memory[at] | self.memory[at + 1] << 8
        if target in self._indirect or target >= _MEMORY or self._owner[target] is None or target < EEPROM_END:
            return None
        return target

    def _write(self, params: bytes, *, ram_only: bool) -> None:
        if len(params) < 3:
            raise _Refused(Error.DATA_LENGTH)
        self._apply(self._check(params[0] | params[1] << 8, params[2:], ram_only=ram_only))

    def _check(self, address: int, data: bytes, *, ram_only: bool = False) -> list[_Item]:
        """What a write would do, all rules checked before anything changes."""
        if not data:
            raise _Refused(Error.DATA_LENGTH)
        end = address + len(data)
        if end > _MEMORY:
            raise _Refused(Error.ACCESS)
        register = self._owner[address]
        if (
            register is not None
            and register.address == address
            and register.end == end
            and address not in self._indirect
        ):
            if not register.writable:
                raise _Refused(Error.ACCESS)
            item = _Item(register, address, int.from_bytes(data, "little", signed=register.signed))
            self._check_item(item, ram_only=ram_only)
            return [item]
        # The bytes as they will stand, indirect cells followed.
        targets: list[tuple[int, int]] = []
        for k, byte in enumerate(data):
            at = address + k
            if self._owner[at] is None:
                raise _Refused(Error.ACCESS)
            target = self._target(at) if at in self._indirect else None
            targets.append((at if target is None else target, byte))
        items = list(self._items(targets))
        for item in items:
            self._check_item(item, ram_only=ram_only)
        return items

    def _items(self, targets: list[tuple[int, int]]) -> Iterator[_Item]:
        k = 0
        while k < len(targets):
            at, byte = targets[k]
            register = self._owner[at]
            assert register is not None
            if at in self._indirect:
                yield _Item(None, at, byte)
                k += 1
                continue
            if not register.writable or at != register.address:
                raise _Refused(Error.ACCESS)
            part = targets[k : k + register.size]
            if [target for target, _ in part] != list(range(register.address, register.end)):
                raise _Refused(Error.DATA_LENGTH)
            value = int.from_bytes(bytes(byte for _, byte in part), "little", signed=register.signed)
            yield _Item(register, at, value)
            k += register.size

    def _check_item(self, item: _Item, *, ram_only: bool) -> None:
        register, value = item.register, item.value
        if register is None:
            return
        if register.area == "EEPROM" and (self.torque or ram_only):
            raise _Refused(Error.ACCESS)
        name = register.name
        if name in _GOALS and self.watchdog_tripped:
            raise _Refused(Error.DATA_RANGE)
        low, high = register.range
        if name == "profile_acceleration" or name == "profile_velocity":
            high = 32737 if self.memory[10] & TIME_BASED else high
        if name == "bus_watchdog" and self.watchdog_tripped and value != 0:
            raise _Refused(Error.DATA_RANGE)
        if not low <= value <= high:
            raise _Refused(Error.DATA_RANGE)
        if name == "operating_mode" and value not in self.model.modes:
            raise _Refused(Error.DATA_RANGE)
        if name == "drive_mode" and value & ~self._drive_mode_bits:
            raise _Refused(Error.DATA_RANGE)
        if not self._within_limits(name, value):
            raise _Refused(Error.DATA_LIMIT)
        if name == "torque_enable" and value and self.shut_down:
            # Unpublished which code: the servo cannot do what was asked until it has been rebooted.
            raise _Refused(Error.RESULT_FAIL)

    @property
    def _drive_mode_bits(self) -> int:
        bits = REVERSED
        if self.firmware >= 42:
            bits |= TIME_BASED
        if self.firmware >= 45:
            bits |= TORQUE_BY_GOAL
        return bits

    def _within_limits(self, name: str, value: int) -> bool:
        """Whether a goal keeps to the limits that stand in EEPROM."""
        if name == "goal_position":
            if self.mode != POSITION_MODE:
                return True
            return self.get("min_position_limit") <= value <= self.get("max_position_limit")
        limits = {"goal_pwm": "pwm_limit", "goal_current": "current_limit", "goal_velocity": "velocity_limit"}
        return name not in limits or abs(value) <= self.get(limits[name])

    def _apply(self, items: list[_Item]) -> None:
        """Let a checked write take effect, item by item in the order of its addresses."""
        eeprom = loop = goal = False
        for item in items:
            register, value = item.register, item.value
            if register is None:
                self.memory[item.address] = value
                continue
            name, before = register.name, self.get(register.name)
            self.set(name, value)
            eeprom |= register.area == "EEPROM"
            loop |= name in _LOOP_REGISTERS
            if name == "torque_enable":
                if value and not before:
                    self.memory[64] = 0
                    self._torque_on()
                elif before and not value:
                    self._torque_off()
            elif name == "goal_position":
                goal = True
            elif name == "operating_mode" and value != before:
                self._mode_changed()
            elif name == "pwm_limit":
                self.set("goal_pwm", max(-value, min(value, self.get("goal_pwm"))))
                if not self.torque:
                    self.set("goal_pwm", value)
            elif name == "current_limit":
                self.set("goal_current", value)
            elif name == "drive_mode" and (value ^ before) & REVERSED:
                self._fold()
                self._stand()
            elif name == "homing_offset":
                self._stand()
            elif name == "baud_rate":
                self._pending.baud = True
            elif name in _GOALS and self.memory[10] & TORQUE_BY_GOAL and not self.torque:
                self._torque_on()
        if loop:
            self._push_loop()
        if goal:
            if self.memory[10] & TORQUE_BY_GOAL and not self.torque:
                wanted = self.get("goal_position")
                self._torque_on()
                self.set("goal_position", wanted)
            if self.torque:
                self._goal()
        if eeprom:
            self._saved()

    def _mode_changed(self) -> None:
        self.set("profile_velocity", 0)
        self.set("profile_acceleration", 0)
        self.set("goal_pwm", self.get("pwm_limit"))
        self.set("goal_velocity", 0)
        if "goal_current" in self.registers:
            self.set("goal_current", self.get("current_limit"))
        for name in _RAM_CHANGED_BY_MODE:
            self.set(name, self.registers[name].default or 0)
        if self.mode == POSITION_MODE:
            self._fold()
        self._stand()

    # ---- the rarer instructions ----

    def _factory_reset(self, params: bytes, *, broadcast: bool) -> None:
        if len(params) != 1:
            raise _Refused(Error.DATA_LENGTH)
        kept = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate")}.get(params[0])
        if kept is None:
            raise _Refused(Error.DATA_RANGE)
        if broadcast and not kept and self.firmware >= 42:
            return
        self._load_defaults(0, EEPROM_END, keep=kept)
        self._pending.reboot = True
        self._saved()

    def _clear(self, params: bytes, now: float) -> None:
        if len(params) != len(CLEAR_KEY):
            raise _Refused(Error.DATA_LENGTH)
        if params != CLEAR_KEY:
            raise _Refused(Error.DATA_RANGE)
        self.refresh(now)
        if self.get("moving"):
            raise _Refused(Error.RESULT_FAIL)
        self._fold()
        self._stand()
        self._push_loop()

    def _back_up(self, params: bytes) -> None:
        if self.firmware < 45:
            raise _Refused(Error.INSTRUCTION)
        if params not in (BACKUP_STORE, BACKUP_RESTORE):
            raise _Refused(Error.DATA_RANGE if len(params) == len(BACKUP_STORE) else Error.DATA_LENGTH)
        if self.torque:
            raise _Refused(Error.RESULT_FAIL)
        if params == BACKUP_STORE:
            self._backup = bytes(self.memory)
            self.set("backup_ready", 1)
        elif self._backup is None:
            raise _Refused(Error.RESULT_FAIL)
        else:
            self.memory[:EEPROM_END] = self._backup[:EEPROM_END]
            self._pending.reboot = True
        self._saved()


@lru_cache(maxsize=16)  # each servo on the line looks at the same packet
def _group_writes(code: int, params: bytes) -> dict[int, list[tuple[int, bytes]]]:
    """id → (address, data) of a sync or bulk write, as far as it is well formed."""
    writes: dict[int, list[tuple[int, bytes]]] = {}
    if code == Inst.SYNC_WRITE:
        if len(params) < 4:
            return writes
        address, count = struct.unpack_from("<HH", params)
        for at in range(4, len(params) - count, 1 + count):
            writes.setdefault(params[at], []).append((address, params[at + 1 : at + 1 + count]))
        return writes
    at = 0
    while at + 5 <= len(params):
        id, address, count = struct.unpack_from("<BHH", params, at)
        data = params[at + 5 : at + 5 + count]
        if len(data) < count:
            break
        writes.setdefault(id, []).append((address, data))
        at += 5 + count
    return writes
