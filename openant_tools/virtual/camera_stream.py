"""The virtual camera's cable: a process of its own that renders frames and serves them over HTTP.

The robot's process tells it what there was to see at each exposure; everything else (rendering, compressing, serving)
happens here, so that the timing of the bus does not suffer. The addresses are those of a network webcam:

* `/stream.mjpg`: the pictures as they are delivered, which `cv2.VideoCapture` opens;
* `/snapshot.jpg`: the last picture delivered, 204 while there is none; with `?at=T`, the last one delivered at robot
  time T. That is how a stepped robot is watched: rendered on demand, and the same at every run. `X-Next` says before which
  robot time it stays the last one, so that nobody asks ten times for one picture.

Every picture says in its header when it was exposed (`X-Timestamp`, s: robot time if stepped, else CLOCK_MONOTONIC),
when it was delivered (`X-Delivered`), which exposure it is (`X-Frame`) and how many were delivered before it
(`X-Ordinal`).

A stepped robot's time goes on some hundred times for each picture, so it stands in memory that both processes share, with how
much the robot has told so far: who asks for a picture waits until all of that has been heard.

The camera delivers frame k, exposed around k/fps, after its latency and jitter, unless it is dropped. What is random is
a function of the seed and k.
"""

from __future__ import annotations

import contextlib
import functools
import http.server
import multiprocessing
import os
import signal
import threading
import time
import urllib.parse
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

import numpy as np

from openant_tools.numbers import exact
from openant_tools.scheduling import gives_way
from openant_tools.virtual.camera_scene import OverheadCameraSettings, Scene

if TYPE_CHECKING:
    from openant_tools.virtual.overhead_camera import OverheadCamera

__all__ = ["CAMERA_FAULTS", "VirtualCamera"]

#: frozen: the same picture again and again; stalled: no more pictures; gone: the camera is unplugged.
CAMERA_FAULTS = ("frozen", "stalled", "gone")
#: of a process that loads OpenCV on a machine that has much else to do
START_TIMEOUT_S = 120.0
#: Exposures kept for snapshots of the past.
MEMORY = 256
#: As many pictures as a driver's queue holds; what comes while it is full is lost.
QUEUE = 4
#: s for which a snapshot may wait for the process that draws
SNAPSHOT_TIMEOUT_S = 20.0
#: s between two looks at a stepped robot's time while a picture waits for it
LOOK_S = 2e-3
#: places in the memory shared by both processes: robot time, s; messages told
TIME, TOLD = 0, 1


@dataclass(frozen=True)
class _Exposure:
    index: int
    ordinal: int
    t: float
    due: float
    scene: Scene


class VirtualCamera:
    """The handle in the robot's process. Starts the camera's process; `wait` until it serves.

    Args:
        settings, seed: of the camera.
        stepped: time is told by `advance` and not by the machine.
    """

    def __init__(self, settings: OverheadCameraSettings, seed: int, *, stepped: bool = False) -> None:
        self.settings = settings
        self._next = 0
        context = multiprocessing.get_context("spawn")
        self._pipe, far = context.Pipe()
        self._shared: Any = context.RawArray("d", 2)
        shared = self._shared if stepped else None
        self._process = context.Process(
            target=_serve, args=(settings, seed, shared, far), name="openant-camera", daemon=True
        )
        self._process.start()
        far.close()
        self._port = 0

    def wait(self, timeout: float = START_TIMEOUT_S) -> str:
        """The stream's address, once it is served (a few seconds after the start).

        Raises:
            RuntimeError: the camera's process died or takes too long.
        """
        if not self._port:
            try:
                if not self._pipe.poll(timeout):
                    raise RuntimeError(f"the virtual camera did not start within {exact(timeout, 's')}")
                self._port = int(self._pipe.recv())
            except (EOFError, OSError):
                raise RuntimeError("the virtual camera's process died while starting") from None
        return f"http://127.0.0.1:{self._port}/stream.mjpg"

    @property
    def next_exposure(self) -> float:
        """Robot time of the next exposure: call `expose` then, with the scene of that moment."""
        return self._next / self.settings.fps

    def expose(self, t: float, scene: Scene) -> None:
        """The scene at the next exposure; `t` is the robot's time now, at or just after `next_exposure`."""
        index, due = self._next, self.next_exposure
        # A host that was busy missed exposures; the camera did not wait for it.
        self._next = max(index + 1, int(t * self.settings.fps) + 1)
        self._tell(("expose", index, due, time.monotonic() - (t - due), scene))

    def advance(self, t: float) -> None:
        """The time of a stepped robot, after the exposures up to then."""
        self._shared[TIME] = t

    def fault(self, name: str | None) -> None:
        """Begin a fault of `CAMERA_FAULTS`, or end it."""
        if name is not None and name not in CAMERA_FAULTS:
            raise ValueError(f"no camera fault {name!r}: one of {', '.join(CAMERA_FAULTS)}")
        self._tell(("fault", name))

    def close(self) -> None:
        """Stop the process."""
        with contextlib.suppress(OSError):
            self._pipe.close()  # it ends when its end of the pipe does
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _tell(self, message: tuple[Any, ...]) -> None:
        # The robot goes on without its camera.
        with contextlib.suppress(OSError):
            self._pipe.send(message)
            self._shared[TOLD] += 1


