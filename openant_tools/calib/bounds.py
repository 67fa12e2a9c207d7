"""Observation bounds: ranges by hand, a slow sweep, and the smallest and largest of every observation in many motions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.calib.lost_answers import loose, lost_in
from openant_tools.calib.motions import LIBRARY, motion
from openant_tools.calib.sweep import JointSweep, analyse, play_watched, sweep
from openant_tools.calib.wires import (
    SETTLE_S,
    engine_config,
    in_joints,
    opened_bus,
    rest,
    robot_servos,
    servo_angles,
    wait,
)
from openant_tools.comms import messages
from openant_tools.comms.bus import Bus
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.lateness import REMEDY, losses
from openant_tools.comms.servos import Servos
from openant_tools.errors import HardwareFault
from openant_tools.numbers import number, span
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Drawing, Hands, Intent, Live, Procedure, Progress, Say, Subroutine
from openant_tools.procedure.unfinished import Parts
from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import read_run
from openant_tools.robot.config import Provenance
from openant_tools.robot.joints import JOINT_NAMES, JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD

__all__ = ["Range", "Unwrapped", "bounds", "measured_bounds"]

COMMAND = "openant calib bounds"

#: A stop that hands reach comes within this of the kit's; a joint that turns less is blocked.
SHORT_RAD = 0.15
#: Beyond this a joint turns further than any Ant's: a loose horn.
FAR_RAD = 0.6
#: s without a new extreme, with both ends seen, end the capture; and the longest that it waits for hands.
QUIET_S, LONGEST_S = 1.2, 60.0
SAMPLE_S = 0.05
#: Commands keep this far from what hands could reach.
KEEP_OFF_RAD = 0.03
#: the parts that are recorded, and where; the one after them
SWEEP, STAND, FLOOR, BACK = "slow sweep", "motions on the stand", "motions on the floor", "back on its stand"
#: of the step's progress: ranges by hand up to there, then from where to where each recording is
BY_HAND = 0.5
SHARES = {SWEEP: (0.5, 0.6), STAND: (0.6, 0.85), FLOOR: (0.85, 1.0)}
RECORDED = {SWEEP: "sweep", STAND: "bounds-stand", FLOOR: "bounds-floor"}
QUANTILES = (0.001, 0.01, 0.99, 0.999)
SIGNALS = ("pos", "vel")
BODY = ("gyro.x", "gyro.y", "gyro.z", "acc.x", "acc.y", "acc.z")


@dataclass
class Unwrapped:
    """An encoder followed over its seam: differences are taken the short way round, as no hand turns half a turn between
    two readings."""

    last: float | None = None
    angle: float = 0.0
    seam: bool = False

    def add(self, angle_rad: float) -> float:
        """The unwrapped angle, rad, for one more reading."""
        if self.last is None:
            self.angle = angle_rad
        else:
            step = angle_rad - self.last
            short = (step + math.pi) % (2 * math.pi) - math.pi
            self.seam |= abs(step - short) > 1e-6
            self.angle += short
        self.last = angle_rad
        return self.angle


@dataclass
class Range:
    """What hands reach with one joint, rad, and the stops as they came again: their spread is the hysteresis."""

    low: float = math.inf
    high: float = -math.inf
    lows: list[float] = field(default_factory=list)
    highs: list[float] = field(default_factory=list)
    seam: bool = False

    def add(self, angle: float) -> bool:
        """Take one reading; whether it is a new extreme."""
        new = angle < self.low - 0.005 or angle > self.high + 0.005
        self.low, self.high = min(self.low, angle), max(self.high, angle)
        return new


def bounds(bench: Bench) -> Procedure:
    """Ranges, sweep, library; writes limits and `[observation]` into robot.toml."""
    config = bench.folder.config()
    problems, evidence = list[str](), list[Evidence]()
    with opened_bus(bench) as bus:
        servos = Servos(bus, robot_servos(config))
        servos.identify()
        servos.set_torque(False)
        joints = bench.joints or JOINT_NAMES
        parts = Parts(bench, "bounds", (*joints, *RECORDED, BACK), bench.joints)
        if parts.before:
            yield Say(parts.words)
        ranges = yield from _by_hand(bus, servos, joints, parts)
    limits = dict[str, tuple[float, float]]()
    for joint, motor in config.motors.items():
        kit_limit = ANGLE_LIMIT_RAD[JOINTS[joint].kind]
        seen = ranges.get(joint)
        if seen is None:
            limits[joint] = (motor.min_rad, motor.max_rad)
            continue
        evidence += [
            Evidence(
                f"{joint} low end",
                seen.low,
                "rad",
                "by hand, torque off",
                least=-kit_limit - FAR_RAD,
                most=SHORT_RAD - kit_limit,
            ),
            Evidence(
                f"{joint} high end",
                seen.high,
                "rad",
                "by hand, torque off",
                least=kit_limit - SHORT_RAD,
                most=kit_limit + FAR_RAD,
            ),
        ]
        problems += _range_words(joint, seen, kit_limit)
        limits[joint] = (-_limit(-seen.low, kit_limit), _limit(seen.high, kit_limit))
    blocked = [joint for joint, (low, high) in limits.items() if low > -0.2 or high < 0.2]
    if blocked:
        return Finding(
            "bounds", False, f"{', '.join(blocked)} can hardly be moved", tuple(evidence), "free the joint and run it again", COMMAND,
            problems=(*problems, *(f"{joint} can hardly be moved → free it" for joint in blocked)),
        )  # fmt: skip
    for kind in ("hip", "knee"):
        ends = (f"{joint} {span(*limits[joint], 'rad', decimals=0)}" for joint in limits if JOINTS[joint].kind == kind)
        yield Say(f"limits of {kind}s: {', '.join(ends)}")
    facts = {"limits_rad": {joint: list(ends) for joint, ends in limits.items()}}
    swept, stood, walked = (_recorded(bench, parts, part, facts) for part in (SWEEP, STAND, FLOOR))
    intents = ["write these limits into robot.toml"]
    if swept is None:
        intents.append("sweep every joint slowly through its range")
    if stood is None:
        intents.append(f"play {len(LIBRARY)} motions on the stand")
    yield Intent("; then ".join(intents), moves=len(intents) > 1)
    values: dict[str, object] = {}
    for joint, (low, high) in limits.items():
        values |= {f"motors.{joint}.min_rad": low, f"motors.{joint}.max_rad": high}
    bench.folder.update(values, provenance=Provenance.measured(COMMAND))
    if swept is None:
        path = bench.folder.new_recording(RECORDED[SWEEP])
        swept = yield from sweep(engine_config(bench, imu=None), path, "slow sweep", SHARES[SWEEP])
        _note(bench, parts, SWEEP, facts, swept)
    sweeps = analyse(swept, limits)
    most = {kind: _most_friction(sweeps, kind) for kind in ("hip", "knee")}
    for one in sweeps.values():
        source = "slow sweep, from duty and back-EMF"
        evidence.append(
            Evidence(f"friction of {one.joint}", one.friction_nm, "N·m", source, most=most[JOINTS[one.joint].kind])
        )
    problems += _friction_words(sweeps)
    problems += loose(lost_in(swept), config.bus.chain)
    missed = losses(swept)
    if missed.words:
        yield Say(f"{missed.words} → {REMEDY}", "warn")

    if stood is None:
        stood = yield from _library(bench, STAND)
        _note(bench, parts, STAND, facts, stood)
    runs = [stood]
    question = "Also on the floor? It needs a metre of room around the robot."
    if walked is not None:
        runs.append(walked)
    elif (yield Ask(question, ("yes", "no"), default="yes")) == "yes":
        yield Hands("Put the robot on the floor, on its belly, legs straight out.", "place", setup="floor")
        rest(bench)
        yield Intent("play two of the motions on the floor; the robot stands up, walks about and lies down", moves=True)
        runs.append((yield from _library(bench, FLOOR)))
        _note(bench, parts, FLOOR, facts, runs[-1])
    if len(runs) > 1:
        yield Hands("Put it back on its stand.", "place", setup="stand")
        rest(bench)
    parts.end()
    # The sweep is the one motion that takes every joint to its ends: neighbouring legs would meet there in the others.
    found, quantiles = measured_bounds([*runs, swept])
    recording = ", ".join(bench.folder.relative(run.path) for run in [*runs, swept] if run.path)
    bench.folder.update(
        {f"observation.{name}": [round(low, 5), round(high, 5)] for name, (low, high) in found.items()},
        provenance={"observation": Provenance.measured(COMMAND, recording)},
    )
    picture = coverage_picture(runs, bench.folder.findings / "bounds-coverage.png")
    yield Drawing("What the motions covered:", picture=picture)
    ok = not problems
    return Finding(
        "bounds",
        ok,
        f"ranges of {len(ranges)} joints, bounds of {len(found)} observations from {sum(len(run.t) for run in runs)} steps",
        tuple(evidence),
        "" if ok else "look at the joints that are named and run it again; until then these bounds are in use",
        COMMAND,
        data={
            "limits_rad": limits,
            "ranges_rad": {joint: [seen.low, seen.high] for joint, seen in ranges.items()},
            "hysteresis_rad": {joint: _spread(seen) for joint, seen in ranges.items()},
            "seam": [joint for joint, seen in ranges.items() if seen.seam],
            "sweep": {joint: one.as_dict() for joint, one in sweeps.items()},
            "quantiles": {name: dict(zip(map(str, QUANTILES), q, strict=True)) for name, q in quantiles.items()},
            "picture": bench.folder.relative(picture),
            "recordings": recording,
        },
        problems=tuple(problems),
        stands=True,
    )


def _limit(reached_rad: float, kit_rad: float) -> float:
    """The limit of commands on one side: the kit's where hands got there, else short of where they got."""
    return kit_rad if reached_rad > kit_rad - KEEP_OFF_RAD else round(max(0.0, reached_rad - KEEP_OFF_RAD), 5)


