"""What measures the body while the engine moves the joints: IMU and overhead camera, taken in between two cycles."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.body_imu import BodyImu
from openant_tools.comms.clock import Clock
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.recorder import Recorder
from openant_tools.errors import HardwareFault, OpenAntError

if TYPE_CHECKING:
    from openant_tools.comms.body_camera import BodyCamera
    from openant_tools.comms.camera_process import CameraProcess
    from openant_tools.comms.tags import BodyPose

    Sensor: TypeAlias = BodyImu | BodyCamera | CameraProcess

__all__ = ["BodySensors"]

#: rad. No body whose tag is seen from above leans farther.
STEEP_RAD = np.pi / 4
#: The IMU's port is left alone for so long before a cycle begins, where time does not wait for us.
IMU_SLACK_S = 0.3e-3
#: s; an older pose is not where the robot is now. A camera of 30 pictures a second and 0.1 s latency is within it.
FRESH_S = 0.25
#: s until a sensor that did not answer when the robot was connected is tried again
RETRY_S = 5.0
_NAN = float("nan")


class BodySensors:
    """The sensors of one robot, as far as it has them.

    Attributes:
        imu, camera: None where there is none, or none that answers yet, which has been told.
    """

    def __init__(self) -> None:
        self.imu: BodyImu | None = None
        self.camera: BodyCamera | CameraProcess | None = None
        #: where the body was seen last; None where it was lost since
        self._pose: BodyPose | None = None
        self._imu_calibrated = False
        self._slack_s = IMU_SLACK_S
        self._awaited: list[_Awaited] = []
        self._news: list[str] = []
        #: kind of the reason for which no pose is seen, as the recording was told; empty while poses come
        self._pose_lost = ""

    def open(self, config: EngineConfig, clock: Clock, notice: Callable[[str], None]) -> None:
        """Connect to those that the robot has; what does not answer is told, and tried again while the robot goes on without it."""
        self._slack_s = 0.0 if clock.stepped else IMU_SLACK_S
        wanted: list[tuple[str, Callable[[], Sensor]]] = []
        if (imu := config.imu) is not None:
            self._imu_calibrated = imu.calibrated
            wanted.append(("IMU", lambda: BodyImu(imu, clock)))
        if (camera := config.camera) is not None:
            # OpenCV takes its time to load.
            from openant_tools.comms.body_camera import BodyCamera
            from openant_tools.comms.camera_process import CameraProcess

            wanted.append(("camera", lambda: BodyCamera(camera, clock) if clock.stepped else CameraProcess(camera)))
        for name, open_ in wanted:
            try:
                self._adopt(name, open_())
            except HardwareFault as error:
                notice(f"going on without the {name} until it answers: {error}")
                if not clock.stepped:  # whose time would stand still meanwhile
                    self._awaited.append(_Awaited(name, open_))
        for note in self.news():
            notice(note)

    def _adopt(self, name: str, sensor: Sensor) -> None:
        if isinstance(sensor, BodyImu):
            self.imu = sensor
        else:
            self.camera = sensor
        self._news += [f"{name}: {note}" for note in sensor.notes]

    @property
    def has_camera(self) -> bool:
        """Whether it has a camera, one that does not answer yet included."""
        return self.camera is not None or any(one.name == "camera" for one in self._awaited)

    def take_until(self, due: float, recorder: Recorder) -> None:
        """Take in samples until shortly before `due` (s), and poses that are there; record them.

        Raises:
            RecordingStopped: they cannot be recorded.
        """
        for one in [one for one in self._awaited if one.done]:
            self._awaited.remove(one)
            if one.sensor is not None:
                self._news.append(f"the {one.name} answers")
                self._adopt(one.name, one.sensor)
            else:
                self._news.append(f"going on without the {one.name}: {one.refused}")
        if self.imu is not None:
            for sample in self.imu.until(due - self._slack_s):
                if recorder.writer is not None:
                    recorder.writer.imu(*sample)
        if self.camera is not None:
            self.camera.keeping = recorder.pictures
            self._take_poses(self.camera, recorder)
            for picture in self.camera.kept():
                if recorder.writer is not None:
                    recorder.writer.picture(*picture)

    def _take_poses(self, camera: BodyCamera | CameraProcess, recorder: Recorder) -> None:
        from openant_tools.comms.tags import BodyPose

        lean = None if self.imu is None else self.imu.lean
        if lean is not None and self._may_lean(*lean[1:]):
            camera.lean(*lean)
        for seen in camera.poses():
            self._pose = seen if isinstance(seen, BodyPose) else None
            if recorder.writer is None:
                continue
            if isinstance(seen, BodyPose):
                recorder.writer.pose(
                    seen.t, position=seen.position.tolist(), yaw=seen.yaw, quaternion=seen.quaternion.tolist()
                )
            reason = "" if isinstance(seen, BodyPose) else seen.reason
            if seen.kind != self._pose_lost:
                self._pose_lost = seen.kind
                recorder.event("pose lost" if reason else "pose found", taken=seen.t, reason=reason)

    def _may_lean(self, roll: float, pitch: float) -> bool:
        """Whether a lean (rad) can be the body's: an IMU whose place nobody has measured may sit in it any way round."""
        return self._imu_calibrated or bool(np.cos(roll) * np.cos(pitch) > np.cos(STEEP_RAD))

    def news(self) -> list[str]:
        """What is wrong with them, once when it begins and from time to time while it lasts."""
        told = (sensor.news() for sensor in (self.imu, self.camera) if sensor is not None)
        news, self._news = [*self._news, *(one for one in told if one is not None)], []
        return news

    def newest(self, t: float) -> tuple[float, ...]:
        """(12,) as of `t`: the IMU's rates and accelerations, the body's x, y, z and yaw, when each was measured."""
        body = (_NAN,) * 6 if self.imu is None else self.imu.newest(t)
        pose, base = self._pose, (_NAN,) * 4
        if pose is not None and t - pose.t <= FRESH_S:
            base = (*pose.position.tolist(), pose.yaw)
        taken = _NAN if self.imu is None else self.imu.taken_at, _NAN if pose is None else pose.t
        return (*body, *base, *taken)

    def picture(self) -> NDArray[np.uint8] | None:
        return None if self.camera is None else self.camera.picture()

    def close(self) -> None:
        for one in self._awaited:
            one.give_up()
        if self.imu is not None:
            self.imu.close()
        if self.camera is not None:
            self.camera.close()


class _Awaited:
    """A sensor that did not answer, opened again and again in a thread: no cycle of the bus waits for it.

    Attributes:
        done: whether there is nothing more to wait for. sensor: open. refused: why it never will be.
    """

    def __init__(self, name: str, open_: Callable[[], Sensor]) -> None:
        self.name, self.done = name, False
        self.sensor: Sensor | None = None
        self.refused: OpenAntError | None = None
        self._open = open_
        self._given_up, self._lock = threading.Event(), threading.Lock()
        threading.Thread(target=self._try, name=f"waiting for the {name}", daemon=True).start()

    def give_up(self) -> None:
        """What was opened, or comes to be, is closed."""
        with self._lock:
            self._given_up.set()
            if self.sensor is not None:
                self.sensor.close()

    def _try(self) -> None:
        while not self._given_up.wait(RETRY_S):
            try:
                sensor = self._open()
            except HardwareFault:
                continue
            except OpenAntError as error:
                self.refused, self.done = error, True
                return
            with self._lock:
                if self._given_up.is_set():
                    sensor.close()
                else:
                    self.sensor, self.done = sensor, True
            return
