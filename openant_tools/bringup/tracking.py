"""How a robot moved and how its models say that it would, around the moment at which the nominal one is worst."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.model.plant import Setup, load_plant
from openant_tools.model.rollout import Rollouts
from openant_tools.recording.run import Run
from openant_tools.report import plots
from openant_tools.robot.joints import JOINT_NAMES

__all__ = ["Moment", "draw_moment", "worst_moment"]

Array = NDArray[np.float64]

#: s, shown around the moment
WINDOW_S = 2.0


@dataclass(frozen=True)
class Moment:
    """A stretch of the held-out run for one joint: measured, and simulated by both models; rad against s."""

    joint: str
    t: Array
    command: Array
    measured: Array
    nominal: Array
    calibrated: Array


def worst_moment(run: Run, nominal: Path, calibrated: Path) -> Moment:
    """Where the nominal model is worst, on the stand.

    Raises:
        BadInput: a model cannot be read.
    """
    simulated = []
    for path in (nominal, calibrated):
        plant = load_plant(path, JOINT_NAMES, Setup.STAND)
        simulated.append(Rollouts(plant, [run])().pos[0])
    measured = run.signal("pos", JOINT_NAMES)
    squares = np.nan_to_num(measured - simulated[0]) ** 2
    width = max(2, min(len(run.t), round(WINDOW_S / float(np.median(np.diff(run.t))))))
    # Sums over every window, by differences of running sums.
    sums = np.vstack([np.zeros(squares.shape[1]), np.cumsum(squares, axis=0)])
    first, j = np.unravel_index(
        int(np.argmax(sums[width:] - sums[:-width])), (len(run.t) - width + 1, len(JOINT_NAMES))
    )
    rows = slice(int(first), int(first) + width)
    joint = JOINT_NAMES[int(j)]
    return Moment(
        joint, run.t[rows] - run.t[0], run.column(f"cmd.{joint}")[rows], measured[rows, j],
        simulated[0][rows, j], simulated[1][rows, j],
    )  # fmt: skip


def draw_moment(above: Any, below: Any, moment: Moment, title: str = "") -> None:
    """Positions into the upper axes, errors of both models into the lower."""
    plots.draw_tracking(
        above, below, moment.joint, moment.t, moment.command, moment.measured, moment.nominal, moment.calibrated,
        names=("data sheets", "calibrated"), title=title,
    )  # fmt: skip
