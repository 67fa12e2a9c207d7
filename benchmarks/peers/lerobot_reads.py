"""LeRobot's own dataset class reads a dataset of ours."""

import subprocess
import sys
import tempfile
from pathlib import Path

from a_run import two_runs
from lerobot.datasets.lerobot_dataset import LeRobotDataset

with tempfile.TemporaryDirectory() as place:
    runs = map(str, two_runs(Path(place)))
    out = Path(place) / "walks"
    subprocess.run(
        [sys.executable, "-m", "openant_tools", "rec", "export", *runs, "--to", "lerobot", "--out", out], check=True
    )
    dataset = LeRobotDataset("openant/walks", root=out)
    first = dataset[0]
    assert dataset.num_episodes == 2
    assert dataset.num_frames == 300
    assert first["observation.state"].shape == (8,)
    assert first["task"] == "walk"
    print(
        f"{dataset.num_episodes} episodes, {dataset.num_frames} frames at {dataset.fps} a second, task {first['task']!r}"
    )
