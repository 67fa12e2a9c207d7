"""The overhead camera: pictures with the time they were taken, what the camera really gives, and what it lost.

Two kinds of source behind one face:

* a stream of JPEG pictures (`http://…/stream.mjpg`) or an OpenCV capture (`0`, `/dev/video2`, `rtsp://…`), read by a
  thread that keeps the newest picture only;
* under a stepped clock, a virtual camera's snapshots, asked for the moment in question.

When was it taken? Video4Linux stamps buffers with the machine's monotonic clock, and those stamps are used where they
are sound. Any other picture is taken to be `latency_s` older than its arrival: a number to be measured (`latency.py`,
the spin on the floor) and stored with the robot; until then it is the sum of what is always there (exposure, transfer,
decoding), and `CameraInfo` says that it is a guess.

Lost pictures leave no gap in OpenCV's numbering, only in time: see `DropCounter`.
"""

from __future__ import annotations

import http.client
import math
import os
import platform
import threading
import time
import urllib.parse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.clock import Clock
from openant_tools.comms.mjpeg import MjpegStream
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.numbers import literal, number
from openant_tools.optional import cv2

__all__ = [
    "Camera",
    "CameraInfo",
    "CameraSetting",
    "CameraSettings",
    "CameraStatistics",
    "DropCounter",
    "Frame",
    "look",
]

Image = NDArray[np.uint8]

#: A webcam's exposure, USB transfer and decoding, where nothing was measured.
TYPICAL_LATENCY_S = 0.07
#: s that a source may take to open, a picture to come, and the first one to come; OpenCV waits 30 s unless told
OPEN_TIMEOUT_S = 5.0
READ_TIMEOUT_S = 2.0
FIRST_FRAME_TIMEOUT_S = 5.0
#: s between two tries to open a source that is gone
REOPEN_EVERY_S = 1.0
#: A sensor's noise makes no two pictures alike: this long without any change, the camera or its driver hangs.
FROZEN_S = 0.5
#: and so many pictures at least: a slow camera sends few within that time
FROZEN_FRAMES = 5
#: No picture for this long and for this many periods: the stream has stopped.
STALLED_S = 0.3
STALLED_PERIODS = 5
#: A kernel stamp is believed if it lies this far back at most.
KERNEL_STAMP_WINDOW_S = 1.0


@dataclass(frozen=True)
class CameraSettings:
    """What is asked of the camera.

    Attributes:
        source: a number, a device path, or a URL.
        width, height, fps, fourcc: None leaves what the camera has. Full HD over USB 2 needs MJPG.
        exposure: in the driver's unit (Video4Linux: 0.1 ms) with automatic exposure off; None leaves it automatic.
        focus: fixed, in the driver's unit; None leaves it.
        latency_s: from exposure to arrival, as measured; None where it was not.
    """

    source: str | int = 0
    width: int | None = 1920
    height: int | None = 1080
    fps: float | None = 30.0
    fourcc: str | None = "MJPG"
    exposure: float | None = None
    focus: float | None = None
    latency_s: float | None = None

    @property
    def network(self) -> bool:
        """Whether the source is an address: such a camera has its own settings."""
        return isinstance(self.source, str) and "://" in self.source

    @property
    def name(self) -> str:
        """What the source is called in messages."""
        return f"camera {self.source}" if isinstance(self.source, int) else self.source


@dataclass(frozen=True)
class CameraSetting:
    """One thing asked, and what the camera says it does."""

    name: str
    asked: float | str
    given: float | str

    @property
    def kept(self) -> bool:
        """Whether it does what was asked."""
        if isinstance(self.asked, str) or isinstance(self.given, str):
            return self.asked == self.given
        return abs(self.asked - self.given) <= 0.01 * abs(self.asked) + 1e-9

    @property
    def words(self) -> str:
        """Both, for reading."""
        given, asked = (one if isinstance(one, str) else literal(one) for one in (self.given, self.asked))
        return f"{self.name} {given} instead of {asked}"


