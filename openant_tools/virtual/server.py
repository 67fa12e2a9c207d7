"""The virtual robot as a process: ports that clients open, a control socket, and one loop that keeps time.

In real time the world is brought to "now" before each packet and every answer leaves when the wire would have
delivered it. Bytes are stamped when they are read, which on a busy host is later than they were written; how much later
it may have been is kept with them (`lateness`), and the wire gives the client the benefit of that doubt. In stepped
time nothing moves but by the control socket, and where requests count bytes these are written when one counts them.

The control socket (Unix stream, one JSON object a line, one line of answer each):

| request | answer |
|---|---|
| `{"do": "now"}` | `{"t": s, "stepped": bool}` |
| `{"do": "open"}` | counts of bytes start anew, for a client that has just opened its ports; `{"t": s}` |
| `{"do": "advance", "to": s}` | runs the world to that time (stepped only); `{"t": s}`. With `bus_written` or |
| | `imu_written` it does first what `settle` does, and answers so |
| `{"do": "settle", "bus_written": n, "imu_written": m}` | waits for so many bytes in all and lets them act; |
| | `{"t": s, "bus_sent": n, "imu_sent": m}`: when the last answer reached the host (or the wire fell silent), and |
| | how many bytes were sent in all; `"bus_arrivals": [[n, t], …]` (and `imu_…`): when each portion since the last |
| | answer reached the host |
| `{"do": "wait", "port": "bus", "to": s, "bus_written": n, "imu_written": m}` | as `settle`, but time runs only until |
| | the next bytes leave for that port, or to `to` (stepped only) |
| | `advance`, `settle` and `wait` add `"stood": [s, s]` where the host stood still (a `host_stall`): from when it was |
| | to go on, to when it does, which is `t` |
| `{"do": "state"}` | the truth: angles, torques, temperatures, torque enables, supply, body; not where it is sealed |
| `{"do": "wiring"}` | `{"chain": [[joint, …], …]}`, each cable from the adapter outwards |
| `{"do": "look"}` | what eyes beside it see: `{"lit": [joint, …]}`, the servos whose LED is on |
| `{"do": "fault", "cause": …, "where": …, "on": bool, …}` | switches a fault; `{"t": s}` |
| `{"do": "plug", "joint": …}`, `{"do": "unplug", …}` | puts a servo on the bus or takes it off; `{"t": s}` |
| `{"do": "assemble", "setup": "stand"}` | builds the robot from the motors in the box, or puts it on "floor" or stand |
| `{"do": "turn", "joint": …, "to": [rad, …], "leg_s": s}` | a hand leads a joint through these angles and holds it |
| `{"do": "let_go"}` | hands off all joints |
| `{"do": "tilt", "rotation_rad": [x, y, z], "seconds": s}` | hands turn the torso on its stand to this attitude |
| `{"do": "put", "position_m": [x, y], "rotation_rad": [x, y, z]}` | hands put the robot on the floor; without these on |
| | its feet where it began |

What fails answers `{"error": "…"}`. Counts of bytes run from the opening of this control connection or the last `open`.
"""

from __future__ import annotations

import contextlib
import heapq
import json
import math
import os
import select
import selectors
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from openant_tools.errors import OpenAntError
from openant_tools.files import write_text
from openant_tools.scheduling import ROBOT, in_time
from openant_tools.virtual.camera_scene import Scene
from openant_tools.virtual.lateness import HOP_S, WaitTimer
from openant_tools.virtual.ports import ClientPort, PtyPort, TcpPort
from openant_tools.virtual.world import World

__all__ = ["Device", "Server"]

#: s between two advances of the world while nobody talks; of one that dozes, which takes as many in one bound.
IDLE_S, DOZING_S = 4e-3, 2e-2
#: s before an answer is due in which the loop spins, since sleeping overshoots by 0.1 ms and more.
SPIN_S = 2e-4
#: s after bytes of the bus in which the loop spins: a client that goes as fast as the wire lets it is back by then.
ALERT_S = 3e-4
#: A world that falls behind by more lets the time go: after a laptop's sleep it does not run to catch up.
MAX_LAG_S = 1.0
#: s of wall clock for which a stepped robot waits until bytes that were sent have arrived
SETTLE_TIMEOUT_S = 5.0


