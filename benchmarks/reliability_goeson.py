"""Campaigns for docs/reliability.md: disks that fill up under every recorder, and messages that are none."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Campaign

from openant_tools.comms import messages
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.restart import MotionStopped
from openant_tools.comms.setup import config_of_unknown_robot
from openant_tools.errors import OpenAntError
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.robot.kit import home_angles
from openant_tools.virtual.process import virtual_robot

__all__ = ["campaigns"]

#: s for a command, on a computer that does other things, too
PATIENCE_S = 300.0
#: bytes, between which a file's end is drawn: before the first rows are on the disk, and after some seconds
SMALLEST, LARGEST = 0, 120_000
#: name → words of the command, which records to OUT on the robot READY
RECORDERS = {
    "sysid record": "sysid record --virtual READY --protocol stand --seconds 60 --out OUT --yes",
    "comms soak": "comms soak --virtual READY --minutes 2 --every-cycle --out OUT --yes",
    "comms soak --still": "comms soak --virtual READY --minutes 2 --every-cycle --still --out OUT",
    "thermal soak": "thermal soak --virtual READY --minutes 60 --load hang --out OUT --yes",
}
HOME = np.array(home_angles())


def campaigns() -> list[Campaign]:
    """The rows of this file."""
    disks = [
        Campaign(
            f"`{name}` on a disk that is full after a random number of bytes: exit code 1, one line, torque off, whatever "
            "reached the disk is readable",
            5,
            lambda k, words=words: _full_disk(words, k),  # type: ignore[misc]
        )
        for name, words in RECORDERS.items()
    ]
    return [
        *disks,
        Campaign(
            "100 messages with any value in any field to an engine whose robot stands: refused or done, torque as it was",
            10,
            _any_messages,
        ),
        Campaign(
            "a goal with one joint not finite or beyond its limit, out of 100 such: refused by name", 10, _bad_goals
        ),
    ]


@contextlib.contextmanager
def _robot() -> Iterator[tuple[dict[str, Any], VirtualControl]]:
    with virtual_robot("default", clock="stepped", camera=False) as found:
        control = VirtualControl(str(found["control"]))
        try:
            yield dict(found), control
        finally:
            control.close()


def _torque(control: VirtualControl) -> int:
    return sum(control.ask("state")["torque_enable"].values())


def _full_disk(words: str, k: int) -> bool:
    """One try: no file of the command and its processes grows beyond a random size."""
    size = int(np.random.default_rng(k).integers(SMALLEST, LARGEST))
    with tempfile.TemporaryDirectory() as folder, _robot() as (found, control):
        ready, out = Path(folder) / "ready.json", Path(folder) / "run.mcap"
        ready.write_text(json.dumps(found))
        command = [{"READY": str(ready), "OUT": str(out)}.get(word, word) for word in words.split()]
        done = subprocess.run(
            [sys.executable, "-m", "openant_tools.cli", *command], text=True, capture_output=True, timeout=PATIENCE_S,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)), stdin=subprocess.DEVNULL,
            env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},  # or Python leaves parts of compiled modules
        )  # fmt: skip
        lines = [line for line in done.stderr.splitlines() if line.startswith("openant: ")]
        told = len(lines) == 1 and "Traceback" not in done.stderr
        kept = not out.exists() or _readable(out)
        return done.returncode in (1, 2) and told and kept and _torque(control) == 0


def _readable(path: Path) -> bool:
    try:
        return len(read_recording(path).run.t) > 0
    except OpenAntError as error:
        return "no row" in str(error) or "before its first row" in str(error)


@contextlib.contextmanager
def _standing() -> Iterator[tuple[EngineProcess, VirtualControl]]:
    with (
        _robot() as (found, control),
        EngineProcess(config_of_unknown_robot(str(found["bus"]), found["control"])) as engine,
    ):
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(HOME))
        yield engine, control


#: what a field may hold that is none of its kind
VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 0.05, float("nan"), float("inf"), 1e308, 10**400, "", "hip_rr", "goal_pwm", "torque_enable", b"\0",
    [], [0.0] * 8, (1, 2), {}, object, np.zeros(8), np.zeros((3, 8)), np.full(8, 3.0), np.full((2, 8), np.inf),
    np.zeros((2, 2, 2)), np.array(0.1), HOME, np.array([None] * 8), np.float32(0.1), "x" * 5000, 2j, Facts(("hip_rr",)),
)  # fmt: skip
#: messages that do not switch torque off by themselves, nor record
KINDS: tuple[Any, ...] = (
    messages.Ramp, messages.Play, messages.Hold, messages.Goal, messages.LetPass, messages.ReadRegister, messages.WriteRegister,
)  # fmt: skip


def _any_messages(k: int) -> bool:
    chance = np.random.default_rng(k)
    with _standing() as (engine, control):
        for _ in range(100):
            kind = KINDS[chance.integers(len(KINDS))]
            command = object.__new__(kind)
            for name in kind.__dataclass_fields__:
                object.__setattr__(command, name, VALUES[chance.integers(len(VALUES))])
            try:
                engine.ask(command, 60.0)
            except MotionStopped:
                return False
            except OpenAntError:
                pass
        engine.ask(messages.Ramp(HOME))
        return _torque(control) == 8 and not engine.ended


def _bad_goals(k: int) -> bool:
    chance = np.random.default_rng(k)
    with _standing() as (engine, control):
        before = np.array(list(control.ask("state")["angle"].values()))
        joints = [servo.joint for servo in engine.config.servos]
        for _ in range(100):
            joint = int(chance.integers(8))
            low, high = engine.config.limits_rad[joints[joint]]
            beyond = float(10.0 ** chance.uniform(-4, 300))
            value = [np.nan, np.inf, -np.inf, high + beyond, low - beyond][chance.integers(5)]
            target = HOME.copy()
            target[joint] = value
            try:
                engine.ask(messages.Goal(target, 0.05), 60.0)
            except MotionStopped:
                return False
            except OpenAntError as error:
                if joints[joint] in str(error):
                    continue
            return False
        after = np.array(list(control.ask("state")["angle"].values()))
        return _torque(control) == 8 and bool(np.abs(after - before).max() < 0.01)
