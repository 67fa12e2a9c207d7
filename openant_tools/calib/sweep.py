"""The slow sweep: every joint gently from stop to stop and back, and what that tells of friction, load, stops and losses.

At a constant slow speed the motor's torque is friction against the motion plus what the leg weighs:

    τ = (kt/R)·(duty·V − ke·ω) = f·sign(ω) + g·cos(q)

fitted per joint to the rows away from stops and turning points. g is the leg's weight about a knee whose torso is level
(a hip, whose axis is upright, has a constant instead). Stops are where a joint stands still although it is told to go on, pushed with no
more than `SWEEP_PWM` of full duty.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.calib.wires import heard
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.guards import Guards
from openant_tools.comms.messages import EngineConfig
from openant_tools.procedure.step import Live, Progress, Subroutine
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.registers import PWM_FULL
from openant_tools.robot.servo import ServoModel, servo_model

__all__ = ["FOLLOWED", "JointSweep", "analyse", "joint_sweep_of", "play_watched", "sweep"]

Array = NDArray[np.float64]
#: from which to which share of a step's progress
Part = tuple[float, float]
WHOLE: Part = (0.0, 1.0)

#: rad/s; slow enough that nothing but friction and weight counts, and that a hand can stop it
SPEED_RAD_S = 0.35
#: rad beyond the limits of commands that are tried for a stop
BEYOND_RAD = 0.12
#: share of full duty: some 0.3 N·m at a hip, 0.6 at a knee
SWEEP_PWM = 0.15
#: rad from the ends of the motion that the fit leaves out: stops, turning points
MARGIN_RAD = 0.1
#: rad that a joint stays behind its command where a stop holds it; friction and gain leave less
HELD_RAD = 0.04
FITTED_ROWS = 100
#: A joint moves as it is told where it goes at least half as far within WINDOW_S; where it does for less than FOLLOWED of its
#: way, its duty tells neither friction nor weight.
WINDOW_S, FOLLOWED = 0.2, 0.8


@dataclass(frozen=True)
class JointSweep:
    """What one joint's sweep tells; None where the data do not.

    Attributes:
        friction_nm: f of the module's formula, with its standard error.
        weight_nm: g. low_stop_rad, high_stop_rad: where it was held.
        temperature_c: at the end. volts: lowest.
        followed: share of the way between its limits in which it moved as it was told; without it nothing was measured.
    """

    joint: str
    friction_nm: float | None
    friction_error_nm: float | None
    weight_nm: float | None
    weight_error_nm: float | None
    low_stop_rad: float | None
    high_stop_rad: float | None
    temperature_c: float | None
    volts: float | None
    followed: float = 1.0

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def joint_sweep_of(content: Mapping[str, Any]) -> JointSweep:
    """The inverse of `as_dict`; raises TypeError on what it did not write."""
    # Which answers were lost stood there until `lost_answers` told it better.
    return JointSweep(**{name: value for name, value in content.items() if name != "lost"})


def commands(limits: Mapping[str, tuple[float, float]], joints: tuple[str, ...], rate_hz: float) -> Array:
    """(n, joints) rad: all hips together to both ends, then all knees; straight before and after.

    Hips go the same way all at once, so that neighbouring legs keep their distance.
    """
    parts = []
    for kind in ("hip", "knee"):
        mine = [k for k, joint in enumerate(joints) if JOINTS[joint].kind == kind]
        if not mine:
            continue
        reach = max(max(-limits[joints[k]][0], limits[joints[k]][1]) for k in mine) + BEYOND_RAD
        shape = _there_and_back(reach, rate_hz)
        rows = np.zeros((len(shape), len(joints)))
        for k in mine:
            low, high = limits[joints[k]]
            rows[:, k] = np.clip(shape, low - BEYOND_RAD, high + BEYOND_RAD)
        parts.append(rows)
    return np.concatenate(parts)


def _there_and_back(reach: float, rate_hz: float) -> Array:
    """0 → +reach → −reach → 0 at constant speed, rad."""
    corners = np.array([0.0, reach, -reach, 0.0])
    times = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corners)))]) / SPEED_RAD_S
    return np.asarray(np.interp(np.arange(0.0, times[-1], 1 / rate_hz), times, corners), float)


def sweep(config: EngineConfig, path: Path, words: str, part: Part = WHOLE) -> Subroutine[Run]:
    """Play the sweep on the stand and record it to `path`, as such a part of its step; the recording.

    Raises:
        HardwareFault: a guard stopped it; its words say which joint and why.
    """
    joints = tuple(servo.joint for servo in config.servos)
    wide = {name: (low - 2 * BEYOND_RAD, high + 2 * BEYOND_RAD) for name, (low, high) in config.limits_rad.items()}
    played = commands(config.limits_rad, joints, config.rate_hz)
    gentle = replace(config, limits_rad=wide, guards=replace(config.guards or Guards(), angle_margin_rad=0.4))
    with EngineProcess(gentle) as engine:
        engine.ask(messages.Torque(True))
        for joint in joints:
            engine.ask(messages.WriteRegister(joint, "goal_pwm", round(SWEEP_PWM * PWM_FULL)))
        engine.ask(messages.Ramp(played[0]))
        volts = engine.ask(messages.ReadRegister("present_input_voltage"))
        facts = Facts(
            joints=joints, setup="stand", protocol="slow sweep", supply_v=float(np.mean(list(volts.values()))) * 0.1
        )
        engine.ask(messages.Record(str(path), facts))
        yield from play_watched(engine, messages.Play(played, "slow sweep"), len(played) / config.rate_hz, words, part)
        engine.ask(messages.StopRecording())
        engine.ask(messages.Torque(False))
    return read_run(path)


def play_watched(
    engine: EngineProcess, command: messages.Command, seconds: float, words: str, part: Part | None = WHOLE
) -> Subroutine[None]:
    """Start a motion and show joints and progress until it ends; raises HardwareFault where it is stopped.

    Args:
        part: of its step, that the motion is; None where the step's progress is told otherwise.
    """
    number = engine.start(command)
    names = [servo.joint for servo in engine.config.servos]
    at = [engine.columns.index(f"pos.{name}") for name in names]
    t, first = engine.columns.index("t"), math.nan
    low = {name: limit[0] for name, limit in engine.config.limits_rad.items()}
    high = {name: limit[1] for name, limit in engine.config.limits_rad.items()}
    said = 0.0
    while not engine.done(number):
        yield from heard(engine)
        rows = engine.telemetry()
        if len(rows):
            first = float(rows[0, t]) if math.isnan(first) else first
            share = min(1.0, (float(rows[-1, t]) - first) / seconds)
            yield Live({n: float(rows[-1, k]) for n, k in zip(names, at, strict=True)}, "rad", words, low, high)
            if part is not None and share - said > 0.2:
                said = share
                yield Progress(part[0] + share * (part[1] - part[0]), words)
        # The motion runs in the engine's process: real time passes here, also where the robot's is stepped.
        time.sleep(0.05)


# ---- analysis: a recording in, numbers out ---------------------------------------------------------------------------


def analyse(run: Run, limits: Mapping[str, tuple[float, float]]) -> dict[str, JointSweep]:
    """Every joint of a sweep.

    Args:
        run: a recording of `sweep`, with cmd, pos, pwm. limits: joint → the limits that the sweep was made with, rad.
    """
    return {joint: _joint(run, joint, *limits[joint]) for joint in run.joints}


def _joint(run: Run, joint: str, low: float, high: float) -> JointSweep:
    cmd, pos, duty = (run.signal(name, [joint])[:, 0] for name in ("cmd", "pos", "pwm"))
    volt, temperature = (run.signal(name, [joint])[:, 0] for name in ("volt", "temp"))
    model = servo_model(run.facts.motors[joint])
    rate = np.gradient(cmd, run.t)
    inside = (np.abs(rate) > 0.8 * SPEED_RAD_S) & (pos > low + MARGIN_RAD) & (pos < high - MARGIN_RAD)
    moves = _moves(run.t, cmd, pos)
    followed = float(np.mean(moves[inside])) if inside.any() else 0.0
    good = inside & moves & np.isfinite(pos) & np.isfinite(duty)
    friction = weight = friction_error = weight_error = None
    if good.sum() >= FITTED_ROWS and followed >= FOLLOWED:
        supply = np.where(
            np.isfinite(volt), volt, np.nanmean(volt) if np.isfinite(volt).any() else model.nominal_voltage_v
        )
        torque = _torque(model, duty[good], supply[good], rate[good])
        (friction, weight), (friction_error, weight_error) = _fit(
            torque, rate[good], pos[good], JOINTS[joint].kind == "knee"
        )
    return JointSweep(
        joint, friction, friction_error, weight, weight_error,
        _stop(cmd, pos, -1), _stop(cmd, pos, 1),
        float(np.nanmax(temperature[-200:])) if np.isfinite(temperature[-200:]).any() else None,
        float(np.nanmin(volt)) if np.isfinite(volt).any() else None,
        followed,
    )  # fmt: skip


def _moves(t: Array, cmd: Array, pos: Array) -> NDArray[np.bool_]:
    """(n,), where the joint goes at least half as far as its command within a window, the same way."""
    seen = np.isfinite(pos)
    if seen.sum() < 2:
        return np.zeros(len(t), bool)

    def way(values: Array) -> Array:
        there: Array = np.interp(t + WINDOW_S / 2, t, values) - np.interp(t - WINDOW_S / 2, t, values)
        return there

    asked, went = way(cmd), way(np.interp(t, t[seen], pos[seen]))
    out: NDArray[np.bool_] = went * np.sign(asked) >= 0.5 * np.abs(asked)
    return out


def _torque(model: ServoModel, duty: Array, supply: Array, rate: Array) -> Array:
    return model.kt_nm_a * (duty * supply - model.ke_v_s_rad * rate) / model.resistance_ohm


def _fit(torque: Array, rate: Array, pos: Array, knee: bool) -> tuple[tuple[float, float], tuple[float, float]]:
    # An offset and a sine would hide the weight: over a knee's range the three are nearly one shape.
    matrix = np.column_stack([np.sign(rate), np.cos(pos) if knee else np.ones_like(pos)])
    solution, *_ = np.linalg.lstsq(matrix, torque, rcond=None)
    left = torque - matrix @ solution
    # Neighbouring rows err alike (cogging, quantisation): one in ten counts.
    variance = float(left @ left) / max(1, len(torque) / 10 - matrix.shape[1])
    errors = np.sqrt(np.diag(np.linalg.pinv(matrix.T @ matrix)) * variance)
    weight = (float(solution[1]), float(errors[1])) if knee else (0.0, 0.0)
    return (float(solution[0]), weight[0]), (float(errors[0]), weight[1])


def _stop(cmd: Array, pos: Array, side: int) -> float | None:
    """Where the joint was held on one side although it was told to go on, rad."""
    held = (side * (cmd - pos) > HELD_RAD) & np.isfinite(pos)
    if held.sum() < 5:
        return None
    return float(np.median(np.sort(side * pos[held])[-20:]) * side)
