"""Arena: lens, tags, where the circle is, and how late the picture is; the robot itself is the ruler.

Where the camera stands follows from the origin's tag alone, and how far the body's tag is from its own size. The robot
lies on its belly, so that its tag's height is known: the two distances agree only if the two sizes do. Then it stands up,
by a height that its legs give: how much nearer the tag seems to come tells which of the two sizes is the wrong one. At
last it turns to and fro, and the gyro tells how late the camera's heading is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.calib.gyro_scale import SAME_SHARE, by_camera, old_rates
from openant_tools.calib.sweep import play_watched
from openant_tools.calib.wires import clock_of, engine_config, rest
from openant_tools.comms import messages
from openant_tools.comms.body_camera import CameraConfig
from openant_tools.comms.camera import Camera, CameraInfo, CameraSettings
from openant_tools.comms.clock import Clock
from openant_tools.comms.doubts import other_reading
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.intrinsics import CharucoBoard, Intrinsics, calibrate
from openant_tools.comms.latency import camera_latency
from openant_tools.comms.setup import camera_of_robot
from openant_tools.comms.tags import TagDetector, tag_pose
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.files import write_bytes
from openant_tools.numbers import number
from openant_tools.optional import cv2
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.procedure.step import Ask, Bench, Drawing, Hands, Intent, Procedure, Progress, Say, Subroutine
from openant_tools.procedure.unfinished import Parts
from openant_tools.recording.reader import Recording, read_recording
from openant_tools.recording.run import Facts
from openant_tools.robot.config import CameraSection as CameraFacts
from openant_tools.robot.config import Provenance, RobotConfig
from openant_tools.robot.joints import JOINTS
from openant_tools.robot.kit import HOME_RAD

__all__ = ["arena", "judge_sizes"]

COMMAND = "openant calib arena"
Array = NDArray[np.float64]

PICTURES = 12
#: m, the torso's centre while the robot lies on its belly, and stands in its home pose (facts/robot.md, section 6).
LYING_M, STANDING_M = 0.076, 0.148
#: Sizes that agree do so within this share; the tags that people confuse are 0.03, 0.045, 0.06 and 0.10 m.
SIZE_SHARE = 0.08
#: A builder places a robot by eye within this.
BY_EYE_RAD = math.radians(8)
#: poses of the robot that a phase needs, or nothing is known of it
LEAST_POSES = 10
#: Turning to and fro: all hips together, feet on the floor.
WIGGLE_RAD, WIGGLE_HZ, WIGGLE_S, HOLD_S = 0.35, 0.8, 6.0, 1.5
#: s; stamps that are as good as this are left as they are
LATE_S = 0.008
#: The hips' share of the body's turn: feet that slide leave less, joints that turn the other way a negative one.
TURNED_SHARE = 0.3
#: Gyro scales differ by less than this; more is another axis.
GYRO_FACTOR = 1.5
#: Views of a ChArUco board, and the longest wait for the next one that differs, s.
VIEWS, VIEW_S = 10, 60.0
#: shares of the step when the lens is known, and when the motion is over
LOOKED, MOVED = 0.1, 0.9
#: Share of the picture's width by which a view must differ from all before it.
NEW_VIEW = 0.03
#: as `calibrate` calls its source
BOARD = "ChArUco board"
#: its parts
LENS, MOTION, CIRCLE, BACK = "the lens", "standing up and turning", "the circle", "back on its stand"
FOV_WORDS = "the declared field of view is good to a few mm near the picture's middle, 10 to 20 mm in height"


@dataclass(frozen=True)
class Sizes:
    """Whether the tags' sizes agree.

    Attributes:
        ratio: distance of the body's tag by its size over that by its known height; 1 where both sizes are right.
        step_ratio: height that it seems to rise over the height that the legs give; in the body tag's scale.
        wrong: "body" or "origin" where they do not agree; "" where they do.
        size_m: what the wrong one's edge really is.
    """

    ratio: float
    step_ratio: float
    wrong: str
    size_m: float | None


def judge_sizes(lying_m: float, standing_m: float, camera_m: float, tag_m: float, setup: CameraFacts) -> Sizes:
    """Compare measured heights of the torso with those that the robot's build gives.

    Args:
        lying_m, standing_m: the torso's height as the tags tell it. camera_m: the camera's, as the origin's tag tells it.
        tag_m: the body tag's height over the torso's centre. setup: the declared sizes.
    """
    ratio = (camera_m - lying_m - tag_m) / (camera_m - LYING_M - tag_m)
    step = (standing_m - lying_m) / (STANDING_M - LYING_M)
    if abs(ratio - 1) <= SIZE_SHARE or not math.isfinite(ratio + step):
        return Sizes(ratio, step, "", None)
    # Were the body's size wrong, the rise would be wrong by the same ratio; were the origin's, it would be right.
    if abs(step - ratio) < abs(step - 1):
        return Sizes(ratio, step, "body", setup.body_tag_size_m / ratio)
    # The body's distance is true then, and with it the camera's height: that distance above the known tag.
    true_camera_m = camera_m - lying_m + LYING_M
    return Sizes(ratio, step, "origin", setup.origin_tag_size_m * true_camera_m / camera_m)


@dataclass(frozen=True)
class _View:
    """What the picture told before the robot stood up.

    Attributes:
        camera_m: its height over the origin's tag. latency_s, latency_source: how late its stamps are, and who says so.
        problems: what is odd.
    """

    lens: Intrinsics
    body_id: int
    camera_m: float
    latency_s: float
    latency_source: str
    problems: tuple[str, ...]

    @classmethod
    def of_note(cls, note: Mapping[str, Any]) -> _View:
        facts = {name: note[name] for name in cls.__dataclass_fields__}
        return cls(**{**facts, "lens": _lens_of_note(note["lens"]), "problems": tuple(note["problems"])})


def _lens_of_note(note: Mapping[str, Any]) -> Intrinsics:
    return Intrinsics(**{**note, "distortion": tuple(note["distortion"])})


def arena(bench: Bench) -> Procedure:
    """Look, measure, judge, write `[camera]` and `[arena]`.

    Raises:
        HardwareFault: there is no camera, or the tags are not in its picture.
    """
    config = bench.folder.config()
    where: str | int = bench.camera if bench.camera is not None else config.ports.camera
    if where == "":
        named = yield Ask(
            "Which camera? Its number (0 is the first), an address, or empty for none", unit="text", default=""
        )
        where = named if isinstance(named, str) else ""
    if where == "":
        return Finding(
            "arena", True, "No camera: agents can be trained in simulation only", (),
            "name a camera with --camera and run it again before learning on the robot", COMMAND,
            problems=("no camera → floor experiments on the robot need one",),
        )  # fmt: skip
    # What is worth knowing, what is wrong, and what could not be judged.
    problems, wrong, unsure = list[str](), list[str](), list[str]()
    values = dict[str, object]()
    parts = Parts(bench, "arena", (LENS, MOTION, CIRCLE, BACK))
    then = parts.before.get(LENS, {}).get("where", where)
    if then != where:
        yield Say(f"it was another camera then ({then}): lens, look and motion are made again", "warn")
    elif parts.before:
        yield Say(parts.words)
    seen = parts.before.get(MOTION, {})
    path = bench.folder.path / str(seen.get("recording", ""))
    if seen.get("where") == where and path.is_file():
        view, record = _View.of_note(seen), read_recording(path)
    else:
        yield Progress(0.0, f"looking through {where}")
        view = yield from _view(bench, config, where, parts)
        setup = replace(config.camera, body_tag_id=view.body_id, latency_s=None)
        path = bench.folder.new_recording("arena")
        record = yield from _stand_and_wiggle(bench, config, setup, where, view.lens, path)
        for phase in record.run.facts.extra["phases"]:
            _between(record, phase)  # or it is no recording to go on from
        parts.done(MOTION, where=where, recording=bench.folder.relative(path), **asdict(view))
    lens, camera_m, origin_id = view.lens, view.camera_m, config.camera.origin_tag_id
    setup = replace(config.camera, body_tag_id=view.body_id)
    problems += view.problems
    lying, standing = _between(record, "lying"), _between(record, "standing")
    sizes = judge_sizes(_height(lying), _height(standing), camera_m, config.camera.body_tag_position_m[2], setup)
    if sizes.wrong:
        declared = setup.body_tag_size_m if sizes.wrong == "body" else setup.origin_tag_size_m
        wrong.append(
            f"tag size: the {sizes.wrong}'s tag is declared {number(1e3 * declared, 'mm', decimals=0)}, but everything fits only if its edge is about "
            f"{number(1e3 * (sizes.size_m or 0.0), 'mm', decimals=0)} → measure it, correct camera.{sizes.wrong}_tag_size_m in robot.toml, run it again"
        )
    yaw = _mean_angle(lying["yaw"])
    if abs(yaw) > BY_EYE_RAD:
        problems.append(
            f"the robot's tag is glued {number(yaw, 'rad', sign=True, decimals=0)} askew (or the robot was) → camera.body_tag_yaw_rad takes it into account"
        )
    if lens.source == BOARD:
        values |= {
            "camera.size_px": [lens.width, lens.height],
            "camera.focal_px": [round(lens.fx, 3), round(lens.fy, 3)],
            "camera.centre_px": [round(lens.cx, 3), round(lens.cy, 3)],
            "camera.distortion": [round(k, 6) for k in lens.distortion],
        }
        evidence_of_lens = [Evidence("reprojection error", lens.rms_px, "px", f"{VIEWS} views of a ChArUco board")]
    else:
        evidence_of_lens = []
    values["camera.body_tag_id"] = view.body_id
    values["camera.body_tag_yaw_rad"] = round(config.camera.body_tag_yaw_rad + yaw, 4)
    turning = _between(record, "wiggle")
    evidence = [
        *evidence_of_lens,
        Evidence("camera's height", camera_m, "m", "pose of the origin's tag"),
        Evidence(
            "distance by size over distance by height",
            sizes.ratio,
            "1",
            "lying robot",
            least=1 - SIZE_SHARE,
            most=1 + SIZE_SHARE,
        ),
        Evidence("rise seen over rise by legs", sizes.step_ratio, "1", "standing up"),
        Evidence("tag yaw", yaw, "rad", "robot placed along the origin's tag", least=-BY_EYE_RAD, most=BY_EYE_RAD),
    ]
    share = _turned(record, turning)
    evidence.append(
        Evidence("body's turn over the hips', opposite", share, "1", "camera, feet in place", least=TURNED_SHARE)
    )
    if not math.isfinite(share):
        unsure.append("which way the hips turn the body: joints or tag were not seen while it turned → run it again")
    elif share < TURNED_SHARE:
        turned = f"with its feet in place the body turned by {number(share, sign=True, decimals=2)} of what its hips turned the other way → "
        if share < -TURNED_SHARE:
            wrong.append(f"{turned}hips turn the wrong way: `openant calib zeros`")
        else:
            problems.append(f"{turned}do its feet slide? `openant calib zeros` if not")
    latency_s: float | None = None
    try:
        late = camera_latency(turning["t"], turning["yaw"], record.imu.t, record.imu.columns["gyro.z"])
    except (BadInput, KeyError) as error:
        unsure.append(f"latency: {error} → is the IMU step done? does the robot turn?")
    else:
        latency_s = view.latency_s + late.latency_s
        evidence += [
            Evidence("stamps are late by", late.latency_s, "s", f"gyro against tag heading; stamps: {view.latency_source}",
                     late.latency_s - 2 * late.latency_error_s, late.latency_s + 2 * late.latency_error_s),
            Evidence("camera angle over gyro angle", late.scale, "1", "the same motion",
                     late.scale - 2 * late.scale_error, late.scale + 2 * late.scale_error),
        ]  # fmt: skip
        if not 1 / GYRO_FACTOR < late.scale < GYRO_FACTOR:
            wrong.append(
                f"the gyro turned by {number(1 / late.scale, sign=True, decimals=2)} of what the camera saw → its board is mounted otherwise than robot.toml "
                "says: `openant calib imu`; or the picture is mirrored"
            )
        elif abs(late.scale - 1) > max(SAME_SHARE, 3 * late.scale_error):
            # The scale that was in use is the recording's own: robot.toml may have been changed meanwhile.
            now = float(record.run.facts.extra["imu"]["gyro_counts_per_dps"])
            gyro = by_camera(late.scale, late.scale_error, now)
            values["imu.gyro_counts_per_dps"] = round(gyro.counts_per_dps, 4)
            bias = [round(now / gyro.counts_per_dps * one, 6) for one in config.imu.gyro_bias_rad_s]
            values["imu.gyro_bias_rad_s"] = bias
            problems.append(
                f"the gyro has {gyro.words}, not {number(now, decimals=2)}: the tag turned by {number((late.scale - 1), 'share', sign=True, decimals=1)} more than it said "
                f"→ imu.gyro_counts_per_dps takes it into account from now on; {old_rates(now, gyro)}"
            )
        if abs(late.latency_s) > LATE_S and latency_s > 0:
            values["camera.latency_s"] = round(latency_s, 4)
    radius = parts.before.get(CIRCLE, {}).get("radius_m")
    if radius is None:
        radius = yield Ask(
            "Radius of the circle in which it may walk?", unit="m", default=config.arena.radius_m, low=0.1, high=5.0
        )
        parts.done(CIRCLE, radius_m=radius)
    centre = [round(float(np.median(lying[axis])), 4) for axis in ("x", "y")]
    values |= {"arena.centre_m": centre, "arena.radius_m": radius}
    yield Hands("Put it back on its stand.", "place", setup="stand")
    rest(bench)
    parts.end()
    recording = bench.folder.relative(path)
    bench.folder.update(values, provenance=Provenance.measured(COMMAND, recording))
    ok = False if wrong else None if unsure else True
    return Finding(
        "arena",
        ok,
        f"camera at {number(camera_m, 'm', decimals=2)}, tags {origin_id} and {view.body_id}"
        + ("" if latency_s is None else f", picture stamps {number(1e3 * abs(late.latency_s), 'ms', decimals=0)} off"),
        tuple(evidence),
        "" if ok else "mend what is listed and run it again" if wrong else "see to what is listed and run it again",
        COMMAND,
        data={
            "centre_m": centre,
            "radius_m": radius,
            "camera": str(where),
            "sizes": vars(sizes),
            "latency_s": latency_s,
            "recordings": recording,
        },
        problems=(*wrong, *problems),
        unsure=tuple(unsure),
        stands=True,
    )


def _view(bench: Bench, config: RobotConfig, where: str | int, parts: Parts) -> Subroutine[_View]:
    """Look until both tags are in the picture, and the robot lies where it is to stand up; what is seen, and that it may.

    Raises:
        HardwareFault: a tag is not in the picture, or the origin's lies askew.
    """
    info, lens, seen, problems = yield from _look(bench, config, where, parts)
    origin_id, body_id = config.camera.origin_tag_id, config.camera.body_tag_id
    if origin_id not in seen:
        raise HardwareFault(
            f"the origin's tag {origin_id} ({config.camera.tag_family}) is not in the picture (seen: {', '.join(map(str, sorted(seen))) or 'none'})",
            where=str(where), remedy="lay it flat into view; is the family right, the light even, the picture sharp?",
        )  # fmt: skip
    others = sorted(id for id in seen if id != origin_id)
    if body_id not in others:
        if not others:
            yield Hands("Put the robot on the floor, under the camera.", "place", setup="floor")
            rest(bench)
            info, _, seen, _ = yield from _look(bench, config, where, parts, lens)
            others = sorted(id for id in seen if id != origin_id)
        if not others:
            raise HardwareFault(
                "the robot's tag is not in the picture", where=str(where), remedy="put the robot under the camera"
            )
        answer = yield Ask("What is the number of the robot's tag?", default=float(others[0]))
        body_id = int(answer) if isinstance(answer, float) else others[0]
    origin = tag_pose(seen[origin_id], config.camera.origin_tag_size_m, lens)
    if not origin:
        raise HardwareFault("the corners of the origin's tag make no square", where=str(where), remedy="lay it flat")
    rotation, position = origin[0]
    camera_m = abs(float(rotation[:, 2] @ position))
    if float(np.linalg.norm(position)) > 1.5 * camera_m:
        problems.append("the camera looks at the floor from the side → hang it straight above, distances get better")
    yield Hands(
        "Put the robot on its belly at the circle's centre, legs straight out, its nose along the up-direction of the origin's tag.",
        "place",
        setup="floor",
    )
    rest(bench)
    yield Intent(
        "let the robot stand up, turn to and fro for 6 s with its feet in place, and lie down again", moves=True
    )
    yield Say(FOV_WORDS if lens.source not in ("robot.toml", BOARD) else "the lens is calibrated")
    return _View(lens, body_id, camera_m, info.latency_s, info.latency_source, tuple(problems))


def _look(
    bench: Bench, config: RobotConfig, where: str | int, parts: Parts, lens: Intrinsics | None = None
) -> Subroutine[tuple[CameraInfo, Intrinsics, dict[int, Array], list[str]]]:
    """What the camera gives, the lens unless it is known, each tag's corners (4, 2) over a few pictures, and what is odd."""
    clock = clock_of(bench)
    camera = Camera(CameraSettings(where, exposure=config.camera.exposure, focus=config.camera.focus), clock)
    try:
        info = camera.open()
        words = list[str]()
        if lens is None:
            lens, words = yield from _lens(camera, clock, bench, config, where, info, parts)
            parts.done(LENS, where=where, **asdict(lens))
        detector, corners = TagDetector(config.camera.tag_family), dict[int, list[Array]]()
        for _ in range(PICTURES):
            frame = camera.wait(clock.now() + 2.0)
            gray = np.asarray(frame.image if frame.image.ndim == 2 else frame.image.mean(axis=2), np.uint8)
            for tag in detector.detect(gray):
                if tag.hamming == 0 and tag.margin >= 5.0:
                    corners.setdefault(tag.id, []).append(tag.corners)
            gray_last = gray
    finally:
        camera.close()
    twice = [id for id, all_ in corners.items() if len(all_) > 1.5 * PICTURES]
    if twice:
        raise HardwareFault(
            f"tag {twice[0]} is in the picture twice",
            where=str(where),
            remedy="take the other sheet with this number away",
        )
    if not corners and (why := other_reading(gray_last, config.camera.tag_family, (config.camera.origin_tag_id,))):
        raise HardwareFault(f"no tag of {config.camera.tag_family} is in the picture", where=str(where), remedy=why)
    seen = {id: np.median(np.array(all_), axis=0) for id, all_ in corners.items() if len(all_) >= PICTURES // 3}
    return info, lens, seen, [*words, *(f"camera: {note}" for note in info.notes)]


def _lens(
    camera: Camera, clock: Clock, bench: Bench, config: RobotConfig, where: str | int, info: CameraInfo, parts: Parts
) -> Subroutine[tuple[Intrinsics, list[str]]]:
    """The lens: as it was told before, as robot.toml has it, from views of a board, or from the declared field of view;
    and what is odd."""
    width, height = info.width, info.height
    before = dict(parts.before.get(LENS, {}))
    if before.pop("where", None) == where and (before["width"], before["height"]) == (width, height):
        return _lens_of_note(before), []
    known = camera_of_robot(
        replace(config, camera=replace(config.camera, body_tag_id=max(config.camera.body_tag_id, 1))), where
    )
    if known is not None and known.intrinsics is not None:
        return known.intrinsics.scaled(width, height), []
    declared = Intrinsics.from_diagonal_fov(width, height, math.degrees(config.camera.fov_diagonal_rad))
    choice = yield Ask(
        f"The lens is not calibrated: {FOV_WORDS}. Calibrate it with a ChArUco board?", ("no", "yes"), default="no"
    )
    if choice != "yes":
        return declared, []
    board = CharucoBoard()
    sheet = bench.folder.path / "charuco-board.png"
    write_bytes(sheet, cv2.imencode(".png", board.image())[1].tobytes())
    yield Drawing(
        f"The board to print and glue to something flat: its squares must measure {number(1e3 * board.square_m, 'mm', decimals=0)}.",
        picture=sheet,
    )
    yield Hands("Have the printed board at hand.", "free")
    yield Say(f"show the board in {VIEWS} ways: tilted 30° and more, in every corner of the picture", "info")
    pictures = yield from _board_views(camera, clock, board)
    try:
        if len(pictures) < VIEWS:
            raise BadInput(f"only {len(pictures)} different views of the board were seen")
        return calibrate(pictures, board), []
    except BadInput as error:
        return declared, [f"lens: {error}; the declared field of view is used"]


def _board_views(camera: Camera, clock: Clock, board: CharucoBoard) -> Subroutine[list[NDArray[np.uint8]]]:
    """Pictures (h, w) of the board in `VIEWS` places and tilts; fewer where no new one comes for `VIEW_S`."""
    pictures, seen = list[NDArray[np.uint8]](), list[Array]()
    give_up = clock.now() + VIEW_S
    while len(pictures) < VIEWS and clock.now() < give_up:
        frame = camera.wait(clock.now() + 2.0)
        gray = np.asarray(frame.image.mean(axis=2) if frame.image.ndim == 3 else frame.image, np.uint8)
        found = board.corners(gray)
        if found is None:
            continue
        # Where the board is in the picture, and how large it looks along both axes, which a tilt changes.
        view = np.concatenate([found[1].mean(axis=0), 3 * found[1].std(axis=0)])
        if any(np.abs(view - other).max() < NEW_VIEW * gray.shape[1] for other in seen):
            continue
        seen.append(view)
        pictures.append(gray)
        give_up = clock.now() + VIEW_S
        yield Progress(LOOKED * len(pictures) / VIEWS, f"view {len(pictures)} of {VIEWS}")
    return pictures


def _stand_and_wiggle(
    bench: Bench, config: RobotConfig, setup: CameraFacts, where: str | int, lens: Intrinsics, path: Path
) -> Subroutine[Recording]:
    """Lie, stand, turn to and fro, lie: one recording, at `path`, its phases in the facts."""
    seen = camera_of_robot(replace(config, camera=setup), where)
    assert seen is not None
    # How high the body seems to be is what tells a wrong size here.
    camera: CameraConfig = replace(seen, intrinsics=lens, tags=replace(seen.tags, heights=(-math.inf, math.inf)))
    with EngineProcess(engine_config(bench, camera=camera)) as engine:
        names = tuple(servo.joint for servo in engine.config.servos)
        rate = engine.config.rate_hz
        low, high = np.array([engine.config.limits_rad[name] for name in names]).T
        lying = np.clip(np.asarray(engine.description["position"], float), low, high)
        home = np.array([HOME_RAD[JOINTS[name].kind] for name in names])
        hips = np.array([JOINTS[name].kind == "hip" for name in names])
        up = _minimum_jerk(lying, home, 2.0, rate)
        t = np.arange(round(WIGGLE_S * rate)) / rate
        fade = np.clip(np.minimum(t, t[-1] - t) / 0.5, 0.0, 1.0)
        wiggle = home + np.outer(WIGGLE_RAD * fade * np.sin(2 * np.pi * WIGGLE_HZ * t), hips)
        still = round(HOLD_S * rate)
        played = np.concatenate(
            [np.repeat(lying[None], still, 0), up, np.repeat(home[None], still, 0), wiggle, up[::-1]]
        )
        marks = np.cumsum([0, still, len(up), still, len(t)]) / rate
        phases = {"lying": [0.2, marks[1]], "standing": [marks[2] + 0.5, marks[3]], "wiggle": [marks[3], marks[4]]}
        engine.ask(messages.Torque(True))
        facts = Facts(joints=names, setup="floor", protocol="arena", extra={"phases": phases})
        engine.ask(messages.Record(str(path), facts))
        yield from play_watched(engine, messages.Play(played, "arena"), len(played) / rate, MOTION, (LOOKED, MOVED))
        engine.ask(messages.StopRecording())
        engine.ask(messages.Torque(False))
    return read_recording(path)


def _minimum_jerk(start: Array, end: Array, seconds: float, rate_hz: float) -> Array:
    share = np.arange(round(seconds * rate_hz)) / (seconds * rate_hz)
    smooth = share**3 * (10 - 15 * share + 6 * share**2)
    return np.asarray(start + smooth[:, None] * (end - start), float)


def _between(record: Recording, phase: str) -> dict[str, Array]:
    """t, x, y, z, yaw of the poses within a phase; raises HardwareFault where the tag was lost."""
    begin, end = record.run.facts.extra["phases"][phase]
    t = record.pose.t - record.run.t[0]
    columns = record.pose.columns
    rows = (
        (t >= begin) & (t < end) & np.isfinite([columns[f"base.{name}"] for name in ("x", "y", "z", "yaw")]).all(axis=0)
    )
    if rows.sum() < LEAST_POSES:
        lost = [str(event["reason"]) for event in record.events if event["kind"] == "pose lost"]
        why = f": {max(lost, key=lost.count)}" if lost else ""
        raise HardwareFault(
            f"the camera gave {int(rows.sum())} poses of the robot in the phase {phase}, {LEAST_POSES} are needed{why}",
            remedy="light, focus, and both tags in view",
        )
    return {"t": record.pose.t[rows], **{name: columns[f"base.{name}"][rows] for name in ("x", "y", "z", "yaw")}}


def _turned(record: Recording, turning: dict[str, Array]) -> float:
    """How far the body turned over how far all hips turned together the other way: 1 where no foot slides."""
    run = record.run
    hips = [joint for joint in run.joints if JOINTS[joint].kind == "hip"]
    turned = np.mean(run.signal("pos", hips), axis=1)
    seen, found = np.isfinite(turned), np.isfinite(turning["yaw"])
    if seen.sum() < 2 or found.sum() < 2:
        return math.nan
    angle = np.interp(turning["t"][found], run.t[seen], turned[seen])
    yaw = np.unwrap(turning["yaw"][found])
    angle, yaw = angle - angle.mean(), yaw - yaw.mean()
    return float(-(yaw @ angle) / (angle @ angle)) if np.ptp(angle) > 0 else math.nan


def _height(poses: dict[str, Array]) -> float:
    seen = poses["z"][np.isfinite(poses["z"])]
    return float(np.median(seen)) if len(seen) else math.nan


def _mean_angle(angles: Array) -> float:
    seen = angles[np.isfinite(angles)]
    return math.atan2(float(np.mean(np.sin(seen))), float(np.mean(np.cos(seen)))) if len(seen) else math.nan
