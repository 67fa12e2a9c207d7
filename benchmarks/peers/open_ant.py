"""The platform's own hardware environment and its SARSA(λ) agent, their files as they are, on the virtual robot.

Its repository is no package: it is cloned from `OPEN_ANT`, a place that git can clone from (default: GitHub). The environment shows its
camera's picture in a window of its own under Xvfb. Two things are handed to it that it does not ask for: Linux shows no camera of software
as V4L2's, so `cv2.VideoCapture` opens the virtual robot's stream whatever backend was named; and the SDK waits longer for an answer, since
on a busy machine a robot of software is late.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from their_files import cloned

SOURCE = os.environ.get("OPEN_ANT", "https://github.com/Openmind-Research-Institute/open-ant")
#: on the virtual robot
BODY_TAG = 12
HANDED = """
import cv2, dynamixel_sdk.port_handler
real = cv2.VideoCapture
cv2.VideoCapture = lambda device, *backend: real(device)
dynamixel_sdk.port_handler.LATENCY_TIMER = 300
"""
PLAY = """
import json, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from embodied_ant_env import make_ant_env
env = make_ant_env(json.load(open(sys.argv[2])), dt=0.1, render_mode="human")
for _ in range(100):  # until its tracker has seen the robot: before, it calls every step truncated
    if not env.step(np.zeros(8))[3]:
        break
env.reset()
seen, where, weight, cut = [], [], [], []
for step in range(60):
    action = np.tile([0.6 * np.sin(0.2 * step), 0.5 * np.cos(0.2 * step)], 4)
    observation, reward, terminated, truncated, info = env.step(action)
    cut.append(truncated)
    seen.append(info["joint_positions"])
    weight.append(np.linalg.norm([info[axis] for axis in ("ax", "ay", "az")]))
    where.append([info["current_x_position"], info["current_y_position"]])
env.close()
assert observation.shape == env.observation_space.shape
assert (np.ptp(seen, axis=0) > 0.1).all(), np.ptp(seen, axis=0)
assert 9.3 < np.median(weight) < 10.3, np.median(weight)
assert np.isfinite(where).all() and np.ptp(where, axis=0).max() > 1e-4
assert sum(cut) < 30, "its tracker lost the robot, or its motors failed"
print(f"60 steps, {sum(cut)} truncated, {np.median(weight):.1f} m/s2 at rest, moved {np.linalg.norm(np.ptp(where, axis=0)):.2f} m")
"""
#: a window's thread that still runs when Python takes itself apart aborts the program after its last word
END = "\nimport os, sys\nsys.stdout.flush()\nos._exit(0)"
LEARN = "import runpy, sys\nsys.path.insert(0, sys.argv[1]); sys.argv = sys.argv[2:]\nrunpy.run_path(sys.argv[0], run_name='__main__')"


def run(program: str, *words: object, cwd: Path) -> str:
    """What Python says of a program with what is handed to it, on a screen of Xvfb; Enter is pressed whenever it asks."""
    command = ["xvfb-run", "-a", sys.executable, "-c", HANDED + program + END, *map(str, words)]
    done = subprocess.run(command, cwd=cwd, input="\n" * 100, capture_output=True, text=True, timeout=150, check=False)
    if done.returncode:
        sys.exit(done.stdout[-1500:] + done.stderr[-1500:])
    return done.stdout


with tempfile.TemporaryDirectory() as temporary, cloned(SOURCE) as (theirs, commit):
    place = Path(temporary)
    openant = [sys.executable, "-m", "openant_tools"]
    (place / "floor.toml").write_text('[robot]\nsetup = "floor"\n[camera]\nfps = 5\n')
    robot = subprocess.Popen(
        [*openant, "virtual", "start", "--scenario", "floor.toml", "--ready-file", "ready.json"], cwd=place
    )
    try:
        for _ in range(600):
            if (place / "ready.json").exists():
                break
            time.sleep(0.1)
        ready = json.loads((place / "ready.json").read_text())
        subprocess.run([*openant, "config", "new", "--robot", "ant"], cwd=place, check=True, capture_output=True)
        subprocess.run([*openant, "config", "export", "--robot", "ant", "--out", "ant.json"], cwd=place, check=True)
        config = json.loads((place / "ant.json").read_text())
        config |= {"motor_port": ready["bus"], "imu_port": ready["imu"], "camera_id": ready["camera"]}
        config["camera_tag_ids"]["body"] = BODY_TAG
        (place / "ant.json").write_text(json.dumps(config))
        played = run(PLAY, theirs / "embodied_ant_env", "ant.json", cwd=place).splitlines()[-1]
        agent = sorted(theirs.glob("agents/*/sarsa_options_tilecoding.py"))[0]
        words = [
            "--hw_config",
            place / "ant.json",
            "--task",
            "forward",
            "--num_timelimit_episodes",
            1,
            "--iht_size_power",
            20,
        ]
        learned = run(LEARN, agent.parent, agent, *words, cwd=place)
        assert "Ep. 0" in learned, learned[-1500:]
    finally:
        robot.terminate()
        robot.wait(30)
    print(f"{commit}: its environment {played}; its SARSA(λ) took 30 options")
