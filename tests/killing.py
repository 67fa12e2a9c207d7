"""Every command that moves, begun on a virtual robot in real time, and a process of it killed while it holds torque."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import click

from openant_tools.cli import openant
from openant_tools.cli.hardware import Moving
from openant_tools.comms.clock import VirtualControl
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import create_robot
from openant_tools.robot.joints import JOINTS
from openant_tools.virtual.process import virtual_robot

__all__ = [
    "ELSEWHERE",
    "OFF_S",
    "WAYS",
    "InLine",
    "Late",
    "NotBegun",
    "Victim",
    "Way",
    "children",
    "moving_commands",
    "torque_after_kill",
]


class NotBegun(Exception):
    """The command ended before a process of it could be killed: a busy host lets watchdogs trip."""


class Late(NotBegun):
    """It took too long, and those who were to act stood in line for a processor for all that was too long: this tells nothing."""


#: s, the issue's own bound
OFF_S = 0.5

Victim = Literal["command", "engine", "guardian", "guardian+engine"]
#: s that a command may take to its first torque, on a machine that has much else to do
BEGIN_S = 120.0
#: s between two looks at a robot: before the first torque, and where a delay is measured
SELDOM_S, OFTEN_S = 0.05, 0.005

#: its mechanics leave the processors to those who are watched here: steps are long, and there are none while all stands still
STAND = "[camera]\npresent = false\n[clock]\ndoze = true\n[robot]\nstep_s = 0.002\n"
LOOSE = f'{STAND}setup = "loose"\n'
NAMED = LOOSE + "".join(
    f'[[servo]]\njoint = "{joint.name}"\nid = {joint.id}\nbaud = 1000000\nreturn_delay_time = 0\n'
    for joint in JOINTS.values()
)
#: in view of a camera whose pictures are small: finding tags costs most
FLOOR = """
[robot]
setup = "floor"
[camera]
width = 640
height = 360
fps = 12.0
position = [-0.35, 0.2, 1.3]
look_at = [-0.35, 0.2, 0.0]
"""


@dataclass(frozen=True)
class Way:
    """How a command is begun.

    Attributes:
        scenario: of the robot; one that stands on the floor has a camera. words: what follows the command's name; OUT is a
            new file or folder.
        campaign: it takes too long for a test, so that benchmarks/reliability_door.py alone kills it.
    """

    scenario: str
    words: tuple[str, ...] = ()
    campaign: bool = False


_OUT = ("--out", "OUT")
#: command → how it is begun
WAYS: Mapping[str, Way] = {
    "calib estop": Way(LOOSE),
    "calib ids": Way(LOOSE, ("--joint", "hip_rr")),
    "calib centre": Way(NAMED, ("--joint", "hip_rr")),
    "calib legs": Way(STAND, ("--joint", "hip_rr")),
    "calib comms": Way(STAND),
    "calib thermal": Way(STAND),
    "calib identify": Way(STAND),
    "comms soak": Way(STAND, _OUT),
    "thermal soak": Way(STAND, (*_OUT, "--load", "hang")),
    "sysid record": Way(STAND, (*_OUT, "--protocol", "stand")),
    "sysid scale": Way(STAND),
    "sysid tilt": Way(STAND, ("--imu",)),
    "bringup": Way(LOOSE),
    "calib zeros": Way(STAND, campaign=True),
    "calib bounds": Way(STAND, campaign=True),
    "train sarsa": Way(FLOOR, ("--env", "hardware", "--steps", "1000", *_OUT), campaign=True),
}
#: command → why it is not begun here; its engine is the one that the others are killed with
ELSEWHERE: Mapping[str, str] = {
    "check": "needs a robot with its bounds; it sweeps and records as `calib identify` does",
    "calib arena": "needs a camera, which a shared machine renders slowly",
    "train sac": "it walks in the environment that `train sarsa` walks in",
    "eval": "it walks in the environment that `train sarsa` walks in",
    "loop": "it walks by `eval`, as a command of its own",
    "policies play": "it walks in the environment that `train sarsa` walks in",
    "policies rank": "it walks in the environment that `train sarsa` walks in",
}


def moving_commands() -> list[str]:
    """Every command of `openant` that is declared as one that moves."""

    def walk(command: click.Command, path: tuple[str, ...]) -> Iterator[str]:
        if isinstance(command, click.Group):
            context = click.Context(command)
            for name in command.list_commands(context):
                inner = command.get_command(context, name)
                assert inner is not None
                yield from walk(inner, (*path, name))
        elif isinstance(command, Moving):
            yield " ".join(path)

    return list(walk(openant, ()))


def torque_after_kill(name: str, victims: tuple[Victim, ...], folder: Path) -> dict[Victim, float]:
    """Begin a command, and kill one process of it after the other while it holds torque.

    Args:
        victims: one after the other; "guardian+engine" at once, which the servos' own watchdogs alone notice: torque stays on, motion stops.

    Returns:
        victim → s until torque was off everywhere, or until another guardian was there, less the time that this process
        was itself late.

    Raises:
        Late: it was not within `OFF_S`, but would have been if nobody had waited for a processor.
    """
    way = WAYS[name]
    scenario = folder / "scenario.toml"
    scenario.write_text(way.scenario)
    sees = way.scenario == FLOOR
    calibrated = {"motors": Provenance("measured", "openant calib zeros")}
    robot = (
        create_robot(folder / "ant", values={"camera.body_tag_id": 12}, provenance=calibrated)
        if sees
        else create_robot(folder / "ant")
    )
    with virtual_robot(str(scenario), clock="real", camera=sees) as found, contextlib.ExitStack() as stack:
        ready = folder / "ready.json"
        ready.write_text(json.dumps(dict(found)))
        control = VirtualControl(str(found["control"]))
        stack.callback(control.close)
        words = [str(folder / "out.mcap") if word == "OUT" else word for word in way.words]
        log = stack.enter_context((folder / "log").open("wb"))
        command = subprocess.Popen(
            [sys.executable, "-m", "openant_tools.cli", *name.split(), "--robot", str(robot.path), "--virtual", str(ready),
             "--yes", *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
        )  # fmt: skip
        stack.callback(command.wait)
        stack.callback(command.kill)

        def torque() -> bool:
            return any(control.ask("state")["torque_enable"].values())

        def after(done: Callable[[], bool], limit_s: float) -> float:
            begin, late = time.monotonic(), 0.0
            pause = SELDOM_S if limit_s == BEGIN_S else OFTEN_S  # when it begins is not what is measured
            while not done():
                before = time.monotonic()
                if before - begin > limit_s or (limit_s == BEGIN_S and command.poll() is not None):
                    kind = NotBegun if limit_s == BEGIN_S else AssertionError
                    raise kind(f"{name}: not within {limit_s:g} s; " + (folder / "log").read_text()[-800:])
                time.sleep(pause)
                late += max(0.0, time.monotonic() - before - pause - 0.001)
            return time.monotonic() - begin - late

        def in_time(done: Callable[[], bool], actors: Sequence[int]) -> float:
            waited = InLine([*actors, _serving(scenario)])

            def looked() -> bool:
                waited.look()
                return done()

            took = after(looked, 5.0)
            if took > OFF_S >= took - waited.seconds:
                raise Late(f"{name}: {took:.2f} s, of which processes waited {waited.seconds:.2f} s for a processor")
            return took

        took: dict[Victim, float] = {}
        for victim in victims:
            after(torque, BEGIN_S)
            family = _family(command.pid)
            if victim == "guardian+engine":
                patience = time.monotonic() + 0.1
                while _speed(control) < MOVES_RAD_S and time.monotonic() < patience:
                    pass  # one that only holds has no motion to stop
                family = _family(command.pid)
                if not (family["engine"] and family["guardian"]):
                    raise NotBegun(f"{name}: it has ended already")
                os.kill(family["engine"], signal.SIGSTOP)  # or it starts another guardian in between
                os.kill(family["guardian"], signal.SIGKILL)
                os.kill(family["engine"], signal.SIGKILL)
                took[victim] = _last_motion(control)
                continue
            if victim == "guardian" and not family["guardian"]:
                raise AssertionError(f"{name}: torque is on and nobody guards it")
            pid = family[victim]
            os.kill(pid, signal.SIGKILL)
            if victim == "guardian":
                took[victim] = in_time(partial(_replaced, command.pid, pid, torque), [family["engine"]])
            else:
                took[victim] = in_time(lambda: not torque(), [family["engine"], family["guardian"]])
        return took


class InLine:
    """How long processes were ready to run and had no processor, since this was made; 0 where the system does not tell.

    Attributes:
        seconds: of all of them together, as of the last look.
    """

    def __init__(self, pids: Sequence[int]) -> None:
        self._first = {pid: _in_line(pid) for pid in pids if pid}
        self._last = dict(self._first)
        self.seconds = 0.0

    def look(self) -> None:
        """Read it anew; of a process that has ended, what was read last stands."""
        for pid, last in self._last.items():
            self._last[pid] = max(last, _in_line(pid))
        self.seconds = sum(last - self._first[pid] for pid, last in self._last.items())


def _in_line(pid: int) -> float:
    """s that threads of a process were ready to run and did not, all of them together: buses are served by others than the main one."""
    seconds = 0.0
    with contextlib.suppress(OSError):  # the process itself may end while its threads are listed
        for one in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            with contextlib.suppress(OSError, IndexError):
                seconds += int(one.read_text().split()[1]) * 1e-9
    return seconds


def _serving(scenario: Path) -> int:
    """The process of the virtual robot of this scenario, 0 if it is not found."""
    for pid in children(os.getpid()):
        with contextlib.suppress(OSError):
            if str(scenario).encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                return pid
    return 0


#: rad/s of a joint that moves
MOVES_RAD_S = 0.1


def _speed(control: VirtualControl) -> float:
    """rad/s of the fastest joint under torque; 0 where none has it."""
    before = control.ask("state")
    time.sleep(0.02)
    now = control.ask("state")
    if not any(now["torque_enable"].values()):
        return 0.0
    rates = [abs(now["angle"][joint] - before["angle"][joint]) for joint in now["angle"]]
    return float(max(rates) / max(now["t"] - before["t"], 1e-3))


def _last_motion(control: VirtualControl, seconds: float = 1.0) -> float:
    """When within so many s from now a joint was last seen to move under torque, s."""
    begin, moved = time.monotonic(), 0.0
    while (now := time.monotonic() - begin) < seconds:
        if _speed(control) > MOVES_RAD_S:
            moved = now
    return moved


def _replaced(command: int, gone: int, torque: Callable[[], bool]) -> bool:
    """Whether another guardian is there instead of the one that is gone, or torque is off."""
    return _family(command)["guardian"] not in (0, gone) or not torque()


def _family(pid: int) -> dict[Victim, int]:
    """The processes of a command by what they are; 0 for what is not there."""
    family: dict[Victim, int] = {"command": pid, "engine": 0, "guardian": 0}
    for role, parent, module in (
        ("engine", pid, "openant_tools.comms.engine"), ("guardian", 0, "guardian.py")
    ):  # fmt: skip
        for child in children(parent or family["engine"]):
            with contextlib.suppress(OSError):
                if module in Path(f"/proc/{child}/cmdline").read_text():
                    family[role] = child  # type: ignore[index]
    return family


def children(pid: int) -> list[int]:
    """Of all threads: a procedure may have started its engine in one of its own."""
    children = list[int]()
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            children += [int(word) for word in thread.read_text().split()]
    return children
