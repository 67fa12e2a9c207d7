"""The runs of a command and the model that they are played with: which one, and what about them has to be said first."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from openant_tools.cli.options import robot_folder
from openant_tools.errors import BadInput

if TYPE_CHECKING:
    from openant_tools.recording.run import Run
    from openant_tools.robot.config import Effect

__all__ = ["check", "checked", "effects_of", "model_of", "read_runs", "say"]


def read_runs(paths: Sequence[Path]) -> list[Run]:
    """The runs at `paths`; those of a single row are left out, and that is said.

    Raises:
        BadInput: a run cannot be read, or none has a motion.
    """
    from openant_tools.recording.tables import read_run

    runs = [read_run(path) for path in paths]
    still = [run for run in runs if len(run.t) < 2]
    if still and len(still) == len(runs):
        raise BadInput(
            "it has one row: nothing can be seen to move", where=still[0].path, remedy="export all rows of the run"
        )
    say(f"{run.path}: it has one row and is left out → export all rows of the run" for run in still)
    return [run for run in runs if len(run.t) > 1]


def model_of(runs: Sequence[Run], model: Path | None, robot: Path | None) -> tuple[list[Run], Path]:
    """The MJCF that was named, else the first that a run names, else that of the robot's folder.

    Returns:
        the runs, and the model of those that name none. Where one was named, it is that of all.
    """
    from openant_tools.model.of_run import own_model, with_model
    from openant_tools.robot.folder import RobotFolder

    if model is not None:
        named, said = with_model(runs, model)
        say(said)
        return named, model
    own = [own_model(run) for run in runs]
    first = next((path for path in own if path is not None), None)
    if first is not None and None not in own:
        return list(runs), first
    return list(runs), RobotFolder.at(robot_folder(robot)).model_path()


def effects_of(
    runs: Sequence[Run], path: Path, model: Path | None, robot: Path | None, file: Path | None
) -> tuple[tuple[Effect, ...], Path | None]:
    """The `[[effect]]` entries that act with a model, and where they stand: the file's that was named, else the robot's where the
    model is the robot's own. A model that was named by itself is played by itself.

    Args:
        path: of the model, as `model_of` gave it.
        model, robot, file: as they were named on the command line.
    """
    from openant_tools.effects.entries import read_effects
    from openant_tools.model.of_run import own_model
    from openant_tools.model.plant import load_plant
    from openant_tools.robot.config import CONFIG_NAME
    from openant_tools.robot.folder import RobotFolder

    if file is not None:
        return read_effects(file, load_plant(path).joints), file
    folder = robot_folder(robot, must_exist=False)
    if (model is not None and robot is None) or not (folder / CONFIG_NAME).is_file():
        return (), None
    at = RobotFolder.at(folder)
    config = at.config()
    theirs = {(own_model(run) or path).resolve() for run in runs}
    if theirs != {at.model_path(config).resolve()}:
        return (), None
    return config.effects, at.config_file


def check(
    runs: Sequence[Run],
    model: Path,
    joints: Sequence[str],
    *,
    fitting: bool = False,
    effects: tuple[Sequence[Effect], Path | None] | None = None,
) -> tuple[str, ...]:
    """Go through the rules before anything is computed; what they note, which is said at once.

    Args:
        effects: what acts with the model, and where that stands; None where the command itself looks at it.

    Raises:
        BadInput: a rule refuses, or an effect was fitted with another model.
    """
    from openant_tools.effects.entries import check_pair
    from openant_tools.model.of_run import plants_of
    from openant_tools.sysid.identify import joints_in_common
    from openant_tools.sysid.rules import check_runs

    plants = plants_of(runs, model, joints_in_common(runs, model, joints or None))
    if effects is not None:
        entries, where = effects
        say(dict.fromkeys(line for p in plants for line in check_pair(entries, p.model, p.path, where)))
    return check_runs(runs, plants, fitting=fitting, tell=lambda line: click.echo(line, err=True))


def checked(
    runs: Sequence[Run], model: Path, joints: Sequence[str], effects: tuple[Sequence[Effect], Path | None] = ((), None)
) -> list[Run]:
    """The runs without whole turns, after `check`."""
    from openant_tools.sysid.identify import joints_in_common
    from openant_tools.sysid.rules import without_turns

    check(runs, model, joints, effects=effects)
    common = joints_in_common(runs, model, joints or None)
    return [without_turns(run, common) for run in runs]


def say(lines: Iterable[str]) -> None:
    """Notes, a line each, on stderr."""
    for line in lines:
        click.echo(line, err=True)