class Device(Protocol):
    """What sits behind a port other than the bus: bytes in, bytes out, both with their time in s."""

    @property
    def connected(self) -> bool: ...

    def receive(self, data: bytes, t: float) -> None: ...

    def transmit(self, t: float) -> bytes: ...

    def next_event(self, t: float) -> float: ...


class CameraProcess(Protocol):
    """The camera's process, as the robot sees it."""

    def wait(self) -> str: ...

    @property
    def next_exposure(self) -> float: ...

    def expose(self, t: float, scene: Scene) -> None: ...

    def advance(self, t: float) -> None: ...

    def close(self) -> None: ...


@dataclass
class _Control:
    """One client of the control socket."""

    socket: socket.socket
    rest: bytes = b""
    #: whether its requests count the bytes that were written
    counts: bool = False
    received: dict[str, int] = field(default_factory=dict)
    sent: dict[str, int] = field(default_factory=dict)
    #: port → (bytes sent in all, when), since this client's last settle
    arrivals: dict[str, list[tuple[int, float]]] = field(default_factory=dict)


class _Failed(Exception):
    """A control request that cannot be done."""


def _number(request: dict[str, Any], key: str, default: float | None = None) -> float:
    value = request.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _Failed(f"not a request: {key} = {value!r} is no number")
    return float(value)


def _numbers(request: dict[str, Any], key: str, count: int | None = None) -> list[float]:
    values = request.get(key)
    if not isinstance(values, list) or not values or (count is not None and len(values) != count):
        raise _Failed(f"not a request: {key} = {values!r} is no list of {count or 'some'} numbers")
    return [_number({key: value}, key) for value in values]


