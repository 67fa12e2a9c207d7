"""A picture that can be read in two ways gives no pose, and says why: what builders' cameras, sheets and telephones do."""

from __future__ import annotations

import contextlib
import http.server
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_camera import MIDDLE, SMALL, photo, scene, settle

from openant_tools.comms.body_camera import BodyCamera, CameraConfig
from openant_tools.comms.camera import Camera, CameraSettings
from openant_tools.comms.clock import RealClock
from openant_tools.comms.tag_family import load_family
from openant_tools.comms.tags import BodyLost, BodyPose, BodyTracker, TagSetup
from openant_tools.errors import HardwareFault
from openant_tools.virtual.camera_scene import TagOnRobot
from openant_tools.virtual.overhead_camera import OverheadCamera

CAMERA = OverheadCamera(SMALL, seed=2)
AWAY = scene(x=9.0)
#: Beside the origin's tag, so that both are seen.
HERE = scene(x=0.25, y=0.12)


@pytest.fixture
def tracker() -> BodyTracker:
    found = BodyTracker(TagSetup(), CAMERA.intrinsics)
    settle(found, CAMERA)
    return found


def reason(result: BodyPose | BodyLost) -> str:
    assert isinstance(result, BodyLost), result
    return result.reason


def with_sheet(
    picture: np.ndarray, tag: int, family: str = "tagCircle21h7", at: tuple[int, int] = (20, 20), cell: int = 5
) -> np.ndarray:
    """The picture with one more printed tag in it."""
    sheet = np.kron(np.pad(load_family(family).bitmap(tag), 1, constant_values=255), np.ones((cell, cell), np.uint8))
    out, (x, y) = picture.copy(), at
    out[y : y + len(sheet), x : x + len(sheet)] = sheet[:, :, None]
    return out


def cropped(picture: np.ndarray, share: float) -> np.ndarray:
    """Its middle, as a zoom or a crop of the sensor shows it, in the old size."""
    height, width = picture.shape[:2]
    dy, dx = round(height * (1 - share) / 2), round(width * (1 - share) / 2)
    return cv2.resize(picture[dy : height - dy, dx : width - dx], (width, height))


def test_two_sheets_with_one_number_give_no_pose_by_turns(tracker: BodyTracker) -> None:
    here = photo(CAMERA, HERE)
    assert isinstance(tracker.track(here, 1.0), BodyPose)
    assert reason(tracker.track(with_sheet(here, 12), 1.1)).startswith(
        "body tag 12 is seen twice: take the other sheet"
    )
    # Where a leg hides one of them it is not clear which is left.
    assert "seen twice" in reason(tracker.track(with_sheet(photo(CAMERA, AWAY), 12), 1.2))
    assert "seen twice" in reason(tracker.track(here, 1.3))
    assert isinstance(tracker.track(here, 13.0), BodyPose)
    assert reason(tracker.track(with_sheet(here, 0), 14.0)).startswith("origin tag 0 is seen twice")


def test_between_whole_searches_tags_are_found_where_they_were_and_just_as_well(tracker: BodyTracker) -> None:
    whole = BodyTracker(TagSetup(), CAMERA.intrinsics)
    settle(whole, CAMERA)
    for k in range(10):
        picture = photo(CAMERA, scene(x=0.25 + 0.003 * k, y=0.12), k)
        near, all_of_it = tracker.track(picture, 1.0 + k / 30), whole.track(picture, 1.0 + k / 5)
        assert isinstance(near, BodyPose)
        assert isinstance(all_of_it, BodyPose)
        assert np.allclose(near.position, all_of_it.position, atol=1e-4)
    # A second sheet elsewhere is noticed with the next whole search, three pictures later at most.
    picture = with_sheet(picture, 12)
    results = [tracker.track(picture, 1.0 + k / 30) for k in range(10, 13)]
    assert "seen twice" in reason(results[-1])


