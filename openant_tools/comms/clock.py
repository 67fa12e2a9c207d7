"""The clock that engine and drivers live by: the host's own, or a virtual robot's that is stepped.

Nothing in a driver sleeps or asks the time but through a `Clock`, so that the same code runs a real robot in real time
and a virtual one as fast as it can be computed.
"""

from __future__ import annotations

import json
import math
import select
import socket
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from openant_tools.comms.lateness import Lateness
from openant_tools.comms.line import BUFFER, Line
from openant_tools.errors import HardwareFault

__all__ = ["Clock", "RealClock", "SteppedClock", "VirtualControl", "portions"]

#: `sleep` overshoots by 0.1 ms at best on Linux: the last stretch is spun where a deadline is to be met.
SPIN_S = 0.15e-3
#: Real time that a stepped virtual robot may need to answer; it computes physics meanwhile.
CONTROL_TIMEOUT_S = 30.0


class Clock(Protocol):
    """Time in s, monotonic, of no particular origin.

    Attributes:
        lateness: how late this computer was in the waits so far.
    """

    lateness: Lateness

    @property
    def stepped(self) -> bool:
        """Whether time stands still while nobody waits."""
        ...

    def now(self) -> float: ...

    def sleep_until(self, t: float) -> None:
        """Return at `t`, at once where that has passed."""
        ...

    def write_from(self, t: float) -> None:
        """As `sleep_until`, where the next thing is to write."""
        ...

    def wait_readable(self, line: Line, deadline: float) -> bool:
        """True as soon as `line` has bytes to read, False at the deadline. Bytes that already lie there count
        even after the deadline: then it was this process that was late, not they."""
        ...

    def arrivals(self, line: Line) -> list[tuple[int, float]]:
        """(bytes received in all, when) of each portion that the last `line.read()` brought."""
        ...

    def in_time(self, at: float, deadline: float) -> bool:
        """Whether a portion that came at `at` (s, see `arrivals`) lay there by a deadline: this process may have come late
        to it."""
        ...


def portions(clock: Clock, line: Line, deadline: float) -> Iterator[bytes]:
    """What a line says, as it comes, until `deadline` (s).

    What lies there when the deadline has passed counts, too: this process was late. But that is one buffer at most, so that
    a line that never falls silent ends it as well.
    """
    lain = 0
    while lain <= BUFFER and clock.wait_readable(line, deadline):
        data = line.read()
        lain += len(data) if clock.now() > deadline else 0
        if data:
            yield data
        elif clock.now() >= deadline:
            return


class RealClock:
    """The host's monotonic clock, the same one for all processes.

    Args:
        robot_pid: of a virtual robot that runs in real time, see `Lateness`.
    """

    stepped = False

    def __init__(self, robot_pid: int | None = None) -> None:
        self.lateness = Lateness(robot_pid)

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        rest = t - time.monotonic()
        if rest > SPIN_S:
            time.sleep(rest - SPIN_S)
            self.lateness.note(time.monotonic() - t)
        while time.monotonic() < t:
            pass

    def write_from(self, t: float) -> None:
        self.sleep_until(t)

    def wait_readable(self, line: Line, deadline: float) -> bool:
        before = time.monotonic()
        ready, _, _ = select.select([line], [], [], max(0.0, deadline - before))
        self.lateness.note(time.monotonic() - max(deadline, before))
        return bool(ready)

    def arrivals(self, line: Line) -> list[tuple[int, float]]:
        return [(line.received, time.monotonic())]

    def in_time(self, at: float, deadline: float) -> bool:
        return True  # only waiting in vain tells otherwise


