"""Ramps: commands that lead slowly to a pose, before torque goes off, after it came on, or between two episodes of a policy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["ramps"]

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: s and commands that a ramp takes at least
SHORTEST_S, COMMANDS = 0.2, 5
#: rad by which a ramp's commands are off a straight line at most (a servo's step, rounded on both sides), and as a share of its length
OFF_LINE_RAD, OFF_LINE = 0.004, 0.01
#: rad that a joint has to go to count as one that a ramp moves
MOVES_RAD = 0.01
#: rad that no ramp goes from one command to the next; rad by which a command changes at all
JUMP_RAD, LEAST_RAD = 0.05, 1e-9
#: joints that may go along one line by themselves: what fewer do cannot be told from a motion that is to tell something
TELLS = 3
#: s between torque, or the run's ends, and a ramp that belongs to them
NEAR_S = 1.0
#: s for which a pose is held that a ramp led to, and rad within which two poses are one
HELD_S, SAME_RAD = 0.15, 0.02


@dataclass(frozen=True)
class _Way:
    """Rows of commands that lead from one pose straight to another, (joints,) rad."""

    first: int
    last: int
    end: Array
    jumped: bool  # to where it begins


def ramps(t: Array, cmd: Array, off: Bools, *, floor: bool) -> Bools:
    """(rows,) where commands lead slowly to a pose.

    A motion that is to tell something goes to and fro, or its joints each go their own way. A ramp leads at least TELLS joints along
    one straight line to rest, and stands beside the run's ends or where torque is switched. On a floor one that leads back to where the
    run began, or where such a ramp led, from commands that jump (a policy's), resets the robot.

    Args:
        t: (rows,) s. cmd: (rows, joints) rad, missing ones leave those before in force.
        off: (rows,) where the robot has no torque; a leg's release is none of it.
    """
    out = np.zeros(len(t), bool)
    commanded = np.flatnonzero(np.isfinite(cmd).all(axis=1))
    if not len(commanded):
        return out
    ends_at = np.concatenate([t[1:][off[1:] != off[:-1]], t[commanded[[0, -1]]]])
    ways = _ways(t, cmd)
    ends = [way for way in ways if (np.abs(ends_at[:, None] - t[[way.first, way.last]]) < NEAR_S).any()]
    homes = np.array([cmd[commanded[0]], *(way.end for way in ends)])
    resets = [way for way in ways if floor and way.jumped and (np.abs(way.end - homes) < SAME_RAD).all(axis=1).any()]
    for way in [*ends, *resets]:
        out[way.first : way.last] = True
    return out


def _ways(t: Array, cmd: Array) -> list[_Way]:
    given = np.isfinite(cmd)
    row = np.maximum.accumulate(np.where(given, np.arange(len(t))[:, None], 0), axis=0)
    held = np.take_along_axis(cmd, row, axis=0)
    rows = 1 + np.flatnonzero((np.nan_to_num(np.abs(np.diff(held, axis=0))) > LEAST_RAD).any(axis=1))
    out = []
    for last in np.flatnonzero(np.diff(t[rows], append=np.inf) > HELD_S):
        # Parts of a straight way are straight: the longest one to where it rests is found by halving.
        bent, straight = -1, int(last)
        while straight - bent > 1:
            middle = (straight + bent) // 2
            if _straight(held, int(rows[middle]) - 1, int(rows[last])):
                straight = middle
            else:
                bent = middle
        before = np.abs(held[rows[straight - 1]] - held[rows[straight - 1] - 1]).max() if straight else 0.0
        way = _Way(int(rows[straight]) - 1, int(rows[last]), held[rows[last]], bool(before > JUMP_RAD))
        moves = np.abs(held[way.last] - held[way.first]) > MOVES_RAD
        slow = last - straight >= COMMANDS and t[way.last] - t[way.first] >= SHORTEST_S
        if moves.sum() >= TELLS and slow:
            out.append(way)
    return out


def _straight(cmd: Array, first: int, last: int) -> bool:
    """Whether the commands of these rows go straight from the first one to the last one."""
    path = cmd[first : last + 1] - cmd[first]
    aim = path[-1]
    length = float(np.linalg.norm(aim))
    if not np.isfinite(path).all():
        return False
    share = path @ aim / length**2 if length > 0 else np.zeros(len(path))
    allowed = OFF_LINE_RAD * math.sqrt(len(aim)) + OFF_LINE * length
    back = float(np.max(np.maximum.accumulate(share) - share)) * length
    return back <= allowed and float(np.abs(path - share[:, None] * aim).max()) <= allowed
