"""A servo's firmware as the bus sees it: Protocol 2.0 instruction in, status out; no I/O and no clock of its own.

The device is driven by control-table data (`openant_tools.robot.servo`) and a firmware version; below the instructions
lie its table (`servo_registers`) and what it does under power (`servo_power`). Rules are those of the vendor's manual;
where the manual is silent a choice is made, marked "unpublished", and named in docs/virtual-robot.md so that hardware
can settle it.
"""

from __future__ import annotations

import struct
from functools import lru_cache

from openant_tools.comms.protocol2 import ALERT_BIT, BROADCAST, MAX_ID, Error, Inst, Instruction, Status
from openant_tools.robot.registers import EEPROM_END
from openant_tools.virtual.servo_power import DYNAMIC_AT, DYNAMIC_END, GOALS, RAM_CHANGED_BY_MODE, PoweredServo
from openant_tools.virtual.servo_registers import (
    MEMORY,
    REVERSED,
    TIME_BASED,
    TORQUE_BY_GOAL,
    InstructionRefused,
    Item,
)

__all__ = ["READS", "ServoDevice", "read_requests"]

#: Instructions that Status Return Level 1 still answers.
READS = frozenset({Inst.READ, Inst.SYNC_READ, Inst.FAST_SYNC_READ, Inst.BULK_READ, Inst.FAST_BULK_READ, Inst.PING})
#: Fast Sync Read came with this firmware (ROBOTIS e-manual).
FAST_READ_FIRMWARE = 45
_FAST_READS = (Inst.FAST_SYNC_READ, Inst.FAST_BULK_READ)
_GROUP_READS = (Inst.SYNC_READ, Inst.BULK_READ, *_FAST_READS)
_GROUP_WRITES = (Inst.SYNC_WRITE, Inst.BULK_WRITE)
CLEAR_KEY = b"\x01DXL\x22"
BACKUP_STORE = b"\x01CTRL"
BACKUP_RESTORE = b"\x02CTRL"

_FIRST_INDIRECT_DATA = 224
#: Writing one of these changes what the position loop does.
_LOOP_REGISTERS = frozenset(
    {
        *RAM_CHANGED_BY_MODE, "pwm_limit", "current_limit", "goal_pwm", "goal_current", "goal_velocity",
        "operating_mode", "drive_mode", "homing_offset",
    }
)  # fmt: skip


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