def _note(bench: Bench, parts: Parts, part: str, facts: Mapping[str, Any], run: Run) -> None:
    """Note a part with its facts and its recording."""
    parts.done(part, **facts, recording=bench.folder.relative(run.path or ""))


def _recorded(bench: Bench, parts: Parts, part: str, facts: Mapping[str, Any]) -> Run | None:
    """What was recorded before the step was left, where these are its facts; None where it is to be recorded."""
    note = parts.before.get(part, {})
    path = bench.folder.path / str(note.get("recording", ""))
    return read_run(path) if facts.items() <= note.items() and path.is_file() else None


def _by_hand(bus: Bus, servos: Servos, joints: Sequence[str], parts: Parts) -> Subroutine[dict[str, Range]]:
    """joint → its range by hand. Each is led to both stops, twice; the capture ends by itself when nothing new comes."""
    found: dict[str, Range] = {}
    names = list(servos.joints)
    for k, joint in enumerate(joints):
        # A range is told from the joint's zero: where that is another now, it is no longer known.
        zero = [servos[joint].zero_rad, servos[joint].direction]
        if joint in parts.before:
            if parts.before[joint].get("zero") == zero:
                found[joint] = Range(**parts.before[joint]["range"])
                continue
            yield Say(f"{joint} has another zero than when it was moved; it is done again", "warn")
        yield Progress(BY_HAND * k / len(joints), f"{joint}: range by hand")
        servo, at = servos[joint], names.index(joint)
        far = ANGLE_LIMIT_RAD[JOINTS[joint].kind] + 0.1
        yield Hands(
            f"Move the {JOINTS[joint].words} from stop to stop, twice, gently.", "turn", joint,
            (far, -far, far, -far, 0.0), while_watching=True,
        )  # fmt: skip
        seen, track = Range(), Unwrapped()
        start = bus.clock.now()
        newest, towards = start, 0
        extreme = 0.0
        while bus.clock.now() - start < LONGEST_S:
            wait(bus.clock, SAMPLE_S)
            row = servo_angles(servos)[0]
            angle = servo.to_joint(track.add(float(row[at])))
            angle = angle if abs(angle) < math.pi else (angle + math.pi) % (2 * math.pi) - math.pi
            if seen.add(angle):
                newest = bus.clock.now()
            way = 1 if angle > extreme + 0.02 else -1 if angle < extreme - 0.02 else 0
            if way:
                if towards and way != towards:
                    (seen.highs if towards > 0 else seen.lows).append(extreme)
                towards = way
            if way == towards and way:
                extreme = angle
            both = seen.high > 0.1 and seen.low < -0.1
            mark = "both ends seen" if both else "now to the other end"
            limit = ANGLE_LIMIT_RAD[JOINTS[joint].kind]
            enough = yield Live(
                {joint: angle}, "rad", "range by hand; Enter where it goes no further", {joint: -limit}, {joint: limit},
                {joint: mark}, in_joints(servos, row),
            )  # fmt: skip
            if enough is True or (both and bus.clock.now() - newest > QUIET_S and bus.clock.now() - start > 4.0):
                break
        seen.seam = track.seam
        yield Hands("Let go.", "free", while_watching=True)
        if seen.high - seen.low < 0.05:
            raise HardwareFault(
                f"{joint} was not moved within {number(LONGEST_S, 's', decimals=0)}",
                remedy="move the joint that is named",
            )
        found[joint] = seen
        parts.done(joint, zero=zero, range=asdict(seen))
    wait(bus.clock, SETTLE_S / 2)
    return found


