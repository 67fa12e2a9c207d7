"""The overhead camera: what the rendered arena shows, what the tracker makes of it, and what is lost on the way."""

from __future__ import annotations

import http.client
import math
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from boards import TILTS, board_views, rotation
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.comms import camera as camera_module
from openant_tools.comms.body_camera import BodyCamera, CameraConfig
from openant_tools.comms.camera import Camera, CameraSettings, DropCounter
from openant_tools.comms.clock import RealClock
from openant_tools.comms.intrinsics import CharucoBoard, Intrinsics, calibrate
from openant_tools.comms.latency import camera_latency
from openant_tools.comms.setup import camera_of_robot
from openant_tools.comms.tag_family import FAMILIES, TagFamily, load_family
from openant_tools.comms.tags import BodyLost, BodyPose, BodyTracker, TagDetector, TagSetup
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.robot.config import parse_config
from openant_tools.robot.folder import create_robot
from openant_tools.virtual.camera_scene import OverheadCameraSettings, Scene, TagOnFloor, TagOnRobot
from openant_tools.virtual.camera_stream import VirtualCamera
from openant_tools.virtual.overhead_camera import OverheadCamera

#: A small picture from near by: as many pixels on the tags as the real one has, at a quarter of the work.
MIDDLE = TagOnFloor(x=0.0, y=0.0)
SMALL = OverheadCameraSettings(width=640, height=360, position=(0.0, 0.0, 1.0), fps=30.0, origin=MIDDLE)


def scene(x: float = 0.2, y: float = 0.1, z: float = 0.15, roll: float = 0, pitch: float = 0, yaw: float = 0) -> Scene:
    """An Ant that stands, legs out and bent down."""
    r, p = rotation(roll, pitch, yaw), np.array([x, y, z])
    limbs = []
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        out = np.array([sx, sy, 0.0])
        a, b = p + r @ (0.06 * out), p + r @ (0.12 * out)
        c = b + r @ (0.08 * out + [0, 0, -0.13])
        limbs += [[*p, *a, 0.024], [*a, *b, 0.024], [*b, *c, 0.022]]
    return Scene(p, r, limbs)


def photo(camera: OverheadCamera, what: Scene, index: int = 0) -> np.ndarray:
    """A picture as it comes out of the cable: compressed and unpacked."""
    image = camera.picture(index, index / camera.settings.fps, what)
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])[1], cv2.IMREAD_COLOR)


def settle(tracker: BodyTracker, camera: OverheadCamera) -> None:
    """Show the origin tag, with no robot in the way, often enough to be certain of it."""
    for k in range(6):
        tracker.track(photo(camera, scene(x=9.0), k), k / 30)


