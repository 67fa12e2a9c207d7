"""IMU: scales, bias, noise and mounting of the flight controller, from poses that hands can hold and turns that they make.

Gravity seen from the board in three poses whose gravity in the body is known gives the rotation between the two frames
(Wahba's problem, solved by SVD: Markley, J. Astronaut. Sci. 1988). How well the angles between the measured directions
agree with those between the known ones says whether the poses were held: rotations leave angles alone.

Gravity tells the accelerometer's scale, a turn the gyro's (`gyro_scale`). A turn that says something else than what is in
use is made again, twice as far: what the hand was off by counts half as much then, and a sensor's step as much as before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.calib.gyro_scale import GyroScale, by_hand, old_rates
from openant_tools.calib.wires import SETTLE_S, opened_imu, wait
from openant_tools.comms import msp
from openant_tools.comms.clock import Clock
from openant_tools.comms.imu import STANDARD_GRAVITY, Imu
from openant_tools.errors import HardwareFault
from openant_tools.numbers import exact, number
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Drawing, Hands, Intent, Live, Procedure, Progress, Say, Subroutine
from openant_tools.procedure.unfinished import Parts
from openant_tools.robot.config import Provenance

__all__ = ["POSES", "Mounting", "Pose", "imu", "mounting"]

COMMAND = "openant calib imu"
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """One pose: how hands bring it about, and where it points.

    Attributes:
        turn_rad: rotation vector from level, in the world, which is the body's axes while it is level.
        up: specific force in the body's axes there, as a unit vector.
    """

    words: str
    turn_rad: tuple[float, float, float]
    up: tuple[float, float, float]


#: Level, nose down, left side down: none is opposite another, so that two of them would do and three check each other.
POSES: tuple[Pose, ...] = (
    Pose("level on its stand", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    Pose("nose straight down", (0.0, math.pi / 2, 0.0), (-1.0, 0.0, 0.0)),
    Pose("left side straight down", (-math.pi / 2, 0.0, 0.0), (0.0, -1.0, 0.0)),
)
DRAWING = """\
   level              nose down           left side down
    ____                 ||
 --|____|--> front    ---||---              |   left leg down
                         \\/                 |___ torso on its side
