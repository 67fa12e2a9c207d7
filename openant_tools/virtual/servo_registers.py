"""A servo's control table as bytes: which registers its firmware has, what stands in them, what a write would change."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate

from openant_tools.comms.protocol2 import Error
from openant_tools.robot.registers import EEPROM_END, Register
from openant_tools.robot.servo import ServoModel

__all__ = ["MEMORY", "InstructionRefused", "Item", "ServoRegisters"]

#: bytes of the control table
MEMORY = 1024
#: Bits of Drive Mode (10), and values of Operating Mode (11).
REVERSED, TIME_BASED, TORQUE_BY_GOAL = 0x01, 0x04, 0x08
POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE, PWM_MODE, VELOCITY_MODE, CURRENT_MODE = 3, 4, 5, 16, 1, 0


@dataclass(frozen=True, slots=True)
class Item:
    """One write after checking: a register and its count, or a bare byte of indirect storage."""

    register: Register | None
    address: int
    value: int


class InstructionRefused(Exception):
    """The instruction is answered by an error."""

    def __init__(self, error: Error) -> None:
        self.error = error


class ServoRegisters:
    """The table of one model at one firmware version.

    Attributes:
        registers: by name, those that this firmware has.
        memory: (MEMORY,) bytes.
    """

    def __init__(self, model: ServoModel, firmware: int) -> None:
        self.model, self.firmware = model, firmware
        self.registers = {r.name: r for r in model.registers.values() if r.min_firmware <= firmware}
        #: name → (first byte, byte behind the last, whether it may be below zero)
        self._places = {name: (r.address, r.end, r.signed) for name, r in self.registers.items()}
        self._owner: list[Register | None] = [None] * MEMORY
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
        self.memory = bytearray(MEMORY)

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
    def torque(self) -> bool:
        return self.memory[64] != 0

    @property
    def return_delay_s(self) -> float:
        return self.memory[9] * 2e-6

    @property
    def mode(self) -> int:
        return self.memory[11]

    def load_defaults(self, low: int, high: int, keep: tuple[str, ...] = ()) -> None:
        for register in self.registers.values():
            if low <= register.address < high and register.name not in keep:
                self.set(register.name, register.default or 0)
        if low == 0:
            self.memory[6] = self.firmware

    def _target(self, cell: int) -> int | None:
        """The byte that an indirect data cell stands for; None where it stands for itself, as at power-on."""
        at = self._indirect[cell]
        target = self.memory[at] | self.memory[at + 1] << 8
        if target in self._indirect or target >= MEMORY or self._owner[target] is None or target < EEPROM_END:
            return None
        return target

    def _written(self, address: int, data: bytes) -> list[Item]:
        """What a write of these bytes sets, indirect cells followed; raises InstructionRefused where the table has no such place."""
        if not data:
            raise InstructionRefused(Error.DATA_LENGTH)
        end = address + len(data)
        if end > MEMORY:
            raise InstructionRefused(Error.ACCESS)
        register = self._owner[address]
        if (
            register is not None
            and register.address == address
            and register.end == end
            and address not in self._indirect
        ):
            if not register.writable:
                raise InstructionRefused(Error.ACCESS)
            return [Item(register, address, int.from_bytes(data, "little", signed=register.signed))]
        # The bytes as they will stand, indirect cells followed.
        targets: list[tuple[int, int]] = []
        for k, byte in enumerate(data):
            at = address + k
            if self._owner[at] is None:
                raise InstructionRefused(Error.ACCESS)
            target = self._target(at) if at in self._indirect else None
            targets.append((at if target is None else target, byte))
        return list(self._items(targets))

    def _items(self, targets: list[tuple[int, int]]) -> Iterator[Item]:
        k = 0
        while k < len(targets):
            at, byte = targets[k]
            register = self._owner[at]
            assert register is not None
            if at in self._indirect:
                yield Item(None, at, byte)
                k += 1
                continue
            if not register.writable or at != register.address:
                raise InstructionRefused(Error.ACCESS)
            part = targets[k : k + register.size]
            if [target for target, _ in part] != list(range(register.address, register.end)):
                raise InstructionRefused(Error.DATA_LENGTH)
            value = int.from_bytes(bytes(byte for _, byte in part), "little", signed=register.signed)
            yield Item(register, at, value)
            k += register.size

    @property
    def drive_mode_bits(self) -> int:
        bits = REVERSED
        if self.firmware >= 42:
            bits |= TIME_BASED
        if self.firmware >= 45:
            bits |= TORQUE_BY_GOAL
        return bits

    def within_limits(self, name: str, value: int) -> bool:
        """Whether a goal keeps to the limits that stand in EEPROM."""
        if name == "goal_position":
            if self.mode != POSITION_MODE:
                return True
            return self.get("min_position_limit") <= value <= self.get("max_position_limit")
        limits = {"goal_pwm": "pwm_limit", "goal_current": "current_limit", "goal_velocity": "velocity_limit"}
        return name not in limits or abs(value) <= self.get(limits[name])