@dataclass(frozen=True)
class CameraInfo:
    """What was opened.

    Attributes:
        width, height: of the pictures that come, px (not of what the driver promised).
        settings: asked and given. latency_s, latency_source: "measured", "kernel stamp" or "guess".
        notes: what a builder should know, in whole sentences.
    """

    backend: str
    width: int
    height: int
    settings: tuple[CameraSetting, ...]
    latency_s: float
    latency_source: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Frame:
    """A picture.

    Attributes:
        image: (h, w, 3), blue green red.
        t: when it was taken, s, on the clock. arrived: when it was here.
        index: counts pictures received since `open`.
    """

    image: Image
    t: float
    arrived: float
    index: int


class DropCounter:
    """Counts periods without a picture, from the times of those that came.

    Every few seconds the camera's period is found anew, as the one with which the times are most in phase (Rayleigh's
    statistic): missing pictures do not disturb that, nor does jitter below a third of a period. The pictures are then
    laid on that grid, and cells without one are drops. A late picture leaves no gap: only the whole count matters.

    Attributes:
        received, dropped: pictures. period: of the camera, s, None until known.
    """

    BLOCK = 120
    WARM_UP = 30

    def __init__(self) -> None:
        self.received = 0
        self.period: float | None = None
        self._settled = 0
        self._times: list[float] = []
        self._grid: float | None = None  # time on the grid of the last picture of the blocks before

    def add(self, t: float) -> None:
        """A picture with this time stamp (of exposure or arrival), s."""
        self.received += 1
        self._times.append(t)
        if len(self._times) == self.BLOCK or (self.period is None and len(self._times) == self.WARM_UP):
            self._close()

    @property
    def dropped(self) -> int:
        """Pictures that never came."""
        if self.period is None or self._grid is None or not self._times:
            return self._settled
        cells = round((self._times[-1] - self._grid) / self.period)
        return self._settled + max(0, cells - len(self._times))

    @property
    def share(self) -> float:
        """Of the pictures that the camera should have sent, those that never came."""
        return self.dropped / max(1, self.received + self.dropped)

    @property
    def fps(self) -> float:
        """Pictures a second that the camera makes, lost ones included; 0 until known."""
        return 1.0 / self.period if self.period else 0.0

    def pause(self) -> None:
        """The stream was interrupted: what is missing from here on is no drop, and the phase will be new."""
        self._settled = self.dropped
        self._times = []
        self._grid = None

    def _close(self) -> None:
        """Lay a block of pictures on its grid."""
        times = np.asarray(self._times)
        self._times = []
        gap = float(np.median(np.diff(times)))
        if gap <= 0.0:
            return
        # Up to every second picture may be missing before the median gap is two periods.
        frequencies = np.arange(0.7 / gap, 2.3 / gap, 1.0 / (8.0 * np.ptp(times)))
        phases = np.exp(-2j * np.pi * np.outer(frequencies, times - times[0])).mean(axis=1)
        score = np.abs(phases)
        # Every multiple of the true frequency fits as well: the lowest is meant.
        first = int(np.argmax(score >= 0.7 * score.max()))
        peak = first + int(np.argmax(score[first : first + 16]))
        period = 1.0 / float(frequencies[peak])
        on_grid = times[0] - float(np.angle(phases[peak])) / (2 * math.pi) * period
        last = on_grid + round((float(times[-1]) - on_grid) / period) * period
        if self._grid is None:
            first_cell = on_grid + round((float(times[0]) - on_grid) / period) * period
            self._grid = first_cell - period
        self.period = period
        self._settled = max(0, self._settled + round((last - self._grid) / period) - len(times))
        self._grid = last


@dataclass
class CameraStatistics:
    """Since `open`. `dropped` are pictures that never came, `skipped` those that nobody asked for in time."""

    received: int = 0
    dropped: int = 0
    skipped: int = 0
    reopened: int = 0
    fps: float = 0.0


class _Source(Protocol):
    def info(self) -> CameraInfo: ...
    def newest(self) -> Frame | None: ...
    def statistics(self) -> CameraStatistics: ...
    def fault(self) -> HardwareFault | None: ...
    def close(self) -> None: ...


