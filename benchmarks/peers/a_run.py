"""Two short runs to hand on, made without any hardware."""

from pathlib import Path

import numpy as np

from openant_tools.recording.run import Facts, Run
from openant_tools.recording.tables import write_table
from openant_tools.robot.joints import JOINTS


def two_runs(folder: Path) -> list[Path]:
    t = 0.02 * np.arange(150)
    paths = []
    for k in range(2):
        columns = {"base.x": 0.1 * t}
        for n, joint in enumerate(JOINTS):
            swing = 0.3 * np.sin(2 * np.pi * (0.5 + 0.1 * n) * t + k)
            columns |= {f"cmd.{joint}": swing, f"pos.{joint}": np.roll(swing, 2), f"vel.{joint}": np.gradient(swing, t)}
        paths.append(folder / f"walk-{k}.csv")
        write_table(Run(f"walk-{k}", Facts(tuple(JOINTS), setup="floor", protocol="walk"), t, columns), paths[-1])
    return paths