def test_a_sheet_that_is_seen_only_while_the_robot_is_not_is_no_robot(tracker: BodyTracker) -> None:
    there = with_sheet(photo(CAMERA, AWAY), 12, at=(30, 250), cell=7)
    assert isinstance(tracker.track(photo(CAMERA, HERE), 1.0), BodyPose)
    assert "m away 33 ms ago: another sheet with its number" in reason(tracker.track(there, 1.033))
    # Who was carried there stays there.
    results = [tracker.track(there, 1.1 + k / 30) for k in range(12)]
    assert isinstance(results[5], BodyLost)
    assert isinstance(results[-1], BodyPose)


@pytest.mark.parametrize("share", [0.75, 0.9])
def test_a_zoom_or_crop_in_the_old_size_ends_poses(tracker: BodyTracker, share: float) -> None:
    first = tracker.track(photo(CAMERA, HERE), 1.0)
    assert isinstance(first, BodyPose)
    results = [tracker.track(cropped(photo(CAMERA, HERE, k), share), 1.1 + k / 30) for k in range(25)]
    assert not any(isinstance(result, BodyPose) for result in results)
    assert f"origin tag 0 looks {1 / share:.2f} times as large as before" in reason(results[-1])
    back = [tracker.track(photo(CAMERA, HERE, k), 3.0 + k / 30) for k in range(20)]
    assert isinstance(back[-1], BodyPose)
    assert np.allclose(back[-1].position, first.position, atol=3e-3)


def test_a_camera_that_was_moved_while_the_origin_was_hidden_is_noticed(tracker: BodyTracker) -> None:
    robot = HERE
    assert isinstance(tracker.track(photo(CAMERA, robot), 1.0), BodyPose)

    def hidden(camera: OverheadCamera) -> np.ndarray:
        picture = photo(camera, robot, 3)
        picture[140:220, 280:360] = 90
        return picture

    assert isinstance(tracker.track(hidden(CAMERA), 1.1), BodyPose)
    for aside in (0.01, 0.05):
        moved = OverheadCamera(replace(SMALL, look_at=(aside, 0.0, 0.0)), seed=2)
        assert "the view has moved while origin tag 0 was hidden" in reason(tracker.track(hidden(moved), 1.2))
    assert isinstance(tracker.track(photo(CAMERA, robot), 1.3), BodyPose)
    assert isinstance(tracker.track(hidden(CAMERA), 1.4), BodyPose)


@pytest.mark.parametrize(("declared", "said"), [(0.025, "would be 0.4"), (0.06, "would be −0.1")])
def test_a_body_at_an_impossible_height_is_lost(declared: float, said: str) -> None:
    tracker = BodyTracker(TagSetup(body_size=declared), CAMERA.intrinsics)
    settle(tracker, CAMERA)
    words = reason(tracker.track(photo(CAMERA, HERE), 1.0))
    assert said in words
    assert "m above the floor: is it carried, or are a tag's size, the lens or the picture's size" in words


def test_a_tag_that_leans_otherwise_than_the_imu_says_gives_no_pose(tracker: BodyTracker) -> None:
    leaning = photo(CAMERA, scene(roll=0.6))
    assert isinstance(tracker.track(leaning, 1.0, (0.6, 0.0)), BodyPose)
    assert "otherwise than the IMU says" in reason(tracker.track(leaning, 1.1, (-0.3, 0.0)))


def test_a_mirrored_picture_and_a_tag_of_another_family_are_named() -> None:
    mirrored = BodyTracker(TagSetup(), CAMERA.intrinsics)
    pictures = [np.ascontiguousarray(photo(CAMERA, HERE, k)[:, ::-1]) for k in range(17)]
    said = [reason(mirrored.track(picture, k / 30)) for k, picture in enumerate(pictures)]
    assert said[-1] == "origin tag 0 not seen yet; the picture is mirrored: switch that off in the camera's settings"
    other = replace(SMALL, origin=replace(MIDDLE, family="tag36h11"), body=TagOnRobot("tag36h11", 12))
    camera, tracker = OverheadCamera(other, seed=2), BodyTracker(TagSetup(), CAMERA.intrinsics)
    said = [reason(tracker.track(photo(camera, HERE, k), k / 30)) for k in range(17)]
    assert "of the family tag36h11 is there: is camera.tag_family = 'tagCircle21h7' right?" in said[-1]