class Camera:
    """The driver. `open` first; then `newest` whenever a picture is wanted.

    Args:
        settings: what to ask for.
        clock: the time that pictures are stamped with.
    """

    def __init__(self, settings: CameraSettings, clock: Clock) -> None:
        self.settings = settings
        self._clock = clock
        self._source: _Source | None = None
        self._taken = -1

    def open(self) -> CameraInfo:
        """Open the source, set it, read back what it does, and wait for its first picture.

        Raises:
            HardwareFault: no such camera, held by another program, or no pictures.
            BadInput: a source that this clock cannot use.
        """
        self.close()
        self._taken = -1
        if self._clock.stepped:
            self._source = _Snapshots(self.settings, self._clock)
        else:
            self._source = _Capture(self.settings, self._clock)
        return self._source.info()

    @property
    def info(self) -> CameraInfo:
        """What `open` found."""
        return self._opened().info()

    @property
    def statistics(self) -> CameraStatistics:
        """Counts since `open`."""
        return self._opened().statistics()

    def newest(self) -> Frame | None:
        """The newest picture if it was not returned before, else None. Never waits for one."""
        frame = self._opened().newest()
        if frame is None or frame.index <= self._taken:
            return None
        self._taken = frame.index
        return frame

    def wait(self, deadline: float) -> Frame:
        """The next picture that was not returned before.

        Raises:
            HardwareFault: none came by the deadline; the message says why.
        """
        while True:
            frame = self.newest()
            if frame is not None:
                return frame
            if self._clock.now() >= deadline:
                raise self.fault() or HardwareFault(
                    "no picture by the deadline", where=self.settings.name, remedy="look at the camera's cable"
                )
            self._clock.sleep_until(min(deadline, self._clock.now() + 0.005))

    def fault(self) -> HardwareFault | None:
        """What is wrong at this moment, or None: unplugged, no pictures, or always the same one."""
        return self._opened().fault()

    def close(self) -> None:
        """Let go of the camera."""
        if self._source is not None:
            self._source.close()
            self._source = None

    def _opened(self) -> _Source:
        if self._source is None:
            raise HardwareFault("the camera is not open", where=self.settings.name)
        return self._source


def look(settings: CameraSettings, clock: Clock) -> CameraInfo:
    """What a camera's first picture is like; it is closed again. Raises as `Camera.open`."""
    camera = Camera(settings, clock)
    try:
        return camera.open()
    finally:
        camera.close()


class _Frozen:
    """Notices pictures that do not change."""

    def __init__(self) -> None:
        self._last: Image | None = None
        self._since = 0.0
        self._same = 0

    def add(self, image: Image, t: float) -> bool:
        """Whether it is another picture than the one before, not the same once more."""
        if self._last is not None and np.array_equal(image, self._last):
            self._same += 1
            return False
        self._last, self._since, self._same = image, t, 0
        return True

    def fault(self, now: float, name: str) -> HardwareFault | None:
        if self._same < FROZEN_FRAMES or now - self._since < FROZEN_S:
            return None
        return HardwareFault(
            f"the camera repeats one picture for {number(now - self._since, 's', decimals=1)}",
            where=name,
            remedy="its driver hangs: unplug the camera and plug it in again",
        )


# --- OpenCV ------------------------------------------------------------------------------------------------------