def _spread(seen: Range) -> float:
    """rad between repeats of the same stop."""
    ends = [e for e in seen.highs if e > seen.high - 0.15], [e for e in seen.lows if e < seen.low + 0.15]
    return max((max(end) - min(end) for end in ends if len(end) > 1), default=0.0)


def _range_words(joint: str, seen: Range, limit: float) -> list[str]:
    words = []
    for end, kit_end, name in (
        (seen.low, -limit, "down" if "knee" in joint else "clockwise"),
        (seen.high, limit, "up" if "knee" in joint else "counter-clockwise"),
    ):
        short = abs(kit_end) - abs(end)
        if short > SHORT_RAD:
            words.append(
                f"{joint}: stops {number(short, 'rad', decimals=0)} early going {name} → a cable in the way, a screw, or a wrong spline"
            )
        elif -short > FAR_RAD:
            words.append(
                f"{joint}: turns {number(-short, 'rad', decimals=0)} beyond its stop going {name} → the horn is loose"
            )
    return words


def _of_kind(sweeps: Mapping[str, JointSweep], kind: str) -> dict[str, float]:
    """joint → its friction, N·m, of all that are hips, or knees."""
    return {j: s.friction_nm for j, s in sweeps.items() if JOINTS[j].kind == kind and s.friction_nm is not None}


