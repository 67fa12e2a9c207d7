"""The windows in which runs are simulated: short enough that a start from measurement holds, and those that tell most.

A choice asks no simulation. Each window is a vector of what its joints do: angles, speeds, steps, reversals, how far they stay behind.
The next one chosen is always that which adds most to the logarithm of the determinant of what all of them show together (a D-optimal
design, greedily), so that rich windows that are unlike each other win. Each fold has one, and its share of the time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.folds import Part, folds
from openant_tools.gap.regime import slope
from openant_tools.gap.usable import LEAST_S, Usable, usable
from openant_tools.model.plant import Plant, Setup
from openant_tools.numbers import number
from openant_tools.recording.run import Run

__all__ = ["AT_MOST_S", "Selection", "cut", "select", "window_s"]

Array = NDArray[np.float64]

#: s of all windows together, and of one on a stand and on a floor
AT_MOST_S, STAND_S, FLOOR_S = 12.0, 1.0, 2.0
#: by how much longer than asked a window may be before two are made of it
LONGER = 0.25
#: s, the grid on which a window's motion is looked at, whatever its rows are
GRID_S = 0.02
#: what of each joint counts as much as any other: rad of its angle and range, rad/s, rad of a step and behind its command, reversals in a s
USUAL = {"angle": 0.5, "range": 0.5, "speed": 2.0, "step": 0.5, "behind": 0.1, "scatter": 0.1, "reversals": 4.0}
#: rad/s from which a joint counts as going
GOES_RAD_S = 0.1
#: by how much a window that follows a chosen one is preferred: nothing has to start anew between them
FOLLOWS = 1.1
#: digits that count: what differs by less does so by rounding alone
DIGITS = 6
#: s that sums of windows are off by rounding
SLACK_S = 1e-6


@dataclass(frozen=True)
class Selection:
    """What of some runs is simulated.

    Attributes:
        usable: of each run, what can be.
        folds: what is held out in turn.
        windows: of each run, from and up to (s of its `t`), in order of time; none of a run of which nothing is simulated.
        fold: of each run, which of the folds each of its windows is in.
    """

    usable: tuple[Usable, ...]
    folds: tuple[Part, ...]
    windows: tuple[tuple[tuple[float, float], ...], ...]
    fold: tuple[tuple[int, ...], ...]

    @property
    def seconds(self) -> float:
        """s of all windows together."""
        return sum(stop - start for own in self.windows for start, stop in own)

    def __str__(self) -> str:
        """One line for a report."""
        able = number(sum(one.usable_s for one in self.usable), "s")
        whole = number(sum(one.seconds for one in self.usable), "s")
        lines = "; ".join(str(one) for one in self.usable if one.excluded)
        line = f"{number(self.seconds, 's')} simulated, of {able} that can be and {whole} recorded"
        return f"{line} ({lines})" if lines else line


def window_s(setup: Setup) -> float:
    """s, how long a window is where nobody says."""
    return FLOOR_S if setup is Setup.FLOOR else STAND_S


def select(
    runs: Sequence[Run],
    plants: Sequence[Plant],
    length_s: float | None = None,
    at_most_s: float = AT_MOST_S,
    held_out: int = 0,
) -> Selection:
    """The windows of some runs that are simulated: all, where they are no more than `at_most_s` together, else those that tell most.

    Args:
        plants: of each run, the model set up as it was made.
        length_s: of a window, about; default as `window_s`.
        held_out: how many of the last runs are judged on alone: of them as much time is simulated again, because few robots are.

    Raises:
        BadInput: too little of them can be simulated.
    """
    able = tuple(usable(run, plant) for run, plant in zip(runs, plants, strict=True))
    parts = folds(able)
    pieces = [
        _Piece(k, f, start, stop)
        for f, (k, part) in enumerate(parts)
        for start, stop in cut(able[k].stretches, part, length_s or window_s(plants[k].setup))
    ]
    if sum(piece.seconds for piece in pieces) > at_most_s:
        shown = {k: _Shown(runs[k], plants[k]) for k, _ in parts}
        what = np.array([shown[piece.run].window(piece.start, piece.stop) for piece in pieces])
        # What the same motion tells on a floor is another matter than on a stand.
        floor = np.array([plants[piece.run].setup is Setup.FLOOR for piece in pieces])[:, None]
        what = np.hstack([np.where(floor, 0.0, what), np.where(floor, what, 0.0)])
        judged = np.array([piece.run >= len(runs) - held_out for piece in pieces])
        chosen = _most_telling(pieces, what, at_most_s)
        alone = _most_telling(
            [piece for piece, one in zip(pieces, judged, strict=True) if one], what[judged], at_most_s
        )
        pieces = [piece for piece in chosen if piece.run < len(runs) - held_out] + alone
    # A fold of which nothing is simulated cannot be held out.
    there = sorted({piece.fold for piece in pieces})
    own = [[piece for piece in pieces if piece.run == k] for k in range(len(runs))]
    return Selection(
        able,
        tuple(parts[f][1] for f in there),
        tuple(tuple((piece.start, piece.stop) for piece in mine) for mine in own),
        tuple(tuple(there.index(piece.fold) for piece in mine) for mine in own),
    )


@dataclass(frozen=True)
class _Piece:
    """A window of a run, in a fold."""

    run: int
    fold: int
    start: float
    stop: float

    @property
    def seconds(self) -> float:
        return self.stop - self.start

    def adjacent(self, other: _Piece) -> bool:
        """Whether one follows the other."""
        return self.run == other.run and (self.start == other.stop or self.stop == other.start)


def cut(stretches: Sequence[tuple[float, float]], part: Part, length_s: float) -> list[tuple[float, float]]:
    """Windows of about a length (s), one after another, of what of stretches lies in a part."""
    out = []
    for start, stop in stretches:
        begin, end = max(start, part.start), min(stop, part.stop)
        if end - begin < LEAST_S:
            continue
        count = max(1, math.ceil((end - begin) / length_s - LONGER))
        edges = [begin + (end - begin) * k / count for k in range(count)] + [end]
        out += list(itertools.pairwise(edges))
    return out


def _most_telling(pieces: Sequence[_Piece], what: Array, at_most_s: float) -> list[_Piece]:
    """Those of the windows that tell most, in order of time; `what` (windows, numbers) each shows."""
    seconds = np.array([piece.seconds for piece in pieces])
    fold = np.array([piece.fold for piece in pieces], int)
    share = _shares(np.bincount(fold, seconds).astype(np.float64), at_most_s)
    spent, inverse = np.zeros(len(share)), np.eye(what.shape[1])
    left, follows = np.ones(len(pieces), bool), np.zeros(len(pieces), bool)
    while True:
        # One of each fold first, however short its share is; and where of each share less than a window is over, together that may be one.
        inside = left & (spent.sum() + seconds <= at_most_s + SLACK_S)
        steps = inside & (spent[fold] == 0), inside & (spent[fold] + seconds <= share[fold] + SLACK_S), inside
        fits = next((some for some in steps if some.any()), None)
        if fits is None:
            return [piece for piece, here in zip(pieces, left, strict=True) if not here]
        gain = np.log1p(np.einsum("wi,ij,wj->w", what, inverse, what)) * np.where(follows, FOLLOWS, 1.0)
        best = int(np.argmax(np.where(fits, np.round(gain, DIGITS), -np.inf)))
        left[best] = False
        spent[fold[best]] += seconds[best]
        follows |= [piece.adjacent(pieces[best]) for piece in pieces]
        along = inverse @ what[best]
        inverse -= np.outer(along, along) / (1.0 + what[best] @ along)


def _shares(there: Array, at_most_s: float) -> Array:
    """(folds,) s of the time that each may use: the same, but for folds that have less."""
    share = np.zeros(len(there))
    rest = at_most_s
    order = np.argsort(there, kind="stable")
    for k, f in enumerate(order):
        share[f] = min(float(there[f]), rest / (len(order) - k))
        rest -= share[f]
    return share


class _Shown:
    """What a run shows in each of its windows."""

    def __init__(self, run: Run, plant: Plant) -> None:
        self._grid: Array = np.arange(run.t[0], run.t[-1] + GRID_S, GRID_S)
        pos, cmd = run.signal("pos", plant.joints), run.signal("cmd", plant.joints)
        self._pos = np.stack([_onto(self._grid, run.t, one) for one in pos.T], axis=1)
        self._cmd = np.stack([_held(self._grid, run.command_times, one) for one in cmd.T], axis=1)
        self._speed = np.stack([slope(self._grid, one) for one in self._pos.T], axis=1)
        self._usual = np.median(self._pos, axis=0)

    def window(self, start: float, stop: float) -> Array:
        """(statistics · joints,) each of a size that counts alike."""
        inside = slice(*np.searchsorted(self._grid, [start, stop]))
        pos, cmd, speed = self._pos[inside], self._cmd[inside], self._speed[inside]
        behind = np.nan_to_num(cmd - pos)
        going = np.where(np.abs(speed) > GOES_RAD_S, np.sign(speed), 0.0)
        found = {
            "angle": (pos - self._usual).mean(axis=0),
            "range": np.ptp(pos, axis=0),
            "speed": np.sqrt(np.mean(np.square(speed), axis=0)),
            "step": np.nan_to_num(np.abs(np.diff(cmd, axis=0))).max(axis=0),
            "behind": behind.mean(axis=0),
            "scatter": behind.std(axis=0),
            "reversals": np.array([_reversals(one) for one in going.T]) / (stop - start),
        }
        return np.concatenate([found[name] / size for name, size in USUAL.items()]) / math.sqrt(len(USUAL))


def _onto(grid: Array, t: Array, values: Array) -> Array:
    known = np.isfinite(values)
    return np.interp(grid, t[known], values[known]) if known.any() else np.zeros(len(grid))


def _held(grid: Array, t: Array, values: Array) -> Array:
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(grid), np.nan)
    order = np.argsort(t[known], kind="stable")
    times, given = t[known][order], values[known][order]
    return np.asarray(given[np.maximum(np.searchsorted(times, grid, side="right") - 1, 0)])


def _reversals(going: Array) -> int:
    moves = going[going != 0]
    return int((moves[1:] != moves[:-1]).sum())
