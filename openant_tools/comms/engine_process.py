"""The engine from outside: starts the process, asks it, hears its events, reads its telemetry.

Terminal program, command line and environments are three faces of this one object. Leaving the `with` block, or dying,
switches torque off.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import subprocess
import sys
import time
import weakref
from collections import deque
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar

from openant_tools.comms.messages import Command, EngineConfig, Event, Finished, Notice, Reply, Stop, Stopped
from openant_tools.comms.restart import MotionStopped
from openant_tools.comms.ring import Ring, columns
from openant_tools.errors import BadInput, HardwareFault
from openant_tools.numbers import exact
from openant_tools.robot.folder import RobotFolder

__all__ = ["EngineProcess"]

#: Time for a Python process to start and for eight servos to be read through, on a slow machine.
CONNECT_TIMEOUT_S = 60.0
#: The engine sends torque off, closes the recording and goes.
CLOSE_TIMEOUT_S = 15.0
#: s of one look for an answer; so many of them without a new row of telemetry, and nobody is there: asking why a servo is silent takes
#: seconds
LOOK_S, SILENT_LOOKS = 0.1, 150


class EngineProcess:
    """An engine in a process of its own; a context manager.

    Attributes:
        config: as given.
        description: what the engine found when it connected: joints, firmware, registers, position.
        columns: names of the telemetry's numbers.
        running: the engines of this process that are not closed, for a face that shows or stops what a procedure of
            its own moves in another thread.

    Raises:
        BadInput: another program holds the robot's folder; it is named.
        HardwareFault: it could not connect; the message is the engine's.
    """

    running: ClassVar[weakref.WeakSet[EngineProcess]] = weakref.WeakSet()

    def __init__(self, config: EngineConfig) -> None:
        self.config = config
        self.columns = columns([servo.joint for servo in config.servos])
        self._ring = Ring(len(self.columns))
        self._seen = 0
        self._events: deque[Event] = deque()
        self._replies: dict[int, Reply] = {}
        #: commands' numbers; taken from it in one stroke, whichever thread does
        self._numbers = itertools.count(1)
        self._ended = False
        #: the robot's folder, for as long as its bus is ours
        self._held = contextlib.ExitStack()
        if config.journal is not None:
            self._held.enter_context(RobotFolder(Path(config.journal).parent).hold())
        ours, theirs = socket.socketpair()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "openant_tools.comms.engine", str(theirs.fileno()), str(self._ring.fd)],
            pass_fds=(theirs.fileno(), self._ring.fd),
            start_new_session=True,
        )
        theirs.close()
        self._connection = Connection(ours.detach())
        try:
            self._connection.send((config, len(self.columns)))
            self.description: dict[str, Any] = self.wait(0, CONNECT_TIMEOUT_S)
        except BaseException:
            self.close()
            raise
        self.running.add(self)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether it is known to have ended, by itself or by `close`."""
        return self._ended or self._connection.closed

    def __enter__(self) -> EngineProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ---- commands ------------------------------------------------------------------------------------------------

    def start(self, command: Command) -> int:
        """Send a command without waiting; its number, for `done`. What cannot be sent is refused, and nothing changes."""
        number = next(self._numbers)
        try:
            self._connection.send((number, command))
        except OSError:
            self._died()
        except Exception as error:  # whatever pickling makes of it
            raise BadInput(f"{type(command).__name__} cannot be sent to the engine: {error}") from error
        return number

    def done(self, number: int) -> bool:
        """Whether the command has been answered (for a motion: whether it has ended). Raises its error."""
        self._receive(0.0)
        if number in self._replies:
            self._value(self._replies[number])
            return True
        if self._ended:
            self._died()
        return False

    def ask(self, command: Command, timeout_s: float | None = None) -> Any:
        """Send a command and wait for its answer; for a motion that is its end.

        Raises:
            MotionStopped: the motion was stopped meanwhile; its `cause` says why.
            HardwareFault: the engine says no, or has died.
        """
        return self.wait(self.start(command), timeout_s)

    def stop(self) -> None:
        """The stop key: torque off now."""
        self.ask(Stop(), 5.0)

    def let_go(self) -> None:
        """The stop key from any thread: torque off now, without waiting; whoever waits for a motion is told."""
        self.start(Stop())

    # ---- what comes back -----------------------------------------------------------------------------------------

    def events(self) -> Iterator[Event]:
        """What happened since the last call."""
        if not self._connection.closed and not self._ended:
            self._receive(0.0)
        while self._events:
            yield self._events.popleft()

    def notices(self) -> Iterator[str]:
        """What the engine found worth knowing since the last call; other events are passed over."""
        return (event.text for event in self.events() if isinstance(event, Notice))

    def telemetry(self) -> Any:
        """Rows (n, columns) since the last call, oldest first; see `columns`. What was missed is gone."""
        rows, self._seen = self._ring.since(self._seen)
        return rows

    def second_view(self) -> Ring:
        """The telemetry for another reader, with a place of its own in it, from any thread; to be closed by it."""
        return Ring(len(self.columns), os.dup(self._ring.fd))

    def wait(self, number: int, timeout_s: float | None = None) -> Any:
        """The answer to a command that was sent with `start`; as `ask`."""
        give_up = None if timeout_s is None else time.monotonic() + timeout_s
        rows, looks = self._ring.count, 0
        while number not in self._replies:
            # Looks, not seconds: those in which this process stood still itself do not count.
            rows, looks = (rows, looks + 1) if rows == self._ring.count else (self._ring.count, 0)
            if looks > SILENT_LOOKS and number and not self.description["stepped"]:
                raise HardwareFault(
                    f"the engine does not answer and reads nothing for {exact(SILENT_LOOKS * LOOK_S, 's')}", where=self.config.port,
                    remedy="its guardian has switched torque off; this computer is overloaded, or something has stopped that process",
                )  # fmt: skip
            if give_up is not None and time.monotonic() > give_up:
                raise HardwareFault(
                    "the engine does not answer", where=self.config.port, remedy="stop it and try again"
                )
            if self._ended:
                self._died()
            self._receive(LOOK_S)
        return self._value(self._replies.pop(number))

    def _value(self, reply: Reply) -> Any:
        if reply.error is not None:
            what, where, remedy = reply.error
            if reply.cause is not None:
                raise MotionStopped(what, where=where or self.config.port, remedy=remedy, cause=reply.cause)
            raise HardwareFault(what, where=where or self.config.port, remedy=remedy)
        return reply.value

    def _receive(self, wait_s: float) -> None:
        try:
            while self._connection.poll(wait_s):
                message = self._connection.recv()
                if isinstance(message, Reply):
                    self._replies[message.number] = message
                elif isinstance(message, (Finished, Stopped, Notice)):
                    self._events.append(message)
                wait_s = 0.0
        except (EOFError, OSError):
            self._ended = True

    def _died(self) -> None:
        code = self._process.wait(CLOSE_TIMEOUT_S)
        raise HardwareFault(
            f"the engine has ended (exit status {code})",
            where=self.config.port,
            remedy="its guardian switches torque off (if that was killed too, the servos' watchdog has stopped motion: cut "
            "their power); connect again",
        )

    def close(self) -> None:
        """Torque off, recording closed, process gone. May be called again."""
        self.running.discard(self)
        if self._connection.closed:
            return
        with contextlib.suppress(OSError):
            self._connection.send((0, None))
        try:
            self._drain_until_gone()
        finally:
            self._connection.close()
            self._ring.close()
            self._held.close()

    def _drain_until_gone(self) -> None:
        give_up = time.monotonic() + CLOSE_TIMEOUT_S
        while self._process.poll() is None and time.monotonic() < give_up:
            self._receive(0.05)
            if self._ended:
                break
        try:
            self._process.wait(max(0.1, give_up - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.terminate()
            try:
                self._process.wait(2.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