def _most_friction(sweeps: Mapping[str, JointSweep], kind: str) -> float | None:
    """N·m: a joint with more is odd among those of its kind."""
    mine = _of_kind(sweeps, kind)
    return 2 * float(np.median(list(mine.values()))) + 0.03 if mine else None


def _friction_words(sweeps: Mapping[str, JointSweep]) -> list[str]:
    """What is odd already on a new robot: a joint far from the others of its kind."""
    words = []
    for kind in ("hip", "knee"):
        mine, most = _of_kind(sweeps, kind), _most_friction(sweeps, kind)
        middle = float(np.median(list(mine.values()))) if mine else 0.0
        words += [
            f"{joint}: friction {number(friction, 'N·m', decimals=2)}, the other {kind}s have {number(middle, decimals=2)} → screws too tight, or thread-locker in the gear"
            for joint, friction in mine.items()
            if most is not None and friction > most
        ]
    return words


def _library(bench: Bench, part: str) -> Subroutine[Run]:
    """Play the motions and record them in one file; the recording."""
    floor = part == FLOOR
    path, setup = bench.folder.new_recording(RECORDED[part]), "floor" if floor else "stand"
    config = engine_config(bench)
    joints = tuple(servo.joint for servo in config.servos)
    with EngineProcess(config) as engine:
        lying = np.asarray(engine.description["position"], float)
        engine.ask(messages.Torque(True))
        names = ("wander", "trot") if floor else tuple(LIBRARY)
        start, end = SHARES[part]
        engine.ask(messages.Ramp(motion(names[0], joints, config.limits_rad, config.rate_hz, 0, floor=floor)[0]))
        engine.ask(messages.Record(str(path), Facts(joints=joints, setup=setup, protocol="bounds")))
        for seed, name in enumerate(names):
            played = motion(name, joints, config.limits_rad, config.rate_hz, seed, floor=floor)
            begun, done = (start + (end - start) * k / len(names) for k in (seed, seed + 1))
            yield Progress(begun, f"{name}: {LIBRARY[name]}")
            yield from play_watched(
                engine, messages.Play(played, name), len(played) / config.rate_hz, name, (begun, done)
            )
        engine.ask(messages.StopRecording())
        if floor:
            low, high = np.array([config.limits_rad[joint] for joint in joints]).T
            engine.ask(messages.Ramp(np.clip(lying, low, high)))
        engine.ask(messages.Torque(False))
    return read_run(path)


def measured_bounds(runs: Sequence[Run]) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[float, ...]]]:
    """name of a run table's column → (smallest, largest) and → `QUANTILES` over every step of the runs."""
    found: dict[str, tuple[float, float]] = {}
    quantiles: dict[str, tuple[float, ...]] = {}
    names = [f"{signal}.{joint}" for signal in SIGNALS for joint in runs[0].joints] + list(BODY)
    for name in names:
        values = np.concatenate([run.column(name) for run in runs])
        values = values[np.isfinite(values)]
        if len(values) and float(np.ptp(values)) > 0:
            found[name] = (float(values.min()), float(values.max()))
            quantiles[name] = tuple(float(q) for q in np.quantile(values, QUANTILES))
    return found, quantiles


def coverage_picture(runs: Sequence[Run], path: Path) -> Path:
    """Where each leg has been: hip against knee angle, stand and floor; the file."""
    from matplotlib.figure import Figure

    colours = {"stand": "#0072B2", "floor": "#D55E00"}  # Okabe–Ito
    figure = Figure(figsize=(8, 6.4), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    for place, leg in zip(axes.flat, ("fl", "fr", "rl", "rr"), strict=True):
        for run in runs:
            hip, knee = run.column(f"pos.hip_{leg}"), run.column(f"pos.knee_{leg}")
            setup = run.facts.setup or ""
            place.plot(np.degrees(hip), np.degrees(knee), ".", ms=1.5, color=colours.get(setup, "#000000"), label=setup)
        place.set_title(f"{JOINTS[f'hip_{leg}'].leg.words} leg", fontsize=10)
        place.grid(alpha=0.3)
    for row in axes[:, 0]:
        row.set_ylabel("knee (°)")
    for column in axes[-1, :]:
        column.set_xlabel("hip (°)")
    axes[0, 0].legend(markerscale=6, loc="upper right")
    figure.suptitle("Poses covered by the motions for the observation bounds")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path
