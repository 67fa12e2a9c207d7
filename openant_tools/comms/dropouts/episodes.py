"""Losses grouped: rows that belong together, the servos they took, and who is at the origin of a read's silence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from openant_tools.comms.dropouts.log import WORDS, Array, BusLog, Flags
from openant_tools.robot.joints import JOINTS

__all__ = ["DropoutEpisode", "Reach", "cables", "episodes_of", "reach_of"]

#: A servo belongs to those concerned where it loses at least this share of what the worst one loses.
CONCERNED = 0.2
#: of those concerned, where all are
NEARLY_ALL = 0.8
#: share of a servo's losses without those behind it, from which on it is known to lose by itself
ALONE = 0.12


@dataclass(frozen=True)
class DropoutEpisode:
    """Losses in a row, at most one good row between them.

    Attributes:
        start, stop: rows, the last one not included. joints: who lost anything, by position.
        from_s, to_s: on the log's clock.
    """

    start: int
    stop: int
    from_s: float
    to_s: float
    joints: tuple[int, ...]
    words: tuple[str, ...]


def episodes_of(log: BusLog) -> list[DropoutEpisode]:
    """All of them, in order of time."""
    rows = np.flatnonzero(log.lossy)
    if not len(rows):
        return []
    same_run = log.run[rows[1:]] == log.run[rows[:-1]]
    breaks = np.flatnonzero((np.diff(rows) > 2) | ~same_run)
    firsts, lasts = np.r_[rows[0], rows[breaks + 1]], np.r_[rows[breaks], rows[-1]]
    found = []
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        word = log.word[first : last + 1]
        joints = tuple(np.flatnonzero(word.any(axis=0)).tolist())
        codes = set(word.ravel().tolist())
        found.append(
            DropoutEpisode(
                first, last + 1, float(log.t[first]), float(log.t[last]), joints,
                tuple(WORDS[code] for code in sorted(codes) if code),
            )
        )  # fmt: skip
    return found


def cables(log: BusLog) -> list[tuple[int, ...]]:
    """Joints by position, along each cable from the adapter outwards: as said, else a leg each; none where unknown."""
    if log.chain:
        return [tuple(log.joints.index(name) for name in cable) for cable in log.chain]
    if all(name in JOINTS for name in log.joints):
        legs: dict[str, list[int]] = {}
        for k, name in enumerate(log.joints):
            legs.setdefault(JOINTS[name].leg.name, []).append(k)
        return [tuple(sorted(leg, key=lambda k: not log.joints[k].startswith("hip"))) for leg in legs.values()]
    return []


@dataclass(frozen=True)
class Reach:
    """Whom the losses concern.

    Attributes:
        kind: `all`, `behind` (two or more, all that hang behind a place of a cable), `one`, `pair`, `scattered`.
        joints: those concerned, by position. together: share of them that a row with losses takes, mean.
        rate: (J,) share of each servo's answers that was lost.
        shadow: silence behind the one concerned came of the order of reading alone, and is left out here.
        lost: (n, J) losses without that shadow.
        tied: another kind that fits as well, since one servo hangs alone behind its cable.
    """

    kind: str
    joints: tuple[int, ...]
    together: float
    rate: Array
    shadow: bool
    lost: Flags
    tied: str | None = None


def reach_of(log: BusLog) -> Reach:
    """Whom the losses concern, judged over the whole log; `kind` is `one` of nobody where nothing was lost."""
    wires = cables(log)
    plain = _reach(log, log.lost, wires, shadow=False)
    without = _without_shadow(log)
    if without is None:
        return plain
    stripped = _reach(log, without, wires, shadow=True)
    lost = log.lost[log.lossy]
    alone = float((lost[lost[:, stripped.joints[0]]].sum(axis=1) == 1).mean())
    if alone < ALONE and len(stripped.joints) == 1:
        # It never falls silent alone: a cable before it, or (at the first one) all, does the same.
        if stripped.joints == (0,):
            return plain
        if plain.kind == "behind":
            return replace(plain, tied="one")
    if len(stripped.joints) > len(log.joints) / 2 and stripped.kind != "behind":
        return plain
    return stripped


def _without_shadow(log: BusLog) -> Flags | None:
    """Losses without those of servos that only waited for a silent one before them; None where nothing looks so.

    In a sync read each servo waits for the answer before its own: behind a silent one all are silent. So in every row
    either one servo alone is lost (its answer came broken), or the losses run through to the last servo.
    """
    rows = np.flatnonzero(log.lossy & log.asked.all(axis=1))
    lost = log.lost[rows]
    if not len(lost) or lost.shape[1] < 3:
        return None
    j = lost.shape[1]
    first, count = np.argmax(lost, axis=1), lost.sum(axis=1)
    inner = first < j - 1
    if not inner.any():
        return None
    through = count[inner] == j - first[inner]
    if (through | (count[inner] == 1)).mean() < 0.85 or through.sum() < max(2, 0.1 * inner.sum()):
        return None
    stripped = log.lost.copy()
    # What was garbled or late did answer: only silence can be a shadow.
    silent = (log.word[rows] == WORDS.index("timeout")) | (log.word[rows] == WORDS.index("lost"))
    behind = np.arange(j)[None, :] > first[:, None]
    stripped[rows] &= ~(behind & silent)
    return stripped


def _reach(log: BusLog, lost: Flags, wires: Sequence[tuple[int, ...]], *, shadow: bool) -> Reach:
    asked = np.maximum(log.answers, 1)
    counts = lost.sum(axis=0)
    rate = counts / asked
    seen = log.asked.any(axis=0)
    j = int(seen.sum())
    lossy = lost.any(axis=1)
    if not lossy.any():
        return Reach("one", (), 0.0, rate, shadow, lost)
    top = rate.max()
    concerned = tuple(np.flatnonzero(seen & (rate >= CONCERNED * top) & (counts > 0)).tolist())
    together = float(lost[lossy][:, list(concerned)].mean()) if concerned else 0.0
    kind, tied = "scattered", None
    if len(concerned) == 1:
        kind = "one"
        if not wires or any(wire and wire[-1] == concerned[0] for wire in wires):
            tied = "behind"
    elif len(concerned) >= NEARLY_ALL * j and j > 2:
        kind = "all"
        if set(concerned) != set(np.flatnonzero(seen).tolist()) and _behind(concerned, wires, log):
            tied = "behind"
    elif _behind(concerned, wires, log):
        kind = "behind"
        tied = "pair" if len(concerned) == 2 else None
    elif len(concerned) == 2:
        kind = "pair"
    elif j <= 2 and len(concerned) == j:
        kind, tied = "all", "behind"
    return Reach(kind, concerned, together, rate, shadow, lost, tied)


def _behind(concerned: Sequence[int], wires: Sequence[tuple[int, ...]], log: BusLog) -> bool:
    """Whether these are all that hang behind one place."""
    wanted = set(concerned)
    if wires:
        return any(wanted == set(wire[k:]) for wire in wires for k in range(len(wire) - 1))
    # Nobody said how they are wired: in a row, as they are listed?
    j = len(log.joints)
    return wanted == set(range(j - len(wanted), j)) or wanted == set(range(len(wanted)))
