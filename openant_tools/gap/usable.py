"""What of a recording can be simulated: where the robot moved by its commands alone, and the log says both.

Rows are told apart by their log alone; the model lends geometry and gravity, and nothing is simulated. A row counts from its time
to the next one's. Times are those of `run.t`, s.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from openant_tools.gap.handling import lifted, lying, pushed
from openant_tools.gap.ramps import ramps
from openant_tools.model.plant import Plant, Setup
from openant_tools.numbers import exact, number, percent
from openant_tools.recording.run import Run

__all__ = ["LEAST_S", "Excluded", "Reason", "Usable", "usable"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: s, the shortest stretch that a window is worth
LEAST_S = 0.5
#: s between rows, or between a joint's answers, that are a gap; or this many rows as they usually come
GAP_S, GAP_ROWS = 0.1, 5.0
#: share of a second's answers that a joint gives at least
ANSWERS = 0.5
#: s that a joint falls, swings out or hangs after its torque went off on a stand
RELEASE_S = 4.0
#: s until a robot stands again that lay, was carried or had no torque
SETTLES_S = 0.5
#: s of commands that a servo may still have to carry out: the longest delay that is looked for; and rad from where it is commanded at
#: the first row from which it was commanded elsewhere before
REMEMBERED_S, ELSEWHERE_RAD = 0.15, 0.1


class Reason(StrEnum):
    """Why a stretch is left out; where several hold, the first."""

    UNMEASURED = "not every joint measured yet"
    GAP = "no rows"
    UNHEARD = "answers missing"
    LIMP = "torque off"
    UNCOMMANDED = "no command yet"
    LYING = "the robot on its side or back"
    LIFTED = "the robot carried, lifted or turned by hand"
    RAMP = "a ramp to a pose"
    PUSHED = "joints moved by hand"
    BEGUN = "what was commanded before it began"
    SHORT = f"under {exact(LEAST_S, 's')} between two others"


@dataclass(frozen=True)
class Excluded:
    """A stretch that is not simulated, from `start` up to `stop` (s), and why."""

    start: float
    stop: float
    reason: Reason

    @property
    def seconds(self) -> float:
        return self.stop - self.start


@dataclass(frozen=True)
class Usable:
    """What of one run can be simulated.

    Attributes:
        run: its name.
        seconds: how long it is, s.
        stretches: from, up to (s), in order.
        excluded: all the rest, in order.
    """

    run: str
    seconds: float
    stretches: tuple[tuple[float, float], ...]
    excluded: tuple[Excluded, ...]

    @property
    def usable_s(self) -> float:
        return sum(stop - start for start, stop in self.stretches)

    @property
    def share(self) -> float:
        """Of the run, 0…1."""
        return self.usable_s / self.seconds if self.seconds > 0 else 0.0

    def __str__(self) -> str:
        """One line for a report."""
        line = f"{self.run}: {number(self.usable_s, 's')} of {number(self.seconds, 's')} can be simulated ({percent(self.share)})"
        lost: dict[Reason, float] = {}
        for one in self.excluded:
            lost[one.reason] = lost.get(one.reason, 0.0) + one.seconds
        why = ", ".join(
            f"{reason.value} {number(s, 's')}" for reason, s in sorted(lost.items(), key=lambda item: -item[1])
        )
        return f"{line}; left out: {why}" if why else line


def usable(run: Run, plant: Plant) -> Usable:
    """What of a run can be simulated.

    Args:
        plant: the model, set up as the run was made; its joints are those that are looked at.
    """
    t, n = run.t, len(run.t)
    if n < 2:
        return Usable(run.name, 0.0, (), ())
    joints, floor = plant.joints, plant.setup is Setup.FLOOR
    pos, cmd = run.signal("pos", joints), run.signal("cmd", joints)
    off = run.signal("torque", joints, default=1.0) == 0
    gap_s = max(GAP_S, GAP_ROWS * float(np.median(np.diff(t))))
    whole = np.flatnonzero(np.isfinite(pos).all(axis=1))
    limp = off.any(axis=1) if floor else _limp(t, off)
    fallen, carried = lying(run, plant), lifted(run, plant)
    ways = ramps(t, cmd, limp, floor=floor)
    found = {
        Reason.UNMEASURED: np.arange(n) < (whole[0] if len(whole) else n),
        Reason.GAP: np.append(np.diff(t) > gap_s, False),
        Reason.UNHEARD: np.logical_or.reduce([_unheard(t, np.isfinite(one), gap_s) for one in pos.T]),
        Reason.LIMP: _until_settled(t, limp) if floor else limp,
        Reason.UNCOMMANDED: _uncommanded(cmd, off),
        Reason.LYING: _until_settled(t, fallen),
        Reason.LIFTED: _until_settled(t, carried),
        Reason.RAMP: ways,
        Reason.PUSHED: pushed(run, plant),
        Reason.BEGUN: (t - t[0] < REMEMBERED_S) & (np.abs(cmd[0] - pos[0]) > ELSEWHERE_RAD).any(),
    }
    reasons = list(found)
    marked = np.stack([found[reason] for reason in reasons], axis=1)[:-1]
    label = np.where(marked.any(axis=1), marked.argmax(axis=1), -1)
    return _told(run, label, reasons)


def _told(run: Run, label: NDArray[np.int64], reasons: Sequence[Reason]) -> Usable:
    """Stretches of rows with one label each, −1 where they can be simulated."""
    t = run.t
    edges = [0, *(1 + np.flatnonzero(np.diff(label))).tolist(), len(label)]
    stretches, excluded = [], []
    for first, stop in itertools.pairwise(edges):
        start, end, what = float(t[first]), float(t[stop]), int(label[first])
        if what >= 0:
            excluded.append(Excluded(start, end, reasons[what]))
        elif end - start < LEAST_S:
            excluded.append(Excluded(start, end, Reason.SHORT))
        else:
            stretches.append((start, end))
    return Usable(run.name, run.duration_s, tuple(stretches), tuple(excluded))


def _unheard(t: Array, heard: Bools, gap_s: float) -> Bools:
    """(rows,) where a joint's samples are too far apart, or too few of a second's come."""
    out = np.zeros(len(t), bool)
    rows = np.flatnonzero(heard)
    if not len(rows):
        return ~out
    ends = np.append(rows[1:], len(t))
    far = (ends > rows + 1) & (t[np.minimum(ends, len(t) - 1)] - t[rows] > gap_s)
    for before, after in zip(rows[far], ends[far], strict=True):
        out[before + 1 : after] = True
    count = np.concatenate([[0], np.cumsum(heard)])
    first, stop = np.searchsorted(t, t - 0.5), np.searchsorted(t, t + 0.5, side="right")
    few: Bools = (count[stop] - count[first]) < ANSWERS * (stop - first)
    out |= few
    return out


def _limp(t: Array, off: Bools) -> Bools:
    """(rows,) where any joint on a stand has had no torque for longer than a release takes, or never had."""
    out = np.zeros(len(t), bool)
    for own in off.T:
        let_go = np.where(own & ~np.concatenate([[True], own[:-1]]), t, -np.inf)
        out |= own & (t - np.maximum.accumulate(let_go) > RELEASE_S)
    return out


def _uncommanded(cmd: Array, off: Bools) -> Bools:
    """(rows,) where torque is on at a joint of which nobody has said where to since it came on."""
    given = np.isfinite(cmd)
    row = np.arange(len(cmd))[:, None]
    said = np.maximum.accumulate(np.where(given, row, -1), axis=0)
    gone = np.maximum.accumulate(np.where(off, row, -1), axis=0)
    out: Bools = np.asarray((~off & ((said < 0) | (said < gone))).any(axis=1))
    return out


def _until_settled(t: Array, marked: Bools) -> Bools:
    """With what comes within SETTLES_S after it."""
    out: Bools = t - np.maximum.accumulate(np.where(marked, t, -np.inf)) <= SETTLES_S
    return out
