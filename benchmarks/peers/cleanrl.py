"""CleanRL's own SAC, its file as it is, on the Ant: nothing is changed but the environment's id.

Its repository is no package: it is cloned from `CLEANRL`, a place that git can clone from (default: GitHub).
"""

import os
import re
import subprocess
import sys

from their_files import cloned

STEPS, LEARNING_STARTS = 300, 100
SOURCE = os.environ.get("CLEANRL", "https://github.com/vwxyzjn/cleanrl")

with cloned(SOURCE) as (folder, commit):
    # Gymnasium imports what stands before the colon. Without an end to its episodes: the file still looks for what a truncated
    # one leaves behind by its name in Gymnasium 0.29.
    command = [sys.executable, "cleanrl/sac_continuous_action.py", "--env-id", "openant_env:openant/AntContinuing-v0"]
    command += ["--total-timesteps", str(STEPS), "--learning-starts", str(LEARNING_STARTS), "--buffer-size", "1000"]
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    played = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if played.returncode:
        sys.exit(played.stderr)
    rates = re.findall(r"SPS: (\d+)", played.stdout)
    assert rates, played.stdout
    print(
        f"sac_continuous_action.py ({commit}): {STEPS} steps, {rates[-1]} a second, {STEPS - LEARNING_STARTS} updates"
    )
