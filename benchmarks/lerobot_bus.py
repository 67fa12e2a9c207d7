"""LeRobot's `DynamixelMotorsBus`, unmodified, on the virtual Lite robot: set up, scan, calibrate, a thousand cycles.

LeRobot 0.4.4 wants other versions of much than we do, and most of it is not for motors: it gets an environment of its
own with what its motors package imports.

    python -m venv /tmp/lerobot
    /tmp/lerobot/bin/pip install --no-deps lerobot==0.4.4
    /tmp/lerobot/bin/pip install "dynamixel-sdk<3.9" "deepdiff<9" "torch<2.11" pyserial tqdm draccus accelerate datasets

    python benchmarks/lerobot_bus.py --lerobot /tmp/lerobot/bin/python [--json FILE]

Eight factory-fresh motors come out of the box one at a time, as `lerobot-setup-motors` asks for them; then the robot
is assembled on its stand. LeRobot knows no XC430-W240, so that the standard Ant is not for it.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SCENARIO = '[robot]\nkit = "lite"\nsetup = "loose"\n[camera]\npresent = false\n'
IDS = {
    "hip_rr": 10, "knee_rr": 11, "hip_fr": 20, "knee_fr": 21, "hip_fl": 30, "knee_fl": 31, "hip_rl": 40, "knee_rl": 41,
}  # fmt: skip
CYCLES, PERIOD_S, HASTY = 1000, 0.01, 40


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lerobot", type=Path, help="the Python that has LeRobot")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--client", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--cycles-at", metavar="PORT", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=3.0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cycles_at:
        print(json.dumps(cost_of_cycles(options.cycles_at, options.seconds)))
        return
    if options.client:
        print(json.dumps(client(json.loads(options.client.read_text()))))
        return
    if options.lerobot is None:
        parser.error("--lerobot PYTHON names the environment; see the top of this file")
    with tempfile.TemporaryDirectory() as folder:
        scenario, ready = Path(folder) / "lite.toml", Path(folder) / "ready.json"
        scenario.write_text(SCENARIO)
        command = [sys.executable, "-m", "openant_tools.cli", "virtual", "start"]
        robot = subprocess.Popen(
            [*command, "--scenario", str(scenario), "--ready-file", str(ready)], stdout=subprocess.DEVNULL
        )
        try:
            while not ready.is_file():
                if robot.poll() is not None:
                    sys.exit("the virtual robot did not start")
                time.sleep(0.05)
            ran = subprocess.run(
                [str(options.lerobot), __file__, "--client", str(ready)], stdout=subprocess.PIPE, text=True, check=False
            )
        finally:
            robot.terminate()
            robot.wait()
    if ran.returncode:
        sys.exit("LeRobot did not get through")
    steps = json.loads(ran.stdout.splitlines()[-1])
    print("| step | seconds | what came of it |\n|---|---|---|")
    for step in steps:
        print(f"| {step['step']} | {step['seconds']:.1f} | {step['result']} |")
    if options.json:
        options.json.write_text(json.dumps(steps, indent=2) + "\n")


# ---- what runs in LeRobot's environment --------------------------------------------------------------------------


def cost_of_cycles(port: str, seconds: float) -> dict[str, float]:
    """What `benchmarks/bus_client.py` measures, with LeRobot: "write 8 goals, read 8 blocks of 27 bytes"."""
    from lerobot.motors import Motor, MotorNormMode
    from lerobot.motors.dynamixel import DynamixelMotorsBus

    bus = DynamixelMotorsBus(
        port, {joint: Motor(id, "xl430-w250", MotorNormMode.RANGE_M100_100) for joint, id in IDS.items()}
    )
    bus.connect(handshake=False)
    bus.set_baudrate(1_000_000)
    ids, goals = list(IDS.values()), {joint: 2048 + k for k, joint in enumerate(IDS)}
    items = (
        (120, 2), (122, 1), (123, 1), (124, 2), (126, 2), (128, 4), (132, 4), (136, 4), (140, 4), (144, 2), (146, 1),
    )  # fmt: skip

    def cycle() -> list[int]:
        bus.sync_write("Goal_Position", goals, normalize=False)
        # Its public sync_read takes one register by name; the block of all eleven goes through what lies below it.
        bus._sync_read(120, 27, ids)
        return [[bus.sync_reader.getData(id, address, size) for address, size in items][6] for id in ids]

    assert cycle() == [2048 + id for id in ids]
    best, rounds = {"cpu_us": float("inf"), "hz": 0.0}, 5
    for _ in range(rounds):
        cycles, cpu, start = 0, time.process_time(), time.perf_counter()
        while (took := time.perf_counter() - start) < seconds / rounds:
            cycle()
            cycles += 1
        best["cpu_us"] = min(best["cpu_us"], (time.process_time() - cpu) / cycles * 1e6)
        best["hz"] = max(best["hz"], cycles / took)
    return best


def client(ready: dict[str, Any]) -> list[dict[str, Any]]:
    """All steps; raises where LeRobot does."""
    from lerobot.motors import Motor, MotorCalibration, MotorNormMode
    from lerobot.motors.dynamixel import DynamixelMotorsBus

    control = socket.socket(socket.AF_UNIX)
    control.connect(ready["control"])
    lines = control.makefile("rw")

    def tell(do: str, **fields: Any) -> dict[str, Any]:
        lines.write(json.dumps({"do": do, **fields}) + "\n")
        lines.flush()
        answer: dict[str, Any] = json.loads(lines.readline())
        assert "error" not in answer, answer
        return answer

    motors = {joint: Motor(id, "xl430-w250", MotorNormMode.RANGE_M100_100) for joint, id in IDS.items()}
    bus = DynamixelMotorsBus(ready["bus"], motors)
    steps: list[dict[str, Any]] = []

    def step(name: str, do: Callable[[], str]) -> None:
        begin = time.perf_counter()
        result = do()
        steps.append({"step": name, "seconds": time.perf_counter() - begin, "result": result})
        print(steps[-1], file=sys.stderr)

    def set_up() -> str:
        for joint in motors:
            tell("plug", joint=joint)
            time.sleep(0.6)  # a servo that gets its power is mute for a while
            bus.setup_motor(joint)
            tell("unplug", joint=joint)
        truth = tell("assemble", setup="stand") and tell("state")
        assert truth["id"] == IDS, truth["id"]
        assert set(truth["baud"].values()) == {1_000_000}
        time.sleep(0.6)
        bus.port_handler.closePort()
        return "8 motors found at 57,600 baud as id 1; ids 10 to 41 and 1,000,000 baud written"

    def scan() -> str:
        found = DynamixelMotorsBus.scan_port(ready["bus"])
        assert found == {1_000_000: list(IDS.values())}, found
        return f"all 8 ids at 1,000,000 baud, nobody at {len(bus.available_baudrates) - 1} other rates"

    def connect() -> str:
        bus.connect()
        bus.configure_motors()
        return "handshake: ids and models right; return delays set to 0"

    def calibrate() -> str:
        bus.disable_torque()
        offsets = bus.set_half_turn_homings()
        positions = bus.sync_read("Present_Position", normalize=False)
        assert all(abs(position - 2047) <= 2 for position in positions.values()), positions
        # Nobody is there to move the legs by hand: slow servos do it while LeRobot watches, until "Enter" is pressed.
        bus.enable_torque()
        for joint in motors:
            bus.write("Profile_Velocity", joint, 20)
        bus.sync_write("Goal_Position", dict.fromkeys(motors, 2047 - 300), normalize=False)
        time.sleep(2.0)
        bus.sync_write("Goal_Position", dict.fromkeys(motors, 2047 + 300), normalize=False)
        time.sleep(0.01)
        reading, writing = os.pipe()
        os.dup2(reading, 0)
        threading.Timer(4.0, os.write, (writing, b"\n")).start()
        lows, highs = bus.record_ranges_of_motion(display_values=False)
        bus.disable_torque()
        ranges = {joint: MotorCalibration(IDS[joint], 0, offsets[joint], lows[joint], highs[joint]) for joint in motors}
        bus.write_calibration(ranges)
        assert bus.is_calibrated
        widths = [highs[joint] - lows[joint] for joint in motors]
        return f"offsets written; ranges of {min(widths)} to {max(widths)} pulses recorded, written, read back equal"

    def cycles() -> str:
        for joint in motors:
            bus.write("Profile_Velocity", joint, 0)
        bus.enable_torque()
        failed, worst, begin, error = 0, 0.0, time.perf_counter(), 0.0
        goals = dict.fromkeys(motors, 0.0)
        for n in range(CYCLES):
            start = time.perf_counter()
            try:
                seen = bus.sync_read("Present_Position")
                if n > 100:
                    error = max(error, *(abs(seen[joint] - goals[joint]) for joint in motors))
            except ConnectionError:
                failed += 1
            goals = dict.fromkeys(motors, 30.0 * (1 if n // 100 % 2 else -1) * min(1.0, n % 100 / 50))
            bus.sync_write("Goal_Position", goals)
            worst = max(worst, time.perf_counter() - start)
            # Never at once, even where it is late: a read right after a sync write is missed.
            time.sleep(max(0.001, begin + (n + 1) * PERIOD_S - time.perf_counter()))
        rate = CYCLES / (time.perf_counter() - begin)
        return f"{CYCLES} cycles at {rate:.0f} Hz, {failed} failed reads, slowest {worst * 1e3:.1f} ms"

    def hasty() -> str:
        failed = 0
        for _ in range(HASTY):
            bus.sync_write("Goal_Position", dict.fromkeys(motors, 0.0))
            try:
                bus.sync_read("Present_Position")
            except ConnectionError:
                failed += 1
            time.sleep(0.02)
        return (
            f"{failed} of {HASTY} reads fail: servos are deaf for 0.2 ms after a sync write (fewer on a busy machine)"
        )

    step("`setup_motor`, motors one at a time", set_up)
    step("`scan_port`", scan)
    step("`connect`, `configure_motors`", connect)
    step("homing, `record_ranges_of_motion`, `write_calibration`", calibrate)
    step("`sync_read`, then `sync_write`", cycles)
    step("`sync_write`, and `sync_read` at once", hasty)
    bus.disconnect()
    assert not any(tell("state")["torque_enable"].values())
    return steps


if __name__ == "__main__":
    main()
