"""Zeros and directions: what every encoder shows with straight legs, and which servo moves when one joint is moved.

Hands tell more than motors here. With torque off the builder moves one named joint one named way: the servo that turns is
that joint's, whatever its id says, and the sign of its turn is the joint's direction. A gentle nudge by the motor then
proves the other way round that what is commanded is what moves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from openant_tools.calib.wires import SETTLE_S, engine_config, in_joints, opened_bus, robot_servos, servo_angles, wait
from openant_tools.comms import messages
from openant_tools.comms.bus import Bus
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.servos import Servos
from openant_tools.errors import HardwareFault
from openant_tools.numbers import number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Bench, Drawing, Hands, Intent, Live, Procedure, Progress, Say, Subroutine
from openant_tools.procedure.unfinished import Parts
from openant_tools.robot.config import Provenance, RobotConfig
from openant_tools.robot.joints import JOINT_NAMES, JOINTS
from openant_tools.robot.kit import ANGLE_LIMIT_RAD, NOMINAL_ZERO_RAD
from openant_tools.robot.registers import RAD_PER_PULSE

__all__ = ["Moved", "Straight", "TorsoAnswer", "straight", "torso_answer", "zeros"]

COMMAND = "openant calib zeros"
Array = NDArray[np.float64]

#: Horns go on in eighths of a turn.
GRID_RAD = math.pi / 4
READINGS = 25
#: Legs that are put straight by a ruler are within this; more is a horn between two splines, or a leg not straight.
STRAIGHT_RAD = math.radians(8)
#: By how much the builder moves a joint, and how much of it must be seen.
BY_HAND_RAD, SEEN_RAD = math.radians(30), 0.15
#: s that a joint's way back is waited for, and between two looks at it
BACK_S, SAMPLE_S = 20.0, 0.1
#: by what a joint that is held still differs at most between two looks
STILL_RAD = 0.01
NUDGE_RAD, NUDGED_RAD = 0.12, 0.07
#: A torso that answers a nudge stands out of its gyro's noise by so many standard errors, along the joint's axis within
#: this cosine.
SEEN_ERRORS, SEEN_COSINE = 6.0, 0.7
WAYS = {"hip": "counter-clockwise seen from above", "knee": "up (lift its foot)"}
DRAWING = """\
            front
     fl \\          / fr        every leg straight out from the torso,
          \\ ____ /             level, hip and knee in one line:
           |    |              lay a ruler along each leg
          / ---- \\
     rl /          \\ rr
"""


@dataclass(frozen=True)
class Straight:
    """One joint with its leg straight.

    Attributes:
        angle_rad: of the servo, in its own frame, within one turn.
        eighths: how many splines (45°) it sits from the nominal mounting.
        residual_rad: what is left beside the grid.
    """

    angle_rad: float
    eighths: int
    residual_rad: float


def straight(angle_rad: float) -> Straight:
    """Where on the grid of horn positions a servo's angle (rad) with its leg straight lies."""
    angle = angle_rad % (2 * math.pi)
    away = angle - NOMINAL_ZERO_RAD
    eighths = round(away / GRID_RAD)
    return Straight(angle, eighths, away - eighths * GRID_RAD)


@dataclass(frozen=True)
class TorsoAnswer:
    """How the torso turned while one joint was nudged: against the leg, as far as its stand lets it.

    Attributes:
        share: the torso's rate over the joint's, along the joint's axis; negative is against it, as it must be.
        cosine: between the torso's axis and the joint's. errors: of the share, how many it is away from zero.
    """

    share: float
    cosine: float
    errors: float

    @property
    def verdict(self) -> Literal["confirmed", "contradicted", "another", "unseen"]:
        if not self.errors > SEEN_ERRORS:
            return "unseen"
        if abs(self.cosine) < SEEN_COSINE:
            return "another"
        return "confirmed" if self.cosine < 0 else "contradicted"

    @property
    def words(self) -> str:
        """The verdict as it is read."""
        other = {"unseen": "not visible", "another": "another leg", "contradicted": "the leg went the other way"}
        return other.get(self.verdict, self.verdict)