class VirtualControl:
    """The control socket of a virtual robot: a line of JSON out, one back."""

    def __init__(self, path: str | Path) -> None:
        self.path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(CONTROL_TIMEOUT_S)
        try:
            self._socket.connect(self.path)
        except OSError as error:
            raise HardwareFault(
                f"no virtual robot listens here ({error.strerror})",
                where=self.path,
                remedy="start one with `openant virtual start --ready-file FILE` and name that file",
            ) from None
        self._rest = b""

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        """Send one request; its answer. Raises HardwareFault where the robot has gone or refuses."""
        return self.ask_all([{"do": do, **fields}])[0]

    def ask_all(self, requests: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Send requests that are done one after another; their answers. Raises as `ask`."""
        try:
            self._socket.sendall("".join(json.dumps(request) + "\n" for request in requests).encode())
            while self._rest.count(b"\n") < len(requests):
                data = self._socket.recv(65536)
                if not data:
                    raise ConnectionResetError("it closed the connection")
                self._rest += data
        except OSError as error:
            raise HardwareFault(
                f"the virtual robot stopped answering ({error})", where=self.path, remedy="start it again"
            ) from None
        *lines, self._rest = self._rest.split(b"\n", len(requests))
        answers: list[dict[str, Any]] = [json.loads(line.decode()) for line in lines]
        for request, answer in zip(requests, answers, strict=True):
            if "error" in answer:
                raise HardwareFault(f"the virtual robot refuses {request['do']!r}: {answer['error']}", where=self.path)
        return answers

    @property
    def robot_pid(self) -> int | None:
        """The virtual robot's process, where the system tells it."""
        if not hasattr(socket, "SO_PEERCRED"):
            return None
        pid, _, _ = struct.unpack("3i", self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        return int(pid) or None

    def close(self) -> None:
        self._socket.close()


class SteppedClock:
    """A virtual robot's clock: it moves only while somebody waits, as fast as the physics can be computed.

    Pseudo-terminals deliver when they please, so before time moves the robot is told how many bytes have been
    written, and after it how many to expect.
    """

    stepped = True

    def __init__(self, control: VirtualControl, *, bus: Line | None = None) -> None:
        self._control = control
        self.lateness = Lateness(real=False)
        self._lines: dict[str, Line] = {}
        #: bytes (written, received) before the counts of the robot began
        self._base: dict[str, tuple[int, int]] = {}
        self._sent: dict[str, int] = {"bus": 0, "imu": 0}
        self._settled: dict[str, int] = {}
        self._marks: dict[str, list[tuple[int, float]]] = {}
        #: s, from when to when the host last stood still
        self._stood = (-math.inf, -math.inf)
        #: requests that are made together with the next one
        self._put_off: list[dict[str, Any]] = []
        answer = control.ask("now")
        if not answer["stepped"]:
            raise HardwareFault(
                "this virtual robot runs in real time", where=control.path, remedy='[clock] mode = "stepped"'
            )
        self._t = float(answer["t"])
        self.attach(bus=bus)

    def attach(self, *, bus: Line | None = None, imu: Line | None = None) -> None:
        """Take these lines, just opened, as the robot's; those attached before stay, and must be idle."""
        given = {"bus": bus, "imu": imu}
        self._lines |= {name: line for name, line in given.items() if line is not None}
        if self._put_off:
            self._ask("settle")
        self._t = float(self._control.ask("open")["t"])
        for name, line in self._lines.items():
            self._base[name] = line.written, line.received
            self._sent[name], self._settled[name] = line.received, line.written
            self._marks[name] = []

    def now(self) -> float:
        return self._t

    def sleep_until(self, t: float) -> None:
        if t > self._t or self._unsettled:
            self._ask("advance", to=t)  # once what was written has had its effect

    def write_from(self, t: float) -> None:
        """The robot hears of it together with what comes next; only where a host stands still the time is not sure before."""
        if self._stood[1] > -math.inf:
            self.sleep_until(t)
        elif t > self._t:
            self._put_off.append(self._request("advance", to=t))
            self._t = t

    def wait_readable(self, line: Line, deadline: float) -> bool:
        name = self._name(line)
        if line.received >= self._sent[name] and name == "bus" and self._unsettled:
            # A servo answers at once or never: let all that it has to say arrive by one question. Who only looks knows
            # already what came while time moved.
            self._ask("settle")
        if line.received >= self._sent[name] and deadline > self._t:
            self._ask("wait", port=name, to=deadline)
        if line.received >= self._sent[name]:
            return False
        first = next((t for count, t in self._marks[name] if count > line.received), self._t)
        if not self.in_time(first, deadline):
            return False
        ready, _, _ = select.select([line], [], [], CONTROL_TIMEOUT_S)
        if not ready:
            raise HardwareFault("the virtual robot's bytes do not arrive", where=line.path)
        return True

    def arrivals(self, line: Line) -> list[tuple[int, float]]:
        name = self._name(line)
        here = [mark for mark in self._marks[name] if mark[0] <= line.received]
        rest = self._marks[name] = self._marks[name][len(here) :]
        if not here or here[-1][0] < line.received:
            # A pseudo-terminal may bring a portion in parts: each came when the whole did, whatever else this computer does.
            here.append((line.received, rest[0][1] if rest else self._t))
        # Who stood still finds all that came meanwhile when it goes on.
        fell_asleep, woke = self._stood
        return [(count, woke if fell_asleep <= t < woke else t) for count, t in here]

    def in_time(self, at: float, deadline: float) -> bool:
        return at <= deadline or (self._stood[0] <= deadline and at <= self._stood[1])

    @property
    def _unsettled(self) -> bool:
        """Whether something has been written, or put off, that has not had its effect yet."""
        return bool(self._put_off) or any(line.written != self._settled[name] for name, line in self._lines.items())

    def _name(self, line: Line) -> str:
        return next(name for name, known in self._lines.items() if known is line)

    def _request(self, do: str, **fields: Any) -> dict[str, Any]:
        """A request before which all acts that was written so far."""
        self._settled = {name: line.written for name, line in self._lines.items()}
        written = {f"{name}_written": count - self._base[name][0] for name, count in self._settled.items()}
        return {"do": do, **written, **fields}

    def _ask(self, do: str, **fields: Any) -> None:
        """Let what was written act, and take in how far time and bytes have come."""
        requests, self._put_off = [*self._put_off, self._request(do, **fields)], []
        for answer in self._control.ask_all(requests):
            self._take(answer)
            for name in self._lines:
                base = self._base[name][1]
                self._sent[name] = int(answer[f"{name}_sent"]) + base
                self._marks[name] += [(int(count) + base, float(t)) for count, t in answer.get(f"{name}_arrivals", ())]

    def _take(self, answer: dict[str, Any]) -> None:
        """How far time has come."""
        self._t = max(self._t, float(answer["t"]))
        if "stood" in answer:
            fell_asleep, woke = answer["stood"]
            self._stood = float(fell_asleep), float(woke)
