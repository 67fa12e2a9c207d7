"""The runs of a command and the model that they are played with: which one, and what about them has to be said first."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from openant_tools.cli.log import mention
from openant_tools.cli.options import robot_folder

if TYPE_CHECKING:
    from openant_tools.recording.run import Run
    from openant_tools.robot.config import EffectEntry

__all__ = ["checked", "effects_of", "model_of", "read_runs", "say"]


def read_runs(paths: Sequence[Path]) -> list[Run]:
    """The runs at `paths`; those of a single row are left out, and that is said.

    Raises:
        BadInput: a run cannot be read, or none has a motion.
    """
    from openant_tools.recording.tables import read_run
    from openant_tools.sysid.rules import with_rows

    runs, said = with_rows([read_run(path) for path in paths])
    say(said)
    return runs


def model_of(runs: Sequence[Run], model: Path | None, robot: Path | None) -> tuple[list[Run], Path]:
    """The MJCF that was named, else the first that a run names, else that of the robot's folder.

    Returns:
        the runs, and the model of those that name none. Where one was named, it is that of all.
    """
    from openant_tools.model.of_run import models_of
    from openant_tools.robot.folder import RobotFolder

    named, path, said = models_of(runs, model, lambda: RobotFolder.at(robot_folder(robot)))
    say(said)
    return named, path


def effects_of(
    runs: Sequence[Run], path: Path, model: Path | None, robot: Path | None, file: Path | None
) -> tuple[tuple[EffectEntry, ...], Path | None]:
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
    return RobotFolder.at(folder).effects_beside(own_model(run) or path for run in runs)


def checked(
    runs: Sequence[Run],
    model: Path,
    joints: Sequence[str],
    effects: tuple[Sequence[EffectEntry], Path | None] = ((), None),
) -> list[Run]:
    """Go through the rules before anything is computed, and say what they note; the runs without whole turns.

    Args:
        effects: what acts with the model, and where that stands.

    Raises:
        BadInput: a rule refuses, or an effect was fitted with another model.
    """
    from openant_tools.effects.entries import check_pair
    from openant_tools.model.of_run import plants_of
    from openant_tools.sysid.identify import joints_in_common
    from openant_tools.sysid.rules import check_runs, without_turns

    common = joints_in_common(runs, model, joints or None)
    plants = plants_of(runs, model, common)
    entries, where = effects
    say(dict.fromkeys(line for p in plants for line in check_pair(entries, p.model, p.path, where)))
    check_runs(runs, plants, fitting=False, tell=lambda line: say([line]))
    return [without_turns(run, common) for run in runs]


def say(lines: Iterable[str]) -> None:
    """Notes, a line each, on stderr."""
    for line in lines:
        mention(line)