def torso_answer(joint: str, gyro: Array, rate: Array) -> TorsoAnswer:
    """What the gyro (n, 3), rad/s in the body's frame, says of a nudge in which `joint` turned at `rate` (n,), rad/s.

    The torso's rate is regressed on the joint's: momentum that the leg takes up, the torso gives.
    """
    known = np.isfinite(gyro).all(axis=1) & np.isfinite(rate)
    gyro, rate = gyro[known] - gyro[known].mean(axis=0), rate[known] - rate[known].mean()
    power = float(rate @ rate)
    if len(rate) < 10 or power == 0.0:
        return TorsoAnswer(math.nan, math.nan, math.nan)
    turn = gyro.T @ rate / power
    axis = np.asarray(JOINTS[joint].axis, float) / np.linalg.norm(JOINTS[joint].axis)
    size = float(np.linalg.norm(turn))
    noise = float((gyro - np.outer(rate, turn)).std()) / math.sqrt(power)
    return TorsoAnswer(
        float(turn @ axis), float(turn @ axis) / size if size else 0.0, size / noise if noise else math.inf
    )


@dataclass(frozen=True)
class Moved:
    """What was seen while one joint was moved by hand: the joint of the servo that turned, and how far, rad."""

    asked: str
    seen: str
    by_rad: float


def zeros(bench: Bench) -> Procedure:
    """Measure zeros and directions, name what is built wrong, write robot.toml, and nudge every joint to prove it."""
    config = bench.folder.config()
    joints = bench.joints or JOINT_NAMES
    problems = list[str]()
    with opened_bus(bench) as bus:
        servos = Servos(bus, robot_servos(config))
        servos.identify()
        servos.set_torque(False)
        yield Drawing("How straight legs look:", DRAWING)
        yield Hands("Put every leg straight out and hold still; torque is off.", "straighten")
        wait(bus.clock, SETTLE_S)
        yield Progress(0.1, f"{READINGS} readings of every encoder")
        rows = servo_angles(servos, READINGS)
        if float(np.ptp(rows, axis=0).max()) > math.radians(2):
            moved = servos.servos[int(np.ptp(rows, axis=0).argmax())].joint
            return _failed(f"{moved} moved while it was read", "hold the legs still and run it again")
        level = rows.mean(axis=0)
        yield Hands("Let go.", "free", while_watching=True)
        movements = yield from _by_hand(bench, bus, servos, joints)
    grid = {servo.joint: straight(float(level[k])) for k, servo in enumerate(servos.servos)}
    evidence = [
        Evidence(
            f"off the grid of {joint}",
            seen.residual_rad,
            "rad",
            "encoder with straight legs; horns go on in steps of 45°",
            least=-STRAIGHT_RAD,
            most=STRAIGHT_RAD,
        )
        for joint, seen in grid.items()
    ]
    unseen = [joint for joint in joints if joint not in movements]
    problems += [
        f"{joint}: no servo turned when it was moved → look at its horn screw and its cable" for joint in unseen
    ]
    owner = {joint: movement.seen for joint, movement in movements.items() if movement.seen != joint}
    if unseen or len({movement.seen for movement in movements.values()}) < len(movements):
        return _failed(
            "it cannot be told which servo is which joint",
            "move only the joint that is named, well and one way",
            problems=(*problems, *(f"{a}: the servo of {b} turned" for a, b in owner.items())),
            evidence=evidence,
        )
    values: dict[str, object] = {}
    if owner:
        problems += yield from _swapped(owner, config, values)
    ids = {joint: owner.get(joint, joint) for joint in joints}
    for joint in joints:
        seen, movement = grid[ids[joint]], movements[joint]
        direction = 1 if movement.by_rad > 0 else -1
        path = f"motors.{joint}"
        values[f"{path}.zero_offset_rad"] = round(seen.angle_rad, 5)
        if direction != config.motors[joint].direction:
            values[f"{path}.direction"] = direction
            problems.append(
                f"{joint}: reversed, its servo turns backwards (a mirrored leg or mount) → direction = {direction} in "
                "robot.toml; build it as the guide says if the robot's own software is to drive it"
            )
        problems += _spline(joint, seen, direction)
    far = [joint for joint in joints if abs(grid[ids[joint]].residual_rad) > STRAIGHT_RAD]
    for joint in far:
        degrees = math.degrees(grid[ids[joint]].residual_rad)
        problems.append(
            f"{joint}: {number(degrees, sign=True, decimals=1)}° beside the grid of horn positions → was the leg straight? else its horn or gear slips"
        )
    yield Intent(
        f"write zero offsets{', ids as they are built' if owner else ''} and directions into robot.toml, then nudge every joint by "
        f"{number(NUDGE_RAD, 'rad', decimals=0)} with the motors, on the stand",
        moves=True,
    )
    bench.folder.update(values, provenance=Provenance.measured(COMMAND))
    nudged = yield from _nudge_all(bench, joints)
    problems += nudged.problems
    evidence += nudged.evidence
    ok = not far and nudged.ok
    widest = max((abs(grid[ids[joint]].residual_rad) for joint in joints), default=0.0)
    return Finding(
        "zeros",
        ok,
        f"zeros of {len(joints)} joints, at most {number(widest, 'rad', decimals=1)} beside the 45° grid; every joint moves as commanded"
        if ok
        else "not every zero and direction is sure",
        tuple(evidence),
        "" if ok else "mend what is listed and run it again",
        COMMAND,
        data={
            "zero_rad": {joint: grid[ids[joint]].angle_rad for joint in joints},
            "eighths": {joint: grid[ids[joint]].eighths for joint in joints},
            "direction": {joint: 1 if movements[joint].by_rad > 0 else -1 for joint in joints},
            "swapped": owner,
        },
        problems=tuple(problems),
        stands=True,
    )