"""
REST_S = 1.0
#: At rest hands and stands shake by no more: m/s², rad/s (one standard deviation).
STILL_M_S2, STILL_RAD_S = 0.35, 0.08
#: Poses held by hand are a few degrees off; beyond this the answer is not to be trusted.
AGREE_RAD, LOW_RAD = math.radians(6), math.radians(15)
#: a board that is turned by less sits straight
STRAIGHT_RAD = math.radians(1)
#: Share by which |acc| may miss gravity by the scale that its sensor should have; a wrong one is a factor of two.
GRAVITY_SHARE = 0.06
#: rad; the short turn, and the long one (a little less than half, so that its way round is plain); s for a quarter
QUARTER_RAD, HALF_RAD, QUARTER_S = math.pi / 2, math.pi - 1e-3, 3.0
TRIES = 3


@dataclass(frozen=True)
class Mounting:
    """How the board sits in the body.

    Attributes:
        rotation: (3, 3), body from board.
        vector_rad: the same as a rotation vector.
        disagreement_rad: largest difference of an angle between two poses as measured and as it should be.
    """

    rotation: Array
    vector_rad: tuple[float, float, float]
    disagreement_rad: float

    @property
    def confidence(self) -> str:
        return "high" if self.disagreement_rad < AGREE_RAD else "low" if self.disagreement_rad < LOW_RAD else "none"


def mounting(measured: Array, known: Array) -> Mounting:
    """The rotation that takes directions (n, 3) seen by the board to those (n, 3) known in the body."""
    seen = measured / np.linalg.norm(measured, axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(known.T @ seen)
    rotation = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ vt))]) @ vt
    apart = np.abs(np.arccos(np.clip(seen @ seen.T, -1, 1)) - np.arccos(np.clip(known @ known.T, -1, 1)))
    return Mounting(rotation, _vector(rotation), float(apart.max()))


def _vector(rotation: Array) -> tuple[float, float, float]:
    """Rotation vector (rad) of a rotation matrix, by its quaternion's largest part, sound at half turns too."""
    trace = float(np.trace(rotation))
    w = math.sqrt(max(0.0, 1 + trace)) / 2
    xyz = np.sqrt(np.maximum(0.0, 1 + 2 * np.diag(rotation) - trace)) / 2
    if w > 1e-3:
        skew = np.array(
            [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
        )
        xyz = skew / (4 * w)
    else:
        main = int(np.argmax(xyz))
        signs = np.sign(rotation[main] + rotation[:, main])
        signs[main] = 1.0
        xyz = xyz * np.where(signs == 0, 1.0, signs)
    length = float(np.linalg.norm(xyz))
    if length < 1e-12:
        return (0.0, 0.0, 0.0)
    x, y, z = (2 * math.atan2(length, w) / length * xyz).tolist()
    return (float(x), float(y), float(z))


@dataclass(frozen=True)
class _Rest:
    """Readings at rest: mean and standard deviation of acc (m/s²) and gyro (rad/s), (3,) each."""

    acc: Array
    gyro: Array
    acc_noise: Array
    gyro_noise: Array

    @property
    def still(self) -> bool:
        return bool(self.acc_noise.max() < STILL_M_S2 and self.gyro_noise.max() < STILL_RAD_S)


def imu(bench: Bench) -> Procedure:
    """Poses, then a quarter turn; writes `[imu]` where the answer is sure.

    Raises:
        HardwareFault: no flight controller is known, or it stops answering.
    """
    problems = list[str]()
    with opened_imu(bench) as (driver, clock):
        info = driver.info
        for note in info.notes:
            yield Say(note, "warn")
            if "gravity decides" in note.lower() or "Gravity says" in note:
                problems.append(f"IMU scale: {note} → {number(info.acc_lsb_per_g, 'LSB/g', decimals=0)} is used")
        parts = Parts(bench, "imu", (*(pose.words for pose in POSES), "turns"))
        # What another board read, or with other scales, says nothing of this one.
        board = [info.uid, info.acc_lsb_per_g, info.gyro_lsb_per_dps]
        before = {words: facts["rest"] for words, facts in parts.before.items() if facts["board"] == board}
        if before:
            yield Say(parts.words)
        elif parts.before:
            yield Say("it is another flight controller than when it was left: every pose is held again", "warn")
        if len(before) < len(POSES):
            yield Drawing("Three poses, each held still for a second.", DRAWING)
        for attempt in range(TRIES):
            rests = list[_Rest]()
            for k, pose in enumerate(POSES):
                if pose.words in before:
                    rests.append(_Rest(**{name: np.array(value) for name, value in before[pose.words].items()}))
                    continue
                yield Progress(0.25 * k, pose.words)
                rests.append((yield from _pose(driver, clock, pose)))
                parts.done(pose.words, board=board, rest={name: x.tolist() for name, x in vars(rests[-1]).items()})
            before = {}
            found = mounting(np.array([rest.acc for rest in rests]), np.array([pose.up for pose in POSES]))
            if found.confidence == "high" or attempt == TRIES - 1:
                break
            words = f"low confidence: the poses disagree by {number(found.disagreement_rad, 'rad', decimals=0)}"
            if (yield Ask(f"{words}. Once more?", ("yes", "no"), default="yes")) != "yes":
                break
        yield Hands("Put it back on its stand, level.", "tilt", path_rad=(0.0, 0.0, 0.0))
        wait(clock, SETTLE_S)
        # A gyro's bias wanders with its heat: what the turns are told by is read right before them.
        level = yield from _still(driver, clock)
        imu_now = bench.folder.config().imu
        measured = bench.folder.config().provenance_of("imu.gyro_counts_per_dps") is not None
        turns, gyro = yield from _turns(driver, clock, found.rotation, level, measured)
    turned = turns[0]
    if found.confidence != "high" or gyro is not None or turned < 0:
        parts.end()  # else the poses stand, and only the turns are to be made again
    norms = np.array([np.linalg.norm(rest.acc) for rest in rests])
    acc_counts = float(norms.mean() / STANDARD_GRAVITY * info.acc_lsb_per_g)
    nominal = min((*msp.ACC_LSB_PER_G_NEW, msp.ACC_LSB_PER_G_OLD), key=lambda lsb: abs(math.log(acc_counts / lsb)))
    scale_error = acc_counts / nominal - 1
    axis, angle = _axis_words(found.vector_rad)
    straight = angle <= STRAIGHT_RAD
    about = "" if straight else f"rotation about {axis}, from "
    gyro_bias = found.rotation @ level.gyro
    evidence = (
        Evidence(
            "norm of acc over gravity", 1 + scale_error, "1", f"{len(POSES)} poses at rest, {nominal} LSB/g",
            least=1 - GRAVITY_SHARE, most=1 + GRAVITY_SHARE,
        ),
        Evidence("gyro bias", float(np.linalg.norm(gyro_bias)), "rad/s", "at rest, level"),
        Evidence("gyro noise", float(level.gyro_noise.max()), "rad/s", "standard deviation at rest"),
        Evidence("acc noise", float(level.acc_noise.max()), "m/s²", "standard deviation at rest"),
        Evidence("acc counts for 1 g", acc_counts, "1", f"{len(POSES)} poses at rest"),
        Evidence("mounting", angle, "rad", f"{about}gravity in {len(POSES)} poses"),
        Evidence("poses disagree by", found.disagreement_rad, "rad", "angles between measured directions"),
        Evidence(
            "quarter turn", turned, "rad",
            f"integral of the gyro about the body's vertical, {number(info.gyro_lsb_per_dps)} counts for 1 °/s",
        ),
        *([] if gyro is None else [
            Evidence(
                "gyro counts for 1 °/s", gyro.counts_per_dps, "1",
                f"turns by hand: {len(turns)}{f'; {gyro.step} a step' if gyro.step else ''}", gyro.low, gyro.high,
            )
        ]),
    )  # fmt: skip
    unsure = list[str]()
    if abs(scale_error) > GRAVITY_SHARE:
        problems.append(
            f"IMU scale: |acc| at rest is {number(norms.mean(), 'm/s²', decimals=2)} instead of {number(STANDARD_GRAVITY, decimals=2)} → calibrate the accelerometer "
            "in Betaflight (level, still), then run this step again"
        )
    read = ", ".join(f"{number(turn, 'rad', decimals=0)}" for turn in turns)
    if turned < 0:
        problems.append(
            f"gyro: a quarter turn to the left reads {number(turned, 'rad', decimals=0)} → its sign is wrong: the mounting was taken in "
            "wrong poses, or it was turned to the right"
        )
    elif gyro is None:
        unsure.append(
            f"gyro scale: turns of 90° and 180° read {read}, which fits neither gyro type (±2000 °/s in steps of 61 or 70 mdps) → turn it "
            "again along a table's edge, from side to side, or let `openant calib arena` measure it against the tag"
        )
    elif abs(gyro.counts_per_dps / info.gyro_lsb_per_dps - 1) > 1e-3:
        words = f"the gyro has {gyro.words}, not {number(info.gyro_lsb_per_dps, decimals=2)}: a quarter turn read {number(turned, 'rad', decimals=0)}"
        yield Say(words, "warn")
        problems.append(
            f"{words} → imu.gyro_counts_per_dps takes it into account from now on; {old_rates(info.gyro_lsb_per_dps, gyro)}"
        )
    if found.confidence != "high":
        problems.append(
            f"low confidence in the mounting: the poses disagree by {number(found.disagreement_rad, 'rad', decimals=0)} → retry, hold them still "
            "against a wall or a table's edge"
        )
    if angle > math.radians(8):
        yield Say(
            f"the board is mounted rotated by {number(angle, 'rad', decimals=0)} about {axis}; that is taken into account",
            "warn",
        )
        problems.append(
            f"the board is mounted rotated by {number(angle, 'rad', decimals=0)} about {axis} → robot.toml takes it into account"
        )
    sound = found.confidence == "high" and abs(scale_error) <= GRAVITY_SHARE and turned > 0
    counts = imu_now.gyro_counts_per_dps if gyro is None else gyro.counts_per_dps
    if sound:
        yield Intent("write scales, mounting and gyro bias into [imu] of robot.toml")
        # The bias was read with the scale that was in use, and is to be subtracted with the one from now on.
        gyro_bias = gyro_bias * (info.gyro_lsb_per_dps / counts)
        values: dict[str, object] = {
            "imu.mounting_rad": [round(x, 5) for x in found.vector_rad],
            "imu.gyro_bias_rad_s": [round(float(x), 6) for x in gyro_bias],
            "imu.acc_counts_per_g": round(acc_counts, 1),
        }
        provenance = dict.fromkeys(values, Provenance.measured(COMMAND))
        if gyro is not None:
            values["imu.gyro_counts_per_dps"] = round(counts, 4)
            provenance["imu.gyro_counts_per_dps"] = Provenance.measured(
                COMMAND, low=round(gyro.low, 4), high=round(gyro.high, 4)
            )
        bench.folder.update(values, provenance=provenance)
    return Finding(
        "imu",
        False if not sound else None if unsure else True,
        "the board is mounted "
        + ("straight" if straight else f"at {number(angle, 'rad', decimals=0)} about {axis}")
        + f"; {info.variant} {info.firmware} sends {number(info.rate_hz, 'samples/s', decimals=0)}",
        evidence,
        "run it again; nothing was written" if not sound else "turn it again: run this step again" if unsure else "",
        COMMAND,
        data={
            "mounting_rad": list(found.vector_rad),
            "confidence": found.confidence,
            "acc_lsb_per_g": acc_counts,
            "gyro_counts_per_dps": counts,
            "turns_rad": turns,
            "rate_hz": info.rate_hz,
            "uid": info.uid,
            "notes": list(info.notes),
        },
        problems=tuple(problems),
        unsure=tuple(unsure),
        stands=sound,
    )


def _pose(driver: Imu, clock: Clock, pose: Pose) -> Subroutine[_Rest]:
    """Hold a pose and read at rest."""
    yield Hands(f"Hold the robot {pose.words} and keep still.", "tilt", path_rad=pose.turn_rad)
    wait(clock, SETTLE_S)
    rest = yield from _still(driver, clock)
    x, y, z = rest.acc.tolist()
    yield Live({"x": x, "y": y, "z": z}, "m/s²", pose.words)
    return rest


def _still(driver: Imu, clock: Clock) -> Subroutine[_Rest]:
    """Readings at rest; those of the last try where it moves at every one."""
    for _ in range(TRIES):
        samples = _samples(driver, clock, REST_S)
        acc, gyro = samples[:, 1:4], samples[:, 4:7]
        rest = _Rest(acc.mean(axis=0), gyro.mean(axis=0), acc.std(axis=0), gyro.std(axis=0))
        if rest.still:
            break
        yield Say("it moves; keep still", "warn")
    return rest


def _samples(driver: Imu, clock: Clock, seconds: float) -> Array:
    """(n, 7): t, acc, gyro, in the board's own axes."""
    begin, rows = clock.now(), list[tuple[float, ...]]()
    while clock.now() < begin + seconds:
        sample = driver.read(clock.now() + 0.5)
        if sample.t < begin:
            continue  # it lay unread since the last pose
        rows.append((sample.t, *sample.acc, *sample.gyro))
    if len(rows) < 10:
        raise HardwareFault(f"only {len(rows)} IMU samples came in {exact(seconds)} s", where=driver.where)
    return np.array(rows)


def _turns(
    driver: Imu, clock: Clock, rotation: Array, level: _Rest, measured: bool
) -> Subroutine[tuple[list[float], GyroScale | None]]:
    """What the gyro read of the turns, rad, and the scale that they say together; None where they say none."""
    now = driver.info.gyro_lsb_per_dps
    yield Progress(0.85, "yaw check")
    for attempt in range(TRIES):
        turns = [(yield from _turn(driver, clock, rotation, level, QUARTER_RAD))]
        if turns[0] < 0:
            return turns, None
        gyro = by_hand(turns, now, measured=measured)
        if gyro is not None and abs(gyro.counts_per_dps / now - 1) < 1e-3:
            return turns, gyro
        # A sensor of another step, or a hand that stopped early: of twice the turn it is told.
        yield Say(
            f"the quarter turn reads {number(turns[0], 'rad', decimals=0)}: " + ("a turn that was not 90°?" if gyro is None
            else f"a sensor of {gyro.step} a step, or a turn that was not 90°?"), "warn",
        )  # fmt: skip
        turns.append((yield from _turn(driver, clock, rotation, level, HALF_RAD)))
        gyro = by_hand(turns, now, measured=measured)
        if gyro is not None or attempt == TRIES - 1:
            break
        yield Say(
            f"the half turn reads {number(turns[1], 'rad', decimals=0)}: that does not fit together; once more", "warn"
        )
    return turns, gyro


def _turn(driver: Imu, clock: Clock, rotation: Array, level: _Rest, turn_rad: float) -> Subroutine[float]:
    """Integral of the body's yaw rate, less its bias, over a turn to the left, rad."""
    much, seconds = ("half a turn", 2 * QUARTER_S) if turn_rad > 2 else ("a quarter turn", QUARTER_S)
    yield Hands(
        f"Within {number(seconds, 'seconds', decimals=0)} turn the robot {much} to the left (counter-clockwise seen from above), level, from one "
        "straight edge to the next.",
        "tilt",
        path_rad=(0.0, 0.0, turn_rad),
        while_watching=True,
    )
    samples = _samples(driver, clock, seconds)
    rate = (samples[:, 4:7] - level.gyro) @ rotation.T
    turned = float(np.sum(np.diff(samples[:, 0]) * (rate[1:, 2] + rate[:-1, 2]) / 2))
    yield Hands("Turn it back.", "tilt", path_rad=(0.0, 0.0, 0.0))
    wait(clock, SETTLE_S)
    return turned


def _axis_words(vector: tuple[float, float, float]) -> tuple[str, float]:
    """The nearest of the body's axes in words, and the angle, rad."""
    angle = math.sqrt(sum(x * x for x in vector))
    if angle < 1e-6:
        return "any axis", 0.0
    main = int(np.argmax(np.abs(vector)))
    share = abs(vector[main]) / angle
    name = ("x (forward)", "y (left)", "z (up)")[main]
    return (("−" if vector[main] < 0 else "") + name if share > 0.98 else "a slanted axis"), angle
