"""The control table of the X430 servos as data: one table, and what each model has different.

Source: ROBOTIS e-manual, pages of XL430-W250, XC430-W240, XM430-W210 and XM430-W350. Where firmware versions or pages
disagree the vendor's current model files decide: the Acceleration Limit of old firmware (address 40) is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from openant_tools.robot.registers import LOAD_PER_COUNT, PWM_FULL, RAD_PER_PULSE, RAD_S_PER_COUNT, Register

__all__ = ["INDIRECT_CELLS", "control_table"]

AMPERE_PER_COUNT = 2.69e-3
#: 214.577 rev/min², the unit of profile accelerations.
RAD_S2_PER_COUNT = 214.577 * 2 * math.pi / 3600
#: Indirect cells map RAM only; EEPROM cannot be mapped.
INDIRECT_TARGETS = (64, 661)
#: (first number, how many, first address cell, first data cell)
INDIRECT_CELLS = ((1, 28, 168, 224), (29, 28, 578, 634))
GAIN_MAX = 16383
VELOCITY_MAX = 1023
MULTI_TURN_MAX = 1_048_575
HOMING_MAX = 1_044_479
PROFILE_MAX = 32767

_POSITION: dict[str, Any] = {"unit": "rad", "scale": RAD_PER_PULSE}
_VELOCITY: dict[str, Any] = {"unit": "rad/s", "scale": RAD_S_PER_COUNT}
_DUTY: dict[str, Any] = {"unit": "1", "scale": 1 / PWM_FULL}
_CURRENT: dict[str, Any] = {"unit": "A", "scale": AMPERE_PER_COUNT}
_VOLTAGE: dict[str, Any] = {"unit": "V", "scale": 0.1}
_CELSIUS: dict[str, Any] = {"unit": "°C", "scale": 1.0}
_GAIN: dict[str, Any] = {"minimum": 0, "maximum": GAIN_MAX}

#: The XM430-W350's table; every other model is this one with the differences below.
BASE: tuple[Register, ...] = (
    # EEPROM
    Register("model_number", 0, 2, "R", default=1020),
    Register("model_information", 2, 4, "R"),
    Register("firmware_version", 6, 1, "R"),
    Register("id", 7, 1, "RW", minimum=0, maximum=252, default=1),
    Register("baud_rate", 8, 1, "RW", minimum=0, maximum=7, default=1),
    Register("return_delay_time", 9, 1, "RW", unit="s", scale=2e-6, minimum=0, maximum=254, default=250),
    Register("drive_mode", 10, 1, "RW", minimum=0, maximum=13, default=0),
    Register("operating_mode", 11, 1, "RW", minimum=0, maximum=16, default=3),
    Register("secondary_id", 12, 1, "RW", minimum=0, maximum=255, default=255),
    Register("protocol_type", 13, 1, "RW", minimum=1, maximum=2, default=2),
    Register(
        "homing_offset", 20, 4, "RW", signed=True, **_POSITION, minimum=-HOMING_MAX, maximum=HOMING_MAX, default=0
    ),
    Register("moving_threshold", 24, 4, "RW", **_VELOCITY, minimum=0, maximum=VELOCITY_MAX, default=10),
    Register("temperature_limit", 31, 1, "RW", **_CELSIUS, minimum=0, maximum=100, default=80),
    Register("max_voltage_limit", 32, 2, "RW", **_VOLTAGE, minimum=95, maximum=160, default=160),
    Register("min_voltage_limit", 34, 2, "RW", **_VOLTAGE, minimum=95, maximum=160, default=95),
    Register("pwm_limit", 36, 2, "RW", **_DUTY, minimum=0, maximum=PWM_FULL, default=PWM_FULL),
    Register("current_limit", 38, 2, "RW", **_CURRENT, minimum=0, maximum=1193, default=1193),
    Register("velocity_limit", 44, 4, "RW", **_VELOCITY, minimum=0, maximum=VELOCITY_MAX, default=200),
    Register("max_position_limit", 48, 4, "RW", **_POSITION, minimum=0, maximum=4095, default=4095),
    Register("min_position_limit", 52, 4, "RW", **_POSITION, minimum=0, maximum=4095, default=0),
    Register("startup_configuration", 60, 1, "RW", minimum=0, maximum=3, default=0, min_firmware=45),
    Register("shutdown", 63, 1, "RW", minimum=0, maximum=255, default=0x34),
    # RAM
    Register("torque_enable", 64, 1, "RW", minimum=0, maximum=1, default=0),
    Register("led", 65, 1, "RW", minimum=0, maximum=1, default=0),
    Register("status_return_level", 68, 1, "RW", minimum=0, maximum=2, default=2),
    Register("registered_instruction", 69, 1, "R", minimum=0, maximum=1, default=0),
    Register("hardware_error_status", 70, 1, "R", default=0),
    Register("velocity_i_gain", 76, 2, "RW", **_GAIN, default=1920),
    Register("velocity_p_gain", 78, 2, "RW", **_GAIN, default=100),
    Register("position_d_gain", 80, 2, "RW", **_GAIN, default=0),
    Register("position_i_gain", 82, 2, "RW", **_GAIN, default=0),
    Register("position_p_gain", 84, 2, "RW", **_GAIN, default=800),
    Register("feedforward_2nd_gain", 88, 2, "RW", **_GAIN, default=0),
    Register("feedforward_1st_gain", 90, 2, "RW", **_GAIN, default=0),
    # Reads −1 once it has tripped; only 0…127 can be written.
    Register(
        "bus_watchdog",
        98,
        1,
        "RW",
        signed=True,
        unit="s",
        scale=0.02,
        minimum=0,
        maximum=127,
        default=0,
        min_firmware=38,
    ),
    Register("goal_pwm", 100, 2, "RW", signed=True, **_DUTY, minimum=-PWM_FULL, maximum=PWM_FULL, default=PWM_FULL),
    Register("goal_current", 102, 2, "RW", signed=True, **_CURRENT, minimum=-1193, maximum=1193, default=1193),
    Register("goal_velocity", 104, 4, "RW", signed=True, **_VELOCITY, minimum=-VELOCITY_MAX, maximum=VELOCITY_MAX),
    # The unit holds for velocity-based profiles; with bit 2 of the drive mode both profile registers count ms.
    Register(
        "profile_acceleration",
        108,
        4,
        "RW",
        unit="rad/s²",
        scale=RAD_S2_PER_COUNT,
        minimum=0,
        maximum=PROFILE_MAX,
        default=0,
    ),
    Register("profile_velocity", 112, 4, "RW", **_VELOCITY, minimum=0, maximum=PROFILE_MAX, default=0),
    Register("goal_position", 116, 4, "RW", signed=True, **_POSITION, minimum=-MULTI_TURN_MAX, maximum=MULTI_TURN_MAX),
    # In ms, as in run tables: it wraps after 32767 and is compared as a counter, never used as a duration.
    Register("realtime_tick", 120, 2, "R", unit="ms", minimum=0, maximum=32767),
    Register("moving", 122, 1, "R", minimum=0, maximum=1, default=0),
    Register("moving_status", 123, 1, "R", default=0),
    Register("present_pwm", 124, 2, "R", signed=True, **_DUTY),
    Register("present_current", 126, 2, "R", signed=True, **_CURRENT),
    Register("present_velocity", 128, 4, "R", signed=True, **_VELOCITY),
    Register("present_position", 132, 4, "R", signed=True, **_POSITION),
    Register("velocity_trajectory", 136, 4, "R", signed=True, **_VELOCITY),
    Register("position_trajectory", 140, 4, "R", signed=True, **_POSITION),
    Register("present_input_voltage", 144, 2, "R", **_VOLTAGE),
    Register("present_temperature", 146, 1, "R", **_CELSIUS),
    Register("backup_ready", 147, 1, "R", minimum=0, maximum=1, default=0, min_firmware=45),
)

#: Without a current sensor, address 126 is an estimate from the motor's own output.
_LOAD = Register("present_load", 126, 2, "R", signed=True, unit="1", scale=LOAD_PER_COUNT, minimum=-1000, maximum=1000)
_NO_CURRENT: Mapping[str, Register | None] = {"current_limit": None, "goal_current": None, "present_current": _LOAD}

#: model → register → what differs from BASE. A Register replaces the item, None removes it.
DIFFERENCES: Mapping[str, Mapping[str, Mapping[str, int] | Register | None]] = {
    "XM430-W350-T": {},
    "XM430-W210-T": {"model_number": {"default": 1030}, "velocity_limit": {"default": 330}},
    "XC430-W240-T": {
        **_NO_CURRENT,
        "model_number": {"default": 1080},
        "max_voltage_limit": {"minimum": 60},
        "min_voltage_limit": {"minimum": 60, "default": 60},
        "velocity_limit": {"default": 306},
        "position_p_gain": {"default": 700},
    },
    "XL430-W250-T": {
        **_NO_CURRENT,
        "model_number": {"default": 1060},
        "temperature_limit": {"default": 72},
        "max_voltage_limit": {"minimum": 60, "maximum": 140, "default": 140},
        "min_voltage_limit": {"minimum": 60, "maximum": 140, "default": 60},
        "velocity_limit": {"default": 265},
        "velocity_i_gain": {"default": 1000},
        "position_d_gain": {"default": 4000},
        "position_p_gain": {"default": 640},
    },
}


def _indirect_cells() -> Iterator[Register]:
    low, high = INDIRECT_TARGETS
    for first, count, address_cell, data_cell in INDIRECT_CELLS:
        for k in range(count):
            default = data_cell + k
            yield Register(
                f"indirect_address_{first + k}", address_cell + 2 * k, 2, "RW",
                minimum=low, maximum=high, default=default,
            )  # fmt: skip
            # A data cell takes over range and access of the byte that it points to.
            yield Register(f"indirect_data_{first + k}", data_cell + k, 1, "RW")


def control_table(model: str) -> dict[str, Register]:
    """Every register of one model, name → register, by rising address.

    Args:
        model: a key of DIFFERENCES, such as "XM430-W350-T".
    """
    differences = DIFFERENCES[model]
    table: list[Register] = []
    for register in (*BASE, *_indirect_cells()):
        change = differences.get(register.name, {})
        if isinstance(change, Register):
            table.append(change)
        elif change is not None:
            table.append(replace(register, **change))  # type: ignore[arg-type]
    return {register.name: register for register in sorted(table, key=lambda register: register.address)}