class Server:
    """Serves one world.

    Args:
        world: the robot.
        stepped: time moves only by the control socket.
        imu: the flight controller, if any. camera: the camera, if any.
        tcp: the bus on a TCP port instead of a pseudo-terminal.
    """

    def __init__(
        self,
        world: World,
        *,
        stepped: bool = False,
        imu: Device | None = None,
        camera: CameraProcess | None = None,
        tcp: bool = False,
    ) -> None:
        self.world, self.stepped = world, stepped
        self._idle_s = DOZING_S if world.doze else IDLE_S
        # In stepped time it is the host's clock that stands still (`_sleep_through`); in real time nobody can stop it.
        world.line.settings.holds_back = not stepped
        self._camera = camera
        if camera is not None:
            world.events.append(self._expose)
        self._imu = imu
        #: switches a fault by a control request; set by whoever builds the robot
        self.fault: Callable[[dict[str, Any]], None] | None = None
        #: the truth is not told
        self.sealed = False
        self._unplugged: set[str] = set()
        #: of the links and the socket, removed at the end
        self.folder = Path(tempfile.mkdtemp(prefix="openant-"))
        self.ports: dict[str, ClientPort] = {"bus": TcpPort() if tcp else PtyPort(self.folder / "bus")}
        if imu is not None:
            self.ports["imu"] = PtyPort(self.folder / "imu")
        self.received = dict.fromkeys(("bus", "imu"), 0)
        self.sent = dict.fromkeys(("bus", "imu"), 0)
        #: stepped: bytes that were read, and of which no request has said yet that they are written
        self._waiting = {name: bytearray() for name in self.received}
        #: (when read, how much earlier it may have been written, port, bytes, baud)
        self._held: list[tuple[float, float, str, bytes, int]] = []
        #: waiting for a processor; when nothing was last seen to read; how late what is read now may be
        self._lateness, self._empty_at, self._late_s = WaitTimer(), time.monotonic(), 0.0
        self._outbox: list[tuple[float, int, str, bytes]] = []
        self._count = 0
        #: when bytes of the bus last came or went, s
        self._busy_at = -math.inf
        # epoll and poll round a timeout up to whole milliseconds, a whole cycle at 4 Mbaud.
        self._selector = selectors.SelectSelector()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(self.folder / "control"))
        self._listener.listen()
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ, "listener")
        self._controls: list[_Control] = []
        self._watched: dict[int, str] = {}
        self._start = time.monotonic() - world.now
        self._imu_served = world.now

    # ---- life ----

    @property
    def addresses(self) -> dict[str, Any]:
        """What the ready file says (formats, section 6); waits until the camera serves."""
        bus = self.ports["bus"]
        return {
            "bus": bus.url if isinstance(bus, TcpPort) else str(self.folder / "bus"),
            "imu": str(self.folder / "imu") if "imu" in self.ports else None,
            "camera": self._camera.wait() if self._camera is not None else None,
            "control": str(self.folder / "control"),
            "pid": os.getpid(),
        }

    def announce(self, ready_file: Path) -> None:
        write_text(ready_file, json.dumps(self.addresses) + "\n")

    def close(self) -> None:
        for port in self.ports.values():
            port.close()
        for control in self._controls:
            control.socket.close()
        if self._camera is not None:
            self._camera.close()
        self._listener.close()
        self._selector.close()
        self._lateness.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until `until()` (looked at a few hundred times a second) or an interrupt."""
        with contextlib.nullcontext() if self.stepped else in_time(ROBOT):
            while not until():
                self.turn()

    # ---- the loop ----

    @property
    def now(self) -> float:
        """s since power-on."""
        return self.world.now if self.stepped else time.monotonic() - self._start

    def turn(self) -> None:
        """One turn: wait for bytes or the next thing due, and do it."""
        ready: Sequence[tuple[selectors.SelectorKey, int]]
        if self.stepped:
            # Ports are read when a request counts on their bytes; in pauses, too, so that they do not fill.
            ready = self._selector.select(0.05)
            for key, _ in ready:
                self._ready(key.data)
            if not ready:
                self._take_uncounted()
            return
        self._watch()
        sleep_s, until = self._pause()
        if sleep_s > 0:
            before = time.monotonic()
            ready = self._selector.select(0)
            after = time.monotonic()
            if ready:
                # They lay there: no wait could tell how long.
                self._late_s = after - self._empty_at
            else:
                self._empty_at = before
                self._lateness.start()
                ready = self._selector.select(sleep_s)
                slept_s, after = time.monotonic() - after, time.monotonic()
                self._late_s = after - self._empty_at
                if ready:
                    self._late_s = self._lateness.seconds(slept_s, self._late_s)
        else:
            after = self._spin(until)
            ready = self._selector.select(0)
        self._empty_at = after
        for key, _ in ready:
            self._ready(key.data)
        self._keep_time()

    def _pause(self) -> tuple[float, float]:
        """s to sleep until something is due; or 0, and until when (s) to spin."""
        now = self.now
        due = now + self._idle_s
        if self._imu is not None:
            due = min(due, self._imu.next_event(self.world.now))
        if self._outbox and (answer := self._outbox[0][0] - HOP_S) - SPIN_S <= due:
            return (answer - SPIN_S - now, 0.0) if now < answer - SPIN_S else (0.0, answer)
        if now - self._busy_at < ALERT_S:
            return 0.0, min(due, self._busy_at + ALERT_S)
        return max(0.0, due - now), now

    def _spin(self, until: float) -> float:
        """Look again and again until something comes or that time (s since power-on) is there; the last look's time."""
        until += self._start
        files = list(self._selector.get_map())
        while True:
            before = time.monotonic()
            if before >= until or select.select(files, (), (), 0)[0]:
                self._late_s = time.monotonic() - self._empty_at
                return before
            self._empty_at = before
            os.sched_yield()  # to the kernel's worker that carries bytes through pseudo-terminals

    def _keep_time(self) -> None:
        now = self.now
        if now - self.world.now > MAX_LAG_S:
            self._start += now - self.world.now - self._idle_s
            now = self.now
        if now - self.world.now >= self._idle_s:
            self.world.advance(now)
        while self._outbox and self._outbox[0][0] <= self.now + HOP_S:
            due, _, name, data = heapq.heappop(self._outbox)
            self._send(name, data, due)
        if self._imu is not None and self.now >= self._imu.next_event(self._imu_served):
            self.world.advance(self.now)
            self._serve_imu(self.now)

    def _watch(self) -> None:
        """Keep the selector's list in step with ports that come and go."""
        wanted = {file: name for name, port in self.ports.items() for file in port.files}
        if wanted == self._watched:
            return
        for file in self._watched.keys() - wanted.keys():
            with contextlib.suppress(KeyError, ValueError, OSError):
                self._selector.unregister(file)
        for file, name in wanted.items():
            if file not in self._watched:
                self._selector.register(file, selectors.EVENT_READ, name)
        self._watched = wanted

    def _ready(self, what: Any) -> None:
        if what == "listener":
            client, _ = self._listener.accept()
            control = _Control(client)
            self._restart_counts(control)
            self._controls.append(control)
            self._selector.register(client, selectors.EVENT_READ, control)
        elif isinstance(what, _Control):
            self._hear(what)
        else:
            self._read(what)

    def _read(self, name: str) -> None:
        """Take a client's bytes; in real time they act at once."""
        port = self.ports[name]
        data = port.read()
        if not data:
            return
        if self.stepped:
            self._waiting[name] += data
            return
        # No wire has the hop through a pseudo-terminal: here and before an answer it is taken off.
        late_s = self._late_s + time.monotonic() - self._empty_at
        self._hold(name, data, max(self.now - HOP_S, self.world.now), late_s)
        self._act()

    def _take(self, name: str, count: int | None = None) -> None:
        """Stepped: let so many of the bytes that wait, or all, be written now."""
        waiting = self._waiting[name]
        data = bytes(waiting[:count])
        if data:
            del waiting[: len(data)]
            self._hold(name, data, self.now)

    def _take_uncounted(self) -> None:
        """Stepped: read the ports; where nobody counts what is written there, it is written now."""
        counted = any(control.counts for control in self._controls)
        for name in self.ports:
            self._read(name)
            if not counted:
                self._take(name)

    def _hold(self, name: str, data: bytes, t: float, late_s: float = 0.0) -> None:
        """Bytes that were written at `t`, or up to `late_s` (s) earlier, are to act."""
        self.received[name] += len(data)
        baud = 0
        if name == "bus":
            self._busy_at = self.now
            baud = self.ports[name].baud() or self.world.line_baud
        self._held.append((t, late_s, name, data, baud))

    def _act(self) -> float:
        """Let held bytes act; when the last of their answers reaches the host, or the wire falls silent, s."""
        last = 0.0
        for t, late_s, name, data, baud in self._held:
            if name == "imu":
                assert self._imu is not None
                self._imu.receive(data, t)
                continue
            replies = self.world.line.receive(data, t, baud, late_s=late_s)
            for reply in replies:
                self._post(reply.t, name, reply.data)
                last = max(last, reply.t)
            last = max(last, self.world.line.free_at)
        self._held.clear()
        return last

    def _post(self, t: float, name: str, data: bytes) -> None:
        self._count += 1
        heapq.heappush(self._outbox, (t, self._count, name, data))

    def _send(self, name: str, data: bytes, t: float) -> None:
        self.sent[name] += self.ports[name].write(data)
        if name == "bus":
            self._busy_at = self.now
        if self.stepped:
            for control in self._controls:
                control.arrivals[name].append((self.sent[name] - control.sent[name], t))

    def _serve_imu(self, t: float) -> None:
        assert self._imu is not None
        self._imu_served = t
        port = self.ports["imu"]
        there = self._imu.connected and "imu" not in self._unplugged
        if there != bool(port.files):
            (port.plug if there else port.unplug)()
        data = self._imu.transmit(t)
        if data:
            self._send("imu", data, t)

    def _expose(self, now: float) -> None:
        """Let the camera see the robot when its next exposure is due."""
        assert self._camera is not None
        body = self.world.body
        if now >= self._camera.next_exposure:
            velocity = body.velocity
            scene = Scene(
                body.position, body.rotation, body.limbs(), velocity=tuple(velocity[:3]), rate=tuple(velocity[3:]),
                there=body.has_torso,
            )  # fmt: skip
            # The world looks every few milliseconds; the shutter did not wait for it.
            self._camera.expose(self.now, scene.moved(self._camera.next_exposure - now))

    # ---- stepped time ----

    def advance(self, to: float, until: Callable[[], bool] = lambda: False) -> None:
        """Stepped: run to a time, or until something holds, sending what falls due on the way."""
        self._act()
        while not until():
            due = self._outbox[0][0] if self._outbox else to
            event = self._imu.next_event(self.world.now) if self._imu is not None else to
            t = min(max(min(due, event), self.world.now), to)
            self.world.advance(t)
            self._flush(t)
            if t >= to:
                break
        if self._camera is not None:
            self._camera.advance(self.world.now)

    def _flush(self, t: float) -> None:
        while self._outbox and self._outbox[0][0] <= t:
            due, _, name, data = heapq.heappop(self._outbox)
            self._send(name, data, due)
        if self._imu is not None:
            self._serve_imu(t)

    # ---- the control socket ----

    def _restart_counts(self, control: _Control) -> None:
        control.received, control.sent = dict(self.received), dict(self.sent)
        control.arrivals = {name: [] for name in self.sent}

    def _hear(self, control: _Control) -> None:
        try:
            data = control.socket.recv(65536)
        except OSError:
            data = b""
        if not data:
            self._selector.unregister(control.socket)
            control.socket.close()
            self._controls.remove(control)
            return
        *lines, control.rest = (control.rest + data).split(b"\n")
        answers = [json.dumps(self._answer(control, line)) + "\n" for line in lines]
        with contextlib.suppress(OSError):
            control.socket.sendall("".join(answers).encode())

    def _answer(self, control: _Control, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line.decode())
        except ValueError as error:
            return {"error": f"not a request: {error}"}
        try:
            if not isinstance(request, dict):
                raise _Failed("a request is a JSON object")
            return self._do(control, request)
        except (_Failed, OpenAntError) as error:
            return {"error": str(error)}

    def _do(self, control: _Control, request: dict[str, Any]) -> dict[str, Any]:
        do = request.get("do")
        if do == "now":
            return {"t": self.now, "stepped": self.stepped}
        if do == "open":
            for name in self.ports:
                self._read(name)
                self._take(name)
            self._restart_counts(control)
            control.counts = True
            return {"t": self.now}
        if do == "advance":
            return self._advance(control, request)
        if do == "settle":
            return self._settle(control, request)
        if do == "wait":
            return self._wait(control, request)
        if do == "state":
            if self.sealed:
                raise _Failed("this robot's scenario is sealed: it keeps its truth to itself")
            if not self.stepped:
                self.world.advance(self.now)
            return self.world.state()
        if do == "wiring":
            joints, chains = self.world.joints, self.world.line.settings.chains
            return {"chain": [[joints[k] for k in chain] for chain in chains]}
        if do == "look":
            return {"lit": self.world.lit}
        if do == "fault":
            if self.fault is None:
                raise _Failed("this robot has no faults to switch")
            self.fault(request)
            return {"t": self.now}
        if do == "assemble":
            setup = request.get("setup", "stand")
            if setup not in ("stand", "floor", "loose"):
                raise _Failed(f"no setup {setup!r} (stand, floor, loose)")
            self.world.assemble(setup)
            return {"t": self.now}
        if do in ("plug", "unplug"):
            self._plug(str(request.get("joint")), do == "plug")
            return {"t": self.now}
        if do == "turn":
            angles = _numbers(request, "to")
            self.world.turn_by_hand(self._joint(str(request.get("joint"))), angles, _number(request, "leg_s", 1.0))
            return {"t": self.now}
        if do == "let_go":
            self.world.let_go()
            return {"t": self.now}
        if do == "tilt":
            if self.world.settings.body.setup != "stand":
                raise _Failed("only a robot on its stand is tilted by hand")
            self.world.tilt_by_hand(_numbers(request, "rotation_rad", 3), _number(request, "seconds", 1.0))
            return {"t": self.now}
        if do == "put":
            if self.world.settings.body.setup != "floor":
                raise _Failed("only a robot on the floor can be put elsewhere")
            self.world.put(
                _numbers(request, "position_m", 2) if "position_m" in request else None,
                _numbers(request, "rotation_rad", 3) if "rotation_rad" in request else None,
            )
            return {"t": self.now}
        raise _Failed(
            f"no such request: {do!r} (now, open, advance, settle, wait, state, wiring, look, fault, plug, unplug, assemble, "
            "turn, let_go, tilt, put)"
        )

    def _arrive(self, control: _Control, request: dict[str, Any]) -> None:
        """Wait until all bytes are here that a client says it wrote; in stepped time they are written now."""
        deadline = time.monotonic() + SETTLE_TIMEOUT_S
        control.counts = True
        for name in self.ports:
            wanted = int(_number(request, f"{name}_written", 0)) + control.received[name]
            while (missing := wanted - self.received[name]) > len(self._waiting[name]):
                self._await(name, deadline)
            if missing > 0:
                self._take(name, missing)

    def _counts(self, control: _Control) -> dict[str, Any]:
        answer: dict[str, Any] = {"t": self.now}
        for name in ("bus", "imu"):
            answer[f"{name}_sent"] = self.sent[name] - control.sent[name]
            answer[f"{name}_arrivals"] = control.arrivals[name]
            control.arrivals[name] = []
        return answer

    def _advance(self, control: _Control, request: dict[str, Any]) -> dict[str, Any]:
        if not self.stepped:
            raise _Failed("time runs by itself: the robot was not started with --clock stepped")
        to, stood = _number(request, "to"), dict[str, Any]()
        writes = any(f"{name}_written" in request for name in self.sent)
        if writes:
            self._arrive(control, request)
            stood = self._let_act()
        else:
            self._take_uncounted()
        if to > self.now or not writes:
            self.advance(to)
            stood |= self._sleep_through()
        return (self._counts(control) if writes else {"t": self.now}) | stood

    def _let_act(self) -> dict[str, Any]:
        """Stepped: run until the last answer has reached the host, or the wire has fallen silent."""
        self.advance(max(self._act(), self.now))
        return self._sleep_through()

    def _wait(self, control: _Control, request: dict[str, Any]) -> dict[str, Any]:
        if not self.stepped:
            raise _Failed("time runs by itself: the robot was not started with --clock stepped")
        name = str(request.get("port"))
        if name not in self.ports:
            raise _Failed(f"no port {name!r}")
        self._arrive(control, request)
        before = self.sent[name]
        self.advance(_number(request, "to"), until=lambda: self.sent[name] > before)
        stood = self._sleep_through()
        return self._counts(control) | stood

    def _settle(self, control: _Control, request: dict[str, Any]) -> dict[str, Any]:
        self._arrive(control, request)
        stood: dict[str, Any] = {}
        if self.stepped:
            stood = self._let_act()
        else:
            while self._outbox:
                time.sleep(max(0.0, self._outbox[0][0] - self.now))
                self._keep_time()
        return self._counts(control) | stood

    def _sleep_through(self) -> dict[str, Any]:
        """Stepped: let a host that stands still now wake up where it goes on; `stood` of the answer."""
        settings, began = self.world.line.settings, self.now
        while settings.stalled_until > self.now:
            self.advance(settings.stalled_until)
        return {"stood": [began, self.now]} if self.now > began else {}

    def _await(self, name: str, deadline: float) -> None:
        """Wait for more bytes at one port, the pseudo-terminal's delivery being asynchronous."""
        files = self.ports[name].files
        left = deadline - time.monotonic()
        if not files or left <= 0 or not select.select(files, (), (), left)[0]:
            raise _Failed(f"the bytes announced for {name} did not arrive")
        self._read(name)

    def set_plugged(self, device: str, plugged: bool) -> None:
        """Pull a USB device ("bus" or "imu") out of the host, or put it back."""
        (self._unplugged.discard if plugged else self._unplugged.add)(device)
        if device in self.ports:
            (self.ports[device].plug if plugged else self.ports[device].unplug)()

    def _joint(self, joint: str) -> int:
        if joint not in self.world.joints:
            raise _Failed(f"no joint {joint!r}: there are {', '.join(self.world.joints)}")
        return self.world.joints.index(joint)

    def _plug(self, joint: str, plugged: bool) -> None:
        self.world.plug(self._joint(joint), plugged)
