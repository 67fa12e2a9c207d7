"""Which cable loses answers: what one joint, or what hangs behind it, loses alone, and what all servos lose alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from openant_tools.comms.lateness import losses
from openant_tools.numbers import percent
from openant_tools.recording.run import Run

__all__ = ["loose", "lost_alone", "lost_in"]

#: share of its answers that a servo may lose
LOST_SHARE = 0.004
#: a joint stands out of those that lose answers alike where it loses so many times as many
STANDS_OUT = 3.0
ALIKE = "lose answers"


def lost_in(run: Run) -> dict[str, float]:
    """`lost_alone` of a recording, while this computer was punctual; 0 where nothing can be concluded."""
    seen = losses(run)
    return lost_alone(run.joints, seen.lost[seen.rows] if seen.judged else seen.lost[:0])


def lost_alone(joints: Sequence[str], lost: NDArray[np.bool_]) -> dict[str, float]:
    """Joint → share of its answers that it lost by itself; 0 of no reads.

    Servos answer one after another: one that waits in vain for the one before it is lost with it, which says nothing of its
    own cable. Where most are lost together, it is none of theirs.

    Args:
        joints: in the order in which they answer. lost: (n, joints) in n reads of all.
    """
    if not len(lost):
        return dict.fromkeys(joints, 0.0)
    before = np.column_stack([np.zeros(len(lost), bool), lost[:, :-1]])
    own = lost & (~before | (lost.mean(axis=1) > 0.5)[:, None])
    return dict(zip(joints, own.mean(axis=0).tolist(), strict=True))


def loose(
    lost: Mapping[str, float],
    chain: Sequence[Sequence[str]],
    known: Sequence[str] = (),
    *,
    least: float = LOST_SHARE,
    moving: bool = True,
) -> list[str]:
    """Which connector loses contact, in a line each; what all servos lose alike is one line.

    Args:
        lost: joint → share of answers lost, in the order in which they answer.
        chain: how the cables run; by legs where unknown.
        known: what was found before; a joint that is named there is not named again.
        least: share from which a loss counts. moving: whether they were lost while the legs moved.
    """
    cables = chain or [[f"hip_{leg}", f"knee_{leg}"] for leg in ("rr", "fr", "fl", "rl")]
    bad = {joint for joint, share in lost.items() if share > least}
    out = list[str]()
    if len(bad) > len(lost) / 2:
        out += (
            []
            if any(ALIKE in line for line in known)
            else [
                f"{len(bad)} of {len(lost)} servos {ALIKE}{' while they move' if moving else ''} → the power plug and the supply, the "
                f"adapter and its first cable, or a busy computer: all share them; or the cable of {next(iter(lost))}, which answers first, "
                "and for which the others wait"
            ]
        )
        middle = float(np.median(list(lost.values())))
        bad = {joint for joint in bad if lost[joint] > STANDS_OUT * middle}
    for cable in cables:
        there = [joint for joint in cable if joint in bad]
        if there and not any(line.startswith(f"{there[0]}:") and "connector" in line for line in known):
            first = cable.index(there[0])
            between = f"between {cable[first - 1]} and {there[0]}" if first else f"from the board to {there[0]}"
            out.append(
                f"{there[0]}: {percent(lost[there[0]], decimals=1)} of its answers were lost{' while it moved' if moving else ''} → a "
                f"loose connector {between}"
            )
    return out
