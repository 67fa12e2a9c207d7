"""What the commands that train share: the robot they are told, the refusal without torch, progress."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from openant_tools.cli.log import aside
from openant_tools.cli.options import robot_folder
from openant_tools.errors import BadInput
from openant_tools.files import read_json
from openant_tools.numbers import number
from openant_tools.workers import pass_on

if TYPE_CHECKING:
    from openant_agents.drops import DropWatch
    from openant_agents.training import TrainingProgress

__all__ = ["LearningBar", "kit_option", "need_agents", "robot_argument", "settings_of", "settings_option"]

Settings = TypeVar("Settings")

kit_option = click.option(
    "--kit", type=click.Choice(["standard", "lite"]), help="The bundled nominal robot, instead of --robot."
)
settings_option = click.option(
    "--settings", "settings_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="Settings that `openant tune --json` found. Options given here count more.",
)  # fmt: skip


def need_agents() -> None:
    """Refuse in one line where the agents' extra is not installed."""
    import importlib.util

    for name in ("torch", "numba"):
        if importlib.util.find_spec(name) is None:
            raise BadInput(f"agents need {name}, which is not installed", remedy="pip install 'openant-tools[agents]'")


def read_settings(file: Path | None, agent: str) -> dict[str, Any]:
    """The settings of an agent that `openant tune --json` found; none without a file.

    Raises:
        BadInput: the file holds no settings, or another agent's.
    """
    if file is None:
        return {}
    try:
        found = read_json(file, "name what `openant tune --json` wrote")
        settings, of = dict(found["settings"]), found["agent"]
    except OSError as error:
        raise BadInput(
            f"there is nothing to read ({error.strerror})", where=file, remedy="name what `openant tune --json` wrote"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(
            "it holds no settings of an agent", where=file, remedy="name what `openant tune --json` wrote"
        ) from error
    if of != agent:
        raise BadInput(f"these are settings of {of}, not of {agent}", where=file, remedy=f"use `openant train {of}`")
    return settings


def settings_of(kind: type[Settings], file: Path | None, agent: str, given: Mapping[str, Any]) -> Settings:
    """Settings of an agent: its defaults, what a file says, and over both what was given on the command line.

    Raises:
        BadInput: a setting that the agent does not have.
    """
    chosen = {**read_settings(file, agent), **{key: value for key, value in given.items() if value is not None}}
    for key, parameter in inspect.signature(kind).parameters.items():
        default: Any = parameter.default
        value: Any = chosen.get(key, default)
        kinds: tuple[type, ...] = (
            (bool,) if isinstance(default, bool) else (int,) if isinstance(default, int) else (int, float)
        )
        fits = isinstance(value, kinds) and isinstance(value, bool) == isinstance(default, bool)
        if not fits or (isinstance(value, float) and not math.isfinite(value)):
            raise BadInput(f"{key} is {str(value)[:40]!r}", where=file, remedy=f"a value like {default!r}")
    try:
        return kind(**chosen)
    except TypeError as error:
        raise BadInput(
            f"{agent} has no such setting: {error}", where=file, remedy="use what `openant tune` wrote"
        ) from None


def robot_argument(robot: Path | None, kit: str | None) -> dict[str, str]:
    """How the environment is told which robot: the folder named or lying here, else the nominal robot by its kit."""
    if kit is not None:
        if robot is not None:
            raise BadInput("--robot and --kit name two robots", remedy="give one of them")
        return {"kit": kit}
    return {"robot": os.path.abspath(robot_folder(robot))}


class LearningBar:
    """Progress on stderr: steps, robot time, average reward, steps a second, time left.

    Args:
        steps: wanted.
        folder: of the run, where one is to be watched for reward drops.
    """

    def __init__(self, steps: int, folder: Path | None = None) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=16),
            MofNCompleteColumn(),
            TextColumn("{task.fields[words]}"),
            TimeRemainingColumn(),
            console=aside(),
        )
        self._task = self._bar.add_task("learning", total=steps, words="")
        self._watch: DropWatch | None = None
        if folder is not None:
            from openant_agents.drops import DropWatch

            self._watch = DropWatch(folder)
        self._last: int | None = None

    def __enter__(self) -> LearningBar:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()
        if self._watch is not None:
            self._watch.finish()

    def show(self, progress: TrainingProgress, name: str | None = None) -> None:
        """Show how far a run is, under its name or else what it is doing."""
        if self._last is None or progress.step < self._last:
            # A run that goes on did not get this far in no time, and the next run begins anew.
            self._bar.reset(self._task, completed=progress.step)
        self._last = progress.step
        speed = self._bar.tasks[self._task].speed
        words = [
            number(100 * progress.average_reward_m_s, "cm/s", sign=True, decimals=1),
            f"{number(progress.robot_seconds / 60, 'min', decimals=1)} walked",
        ]
        if speed:
            words.append(number(speed, "steps/s", decimals=0))
        self._bar.update(
            self._task,
            completed=progress.step,
            description=name or ("learning" if progress.learning else "exploring"),
            words="  ".join(words),
        )
        pass_on(
            progress.step / progress.steps, number(100 * progress.average_reward_m_s, "cm/s", sign=True, decimals=1)
        )
        drop = self._watch.see(progress) if self._watch is not None else None
        if drop is not None:
            self._bar.console.print(
                f"the reward dropped from {number(100 * drop.best_m_s, decimals=1)} to {number(100 * drop.lowest_m_s, 'cm/s', decimals=1)} at"
                f" {number(drop.from_s / 60, 'min', decimals=0)}: the checkpoint is kept in drops/; `openant plot` says what preceded it"
            )
