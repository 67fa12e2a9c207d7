"""What of a recording is no measurement, and whether a model moves at all as the robot did. What else is asked of both: `rules`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.floor import resolution
from openant_tools.model.plant import Plant
from openant_tools.numbers import number
from openant_tools.recording.run import Run

__all__ = ["Telemetry", "check_model", "span", "without_errors"]

Array = NDArray[np.float64]

#: rad; a joint that is commanded less says nothing about whether the model is that of this robot
TELLING_RAD = 0.1
#: share of a joint's variation that a model's error may have: beyond, it explains not even a fifth of the variance
UNLIKE = 0.9
#: a sample lies outside of both neighbours by more than so many steps of the encoder, or times of what such distances
#: usually are, to be an error of telemetry
GLITCH_QUANTA, GLITCH_TIMES = 8, 8.0
#: what a glitch, as far as it lies beyond its neighbours, leaves in the line through their own neighbours: a motion leaves far more
GLITCH_ALONE = 0.25


@dataclass(frozen=True)
class Telemetry:
    """What was left out of a run before it was fitted: joint → samples.

    Attributes:
        glitches: positions that stand alone, far from where the joint was just before and just after.
        missing: positions that were not read: `ok` is 0, or there is none.
    """

    glitches: Mapping[str, int]
    missing: Mapping[str, int]


def without_errors(run: Run, joints: Sequence[str]) -> tuple[Run, Telemetry]:
    """The run with positions that are none taken out (NaN): what was not read, and single-sample spikes.

    A joint cannot go far and be back within two samples. A spike lies beyond both neighbours, and without it they lie on a
    smooth line; a true peak bends that line as well, a late sample lies between its neighbours. Where the command steps a joint may
    turn back between two samples: what is no larger than that step is no spike there.
    """
    columns = dict(run.columns)
    glitches, missing = {}, {}
    for joint in joints:
        pos = run.column(f"pos.{joint}").copy()
        pos[run.column(f"ok.{joint}") == 0] = np.nan
        lost = int((~np.isfinite(pos)).sum())
        spikes = _spikes(run.t, pos, run.column(f"cmd.{joint}"), resolution(run, "pos", joint))
        pos[spikes] = np.nan
        if lost or len(spikes):
            columns[f"pos.{joint}"] = pos
            glitches[joint], missing[joint] = len(spikes), lost
    return replace(run, columns=columns), Telemetry(
        {joint: n for joint, n in glitches.items() if n}, {joint: n for joint, n in missing.items() if n}
    )


def _spikes(t: Array, pos: Array, cmd: Array, step: float) -> NDArray[np.int64]:
    """Rows of samples that stand alone."""
    rows = np.flatnonzero(np.isfinite(pos))
    if len(rows) < 7:
        return rows[:0]
    t, x = t[rows], pos[rows]

    def off(i: NDArray[np.int64], before: int, after: int) -> Array:
        """How far samples i are from the line between those so many places before and after them."""
        a, b = i - before, i + after
        share = (t[i] - t[a]) / (t[b] - t[a])
        out: Array = x[i] - (1 - share) * x[a] - share * x[b]
        return out

    inner = np.arange(2, len(x) - 2)
    alone = off(inner, 1, 1)
    low, high = np.minimum(x[inner - 1], x[inner + 1]), np.maximum(x[inner - 1], x[inner + 1])
    beyond = np.maximum(x[inner] - high, low - x[inner])
    limit = max(GLITCH_QUANTA * step, GLITCH_TIMES * 1.4826 * float(np.median(np.abs(alone))))
    left = np.maximum(np.abs(off(inner - 1, 1, 2)), np.abs(off(inner + 1, 2, 1)))
    near = sliding_window_view(cmd[rows], 4)[: len(inner)]  # from two rows before a sample to one after it
    stepped = np.nan_to_num(np.fmax.reduce(near, axis=1) - np.fmin.reduce(near, axis=1))
    spike = (beyond > np.maximum(limit, stepped)) & (left < GLITCH_ALONE * beyond + step)
    found: NDArray[np.int64] = rows[inner[spike]]
    return found


def check_model(run: Run, plant: Plant, simulated: Array) -> None:
    """Refuse a model that does not move as the robot did at all: a fit of it would answer with numbers that mean nothing.

    Args:
        simulated: (rows, joints) rad, what the given model did with the run's commands.

    Raises:
        BadInput: the simulation fails, or a joint's error varies as much as its position does.
    """
    where = str(run.path or run.name)
    pos, cmd = run.signal("pos", plant.joints), run.signal("cmd", plant.joints)
    for j, joint in enumerate(plant.joints):
        told = np.isfinite(pos[:, j])
        first = int(np.argmax(np.isfinite(simulated[:, j])))
        told[:first] = False
        if not np.isfinite(simulated[told, j]).all():
            raise BadInput(
                f"the model's simulation of {joint} fails with this run's commands",
                where=where,
                remedy="check the model: its time step may be too long for its stiffness",
            )
        on = told & (run.signal("torque", [joint], default=1.0)[:, 0] != 0)
        if not on.any() or span(cmd[on, j]) < TELLING_RAD or span(pos[on, j]) < TELLING_RAD:
            continue
        varies, left = float(np.std(pos[on, j])), float(np.std(pos[on, j] - simulated[on, j]))
        if left > UNLIKE * varies:
            raise BadInput(
                f"{joint} moves otherwise than in the model altogether: it varies by {number(varies, 'rad')}, the model's error by "
                f"{number(left, 'rad')}",
                where=where,
                remedy="check whether this is the model of this robot: its masses, gains, axes and zeros; if it is, "
                "`openant gap diagnose` says what else may move it so",
            )


def span(values: Array) -> float:
    """How far values go, those that are finite."""
    values = values[np.isfinite(values)]
    return float(np.ptp(values)) if len(values) else 0.0
