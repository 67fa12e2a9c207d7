"""Everything that goes wrong on a bus while the legs move, on a virtual robot in real time; its table is in the docs.

    python benchmarks/fault_campaign.py [--only WORDS] [--json FILE]

For each fault: how long until torque was off everywhere (or, where only the servos' watchdog is left, until nothing
moved), what the user was told, and whether the recording is whole up to there.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from openant_tools.comms import messages
from openant_tools.comms.clock import VirtualControl
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.comms.messages import EngineConfig, ImuConfig
from openant_tools.comms.setup import camera_of_robot, config_of_unknown_robot
from openant_tools.errors import HardwareFault, OpenAntError
from openant_tools.recording.reader import read_recording
from openant_tools.recording.run import Facts
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.robot.kit import home_angles
from openant_tools.virtual.process import VIRTUAL_DEFAULT, virtual_robot

HOME = np.array(home_angles())
WAVE = HOME + 0.2 * np.sin(2 * np.pi * np.arange(6000) / 100)[:, None]
STILL_RAD_S = 0.05
LONGEST_S = 3.0
PARENT = """
import json, sys, time, pickle
from openant_tools.comms import messages
from openant_tools.comms.engine_process import EngineProcess
from openant_tools.recording.run import Facts
config, wave, out = pickle.loads(sys.stdin.buffer.read())
engine = EngineProcess(config)
engine.ask(messages.Torque(True))
engine.ask(messages.Record(out, Facts(tuple(s.joint for s in config.servos))))
engine.start(messages.Play(wave))
print(json.dumps({"engine": engine.pid, "guardian": engine.description["guardian_pid"]}), flush=True)
time.sleep(120)
"""


@dataclass
class Row:
    fault: str
    released_s: float | None
    what: str
    told: str
    rows: int | None


class Robot:
    """A running virtual robot and its truth."""

    def __init__(self, ready: dict[str, Any]) -> None:
        self.ready = ready
        self.control = VirtualControl(ready["control"])

    def config(self, **changes: Any) -> EngineConfig:
        return replace(config_of_unknown_robot(self.ready["bus"], self.ready["control"]), **changes)

    def fault(self, cause: str, on: bool = True, **settings: Any) -> None:
        self.control.ask("fault", cause=cause, on=on, **settings)

    def torque(self, beyond: tuple[str, ...] = ()) -> bool:
        """Whether any servo that has power holds its joint, those behind a broken cable left out."""
        truth = self.control.ask("state")
        return any(
            on and truth["powered"][joint] for joint, on in truth["torque_enable"].items() if joint not in beyond
        )

    def moving(self) -> bool:
        return any(abs(speed) > STILL_RAD_S for speed in self.control.ask("state")["velocity"].values())

    def seconds_until(self, done: Callable[[], bool]) -> float | None:
        start = time.monotonic()
        while time.monotonic() - start < LONGEST_S:
            if done():
                return time.monotonic() - start
            time.sleep(0.004)
        return None

    def seconds_until_still(self) -> float | None:
        """Until nothing has moved for 0.1 s."""
        start, still = time.monotonic(), None
        while time.monotonic() - start < LONGEST_S:
            now = time.monotonic()
            if self.moving():
                still = None
            else:
                still = still or now
                if now - still > 0.1:
                    return still - start
            time.sleep(0.004)
        return None


@contextlib.contextmanager
def moving_engine(robot: Robot, out: Path, **changes: Any) -> Iterator[tuple[EngineProcess, int]]:
    """An engine whose legs have swung for a second."""
    with EngineProcess(robot.config(**changes)) as engine:
        engine.ask(messages.Torque(True))
        engine.ask(messages.Ramp(HOME))
        engine.ask(messages.Record(str(out), Facts(JOINT_NAMES)))
        number = engine.start(messages.Play(WAVE))
        time.sleep(1.5)
        list(engine.events())
        yield engine, number


def heard(engine: EngineProcess, number: int, seconds: float = 1.0) -> str:
    """What the user is told within a while: the motion's error, else the last notice."""
    words, end = "", time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            engine.done(number)
        except HardwareFault as error:
            return str(error)
        for event in engine.events():
            if isinstance(event, messages.Notice):
                words = event.text
        time.sleep(0.02)
    return words


def rows_of(path: Path) -> int | None:
    try:
        return len(read_recording(path).run.t)
    except OpenAntError:
        return None


def on_the_bus(robot: Robot, folder: Path, cause: str, **settings: Any) -> Row:
    """A fault of servos, cables or supply."""
    out = folder / f"{cause}.mcap"
    with moving_engine(robot, out) as (engine, number):
        robot.fault(cause, **settings)
        beyond = (settings["where"][-1],) if cause == "broken_wire" else ()
        released = robot.seconds_until(lambda: not robot.torque(beyond))
        told = heard(engine, number, 0.3 if released is not None else 1.0)
        what = "torque off"
        if beyond:
            what += f" before the break; watchdog behind it, still: {robot.seconds_until_still() is not None}"
        elif released is None:
            lost = max(servo["loss"] for servo in engine.ask(messages.Statistics())["servos"])
            what = f"goes on, up to {lost:.0%} of a servo's answers lost"
        robot.fault(cause, on=False, **settings)
    return Row(cause, released, what, told, rows_of(out))


