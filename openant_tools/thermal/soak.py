"""A soak: load the robot, keep every servo's temperature for minutes to hours, stop before its limit, and keep the cooling.

A soak is a procedure that any face can show, which ends its cooling early where the builder says "enough". The recording knows the plan, so that after a crash `resume_plan` and `soak(…, resume=True)` make one recording of both parts.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.guards import Guards
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.restart import MotionStopped, StopCause
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.numbers import number, percent
from openant_tools.procedure.step import Live, Progress, Say, Subroutine
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD
from openant_tools.robot.registers import PULSES_PER_TURN, PWM_FULL
from openant_tools.thermal.thermometer import Thermometer, clean

__all__ = [
    "COOL_DOWN_S",
    "POSES",
    "HeatSoaked",
    "Load",
    "SoakPlan",
    "pose_angles",
    "resume_plan",
    "soak",
    "soak_config",
]  # fmt: skip

Array = NDArray[np.float64]
Load = Literal["stand", "hang", "stall", "play"]
Phase = Literal["load", "cool-down"]
Why = Literal["time", "margin", "shutdown", "guard"]

#: The maker's advice after an overheating shutdown (facts/dynamixel C3), s.
COOL_DOWN_S = 1200.0
#: s between two looks at the robot: real time is watched closely, a virtual robot's may run on.
LOOK_S, STEPPED_LOOK_S, STEPPED_PIECE_S = 1.0, 10.0, 60.0
#: s after the joints were loaded until they must be stalled, and the share of the wanted duty that proves it.
STALL_S, STALLED = 3.0, 0.7
#: The legs are let down until they stand still, in so many goes at most; rad that count as still.
PRESSES, STILL_RAD = 20, 0.01
#: K below a limit from which no soak begins: what is hot already is to cool first.
BEGIN_K = 10.0
#: s that a servo must read too hot until the engine believes it: longer than any telemetry error
HOT_S = 3.0
#: A soak must outlive a noisy bus: s without an answer until a servo is given up.
SILENT_S = 3.0

#: what goes on without torque; °C where the bars of temperatures begin
COOLING, COLD_C = "cooling, torque off; Enter: enough of it", 15.0

#: name → angles by kind of joint, rad
POSES: Mapping[str, Mapping[str, float]] = {
    "home": {"hip": HOME_RAD["hip"], "knee": HOME_RAD["knee"]},
    "low": {"hip": 0.0, "knee": math.radians(-30)},
    "tall": {"hip": 0.0, "knee": math.radians(-65)},
    "straight": {"hip": 0.0, "knee": 0.0},
}


@dataclass(frozen=True)
class SoakPlan:
    """What a soak is to do.

    Attributes:
        load: `stand` on its feet in held poses, `hang` on its stand in held poses, `stall`ed knees that press a weight
            they cannot lift (the paper's stress test), or `play` a recording's commands over and over.
        seconds: of load. cool_down_s: recorded afterwards, torque off.
        poses: names of `POSES` or `knee=-0.32,hip=0`, held one after the other, equally long.
        effort: share of full duty with which stalled knees press.
        margin_k: below each servo's own limit, where the load ends; negative to let the servos shut down by themselves.
        commands: the file whose commands are played.
        notes: of the builder, such as "heat sinks on all knees".
        heat_sinks: joints whose servo has one.
        ambient_c: of the room, where a thermometer hangs there.
    """

    load: Load = "stand"
    seconds: float = 3600.0
    cool_down_s: float = COOL_DOWN_S
    poses: tuple[str, ...] = ("home",)
    effort: float = 0.5
    margin_k: float = 3.0
    commands: str | None = None
    notes: str | None = None
    heat_sinks: tuple[str, ...] = ()
    ambient_c: float | None = None

    @property
    def setup(self) -> str:
        return "stand" if self.load == "hang" else "floor"


@dataclass(frozen=True)
class HeatSoaked:
    """What came of a soak.

    Attributes:
        path: the recording. cycles: in it.
        why: how the load ended: `time`, `margin`, `shutdown`, or `guard`.
        joint: who ended it. words: the same for people.
        loaded_s: how long the robot was under load, in all.
        peak_c: joint → highest temperature. glitches: joint → readings that were telemetry errors.
    """

    path: Path
    cycles: int
    why: Why
    joint: str | None
    words: str
    loaded_s: float
    peak_c: Mapping[str, float]
    glitches: Mapping[str, int]


def pose_angles(pose: str, joints: Sequence[str]) -> Array:
    """(joints,) rad of a pose by name, or by `knee=-0.32,hip_rr=0.1` (the rest at home).

    Raises:
        BadInput: no such pose, joint or number.
    """
    if pose in POSES:
        return np.array([POSES[pose][JOINTS[joint].kind] for joint in joints])
    angles = np.array([HOME_RAD[JOINTS[joint].kind] for joint in joints])
    for part in pose.split(","):
        name, _, text = part.partition("=")
        name = name.strip()
        chosen = [k for k, joint in enumerate(joints) if name in (joint, JOINTS[joint].kind)]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not chosen or not math.isfinite(value):
            remedy = f"name one of {', '.join(POSES)}, or angles in rad such as knee=-0.32,hip=0"
            raise BadInput(f"{pose!r} is no pose", remedy=remedy)
        angles[chosen] = value
    return angles


def soak_config(config: EngineConfig, rate_hz: float, margin_k: float = SoakPlan.margin_k) -> EngineConfig:
    """The engine's config for hours at a few cycles a second: silence is borne longer.

    Heat is watched here, by one who knows telemetry errors; half way from there to the limit the engine stops by itself,
    whatever becomes of us.

    Args:
        margin_k: of the plan; below zero the servos are to shut down by themselves.
    """
    guards = replace(
        config.guards or Guards(),
        temperature_margin_k=None if margin_k < 0 else margin_k / 2,
        temperature_s=HOT_S,
        silent_s=max(0.25, SILENT_S),
        silent_cycles=5,
        lost_s=max(0.4, 2 * SILENT_S),
    )
    # Servos stop by themselves where three cycles in a row are lost.
    watchdog = min(2.54, max(config.watchdog_s, 3.0 / rate_hz))
    return replace(config, rate_hz=rate_hz, guards=guards, watchdog_s=watchdog, imu=None, camera=None)


def resume_plan(path: Path) -> SoakPlan:
    """The plan of a soak that was cut short, as its recording has it.

    Raises:
        BadInput: there is no such recording, or it is none of a soak.
    """
    recording = read_recording(path)
    table = recording.run.facts.extra.get("soak")
    if not isinstance(table, dict):
        raise BadInput("this is no recording of a soak", where=path, remedy="record under another name")
    known = {name: table[name] for name in SoakPlan.__dataclass_fields__ if name in table}
    return SoakPlan(**{**known, "poses": tuple(known["poses"]), "heat_sinks": tuple(known["heat_sinks"])})


@dataclass
class _Log:
    """What was seen so far: thermometers, and a few minutes of the past for rates."""

    joints: tuple[str, ...]
    columns: Mapping[str, int]
    thermometers: list[Thermometer]
    past: list[tuple[float, Array]] = field(default_factory=list)
    last: Array | None = None
    first_t: float | None = None
    t: float = 0.0
    peak: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, engine: EngineProcess, joints: tuple[str, ...]) -> _Log:
        columns = {name: k for k, name in enumerate(engine.columns)}
        return cls(joints, columns, [Thermometer() for _ in joints], peak=np.full(len(joints), np.nan))

    def take(self, rows: Array) -> None:
        if not len(rows):
            return
        places = [self.columns[f"temp.{joint}"] for joint in self.joints]
        times = rows[:, self.columns["t"]]
        for t, readings in zip(times.tolist(), rows[:, places].tolist(), strict=True):
            for thermometer, reading in zip(self.thermometers, readings, strict=True):
                thermometer.read(t, reading)
        self.t = float(times[-1])
        self.first_t = float(times[0]) if self.first_t is None else self.first_t
        self.last = rows[-1]
        now = self.temperature
        self.peak = np.fmax(self.peak, now)
        self.past.append((self.t, now))
        while len(self.past) > 2 and self.past[0][0] < self.t - RATE_S:
            self.past.pop(0)

    @property
    def temperature(self) -> Array:
        return np.array([thermometer.value for thermometer in self.thermometers])

    @property
    def rate(self) -> Array:
        """(joints,) K/min over the last minutes."""
        then, was = self.past[0] if self.past else (self.t, self.temperature)
        minutes = (self.t - then) / 60
        return (self.temperature - was) / minutes if minutes >= 0.5 else np.full(len(self.joints), np.nan)

    def newest(self, signal: str) -> Array:
        if self.last is None:
            return np.full(len(self.joints), np.nan)
        return self.last[[self.columns[f"{signal}.{joint}"] for joint in self.joints]]


#: s over which the rate of warming is taken: whole °C need minutes
RATE_S = 180.0


def soak(
    config: EngineConfig,
    plan: SoakPlan,
    out: Path,
    *,
    robot_toml: str | None = None,
    resume: bool = False,
) -> Subroutine[HeatSoaked]:
    """Do it. Closed at any yield (Ctrl-C, a stop key) it leaves torque off and a recording that can be resumed.

    Args:
        config: the robot, best by `soak_config`.
        out: the recording to make, or to go on with.
        robot_toml: the robot's configuration as text, kept inside the recording.

    Raises:
        BadInput: the plan cannot be; knees that were to be stalled move.
        HardwareFault: the robot does not answer, or is too hot to begin.
        MotionStopped: the disk is full, the port is gone, or nobody knows which joint it was; torque is off, and the
            recording kept as far as it got.
    """
    joints = tuple(servo.joint for servo in config.servos)
    before = _so_far(out) if resume else _SoFar()
    played = _commands(plan, joints, config)
    if plan.load == "stall":  # pressed against what holds it
        config = replace(config, guards=replace(config.guards, behind_rad=None))
    with EngineProcess(config) as engine:
        stepped = bool(engine.description["stepped"])
        limit = engine.ask(messages.ReadRegister("temperature_limit"))
        limits = np.array([float(limit[joint]) for joint in joints])
        log = _Log.of(engine, joints)
        yield from _look_around(engine, log, limits, plan, before, resume)
        if before.phase == "load" and before.loaded_s < plan.seconds:
            engine.ask(messages.Torque(True))
            found = np.asarray(engine.description["position"], float)
            start = played[0] if played is not None else _first_pose(plan, joints, found)
            if start is not None:
                engine.ask(messages.Ramp(_within(start, config)))
            if plan.load == "stall":
                yield from _press(engine, config, plan, log, limits)
        facts = Facts(
            joints=joints,
            setup=plan.setup,
            protocol="soak",
            ambient_c=plan.ambient_c,
            notes=plan.notes,
            extra={"soak": asdict(plan), "rate_hz": config.rate_hz, "temperature_limit_c": limit},
        )
        path, _ = str(out), engine.telemetry()
        engine.ask(messages.Record(path, facts, robot_toml, resume=resume))
        end = _End(before.loaded_s)
        try:
            if before.phase == "load" and end.loaded_s < plan.seconds:
                end = yield from _under_load(engine, config, plan, log, limits, end.loaded_s, played, stepped)
            if plan.setup == "floor" and plan.load != "stall" and not end.released:
                _lie_down(engine, config)
            engine.ask(messages.Torque(False))
            yield from _cooling(engine, plan, log, limits, end.loaded_s, before.cooled_s, end.words, stepped)
        except BaseException:
            if not engine.ended:
                with contextlib.suppress(HardwareFault):  # what ended it says more
                    engine.stop()  # which the recording tells from a load that has ended
                    engine.ask(messages.StopRecording())
            raise
        made, cycles = engine.ask(messages.StopRecording())
    peaks = {name: float(value) for name, value in zip(joints, log.peak, strict=True)}
    peaks = {name: float(np.nanmax([value, before.peak_c.get(name, np.nan)])) for name, value in peaks.items()}
    glitches = {name: thermometer.glitches for name, thermometer in zip(joints, log.thermometers, strict=True)}
    return HeatSoaked(Path(made), cycles, end.why, end.joint, end.words, end.loaded_s, peaks, glitches)


@dataclass(frozen=True)
class _End:
    """How the load ended: as `HeatSoaked` has it, and whether torque went off with it."""

    loaded_s: float
    why: Why = "time"
    joint: str | None = None
    words: str = "the time is over"
    released: bool = False


def _look_around(
    engine: EngineProcess, log: _Log, limits: Array, plan: SoakPlan, before: _SoFar, resume: bool
) -> Subroutine[None]:
    """Read temperatures before anything moves; a soak that begins hot says nothing and risks a servo."""
    engine.ask(messages.LetPass(1.0))
    log.take(engine.telemetry())
    temperature = log.temperature
    hot = [k for k in range(len(log.joints)) if temperature[k] >= limits[k] - BEGIN_K]
    if hot and before.phase == "load":
        k = max(hot, key=lambda k: temperature[k] - limits[k])
        raise HardwareFault(
            f"{log.joints[k]} is at {number(temperature[k], '°C', decimals=0)}, {number(limits[k], '°C', decimals=0)} is its limit: a soak does not begin there",
            where=engine.config.port,
            remedy=f"let it cool below {number(limits[k] - BEGIN_K, '°C', decimals=0)}"
            + (" and --resume again" if resume else ""),
        )
    for words in engine.notices():
        yield Say(words)


def _under_load(
    engine: EngineProcess,
    config: EngineConfig,
    plan: SoakPlan,
    log: _Log,
    limits: Array,
    loaded: float,
    played: Array | None,
    stepped: bool,
) -> Subroutine[_End]:
    """Until the time is over, a servo is too warm, or something stops it."""
    look = STEPPED_LOOK_S if stepped else LOOK_S
    total = plan.seconds + plan.cool_down_s
    pose, row = -1, 0
    playing: int | None = None
    begun, at = log.t, loaded
    while True:
        try:
            if plan.load in ("stand", "hang"):
                wanted = min(int(loaded / plan.seconds * len(plan.poses)), len(plan.poses) - 1)
                if wanted != pose:
                    pose = wanted
                    engine.ask(messages.Ramp(_within(pose_angles(plan.poses[pose], log.joints), config)))
            if played is None:
                engine.ask(messages.Hold(min(look, max(1.0 / config.rate_hz, plan.seconds - loaded))))
            elif stepped:
                # Its time runs on while nobody looks: a piece at a time, few since each begins with a ramp.
                rows = max(2, round(min(STEPPED_PIECE_S, plan.seconds - loaded) * config.rate_hz))
                engine.ask(messages.Play(played[row : row + rows], "play"))
                row = row + rows if row + rows < len(played) - 1 else 0
            else:
                if playing is None or engine.done(playing):
                    playing = engine.start(messages.Play(played, "play"))
                time.sleep(look)
        except MotionStopped as stopped:
            log.take(engine.telemetry())
            return _why_stopped(engine, log, limits, at + log.t - begun, stopped)
        log.take(engine.telemetry())
        loaded = at + log.t - begun
        yield from _seen(log, limits, loaded, loaded / total, _doing(plan, pose), engine.notices())
        near = limits - log.temperature
        k = int(np.nanargmin(near)) if np.isfinite(near).any() else 0
        if plan.margin_k >= 0 and near[k] <= plan.margin_k:
            words = f"{log.joints[k]} is at {number(log.temperature[k], '°C', decimals=0)}, {number(near[k], 'K', decimals=0)} below its limit"
            return _End(loaded, "margin", log.joints[k], words)
        if loaded >= plan.seconds - 1.5 / config.rate_hz:
            return _End(loaded)


def _why_stopped(engine: EngineProcess, log: _Log, limits: Array, loaded: float, fault: MotionStopped) -> _End:
    """A servo's own shutdown is what the test was for, its limit what the margin is for; anything else is neither."""
    joint = next((e.joint for e in engine.events() if isinstance(e, messages.Stopped) and e.joint), None)
    if engine.ended or joint is None:
        raise fault
    k = log.joints.index(joint)
    if fault.cause is StopCause.HARDWARE_ERROR and "overheating" in fault.what:
        words = f"{joint} shut itself down at {number(log.temperature[k], '°C', decimals=0)}, its limit is {number(limits[k], '°C', decimals=0)}"
        return _End(loaded, "shutdown", joint, words, released=True)
    why: Why = "margin" if fault.cause is StopCause.HEAT else "guard"
    return _End(loaded, why, joint, fault.what, released=True)


def _press(engine: EngineProcess, config: EngineConfig, plan: SoakPlan, log: _Log, limits: Array) -> Subroutine[None]:
    """Let the knees press down with the wanted duty; the position loop makes it of the error that it sees.

    Raises:
        BadInput: the legs move instead of being stalled, or cannot press so hard.
    """
    joints = log.joints
    servos = {servo.joint: servo for servo in config.servos}
    registers = engine.description["registers"]
    knees = [k for k, joint in enumerate(joints) if JOINTS[joint].kind == "knee"]
    error = np.zeros(len(joints))
    for k in knees:
        joint = joints[k]
        allowed = registers[joint]["pwm_limit"] / PWM_FULL
        # What the register holds is a whole count.
        if plan.effort > allowed + 0.01:
            raise BadInput(
                f"{joint} may use {percent(allowed)} of full duty, not {percent(plan.effort)}",
                where=config.port,
                remedy="give --effort less, or raise bus.pwm_limit in robot.toml",
            )
        gain = registers[joint]["position_p_gain"] / servos[joint].model.position_p_divisor
        pulses = plan.effort * PWM_FULL / max(gain, 1e-9)
        # Where all that the limit allows is wanted, a bit more error keeps it there whatever the leg gives way.
        pulses *= 1.3 if plan.effort > 0.95 * allowed else 1.0
        error[k] = pulses * 2 * math.pi / PULSES_PER_TURN
    here = np.asarray(engine.ask(messages.Hold(0.5)), float)
    for _ in range(PRESSES):
        was = here
        engine.ask(messages.Ramp(_within(was - error, config)))
        here = np.asarray(engine.ask(messages.Hold(0.5)), float)
        log.take(engine.telemetry())
        if float(np.abs(here - was).max()) < STILL_RAD:
            break
    engine.ask(messages.Hold(STALL_S))
    log.take(engine.telemetry())
    duty = np.abs(log.newest("pwm"))
    for k in knees:
        if duty[k] < STALLED * plan.effort:
            raise BadInput(
                f"{joints[k]} is not stalled: it presses with {percent(duty[k])} of full duty, not {percent(plan.effort)}",
                where=config.port,
                remedy="let the robot lie on its belly, feet on the floor, and put more weight on it: 8 kg for the "
                "standard robot, 5 kg for the Lite",
            )
    yield Say(f"the knees are stalled at {percent(plan.effort)} of full duty")


def _cooling(
    engine: EngineProcess,
    plan: SoakPlan,
    log: _Log,
    limits: Array,
    loaded: float,
    cooled: float,
    words: str,
    stepped: bool,
) -> Subroutine[None]:
    """Torque off; the recording goes on until its time is over, or enough was seen."""
    look = STEPPED_LOOK_S if stepped else LOOK_S
    total = plan.seconds + plan.cool_down_s
    begun, at = log.t, cooled
    yield Say(words)
    while cooled < plan.cool_down_s:
        engine.ask(messages.LetPass(min(look, plan.cool_down_s - cooled)))
        log.take(engine.telemetry())
        cooled = at + max(log.t - begun, 1e-6)
        share = min(1.0, (plan.seconds + cooled) / total)
        if (yield from _seen(log, limits, loaded + cooled, share, COOLING, engine.notices())):
            return


def _doing(plan: SoakPlan, pose: int) -> str:
    """What goes on under load."""
    if plan.load == "stall":
        return "pressing"
    if plan.load == "play":
        return "moving"
    name = plan.poses[pose]
    return f"holding the {name} pose" if name in POSES else f"holding {name}"


def _seen(
    log: _Log, limits: Array, seconds: float, share: float, doing: str, notices: Iterable[str]
) -> Subroutine[bool]:
    """Show how far it is and how warm the servos are, `seconds` after the load began; whether that was enough."""
    for words in notices:
        yield Say(words)
    yield Progress(share, doing)
    known = {joint: float(v) for joint, v in zip(log.joints, log.temperature, strict=True) if math.isfinite(v)}
    numbers = zip(log.rate, log.newest("cur"), log.newest("load"), log.newest("volt"), strict=True)
    marks = {joint: _marks(*map(float, row)) for joint, row in zip(log.joints, numbers, strict=True)}
    words = f"after {number(seconds / 60, 'min', decimals=1)}: temperature of each servo, up to where it switches off"
    top = dict(zip(log.joints, map(float, limits), strict=True))
    return (yield Live(known, "°C", words, dict.fromkeys(known, COLD_C), top, marks)) is True


def _marks(rate_k_min: float, current_a: float, load: float, volts: float) -> str:
    """What stands beside a temperature: how fast it rises, how hard the servo works, its supply."""
    said = (
        (rate_k_min, number(rate_k_min, "K/min", sign=True, decimals=1)),
        (current_a, f"{number(current_a, sign=True, decimals=2)} A"),
        (load, f"load {number(load, 'share', sign=True, decimals=0)}"),
        (volts, number(volts, "V", decimals=1)),
    )
    return ", ".join(words for value, words in said if math.isfinite(value))


def _lie_down(engine: EngineProcess, config: EngineConfig) -> None:
    """Standing, it would fall when it is let go: back to how it lay."""
    found = np.asarray(engine.description["position"], float)
    engine.ask(messages.Ramp(_within(found, config)))


def _within(angles: Array, config: EngineConfig) -> Array:
    limits = [config.limits_rad.get(servo.joint, (-np.inf, np.inf)) for servo in config.servos]
    return np.clip(angles, [low for low, _ in limits], [high for _, high in limits])


def _first_pose(plan: SoakPlan, joints: Sequence[str], found: Array) -> Array | None:
    """Where the load begins; stalled joints press from where they lie."""
    return None if plan.load == "stall" else pose_angles(plan.poses[0], joints)


def _commands(plan: SoakPlan, joints: Sequence[str], config: EngineConfig) -> Array | None:
    """(n, joints) rad at the engine's rate, of the recording that is to be played; None for held poses."""
    if plan.load != "play":
        for pose in plan.poses:
            pose_angles(pose, joints)
        return None
    if plan.commands is None:
        raise BadInput("nothing to play", remedy="name a recording with --play RUN")
    run = read_run(plan.commands, need=("cmd",))
    missing = [joint for joint in joints if f"cmd.{joint}" not in run.columns]
    if missing:
        raise BadInput(f"it has no commands for {', '.join(missing)}", where=plan.commands)
    return _resampled(run, joints, config)


def _resampled(run: Run, joints: Sequence[str], config: EngineConfig) -> Array:
    command = run.signal("cmd", joints)
    good = np.isfinite(command).all(axis=1)
    times, command = run.command_times[good], command[good]
    if len(times) < 2:
        raise BadInput("it has no commands to play", where=run.path)
    grid = np.arange(times[0], times[-1], 1.0 / config.rate_hz)
    # A command holds until the next.
    rows = np.clip(np.searchsorted(times, grid, side="right") - 1, 0, len(times) - 1)
    return np.asarray(_within(command[rows], config))


@dataclass(frozen=True)
class _SoFar:
    """How far a soak got before it was cut short."""

    phase: Phase = "load"
    loaded_s: float = 0.0
    cooled_s: float = 0.0
    peak_c: Mapping[str, float] = field(default_factory=dict)


#: s between two rows beyond which the time between them was a pause
PAUSE_S = 10.0


def _so_far(path: Path) -> _SoFar:
    recording = read_recording(path)
    run = recording.run
    step = np.diff(run.t, append=run.t[-1])
    step[step > PAUSE_S] = 0.0
    on = run.signal("torque", default=1.0).max(axis=1) > 0
    loaded, cooled = float(step[on].sum()), float(step[~on].sum())
    plan = resume_plan(path)
    # A servo's shutdown, its margin or a guard of its ends the load for good. A crash leaves rows under torque at the end,
    # and what no joint caused (the stop key, Ctrl-C, a lost port) is told after the last of them.
    last = float(run.t[on][-1]) if on.any() else -math.inf
    cut = any(
        event["kind"] == "stopped" and event.get("joint") is None and event["t"] >= last for event in recording.events
    )
    phase: Phase = "load" if not len(on) or on[-1] or cut or loaded == 0.0 else "cool-down"
    if loaded >= plan.seconds - 1.0:
        phase = "cool-down"
    peak = {joint: float(np.nanmax(clean(run.t, run.column(f"temp.{joint}")).values)) for joint in run.joints}
    return _SoFar(phase, loaded, cooled if phase == "cool-down" else 0.0, peak)
