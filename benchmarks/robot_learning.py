"""SAC on the virtual robot, through the bus, in real time: python benchmarks/robot_learning.py [--minutes 10]

A third of the way the servos' bus is unplugged for five seconds; at two thirds training is killed (`kill -9`) and begun again
with the same command. At the end every step's period since then, measured from command to command in the recordings' own stamps,
is compared with what the run said of itself: a missed deadline that was not reported is a failure (exit code 1).

The virtual robot stands for servos that do not share this computer: where that is allowed, it comes before other programs.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openant_tools.comms.clock import VirtualControl
from openant_tools.recording.reader import read_recording
from openant_tools.robot.config import Provenance
from openant_tools.robot.folder import create_robot

DT_S = 0.12
UNPLUGGED_S = 5.0
#: share of an engine's cycle of 10 ms by which a period may be too long (openant_env.hardware)
LATE_S = 0.005


def rows(run: Path) -> int:
    log = run / "transitions.f32"
    return log.stat().st_size // (59 * 4) if log.is_file() else 0


def wait_for(run: Path, steps: int, process: subprocess.Popen[bytes]) -> None:
    while rows(run) < steps:
        if process.poll() is not None:
            sys.exit(f"training ended with status {process.returncode} at step {rows(run)} of {steps}")
        time.sleep(0.05)


def periods(recordings: Sequence[Path]) -> np.ndarray:
    """s between changes of the commands in every recording: each action of chance or policy is another command."""
    found = [np.empty(0)]
    for path in recordings:
        run = read_recording(path).run
        command, t = run.signal("cmd"), run.column("cmd_t")
        known = np.isfinite(command).all(axis=1) & np.isfinite(t)
        command, t = command[known], t[known]
        changed = np.flatnonzero((np.diff(command, axis=0) != 0.0).any(axis=1)) + 1
        gaps = np.diff(t[changed])
        # Without ramps, whose commands change every cycle, and the rest before and after; and without waiting for help.
        slow = gaps > 0.6 * DT_S
        acting = slow & (gaps < 3.0)
        acting[1:] &= slow[:-1]
        acting[:-1] &= slow[1:]
        found.append(gaps[acting])
    return np.concatenate(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    steps = round(options.minutes * 60 / DT_S)
    with tempfile.TemporaryDirectory(prefix="robot-learning-") as name:
        folder = Path(name)
        robot = create_robot(
            folder / "ant",
            values={"camera.body_tag_id": 12},
            provenance={"motors": Provenance("measured", "benchmark")},
        )
        scenario, ready, run = folder / "floor.toml", folder / "ready.json", folder / "run"
        scenario.write_text('[robot]\nsetup = "floor"\n[clock]\nmode = "real"\n')
        start = [sys.executable, "-m", "openant_tools.cli"]
        virtual = subprocess.Popen([*start, "virtual", "start", "--scenario", scenario, "--ready-file", ready])
        process: subprocess.Popen[bytes] | None = None
        try:
            while not ready.is_file():
                time.sleep(0.05)
            control = VirtualControl(json.loads(ready.read_text())["control"])
            train = [
                *start, "train", "sac", "--env", "hardware", "--robot", str(robot.path), "--virtual", str(ready), "--yes",
                "--steps", str(steps), "--learning-start", str(min(500, steps // 6)), "--out", str(run),
                "--json", str(folder / "result.json"),
            ]  # fmt: skip
            began = time.monotonic()
            process = subprocess.Popen(train)
            wait_for(run, steps // 3, process)
            control.ask("fault", cause="usb_unplug", on=True)
            time.sleep(UNPLUGGED_S)
            control.ask("fault", cause="usb_unplug", on=False)
            wait_for(run, 2 * steps // 3, process)
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            kept, before = rows(run), set((run / "recordings").glob("*.mcap"))
            process = subprocess.Popen(train)
            if process.wait() != 0:
                sys.exit(f"training ended with status {process.returncode}")
            took = time.monotonic() - began
        finally:
            for one in (process, virtual):
                if one is not None and one.poll() is None:
                    one.terminate()
                    one.wait()
        recorded = sorted((run / "recordings").glob("*.mcap"))
        measured = periods(recorded)
        late, since = (
            int((gaps > DT_S + LATE_S).sum())
            for gaps in (measured, periods([path for path in recorded if path not in before]))
        )
        result = json.loads((folder / "result.json").read_text())
        interventions = (run / "interventions.csv").read_text().splitlines()[1:]
        answer = {
            "steps": rows(run), "steps_at_kill": kept, "robot_minutes": result["seconds"] / 60, "wall_minutes": took / 60,
            "updates": result["updates"], "late_steps": late,
            "late_steps_since_kill": since, "late_steps_told_since_kill": result["late"],
            "period_median_s": float(np.median(measured)), "period_p99_s": float(np.quantile(measured, 0.99)),
            "interventions": interventions, "load_average": os.getloadavg()[0],
        }  # fmt: skip
        print(json.dumps(answer, indent=2))
        if options.json is not None:
            options.json.write_text(json.dumps(answer, indent=2) + "\n")
        if since > result["late"]:
            sys.exit(f"{since - result['late']} late steps were not reported")


if __name__ == "__main__":
    main()
