"""A virtual robot in a process of its own, for a face that wants one: started and ended, or running already."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import tomlkit

from openant_tools.errors import BadInput, HardwareFault
from openant_tools.files import read_json
from openant_tools.numbers import exact
from openant_tools.optional import installed

__all__ = [
    "VIRTUAL_DEFAULT",
    "clock_of_its_own",
    "has_camera",
    "placeable",
    "placed",
    "read_ready_file",
    "ready_file",
    "virtual_robot",
]

#: the source that stands for a healthy standard Ant on its stand
VIRTUAL_DEFAULT = "default"
#: of a machine that has much else to do; a robot that cannot start says so at once
START_TIMEOUT_S = 180.0


@contextlib.contextmanager
def virtual_robot(source: str, *, clock: str | None = None, camera: bool = True) -> Iterator[Mapping[str, str | None]]:
    """What a ready file says of the virtual robot meant by `source`; one that was started ends with the block.

    Args:
        source: a scenario (NAME.toml), the ready file of a running one, or `VIRTUAL_DEFAULT`.
        clock: "real" or "stepped" for a robot started here; None for what its scenario says.
        camera: False leaves the camera of a robot started here out, for who does not look: it takes long to start.
    """
    running = ready_file(source)
    if running is not None:
        yield read_ready_file(running)
        return
    if source != VIRTUAL_DEFAULT and not Path(source).is_file():
        remedy = "name a scenario (NAME.toml) or a ready file, or give --virtual alone for a healthy robot"
        raise BadInput("there is no such scenario", where=source, remedy=remedy)
    with tempfile.TemporaryDirectory(prefix="openant-virtual-") as folder:
        ready = Path(folder) / "ready.json"
        command = [sys.executable, "-m", "openant_tools.cli", "virtual", "start", "--ready-file", str(ready)]
        command += [] if source == VIRTUAL_DEFAULT else ["--scenario", source]
        command += [] if clock is None else ["--clock", clock]
        command += [] if camera else ["--no-camera"]
        with open(Path(folder) / "log", "w+") as log:
            # A session of its own: Ctrl-C is for the command, which then ends the robot after torque is off. Its input is
            # a pipe from here, which breaks however this process ends: a robot does not outlive who started it.
            process = subprocess.Popen(
                [*command, "--until-eof"], stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True
            )
            try:
                _await(process, ready, log.name)
                yield read_ready_file(ready)
            finally:
                process.terminate()
                assert process.stdin is not None
                process.stdin.close()
                try:
                    process.wait(5.0)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def clock_of_its_own(source: str) -> str | None:
    """The clock of a robot that is started for one command: "stepped", unless its scenario says which.

    Nobody watches such a robot, so it need not wait for real time; and a host that is busy elsewhere cannot let a
    watchdog trip. None for what the scenario says, and for a robot that is running already.
    """
    if source == VIRTUAL_DEFAULT:
        return "stepped"
    clock = _scenario(source).get("clock", {}) if source.endswith(".toml") else None
    return "stepped" if isinstance(clock, dict) and "mode" not in clock else None


def placeable(source: str) -> bool:
    """Whether a virtual robot is started for this command and may be put elsewhere: its scenario is open to us, and it
    is not loose motors in a box."""
    if source == VIRTUAL_DEFAULT:
        return True
    robot = _scenario(source).get("robot", {}) if source.endswith(".toml") else None
    return isinstance(robot, dict) and robot.get("setup") != "loose" and "sealed" not in _scenario(source)


def has_camera(source: str) -> bool:
    """Whether the virtual robot that is meant has a camera; a sealed one counts as one that has."""
    running = ready_file(source)
    if running is not None:
        return read_ready_file(running)["camera"] is not None
    scene = {} if source == VIRTUAL_DEFAULT else _scenario(source).get("camera", {})
    return installed("cv2") and not (isinstance(scene, dict) and scene.get("present") is False)


@contextlib.contextmanager
def placed(source: str, setup: str, heading_rad: float = 0.0, *, doze: bool = False) -> Iterator[str]:
    """The source of a virtual robot like that of `source`, which is placeable, but standing elsewhere.

    Args:
        doze: for hours in which it mostly stands: nothing looks at it, and its mechanics are left out while it does.
    """
    document = tomlkit.document() if source == VIRTUAL_DEFAULT else _scenario(source)
    robot = document.setdefault("robot", tomlkit.table())
    there = robot.get("setup", "stand")
    if not doze and there == setup and (setup == "stand" or robot.get("heading_rad", 0.0) == heading_rad):
        yield source
        return
    robot["setup"], robot["heading_rad"] = setup, heading_rad
    if "eeprom" in robot:
        robot["eeprom"] = str(Path(source).resolve().parent / str(robot["eeprom"]))
    if source == VIRTUAL_DEFAULT:
        document["clock"] = {"mode": "stepped"}
    if doze:
        document.setdefault("clock", tomlkit.table()).setdefault("doze", True)
        document.setdefault("camera", tomlkit.table()).setdefault("present", False)
    with tempfile.TemporaryDirectory(prefix="openant-placed-") as folder:
        path = Path(folder) / (Path(source).name if source != VIRTUAL_DEFAULT else f"{setup}.toml")
        path.write_text(tomlkit.dumps(document), encoding="utf-8")
        yield str(path)


def _scenario(source: str) -> tomlkit.TOMLDocument:
    """A scenario as it stands; empty where it cannot be read: the robot itself will say what is wrong with it."""
    from openant_tools.robot.config import editable_document  # manuals, which need none of it, open at once

    try:
        return editable_document(Path(source).read_bytes(), source)
    except (OSError, BadInput):
        return tomlkit.document()


def _await(process: subprocess.Popen[bytes], ready: Path, log: str) -> None:
    give_up = time.monotonic() + START_TIMEOUT_S
    while not ready.is_file():
        if process.poll() is not None:
            words = Path(log).read_text().strip().splitlines()
            raise HardwareFault(
                words[-1].removeprefix("openant: ")
                if words
                else f"the virtual robot ended with status {process.returncode}"
            )
        if time.monotonic() > give_up:
            raise HardwareFault(f"the virtual robot is not ready after {exact(START_TIMEOUT_S, 's')}")
        time.sleep(0.02)


def ready_file(source: str) -> Path | None:
    """The ready file that a source is; None where a robot is started for it."""
    return None if source == VIRTUAL_DEFAULT or source.endswith(".toml") else Path(source)


def read_ready_file(path: Path) -> Mapping[str, str | None]:
    """Where a virtual robot that is running listens; raises BadInput."""
    try:
        content = read_json(path, "name what `openant virtual start --ready-file` wrote")
        return {"bus": str(content["bus"]), **{key: content.get(key) for key in ("imu", "camera", "control")}}
    except FileNotFoundError:
        raise BadInput("there is no such ready file", where=path, remedy="start a virtual robot first") from None
    except (OSError, KeyError, TypeError, AttributeError):
        remedy = "name what `openant virtual start --ready-file` wrote, or a scenario that ends with .toml"
        raise BadInput("this is no ready file of a virtual robot", where=path, remedy=remedy) from None
