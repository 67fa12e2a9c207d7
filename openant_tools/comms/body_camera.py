"""The overhead camera: its pictures become poses, its faults are told once.

Finding tags takes 5 to 60 ms a picture, so in real time a process does it (`camera_process`). Under a stepped clock pictures are asked
for and searched in turn with everything else, so that every run is the same.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.camera import Camera, CameraInfo, CameraSettings, CameraStatistics
from openant_tools.comms.clock import Clock
from openant_tools.comms.intrinsics import Intrinsics
from openant_tools.comms.tags import BodyLost, BodyPose, BodyTracker, TagSetup
from openant_tools.errors import HardwareFault, OpenAntError
from openant_tools.numbers import number
from openant_tools.optional import cv2

__all__ = ["BodyCamera", "CameraConfig"]

#: px of a picture that is shown to somebody: a larger one takes long to hand over
WIDEST = 640
#: Of pictures that are kept: s between two at least, px of their width at most, JPEG's quality. At 1920 px an hour of them
#: would be several GB.
KEPT_EVERY_S, KEPT_WIDTH, KEPT_QUALITY = 0.2, 640, 80
#: What is wrong is said again after so long, if it is still wrong.
REPEAT_S = 10.0
#: A lost tag is normal for a picture or two (a leg above it, a blurred one).
LOST_S = 0.5
#: Attitudes older than the camera's latency are not needed any more.
LEANS = 128
#: An attitude of this age is not that of the picture.
LEAN_FRESH_S = 0.05
#: Pictures that nobody takes are given up.
QUEUE = 64


@dataclass(frozen=True)
class CameraConfig:
    """The camera, its lens and the tags.

    Attributes:
        intrinsics: as calibrated; None for a lens without distortion of `fov_diagonal_deg`.
    """

    settings: CameraSettings = field(default_factory=CameraSettings)
    tags: TagSetup = field(default_factory=TagSetup)
    intrinsics: Intrinsics | None = None
    fov_diagonal_deg: float = 60.0


class BodyCamera:
    """One overhead camera, open.

    Attributes:
        info: what the camera gives.
        keeping: whether pictures are kept for `kept`.

    Raises:
        HardwareFault: it cannot be opened or sends nothing.
        BadInput: it was calibrated for pictures of another shape.
    """

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        self._clock = clock
        self._camera = Camera(config.settings, clock)
        self.info: CameraInfo = self._camera.open()
        size = self.info.width, self.info.height
        lens = config.intrinsics or Intrinsics.from_diagonal_fov(*size, config.fov_diagonal_deg)
        try:
            self._tracker = BodyTracker(config.tags, lens.scaled(*size))
        except OpenAntError:
            self._camera.close()
            raise
        self._leans: deque[tuple[float, float, float]] = deque(maxlen=LEANS)
        self._image: NDArray[np.uint8] | None = None
        self.keeping = False
        self._kept: deque[tuple[float, bytes]] = deque(maxlen=QUEUE)
        self._kept_at = -np.inf
        # Nobody is missed before the first picture, however long the robot took to be opened.
        self._seen_at = np.inf
        self._lost = ""
        #: kind of what is wrong → when that was said last; reasons may change places with every picture
        self._said: dict[str, float] = {}
        self._error: OpenAntError | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """What a builder should know of the camera."""
        return self.info.notes

    @property
    def statistics(self) -> CameraStatistics:
        """Pictures received, dropped and skipped."""
        return self._camera.statistics

    def lean(self, t: float, roll: float, pitch: float) -> None:
        """The body's attitude at `t` by the IMU, rad; it steadies the pose of the picture taken then."""
        self._leans.append((t, roll, pitch))

    def poses(self) -> list[BodyPose | BodyLost]:
        """What became of the newest picture, if there is one since the last call; does not wait for it."""
        frame = self._camera.newest() if self._error is None else None
        if frame is None:
            return []
        self._image = frame.image
        if self.keeping and frame.t - self._kept_at > KEPT_EVERY_S - 1e-6:
            self._kept_at = frame.t
            self._kept.append((frame.t, _jpeg(frame.image)))
        try:
            result = self._tracker.track(frame.image, frame.t, self._lean_at(frame.t))
        except OpenAntError as error:  # the lens and the picture do not fit any more
            self._error = error
            return []
        if isinstance(result, BodyPose):
            self._seen_at, self._lost = self._clock.now(), ""
        else:
            self._seen_at, self._lost = min(self._seen_at, self._clock.now()), result.reason
        return [result]

    def picture(self) -> NDArray[np.uint8] | None:
        """The newest picture, (height, width, 3) in RGB, at most `WIDEST` wide; None before the first.

        Pixels are left out to fit, not averaged.
        """
        image = self._image
        if image is None:
            return None
        every = -(-image.shape[1] // WIDEST)
        few = image[::every, ::every]
        return np.ascontiguousarray(few[..., ::-1] if few.ndim == 3 else np.repeat(few[..., None], 3, axis=2))

    def kept(self) -> list[tuple[float, bytes]]:
        """The pictures kept since the last call: s when each was taken, and its JPEG."""
        return [self._kept.popleft() for _ in range(len(self._kept))]

    def news(self) -> str | None:
        """What is wrong, once when it begins and from time to time while it lasts or comes again."""
        fault: OpenAntError | None = self._error or self._camera.fault()
        now = self._clock.now()
        if fault is None and now - self._seen_at > LOST_S and self._lost:
            # What stands after a colon says what to do already.
            remedy = (
                None
                if ": " in self._lost or "; " in self._lost
                else "look at the picture: light, focus, and both tags in view"
            )
            fault = HardwareFault(
                f"no pose of the robot for {number(now - self._seen_at, 's', decimals=1)}: {self._lost}", remedy=remedy
            )
        if fault is None:
            return None
        kind = re.sub(r"\d", "", fault.what)
        if now - self._said.get(kind, -np.inf) < REPEAT_S:
            return None
        self._said[kind] = now
        return str(fault)

    def close(self) -> None:
        """Let go of the camera."""
        self._camera.close()

    def _lean_at(self, t: float) -> tuple[float, float] | None:
        near = min(self._leans, key=lambda lean: abs(lean[0] - t), default=None)
        return None if near is None or abs(near[0] - t) > LEAN_FRESH_S else (near[1], near[2])


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    height, width = image.shape[:2]
    if width > KEPT_WIDTH:
        image = cv2.resize(image, (KEPT_WIDTH, round(height * KEPT_WIDTH / width)), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, KEPT_QUALITY])[1])