# ---- through a network camera's stream --------------------------------------------------------------------------------


@contextlib.contextmanager
def stream(picture: Callable[[int], bytes], *, length: bool = True, fps: float = 20.0) -> Iterator[str]:
    """The address of a network camera that sends these JPEGs, with or without their lengths."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def log_message(self, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", 'multipart/x-mixed-replace; boundary="--frame"')
            self.end_headers()
            k = 0
            with contextlib.suppress(OSError):
                while not stop.is_set():
                    data = picture(k)
                    told = b"Content-Length: %d\r\n" % len(data) if length else b""
                    self.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\n" + told + b"\r\n" + data + b"\r\n")
                    k += 1
                    time.sleep(1 / fps)

    stop = threading.Event()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/video?high"
    finally:
        stop.set()
        server.shutdown()
        thread.join()
        server.server_close()


def jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


PICTURES = [CAMERA.picture(k, k / 30, HERE) for k in range(4)]


def watched(
    eye: BodyCamera, until: Callable[[list[BodyPose | BodyLost]], bool]
) -> tuple[list[BodyPose | BodyLost], str]:
    results, news, give_up = list[BodyPose | BodyLost](), list[str](), time.monotonic() + 20
    while not until(results) and time.monotonic() < give_up:
        results += eye.poses()
        news += [said for said in [eye.news()] if said]
        time.sleep(0.02)
    return results, "\n".join(news)


@pytest.mark.parametrize(
    ("change", "length"),
    [
        (lambda p: p[:, 80:560], True),  # another mode of the sensor
        (lambda p: cv2.rotate(p, cv2.ROTATE_90_CLOCKWISE), False),  # a telephone that was turned
        (lambda p: cv2.resize(p, (320, 180)), True),  # a camera that saves on a slow line
    ],
)
def test_a_stream_that_changes_its_picture_gives_no_pose_from_then_on(
    change: Callable[[np.ndarray], np.ndarray], length: bool
) -> None:
    before, after = [jpeg(p) for p in PICTURES], [jpeg(np.ascontiguousarray(change(p))) for p in PICTURES]
    with stream(lambda k: (before if k < 24 else after)[k % 4], length=length) as url:
        eye = BodyCamera(CameraConfig(CameraSettings(url, latency_s=0.05), TagSetup(), CAMERA.intrinsics), RealClock())
        try:
            results, said = watched(
                eye, lambda seen: bool(seen) and "the picture is" in getattr(seen[-1], "reason", "")
            )
            poses = [result for result in results if isinstance(result, BodyPose)]
            assert poses
            assert all(np.allclose(pose.position, [0.25, 0.12, 0.15], atol=0.01) for pose in poses)
            height, width = change(PICTURES[0]).shape[:2]
            assert f"the picture is {width}×{height} now, it was 640×360" in reason(results[-1])
            more, news = watched(eye, lambda seen: len(seen) > 15)
            assert not any(isinstance(result, BodyPose) for result in more)
            assert f"no pose of the robot for 0.5 s: the picture is {width}×{height} now" in said + news
        finally:
            eye.close()


def test_the_same_picture_twice_is_one_and_for_long_a_camera_that_hangs() -> None:
    data = [jpeg(picture) for picture in PICTURES]
    with stream(lambda k: data[k // 2 % 4] if k < 30 else data[0]) as url:
        driver = Camera(CameraSettings(url), RealClock())
        driver.open()
        try:
            frames = [driver.wait(time.monotonic() + 5) for _ in range(8)]
            assert all(not np.array_equal(a.image, b.image) for a, b in itertools.pairwise(frames))
            give_up = time.monotonic() + 10
            while driver.fault() is None and time.monotonic() < give_up:
                time.sleep(0.05)
            assert "the camera repeats one picture" in str(driver.fault())
        finally:
            driver.close()


def test_lengths_and_boundaries_that_cannot_be_are_no_pictures() -> None:
    with stream(lambda k: b"no picture" * (k + 1)) as url, pytest.raises(HardwareFault, match="sends no picture"):
        Camera(CameraSettings(url), RealClock()).open()
