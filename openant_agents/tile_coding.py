"""Tile coding: a vector of real numbers as the few tiles that it falls into (Sutton and Barto 2018, section 9.5.4).

Each of n tilings covers the space with boxes, `tiles` of them along the range of each number, and every tiling is
shifted against the others: tiling k by k(2i + 1)/n of a tile along the i-th number, the displacement by odd numbers that
Miller and Glanz recommend and the Tiles3 software uses. Two points that share a box in one tiling share its weight.

No hashing of boxes: each box that was ever seen has a row of its own, in the order of appearance, so that the code is
exact for as long as the table has rows. Only then does a new box share the row of others, which is counted.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput

__all__ = ["TileCoder"]

#: boxes along one number, beyond which a coordinate would not fit the byte it is kept in (one more for the shift)
MOST_TILES = 126

Rows = NDArray[np.int64]


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
        # A box by name: its tiling and its coordinates.
        self._boxes = np.empty((tilings, 2 + len(inputs)), np.uint8)
        self._boxes[:, :2] = np.arange(tilings, dtype=np.uint16)[:, None].view(np.uint8)
        self._names = self._boxes.view(f"V{self._boxes.shape[1]}").ravel()
        self._row_of: dict[bytes, int] = {}
        self.shared = 0  # lookups of a box that has no row of its own, since the table was full

    @property
    def used(self) -> int:
        """Rows that belong to a box."""
        return len(self._row_of)

    def rows_of(self, observation: NDArray[np.floating], *, learn: bool = True) -> Rows:
        """The rows of the boxes that an observation falls into.

        Args:
            observation: (inputs,).
            learn: whether a box never seen before gets a row.

        Returns:
            (tilings,), or fewer where a box has no row and is to get none.
        """
        row_of, found = self._row_of, []
        for name in self._locate(observation):
            row = row_of.get(name)
            if row is None:
                if len(row_of) < self.rows:
                    if not learn:
                        continue
                    row = row_of[name] = len(row_of)
                else:
                    # The same row in every process, which Python's own hash of bytes is not.
                    row = zlib.crc32(name) % self.rows
                    self.shared += 1
            found.append(row)
        return np.array(found, np.int64)

    def _locate(self, observation: NDArray[np.floating]) -> list[bytes]:
        inside = np.minimum(np.maximum(observation, self.low), self.high)
        steps = ((inside - self.low) * self._scale).astype(np.int32)  # in n-ths of a tile, never below 0
        whole = steps // self.tilings
        # (steps + shift) // n without dividing n times
        np.add(
            whole.astype(np.uint8),
            steps - whole * self.tilings >= self._next_from,
            out=self._boxes[:, 2:],
            casting="unsafe",
        )
        names: list[bytes] = self._names.tolist()
        return names

    # ------------------------------------------------------------------------------------------------- going on

    def names(self) -> NDArray[np.uint8]:
        """(used, 2 + inputs): the box of each row: its tiling (two bytes) and coordinates."""
        width = self._boxes.shape[1]
        return np.frombuffer(b"".join(self._row_of), np.uint8).reshape(-1, width).copy()

    def restore(self, names: NDArray[np.uint8], shared: int) -> None:
        """Give rows to these boxes, in order, instead of those seen so far.

        Raises:
            BadInput: they are of other inputs or of a larger table.
        """
        width = self._boxes.shape[1]
        if names.ndim != 2 or names.shape[1] != width or len(names) > self.rows:
            raise BadInput(f"boxes of shape {names.shape} do not fit {self.tilings} tilings of {width - 2} inputs")
        boxes: Sequence[bytes] = np.ascontiguousarray(names).view(f"V{width}").ravel().tolist()
        self._row_of = {name: row for row, name in enumerate(boxes)}
        self.shared = shared
