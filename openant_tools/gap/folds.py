"""Parts of runs, and the folds that are held out in turn (formats, section 2)."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from openant_tools.errors import BadInput
from openant_tools.gap.usable import LEAST_S, Usable
from openant_tools.numbers import exact, number

__all__ = ["FOLDS", "Part", "folds"]

#: a single run is cut into so many folds; s between two of them
FOLDS, APART_S = 4, 1.0
#: s from which a part of one run of several is worth the pause before it
LONG_S = 4.0
#: share of a fold by which its end moves to a pause that is there anyway
TO_PAUSE = 0.25

_PART = re.compile(r"(?P<run>.+)\[(?P<start>-?\d+(\.\d+)?),\s*(?P<stop>-?\d+(\.\d+)?)\]")


@dataclass(frozen=True)
class Part:
    """A run, or what of it lies from `start` up to `stop` (s of its `t`); printed and read as `RUN` or `RUN[12.0,31.5]`."""

    run: str
    start: float = -math.inf
    stop: float = math.inf

    def __str__(self) -> str:
        if math.isinf(self.start) and math.isinf(self.stop):
            return self.run
        return f"{self.run}[{_seconds(self.start)},{_seconds(self.stop)}]"

    @classmethod
    def parse(cls, text: str, runs: Collection[str] = ()) -> Part:
        """The part that a text names.

        Args:
            runs: names that are taken as they are, whatever they look like.

        Raises:
            BadInput: it ends before it starts.
        """
        found = _PART.fullmatch(text)
        if text in runs or found is None:
            return cls(text)
        part = cls(found["run"], float(found["start"]), float(found["stop"]))
        if part.stop <= part.start:
            raise BadInput("a part that ends before it starts", where=text, remedy="RUN[FROM,TO], in s of the run's t")
        return part


def folds(usable: Sequence[Usable]) -> tuple[tuple[int, Part], ...]:
    """What is held out in turn, and of which run: runs, where there are FOLDS of them or they are short, else parts of each.

    Parts are contiguous and APART_S from each other. Runs of which nothing can be simulated are none.

    Raises:
        BadInput: too little of a single run can be simulated, or nothing of any.
    """
    there = [k for k, one in enumerate(usable) if one.stretches]
    if not there:
        lines = "; ".join(str(one) for one in usable)
        raise BadInput(
            f"nothing of these recordings can be simulated: {lines}", remedy="record the robot as it moves by itself"
        )
    each = math.ceil(FOLDS / len(there))
    long = len(there) == 1 or all(usable[k].usable_s > each * LONG_S for k in there)
    found = [(k, part) for k in there for part in _parts(usable[k], each if long else 1)]
    if len(found) == 1:
        (one,) = (usable[k] for k in there)
        raise BadInput(
            f"{number(one.usable_s, 's')} of the one run can be simulated, too little to hold parts of it out",
            where=one.run,
            remedy=f"record {exact(FOLDS * LEAST_S + (FOLDS - 1) * APART_S + 1, 's')} or more in one piece, or a second run",
        )
    return tuple(found)


def _parts(one: Usable, count: int) -> list[Part]:
    """A run in so many parts, or whole, where it is too short for that."""
    stretches = one.stretches
    pauses = [a[1] for a, b in itertools.pairwise(stretches) if b[0] - a[1] >= APART_S]
    parts, start = [], stretches[0][0]
    for left in range(count, 0, -1):
        gone = _until(stretches, start)
        each = (one.usable_s - gone - (left - 1) * APART_S) / left
        stop = stretches[-1][1] if left == 1 else _after(stretches, gone + each)
        # A pause that is there anyway costs nothing.
        near = [at for at in pauses if abs(_until(stretches, at) - gone - each) <= TO_PAUSE * each] if left > 1 else []
        stop = near[int(np.argmin(np.abs(np.array(near) - stop)))] if near else stop
        parts.append(Part(one.run, math.ceil(1e3 * start) / 1e3, math.floor(1e3 * stop) / 1e3))
        start = stop + APART_S
        if near:
            start = max(start, next(begin for begin, _ in stretches if begin > stop))
    long = all(any(min(b, part.stop) - max(a, part.start) >= LEAST_S for a, b in stretches) for part in parts)
    return parts if count > 1 and long else [Part(one.run)]


def _after(stretches: Sequence[tuple[float, float]], seconds: float) -> float:
    """When so many s have been gone through."""
    for start, stop in stretches:
        if seconds <= stop - start:
            return start + seconds
        seconds -= stop - start
    return stretches[-1][1]


def _until(stretches: Sequence[tuple[float, float]], t: float) -> float:
    """How many s have been gone through until then."""
    return sum(max(0.0, min(stop, t) - start) for start, stop in stretches)


def _seconds(value: float) -> str:
    text = f"{value:.3f}".rstrip("0")  # for a file
    return text + "0" if text.endswith(".") else text