def _by_hand(bench: Bench, bus: Bus, servos: Servos, joints: tuple[str, ...]) -> Subroutine[dict[str, Moved]]:
    """joint → what turned when the builder moved it; a joint at which nothing turned is missing.

    One answer a joint: that it is held. That it is back is seen.
    """
    found: dict[str, Moved] = {}
    parts = Parts(bench, "zeros", joints, bench.joints)
    if parts.before:
        yield Say(parts.words)
    first = before = servo_angles(servos)[0]
    for k, joint in enumerate(joints):
        if joint in parts.before:
            found[joint] = Moved(joint, parts.before[joint]["seen"], parts.before[joint]["by_rad"])
            continue
        kind = JOINTS[joint].kind
        yield Progress(0.2 + 0.6 * k / len(joints), f"{joint} by hand")
        # Half a turn up or round is beyond no stop; from straight it is safe either way.
        yield Hands(
            f"Move the {JOINTS[joint].words} about {number(BY_HAND_RAD, 'rad', decimals=0)} {WAYS[kind]}, and hold it there.",
            "turn", joint, (BY_HAND_RAD,),
        )  # fmt: skip
        wait(bus.clock, SETTLE_S)
        row = servo_angles(servos)[0]
        yield _away(servos, row, first, f"moved: {joint}")
        # The joint before it may have been put back meanwhile, or not yet: neither is what moved now.
        change = np.where(
            np.abs(_turned(row, first)) < np.abs(_turned(row, before)), _turned(row, first), _turned(row, before)
        )
        most = int(np.abs(change).argmax())
        if abs(change[most]) > SEEN_RAD:
            found[joint] = Moved(joint, servos.servos[most].joint, float(change[most]))
            words = f"{joint}: its servo turned {number(change[most], 'rad', sign=True, decimals=0)}"
            if found[joint].seen != joint:
                words = f"{joint} was moved, but the servo with the id of {found[joint].seen} turned"
            yield Say(words, "ok" if found[joint].seen == joint else "warn")
            parts.done(joint, seen=found[joint].seen, by_rad=found[joint].by_rad)
        yield Hands("Put it back.", "turn", joint, (0.0,), while_watching=True)
        before = yield from _back(bus, servos, first, most)
        yield Hands("Let go.", "free", while_watching=True)
    return found


