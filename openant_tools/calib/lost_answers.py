"""Which cable loses answers: what one joint, or what hangs behind it, loses alone, and what all servos lose alike.

A servo loses answers where k of n are lost and a sound one, which loses at most `SOUND_SHARE` of them, would lose so many
by chance, P(X ≥ k) of a binomial distribution, in less than `SIGNIFICANCE` of all measurements. Where most servos do, one
stands out of them if its k beside the middle one's m is as improbable for two that lose alike: P(X ≥ k) of k + m coins.
Among several servos each has its part of the significance (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, bdtrik

from openant_tools.comms.lateness import losses
from openant_tools.numbers import percent
from openant_tools.recording.run import Run

__all__ = ["LostAlone", "loose", "lost_alone", "lost_in", "most_lost"]

#: Share of its answers that a sound servo may lose: one in ten seconds at 100 Hz. The bit errors of a sound cable make far
#: fewer, a plug that works itself loose a hundredth and more. With a fifth of it, and with three times as much, the
#: verdicts that the tests know are the same.
SOUND_SHARE = 0.001
#: of all measurements of a sound robot, those in which some servo may be blamed; a tenth and ten times of it change nothing, either
SIGNIFICANCE = 0.001
ALIKE = "lose answers"


@dataclass(frozen=True)
class LostAlone:
    """Joint → how many answers it lost by itself, in the order in which they answer, each of so many `reads`."""

    counts: dict[str, int]
    reads: int


def lost_in(run: Run) -> LostAlone:
    """`lost_alone` of a recording, while this computer was punctual; of no reads where nothing can be concluded."""
    return lost_alone(run.joints, losses(run).counted)


def lost_alone(joints: Sequence[str], lost: NDArray[np.bool_]) -> LostAlone:
    """What each joint lost by itself.

    Servos answer one after another: one that waits in vain for the one before it is lost with it, which says nothing of its
    own cable. Where most are lost together, it is none of theirs.

    Args:
        joints: in the order in which they answer. lost: (n, joints) in n reads of all.
    """
    before = np.column_stack([np.zeros(len(lost), bool), lost[:, :-1]])
    own = lost & (~before | (lost.sum(axis=1) > len(joints) / 2)[:, None])
    return LostAlone(dict(zip(joints, own.sum(axis=0).tolist(), strict=True)), len(lost))


def most_lost(reads: int, servos: int = 1) -> int:
    """How many of so many answers a sound servo loses at most, where so many servos are judged at once."""
    return math.ceil(bdtrik(1 - SIGNIFICANCE / servos, reads, SOUND_SHARE)) if reads else 0


def loose(
    lost: LostAlone, chain: Sequence[Sequence[str]], known: Sequence[str] = (), *, moving: bool = True
) -> list[str]:
    """Which connector loses contact, in a line each; what all servos lose alike is one line.

    Args:
        chain: how the cables run; by legs where unknown.
        known: what was found before; a joint that is named there is not named again.
        moving: whether answers were lost while the legs moved.
    """
    cables = chain or [[f"hip_{leg}", f"knee_{leg}"] for leg in ("rr", "fr", "fl", "rl")]
    counts, servos = lost.counts, len(lost.counts)
    bad = {joint for joint, count in counts.items() if count > most_lost(lost.reads, servos)}
    out = list[str]()
    if len(bad) > servos / 2:
        out += (
            []
            if any(ALIKE in line for line in known)
            else [
                f"{len(bad)} of {servos} servos {ALIKE}{' while they move' if moving else ''} → the power plug and the supply, the "
                f"adapter and its first cable, or a busy computer: all share them; or the cable of {next(iter(counts))}, which answers first, "
                "and for which the others wait"
            ]
        )
        middle = math.ceil(np.median(list(counts.values())))
        bad = {joint for joint in bad if bdtrc(counts[joint] - 1, counts[joint] + middle, 0.5) < SIGNIFICANCE / servos}
    for cable in cables:
        there = [joint for joint in cable if joint in bad]
        if there and not any(line.startswith(f"{there[0]}:") and "connector" in line for line in known):
            first = cable.index(there[0])
            between = f"between {cable[first - 1]} and {there[0]}" if first else f"from the board to {there[0]}"
            share = percent(counts[there[0]] / lost.reads, decimals=1)
            out.append(
                f"{there[0]}: {share} of its answers were lost{' while it moved' if moving else ''} → a loose connector {between}"
            )
    return out
