"""What measures the body while the engine moves the joints: IMU and overhead camera, taken in between two cycles."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.body_imu import BodyImu
from openant_tools.comms.clock import Clock
from openant_tools.comms.messages import EngineConfig
from openant_tools.comms.recorder import Recorder
from openant_tools.errors import HardwareFault

if TYPE_CHECKING:
    from openant_tools.comms.body_camera import BodyCamera
    from openant_tools.comms.camera_process import CameraProcess
    from openant_tools.comms.tags import BodyPose

__all__ = ["BodySensors"]

#: rad. No body whose tag is seen from above leans farther.
STEEP_RAD = np.pi / 4
#: The IMU's port is left alone for so long before a cycle begins, where time does not wait for us.
IMU_SLACK_S = 0.3e-3
#: s; an older pose is not where the robot is now. A camera of 30 pictures a second and 0.1 s latency is within it.
FRESH_S = 0.25
_NAN = float("nan")


class BodySensors:
    """The sensors of one robot, as far as it has them.

    Attributes:
        imu, camera: None where there is none, or none that answers, which has been told.
    """

    def __init__(self) -> None:
        self.imu: BodyImu | None = None
        self.camera: BodyCamera | CameraProcess | None = None
        #: where the body was seen last; None where it was lost since
        self._pose: BodyPose | None = None
        self._imu_calibrated = False
        self._slack_s = IMU_SLACK_S
        #: kind of the reason for which no pose is seen, as the recording was told; empty while poses come
        self._pose_lost = ""

    def open(self, config: EngineConfig, clock: Clock, notice: Callable[[str], None]) -> None:
        """Connect to those that the robot has; what does not answer is told, and left out."""
        self._slack_s = 0.0 if clock.stepped else IMU_SLACK_S
        if config.imu is not None:
            self._imu_calibrated = config.imu.calibrated
            try:
                self.imu = BodyImu(config.imu, clock)
                for note in self.imu.notes:
                    notice(f"IMU: {note}")
            except HardwareFault as error:
                notice(f"going on without the IMU: {error}")
        if config.camera is not None:
            # OpenCV takes its time to load.
            from openant_tools.comms.body_camera import BodyCamera
            from openant_tools.comms.camera_process import CameraProcess

            try:
                self.camera = BodyCamera(config.camera, clock) if clock.stepped else CameraProcess(config.camera)
                for note in self.camera.notes:
                    notice(f"camera: {note}")
            except HardwareFault as error:
                notice(f"going on without the camera: {error}")

    def take_until(self, due: float, recorder: Recorder) -> None:
        """Take in samples until shortly before `due` (s), and poses that are there; record them.

        Raises:
            RecordingStopped: they cannot be recorded.
        """
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
        return [news for news in told if news is not None]

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
        if self.imu is not None:
            self.imu.close()
        if self.camera is not None:
            self.camera.close()
