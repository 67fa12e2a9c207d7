"""What a servo's registers come to in N·m, and back: the law of the position loop, and the motor that it drives.

In position mode the firmware turns the position error into a duty, and the bridge puts that share of the supply on the motor:

    duty = (P / p_divisor · e + I / i_divisor · Σe + D / d_divisor · Δe) / 885, at most PWM limit / 885      e in pulses
    τ    = duty · τ_stall − τ_stall / ω_no-load · ω

The first line is the e-manual's (Position PID Gain(80, 82, 84), Goal PWM(100)): sums and differences are taken once in a control
period, which is not published. The second is a DC motor's, τ = kt · (duty · V − ke · ω) / R, with its constants read off a data
sheet's line of stall and free run. A `<position>` actuator of MuJoCo, τ = kp · (ctrl − q) − kv · q̇ within `forcerange`, is that
law with kp and kv as below, without the sum; there the limit holds for both terms, in the servo for the duty alone.

Everything here is a plain function of numbers (pulses, counts, N·m, V, s); which servo has which is `gain_models`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE

__all__ = [
    "CONTROL_PERIOD_S", "D_DIVISOR", "I_DIVISOR", "P_DIVISOR", "Rating", "back_emf_damping_nm_s_rad", "d_gain_for", "derivative_damping_nm_s_rad", "emf_constant_v_s_rad",
    "integral_gain_nm_rad_s", "p_gain_for", "pwm_limit_for", "resistance_ohm", "stall_torque_nm", "stiffness_nm_rad",
    "torque_constant_nm_a", "torque_limit_nm",
]  # fmt: skip

#: The manual's (Position PID Gain(80, 82, 84)), the same for every model that it has.
P_DIVISOR, I_DIVISOR, D_DIVISOR = 128.0, 65536.0, 16.0
#: Assumed: none is published. Asked of velocity control ROBOTIS says "much faster than 1kHz" (DynamixelSDK issue 534).
CONTROL_PERIOD_S = 1e-3


@dataclass(frozen=True)
class Rating:
    """One line of a data sheet: stall and free run at one supply voltage."""

    voltage_v: float
    stall_torque_nm: float
    stall_current_a: float
    no_load_rad_s: float


def stall_torque_nm(ratings: Sequence[Rating], supply_v: float, duty: float = 1.0) -> float:
    """N·m at stall, at any supply and duty.

    The data sheet's own at the supplies that it lists. Between them τ / V, which is kt / R, is interpolated, and beyond them it is
    the nearest line's: stall current is V / R. A duty acts as so much less supply does, with the kt / R of the whole supply.

    Args:
        ratings: the data sheet's lines, by rising voltage.
    """
    per_volt = [rating.stall_torque_nm / rating.voltage_v for rating in ratings]
    return duty * supply_v * float(np.interp(supply_v, [rating.voltage_v for rating in ratings], per_volt))


def torque_constant_nm_a(rating: Rating) -> float:
    """kt at the output, τ_stall / I_stall; the friction of the gear at stall is in it, so it is not `emf_constant_v_s_rad`."""
    return rating.stall_torque_nm / rating.stall_current_a


def resistance_ohm(rating: Rating) -> float:
    """R = V / I_stall: winding, bridge and cable together."""
    return rating.voltage_v / rating.stall_current_a


def emf_constant_v_s_rad(rating: Rating) -> float:
    """ke at the output, V / ω_no-load."""
    return rating.voltage_v / rating.no_load_rad_s


def back_emf_damping_nm_s_rad(rating: Rating) -> float:
    """τ_stall / ω_no-load, the slope of the torque–speed line (kt · ke / R): the same at any supply, gain and duty."""
    return rating.stall_torque_nm / rating.no_load_rad_s


def stiffness_nm_rad(p_gain: float, divisor: float, stall_nm: float) -> float:
    """kp = P / divisor · (4096 / 2π) / 885 · τ_stall, in N·m/rad.

    Args:
        p_gain: the register `position_p_gain`.
        divisor: 128 by the manual; measured otherwise on some (`gain_models`).
        stall_nm: stall torque at the supply and full duty.
    """
    return p_gain / divisor / PWM_FULL / RAD_PER_PULSE * stall_nm


def p_gain_for(stiffness: float, divisor: float, stall_nm: float) -> float:
    """The P gain of a stiffness, before it is rounded to a register's count; the inverse of `stiffness_nm_rad`."""
    return stiffness * divisor * PWM_FULL * RAD_PER_PULSE / stall_nm


def derivative_damping_nm_s_rad(d_gain: float, divisor: float, period_s: float, stall_nm: float) -> float:
    """The share of kv that the D gain makes, D / divisor · period · (4096 / 2π) / 885 · τ_stall, in N·m·s/rad.

    Args:
        d_gain: the register `position_d_gain`.
        divisor: 16 by the manual.
        period_s: control period, over which the difference is taken; no maker's page states it.
        stall_nm: stall torque at the supply and full duty.
    """
    return stiffness_nm_rad(d_gain, divisor, stall_nm) * period_s


def d_gain_for(damping: float, divisor: float, period_s: float, stall_nm: float) -> float:
    """The D gain of a damping, before it is rounded; the inverse of `derivative_damping_nm_s_rad`."""
    return p_gain_for(damping / period_s, divisor, stall_nm)


def integral_gain_nm_rad_s(i_gain: float, divisor: float, period_s: float, stall_nm: float) -> float:
    """ki = I / divisor / period · (4096 / 2π) / 885 · τ_stall, in N·m/(rad·s); a `<position>` actuator has none.

    Args:
        i_gain: the register `position_i_gain`.
        divisor: 65536 by the manual.
        period_s, stall_nm: as in `derivative_damping_nm_s_rad`.
    """
    return stiffness_nm_rad(i_gain, divisor, stall_nm) / period_s


def torque_limit_nm(pwm_limit: float, stall_nm: float) -> float:
    """The end of forcerange, PWM limit / 885 · τ_stall: what the servo gives at stall at its limit of duty."""
    return pwm_limit / PWM_FULL * stall_nm


def pwm_limit_for(torque_nm: float, stall_nm: float) -> float:
    """The PWM limit of a torque, before it is rounded; the inverse of `torque_limit_nm`."""
    return torque_nm / stall_nm * PWM_FULL
