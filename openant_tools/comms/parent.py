"""The process that the engine works for, as the engine sees it: what it asks for, what it is told, whether it lives."""

from __future__ import annotations

import os
import pickle
import select
from collections import deque
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

from openant_tools.comms import messages

__all__ = ["Parent", "ParentGone"]

#: messages that wait for a parent that does not read; the oldest are lost beyond
MOST_WAITING = 4096
#: s for which the engine waits for a command where a stepped robot's time stands still meanwhile
WAIT_S = 0.2


class ParentGone(Exception):
    """Nobody is there any more to move a robot for."""


class Parent:
    """The other end of a socket pair.

    Attributes:
        ended: it wants no more, or the system wants this process to end.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._pid = os.getppid()
        self._outbox: deque[messages.Reply | messages.Event] = deque(maxlen=MOST_WAITING)
        self.ended = False

    def commands(self, *, wait: bool) -> Iterator[tuple[int, messages.Command]]:
        """Number and command of all that it has asked for, or of the next within WAIT_S.

        Raises:
            ParentGone: it is no more.
        """
        if os.getppid() != self._pid:
            raise ParentGone
        try:
            while self._connection.poll(WAIT_S if wait else 0.0):
                received = self._connection.recv_bytes()
                try:
                    number, command = pickle.loads(received)  # from our parent alone, over a socket pair
                except Exception as error:
                    self.notice(f"a message of {len(received)} bytes was refused: it cannot be read ({error})")
                    continue
                if command is None:
                    self.ended = True
                    return
                yield number, command
                if wait:
                    return
        except (EOFError, ConnectionError):
            raise ParentGone from None

    def suspended(self) -> bool:
        """By Ctrl-Z or SIGSTOP; where the system does not tell (no /proc), the face that gets the signal says stop."""
        try:
            stat = Path(f"/proc/{self._pid}/stat").read_bytes()
        except OSError:
            return False
        return stat.rpartition(b")")[2].split()[:1] == [b"T"]

    def notice(self, text: str) -> None:
        """Tell a builder a line."""
        self.say(messages.Notice(text))

    def say(self, message: messages.Reply | messages.Event) -> None:
        """Tell it; what it does not take now waits for the next `flush`."""
        self._outbox.append(message)
        self.flush()

    def flush(self, patience_s: float = 0.0) -> None:
        """Send what it can take now; a face that does not read must not stop the loop.

        Raises:
            ParentGone: it is no more, and nobody was told to be patient.
        """
        try:
            while self._outbox and select.select([], [self._connection], [], patience_s)[1]:
                self._connection.send(self._outbox.popleft())
        except OSError:
            if patience_s == 0.0:
                raise ParentGone from None