def _back(bus: Bus, servos: Servos, first: Array, moved: int) -> Subroutine[Array]:
    """Wait until the servo that was `moved` is where it was at `first` (n,), rad, or for `BACK_S`; where all are then."""
    give_up, before = bus.clock.now() + BACK_S, first + math.pi
    while True:
        row: Array = servo_angles(servos)[0]
        still = abs(_turned(row, before)[moved]) < STILL_RAD
        before = row
        enough = yield _away(servos, row, first, "being put back; Enter goes on")
        if enough is True or (still and abs(_turned(row, first)[moved]) < SEEN_RAD) or bus.clock.now() > give_up:
            return row
        wait(bus.clock, SAMPLE_S)


def _away(servos: Servos, row: Array, first: Array, words: str) -> Live:
    """How far each joint is from where it was at first."""
    turned = {servo.joint: float(change) for servo, change in zip(servos.servos, _turned(row, first), strict=True)}
    return Live(turned, "rad", words, angles_rad=in_joints(servos, row))


def _turned(row: Array, since: Array) -> Array:
    """By what each servo has turned, rad, the short way round."""
    turned: Array = (row - since + math.pi) % (2 * math.pi) - math.pi
    return turned


def _swapped(owner: Mapping[str, str], config: RobotConfig, values: dict[str, object]) -> Subroutine[list[str]]:
    """Name servos that sit in each other's place, and let robot.toml follow how the robot is built."""
    words = list[str]()
    for joint, other in owner.items():
        mine, its = config.motors[joint], config.motors[other]
        pair = (
            f"{joint} and {other} are swapped"
            if owner.get(other) == joint
            else f"the servo of {joint} has the id of {other}"
        )
        if mine.model != its.model:
            raise HardwareFault(
                f"{pair}, and they are of different models ({mine.model}, {its.model})",
                remedy="exchange the two motors: a hip's is too weak for a knee",
            )
        if owner.get(other) != joint or joint < other:
            words.append(
                f"{pair} → their ids are exchanged in robot.toml; `openant calib ids` can exchange them in the servos"
            )
    for line in words:
        yield Say(line, "warn")
    for joint, other in owner.items():
        values[f"motors.{joint}.id"] = config.motors[other].id
    return words


def _spline(joint: str, seen: Straight, direction: int) -> list[str]:
    """What a horn on another spline than the guide's means for this joint."""
    if seen.eighths == 0:
        return []
    limit = ANGLE_LIMIT_RAD[JOINTS[joint].kind]
    ends = [seen.angle_rad + direction * end for end in (-limit, limit)]
    seam = min(ends) < 0 or max(ends) > 2 * math.pi
    return [
        f"{joint}: its horn is on the wrong spline, {abs(seen.eighths)} × 45° {'beyond' if seen.eighths > 0 else 'before'} where "
        "it belongs → its zero follows in robot.toml"
        + (", and it runs in extended position mode since its range passes the encoder's 0°/360° point" if seam else "")
        + "; the guide's mounting is better"
    ]


@dataclass(frozen=True)
class _Nudged:
    ok: bool
    problems: tuple[str, ...]
    evidence: tuple[Evidence, ...]


