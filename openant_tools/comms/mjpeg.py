"""A stream of JPEG pictures over HTTP (multipart/x-mixed-replace), as network cameras and telephones send it.

OpenCV opens such streams, too, but hands every picture over in the size of the first: where the camera changes its picture
(another mode, a turned telephone) that stretches it, and nothing says so. Here each picture has the size that it was sent in.
"""

from __future__ import annotations

import contextlib
import http.client
import urllib.parse
from typing import Any

import numpy as np

from openant_tools.optional import cv2

__all__ = ["MjpegStream"]

#: Bytes of one picture, of one header line, and lines of a header; more is no picture.
MOST_BYTES, MOST_LINE, MOST_LINES = 64 << 20, 4096, 64


class MjpegStream:
    """The part of `cv2.VideoCapture` that is needed, for one stream.

    Args:
        url: http://HOST[:PORT]/…, without a password.
        open_s, read_s: how long an answer, and then each picture, is waited for.

    Raises:
        OSError, http.client.HTTPException: nobody answers.
        ValueError: what answers is no stream of pictures.
    """

    def __init__(self, url: str, open_s: float, read_s: float) -> None:
        to = urllib.parse.urlsplit(url)
        if to.scheme != "http" or to.hostname is None or to.username is not None:
            raise ValueError("is another kind of stream")
        self._http = http.client.HTTPConnection(to.hostname, to.port or 80, timeout=open_s)
        self._data = b""
        self._inside = False
        try:
            self._http.request("GET", (to.path or "/") + (f"?{to.query}" if to.query else ""))
            if self._http.sock is not None:
                self._http.sock.settimeout(read_s)
            self._answer = self._http.getresponse()
            kind, boundary = self._answer.headers, self._answer.headers.get_param("boundary")
            if self._answer.status != 200 or kind.get_content_type() != "multipart/x-mixed-replace" or not boundary:
                raise ValueError("is no stream of pictures")
        except BaseException:
            self._http.close()
            raise
        self._boundary = "--" + str(boundary).strip().removeprefix("--")

    def isOpened(self) -> bool:
        return True

    def getBackendName(self) -> str:
        return "MJPEG"

    def get(self, prop: int) -> float:
        return 0.0

    def grab(self) -> bool:
        """Read the next picture; False where the stream has ended, or sends none in time."""
        try:
            size = self._head()
            self._data = self._until_boundary() if size is None else self._answer.read(size)
        except (OSError, ValueError, http.client.HTTPException):
            return False
        return bool(self._data) and (size is None or len(self._data) == size)

    def retrieve(self) -> tuple[bool, Any]:
        """Whether the picture that was read is one, and it: (h, w, 3)."""
        image = cv2.imdecode(np.frombuffer(self._data, np.uint8), cv2.IMREAD_COLOR) if self._data else None
        return image is not None, image

    def release(self) -> None:
        with contextlib.suppress(OSError):
            self._http.close()

    def _head(self) -> int | None:
        """Read up to where a picture begins; how many bytes it has, None where its header does not say."""
        size, inside = None, self._inside
        self._inside = False
        for _ in range(MOST_LINES):
            line = self._answer.readline(MOST_LINE)
            if not line:
                raise ValueError("the stream has ended")
            text = line.strip().decode("latin-1")
            if text.startswith(self._boundary):
                inside = True
            elif inside and not text:
                return size
            elif inside and text.lower().startswith("content-length:"):
                size = int(text.partition(":")[2])
                if not 0 < size <= MOST_BYTES:
                    raise ValueError("no picture has so many bytes")
        raise ValueError("no picture begins")

    def _until_boundary(self) -> bytes:
        """The picture's bytes; the boundary behind them is read with them, and the next header begins without one."""
        data, mark = bytearray(), self._boundary.encode("latin-1")
        while len(data) < MOST_BYTES:
            line = self._answer.readline(1 << 16)
            if not line:
                raise ValueError("the stream has ended")
            data += line
            if line.startswith(mark) and data[-len(line) - 2 : -len(line)] == b"\r\n":
                self._inside = True
                return bytes(data[: -len(line) - 2])
        raise ValueError("no picture has so many bytes")
