"""Traces in characters: braille dots, two by four a cell, or in plain ASCII five levels a cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["canvas_lines", "trace"]

Array = NDArray[np.float64]

#: the bit of each dot in a braille cell, 4 rows by 2 columns (Unicode 6.0, chapter 15)
_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_LEVELS = np.array(list("^'-._"))


def trace(
    t: Array, values: Array, start: float, stop: float, low: float, high: float, width: int, height: int, *, plain: bool
) -> list[str]:
    """Lines of a trace of `values` (n,) at `t` (n,) s, from `start` to `stop` across, `low` to `high` upwards.

    Where several samples fall into one dot's width the line spans them all: no peak is lost. Where none fall, or they
    are NaN, it is blank: what was not measured is not drawn.
    """
    across, down = (width, 5) if plain else (2 * width, 4)
    bins = across if plain else 2 * width
    rows = down * height
    lowest, highest = np.full(bins, np.inf), np.full(bins, -np.inf)
    known = np.isfinite(values) & (t >= start) & (t <= stop)
    place = np.minimum(((t[known] - start) / (stop - start) * bins).astype(int), bins - 1)
    np.minimum.at(lowest, place, values[known])
    np.maximum.at(highest, place, values[known])
    some = highest >= lowest
    span = high - low or 1.0
    top = np.full(bins, rows)
    bottom = np.full(bins, -1)
    top[some] = np.clip(((high - highest[some]) / span * rows).astype(int), 0, rows - 1)
    bottom[some] = np.clip(((high - lowest[some]) / span * rows).astype(int), 0, rows - 1)
    # Neighbours are joined, so that steep slopes are lines.
    joined = some[1:] & some[:-1]
    top[1:][joined] = np.minimum(top[1:][joined], bottom[:-1][joined])
    bottom[1:][joined] = np.maximum(bottom[1:][joined], np.minimum(top[:-1][joined], rows - 1))
    row = np.arange(rows)[:, None]
    return canvas_lines((row >= top) & (row <= bottom), plain=plain)


def canvas_lines(dots: NDArray[np.bool_], *, plain: bool) -> list[str]:
    """Dots (4 rows a line, 2 columns a cell) as lines; in ASCII (5 rows a line, 1 column a cell)."""
    rows, across = dots.shape
    if plain:
        fifths = dots.reshape(rows // 5, 5, across)
        level = fifths.argmax(axis=1)
        return ["".join(line) for line in np.where(fifths.any(axis=1), _LEVELS[level], " ")]
    cells = dots.reshape(rows // 4, 4, across // 2, 2)
    codes = 0x2800 + np.einsum("hiwj,ij->hw", cells, _BITS)
    return ["".join(map(chr, line)).replace("\u2800", " ") for line in codes]
