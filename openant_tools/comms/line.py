"""A serial line as the drivers see it: bytes out, bytes in, nothing waits. A U2D2, a pseudo-terminal, or TCP."""

from __future__ import annotations

import errno
import os
import select
import time
from typing import Protocol

import serial

from openant_tools.errors import HardwareFault

__all__ = ["BUFFER", "Line", "PortGone", "SerialLine"]

#: What the system keeps of a line that nobody reads, bytes: more can only come meanwhile.
BUFFER = 4096
#: How long a full buffer of an adapter may take, as a multiple of what it takes on the wire, and at least, s.
WRITE_PATIENCE, SHORTEST_WRITE_S = 1.2, 0.1


class PortGone(HardwareFault):
    """The host's port vanished: unplugged, or the other end of a virtual one closed."""

    def __init__(self, path: str, why: str = "") -> None:
        super().__init__(
            "the port is gone" + (f" ({why})" if why else ""),
            where=path,
            remedy="look at the USB cable of the adapter, then connect again",
        )


class Line(Protocol):
    """Bytes both ways, without waiting; waiting is the clock's business.

    Attributes:
        path: what the user calls it.
        baud: bits per second on the wire; for TCP and other lines without one, what the servos would use.
        written, received: bytes in total since it was opened.
    """

    path: str
    baud: int
    written: int
    received: int

    def fileno(self) -> int: ...
    def write(self, data: bytes) -> None: ...
    def read(self) -> bytes: ...
    def set_baud(self, baud: int) -> None: ...
    def close(self) -> None: ...


class SerialLine:
    """A `Line` over pyserial: a device path, or a URL such as `socket://host:port`.

    Raises:
        HardwareFault: the port is missing, busy or forbidden; `openant_tools.comms.ports` explains which.
    """

    def __init__(self, path: str, baud: int) -> None:
        self.path = path
        self.baud = baud
        self.written = 0
        self.received = 0
        self._serial = _open(path, baud)
        self._fd: int = self._serial.fileno()
        os.set_blocking(self._fd, False)
        self.read()

    def fileno(self) -> int:
        return self._fd

    def write(self, data: bytes) -> None:
        """Hand all bytes to the system."""
        rest = memoryview(data)
        give_up = None
        while rest:
            try:
                sent = os.write(self._fd, rest)
            except BlockingIOError:
                patience = max(SHORTEST_WRITE_S, WRITE_PATIENCE * 10 * BUFFER / self.baud)
                give_up = give_up or time.monotonic() + patience
                select.select([], [self._fd], [], patience)
                if time.monotonic() > give_up:
                    raise PortGone(self.path, "it takes no more bytes") from None
                continue
            except OSError as error:
                raise PortGone(self.path, error.strerror or "") from None
            self.written += sent
            rest = rest[sent:]

    def read(self) -> bytes:
        """What has arrived, perhaps nothing."""
        try:
            data = os.read(self._fd, BUFFER)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PortGone(self.path, error.strerror or "") from None
        if not data and self._hung_up():
            raise PortGone(self.path, "it hung up")
        self.received += len(data)
        return data

    def _hung_up(self) -> bool:
        """Whether there is nothing to read because nobody is there: else another reader of this port took it."""
        if self.path.startswith("socket://"):
            return True
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        return any(event & (select.POLLHUP | select.POLLERR | select.POLLNVAL) for _, event in poll.poll(0))

    def set_baud(self, baud: int) -> None:
        try:
            self._serial.baudrate = baud
        except OSError as error:
            # A pseudo-terminal of macOS refuses the ioctl for 1 Mbaud and more; it has no wire that would care.
            if error.errno != errno.ENOTTY:
                raise PortGone(self.path, error.strerror or "") from None
        self.baud = baud

    def close(self) -> None:
        try:
            self._serial.close()
        except OSError:
            pass  # an unplugged port cannot be closed any more than it is


def _open(path: str, baud: int) -> serial.SerialBase:
    options = {"timeout": 0, "write_timeout": 0}
    if "://" not in path:
        options["exclusive"] = True
    try:
        try:
            return serial.serial_for_url(path, baudrate=baud, **options)
        except OSError as error:
            if error.errno != errno.ENOTTY:
                raise
            port = serial.serial_for_url(path, baudrate=115_200, **options)  # macOS, see set_baud
            return port
    except (OSError, ValueError) as error:
        # pyserial's own words hold the system's; the port module knows who holds it and which group is missing.
        from openant_tools.comms.ports import explain_open_error

        raise explain_open_error(path, error) from None
