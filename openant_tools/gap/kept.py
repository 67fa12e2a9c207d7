"""What follows from a prepared protocol for a log with some runs and signals: made once, kept beside it, then read again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import TypeVar

import joblib
import numpy as np
from numpy.typing import NDArray

from openant_tools.files import atomic_writer
from openant_tools.gap.judge import Judge, metric_of, train
from openant_tools.gap.prepare import Prepared
from openant_tools.gap.protocol import Protocol
from openant_tools.gap.whitening import Metric

__all__ = ["judge_of", "kept_metric"]

Bools = NDArray[np.bool_]
Stored = TypeVar("Stored")

#: of what is kept beside a preparation: another where judges are taught otherwise
FORM = 3


def judge_of(prepared: Prepared, protocol: Protocol, *, progress: Callable[[float, str], None]) -> Judge:
    """The judge of a log with these runs and signals; the first of these runs brings those of logs to come.

    Robots of one protocol come with a tracker and without: whoever comes second has not the time to teach one.

    Args:
        protocol: the runs at hand, as they were given to `prepare`. progress: told a share and words.
    """
    which = prepared.ordered
    own, *others = [[there[k] for k in which] for there in protocol.logs()]
    alone = not any(prepared.folder.glob(f"{_stem(Judge, prepared, which)}-*"))
    progress(0.0, "the judge")
    judge = _kept(Judge, train, prepared, which, own)
    for columns in others if alone else ():
        progress(0.5, "the judge of robots with other sensors")
        _kept(Judge, train, prepared, which, columns)
    return judge


def kept_metric(prepared: Prepared, which: Sequence[int], columns: Sequence[Bools]) -> Metric:
    """The metric of some runs' block means alone."""
    return _kept(Metric, metric_of, prepared, which, columns)


def _kept(
    kind: type[Stored],
    make: Callable[[Prepared, Sequence[int], Sequence[Bools]], Stored],
    prepared: Prepared,
    which: Sequence[int],
    columns: Sequence[Bools],
) -> Stored:
    signals = hashlib.sha256(b"".join(mine.tobytes() for mine in columns)).hexdigest()[:12]
    path = prepared.folder / f"{_stem(kind, prepared, which)}-{signals}.joblib"
    if path.is_file():
        try:
            found = joblib.load(path)
            if isinstance(found, kind):
                return found
        except Exception:  # whatever an interrupted or foreign file does, it is made anew
            path.unlink(missing_ok=True)
    made = make(prepared, which, columns)
    with atomic_writer(path) as file:
        joblib.dump(made, file)
    return made


def _stem(kind: type, prepared: Prepared, which: Sequence[int]) -> str:
    """How the names of files begin that are kept of a kind for some runs, whatever their signals."""
    runs = hashlib.sha256(repr((FORM, [prepared.which[k] for k in which], len(prepared.cases))).encode())
    return f"{kind.__name__.lower()}-{runs.hexdigest()[:12]}"