def _serve(settings: OverheadCameraSettings, seed: int, shared: Any, pipe: Connection) -> None:
    """The camera's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the robot's process decides when to end
    if shared is None:  # else the robot waits for it
        gives_way()
    feed = _Feed(settings, seed, shared)
    server = _Server(("127.0.0.1", 0), _Handler)
    server.feed = feed
    threading.Thread(target=server.serve_forever, daemon=True).start()
    threading.Thread(target=feed.render, daemon=True).start()
    try:
        pipe.send(server.server_port)
        while True:
            message = pipe.recv()
            if message[0] == "expose":
                feed.expose(*message[1:])
            else:
                feed.set_fault(message[1])
            feed.has_heard()
    except (EOFError, OSError):
        # The robot is gone. Threads in the midst of OpenCV do not survive an orderly end of the interpreter.
        os._exit(0)


@dataclass(frozen=True)
class _Picture:
    exposure: _Exposure
    data: bytes

    @property
    def header(self) -> bytes:
        e = self.exposure
        return (
            f"Content-Type: image/jpeg\r\nContent-Length: {len(self.data)}\r\n"
            f"X-Timestamp: {e.t:.6f}\r\nX-Delivered: {e.due:.6f}\r\n"  # for a file
            f"X-Frame: {e.index}\r\nX-Ordinal: {e.ordinal}\r\n\r\n"
        ).encode()


class _Feed:
    """Exposures in, pictures out.

    Args:
        shared: a stepped robot's time and how much it has told; None in real time.
    """

    def __init__(self, settings: OverheadCameraSettings, seed: int, shared: Any) -> None:
        self.settings = settings
        self.stepped = shared is not None
        self._shared = shared
        self._heard = 0
        self.changed = threading.Condition()
        self.fault: str | None = None
        self.watchers = 0
        self.published: tuple[int, _Picture | None] = (0, None)
        self._seed = seed
        self._queue: deque[_Exposure] = deque()
        self._history: deque[_Exposure] = deque(maxlen=MEMORY)
        self._rendered: OrderedDict[int, _Picture] = OrderedDict()
        self._held: _Picture | None = None
        self._delivered = 0
        #: the last exposure of which the robot told, whether or not a picture of it is delivered
        self._told = -1
        self._render_lock = threading.Lock()
        if not self.stepped:
            _ = self._optics  # what is to come in time is got ready; a stepped robot waits for the first picture

    @functools.cached_property
    def _optics(self) -> tuple[OverheadCamera, Callable[..., Any], int]:
        """The camera, and how its pictures are compressed. OpenCV and the floor take most of a second."""
        from openant_tools.optional import cv2
        from openant_tools.virtual.overhead_camera import OverheadCamera

        # One thread a picture: the machine's other cores have the robot to compute.
        cv2.setNumThreads(1)
        return OverheadCamera(self.settings, self._seed), cv2.imencode, cv2.IMWRITE_JPEG_QUALITY

    def expose(self, index: int, t: float, monotonic: float, scene: Scene) -> None:
        s = self.settings
        drop, late = np.random.default_rng([self._seed, index, 1]).random(2)
        taken = t if self.stepped else monotonic
        due = taken + s.latency_s + (2.0 * late - 1.0) * s.latency_jitter_s
        with self.changed:
            self._told = index
            if self.fault in ("stalled", "gone") or drop < s.drop:
                return
            # A driver hands pictures over in order.
            due = max(due, self._history[-1].due if self._history else due)
            exposure = _Exposure(index, self._delivered, taken, due, scene)
            self._delivered += 1
            self._history.append(exposure)
            if self.watchers and len(self._queue) < QUEUE:
                self._queue.append(exposure)
            self.changed.notify_all()

    def has_heard(self) -> None:
        with self.changed:
            self._heard += 1
            self.changed.notify_all()

    def catch_up(self, at: float | None) -> None:
        """Return once a stepped robot's time is `at` (s), and all is here that it has told until then."""
        if not self.stepped:
            return
        give_up = time.monotonic() + SNAPSHOT_TIMEOUT_S
        while at is not None and self.now() < at - 1e-9 and time.monotonic() < give_up:
            time.sleep(LOOK_S)
        with self.changed:
            self.changed.wait_for(lambda: self._heard >= self._shared[TOLD], SNAPSHOT_TIMEOUT_S)

    def set_fault(self, fault: str | None) -> None:
        with self.changed:
            self.fault = fault
            self._held = None
            self.changed.notify_all()

    def now(self) -> float:
        return float(self._shared[TIME]) if self.stepped else time.monotonic()

    def render(self) -> None:
        """Publish queued pictures, each at its time."""
        while True:
            with self.changed:
                while not self._queue:
                    self.changed.wait()
                exposure = self._queue[0]
            picture = self._frozen(self.picture(exposure))
            with self.changed:
                while self.now() < exposure.due:
                    self.changed.wait(LOOK_S if self.stepped else max(1e-4, exposure.due - self.now()))
                self._queue.popleft()
                self.published = (self.published[0] + 1, picture)
                self.changed.notify_all()

    def after(self, number: int) -> tuple[int, _Picture | None]:
        """The newest picture once there is one after `number`, or the camera is unplugged."""
        with self.changed:
            self.changed.wait_for(lambda: self.published[0] > number or self.fault == "gone")
            return self.published

    def picture(self, exposure: _Exposure) -> _Picture:
        with self._render_lock:
            known = self._rendered.get(exposure.index)
            if known is None:
                camera, encode, quality = self._optics
                image = camera.picture(exposure.index, exposure.t, exposure.scene)
                known = _Picture(exposure, encode(".jpg", image, [quality, self.settings.jpeg_quality])[1].tobytes())
                self._rendered[exposure.index] = known
                if len(self._rendered) > 2 * QUEUE:
                    self._rendered.popitem(last=False)
            return known

    def _frozen(self, picture: _Picture) -> _Picture:
        """With the fault "frozen", the first picture since it began, under the new one's number and time."""
        with self.changed:
            if self.fault != "frozen":
                return picture
            self._held = self._held or picture
            return _Picture(picture.exposure, self._held.data)

    def snapshot(self, at: float | None) -> tuple[_Picture, float] | None:
        """The last picture delivered by `at` (default now), and before which time there is no other."""
        with self.changed:
            now = self.now() if at is None else at
            dues = [exposure.due for exposure in self._history]
            found = bisect_right(dues, now + 1e-9)
            if not found:
                return None
            exposure = self._history[found - 1]
            s = self.settings
            untold = (self._told + 1) / s.fps + s.latency_s - s.latency_jitter_s
            until = min([untold, *dues[found : found + 1]])
        return self._frozen(self.picture(exposure)), until


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    feed: _Feed

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away is nothing to report."""


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    server: _Server

    def log_message(self, format: str, *args: Any) -> None:
        """Quiet."""

    def do_GET(self) -> None:
        feed = self.server.feed
        url = urllib.parse.urlparse(self.path)
        at = [float(one) for one in urllib.parse.parse_qs(url.query).get("at", ())]
        feed.catch_up(at[0] if at else None)
        self.close_connection = feed.fault == "gone"
        if self.close_connection:
            return
        if url.path == "/stream.mjpg":
            self._stream(feed)
        elif url.path == "/snapshot.jpg":
            last = feed.snapshot(at[0] if at else None)
            if last is None:
                self.send_response(204)
                self.send_header("Content-Length", "0")
                self.end_headers()
            else:
                picture, until = last
                status = f"HTTP/1.1 200 OK\r\nX-Next: {until:.9f}\r\n"  # for a file
                self.wfile.write(status.encode() + picture.header + picture.data)
        else:
            self.send_error(404)

    def _stream(self, feed: _Feed) -> None:
        self.close_connection = True
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace;boundary=openant")
        self.end_headers()
        with feed.changed:
            feed.watchers += 1
            last = feed.published[0]
        try:
            while True:
                last, picture = feed.after(last)
                if feed.fault == "gone":
                    return
                if picture is not None:
                    self.wfile.write(b"--openant\r\n" + picture.header + picture.data + b"\r\n")
        finally:
            with feed.changed:
                feed.watchers -= 1
