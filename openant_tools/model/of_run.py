"""Which model a run is simulated with, and set up how."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from openant_tools.errors import BadInput
from openant_tools.model.plant import Plant, Setup, load_plant, setup_of
from openant_tools.recording.run import Run
from openant_tools.robot.folder import RobotFolder
from openant_tools.trust import follows

__all__ = ["models_of", "own_model", "plants_of", "with_model"]

_log = logging.getLogger(__name__)


def own_model(run: Run) -> Path | None:
    """The model that a run itself names, where that file is: one file is one model, from wherever runs name it.

    One elsewhere is not followed, and that is said.
    """
    own = run.model_path
    if own is None or not own.is_file():
        return None
    # A run in memory was named by a program, not by a file from anybody.
    if run.path is not None and follows(str(run.facts.model), run.path) is None:
        _say_elsewhere(str(run.path), str(run.facts.model))
        return None
    return own.resolve()


@functools.cache
def _say_elsewhere(run: str, model: str) -> None:
    """Once, however often a run is asked for its model."""
    _log.warning(
        "%s: its model %s lies elsewhere and is not followed → add --trust-paths if it may be, or name one by --model",
        run, model,
    )  # fmt: skip


def with_model(runs: Sequence[Run], model: Path) -> tuple[list[Run], tuple[str, ...]]:
    """The runs as runs of `model`, whatever they name themselves; and a line for each that names another."""
    said = tuple(
        f"{run.path or run.name}: its own model is {run.facts.model}, and {model} was named → leave --model out to play each "
        "run on its own"
        for run in runs
        if run.model_path is not None and run.model_path.is_file() and run.model_path.resolve() != model.resolve()
    )
    return [replace(run, facts=replace(run.facts, model=None)) for run in runs], said


def models_of(
    runs: Sequence[Run], model: Path | None, robot: Callable[[], RobotFolder] | None = None
) -> tuple[list[Run], Path, tuple[str, ...]]:
    """Which model each run is of: the one that was named, else its own, else that of the robot's folder.

    Args:
        model: of all runs, whatever they name themselves.
        robot: asked for where no model was named and a run names none.

    Returns:
        the runs, the model of those that name none (else the first run's), and a line for each run whose own is not taken.

    Raises:
        BadInput: nobody names a model.
    """
    if model is not None:
        named, said = with_model(runs, model)
        return named, model, said
    own = [own_model(run) for run in runs]
    first = next((path for path in own if path is not None), None)
    if first is not None and None not in own:
        return list(runs), first, ()
    if robot is None:
        raise BadInput("no model is named", remedy="name an MJCF of this robot, or the robot's folder")
    return list(runs), robot().model_path().resolve(), ()


def plants_of(runs: Sequence[Run], model: Path, joints: Sequence[str]) -> list[Plant]:
    """Of each run its own model, else `model`, set up as the run was made; the same plant for the same model and setup."""
    plants: dict[tuple[Path, Setup], Plant] = {}
    out = []
    for run in runs:
        key = own_model(run) or model, setup_of(run.facts.setup)
        if key not in plants:
            plants[key] = load_plant(key[0], joints, key[1])
        out.append(plants[key])
    return out