def _nudge_all(bench: Bench, joints: tuple[str, ...]) -> Subroutine[_Nudged]:
    """Move each joint a little by its motor, and see that it goes there, comes back, and no other does."""
    problems, evidence = list[str](), list[Evidence]()
    with EngineProcess(engine_config(bench)) as engine:
        names = [servo.joint for servo in engine.config.servos]
        start = np.asarray(engine.description["position"], float)
        for words in engine.notices():
            yield Say(words)
        engine.ask(messages.Torque(True))
        limits = np.array([engine.config.limits_rad[name] for name in names])
        start = np.clip(start, limits[:, 0], limits[:, 1])
        view, answers = engine.second_view(), dict[str, TorsoAnswer]()
        for k, joint in enumerate(joints):
            yield Progress(0.8 + 0.2 * k / len(joints), f"nudging {joint}")
            at = names.index(joint)
            there = start.copy()
            there[at] += NUDGE_RAD if start[at] + NUDGE_RAD < limits[at, 1] else -NUDGE_RAD
            before, begun = _measured(engine, names), view.count
            engine.ask(messages.Ramp(there))
            engine.ask(messages.Hold(0.3))
            reached = _measured(engine, names)
            engine.ask(messages.Ramp(start))
            engine.ask(messages.Hold(0.2))
            rows = dict(zip(engine.columns, view.since(begun)[0].T, strict=True))
            answers[joint] = torso_answer(
                joint, np.column_stack([rows[f"gyro.{axis}"] for axis in "xyz"]), rows[f"vel.{joint}"]
            )
            went = reached - before
            sign = math.copysign(1.0, there[at] - start[at])
            others = [name for n, name in enumerate(names) if n != at and abs(went[n]) > NUDGED_RAD]
            if sign * went[at] < NUDGED_RAD:
                why = "turned the wrong way" if sign * went[at] < -NUDGED_RAD else "did not follow"
                problems.append(
                    f"{joint}: {why} ({number(went[at], 'rad', sign=True, decimals=1)}) → is it blocked, or its horn screw loose?"
                )
            if others:
                problems.append(f"{joint}: {', '.join(others)} moved with it → look for two servos with one id")
            evidence.append(Evidence(f"nudge of {joint}", float(went[at]), "rad", "encoder, motor commanded"))
        engine.ask(messages.Torque(False))
        view.close()
    # Before the IMU's own step nobody knows how its board sits in the torso, and with it which way it turned.
    board_known = bench.folder.config().imu.acc_counts_per_g > 0
    for joint, answer in answers.items():
        if math.isfinite(answer.share):
            evidence.append(
                Evidence(
                    f"torso's recoil at {joint}", -answer.share, "share", f"of the nudge, by the gyro: {answer.words}"
                )
            )
        if board_known and answer.verdict in ("contradicted", "another"):
            otherwise = "the leg went the other way" if answer.verdict == "contradicted" else "another leg moved"
            problems.append(
                f"{joint}: the gyro says that {otherwise} → look which leg moves, and which way; then `openant calib imu`"
            )
    yield Say(*_seen_words(answers, board_known))
    return _Nudged(not problems, tuple(problems), tuple(evidence))


def _seen_words(answers: Mapping[str, TorsoAnswer], board_known: bool) -> tuple[str, Literal["ok", "info"]]:
    """What the gyro had to say of the nudges, and how well that is."""
    alone = "hands and encoders alone have told which leg moves and which way"
    if not any(math.isfinite(answer.share) for answer in answers.values()):
        return f"no IMU was there to see the nudges: {alone}", "info"
    if not board_known and any(answer.verdict != "unseen" for answer in answers.values()):
        return (
            "the gyro sees the nudges; once the IMU step is done, this step again lets it confirm leg and way",
            "info",
        )
    seen = [joint for joint, answer in answers.items() if answer.verdict == "confirmed"]
    if not seen:
        return f"the stand holds the torso so still that its gyro does not see the nudges: {alone}", "info"
    unseen = [joint for joint, answer in answers.items() if answer.verdict == "unseen"]
    more = f"; not seen: {', '.join(unseen)}" if unseen else ""
    return f"the gyro confirms leg and way of {', '.join(seen)}{more}", "ok"


def _measured(engine: EngineProcess, names: list[str]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """(n,) rad: where the joints are, in the servos' own frames made joint angles without turns."""
    counts = engine.ask(messages.ReadRegister("present_position"))
    servos = {servo.joint: servo for servo in engine.config.servos}
    angles = np.array([servos[name].to_joint(counts[name] * RAD_PER_PULSE) for name in names])
    wrapped: np.ndarray[tuple[int], np.dtype[np.float64]] = (angles + math.pi) % (2 * math.pi) - math.pi
    return wrapped


def _failed(what: str, remedy: str, problems: tuple[str, ...] = (), evidence: list[Evidence] | None = None) -> Finding:
    return Finding("zeros", False, what, tuple(evidence or ()), remedy, COMMAND, problems=problems or (what,))