def unplugged(robot: Robot, folder: Path) -> Row:
    out = folder / "unplugged.mcap"
    with moving_engine(robot, out) as (engine, number):
        robot.fault("usb_unplug", device="bus")
        still = robot.seconds_until_still()
        told = heard(engine, number)
        robot.fault("usb_unplug", on=False, device="bus")
        back = robot.seconds_until(lambda: not robot.torque())
        told += " … " + heard(engine, engine.start(messages.Statistics()), 0.5)
    return Row(
        "unplug in mid-motion",
        still,
        f"watchdog stops it; torque off {back or -1:.1f} s after plugging in",
        told,
        rows_of(out),
    )


def imu_silent(robot: Robot, folder: Path) -> Row:
    out = folder / "imu.mcap"
    with moving_engine(robot, out, imu=ImuConfig(robot.ready["imu"])) as (engine, number):
        robot.fault("imu_silent")
        told = heard(engine, number, 1.5)
        robot.fault("imu_silent", on=False)
    return Row("IMU silent", None, "goes on; its columns are empty from there", told, rows_of(out))


def camera_frozen(robot: Robot, folder: Path) -> Row:
    out = folder / "camera.mcap"
    with moving_engine(robot, out, camera=camera_of_robot(None, robot.ready["camera"])) as (engine, number):
        robot.fault("camera_frozen")
        told = heard(engine, number, 2.0)
        assert not engine.done(number)
        robot.fault("camera_frozen", on=False)
    return Row("camera frozen", None, "goes on; no pose from there", told, rows_of(out))


def wrong_baud(robot: Robot, folder: Path) -> Row:
    try:
        with EngineProcess(robot.config(baud=57_600)):
            told = "connected"
    except HardwareFault as error:
        told = str(error)
    return Row("wrong baud rate", None, "does not connect", told, None)


def killed(robot: Robot, folder: Path, which: tuple[str, ...]) -> Row:
    name = " and ".join(which)
    out = folder / f"kill {name}.mcap"
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert parent.stdin is not None
    assert parent.stdout is not None
    parent.stdin.write(pickle.dumps((robot.config(), WAVE, str(out))))
    parent.stdin.close()
    pids = json.loads(parent.stdout.readline()) | {"parent": parent.pid}
    time.sleep(3.0)
    for process in which:
        os.kill(pids[process], signal.SIGKILL)
    both = {"engine", "guardian"} <= set(which)
    took = robot.seconds_until_still() if both else robot.seconds_until(lambda: not robot.torque())
    parent.kill()
    parent.wait()
    time.sleep(0.5)
    with EngineProcess(robot.config()) as engine:
        told = "; next connect: " + " ".join(e.text for e in engine.events() if isinstance(e, messages.Notice))
    what = "watchdog stops it, torque stays on until the next connect" if both else "torque off"
    return Row(f"kill -9 {name}", took, what, told.removesuffix("; next connect: "), rows_of(out))


CASES: dict[str, Callable[[Robot, Path], Row]] = {
    "kill parent": lambda robot, folder: killed(robot, folder, ("parent",)),
    "kill engine": lambda robot, folder: killed(robot, folder, ("engine",)),
    "kill all": lambda robot, folder: killed(robot, folder, ("guardian", "engine", "parent")),
    "unplug": unplugged,
    "brown-out": lambda robot, folder: on_the_bus(robot, folder, "supply_weak", volts=8.0, resistance_ohm=3.0),
    "silent servo": lambda robot, folder: on_the_bus(robot, folder, "bad_servo", where="knee_fl", fraction=1.0),
    "1 % byte errors": lambda robot, folder: on_the_bus(robot, folder, "line_noise", byte_error=0.01),
    "10 % byte errors": lambda robot, folder: on_the_bus(robot, folder, "line_noise", byte_error=0.1),
    "equal ids": lambda robot, folder: on_the_bus(robot, folder, "duplicate_id", where="knee_rr", of="hip_fl"),
    "overheated": lambda robot, folder: on_the_bus(robot, folder, "overheated", where="knee_fl", temperature_c=85),
    "broken wire": lambda robot, folder: on_the_bus(robot, folder, "broken_wire", where=["hip_fl", "knee_fl"]),
    "IMU": imu_silent,
    "camera": camera_frozen,
    "wrong baud": wrong_baud,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    table = []
    load = os.getloadavg()[0]
    print("| fault | after | what happens | what the user is told | rows kept |\n|---|---|---|---|---|")
    for name, case in CASES.items():
        if options.only not in name:
            continue
        with virtual_robot(VIRTUAL_DEFAULT, clock="real") as ready, tempfile.TemporaryDirectory() as folder:
            robot = Robot(dict(ready))
            try:
                row = case(robot, Path(folder))
                for device in ("bus", "imu", "camera"):
                    row.told = row.told.replace(str(robot.ready[device]), device.upper())
            except OpenAntError as error:
                row = Row(name, None, "FAILED", str(error), None)
            table.append(vars(row) | {"case": name})
            after = "" if row.released_s is None else f"{row.released_s:.2f} s"
            print(f"| {name} | {after} | {row.what} | {row.told} | {row.rows or ''} |", flush=True)
    loads = [load, os.getloadavg()[0]]
    print(f"\nload {loads[0]:.1f} before, {loads[1]:.1f} after, on {os.cpu_count()} cores")
    if options.json:
        content = {"load": loads, "cores": os.cpu_count(), "faults": table}
        options.json.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
