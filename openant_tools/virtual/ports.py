"""Where a client plugs in: a pseudo-terminal behind a lasting path, or a TCP socket for pyserial's `socket://`."""

from __future__ import annotations

import errno
import fcntl
import os
import platform
import pty
import socket
import struct
import tty
from pathlib import Path
from typing import Protocol

__all__ = ["ClientPort", "PtyPort", "TcpPort"]

#: Linux: struct termios2 = 4 flags, line, 19 control characters, input and output speed (bits/s as numbers).
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("<4IB19s2I")
_HAS_TERMIOS2 = platform.system() == "Linux"
_CHUNK = 65536


class ClientPort(Protocol):
    """One end of a byte stream to a client."""

    @property
    def files(self) -> list[int]:
        """Descriptors that become readable when something happens here."""
        ...

    def read(self) -> bytes: ...

    def write(self, data: bytes) -> int: ...

    def baud(self) -> int:
        """The rate that the client has set, bits/s; 0 where the port has none."""
        ...

    def unplug(self) -> None: ...

    def plug(self) -> None: ...

    def close(self) -> None: ...


class PtyPort:
    """A pseudo-terminal. The path is a link that outlives unplugging; what it points to goes as a USB device does.

    Args:
        path: where the link shall stand.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master: int | None = None
        self._slave: int | None = None
        self.plug()

    @property
    def files(self) -> list[int]:
        return [] if self._master is None else [self._master]

    def plug(self) -> None:
        if self._master is not None:
            return
        self._master, self._slave = pty.openpty()
        # Held open, so that the master does not fail while no client is there; raw, so that no byte is touched.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        target = os.ttyname(self._slave)
        link = self.path.with_name(self.path.name + ".new")
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        link.replace(self.path)

    def unplug(self) -> None:
        """The device is gone: open clients get EIO, new ones find no file."""
        self.path.unlink(missing_ok=True)
        for descriptor in (self._master, self._slave):
            if descriptor is not None:
                os.close(descriptor)
        self._master = self._slave = None

    def close(self) -> None:
        self.unplug()

    def read(self) -> bytes:
        if self._master is None:
            return b""
        try:
            return os.read(self._master, _CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno == errno.EIO:
                return b""
            raise

    def write(self, data: bytes) -> int:
        """Bytes taken; what a client that does not read leaves no room for is lost, as in a full adapter."""
        if self._master is None:
            return 0
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def baud(self) -> int:
        # Elsewhere a pseudo-terminal cannot be set to the rates of servos (macOS): any rate counts as right.
        if self._master is None or not _HAS_TERMIOS2:
            return 0
        answer = fcntl.ioctl(self._master, _TCGETS2, b"\0" * _TERMIOS2.size)
        return int(_TERMIOS2.unpack(answer)[-1])


class TcpPort:
    """A TCP server for one client at a time; a stream without a baud rate, so that every rate counts as right."""

    def __init__(self) -> None:
        self._address = ("127.0.0.1", 0)
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self.plug()

    @property
    def url(self) -> str:
        host, port = self._address
        return f"socket://{host}:{port}"

    @property
    def files(self) -> list[int]:
        return [end.fileno() for end in (self._server, self._client) if end is not None]

    def plug(self) -> None:
        if self._server is not None:
            return
        self._server = socket.create_server(self._address)
        self._server.setblocking(False)
        self._address = self._server.getsockname()[:2]

    def unplug(self) -> None:
        for end in (self._client, self._server):
            if end is not None:
                end.close()
        self._client = self._server = None

    def close(self) -> None:
        self.unplug()

    def read(self) -> bytes:
        if self._server is not None:
            try:
                client, _ = self._server.accept()
            except BlockingIOError:
                pass
            else:
                if self._client is not None:
                    self._client.close()
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._client = client
        if self._client is None:
            return b""
        try:
            data = self._client.recv(_CHUNK)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._client.close()
            self._client = None
        return data

    def write(self, data: bytes) -> int:
        if self._client is None:
            return 0
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._client.close()
            self._client = None
            return 0

    def baud(self) -> int:
        return 0
