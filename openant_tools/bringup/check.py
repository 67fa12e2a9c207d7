"""The daily check, two minutes before a session: what is not as it was when the passport was written, and what to look at.

Bus, registers, supply, temperatures and IMU are read; then the slow sweep of the step Observation bounds is made again. Friction,
a leg's weight and both stops of every joint are compared with what stood then: a joint that grew stiff, a foot that was
lost, a horn that slipped and a plug that works itself loose each change one of them and leave the others alone.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from openant_tools.bringup.gap_check import gap_by_joint
from openant_tools.calib.inventory import silence_words
from openant_tools.calib.lost_answers import loose, lost_in
from openant_tools.calib.sweep import FOLLOWED, JointSweep, analyse, joint_sweep_of, play_watched, sweep
from openant_tools.calib.wires import engine_config, opened_bus, opened_imu, robot_servos
from openant_tools.comms import messages
from openant_tools.comms.body_imu import rotation
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.imu import STANDARD_GRAVITY
from openant_tools.comms.lateness import REMEDY, losses
from openant_tools.comms.servos import Servos
from openant_tools.comms.state import BY_FACTORY, differences_of_robot, passport_registers, read_state, stopping
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.gap.measure import measure
from openant_tools.numbers import number, percent, span
from openant_tools.procedure.finding import Evidence, Finding, latest
from openant_tools.procedure.relay import relayed
from openant_tools.procedure.step import Bench, Intent, Procedure, Progress, Say, Subroutine, confirmed
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run
from openant_tools.robot.config import RobotConfig
from openant_tools.robot.joints import JOINTS
from openant_tools.sysid.excitation import CommandSpace
from openant_tools.sysid.protocols import protocol

__all__ = ["changed", "check", "unjudged"]

COMMAND = "openant check"
#: Friction: grown by this factor and by more than the sweep repeats to. Doubled friction is far beyond both.
FRICTION_FACTOR, FRICTION_NM = 1.5, 0.012
#: A leg's weight at its knee: share of what it was. The sweep repeats to 2 %; a foot is a fifth and more.
WEIGHT_SHARE, WEIGHT_NM = 0.15, 0.003
#: Both stops moved by so much: the zero did. A spline is 0.79 rad.
ZERO_RAD = 0.015
#: K below a servo's limit at which a session should not begin.
COOL_K = 20.0
#: IMU: |acc| against gravity, the body's lean on its stand, rad, and the gyro's rate at rest, rad/s.
GRAVITY_SHARE, LEAN_RAD, STILL_RAD_S = 0.06, math.radians(6), 0.05
TWITCH_S = 20.0
#: Share of steps at which an observation may be outside its measured bounds: a bound is the largest of many motions.
OUTSIDE_SHARE = 0.01
#: signal of an observation → how it is called before its joint or axis, and its unit
OBSERVED = {
    "pos": ("angle of", "rad"),
    "vel": ("speed of", "rad/s"),
    "gyro": ("turn rate about", "rad/s"),
    "acc": ("acceleration along", "m/s²"),
}
#: A joint's simulation error that was this much smaller when the model was made.
GAP_FACTOR, GAP_RAD = 1.8, 0.004
START_LIST = (
    "cables are not twisted, and leave the legs free",
    "the robot stands on its stand, legs free all round",
    "screws of feet and horns are in",
)
#: The paper's list for the start of an experiment.
BEFORE_A_SESSION = (
    "before it learns: cables outside the circle and untangled; the robot inside the circle, facing its reward",
)


def check(bench: Bench) -> Procedure:
    """Read, sweep, twitch, compare.

    Raises:
        BadInput: there is nothing to compare with: the step Observation bounds was not done.
    """
    config = bench.folder.config()
    bounds = latest(bench.folder, "bounds", real=not bench.virtual)
    if bounds is None or "sweep" not in bounds.data:
        raise BadInput(
            "there is nothing to compare with yet",
            where=bench.folder.path,
            remedy="`openant calib bounds` keeps what is healthy",
        )
    baseline = {joint: joint_sweep_of(one) for joint, one in bounds.data["sweep"].items()}
    evidence, problems, unsure = list[Evidence](), list[str](), list[str]()
    for line in START_LIST:
        if not (yield from confirmed(bench, f"Before it moves: {line}. Is that so?")):
            problems.append(f"not as it must be before it moves: {line} → see to it first")
    if problems:
        return _finding(problems, evidence, {})
    yield Progress(0.0, "bus, supply, temperatures")
    state: dict[str, dict[str, int]] = {}
    problems += _at_rest(bench, config, evidence, state)
    if problems:
        return _finding(problems, evidence, {})
    # Before hardware is blamed: registers that other software left explain most of what a sweep can show.
    odd = [
        one
        for one in differences_of_robot(
            robot_servos(config), state, config, passport_registers(bench.folder, real=not bench.virtual)
        )
        if one.register != "pwm_limit"  # set to robot.toml's by whatever moves
    ]
    problems += [f"{one.joint}: {one.reads} → {one.mended}" for one in odd if one.stops or one.by != BY_FACTORY]
    wrong = ", ".join(dict.fromkeys(one.joint for one in stopping(odd)))
    if wrong:
        unsure.append(f"cannot judge friction, weight and stops, because registers of {wrong} differ: nothing moved")
        return _finding(problems, evidence, {}, unsure)
    for difference in odd:
        if difference.by == BY_FACTORY:
            yield Say(str(difference), "warn")
    outside: dict[str, float] = {}
    runs = list[Run]()
    yield Progress(0.05, "IMU")
    problems += _imu(bench, config, evidence)
    yield Intent("sweep every joint slowly through its range, then twitch for 20 s, on the stand", moves=True)
    now: dict[str, JointSweep] = {}
    try:
        run = yield from sweep(
            engine_config(bench, imu=None), bench.folder.new_recording("check-sweep"), "slow sweep", (0.1, 0.6)
        )
    except HardwareFault as fault:
        problems.append(str(fault))
        return _finding(problems, evidence, {})
    runs.append(run)
    limits = {motor.joint: (motor.min_rad, motor.max_rad) for motor in config.motors.values()}
    now = analyse(run, limits)
    problems += changed(baseline, now)
    unsure += unjudged(baseline, now)
    problems += loose(lost_in(run), config.bus.chain)
    problems += yield from _of_this_computer(run)
    problems += _warm_or_weak(now, config)
    for joint, one in now.items():
        then = number(baseline[joint].friction_nm if joint in baseline else None, "N·m")
        evidence.append(Evidence(f"friction of {joint}", _measured(one.friction_nm), "N·m", f"slow sweep; then {then}"))
    try:
        twitch = yield from _twitch(bench)
    except HardwareFault as fault:
        problems.append(str(fault))
    else:
        runs.append(twitch)
        problems += loose(lost_in(twitch), config.bus.chain, problems)
        problems += yield from _of_this_computer(twitch)
        named = {*(line.partition(":")[0] for line in problems), *(difference.joint for difference in odd)}
        problems += yield from _against_model(bench, twitch, evidence, unsure, named)
        outside = _outside(twitch, config)
        for name, share in outside.items():
            signal, _, joint = name.partition(".")
            words, unit = OBSERVED[signal]
            within = span(*config.observation[name], unit)
            yield Say(f"{words} {joint} left {within} for {percent(share)} of the twitch", "warn")
    for line in BEFORE_A_SESSION:
        yield Say(line)
    return _finding(
        problems,
        evidence,
        {
            "sweep": {joint: one.as_dict() for joint, one in now.items()},
            "outside": outside,
            "recordings": ", ".join(bench.folder.relative(run.path) for run in runs if run.path),
        },
        unsure,
    )


def _measured(value: float | None) -> float | None:
    """A friction or weight, None where it cannot be one: neither is negative, nor nothing at all."""
    return value if value is not None and math.isfinite(value) and value > 0 else None


def unjudged(before: Mapping[str, JointSweep], now: Mapping[str, JointSweep]) -> list[str]:
    """What cannot be compared, because one of the two sweeps has not measured it: joint, what, and why."""
    words = []
    for joint, new in now.items():
        old = before.get(joint)
        kinds = ("friction_nm", "weight_nm") if JOINTS[joint].kind == "knee" else ("friction_nm",)
        for name in kinds:
            what, value = name.removesuffix("_nm"), getattr(new, name)
            if old is None or _measured(getattr(old, name)) is None:
                words.append(
                    f"{joint}: cannot judge its {what}, because it was not measured when the robot was healthy → `openant calib "
                    "bounds`"
                )
            elif new.followed < FOLLOWED:
                words.append(
                    f"{joint}: cannot judge its {what}, because it went only {percent(new.followed, decimals=0)} of the way that it was told "
                    "→ is it blocked? Turn it by hand, torque off, and check again"
                )
            elif _measured(value) is None:
                found = "was not measured" if value is None else f"of {number(value, 'N·m', decimals=3)} cannot be"
                words.append(f"{joint}: cannot judge its {what}, because a {what} {found} → check again")
        if new.temperature_c is None or new.volts is None:
            words.append(
                f"{joint}: cannot judge its supply and temperature, because it did not report them → check its cable"
            )
    return words


def changed(before: Mapping[str, JointSweep], now: Mapping[str, JointSweep]) -> list[str]:
    """What two sweeps of one robot have different: joint, how much, and the likely part."""
    words = []
    for joint, new in now.items():
        old = before.get(joint)
        if old is None:
            continue
        was, is_now = _measured(old.friction_nm), _measured(new.friction_nm)
        if was is not None and is_now is not None:
            if is_now > FRICTION_FACTOR * was and is_now - was > FRICTION_NM:
                words.append(
                    f"{joint}: friction {number(is_now, 'N·m', decimals=3)}, it was {number(was, decimals=3)} → gear (thread-locker, a worn "
                    "tooth), or the screws of its horn and idler too tight"
                )
            elif is_now < was / FRICTION_FACTOR - FRICTION_NM:
                words.append(
                    f"{joint}: friction {number(is_now, 'N·m', decimals=3)}, it was {number(was, decimals=3)} → is its horn screw loose?"
                )
        was, is_now = _measured(old.weight_nm), _measured(new.weight_nm)
        if JOINTS[joint].kind == "knee" and was is not None and is_now is not None:
            share = is_now / was - 1
            if abs(is_now - was) > WEIGHT_NM and abs(share) > WEIGHT_SHARE:
                words.append(
                    f"{joint}: its leg weighs {percent(abs(share), decimals=0)} {'less' if share < 0 else 'more'} than it did → "
                    + (
                        "a foot was lost, or a part of the lower leg"
                        if share < 0
                        else "something sticks to the lower leg"
                    )
                )
        words += _stops(joint, old, new)
    return words


def _stops(joint: str, old: JointSweep, new: JointSweep) -> list[str]:
    pairs = [(old.low_stop_rad, new.low_stop_rad), (old.high_stop_rad, new.high_stop_rad)]
    shifts = [b - a for a, b in pairs if a is not None and b is not None]
    gone = [b is None for a, b in pairs if a is not None]
    middle = float(np.mean(shifts)) if shifts else 0.0
    if len(shifts) == 2 and min(shifts) * max(shifts) > 0 and abs(middle) > ZERO_RAD:
        return [_zero_words(joint, middle)]
    if len(shifts) == 1 and any(gone) and abs(shifts[0]) > ZERO_RAD:
        return [_zero_words(joint, shifts[0])]
    if all(gone) and gone:
        return [
            f"{joint}: neither of its stops is where it was → its zero has changed by more than a few degrees, or its horn is loose"
        ]
    if any(abs(shift) > 2 * ZERO_RAD for shift in shifts):
        return [
            f"{joint}: one of its stops has moved by {number(max(shifts, key=abs), 'rad', sign=True, decimals=1)} → something is in its way"
        ]
    return []


def _zero_words(joint: str, shift: float) -> str:
    return (
        f"{joint}: its zero has changed by {number(shift, 'rad', sign=True, decimals=1)} (both stops moved) → horn screw or spline; then "
        "`openant calib zeros`"
    )


def _of_this_computer(run: Run) -> Subroutine[list[str]]:
    """What it missed itself: said, and a problem where nothing is left to judge the connectors by."""
    seen = losses(run)
    if not seen.words:
        return []
    yield Say(f"{seen.words} → {REMEDY}", "warn")
    return [] if seen.judged else [f"cannot judge the connectors, because {seen.words} → {REMEDY}"]


def _at_rest(
    bench: Bench, config: RobotConfig, evidence: list[Evidence], state: dict[str, dict[str, int]]
) -> list[str]:
    """Who answers, with what voltage and temperature, and which hardware errors stand; fills in what is set in them."""
    problems = []
    with opened_bus(bench) as bus:
        found = {motor.joint: bus.ping(motor.id, insist=True) for motor in config.motors.values()}
        known = [
            replace(servo, firmware=seen.firmware if (seen := found[servo.joint]) else None)
            for servo in robot_servos(config)
        ]
        servos = Servos(bus, known)
        for joint, seen in found.items():
            if seen is not None and seen.model_number != config.motors[joint].servo.number:
                problems.append(
                    f"{joint}: another servo model answers than the passport's → were two motors exchanged?"
                )
        silent = [config.motors[joint] for joint, seen in found.items() if seen is None]
        problems = silence_words(bus, silent, config) + problems
        if problems:
            return problems
        servos.set_torque(False)
        for servo in servos.servos:
            problems += [f"{servo.joint}: {e.name} → {e.advice}" for e in servos.hardware_errors(servo.joint)]
        volts = {servo.joint: servos.read("present_input_voltage", servo.joint) for servo in servos.servos}
        warm = {servo.joint: servos.read("present_temperature", servo.joint) for servo in servos.servos}
        state |= read_state(servos)
    low = min(volts, key=lambda joint: volts[joint])
    evidence += [
        Evidence("lowest supply at rest", volts[low], "V", f"register 144 of {low}"),
        Evidence(
            "warmest servo", max(warm.values()), "°C", f"register 146 of {max(warm, key=lambda joint: warm[joint])}"
        ),
    ]
    for joint, value in volts.items():
        lowest, highest = config.motors[joint].servo.supply_range_v
        if not lowest <= value <= highest + 0.5:
            problems.append(
                f"{joint}: is supplied with {number(value, 'V', decimals=1)}, it needs {number(lowest, decimals=1)} to {number(highest, decimals=1)} → supply and power plug"
            )
    for joint, value in warm.items():
        if value > config.motors[joint].servo.temperature_limit_c - COOL_K:
            problems.append(
                f"{joint}: is at {number(value, '°C', decimals=0)} already → let it cool before the session"
            )
    return problems


def _warm_or_weak(now: Mapping[str, JointSweep], config: RobotConfig) -> list[str]:
    words = []
    for joint, one in now.items():
        model = config.motors[joint].servo
        if one.temperature_c is not None and one.temperature_c > model.temperature_limit_c - COOL_K:
            words.append(
                f"{joint}: {number(one.temperature_c, '°C', decimals=0)} after a slow sweep → let it cool; is it blocked?"
            )
        if one.volts is not None and one.volts < model.supply_range_v[0]:
            words.append(
                f"{joint}: its supply fell to {number(one.volts, 'V', decimals=1)} while it moved → power plug, or a weak supply"
            )
    return words


def _imu(bench: Bench, config: RobotConfig, evidence: list[Evidence]) -> list[str]:
    """Whether the flight controller answers, lies level and still; nothing where the robot has none."""
    if bench.imu is None and config.ports.imu == "":
        return []
    try:
        with opened_imu(bench) as (driver, clock):
            end, rows = clock.now() + 1.0, list[tuple[float, ...]]()
            while clock.now() < end:
                sample = driver.read(clock.now() + 0.5)
                rows.append((*sample.acc, *sample.gyro))
    except HardwareFault as fault:
        return [f"IMU: {fault}"]
    seen = np.array(rows).mean(axis=0)
    body = rotation(config.imu.mounting_rad)
    acc, gyro = body @ seen[:3] - config.imu.acc_bias_m_s2, body @ seen[3:] - config.imu.gyro_bias_rad_s
    norm = float(np.linalg.norm(acc))
    if not (math.isfinite(norm) and np.isfinite(gyro).all()):
        return [
            "IMU: it answers, but not with numbers → power it off and on; `openant comms scan` shows whether it is one"
        ]
    lean = math.acos(max(-1.0, min(1.0, float(acc[2]) / norm))) if norm else math.pi
    evidence += [
        Evidence("norm of acc over gravity", norm / STANDARD_GRAVITY, "1", "IMU at rest"),
        Evidence("lean of the torso", lean, "rad", "gravity in the body's frame"),
        Evidence("gyro at rest", float(np.linalg.norm(gyro)), "rad/s", "less its bias"),
    ]
    words = []
    if abs(norm / STANDARD_GRAVITY - 1) > GRAVITY_SHARE:
        words.append(
            f"IMU: reads {number(norm, 'm/s²', decimals=2)} at rest → its scale has changed (new firmware?): `openant calib imu`"
        )
    if lean > LEAN_RAD:
        words.append(
            f"IMU: the torso leans by {number(lean, 'rad', decimals=0)} → put it level, or the board has come loose: `openant calib imu`"
        )
    if float(np.linalg.norm(gyro)) > STILL_RAD_S:
        words.append("IMU: the gyro turns at rest → was it moved while it was powered on? Power it off and on, still")
    return words


def _twitch(bench: Bench) -> Subroutine[Run]:
    """A short excitation on the stand, recorded; the recording."""
    path = bench.folder.new_recording("check-twitch")
    played = protocol("stand", TWITCH_S)
    config = engine_config(bench)
    joints = tuple(servo.joint for servo in config.servos)
    space = CommandSpace.around_home(dict(config.limits_rad), list(joints))
    commands = played.commands(space, config.rate_hz, 7)
    limp = played.limp(space, config.rate_hz)
    with EngineProcess(config) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(commands[0]))
        engine.ask(messages.Hold(0.5))
        volts = engine.ask(messages.ReadRegister("present_input_voltage"))
        facts = Facts(
            joints=joints,
            setup="stand",
            protocol="twitch",
            supply_v=round(float(np.mean(list(volts.values()))) * 0.1, 2),
        )
        engine.ask(messages.Record(str(path), facts))
        motion = messages.Play(commands, "twitch", limp if limp.any() else None)
        yield from play_watched(engine, motion, len(commands) / config.rate_hz, "twitch", (0.6, 1.0))
        engine.ask(messages.StopRecording())
        engine.ask(messages.Torque(False))
    return read_run(path)


def _against_model(
    bench: Bench, run: Run, evidence: list[Evidence], unsure: list[str], known: Collection[str]
) -> Subroutine[list[str]]:
    """Joints that the calibrated model simulates much worse than when it was made, besides those named already."""
    gap = latest(bench.folder, "gap", real=not bench.virtual)
    if gap is None or "by_joint_rad" not in gap.data:
        yield Say("there is no gap check to compare the twitch with", "warn")
        return []
    config = bench.folder.config()
    model = bench.folder.model_path(config)
    found = yield from relayed(lambda progress: measure([run], model, effects=config.effects))
    evidence.append(
        Evidence("position gap of the twitch", found.gaps.get("pos"), "rad", f"{model.name}, 0.5 s horizon")
    )
    now = gap_by_joint(found)
    before: dict[str, float] = {joint: off for joint, off in gap.data["by_joint_rad"].items() if off is not None}
    # A joint that was not measured is not as it was: its figure is missing, and that is said.
    evidence += [
        Evidence(f"position gap of {joint}", off, "rad", "the twitch against the model; its position was not read")
        for joint, off in now.items()
        if joint in before and not math.isfinite(off)
    ]
    unsure += [
        f"{joint}: cannot judge its motion, because the gap check has no figure of it → `openant calib gap`"
        for joint in now
        if joint not in before
    ]
    return [
        f"{joint}: moves differently from its model ({number(off, 'rad', name='error', decimals=1)}, it was {number(was, 'rad', name='error', decimals=1)}) → screws, gear, or a "
        "part that was exchanged; `openant gap diagnose` says more"
        for joint, off in now.items()
        if (was := before.get(joint)) is not None
        and off > GAP_FACTOR * was
        and off - was > GAP_RAD
        and joint not in known
    ]


def _outside(run: Run, config: RobotConfig) -> dict[str, float]:
    """observation → share of the steps at which it was outside the bounds that agents are normalised by."""
    shares = {}
    for name, (low, high) in config.observation.items():
        values = run.column(name)
        share = float(np.mean((values < low) | (values > high))) if np.isfinite(values).any() else 0.0
        if share > OUTSIDE_SHARE:
            shares[name] = share
    return shares


def _finding(
    problems: Sequence[str], evidence: Sequence[Evidence], data: Mapping[str, object], unsure: Sequence[str] = ()
) -> Finding:
    return Finding(
        "check",
        False if problems else None if unsure else True,
        f"{len(problems)} thing{'s' if len(problems) > 1 else ''} changed"
        if problems
        else f"{len(unsure)} thing{'s' if len(unsure) > 1 else ''} could not be judged"
        if unsure
        else "nothing has changed since the passport",
        tuple(evidence),
        ""
        if not (problems or unsure)
        else "mend what is listed and check again; where it was meant, do the step that measures it again",
        COMMAND,
        data=dict(data),
        problems=tuple(problems),
        unsure=tuple(unsure),
    )
