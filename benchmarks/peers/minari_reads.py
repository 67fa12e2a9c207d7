"""Minari's own classes read a dataset of ours."""

import subprocess
import sys
import tempfile
from pathlib import Path

from a_run import two_runs
from minari import MinariDataset

with tempfile.TemporaryDirectory() as place:
    runs = map(str, two_runs(Path(place)))
    out = Path(place) / "walks"
    subprocess.run(
        [sys.executable, "-m", "openant_tools", "rec", "export", *runs, "--to", "minari", "--out", out], check=True
    )
    dataset = MinariDataset(out / "data")
    episodes = list(dataset.iterate_episodes())
    assert [len(one.rewards) for one in episodes] == [149, 149]
    assert all(dataset.action_space.contains(action) for one in episodes for action in one.actions)
    print(f"{dataset.total_episodes} episodes, {dataset.total_steps} steps, actions within their space")
