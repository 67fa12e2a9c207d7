"""Training as a process: the same command that one would type, and how far it got, from the files that it writes."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from openant_agents.runs import CurvePoint, read_curve
from openant_tools.errors import BadInput
from openant_tools.tui.process import Process

__all__ = ["AGENTS", "Place", "PlayProcess", "TrainingProcess", "curve_so_far"]

#: where it walks; what is not `sim` moves a robot, and the stop key reaches it
Place = Literal["sim", "robot", "virtual"]
#: agents that this version has
AGENTS: tuple[str, ...] = tuple(
    name for name in ("sac", "sarsa") if importlib.util.find_spec(f"openant_agents.{name}") is not None
)


@dataclass
class TrainingProcess(Process):
    """One `openant train`.

    Attributes:
        agent: as in `AGENTS`.
        robot: the robot's folder.
        folder: of the run; one that stands there goes on.
        where: in the robot's simulation, on the robot itself, or on a virtual robot (started for it, on its floor).
        options: more of the command's.
    """

    agent: str
    robot: Path
    steps: int
    seed: int
    folder: Path
    where: Place = "sim"
    options: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        arguments = (
            *("train", self.agent, "--robot", str(self.robot), "--steps", str(self.steps), *self.options),
            *("--seed", str(self.seed), "--out", str(self.folder)),
            # Who starts it on the screen has said there that the robot may move.
            *(() if self.where == "sim" else ("--env", "hardware", "--yes")),
            *(("--virtual",) if self.where == "virtual" else ()),
        )
        super().__init__(arguments, self.folder / "train.log")


class PlayProcess(Process):
    """What is done with trained agents: evaluated, played, compared.

    Attributes:
        folder: the run's, or that of all runs.
    """

    def __init__(self, arguments: tuple[str, ...], folder: Path, where: Place = "sim") -> None:
        super().__init__(arguments, folder / f"{arguments[0]}.log")
        self.folder = folder
        self.where = where


def curve_so_far(folder: Path) -> list[CurvePoint]:
    """The learning curve of a run that is under way; none where there is no file yet."""
    try:
        return read_curve(folder)
    except BadInput:
        return []
