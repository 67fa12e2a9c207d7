"""Whether what scatters comes back at the same angles: a gear's fault does, and lost or late commands do not.

No simulation loses the same commands, so that closure cannot tell whether commands were lost. Where they were, errors begin
anywhere; what returns whenever a joint comes by the same angle in the same direction is in its gears.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.features import SKIP_S, Floats
from openant_tools.gap.neighbours import beside_neighbours

__all__ = ["returning"]

Array = NDArray[np.float64]

#: rad, of one place on a gear; rad/s from which a joint passes it
PLACE_RAD, PASSES_RAD_S = 0.02, 0.3


def returning(t: Sequence[Array], seen: Sequence[Floats], simulated: Sequence[Floats]) -> float:
    """Share of what joints scatter about a model that comes back at the same angles, beyond chance.

    The intraclass correlation of passages (Fisher 1925), all joints together: of how far rows lie off those about them, averaged over
    each passage of a place, what passages of one place have in common.

    Args:
        t: of each run (rows,) s, from 0. seen, simulated: of each run (rows, joints) rad; NaN where nothing was measured.
    """
    common = everything = 0.0
    for joint in range(seen[0].shape[1]):
        found = [
            _passages(when, x[:, joint], model[:, joint]) for when, x, model in zip(t, seen, simulated, strict=True)
        ]
        places, off = (np.concatenate(one) for one in zip(*found, strict=True))
        _, which, counts = np.unique(places, return_inverse=True, return_counts=True)
        sums, squares = np.bincount(which, off), np.bincount(which, np.square(off))
        again = counts > 1
        common += float(((np.square(sums) - squares)[again] / (counts[again] - 1)).sum())
        everything += float(squares[again].sum())
    return common / everything if everything > 0 else 0.0


def _passages(t: Array, seen: Floats, simulated: Floats) -> tuple[NDArray[np.int64], Array]:
    """Of each passage of a place, which place in which direction, and how far its rows lie off those about them, rad."""
    speed = np.gradient(simulated, t)
    off = beside_neighbours((seen - simulated)[None, :, None], t)[0, :, 0]
    passes = (t >= SKIP_S) & (np.abs(speed) > PASSES_RAD_S) & np.isfinite(seen)
    place = 2 * np.floor(np.nan_to_num(seen) / PLACE_RAD).astype(np.int64) + (speed > 0)
    passage = np.concatenate([[0], np.cumsum(np.diff(place) != 0)])[passes]
    if not passage.size:
        return np.empty(0, np.int64), np.empty(0)
    _, first, which, counts = np.unique(passage, return_index=True, return_inverse=True, return_counts=True)
    return place[passes][first], np.bincount(which, off[passes]) / counts
