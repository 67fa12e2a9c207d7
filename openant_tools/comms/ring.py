"""Telemetry from the engine to any number of faces: a ring in shared memory that no reader can hold up.

One writer, readers that look when they like; what a slow reader misses is gone. Rows are float64 in SI units of the
joints, named by `columns`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.bus import Answer
from openant_tools.comms.servos import Block, Servo
from openant_tools.files import shared_memory

__all__ = ["ERR_CODES", "SIGNALS", "Ring", "columns", "joint_values"]

#: per joint, in this order
SIGNALS = ("cmd", "pos", "vel", "cur", "load", "pwm", "volt", "temp", "tick", "ok", "err", "rtt")
#: of the loop and the body, before the joints; `imu_t` and `base_t` say when the sensors measured, `goal` which command's
#: goal is in force
COMMON = (
    "t", "cmd_t", "wake", "torque", "gyro.x", "gyro.y", "gyro.z", "acc.x", "acc.y", "acc.z",
    "base.x", "base.y", "base.z", "base.yaw", "imu_t", "base_t", "goal",
)  # fmt: skip
#: numbers for the words of `err.J`
ERR_CODES = ("", "timeout", "crc", "short", "late", "port", "alert")
#: 10 s at 100 Hz, what a screen shows
SLOTS = 1024
_HEADER = 64
_ERR_CODE = {word: code for code, word in enumerate(ERR_CODES)}
_NAN = float("nan")


def columns(joints: Sequence[str]) -> list[str]:
    """Names of a row's numbers; `signal.joint` as in a run table, `err` by `ERR_CODES`."""
    return [*COMMON, *(f"{signal}.{joint}" for joint in joints for signal in SIGNALS)]


def joint_values(servo: Servo, command: float, answer: Answer, block: Block | None) -> list[float]:
    """SIGNALS of one joint: what it was sent (rad), and what it answered."""
    if block is None:
        return [command, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, _NAN, 0.0, _ERR_CODE[answer.word], _NAN]
    table, sign = servo.model.registers, servo.direction
    effort = sign * servo.model.effort.to_si(block.effort)
    return [
        command,
        servo.to_joint(block.position * table["present_position"].scale),
        sign * block.velocity * table["present_velocity"].scale,
        effort if servo.model.has_current_sensor else _NAN,
        _NAN if servo.model.has_current_sensor else effort,
        sign * block.pwm * table["present_pwm"].scale,
        block.voltage * table["present_input_voltage"].scale,
        float(block.temperature),
        float(block.tick),
        float(answer.ok),
        _ERR_CODE[answer.word],
        _NAN if answer.rtt is None else answer.rtt,
    ]


class Ring:
    """The shared rows; made by the parent, opened by its file descriptor in the engine.

    Attributes:
        fd: the file descriptor to hand to the other process.
    """

    def __init__(self, width: int, fd: int | None = None) -> None:
        self.fd, self._map = shared_memory(_HEADER + SLOTS * width * 8, fd)
        self._count = np.frombuffer(self._map, np.uint64, 1)
        self._rows = np.frombuffer(self._map, np.float64, SLOTS * width, _HEADER).reshape(SLOTS, width)

    @property
    def count(self) -> int:
        """Rows ever written."""
        return int(self._count[0])

    def put(self, row: Sequence[float]) -> None:
        """Write a row over the oldest."""
        count = int(self._count[0])
        self._rows[count % SLOTS] = row
        self._count[0] = count + 1

    def since(self, seen: int) -> tuple[NDArray[np.float64], int]:
        """Rows after the first `seen`, oldest first, as far as they are still there; and the new count."""
        while True:
            count = self.count
            first = max(seen, count - SLOTS + 1)
            rows = self._rows[np.arange(first, max(first, count)) % SLOTS].copy()
            # The writer may have come round while we copied: then take what is newer.
            if self.count - first < SLOTS:
                return rows, count

    def close(self) -> None:
        del self._count, self._rows
        self._map.close()
        os.close(self.fd)
