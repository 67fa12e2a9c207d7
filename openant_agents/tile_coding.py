"""Tile coding: a vector of real numbers as the few tiles that it falls into (Sutton and Barto 2018, section 9.5.4).

Each of n tilings covers the space with boxes, `tiles` of them along the range of each number, and every tiling is
shifted against the others: tiling k by k(2i + 1)/n of a tile along the i-th number, the displacement by odd numbers that
Miller and Glanz recommend and the Tiles3 software uses. Two points that share a box in one tiling share its weight.

No box shares a row by its hash: each box that was ever seen has a row of its own, in the order of appearance, so that the code
is exact for as long as the table has rows. Only then does a new box share the row of others, which is counted. A hash only
says where to look for a box's name (linear probing, Knuth 1998, section 6.4), for all tilings at once.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput

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
Names = NDArray[np.void]


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
                f"the bounds of observation {at} leave no room for tiles: {self.low[at]:g} to {self.high[at]:g}",
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
        self._next_from = (tilings - shift).astype(np.int32)
        # A box by name: its tiling and its coordinates, in whole words.
        self._place = np.zeros((tilings, -(-(2 + len(inputs)) // WORD) * WORD), np.uint8)
        self._place[:, :2] = np.arange(tilings, dtype=np.uint16)[:, None].view(np.uint8)
        self._coordinates = self._place[:, 2 : 2 + len(inputs)]
        self._name = self._place.view(f"V{self._place.shape[1]}").ravel()
        # The names by row, and the rows by hash: where a place is taken by another name, the next free one is used. The system
        # gives memory only as rows are written.
        self._names = np.empty(rows, self._name.dtype)
        self._row_at = np.full(PLACES, EMPTY, np.int32)
        # Odd numbers without a pattern, to mix a name's words by.
        words = self._place.shape[1] // WORD
        self._mix = np.random.default_rng(0).integers(2**63, size=words, dtype=np.uint64) * 2 + 1
        self._used = 0
        self.shared = 0  # lookups of a box that has no row of its own, since the table was full

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
        self._locate(observation)
        rows, places = self._find(self._name)
        missing = np.flatnonzero(rows == EMPTY)
        if len(missing) == 0:
            return rows
        free = self.rows - self._used
        if free and not learn:
            rows[missing] = self.rows
            return rows
        new, sharing = missing[:free], missing[free:]
        rows[new] = np.arange(self._used, self._used + len(new))
        self._names[rows[new]] = self._name[new]
        self._used += len(new)
        self._enter(rows[new], places[new])
        # The same row in every process, which Python's own hash of bytes is not.
        rows[sharing] = [zlib.crc32(self._name[k].tobytes()) % self.rows for k in sharing]
        self.shared += len(sharing)
        if self._used > CROWDED * len(self._row_at):
            self._row_at = np.full(2 * len(self._row_at), EMPTY, np.int32)
            everything = np.arange(self._used)
            self._enter(everything, self._hashed(self._names[: self._used]))
        return rows

    def _locate(self, observation: NDArray[np.floating]) -> None:
        """Write the names of the boxes that an observation falls into."""
        inside = np.minimum(np.maximum(observation, self.low), self.high)
        steps = ((inside - self.low) * self._scale).astype(np.int32)  # in n-ths of a tile, never below 0
        whole = steps // self.tilings
        # (steps + shift) // n without dividing n times
        pushed = steps - whole * self.tilings >= self._next_from
        np.add(whole.astype(np.uint8), pushed, out=self._coordinates, casting="unsafe")

    def _hashed(self, names: Names) -> Rows:
        """(boxes,) the place where to look first for a name."""
        mixed = names.view(np.uint64).reshape(len(names), -1) @ self._mix
        mixed ^= mixed >> np.uint64(29)
        mixed *= self._mix[0]
        places: Rows = (mixed >> np.uint64(32)).astype(np.int64)
        return places & (len(self._row_at) - 1)

    def _find(self, names: Names) -> tuple[Rows, Rows]:
        """(boxes,) the row of each name, or `EMPTY`, and its place, or the one that is free for it."""
        places = self._hashed(names)
        rows = self._row_at.take(places).astype(np.int64)
        others = np.flatnonzero((rows != EMPTY) & (self._names.take(rows, mode="wrap") != names))
        while len(others):
            places[others] = self._after(places[others])
            found = self._row_at.take(places[others])
            rows[others] = found
            others = others[(found != EMPTY) & (self._names.take(found, mode="wrap") != names[others])]
        return rows, places

    def _enter(self, rows: Rows, places: Rows) -> None:
        """Let names be found: rows (boxes,), from the places (boxes,) on."""
        while len(rows):
            free = self._row_at[places] == EMPTY
            self._row_at[places[free]] = rows[free]
            # Of several at one place the last has it, the others go on.
            still = self._row_at[places] != rows
            rows, places = rows[still], self._after(places[still])

    def _after(self, places: Rows) -> Rows:
        return (places + 1) & (len(self._row_at) - 1)
