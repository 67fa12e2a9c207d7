"""The overhead camera in a process of its own: whatever finding tags takes, no cycle of the bus waits for it.

Run as `python -m openant_tools.comms.camera_process`, by `CameraProcess`. It says what it sees over a socket, in messages that are small
enough to come whole; the body's attitude comes, and the newest picture goes, through shared memory. So the bus's loop waits neither to say
something nor for the rest of a message. It ends when the other end of its socket does.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.body_camera import WIDEST, BodyCamera, CameraConfig
from openant_tools.comms.clock import RealClock
from openant_tools.comms.ring import Ring
from openant_tools.comms.tags import BodyLost, BodyPose
from openant_tools.errors import BadInput, HardwareFault, OpenAntError
from openant_tools.files import shared_memory
from openant_tools.scheduling import gives_way

__all__ = ["CameraProcess", "main"]

#: s within which a camera is open, or has said why not: some telephones take 10 to wake up
OPEN_TIMEOUT_S = 30.0
#: s between two looks for a new picture: a fifteenth of a period at 30 Hz
POLL_S = 0.002
#: s between two pictures for somebody to look at
SHOWN_EVERY_S = 0.1
#: bytes of a part of a picture that is kept: what is much longer a connection sends after its length
PART = 2**13
#: columns of what the engine tells: when the body leant how, s and rad, and whether pictures are kept
TOLD = 4
NO_LEAN = (np.nan, np.nan, np.nan)


class CameraProcess:
    """A `BodyCamera` in another process, with the same methods.

    Attributes:
        notes: what a builder should know of the camera.
        keeping: whether pictures are kept for `kept`.

    Raises:
        HardwareFault: it cannot be opened or sends nothing.
        BadInput: it was calibrated for pictures of another shape.
    """

    def __init__(self, config: CameraConfig) -> None:
        self._told, self._shown = Ring(TOLD), _Shown()
        ours, theirs = socket.socketpair()
        fds = theirs.fileno(), self._told.fd, self._shown.fd
        words = [sys.executable, "-m", "openant_tools.comms.camera_process", *map(str, fds)]
        with theirs:
            try:
                self._process = subprocess.Popen(words, pass_fds=fds, start_new_session=True)
            except OSError as error:
                ours.close()
                self._told.close()
                self._shown.close()
                raise HardwareFault(
                    f"the camera's process cannot be started ({error.strerror})",
                    remedy="make room on this computer: processes, memory",
                ) from None
        self._connection = Connection(ours.detach())
        self._kept: deque[tuple[float, bytes]] = deque()
        self._parts = bytearray()
        self._news: deque[str] = deque()
        self._ended = False
        self.keeping = False
        self._lean = NO_LEAN
        kind: str
        value: Any
        try:
            self._connection.send(config)
            kind, value = self._connection.recv() if self._connection.poll(OPEN_TIMEOUT_S) else ("silent", None)
        except (EOFError, OSError):
            kind, value = "silent", None
        if kind != "ready":
            self.close()
        if kind == "silent":
            raise HardwareFault(
                "the camera's process does not answer", where=config.settings.name, remedy="try again, or go on without it"
            )  # fmt: skip
        if kind == "fault":
            bad, what, where, remedy = value
            raise (BadInput if bad else HardwareFault)(what, where=where, remedy=remedy)
        self.notes: tuple[str, ...] = value

    @property
    def pid(self) -> int:
        return self._process.pid

    def lean(self, t: float, roll: float, pitch: float) -> None:
        """The body's attitude at `t` by the IMU, rad; it steadies the pose of the picture taken then."""
        self._lean = t, roll, pitch

    def poses(self) -> list[BodyPose | BodyLost]:
        """What was seen since the last call, oldest first."""
        self._told.put((*self._lean, float(self.keeping)))
        self._lean, out = NO_LEAN, []
        for kind, value in self._messages():
            if kind == "pose":
                out.append(value)
            elif kind == "part":
                self._parts += value
            elif kind == "kept":
                self._kept.append((value, bytes(self._parts)))
                self._parts.clear()
            else:
                self._news.append(value)
        return out

    def kept(self) -> list[tuple[float, bytes]]:
        """The pictures kept since the last call: s when each was taken, and its JPEG."""
        return [self._kept.popleft() for _ in range(len(self._kept))]

    def picture(self) -> NDArray[np.uint8] | None:
        """The newest picture, as `BodyCamera.picture`, up to a tenth of a second old."""
        return self._shown.picture()

    def news(self) -> str | None:
        """What is wrong, once when it begins and from time to time while it lasts."""
        return self._news.popleft() if self._news else None

    def close(self) -> None:
        """Let go of the camera."""
        self._connection.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(2.0)
        self._process.kill()
        self._process.wait()
        self._told.close()
        self._shown.close()

    def _messages(self) -> Iterator[tuple[str, Any]]:
        """Those that are there."""
        try:
            while not self._ended and self._connection.poll(0):
                yield self._connection.recv()
        except (EOFError, OSError):
            self._ended = True
            self._news.append(str(HardwareFault("the camera's process was ended from outside", remedy="start anew")))


