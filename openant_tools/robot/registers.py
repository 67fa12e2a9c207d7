"""One register of a servo, and the one place where its counts become SI units and bytes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import literal

__all__ = [
    "EEPROM_END", "LOAD_PER_COUNT", "PULSES_PER_TURN", "PWM_FULL", "RAD_PER_PULSE", "RAD_S_PER_COUNT", "Register",
]  # fmt: skip

PULSES_PER_TURN = 4096
#: The platform's driver divides by 4095; the encoder has 4096 steps to the turn.
RAD_PER_PULSE = 2 * math.pi / PULSES_PER_TURN
#: 0.229 rpm, the unit of every velocity in the control table (ROBOTIS e-manual).
RAD_S_PER_COUNT = 0.229 * 2 * math.pi / 60
#: Counts of full duty; the manual prints the unit rounded to 0.113 %.
PWM_FULL = 885
#: 0.1 % of full, the unit of Present Load.
LOAD_PER_COUNT = 1e-3
#: First address of RAM. What lies below survives a power cut and is locked while torque is on.
EEPROM_END = 64

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Register:
    """One item of a control table.

    Attributes:
        name: the vendor's name in snake_case, such as `present_position`.
        address, size: where it stands, in bytes; little-endian.
        access: "R" or "RW".
        signed: whether the bytes are a two's complement.
        unit, scale: SI unit, and how much of it one count is; ("", 1.0) for codes, bits and bare gains.
        minimum, maximum: the range of a write in counts, where the vendor states one.
        default: counts after a factory reset (EEPROM) or a reboot (RAM), where the vendor states them.
        min_firmware: the first firmware that has this item.
    """

    name: str
    address: int
    size: int
    access: Literal["R", "RW"]
    signed: bool = False
    unit: str = ""
    scale: float = 1.0
    minimum: int | None = None
    maximum: int | None = None
    default: int | None = None
    min_firmware: int = 0

    @property
    def area(self) -> Literal["EEPROM", "RAM"]:
        return "EEPROM" if self.address < EEPROM_END else "RAM"

    @property
    def end(self) -> int:
        """The first address behind it."""
        return self.address + self.size

    @property
    def writable(self) -> bool:
        return self.access == "RW"

    @overload
    def to_si(self, counts: float) -> float: ...

    @overload
    def to_si(self, counts: NDArray[Any]) -> Array: ...

    def to_si(self, counts: float | NDArray[Any]) -> float | Array:
        """Counts (a number or an array) in the register's unit."""
        return counts * self.scale

    def to_counts(self, value: float) -> int:
        """The nearest count to a value in the register's unit; raises BadInput beyond the register's range."""
        if not math.isfinite(value):
            raise BadInput(f"{self.name} cannot be set to {value}")
        counts = round(value / self.scale)
        self.check(counts)
        return counts

    def check(self, counts: int) -> None:
        """Raise BadInput unless the register can be set to `counts`."""
        low, high = self.range
        if not low <= counts <= high:
            unit = f" {self.unit}" if self.unit else ""
            ends = f"{low} to {high}"
            if self.scale != 1:
                ends += f", that is {literal(low * self.scale, 4)} to {literal(high * self.scale, 4)}{unit}"
            raise BadInput(f"{self.name} cannot be {counts} (it goes from {ends})")

    @property
    def range(self) -> tuple[int, int]:
        """Lowest and highest count: the vendor's range, or what the bytes can hold."""
        bits = 8 * self.size
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if self.signed else (0, (1 << bits) - 1)
        return (low if self.minimum is None else self.minimum, high if self.maximum is None else self.maximum)

    def encode(self, counts: int) -> bytes:
        """The register's bytes on the wire. Unsigned registers wrap nothing: a count that does not fit raises."""
        try:
            return int(counts).to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            raise BadInput(f"{counts} does not fit into the {self.size} bytes of {self.name}") from None

    def decode(self, data: bytes) -> int:
        """The count in exactly `size` bytes."""
        if len(data) != self.size:
            raise BadInput(f"{self.name} has {self.size} bytes, not {len(data)}")
        return int.from_bytes(data, "little", signed=self.signed)