class ServoDevice(PoweredServo):
    """One servo on the bus: what it answers."""

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
        except InstructionRefused as refused:
            error = refused.error
        if shadow or (addressee == BROADCAST and code not in (READS - {Inst.READ})):
            return None
        level = self.get("status_return_level")
        if code != Inst.PING and (level == 0 or (level == 1 and code not in READS)):
            return None
        return Status(own, error | (ALERT_BIT if self.memory[70] else 0), params)

    def _do(self, instruction: Instruction, now: float, *, shadow: bool) -> bytes | None:
        """Parameters of the reply; None where the instruction is not for this servo. Raises InstructionRefused."""
        code, params, broadcast = instruction.code, instruction.params, instruction.id == BROADCAST
        if code in _GROUP_READS:
            if not broadcast:
                raise InstructionRefused(Error.INSTRUCTION)
            if code in _FAST_READS and self.firmware < FAST_READ_FIRMWARE:
                return None
            wanted = _wanted(code, params).get(self.memory[7])
            return None if wanted is None else self.read(*wanted, now=now)
        if code in _GROUP_WRITES:
            if not broadcast:
                raise InstructionRefused(Error.INSTRUCTION)
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
                raise InstructionRefused(Error.DATA_LENGTH)
            return self.read(*struct.unpack("<HH", params), now=now)
        if code == Inst.WRITE:
            self._write(params, ram_only=shadow)
            return b""
        if code == Inst.REG_WRITE:
            if len(params) < 3:
                raise InstructionRefused(Error.DATA_LENGTH)
            address, data = params[0] | params[1] << 8, params[2:]
            self._check(address, data, ram_only=shadow)
            self._reg_write = (address, data)
            self.set("registered_instruction", 1)
            return b""
        if code == Inst.ACTION:
            if self._reg_write is None:
                raise InstructionRefused(Error.INSTRUCTION)
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
        raise InstructionRefused(Error.INSTRUCTION)

    # ---- reading and writing ----

    def read(self, address: int, count: int, *, now: float) -> bytes:
        """The bytes of a read; raises InstructionRefused with ACCESS where an address is undefined."""
        if count == 0:
            raise InstructionRefused(Error.DATA_LENGTH)
        end = address + count
        if end > MEMORY or self._holes[end] != self._holes[address]:
            raise InstructionRefused(Error.ACCESS)
        indirect: list[tuple[int, int | None]] = []
        if end > _FIRST_INDIRECT_DATA:
            indirect = [(at, self._target(at)) for at in range(address, end) if at in self._indirect]
        if (address < DYNAMIC_END and end > DYNAMIC_AT) or any(target is not None for _, target in indirect):
            self.refresh(now)
        data = bytearray(self.memory[address:end])
        for at, target in indirect:
            if target is not None:
                data[at - address] = self.memory[target]
        return bytes(data)

    def _write(self, params: bytes, *, ram_only: bool) -> None:
        if len(params) < 3:
            raise InstructionRefused(Error.DATA_LENGTH)
        self._apply(self._check(params[0] | params[1] << 8, params[2:], ram_only=ram_only))

    def _check(self, address: int, data: bytes, *, ram_only: bool = False) -> list[Item]:
        """What a write would do, all rules checked before anything changes."""
        items = self._written(address, data)
        for item in items:
            self._check_item(item, ram_only=ram_only)
        return items

    def _check_item(self, item: Item, *, ram_only: bool) -> None:
        register, value = item.register, item.value
        if register is None:
            return
        if register.area == "EEPROM" and (self.torque or ram_only):
            raise InstructionRefused(Error.ACCESS)
        name = register.name
        if name in GOALS and self.watchdog_tripped:
            raise InstructionRefused(Error.DATA_RANGE)
        low, high = register.range
        if name == "profile_acceleration" or name == "profile_velocity":
            high = 32737 if self.memory[10] & TIME_BASED else high
        if name == "bus_watchdog" and self.watchdog_tripped and value != 0:
            raise InstructionRefused(Error.DATA_RANGE)
        if not low <= value <= high:
            raise InstructionRefused(Error.DATA_RANGE)
        if name == "operating_mode" and value not in self.model.modes:
            raise InstructionRefused(Error.DATA_RANGE)
        if name == "drive_mode" and value & ~self.drive_mode_bits:
            raise InstructionRefused(Error.DATA_RANGE)
        if not self.within_limits(name, value):
            raise InstructionRefused(Error.DATA_LIMIT)
        if name == "torque_enable" and value and self.shut_down:
            # Unpublished which code: the servo cannot do what was asked until it has been rebooted.
            raise InstructionRefused(Error.RESULT_FAIL)

    def _apply(self, items: list[Item]) -> None:
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
            elif name in GOALS and self.memory[10] & TORQUE_BY_GOAL and not self.torque:
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

    # ---- the rarer instructions ----

    def _factory_reset(self, params: bytes, *, broadcast: bool) -> None:
        if len(params) != 1:
            raise InstructionRefused(Error.DATA_LENGTH)
        kept = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate")}.get(params[0])
        if kept is None:
            raise InstructionRefused(Error.DATA_RANGE)
        if broadcast and not kept and self.firmware >= 42:
            return
        self.load_defaults(0, EEPROM_END, keep=kept)
        self._pending.reboot = True
        self._saved()

    def _clear(self, params: bytes, now: float) -> None:
        if len(params) != len(CLEAR_KEY):
            raise InstructionRefused(Error.DATA_LENGTH)
        if params != CLEAR_KEY:
            raise InstructionRefused(Error.DATA_RANGE)
        self.refresh(now)
        if self.get("moving"):
            raise InstructionRefused(Error.RESULT_FAIL)
        self._fold()
        self._stand()
        self._push_loop()

    def _back_up(self, params: bytes) -> None:
        if self.firmware < 45:
            raise InstructionRefused(Error.INSTRUCTION)
        if params not in (BACKUP_STORE, BACKUP_RESTORE):
            raise InstructionRefused(Error.DATA_RANGE if len(params) == len(BACKUP_STORE) else Error.DATA_LENGTH)
        if self.torque:
            raise InstructionRefused(Error.RESULT_FAIL)
        if params == BACKUP_STORE:
            self._backup = bytes(self.memory)
            self.set("backup_ready", 1)
        elif self._backup is None:
            raise InstructionRefused(Error.RESULT_FAIL)
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
