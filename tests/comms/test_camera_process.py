"""The camera's own process: what it sees, tells and keeps, and that the engine outlives it."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from test_doubtful_poses import CAMERA, HERE, PICTURES, jpeg, stream

import openant_tools.comms.body_sensors as body_sensors
from openant_tools.comms.body_camera import CameraConfig
from openant_tools.comms.body_sensors import BodySensors
from openant_tools.comms.camera import CameraSettings
from openant_tools.comms.camera_process import CameraProcess
from openant_tools.comms.clock import RealClock
from openant_tools.comms.engine_port import EnginePort
from openant_tools.comms.intrinsics import Intrinsics
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.recorder import Recorder
from openant_tools.comms.tags import BodyLost, BodyPose, TagSetup
from openant_tools.errors import BadInput, HardwareFault


def config(url: str, lens: Intrinsics | None = None) -> CameraConfig:
    return CameraConfig(CameraSettings(url, latency_s=0.05), TagSetup(), lens or CAMERA.intrinsics)


@pytest.fixture
def camera() -> Iterator[CameraProcess]:
    data = [jpeg(picture) for picture in PICTURES]
    with stream(lambda k: data[k % 4]) as url:
        found = CameraProcess(config(url))
        yield found
        found.close()


def seen(camera: CameraProcess, enough: Callable[[list[BodyPose | BodyLost]], bool]) -> list[BodyPose | BodyLost]:
    results, give_up = list[BodyPose | BodyLost](), time.monotonic() + 20
    while not enough(results) and time.monotonic() < give_up:
        results += camera.poses()
        time.sleep(0.01)
    return results


def test_poses_come_in_order_and_pictures_are_kept_when_asked(camera: CameraProcess) -> None:
    results = seen(camera, lambda found: sum(isinstance(one, BodyPose) for one in found) > 10)
    poses = [one for one in results if isinstance(one, BodyPose)]
    assert np.all(np.diff([one.t for one in results]) > 0)
    assert all(np.allclose(one.position, HERE.position, atol=0.01) for one in poses)
    assert 0.0 < time.monotonic() - poses[-1].t < 5.0
    assert camera.kept() == []
    camera.keeping = True
    kept: list[tuple[float, bytes]] = []
    seen(camera, lambda found: bool(kept.extend(camera.kept()) or len(kept) > 1))
    assert all(data.startswith(b"\xff\xd8") for _, data in kept)
    picture = camera.picture()
    assert picture is not None
    assert picture.shape == (360, 640, 3)
    assert abs(picture.astype(float).mean() - PICTURES[0].mean()) < 5


def test_who_waits_for_a_camera_that_was_killed_is_told_and_goes_on(camera: CameraProcess) -> None:
    seen(camera, bool)
    os.kill(camera.pid, signal.SIGKILL)
    give_up = time.monotonic() + 5
    while (news := camera.news()) is None and time.monotonic() < give_up:
        camera.poses()
    assert news == "the camera's process was ended from outside → start anew"
    assert camera.poses() == []
    assert camera.news() is None


def test_a_computer_that_starts_no_process_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    before = len(os.listdir("/dev/fd"))
    with pytest.raises(HardwareFault, match="camera's process cannot be started"):
        CameraProcess(config("http://127.0.0.1:9/stream.mjpg"))
    assert len(os.listdir("/dev/fd")) == before


def test_why_it_cannot_be_opened_is_told_as_without_a_process() -> None:
    with stream(lambda k: b"no picture" * (k + 1)) as url, pytest.raises(HardwareFault, match="sends no picture"):
        CameraProcess(config(url))
    data = [jpeg(picture) for picture in PICTURES]
    square = Intrinsics.from_diagonal_fov(480, 480, 60)
    with stream(lambda k: data[k % 4]) as url, pytest.raises(BadInput):
        CameraProcess(config(url, square))


def test_a_camera_that_wakes_up_late_is_taken_in_while_the_robot_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Connected anew while its camera is out, a robot is not blind for the rest of its day."""
    monkeypatch.setattr(body_sensors, "RETRY_S", 0.1)
    data, there = [jpeg(picture) for picture in PICTURES], False
    sensors, said = BodySensors(), list[str]()
    with stream(lambda k: data[k % 4] if there else b"no picture") as url:
        engine = EngineConfig("/dev/null", (), camera=config(url))
        recorder = Recorder(engine, EnginePort.__new__(EnginePort))
        sensors.open(engine, RealClock(), said.append)
        assert said[0].startswith(f"going on without the camera until it answers: {url}")
        assert sensors.camera is None
        assert sensors.has_camera
        there, cycles, give_up = True, 0, time.monotonic() + 30
        while not np.isfinite(sensors.newest(time.monotonic())[6]) and time.monotonic() < give_up:
            sensors.take_until(time.monotonic(), recorder)
            cycles += sensors.camera is None
            said += sensors.news()
            time.sleep(0.01)
        assert sensors.newest(time.monotonic())[6] == pytest.approx(HERE.position[0], abs=0.01)
        assert "the camera answers" in said
        assert cycles > 3, "none waits for it to open"
        sensors.close()


def test_who_no_longer_waits_for_a_camera_leaves_none_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_sensors, "RETRY_S", 0.0)
    opened, opening, go, closed = (threading.Event() for _ in range(4))

    class Slow:
        notes = ()

        def __init__(self, config: CameraConfig) -> None:
            if not opened.is_set():
                opened.set()
                raise HardwareFault("it sleeps")
            opening.set()
            go.wait(10)

        def close(self) -> None:
            closed.set()

    monkeypatch.setattr("openant_tools.comms.camera_process.CameraProcess", Slow)
    sensors = BodySensors()
    sensors.open(EngineConfig("/dev/null", (), camera=config("x")), RealClock(), lambda words: None)
    assert opening.wait(10)
    sensors.close()
    assert not closed.is_set()
    go.set()
    assert closed.wait(10)
    assert sensors.camera is None