class _Shown:
    """One picture in memory that two processes share. Odd counts say that it is being written (a seqlock)."""

    def __init__(self, fd: int | None = None) -> None:
        head = 3 * 8
        self.fd, self._map = shared_memory(head + WIDEST * WIDEST * 3, fd)
        self._head = np.frombuffer(self._map, np.uint64, 3)
        self._bytes = np.frombuffer(self._map, np.uint8, offset=head)

    def put(self, picture: NDArray[np.uint8]) -> None:
        picture = picture[:WIDEST, :WIDEST]
        self._head[0] += np.uint64(1)
        self._head[1:] = picture.shape[:2]
        self._bytes[: picture.size] = picture.ravel()
        self._head[0] += np.uint64(1)

    def picture(self) -> NDArray[np.uint8] | None:
        """(height, width, 3) RGB; None before the first, or where it changes all the time."""
        for _ in range(3):
            count, height, width = self._head.tolist()
            out = self._bytes[: height * width * 3].reshape(height, width, 3).copy()
            if count and count % 2 == 0 and count == int(self._head[0]):
                return out
        return None

    def close(self) -> None:
        del self._head, self._bytes
        self._map.close()
        os.close(self.fd)


def _serve(us: Connection, told: Ring, shown: _Shown) -> None:
    """Look at pictures until the other end is gone."""
    config = us.recv()
    try:
        camera = BodyCamera(config, RealClock())
    except OpenAntError as error:
        us.send(("fault", (isinstance(error, BadInput), error.what, error.where, error.remedy)))
        return
    try:
        us.send(("ready", camera.notes))
        seen, shown_at = 0, -np.inf
        while not us.poll(POLL_S):  # nothing more is said: that is its end
            rows, seen = told.since(seen)
            for t, roll, pitch, keeping in rows.tolist():
                camera.keeping = bool(keeping)
                if np.isfinite(t):
                    camera.lean(t, roll, pitch)
            for result in camera.poses():
                us.send(("pose", result))
                if result.t - shown_at > SHOWN_EVERY_S and (picture := camera.picture()) is not None:
                    shown_at = result.t
                    shown.put(picture)
            for taken, data in camera.kept():
                for first in range(0, len(data), PART):
                    us.send(("part", data[first : first + PART]))
                us.send(("kept", taken))
            if (news := camera.news()) is not None:
                us.send(("news", news))
    finally:
        camera.close()


def main() -> None:
    """Arguments: file descriptors of the socket, of what is told and of the picture. The config comes first over the socket."""
    gives_way()
    us, told, shown = map(int, sys.argv[1:])
    with contextlib.suppress(EOFError, OSError):
        _serve(Connection(us), Ring(TOLD, told), _Shown(shown))


if __name__ == "__main__":
    main()
