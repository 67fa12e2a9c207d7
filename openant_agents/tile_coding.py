"""Tile coding: a vector of real numbers as the few tiles that it falls into (Sutton and Barto 2018, section 9.5.4).

Each of n tilings covers the space with boxes, `tiles` of them along the range of each number, and every tiling is
shifted against the others: tiling k by k(2i + 1)/n of a tile along the i-th number, the displacement by odd numbers that
Miller and Glanz recommend and the Tiles3 software uses. Two points that share a box in one tiling share its weight.

No box shares a row by its hash: each box that was ever seen has a row of its own, in the order of appearance, so that the code
is exact for as long as the table has rows. Only then does a new box share the row of others, which is counted. A hash only
says where to look for a box's name (linear probing, Knuth 1998, section 6.4). The looking up is compiled.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from openant_agents.compiled import compiled
from openant_tools.errors import BadInput
from openant_tools.numbers import literal

__all__ = ["TileCoder"]

#: boxes along one number, beyond which a coordinate would not fit the byte it is kept in (one more for the shift)
MOST_TILES = 126
#: bytes of the words that a box's name is made of
WORD = 8
#: places for names at first; the share of them beyond which there are twice as many
PLACES, CROWDED = 2**22, 0.5
#: what stands in a place without a name
EMPTY = -1

Rows = NDArray[np.int64]
Words = NDArray[np.uint64]
Floats = NDArray[np.float64]


class TileCoder:
    """From observations to rows of a table of weights.

    Args:
        low, high: (inputs,), the range of each number that the tiles divide; what lies beyond counts as its end.
        tiles: boxes along each range.
        tilings: how many; a power of two that is 4 times the inputs or more spreads them evenly, others do nearly.
        rows: of the table.

    Raises:
        BadInput: a range that is none, or more tiles than can be told apart.
    """

    def __init__(
        self,
        low: NDArray[np.floating],
        high: NDArray[np.floating],
        *,
        tiles: int,
        tilings: int,
        rows: int,
    ) -> None:
        self.low, self.high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        if self.low.ndim != 1 or self.low.shape != self.high.shape:
            raise BadInput(f"bounds of shapes {self.low.shape} and {self.high.shape} are none of one vector")
        narrow = np.flatnonzero(~(np.isfinite(self.high - self.low) & (self.high > self.low)))
        if len(narrow):
            at = narrow[0]
            raise BadInput(
                f"the bounds of observation {at} leave no room for tiles: {literal(self.low[at])} to {literal(self.high[at])}",
                remedy="measure the bounds while the robot moves all its joints",
            )
        if not 1 <= tiles <= MOST_TILES:
            raise BadInput(f"{tiles} tiles along a range", remedy=f"use 1 to {MOST_TILES}")
        if tilings < 1 or rows < tilings:
            raise BadInput(f"{tilings} tilings in a table of {rows} rows", remedy="a tiling needs at least a row")
        self.tiles, self.tilings, self.rows = tiles, tilings, rows
        self._scale = tiles * tilings / (self.high - self.low)
        inputs = np.arange(len(self.low))
        # Whole boxes of displacement change no box's extent; without them coordinates stay small.
        shift = (np.arange(tilings)[:, None] * (2 * inputs + 1)) % tilings
        # From how many n-ths on a point within its tile is pushed into the next.
        self._next_from = (tilings - shift).astype(np.int64)
        # A box by name: its tiling and its coordinates, in whole words.
        self._place = np.zeros((tilings, -(-(2 + len(inputs)) // WORD) * WORD), np.uint8)
        self._place[:, :2] = np.arange(tilings, dtype=np.uint16)[:, None].view(np.uint8)
        self._name = self._place.view(np.uint64)
        # The names by row, and the rows by hash: where a place is taken by another name, the next free one is used. The system
        # gives memory only as rows are written.
        self._names = np.empty((rows, self._name.shape[1]), np.uint64)
        # Odd numbers without a pattern, to mix a name's words by.
        self._mix = np.random.default_rng(0).integers(2**63, size=self._name.shape[1], dtype=np.uint64) * 2 + 1
        self._used = 0
        self.shared = 0  # lookups of a box that has no row of its own, since the table was full
        self._make_places(PLACES)

    @property
    def used(self) -> int:
        """Rows that belong to a box."""
        return self._used

    def rows_of(self, observation: NDArray[np.floating], *, learn: bool = True) -> Rows:
        """The rows of the boxes that an observation falls into.

        Args:
            observation: (inputs,).
            learn: whether a box never seen before gets a row.

        Returns:
            (tilings,), the row of each tiling's box; the one beyond the table where a box has none and is to get none.
        """
        rows = np.empty(self.tilings, np.int64)
        self._used, complete = _look_up(
            np.asarray(observation, np.float64), self.low, self.high, self._scale, self._next_from, self._place,
            self._name, self._names, self._row_at, self._mix, self._used, learn, rows,
        )  # fmt: skip
        missing = () if complete else np.flatnonzero(rows == EMPTY)
        if len(missing) and self._used < self.rows:
            rows[missing] = self.rows
        elif len(missing):
            # The same row in every process, which Python's own hash of bytes is not.
            rows[missing] = [zlib.crc32(self._place[k].tobytes()) % self.rows for k in missing]
            self.shared += len(missing)
        if self._used > CROWDED * len(self._row_at):
            self._make_places(2 * len(self._row_at))
        return rows

    def _make_places(self, count: int) -> None:
        """So many places to look for names, those of all rows among them."""
        self._row_at = np.full(count, EMPTY, np.int32)
        _enter_all(self._names, self._used, self._row_at, self._mix)


@compiled
def _look_up(
    observation: Floats,
    low: Floats,
    high: Floats,
    scale: Floats,
    next_from: Rows,
    place: NDArray[np.uint8],
    name: Words,
    names: Words,
    row_at: NDArray[np.int32],
    mix: Words,
    used: int,
    learn: bool,
    rows: Rows,
) -> tuple[int, bool]:
    """Write the row of each tiling's box, and to new boxes their rows and names.

    Args:
        observation, low, high: (inputs,). scale: (inputs,) n-ths of a tile per unit. next_from: (tilings, inputs).
        place, name: (tilings, …) the boxes' names, as bytes and as words; their coordinates are written.
        names: (rows, words) of all boxes. row_at: (places,) by hash.
        used: how many rows have a box. learn: whether a new box gets one.
        rows: (tilings,) to write to; `EMPTY` where a box has none.

    Returns:
        How many rows have a box now; whether each tiling's box has one.
    """
    tilings, complete = len(rows), True
    # In n-ths of a tile, never below 0.
    steps = ((np.minimum(np.maximum(observation, low), high) - low) * scale).astype(np.int64)
    whole = steps // tilings
    left = steps - whole * tilings
    places = np.empty(tilings, np.int64)
    for k in range(tilings):
        # (steps + shift) // n without dividing n times
        for i in range(len(steps)):
            place[k, 2 + i] = whole[i] + (left[i] >= next_from[k, i])
        places[k] = _hashed(name[k], mix) & (len(row_at) - 1)
    # The memory's answers, far apart, are waited for together.
    for k in range(tilings):
        rows[k] = row_at[places[k]]
    for k in range(tilings):
        at, row = _find(places[k], name[k], names, row_at)
        if row == EMPTY and learn and used < len(names):
            row = np.int64(used)
            row_at[at] = row
            names[row] = name[k]
            used += 1
        complete &= row != EMPTY
        rows[k] = row
    return used, complete


@compiled
def _hashed(name: Words, mix: Words) -> np.int64:
    mixed = np.uint64(0)
    for i in range(len(name)):
        mixed += name[i] * mix[i]
    return np.int64(((mixed ^ (mixed >> np.uint64(29))) * mix[0]) >> np.uint64(32))


@compiled
def _find(at: np.int64, name: Words, names: Words, row_at: NDArray[np.int32]) -> tuple[np.int64, np.int64]:
    """From a place on, where a name stands, or could, and its row or `EMPTY`."""
    while True:
        row = np.int64(row_at[at])
        if row == EMPTY:
            return at, row
        same = True
        for i in range(len(name)):
            same &= names[row, i] == name[i]
        if same:
            return at, row
        at = (at + 1) & (len(row_at) - 1)


@compiled
def _enter_all(names: Words, used: int, row_at: NDArray[np.int32], mix: Words) -> None:
    """Let the names of all rows be found."""
    for row in range(used):
        at, _ = _find(_hashed(names[row], mix) & (len(row_at) - 1), names[row], names, row_at)
        row_at[at] = row