class _Capture:
    """An OpenCV capture and the thread that empties it."""

    def __init__(self, settings: CameraSettings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self._lock = threading.Condition()
        self._stop = False
        self._newest: Frame | None = None
        self._given = -1
        self._arrived = 0.0
        self._count = 0
        self._drops = DropCounter()
        self._frozen = _Frozen()
        self._statistics = CameraStatistics()
        self._connected = True
        self._timed_out = False
        capture, self._asked = _open(settings)
        self._kernel_stamps = True
        self._thread = threading.Thread(target=self._run, args=(capture,), name="camera", daemon=True)
        self._thread.start()
        self._info = self._wait_for_first(capture.getBackendName())

    def _wait_for_first(self, backend: str) -> CameraInfo:
        with self._lock:
            self._lock.wait_for(lambda: self._newest is not None or not self._connected, FIRST_FRAME_TIMEOUT_S)
            frame = self._newest
        if frame is None:
            self.close()
            raise HardwareFault(
                "the camera opens but sends no picture",
                where=self._settings.name,
                remedy="close other programs that use it, try a smaller picture, or another USB port",
            )
        height, width = frame.image.shape[:2]
        settings = list(self._asked)
        notes = []
        for name, asked, given in (
            ("width", self._settings.width, width),
            ("height", self._settings.height, height),
        ):
            if asked is not None and not self._settings.network:
                settings.append(CameraSetting(name, float(asked), float(given)))
        refused = [setting.words for setting in settings if not setting.kept]
        if refused:
            notes.append(f"The camera does not do what was asked: {', '.join(refused)}.")
        latency, source = self._latency()
        if source == "guess":
            notes.append(f"The camera's latency is taken to be {number(latency, 's')} until it is measured.")
        return CameraInfo(backend, width, height, tuple(settings), latency, source, tuple(notes))

    def _latency(self) -> tuple[float, str]:
        if self._settings.latency_s is not None:
            return self._settings.latency_s, "measured"
        if self._kernel_stamps:
            return 0.0, "kernel stamp"
        return TYPICAL_LATENCY_S, "guess"

    def info(self) -> CameraInfo:
        return self._info

    def newest(self) -> Frame | None:
        with self._lock:
            if self._newest is not None:
                self._given = self._newest.index
            return self._newest

    def statistics(self) -> CameraStatistics:
        with self._lock:
            s = self._statistics
            return CameraStatistics(self._count, self._drops.dropped, s.skipped, s.reopened, self._drops.fps)

    def fault(self) -> HardwareFault | None:
        now = self._clock.now()
        name = self._settings.name
        with self._lock:
            age = now - self._arrived if self._newest else 0.0
            if not self._connected and not self._timed_out:
                return HardwareFault(
                    "the camera is unplugged or closed its stream", where=name, remedy="look at its cable"
                )
            if age > max(STALLED_S, STALLED_PERIODS * (self._drops.period or 0.0)):
                return HardwareFault(
                    f"the camera has sent no picture for {number(age, 's', decimals=1)}",
                    where=name,
                    remedy="look at its cable; a dark room makes some webcams slow",
                )
            return self._frozen.fault(now, name)

    def close(self) -> None:
        with self._lock:
            self._stop = True
        # A read that hangs in the driver ends by its own timeout; the thread is a daemon and holds nothing else.
        self._thread.join(READ_TIMEOUT_S + 1.0)

    def _run(self, capture: Any) -> None:
        try:
            while not self._stop:
                if not capture.grab():
                    capture.release()
                    capture = self._reopen()
                    continue
                arrived = self._clock.now()
                stamp = self._stamp(capture, arrived)
                ok, image = capture.retrieve()
                if ok and image is not None:
                    self._publish(np.asarray(image, np.uint8), arrived, stamp)
        finally:
            if capture is not None:
                capture.release()

    def _stamp(self, capture: Any, arrived: float) -> float | None:
        """The kernel's time of this buffer, where it is on our clock."""
        if not self._kernel_stamps:
            return None
        if capture.getBackendName() != "V4L2" or self._clock.stepped:
            self._kernel_stamps = False
            return None
        stamp = float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0
        if 0.0 <= arrived - stamp <= KERNEL_STAMP_WINDOW_S:
            return stamp
        self._kernel_stamps = stamp <= 0.0  # the first buffer has no stamp yet; any other clock is not ours
        return None

    def _publish(self, image: Image, arrived: float, stamp: float | None) -> None:
        with self._lock:
            self._arrived = arrived
            self._connected = True
            self._drops.add(arrived if stamp is None else stamp)
            if not self._frozen.add(image, arrived):
                self._lock.notify_all()
                return  # the same picture once more is not where the robot is now
            if (
                stamp is not None
                and self._newest is not None
                and stamp - (self._settings.latency_s or 0.0) <= self._newest.t
            ):
                self._kernel_stamps, stamp = False, None  # stamps that stand still or run back are none
            latency, _ = self._latency()
            if self._newest is not None and self._given < self._newest.index:
                self._statistics.skipped += 1
            t = arrived - latency if stamp is None else stamp - (self._settings.latency_s or 0.0)
            self._newest = Frame(image, t, arrived, self._count)
            self._count += 1
            self._lock.notify_all()

    def _reopen(self) -> Any:
        with self._lock:
            self._timed_out = self._newest is not None and self._clock.now() - self._arrived > 0.8 * READ_TIMEOUT_S
            self._connected = False
            self._drops.pause()
            self._lock.notify_all()
        while not self._stop:
            time.sleep(REOPEN_EVERY_S / 2)
            try:
                # The same way as at first: a camera that was plugged in again has forgotten size, format and exposure.
                capture, _ = _open(self._settings)
            except HardwareFault:
                continue
            with self._lock:
                self._statistics.reopened += 1
            return capture
        return None


def _open(settings: CameraSettings) -> tuple[Any, list[CameraSetting]]:
    """An opened and set capture, and what it made of what was asked.

    Raises:
        HardwareFault: it cannot be opened.
    """
    source, backend = settings.source, cv2.CAP_ANY
    params: list[int] = []
    if settings.network:
        try:
            return MjpegStream(str(source), OPEN_TIMEOUT_S, READ_TIMEOUT_S), []
        except (OSError, ValueError, http.client.HTTPException):
            pass  # another kind of stream, which FFmpeg may know; what keeps it from opening is said below
        backend = cv2.CAP_FFMPEG
        params = [
            *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, int(OPEN_TIMEOUT_S * 1000)),
            *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, int(READ_TIMEOUT_S * 1000)),
            # Decoding in parallel holds back a picture a thread.
            *(cv2.CAP_PROP_N_THREADS, 1),
        ]
    elif platform.system() == "Linux":
        backend = cv2.CAP_V4L2
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(int(READ_TIMEOUT_S)))
    # Both libraries print to the terminal what is raised here as an error.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        capture = cv2.VideoCapture(source, backend, params)
    except cv2.error as error:
        raise HardwareFault(str(error.err), where=settings.name) from None
    if not capture.isOpened():
        capture.release()
        what, remedy = _why_not(settings)
        raise HardwareFault(what, where=settings.name, remedy=remedy)
    asked: list[CameraSetting] = []
    if settings.network:
        return capture, asked
    if settings.fourcc is not None:
        # First the format: the sizes and rates that a camera offers depend on it.
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.fourcc))
    manual = settings.exposure is not None
    wanted: list[tuple[str, int, float | None]] = [
        ("width", cv2.CAP_PROP_FRAME_WIDTH, settings.width),
        ("height", cv2.CAP_PROP_FRAME_HEIGHT, settings.height),
        ("fps", cv2.CAP_PROP_FPS, settings.fps),
        ("buffers", cv2.CAP_PROP_BUFFERSIZE, 1),
        # Video4Linux's menu: 1 manual, 3 automatic.
        ("automatic exposure", cv2.CAP_PROP_AUTO_EXPOSURE, 1.0 if manual else None),
        ("exposure", cv2.CAP_PROP_EXPOSURE, settings.exposure),
        ("automatic focus", cv2.CAP_PROP_AUTOFOCUS, 0.0 if settings.focus is not None else None),
        ("focus", cv2.CAP_PROP_FOCUS, settings.focus),
    ]
    for name, prop, value in wanted:
        if value is None:
            continue
        capture.set(prop, value)
        # Sizes are read off the first picture; a driver that keeps more buffers is emptied by the thread.
        if name not in ("width", "height", "buffers"):
            asked.append(CameraSetting(name, float(value), float(capture.get(prop))))
    if settings.fourcc is not None:
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        given = code.to_bytes(4, "little", signed=code < 0).decode("ascii", "replace")
        asked.insert(0, CameraSetting("format", settings.fourcc, given))
    return capture, asked


