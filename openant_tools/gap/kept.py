"""What follows from a prepared protocol for a log with some runs and signals: made once in a process, and used again in it.

Judges are not written to files: what is read back from one could be anybody's, and a judge is more than plain arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.judge import Judge, metric_of, train
from openant_tools.gap.prepare import Prepared
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.whitening import Metric

__all__ = ["judge_of", "kept_metric"]

Bools = NDArray[np.bool_]
Made = TypeVar("Made")

#: of one kind that are remembered: more than a process that diagnoses one robot after the other of a set comes to
REMEMBERED = 8
_judges: dict[object, Judge] = {}
_metrics: dict[object, Metric] = {}


def judge_of(prepared: Prepared, protocol: Protocol, *, progress: Callable[[float, str], None]) -> Judge:
    """The judge of a log with these runs and signals; teaching it takes up to a minute.

    Args:
        protocol: the runs at hand, as they were given to `prepare`. progress: told a share and words.
    """
    which = prepared.ordered
    own = protocol.logs()
    progress(0.0, "the judge")
    return _remembered(_judges, train, prepared, which, [own[k] for k in which])


def kept_metric(prepared: Prepared, which: Sequence[int], columns: Sequence[Bools]) -> Metric:
    """The metric of some runs' block means alone."""
    return _remembered(_metrics, metric_of, prepared, which, columns)


def _remembered(
    known: dict[object, Made],
    make: Callable[[Prepared, Sequence[int], Sequence[Bools]], Made],
    prepared: Prepared,
    which: Sequence[int],
    columns: Sequence[Bools],
) -> Made:
    signals = tuple(mine.tobytes() for mine in columns)
    key = (prepared.folder, tuple(prepared.which[k] for k in which), len(prepared.cases), signals)
    if key not in known:
        while len(known) >= REMEMBERED:
            del known[next(iter(known))]
        known[key] = make(prepared, which, columns)
    return known[key]
