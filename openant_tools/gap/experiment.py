"""A recording made ready to be diagnosed: its telling windows alone, on its models, each to be begun anew from measurement."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.protocol import Protocol
from openant_tools.gap.windows import AT_MOST_S, Selection, select
from openant_tools.model.plant import load_plant, setup_of
from openant_tools.recording.run import Run

__all__ = ["Experiment"]

Array = NDArray[np.float64]
Window = tuple[float, float]

#: s of rows before a window that are kept (what a lag or a buffer remembers, and from where a base is led), and after it
BEFORE_S, AFTER_S = 0.6, 0.05
#: s between stretches that are kept: more than any gap across which a base would be led, so that none is
PAUSE_S = 0.2


@dataclass(frozen=True)
class Experiment:
    """Runs, cut to what of them is simulated.

    Attributes:
        protocol: the runs, in windows; their times are compressed: between windows far apart little is left.
        folds: the same cut into what is held out in turn, each as a run of its own.
        selection: what was chosen, in the times of the recordings.
    """

    protocol: Protocol
    folds: Protocol
    selection: Selection

    @classmethod
    def of(
        cls,
        runs: Sequence[Run],
        model: Path,
        joints: Sequence[str],
        models: Sequence[Path | None],
        at_most_s: float = AT_MOST_S,
    ) -> Experiment:
        """
        Args:
            models: of each run its own MJCF, None for `model`.

        Raises:
            BadInput: too little of them can be simulated.
        """
        plants = [
            load_plant(own or model, joints, setup_of(run.facts.setup)) for run, own in zip(runs, models, strict=True)
        ]
        selection = select(runs, plants, at_most_s=at_most_s)
        some = [k for k in range(len(runs)) if selection.windows[k]]
        protocol = _protocol([(runs[k], models[k], selection.windows[k]) for k in some], model, joints)
        if len(some) > 1:
            return cls(protocol, protocol, selection)
        (k,) = some
        parts = []
        for f, part in enumerate(selection.folds):
            mine = [window for window, fold in zip(selection.windows[k], selection.fold[k], strict=True) if fold == f]
            parts.append((dataclasses.replace(runs[k], name=str(part)), models[k], mine))
        return cls(protocol, _protocol(parts, model, joints), selection)


def _protocol(
    parts: Sequence[tuple[Run, Path | None, Sequence[Window]]], model: Path, joints: Sequence[str]
) -> Protocol:
    cut = [_compressed(run, windows) for run, _, windows in parts]
    own = [own for _, own, _ in parts]
    return Protocol.of([run for run, _ in cut], model, joints, own, [windows for _, windows in cut])


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
