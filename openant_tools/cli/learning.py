"""What the commands that train share: the robot they are told, the refusal without torch, progress."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from openant_tools.cli.options import robot_folder
from openant_tools.errors import BadInput

if TYPE_CHECKING:
    from openant_agents.training import Progress

__all__ = ["LearningBar", "need_torch", "robot_argument"]


def need_torch() -> None:
    """Refuse in one line where the agents' extra is not installed."""
    import importlib.util

    if importlib.util.find_spec("torch") is None:
        raise BadInput("agents need torch, which is not installed", remedy="pip install 'openant-tools[agents]'")


def robot_argument(robot: Path | None, kit: str | None) -> dict[str, str]:
    """How the environment is told which robot: the folder named or lying here, else the nominal robot by its kit."""
    if kit is not None:
        if robot is not None:
            raise BadInput("--robot and --kit name two robots", remedy="give one of them")
        return {"kit": kit}
    return {"robot": os.path.abspath(robot_folder(robot))}


class LearningBar:
    """Progress on stderr: steps, robot time, average reward, steps a second, time left."""

    def __init__(self, steps: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=16),
            MofNCompleteColumn(),
            TextColumn("{task.fields[words]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._bar.add_task("learning", total=steps, words="")
        self._begun = False

    def __enter__(self) -> LearningBar:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def show(self, progress: Progress) -> None:
        if not self._begun:
            # A run that goes on did not get this far in no time.
            self._bar.reset(self._task, completed=progress.step)
            self._begun = True
        speed = self._bar.tasks[self._task].speed
        words = [f"{100 * progress.average_reward_m_s:+5.1f} cm/s", f"{progress.robot_seconds / 60:5.1f} min walked"]
        if speed:
            words.append(f"{speed:4.0f} steps/s")
        self._bar.update(
            self._task,
            completed=progress.step,
            description="learning" if progress.learning else "exploring",
            words="  ".join(words),
        )