def _why_not(settings: CameraSettings) -> tuple[str, str]:
    """What is wrong with a source that does not open, and what to do."""
    source = settings.source
    if settings.network:
        return (
            "no picture stream answers at this address",
            "open it in a browser: is the camera on, is the address right?",
        )
    if platform.system() == "Linux":
        path = f"/dev/video{source}" if isinstance(source, int) else source
        if not os.path.exists(path):
            there = ", ".join(sorted(str(p) for p in Path("/dev").glob("video*"))) or "none"
            return f"there is no {path}", f"plug the camera in; cameras that are there: {there}"
        if not os.access(path, os.R_OK | os.W_OK):
            return f"{path} may not be opened by this user", "sudo usermod -aG video $USER, then log in again"
        return f"{path} does not open", "another program holds it (`fuser " + path + "`), or it is no picture source"
    return "this camera does not open", "allow the terminal to use the camera, and close other programs that do"


# --- snapshots of a stepped robot ----------------------------------------------------------------------------------


class _Snapshots:
    """A virtual camera under a stepped clock: asked for what was delivered by now, and always the same at every run."""

    def __init__(self, settings: CameraSettings, clock: Clock) -> None:
        if not settings.network:
            raise BadInput(
                f"a stepped clock cannot watch {settings.name}",
                remedy="name a virtual robot's camera, or run in real time",
            )
        self._settings = settings
        self._clock = clock
        url = urllib.parse.urlparse(str(settings.source))
        self._http = http.client.HTTPConnection(url.hostname or "127.0.0.1", url.port or 80, timeout=30.0)
        self._frame: Frame | None = None
        # Number of the exposure, and how many pictures were delivered until then.
        self._first = self._last = (-1, -1)
        self._count = 0
        self._frozen = _Frozen()
        self._gone = False
        #: before this time there is no other picture than the last
        self._next = -math.inf
        self._began = self._arrived = clock.now()
        while (frame := self.newest()) is None:
            if clock.now() - self._began > FIRST_FRAME_TIMEOUT_S or self._gone:
                raise HardwareFault("no picture comes", where=settings.name, remedy="look at the camera's cable")
            clock.sleep_until(clock.now() + 0.02)
        height, width = frame.image.shape[:2]
        self._first = self._last
        self._info = CameraInfo("snapshots", width, height, (), 0.0, "kernel stamp", ())

    def info(self) -> CameraInfo:
        return self._info

    def newest(self) -> Frame | None:
        now = self._clock.now()
        if now < self._next:
            return self._frame
        self._clock.sleep_until(now)  # what was sent to the robot so far has its effect first
        try:
            self._http.request("GET", f"/snapshot.jpg?at={now:.9f}")  # for a file
            answer = self._http.getresponse()
            data = answer.read()
        except (OSError, http.client.HTTPException):
            self._gone = True
            self._http.close()
            return None
        self._gone = False
        if answer.status != 200:
            return None
        self._next = float(answer.headers["X-Next"])
        number = (int(answer.headers["X-Frame"]), int(answer.headers["X-Ordinal"]))
        if number != self._last:
            image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            if image is None:
                return self._frame
            self._last = number
            arrived = float(answer.headers["X-Delivered"])
            self._arrived = arrived
            if not self._frozen.add(np.asarray(image, np.uint8), arrived):
                return self._frame  # the same picture once more is not where the robot is now
            latency = self._settings.latency_s
            t = float(answer.headers["X-Timestamp"]) if latency is None else arrived - latency
            self._frame = Frame(np.asarray(image, np.uint8), t, arrived, self._count)
            self._count += 1
        return self._frame

    def statistics(self) -> CameraStatistics:
        exposed, delivered = self._last[0] - self._first[0] + 1, self._last[1] - self._first[1] + 1
        return CameraStatistics(self._count, exposed - delivered, delivered - self._count)

    def fault(self) -> HardwareFault | None:
        now = self._clock.now()
        self.newest()
        if self._gone:
            return HardwareFault(
                "the camera is unplugged or closed its stream", where=self._settings.name, remedy="look at its cable"
            )
        age = now - self._arrived if self._frame else now - self._began
        if age > STALLED_S:
            return HardwareFault(
                f"the camera has sent no picture for {number(age, 's', decimals=1)}",
                where=self._settings.name,
                remedy="look at its cable",
            )
        return self._frozen.fault(now, self._settings.name)

    def close(self) -> None:
        self._http.close()
