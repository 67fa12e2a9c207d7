"""What the engine takes from its faces: every field of every message, by name, before anything is done.

A message comes out of a pickle: its class promises nothing about what stands in it. What is refused here has changed
nothing: torque is as it was, and the motion in progress goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import messages
from openant_tools.comms.restart import Restart
from openant_tools.comms.servos import Servos
from openant_tools.errors import BadInput
from openant_tools.numbers import exact, number, span
from openant_tools.recording.run import Facts

__all__ = ["LONGEST_S", "SLACK_RAD", "checked"]

Array = NDArray[np.float64]

#: s, a week: nobody holds, looks or plays longer by one command
LONGEST_S = 7 * 86400.0
#: rad by which rounding (single precision, decimals in a file) may put a goal beyond its limit: it then is the limit. A
#: hundredth of the encoder's step.
SLACK_RAD = 1.5e-5
#: rad, 256 turns: beyond them a servo has no positions, whatever limits are unknown
FARTHEST_RAD = 1600.0
#: What is not to be written past the engine, and what there is instead: whatever switches torque, moves a joint, or changes
#: what a position, a limit or a guard means.
GUARDED: Mapping[str, str] = {
    "torque_enable": "the message Torque switches it, with guardian and watchdog",
    "bus_watchdog": "the engine arms it whenever torque is on (EngineConfig.watchdog_s)",
    **dict.fromkeys(("goal_position", "goal_velocity"), "Ramp, Play and Goal move joints, within their limits"),
    **dict.fromkeys(
        ("operating_mode", "drive_mode", "homing_offset", "shutdown", "temperature_limit", "status_return_level"),
        "name it in EngineConfig.registers: it is in force, and known, before torque comes on",
    ),
    **dict.fromkeys(
        ("id", "secondary_id", "baud_rate", "protocol_type"), "`openant calib ids` changes it, and journals it"
    ),
}


def checked(command: Any, servos: Servos, limits_rad: Mapping[str, tuple[float, float]]) -> messages.Command:
    """The same command with its numbers as arrays and floats.

    Args:
        command: whatever came.
        servos: the joints, their order and registers.
        limits_rad: joint → (low, high).

    Raises:
        BadInput: no such message, or a field that cannot be; the words name message, field, joint and value.
    """
    check = _CHECKS.get(type(command))
    if check is None:
        remedy = f"one of {', '.join(sorted(kind.__name__ for kind in _CHECKS))}"
        raise BadInput(f"the engine knows no message {type(command).__name__}", remedy=remedy)
    done: messages.Command = check(command, servos, limits_rad)
    return done


def _torque(command: messages.Torque, servos: Servos, limits: Any) -> messages.Torque:
    if command.restart is not None and not isinstance(command.restart, Restart):
        raise BadInput(f"Torque.restart is {_words(command.restart)}", remedy="give what restart.Interlock gave")
    return replace(command, on=_flag("Torque.on", command.on))


def _ramp(command: messages.Ramp, servos: Servos, limits: Any) -> messages.Ramp:
    return replace(command, target=_angles("Ramp.target", command.target, servos.joints, limits))


def _play(command: messages.Play, servos: Servos, limits: Any) -> messages.Play:
    joints = servos.joints
    commands = _angles("Play.commands", command.commands, joints, limits, rows=True)
    limp = command.limp
    if limp is not None:
        if not isinstance(limp, np.ndarray) or limp.dtype != bool or limp.shape != commands.shape:
            raise BadInput(f"Play.limp is {_words(limp)}", remedy=f"give booleans of shape {commands.shape}")
        if limp[[0, -1]].any():
            raise BadInput("a motion must begin and end with the torque of all joints on")
    return replace(command, commands=commands, name=_text("Play.name", command.name))


def _hold(command: messages.Hold, servos: Servos, limits: Any) -> messages.Hold:
    return replace(command, seconds=_seconds("Hold.seconds", command.seconds))


def _goal(command: messages.Goal, servos: Servos, limits: Any) -> messages.Goal:
    agent = command.agent
    if agent is not None:
        if not isinstance(agent, tuple) or len(agent) != 2:
            raise BadInput(f"Goal.agent is {_words(agent)}", remedy="give two times in s, or None")
        agent = _number("Goal.agent", agent[0]), _number("Goal.agent", agent[1])
    return replace(
        command,
        target=_angles("Goal.target", command.target, servos.joints, limits),
        seconds=_seconds("Goal.seconds", command.seconds),
        measured=_flag("Goal.measured", command.measured),
        agent=agent,
    )


def _look(command: messages.LetPass, servos: Servos, limits: Any) -> messages.LetPass:
    return replace(command, seconds=_seconds("LetPass.seconds", command.seconds))


def _record(command: messages.Record, servos: Servos, limits: Any) -> messages.Record:
    path = _text("Record.path", command.path)
    if not path or "\0" in path:
        raise BadInput(f"Record.path is {path!r}", remedy="name a file")
    if not isinstance(command.facts, Facts):
        raise BadInput(f"Record.facts is {_words(command.facts)}", remedy="give Facts")
    if command.config is not None:
        _text("Record.config", command.config)
    for name in ("resume", "pictures"):
        _flag(f"Record.{name}", getattr(command, name))
    thin = command.thin_s
    if thin is not None and not _seconds("Record.thin_s", thin) > 0.0:
        raise BadInput(f"Record.thin_s is {thin}", remedy="give s above 0, or None to keep every cycle")
    return command


def _read(command: messages.ReadRegister, servos: Servos, limits: Any) -> messages.ReadRegister:
    name = _text("ReadRegister.register", command.register)
    for servo in servos.servos:
        servo.model.register(name)
    return command


def _write(command: messages.WriteRegister, servos: Servos, limits: Any) -> messages.WriteRegister:
    joint, name = _text("WriteRegister.joint", command.joint), _text("WriteRegister.register", command.register)
    register = servos[joint].model.register(name)
    if name in GUARDED:
        raise BadInput(f"{name} of {joint} is not written past the engine", remedy=GUARDED[name])
    if not isinstance(command.counts, (int, np.integer)) or isinstance(command.counts, bool):
        raise BadInput(f"WriteRegister.counts for {name} of {joint} is {_words(command.counts)}", remedy="give an int")
    register.check(int(command.counts))
    return replace(command, counts=int(command.counts))


def _as_it_is(command: Any, servos: Servos, limits: Any) -> Any:
    return command


_CHECKS: Mapping[type, Callable[[Any, Servos, Any], Any]] = {
    messages.Torque: _torque,
    messages.Ramp: _ramp,
    messages.Play: _play,
    messages.Hold: _hold,
    messages.Goal: _goal,
    messages.LetPass: _look,
    messages.Record: _record,
    messages.ReadRegister: _read,
    messages.WriteRegister: _write,
    messages.StopRecording: _as_it_is,
    messages.Stop: _as_it_is,
    messages.Statistics: _as_it_is,
    messages.TakePicture: _as_it_is,
}


# ---- one field ----------------------------------------------------------------------------------------------------


def _angles(
    what: str, value: Any, joints: tuple[str, ...], limits: Mapping[str, tuple[float, float]], *, rows: bool = False
) -> Array:
    """Finite angles (joints,) rad, or (n, joints), within the limits."""
    wanted = f"(n, {len(joints)})" if rows else f"({len(joints)},)"
    try:
        array = np.asarray(value)
    except ValueError:  # rows of several lengths
        raise BadInput(f"{what} is {_words(value)}", remedy=f"give numbers of shape {wanted}, in rad") from None
    if array.dtype.kind not in "fiu":
        raise BadInput(f"{what} is {_words(value)}, no numbers", remedy=f"give numbers of shape {wanted}, in rad")
    if array.ndim != 1 + rows or array.shape[-1] != len(joints) or not len(array):
        raise BadInput(f"{what} has shape {array.shape} for {len(joints)} joints", remedy=f"give {wanted}, in rad")
    angles = array.astype(float)
    low, high = np.array([limits.get(joint, (-FARTHEST_RAD, FARTHEST_RAD)) for joint in joints]).T
    bad = np.argwhere(~(np.isfinite(angles) & (angles >= low - SLACK_RAD) & (angles <= high + SLACK_RAD)))
    if len(bad):
        *row, k = bad[0].tolist()
        angle, place = angles[tuple(bad[0])], f" in row {row[0]}" if row else ""
        if not math.isfinite(angle):
            raise BadInput(f"{what} is {angle} for {joints[k]}{place}", remedy="give a finite angle, in rad")
        raise BadInput(
            f"{what}: a command of {number(angle, 'rad', decimals=2)} for {joints[k]}{place} is outside its limits "
            f"{span(low[k], high[k], 'rad', decimals=2)}"
        )
    return np.asarray(np.clip(angles, low, high))


def _number(what: str, value: Any) -> float:
    if not isinstance(value, (int, float, np.integer, np.floating)) or isinstance(value, bool):
        raise BadInput(f"{what} is {_words(value)}", remedy="give a number")
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise BadInput(f"{what} is {number}", remedy="give a finite number")
    return number


def _seconds(what: str, value: Any) -> float:
    seconds = _number(what, value)
    if not 0.0 <= seconds <= LONGEST_S:
        raise BadInput(f"{what} is {exact(seconds, 's')}", remedy=f"give 0 to {exact(LONGEST_S, 's')}")
    return seconds


def _flag(what: str, value: Any) -> bool:
    if not isinstance(value, (bool, np.bool_)):
        raise BadInput(f"{what} is {_words(value)}", remedy="give True or False")
    return bool(value)


def _text(what: str, value: Any) -> str:
    if not isinstance(value, str):
        raise BadInput(f"{what} is {_words(value)}", remedy="give a text")
    return value


def _words(value: Any) -> str:
    """A value short enough for one line."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} of shape {value.shape}"
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}…"
