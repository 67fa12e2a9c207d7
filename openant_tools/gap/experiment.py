"""A recording made ready to be diagnosed: its telling windows alone, on its models, each to be begun anew from measurement."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.gap.folds import FOLDS
from openant_tools.gap.protocol import RunSet, alike
from openant_tools.gap.windows import AT_MOST_S, Selection, select
from openant_tools.model.of_run import own_model
from openant_tools.model.plant import load_plant, setup_of
from openant_tools.recording.run import Run

__all__ = ["Experiment"]

Window = tuple[float, float]

#: s of rows before a window that are kept (what a lag or a buffer remembers, and from where a base is led), and after it
BEFORE_S, AFTER_S = 0.6, 0.05
#: s between stretches that are kept: more than any gap across which a base would be led, so that none is
PAUSE_S = 0.2


@dataclass(frozen=True)
class Experiment:
    """Runs, cut to what of them is simulated.

    Attributes:
        protocol: the runs to learn from, in windows; their times are compressed: between windows far apart little is left.
        parts: all runs, cut into what is held out, each part as a run of its own.
        training: parts that are fitted. folds: parts that are judged together, by fits that have not seen them.
        selection: what was chosen, in the times of the recordings.
    """

    protocol: RunSet
    parts: RunSet
    training: tuple[int, ...]
    folds: tuple[tuple[int, ...], ...]
    selection: Selection

    @classmethod
    def of(
        cls, runs: Sequence[Run], model: Path, joints: Sequence[str], hold_out: Sequence[Run] = (),
        at_most_s: float = AT_MOST_S,
    ) -> Experiment:  # fmt: skip
        """
        Args:
            runs: each on its own MJCF where it names one, else on `model`.
            hold_out: runs to judge on; without them all are, each part by fits without it, or all of a motion or of a setting.

        Raises:
            BadInput: too little of them can be simulated.
        """
        every = [*runs, *hold_out]
        models = [own_model(run) for run in every]
        plants = [
            load_plant(own or model, joints, setup_of(run.facts.setup)) for run, own in zip(every, models, strict=True)
        ]
        selection = select(every, plants, at_most_s=at_most_s, held_out=len(hold_out))
        whole, parts, of = [], [], []
        for k, (run, own) in enumerate(zip(every, models, strict=True)):
            if k < len(runs) and selection.windows[k]:
                whole.append((run, own, selection.windows[k]))
        for f, part in enumerate(selection.folds):
            k = next(k for k in range(len(every)) if f in selection.fold[k])
            mine = [window for window, fold in zip(selection.windows[k], selection.fold[k], strict=True) if fold == f]
            parts.append((dataclasses.replace(every[k], name=str(part)), models[k], mine))
            of.append(k)
        training = tuple(f for f, k in enumerate(of) if k < len(runs))
        held_out = tuple(f for f, k in enumerate(of) if k >= len(runs))
        if not training or len(held_out) < len(set(range(len(runs), len(every)))):
            raise BadInput(
                f"of {'the runs' if not training else 'a held-out run'} nothing can be simulated: {selection}",
                remedy="record the robot as it moves by itself",
            )
        folds = [(f,) for f in held_out] or _alike([every[k] for k in of], [str(models[k]) for k in of], joints)
        return cls(
            _protocol(whole, model, joints), _protocol(parts, model, joints), training, tuple(folds), selection
        )  # fmt: skip


def _alike(parts: Sequence[Run], settings: Sequence[str], joints: Sequence[str]) -> list[tuple[int, ...]]:
    """Parts of one kind of motion together, then those of one setting (a model of their own); by themselves where that makes few."""
    motions: list[list[int]] = []
    for k, run in enumerate(parts):
        group = next((group for group in motions if alike(run, parts[group[0]], joints)), None)
        if group is None:
            motions.append([k])
        else:
            group.append(k)
    by_setting = [[k for k, one in enumerate(settings) if one == setting] for setting in dict.fromkeys(settings)]
    groups = [group for groups in (motions, by_setting) if len(groups) > 1 for group in groups]
    return [tuple(group) for group in groups] if len(groups) >= FOLDS else [(k,) for k in range(len(parts))]


def _protocol(parts: Sequence[tuple[Run, Path | None, Sequence[Window]]], model: Path, joints: Sequence[str]) -> RunSet:
    cut = [_compressed(run, windows) for run, _, windows in parts]
    own = [own for _, own, _ in parts]
    return RunSet.of([run for run, _ in cut], model, joints, own, [windows for _, windows in cut])


def _compressed(run: Run, windows: Sequence[Window]) -> tuple[Run, tuple[Window, ...]]:
    """The rows about windows, closed up, and where the windows are then."""
    t = run.t
    near = np.zeros(len(t), bool)
    for start, stop in windows:
        near |= (t >= start - BEFORE_S) & (t < stop + AFTER_S)
    rows = np.flatnonzero(near)
    # By how much each row moves towards the first: all that was left out before it, but for a pause.
    gone = np.zeros(len(rows))
    breaks = np.flatnonzero(np.diff(rows) > 1) + 1
    for n in breaks:
        gone[n:] += t[rows[n]] - t[rows[n - 1]] - PAUSE_S
    columns = {name: values[rows] for name, values in run.columns.items()}
    if "cmd_t" in columns:
        columns["cmd_t"] = columns["cmd_t"] - gone
    moved = []
    for start, stop in windows:
        first = int(np.searchsorted(t[rows], start - 1e-9))
        by = float(gone[min(first, len(rows) - 1)])
        moved.append((start - by, stop - by))
    return dataclasses.replace(run, t=t[rows] - gone, columns=columns), tuple(moved)