# --- tags and the arena --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES[:5])
def test_bitmaps_are_what_the_detector_reads(family: str) -> None:
    kind, detector = load_family(family), TagDetector(family, decimate=1.0)
    for tag in (0, 1, 12, len(kind.codes) - 1):
        sheet = np.kron(np.pad(kind.bitmap(tag), 2, constant_values=255), np.ones((12, 12), np.uint8))
        (seen,) = detector.detect(sheet)
        assert (seen.id, seen.hamming) == (tag, 0)
        low = 12 * (2 + (kind.cells - kind.edge_cells) // 2) - 0.5
        high = low + 12 * kind.edge_cells
        assert np.allclose(seen.corners, [[low, low], [high, low], [high, high], [low, high]], atol=0.6)


@pytest.mark.parametrize("family", FAMILIES[:4])
def test_no_tag_is_another_ones_until_as_many_cells_are_wrong_as_the_family_says(family: str) -> None:
    kind = load_family(family)
    corner = (kind.cells - kind.edge_cells) // 2
    columns, rows = corner + np.array(kind.bits).T
    turned = [[np.rot90(kind.bitmap(tag), k)[rows, columns] > 0 for tag in range(len(kind.codes))] for k in range(4)]
    upright = np.array(turned[0], float)
    for k, other in enumerate(np.array(turned, float)):
        apart = upright @ (1 - other).T + (1 - upright) @ other.T
        if k == 0:
            np.fill_diagonal(apart, np.inf)
        assert apart.min() >= kind.hamming


def test_a_tag_with_a_wrong_bit_is_neither_followed_nor_taken_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    family, printed, chance = (
        "tag16h5",
        TagFamily.bitmap,
        np.random.default_rng(0),
    )  # its codes differ by the fewest bits

    def spotted(wrong: int) -> OverheadCamera:
        def bitmap(kind: TagFamily, tag: int) -> np.ndarray:
            cells = printed(kind, tag)
            if tag == 12:
                corner = (kind.cells - kind.edge_cells) // 2
                for x, y in chance.permutation(kind.bits)[:wrong]:
                    cells[corner + y, corner + x] ^= 255
            return cells

        with monkeypatch.context() as patch:
            patch.setattr(TagFamily, "bitmap", bitmap)
            return OverheadCamera(
                replace(SMALL, origin=replace(MIDDLE, family=family), body=TagOnRobot(family, 12)), seed=3
            )

    for wrong, words in ((1, "wrong bits: 1"), (2, "wrong bits: 2"), (3, ""), (4, "")):
        for _ in range(5):
            camera = spotted(wrong)
            # Whoever wears the tag that it reads like is not seen in its place, either.
            trackers = [BodyTracker(TagSetup(family, body_id=tag), camera.intrinsics) for tag in (12, 3, 13)]
            for tracker in trackers:
                settle(tracker, camera)
            first, *others = [tracker.track(photo(camera, scene(), 9), 0.3) for tracker in trackers]
            assert isinstance(first, BodyLost)
            assert words in first.reason
            assert all(isinstance(one, BodyLost) for one in others)


def test_an_origin_tag_with_a_wrong_bit_is_said_to_have_one(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = TagFamily.bitmap

    def bitmap(kind: TagFamily, tag: int) -> np.ndarray:
        cells, corner = printed(kind, tag), (kind.cells - kind.edge_cells) // 2
        if tag == 0:
            x, y = kind.bits[3]
            cells[corner + y, corner + x] ^= 255
        return cells

    monkeypatch.setattr(TagFamily, "bitmap", bitmap)
    camera = OverheadCamera(SMALL, seed=3)
    tracker = BodyTracker(TagSetup(), camera.intrinsics)
    lost = [tracker.track(photo(camera, scene(x=0.6)), t) for t in (0.0, 0.1)][-1]
    assert lost == BodyLost(0.1, "origin tag 0 is doubtful (wrong bits: 1): a spot, a crease or a shadow on it")


@pytest.mark.parametrize("family", ["tagCircle21h7", "tag36h11", "tag16h5", "tag25h9"])
def test_each_family_is_found_at_five_distances_and_tilts_within_its_stated_error(family: str) -> None:
    """The camera hangs at 2.6 m, as over a real arena; the body tag comes nearer and tilts more."""
    settings = OverheadCameraSettings(
        position=(0.3, -0.2, 2.6), origin=replace(MIDDLE, family=family), body=TagOnRobot(family, 12), fps=30.0
    )
    camera = OverheadCamera(settings, seed=4)
    tracker = BodyTracker(TagSetup(family, heights=(0.0, 2.0)), camera.intrinsics)
    settle(tracker, camera)
    for k, (height, tilt) in enumerate([(0.15, 0.0), (0.5, 0.1), (0.9, -0.15), (1.3, 0.2), (1.6, -0.3)]):
        truth = scene(x=0.25, y=-0.1, z=height, roll=tilt, pitch=0.5 * tilt, yaw=0.7 * k)
        pose = tracker.track(photo(camera, truth, 10 + k), 1.0 + k, (tilt, 0.5 * tilt))
        assert isinstance(pose, BodyPose), pose
        error = pose.position - truth.position
        assert np.all(np.abs(error) < 4 * pose.position_error + 1e-3)
        assert np.all(np.abs(error[:2]) < 3e-3 + 8e-3 * height)  # the origin tag's own tilt grows with the height
        assert abs(math.remainder(pose.yaw - 0.7 * k, 2 * math.pi)) < 4 * pose.yaw_error + 2e-3
        assert np.all(pose.position_error < 0.02)


def test_the_arena_is_the_origin_tags_frame_and_the_body_is_not_its_tag() -> None:
    mount = TagOnRobot(position=(0.02, -0.01, 0.09), yaw=0.4)
    origin = TagOnFloor(x=-0.15, y=0.1, yaw=1.0)
    camera = OverheadCamera(replace(SMALL, origin=origin, body=mount), seed=2)
    tracker = BodyTracker(TagSetup(body_position=mount.position, body_yaw=mount.yaw), camera.intrinsics)
    settle(tracker, camera)
    truth = scene(x=0.15, y=-0.08, yaw=-2.0)
    pose = tracker.track(photo(camera, truth, 7), 7 / 30)
    assert isinstance(pose, BodyPose)
    expected = rotation(yaw=1.0).T @ (truth.position - [origin.x, origin.y, 0])
    assert np.allclose(pose.position, expected, atol=4e-3)
    assert math.remainder(pose.yaw - (-2.0 - 1.0), 2 * math.pi) == pytest.approx(0.0, abs=5e-3)
    assert np.allclose(pose.heading, [math.cos(pose.yaw), math.sin(pose.yaw)])
    assert pose.t == 7 / 30


def test_the_imus_tilt_takes_the_lean_out_of_the_position() -> None:
    camera = OverheadCamera(SMALL, seed=2)
    tracker = BodyTracker(TagSetup(), camera.intrinsics)
    settle(tracker, camera)
    errors = []
    for tilt in (None, (0.35, 0.0)):
        worst = 0.0
        for k in range(6):
            truth = scene(roll=0.35, yaw=k)
            pose = tracker.track(photo(camera, truth, 20 + k), 1.0, tilt)
            assert isinstance(pose, BodyPose)
            worst = max(worst, float(np.linalg.norm(pose.position[:2] - truth.position[:2])))
        errors.append(worst)
    assert errors[1] < 4e-3
    assert errors[1] < errors[0]


def test_a_lost_body_is_reported_lost_with_the_reason() -> None:
    camera = OverheadCamera(SMALL, seed=2)
    tracker = BodyTracker(TagSetup(), camera.intrinsics)
    first = tracker.track(photo(camera, scene()), 0.0)
    assert first == BodyLost(0.0, "origin tag 0 not seen yet")
    settle(tracker, camera)
    assert isinstance(tracker.track(photo(camera, scene()), 1.0), BodyPose)
    away = tracker.track(photo(camera, scene(x=3.0)), 1.1)
    assert away == BodyLost(1.1, "body tag 12 not seen")
    over = tracker.track(photo(camera, scene(roll=math.pi)), 1.2)
    assert over == BodyLost(1.2, "body tag 12 not seen")
    other = BodyTracker(TagSetup(body_id=5), camera.intrinsics)
    settle(other, camera)
    lost = other.track(photo(camera, scene()), 1.3)
    assert lost == BodyLost(1.3, "body tag 5 not seen (but tag 12)")
    dark = tracker.track((photo(camera, scene()) * 0.03).astype(np.uint8), 1.4)
    assert isinstance(dark, BodyLost)
    assert "body tag 12" in dark.reason


def test_a_body_at_the_pictures_edge_says_so() -> None:
    camera = OverheadCamera(SMALL, seed=2)
    tracker = BodyTracker(TagSetup(), camera.intrinsics)
    settle(tracker, camera)
    inner, outer = (tracker.track(photo(camera, scene(x=x)), t) for t, x in ((1.0, 0.2), (2.0, 0.33)))
    assert isinstance(inner, BodyPose)
    assert isinstance(outer, BodyPose)
    assert (inner.near_edge, outer.near_edge) == (False, True)


def test_the_origin_may_be_covered_but_not_moved() -> None:
    camera = OverheadCamera(SMALL, seed=2)
    tracker = BodyTracker(TagSetup(), camera.intrinsics)
    settle(tracker, camera)
    covered = photo(camera, scene())
    covered[120:240, 260:380] = 90
    pose = tracker.track(covered, 2.0)
    assert isinstance(pose, BodyPose)
    bumped = OverheadCamera(replace(SMALL, look_at=(0.03, 0.0, 0.0)), seed=2)
    beside = scene(x=-0.25, y=0.14, yaw=math.pi / 4)
    lost = tracker.track(photo(bumped, beside), 2.1)
    assert lost == BodyLost(2.1, "the origin tag or the camera has moved")
    for k in range(12):
        last = tracker.track(photo(bumped, beside, k), 2.2 + k / 30)
    assert isinstance(last, BodyPose)
    assert np.allclose(last.position[:2], [-0.25, 0.14], atol=4e-3)
    assert tracker.origin_moves == 1


def test_tags_that_cannot_be_are_refused() -> None:
    with pytest.raises(BadInput, match=r"tagCircle21h7 has no tag 99 .* ids are 0 to 37"):
        TagSetup(body_id=99)
    with pytest.raises(BadInput, match="origin and body cannot both be tag 0"):
        TagSetup(body_id=0)
    with pytest.raises(BadInput, match="the body tag's edge length is 45 m"):
        TagSetup(body_size=45)
    with pytest.raises(BadInput, match="no tag family 'tag36h12'"):
        TagSetup("tag36h12")
    camera = OverheadCamera(SMALL, seed=2)
    tracker = BodyTracker(TagSetup(), Intrinsics.from_diagonal_fov(640, 480, 60))
    with pytest.raises(BadInput, match="calibrated at 640×480, its pictures are 640×360"):
        tracker.track(photo(camera, scene()), 0.0)


def test_the_picture_is_a_function_of_seed_and_number() -> None:
    a, b = OverheadCamera(SMALL, seed=3), OverheadCamera(SMALL, seed=3)
    assert np.array_equal(a.picture(5, 0.1, scene()), b.picture(5, 0.1, scene()))
    assert not np.array_equal(a.picture(5, 0.1, scene()), a.picture(6, 0.1, scene()))


def test_fast_motion_smears_the_tag_and_not_the_floor() -> None:
    camera = OverheadCamera(replace(SMALL, noise=0.0, flicker=0.0, exposure_s=0.03), seed=3)
    still, fast = camera.picture(0, 0, scene()), camera.picture(0, 0, replace(scene(), velocity=(1.5, 0, 0)))
    assert np.array_equal(still[:, :60], fast[:, :60])
    sharpness = [cv2.Laplacian(image, cv2.CV_64F).var() for image in (still, fast)]
    assert sharpness[1] < 0.8 * sharpness[0]


# --- the lens ------------------------------------------------------------------------------------------------------


def test_the_field_of_view_is_the_diagonals() -> None:
    lens = Intrinsics.from_diagonal_fov(1920, 1080, 60)
    assert lens.fx == pytest.approx(1907.7, abs=0.5)
    half = lens.scaled(960, 540)
    assert half.fx == pytest.approx(lens.fx / 2)
    assert half.cx == pytest.approx(479.5)
    with pytest.raises(BadInput, match="diagonal field of view of 0°"):
        Intrinsics.from_diagonal_fov(1920, 1080, 0)


@settings(max_examples=25)
@given(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.floats(-0.003, 0.003), st.floats(-0.003, 0.003))
def test_projection_is_opencvs_and_undistortion_its_inverse(k1: float, k2: float, p1: float, p2: float) -> None:
    lens = Intrinsics(1280, 720, 1250, 1240, 650, 350, (k1, k2, p1, p2, 0.0))
    pixels = np.array([[0, 0], [1279, 719], [300, 500], [640, 360]], float)
    points = np.column_stack([lens.rays(pixels), np.ones(4)])
    assert np.allclose(lens.project(points), pixels, atol=1e-4)
    reference, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, lens.coefficients)
    assert np.allclose(reference.reshape(-1, 2), pixels, atol=1e-4)


def test_a_charuco_board_gives_the_lens_back() -> None:
    truth = Intrinsics(800, 600, 780, 776, 405, 296, (0.08, -0.15, 0.001, -0.001, 0.0))
    board = CharucoBoard()
    lens = calibrate(board_views(truth, board, TILTS), board)
    assert lens.fx == pytest.approx(truth.fx, rel=0.005)
    assert lens.fy == pytest.approx(truth.fy, rel=0.005)
    assert (lens.cx, lens.cy) == pytest.approx((truth.cx, truth.cy), abs=3)
    assert lens.rms_px is not None
    assert lens.rms_px < 0.3
    corners = np.array([[60.0, 60.0], [740.0, 540.0]])
    assert np.allclose(lens.rays(corners), truth.rays(corners), atol=2e-3)


def test_views_that_cannot_tell_the_lens_are_refused() -> None:
    lens, board = Intrinsics(800, 600, 780, 776, 405, 296), CharucoBoard()
    flat = board_views(lens, board, [(0.0, 0.0)] * 8)
    with pytest.raises(BadInput, match=r"all views are within .* tilt the board"):
        calibrate(flat, board)
    with pytest.raises(BadInput, match="the board is found in 3 of 5 pictures"):
        calibrate([*flat[:3], np.full_like(flat[0], 128), np.full_like(flat[0], 128)], board)


# --- what is lost --------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(st.floats(8.0, 60.0), st.floats(0.0, 0.35), st.floats(0.0, 0.25), st.integers(0, 2**31), st.floats(-1e-4, 1e-4))
def test_drops_are_counted_through_jitter(fps: float, share: float, jitter: float, seed: int, skew: float) -> None:
    rng = np.random.default_rng(seed)
    kept = rng.random(700) >= share
    kept[[0, -1]] = True
    times = 50.0 + np.arange(700) / fps * (1 + skew) + rng.uniform(0, jitter / fps, 700)
    counter = DropCounter()
    for t in np.sort(times[kept]):
        counter.add(t)
    assert counter.received == kept.sum()
    assert abs(counter.dropped - (700 - kept.sum())) <= 1
    assert counter.fps == pytest.approx(fps, rel=0.01)


def test_an_interruption_is_no_drop() -> None:
    counter = DropCounter()
    for start in (0.0, 100.0):
        for k in range(100):
            counter.add(start + k / 30)
        assert counter.dropped == 0
        counter.pause()
    assert counter.received == 200


def turning(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heading and rate of a robot that is turned to and fro by hand."""
    phase = 2 * np.pi * 0.7 * t
    return 0.5 * np.sin(phase) + 0.1 * np.sin(2.3 * phase), 2 * np.pi * 0.7 * (
        0.5 * np.cos(phase) + 0.23 * np.cos(2.3 * phase)
    )


def test_the_latency_comes_out_of_a_turn_to_and_fro() -> None:
    rng = np.random.default_rng(0)
    tg = np.arange(0, 8, 0.01)
    tc = np.sort(rng.uniform(0, 8, 200))
    yaw = 1.1 * turning(tc - 0.083)[0] + 2.0 + 0.01 * tc + rng.normal(0, 2e-3, 200)
    rate = turning(tg)[1] + rng.normal(0, 0.01, len(tg))
    found = camera_latency(tc, np.angle(np.exp(1j * yaw)), tg, rate)
    assert found.latency_s == pytest.approx(0.083, abs=max(1e-3, 3 * found.latency_error_s))
    assert found.latency_error_s < 2e-3
    assert found.scale == pytest.approx(1.1, abs=0.01)
    assert found.drift_rad_s == pytest.approx(0.01, abs=0.003)


def test_a_motion_that_tells_no_latency_is_refused() -> None:
    t = np.arange(0, 6, 0.01)
    with pytest.raises(BadInput, match=r"tells no latency .* to and fro"):
        camera_latency(t, 0.8 * t, t, np.full_like(t, 0.8))
    with pytest.raises(BadInput, match="only 0 pictures"):
        camera_latency(t + 100, t, t, t)


# --- the stream: stepped -------------------------------------------------------------------------------------------


class SteppedHost:
    """A robot under the camera whose time moves only while somebody waits. Serves as the driver's clock."""

    stepped = True

    def __init__(self, camera: VirtualCamera, motion: Callable[[float], Scene]) -> None:
        self.camera, self.motion, self.t = camera, motion, 0.0

    def now(self) -> float:
        return self.t

    def sleep_until(self, t: float) -> None:
        self.t = max(self.t, t)
        while self.camera.next_exposure <= self.t:
            at = self.camera.next_exposure
            self.camera.expose(at, self.motion(at))
        self.camera.advance(self.t)

    def wait_readable(self, line: Any, deadline: float) -> bool:
        raise NotImplementedError


@pytest.fixture(scope="module")
def stepped() -> Iterator[SteppedHost]:
    settings = replace(SMALL, drop=0.1, latency_s=0.062, latency_jitter_s=0.004)
    camera = VirtualCamera(settings, seed=9, stepped=True)
    yield SteppedHost(camera, lambda t: scene(yaw=float(turning(np.array(t))[0])))
    camera.close()


def test_under_a_stepped_clock_latency_and_drops_are_measured_right(stepped: SteppedHost) -> None:
    driver = Camera(CameraSettings(stepped.camera.wait()), stepped)
    info = driver.open()
    assert (info.width, info.height) == (640, 360)
    tracker = BodyTracker(TagSetup(), stepped.camera.settings.intrinsics)
    begin = stepped.t
    poses, arrivals, drops = [], [], DropCounter()
    while stepped.t < begin + 4.0:
        stepped.sleep_until(stepped.t + 0.01)
        frame = driver.newest()
        if frame is None:
            continue
        drops.add(frame.arrived)
        pose = tracker.track(frame.image, frame.t)
        if isinstance(pose, BodyPose):
            poses.append(pose)
            arrivals.append(frame.arrived)
    yaw = np.array([pose.yaw for pose in poses])
    taken = np.array([pose.t for pose in poses])
    assert np.allclose(yaw, turning(taken)[0], atol=8e-3)  # stamps say when the picture was taken
    tg = np.arange(begin, stepped.t, 0.01)
    found = camera_latency(np.array(arrivals), yaw, tg, turning(tg)[1])
    assert found.latency_s == pytest.approx(0.062, abs=2e-3)
    assert found.latency_error_s < 2e-3
    statistics = driver.statistics
    expected = [np.random.default_rng([9, k, 1]).random() < 0.1 for k in range(round(stepped.t * 30))]
    assert abs(statistics.dropped - sum(expected[round(begin * 30) :])) <= 1
    assert abs(drops.dropped - statistics.dropped) <= 1
    assert statistics.skipped == 0
    # The same latency, once measured, corrects arrival times.
    known = Camera(replace(driver.settings, latency_s=found.latency_s), stepped)
    known.open()
    frame = known.wait(stepped.t + 1)
    assert frame.t == pytest.approx(frame.arrived - 0.062, abs=2e-3)


def test_who_looks_often_asks_seldom_and_sees_every_picture_as_it_comes(
    stepped: SteppedHost, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver, asked, send = Camera(CameraSettings(stepped.camera.wait()), stepped), [], http.client.HTTPConnection.request

    def counted(*given: Any, **more: Any) -> None:
        asked.append(stepped.t)
        send(*given, **more)

    monkeypatch.setattr(http.client.HTTPConnection, "request", counted)
    driver.open()
    late, begin, before = [], stepped.t, len(asked)
    while stepped.t < begin + 1.0:
        stepped.sleep_until(stepped.t + 0.001)
        if (frame := driver.newest()) is not None:
            late.append(stepped.t - frame.arrived)
        assert driver.fault() is None
    assert len(late) > 20
    assert min(late[1:]) >= 0
    assert max(late[1:]) < 0.001 + 1e-6
    assert driver.statistics.skipped == 0
    assert len(asked) - before < 15 * len(late), "not at each of a thousand looks, twice"


def test_under_a_stepped_clock_every_run_is_the_same(stepped: SteppedHost) -> None:
    driver = Camera(CameraSettings(stepped.camera.wait()), stepped)
    driver.open()
    stepped.sleep_until(stepped.t + 0.3)
    once = driver.newest()
    again = Camera(CameraSettings(stepped.camera.wait()), stepped)
    again.open()
    twice = again.newest()
    assert once is not None
    assert twice is not None
    assert once.t == twice.t
    assert np.array_equal(once.image, twice.image)
    assert driver.newest() is None  # each picture is given once


def test_frozen_stalled_and_unplugged_cameras_are_told_apart(stepped: SteppedHost) -> None:
    driver = Camera(CameraSettings(stepped.camera.wait()), stepped)
    driver.open()

    def watch(seconds: float) -> str:
        for _ in range(round(seconds / 0.03)):
            stepped.sleep_until(stepped.t + 0.03)
            driver.newest()
        return str(driver.fault())

    assert watch(0.3) == "None"
    stepped.camera.fault("frozen")
    assert "repeats one picture for" in watch(0.9)
    stepped.camera.fault(None)
    assert watch(0.3) == "None"
    stepped.camera.fault("stalled")
    assert "has sent no picture for" in watch(0.6)
    with pytest.raises(HardwareFault, match="has sent no picture"):
        driver.wait(stepped.t + 0.1)
    stepped.camera.fault("gone")
    assert "unplugged" in watch(0.1)
    stepped.camera.fault(None)
    assert watch(0.5) == "None"
    with pytest.raises(ValueError, match="no camera fault 'tired'"):
        stepped.camera.fault("tired")


def test_the_engines_camera_gives_poses_in_order_and_tells_what_is_wrong_once(stepped: SteppedHost) -> None:
    settings = stepped.camera.settings
    config = CameraConfig(CameraSettings(stepped.camera.wait()), TagSetup(), settings.intrinsics)
    eye = BodyCamera(config, stepped)
    still, stepped.motion = stepped.motion, lambda t: scene(roll=0.3, yaw=0.5)

    def watch(seconds: float) -> tuple[list[BodyPose | BodyLost], list[str]]:
        results, news = [], []
        for _ in range(round(seconds / 0.02)):
            stepped.sleep_until(stepped.t + 0.02)
            eye.lean(stepped.t, 0.3, 0.0)
            results += eye.poses()
            news += [said for said in [eye.news()] if said]
        return results, news

    try:
        stepped.sleep_until(stepped.t + 0.6)  # the servos are opened meanwhile
        results, news = watch(1.0)
        last = results[-1]
        assert isinstance(last, BodyPose)
        assert news == []
        assert np.all(np.diff([result.t for result in results]) > 0)
        assert np.allclose(last.position, [0.2, 0.1, 0.15], atol=5e-3)
        w, x, y, z = last.quaternion
        assert math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) == pytest.approx(last.yaw)
        stepped.motion = lambda t: scene(x=5.0)
        results, news = watch(1.5)
        assert isinstance(results[-1], BodyLost)
        assert len(news) == 1
        assert "no pose of the robot for 0.5 s: body tag 12 not seen → look at the picture" in news[0]
        assert eye.statistics.received > 40
    finally:
        stepped.motion = still
        eye.close()


def test_a_stepped_clock_refuses_a_real_camera(stepped: SteppedHost) -> None:
    with pytest.raises(BadInput, match="a stepped clock cannot watch camera 0"):
        Camera(CameraSettings(0), stepped).open()


# --- the stream: real time -----------------------------------------------------------------------------------------


def test_opencv_opens_the_stream_and_its_drops_and_return_are_noticed() -> None:
    virtual = VirtualCamera(replace(SMALL, fps=20.0, drop=0.2), seed=5)
    url = virtual.wait()
    stop, began = threading.Event(), time.monotonic()

    def host() -> None:
        while not stop.wait(0.002):
            t = time.monotonic() - began
            if t >= virtual.next_exposure:
                virtual.expose(t, scene(yaw=t))

    thread = threading.Thread(target=host)
    thread.start()
    driver = Camera(CameraSettings(url), RealClock())
    try:
        info = driver.open()
        assert (info.width, info.height, info.backend) == (640, 360, "MJPEG")
        assert info.latency_source == "guess"
        assert "until it is measured" in info.notes[-1]
        first = driver.wait(time.monotonic() + 5)
        exposed = virtual.next_exposure
        while driver.statistics.received < 60:
            last = driver.wait(time.monotonic() + 5)
        exposed = round((virtual.next_exposure - exposed) * 20)
        assert last.index > first.index
        assert 0 < last.arrived - last.t < 0.2
        counted = driver.statistics
        # Whoever lost them (the camera on purpose, a busy machine on top): what was exposed came or is counted.
        assert abs(counted.received + counted.dropped - exposed) <= 0.3 * exposed
        virtual.fault("gone")
        until = time.monotonic() + 10
        while driver.fault() is None and time.monotonic() < until:
            time.sleep(0.02)
        assert "unplugged or closed its stream" in str(driver.fault())
        virtual.fault(None)
        driver.wait(time.monotonic() + 10)  # whatever was on its way
        driver.wait(time.monotonic() + 10)
        assert driver.statistics.reopened >= 1
        assert driver.fault() is None
    finally:
        driver.close()
        stop.set()
        thread.join()
        virtual.close()


# --- real cameras, by their driver's habits ------------------------------------------------------------------------


class Webcam:
    """A Video4Linux webcam that does what it likes: 1280 × 720 at 30 pictures a second whatever is asked."""

    def __init__(self, *opened_as: Any) -> None:
        self.props = {cv2.CAP_PROP_FPS: 30.0, cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV"))}
        self.order: list[int] = []
        self.taken = 0.0
        self.rng = np.random.default_rng(0)

    def isOpened(self) -> bool:
        return True

    def getBackendName(self) -> str:
        return "V4L2"

    def set(self, prop: int, value: float) -> bool:
        self.order.append(prop)
        if prop == cv2.CAP_PROP_EXPOSURE:
            self.props[prop] = value
        return prop == cv2.CAP_PROP_EXPOSURE

    def get(self, prop: int) -> float:
        return self.taken * 1000 if prop == cv2.CAP_PROP_POS_MSEC else self.props.get(prop, -1.0)

    def grab(self) -> bool:
        time.sleep(0.01)
        self.taken = time.monotonic() - 0.025
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, self.rng.integers(0, 255, (720, 1280, 3), np.uint8)

    def release(self) -> None: ...


@pytest.fixture
def webcam(monkeypatch: pytest.MonkeyPatch) -> type[Webcam]:
    monkeypatch.setattr(cv2, "VideoCapture", Webcam)
    return Webcam


def test_what_the_camera_does_not_do_is_said(webcam: type[Webcam]) -> None:
    driver = Camera(CameraSettings(0, exposure=80), RealClock())
    info = driver.open()
    driver.close()
    assert (info.width, info.height) == (1280, 720)
    kept = {s.name: s.kept for s in info.settings}
    assert kept["exposure"]
    assert kept["fps"]
    assert not kept["format"]
    assert "format YUYV instead of MJPG" in info.notes[0]
    assert "width 1280 instead of 1920" in info.notes[0]


def test_kernel_stamps_are_used_where_they_are_on_our_clock(webcam: type[Webcam]) -> None:
    driver = Camera(CameraSettings(0), RealClock())
    info = driver.open()
    frame = driver.wait(time.monotonic() + 2)
    driver.close()
    assert (info.latency_source, info.latency_s) == ("kernel stamp", 0.0)
    assert frame.arrived - frame.t == pytest.approx(0.025, abs=0.02)


def test_stamps_of_another_clock_are_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    class WallClock(Webcam):
        def get(self, prop: int) -> float:
            return time.time() * 1000 if prop == cv2.CAP_PROP_POS_MSEC else super().get(prop)

    monkeypatch.setattr(cv2, "VideoCapture", WallClock)
    driver = Camera(CameraSettings(0, latency_s=0.05), RealClock())
    info = driver.open()
    frame = driver.wait(time.monotonic() + 2)
    driver.close()
    assert info.latency_source == "measured"
    assert frame.arrived - frame.t == pytest.approx(0.05)


def test_a_camera_that_is_not_there_or_sends_nothing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(HardwareFault, match="camera 77: there is no /dev/video77"):
        Camera(CameraSettings(77), RealClock()).open()
    with pytest.raises(HardwareFault, match="no picture stream answers at this address"):
        Camera(CameraSettings("http://127.0.0.1:9/stream.mjpg"), RealClock()).open()

    class Mute(Webcam):
        def grab(self) -> bool:
            time.sleep(0.01)
            return False

    monkeypatch.setattr(cv2, "VideoCapture", Mute)
    monkeypatch.setattr(camera_module, "FIRST_FRAME_TIMEOUT_S", 0.2)
    with pytest.raises(HardwareFault, match=r"opens but sends no picture .* close other programs"):
        Camera(CameraSettings(0), RealClock()).open()
    with pytest.raises(HardwareFault, match="the camera is not open"):
        Camera(CameraSettings(0), RealClock()).newest()


def test_a_robots_file_describes_its_camera(tmp_path: Path) -> None:
    """Lens, mount and tags come from robot.toml; a robot that wears no known tag cannot be looked for."""
    folder = create_robot(tmp_path / "ant", kit="standard", name="ant")
    assert camera_of_robot(folder.config()) is None
    text = folder.config_file.read_text()
    with_camera = text.replace('camera = ""', "camera = 2")
    with pytest.raises(BadInput, match="body_tag_id"):
        camera_of_robot(parse_config(tomllib.loads(with_camera))[0])
    lens = "size_px = [1920, 1080]\nfocal_px = [1500, 1501]\ncentre_px = [960, 540]\ndistortion = [0.1, 0, 0, 0, 0]\n"
    partly = with_camera.replace("body_tag_id = -1", "body_tag_id = 7\nfocal_px = [1500, 1501]")
    with pytest.raises(BadInput, match="the lens is described in part"):
        camera_of_robot(parse_config(tomllib.loads(partly))[0])
    known = with_camera.replace("body_tag_id = -1", f"latency_s = 0.08\n{lens}body_tag_id = 7")
    found = camera_of_robot(parse_config(tomllib.loads(known))[0])
    assert found is not None
    assert found.intrinsics is not None
    assert (found.settings.source, found.settings.latency_s) == (2, 0.08)
    assert (found.tags.body_id, found.tags.body_position) == (7, (0.0, 0.0, 0.085))
    assert (found.intrinsics.fx, found.intrinsics.distortion[0]) == (1500, 0.1)
