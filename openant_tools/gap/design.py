"""Slopes of many coordinates from robots that differ in all of them: an orthogonal design, folded over.

Feet that chatter make two robots that hardly differ land otherwise, so that the difference of two says little of what one tolerance does. Here
each robot differs in every tolerance, and all of them tell each slope, which has 1/n of their scatter. Columns are orthogonal (cas, Hartley
1942), so that no slope takes of another; each robot has its mirror image (Box & Wilson 1951), so that nothing even, squares and pairs, is in
a slope. What slopes leave is scatter: how little a row of a simulation is to be trusted where robots are of one build.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["design", "scatter", "slopes"]

Array = NDArray[np.float64]


@cache
def design(coordinates: int) -> Array:
    """(robots, coordinates) in which they are moved, 1 rms each, columns orthogonal to each other and to what all robots share."""
    n = coordinates + 1
    angle = 2 * np.pi * np.outer(np.arange(n), np.arange(1, n)) / n
    once = np.cos(angle) + np.sin(angle)
    out = np.concatenate([once, -once])
    out.setflags(write=False)
    return out


def slopes(seen: Array, moved: Array) -> Array:
    """(coordinates, rows, channels) by which each coordinate changes what robots show, by least squares.

    Args:
        seen: (robots, rows, channels). moved: (robots, coordinates), a `design`.
    """
    out: Array = np.tensordot(moved.T, seen, 1) / len(moved)
    return out


def scatter(seen: Array, moved: Array) -> Array:
    """(rows, channels) variance of what slopes do not explain; arguments as those of `slopes`."""
    explained = np.square(seen.mean(axis=0)) + np.square(slopes(seen, moved)).sum(axis=0)
    left = np.square(seen).sum(axis=0) - len(moved) * explained
    out: Array = np.maximum(left / (len(moved) - moved.shape[1] - 1), 0.0)
    return out
