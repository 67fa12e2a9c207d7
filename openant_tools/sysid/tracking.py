"""How late positions follow sines: the look at tracking by which delays are first seen, in numbers.

A servo is late by its own lag already (friction, damping over stiffness); a delay adds itself at every frequency alike. So
the number means little alone and much beside another: of a model, another robot, another day.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openant_tools.recording.run import Run

__all__ = ["Tracking", "tracking"]

Array = NDArray[np.float64]

#: share of a segment at each end that is left out: the sine fades in and out there
ENDS = 0.2


@dataclass(frozen=True)
class Tracking:
    """How one joint follows.

    Attributes:
        late_s: at each frequency, how much later than its command the position is.
        gain: at each frequency, its amplitude over the command's.
    """

    joint: str
    hz: tuple[float, ...]
    late_s: tuple[float, ...]
    gain: tuple[float, ...]


def tracking(run: Run) -> list[Tracking]:
    """How each joint follows the sines of a recording; empty where it says of none."""
    sines = [entry for entry in run.facts.extra.get("segments", ()) if entry.get("kind") == "Sine"]
    out = []
    for joint in run.joints if sines else ():
        seen = sorted((float(entry["hz"]), *_response(run, joint, entry)) for entry in sines)
        hz, late, gain = (tuple(column) for column in zip(*seen, strict=True))
        out.append(Tracking(joint, hz, late, gain))
    return out


def _response(run: Run, joint: str, entry: dict[str, float]) -> tuple[float, float]:
    """(s late, gain) of a sine segment: command and position as amplitude and phase at its frequency."""
    start, seconds, omega = entry["start_s"], entry["seconds"], 2 * math.pi * entry["hz"]
    t = run.t - run.t[0]
    inside = (t > start + ENDS * seconds) & (t < start + (1 - ENDS) * seconds)
    # A command acts from when it was sent; a position is of when it was read.
    command = _phasor(run.command_times[inside] - run.t[0], run.column(f"cmd.{joint}")[inside], omega)
    position = _phasor(t[inside], run.column(f"pos.{joint}")[inside], omega)
    ratio = position / command
    # A staircase of commands is itself half a step late.
    held = float(np.median(np.diff(run.t))) / 2
    return -float(np.angle(ratio)) / omega - held, abs(ratio)


def _phasor(t: Array, values: Array, omega: float) -> complex:
    known = np.isfinite(values)
    t, values = t[known], values[known]
    columns = np.stack([np.cos(omega * t), -np.sin(omega * t), np.ones_like(t), t], axis=1)
    real, imaginary, _, _ = np.linalg.lstsq(columns, values, rcond=None)[0]
    return complex(real, imaginary)
