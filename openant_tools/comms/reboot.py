"""Clearing a latched hardware error: which one stands, whether its cause does, and whether it comes back."""

from __future__ import annotations

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.bus import Bus
from openant_tools.comms.silence import ERROR_STATUS, VOLTAGE, ask, diagnose, patient_ping, read_register
from openant_tools.errors import HardwareFault
from openant_tools.numbers import number, span
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Intent, Procedure, RegisterChange, Say
from openant_tools.robot.servo import HardwareError, hardware_errors

__all__ = ["reboot"]

TEMPERATURE, TEMPERATURE_LIMIT, VOLTAGE_LIMITS, TORQUE_ENABLE = 146, 31, 32, 64
#: K below its limit a servo must be, or it is back there at once
COOL_K = 5
#: s that a servo is mute while it starts (0.3 to 0.5), with a margin; and how long an error takes to show again
BOOT_S, LONGEST_S, SHOWS_S = 0.5, 3.0, 0.2
OTHER_REMEDY = "power it off and on"


def reboot(bus: Bus, id: int, name: str, command: str) -> Procedure:
    """Say what keeps a servo from working, and clear it where its cause is gone and that is granted; torque is off afterwards.

    Args:
        name: of the servo, for people. command: the command that does it.

    Raises:
        HardwareFault: it does not answer, and the message says why; it does not come back, or its torque is not off.
    """
    errors = _latched(bus, id)
    for error in errors:
        yield Say(f"{name} has switched itself off after {error.name}: {error.advice}", "warn")
    if not errors:
        return _finding(True, f"{name} has no hardware error: there is nothing to clear", errors, command)
    if cause := _cause(bus, id):
        return _finding(False, f"not rebooted, the error would come back: {cause}", errors, command)
    yield Say(f"a reboot clears it, as does another way: {OTHER_REMEDY}")
    off = RegisterChange(name, "torque_enable", None, 0, "off, and it stays so")
    yield Intent(f"reboot {name}, which lets go of its joint", (off,))
    left = _start_anew(bus, id)
    if not left:
        return _finding(True, f"{name} works again: {_names(errors)} is cleared, its torque is off", left, command)
    remedy = f"{left[0].advice}; where it stays so, {OTHER_REMEDY}, or replace the servo"
    return _finding(False, f"{name} reports {_names(left)} again at once → {remedy}", left, command)


def _finding(ok: bool, what: str, errors: tuple[HardwareError, ...], command: str) -> Finding:
    count = Evidence("hardware errors that stand", len(errors), "1", "register Hardware Error Status (70)", most=0)
    return Finding("reboot", ok, what, (count,), "", command, problems=() if ok else (what,))


def _names(errors: tuple[HardwareError, ...]) -> str:
    return " and ".join(error.name for error in errors)


def _latched(bus: Bus, id: int) -> tuple[HardwareError, ...]:
    status, _ = patient_ping(bus, id)
    value = None if status is None else read_register(bus, id, ERROR_STATUS, 1)
    if status is None or value is None:
        raise diagnose(bus, [id]).fault(bus.line.path)
    return hardware_errors(value[0])


def _start_anew(bus: Bus, id: int) -> tuple[HardwareError, ...]:
    """Start it anew; its torque is off afterwards. The errors that came back at once."""
    where = f"{bus.line.path}, servo {id}"
    bus.send(p2.reboot(id).encode())  # whether it answers depends on its Status Return Level
    started = bus.clock.now()
    bus.clock.sleep_until(started + BOOT_S)
    while patient_ping(bus, id, (0.1,))[0] is None:
        if bus.clock.now() - started > LONGEST_S:
            raise HardwareFault("it does not come back from its reboot", where=where, remedy=OTHER_REMEDY)
    for _ in range(3):
        # Startup Configuration (60) may have switched torque on.
        ask(bus, p2.write(id, TORQUE_ENABLE, b"\0").encode(), 0.1, lambda heard: bool(heard.statuses))
        if read_register(bus, id, TORQUE_ENABLE, 1) == b"\0":
            break
    else:
        raise HardwareFault("it does not say that its torque is off", where=where, remedy="cut its power")
    bus.clock.sleep_until(bus.clock.now() + SHOWS_S)
    value = read_register(bus, id, ERROR_STATUS, 1)
    if value is None:
        raise HardwareFault("it does not say whether its error is gone", where=where, remedy=OTHER_REMEDY)
    return hardware_errors(value[0])


def _cause(bus: Bus, id: int) -> str:
    """What would bring the error back at once; empty for nothing."""
    temperature, limit = read_register(bus, id, TEMPERATURE, 1), read_register(bus, id, TEMPERATURE_LIMIT, 1)
    if temperature and limit and temperature[0] > limit[0] - COOL_K:
        return (
            f"it is at {temperature[0]} °C and its limit is {limit[0]} °C → let it cool below {limit[0] - COOL_K} °C (20 "
            "minutes), and take load off this joint"
        )
    volts, limits = read_register(bus, id, VOLTAGE, 2), read_register(bus, id, VOLTAGE_LIMITS, 4)
    if volts and limits:
        now = int.from_bytes(volts, "little")
        high, low = int.from_bytes(limits[:2], "little"), int.from_bytes(limits[2:], "little")
        if not low <= now <= high:
            return (
                f"it is supplied with {number(now / 10, 'V', decimals=1)} and is set to bear {span(low / 10, high / 10, 'V', decimals=1)} → look at the "
                "power connector and at the supply under load"
            )
    return ""
