"""Training as a process: the same command that one would type, and how far it got, from the files that it writes."""

from __future__ import annotations

import csv
import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from openant_tools.tui.process import Process

__all__ = ["AGENTS", "CurvePoint", "Place", "Play", "Training", "read_curve"]

#: where it walks; what is not `sim` moves a robot, and the stop key reaches it
Place = Literal["sim", "robot", "virtual"]
#: last lines of what a command said

SAID = 6
#: agents that this version has
AGENTS: tuple[str, ...] = tuple(
    name for name in ("sac", "sarsa") if importlib.util.find_spec(f"openant_agents.{name}") is not None
)


@dataclass(frozen=True)
class CurvePoint:
    """One row of learning_curve.csv: steps, s of robot time, m/s over the last 120 s."""

    step: int
    seconds: float
    average_reward_m_s: float


@dataclass
class Training(Process):
    """One `openant train`.

    Attributes:
        agent: as in `AGENTS`.
        robot: the robot's folder.
        folder: of the run; one that stands there goes on.
        where: in the robot's simulation, on the robot itself, or on a virtual robot (started for it, on its floor).
    """

    agent: str
    robot: Path
    steps: int
    seed: int
    folder: Path
    where: Place = "sim"

    def __post_init__(self) -> None:
        arguments = (
            *("train", self.agent, "--robot", str(self.robot), "--steps", str(self.steps)),
            *("--seed", str(self.seed), "--out", str(self.folder)),
            # Who starts it on the screen has said there that the robot may move.
            *(() if self.where == "sim" else ("--env", "hardware", "--yes")),
            *(("--virtual",) if self.where == "virtual" else ()),
        )
        super().__init__(arguments, self.folder / "train.log")


class Play(Process):
    """What is done with trained agents: evaluated, played, compared."""

    def __init__(self, arguments: tuple[str, ...], folder: Path, where: Place = "sim") -> None:
        super().__init__(arguments, folder / f"{arguments[0]}.log")
        self.where = where

    @property
    def said(self) -> list[str]:
        """Its last lines."""
        try:
            return self.log.read_text(encoding="utf-8", errors="replace").splitlines()[-SAID:]
        except OSError:
            return []


def read_curve(folder: Path) -> list[CurvePoint]:
    """The learning curve so far; a last line that is half written, or no file at all, is none."""
    points = []
    try:
        with (folder / "learning_curve.csv").open(encoding="utf-8", newline="") as stream:
            for row in csv.DictReader(stream):
                try:
                    point = CurvePoint(int(row["step"]), float(row["seconds"]), float(row["average_reward_m_s"]))
                except (KeyError, TypeError, ValueError):
                    continue
                if math.isfinite(point.average_reward_m_s):
                    points.append(point)
    except OSError:
        pass
    return points
