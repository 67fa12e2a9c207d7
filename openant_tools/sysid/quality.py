"""What is wrong with a recording, said before any number is given: bad data fit too, and silently.

Each check names the run, the joint and what to do. All are about commands and positions only, so that they hold for any log.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.floor import resolution
from openant_tools.model.plant import Plant
from openant_tools.recording.run import Run
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE, RAD_S_PER_COUNT
from openant_tools.sysid.kinds import KINDS, torque_limit

__all__ = ["Telemetry", "check_model", "check_runs", "without_errors"]

Array = NDArray[np.float64]

#: s; below it there is not one motion to its end
SHORTEST_S = 1.0
#: a joint moves if it does so by more than this many steps of its encoder
MOVES_QUANTA = 5
#: share of the samples at the torque limit beyond which a run shows the limit and nothing else
SATURATED = 0.9
#: a position follows a command if they correlate above this, and does not below LOOSE
FOLLOWS, LOOSE = 0.9, 0.5
#: a position that swings this much more or less than the command that it follows is in another unit
OTHER_UNIT = 10.0
#: rad; where a model sets no range, a joint that reads more than two turns is in another unit
MOST_RAD = 4 * math.pi
#: rad; a joint that is commanded less says nothing about whether the model is that of this robot
TELLING_RAD = 0.1
#: share of a joint's variation that a model's error may have: beyond, it explains not even a fifth of the variance
UNLIKE = 0.9
#: rad beyond a joint's range that a soft stop and a zero offset may explain
BEYOND_STOP_RAD = 0.5
#: a sample lies outside of both neighbours by more than so many steps of the encoder, or times of what such distances
#: usually are, to be an error of telemetry
GLITCH_QUANTA, GLITCH_TIMES = 8, 8.0
#: operating mode in which position limits are in force, and the bit of the drive mode by which profiles count ms (e-manual)
POSITION_MODE, TIME_BASED = 3, 0x04
#: rad/s below which a command rests, and the share of a motion that may be faster than a profile
STILL_RAD_S, TOO_FAST = 0.01, 0.2
#: what a glitch leaves of itself in the line through its neighbours' own neighbours: a motion leaves far more
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
    smooth line; a true peak bends that line as well, a late sample lies between its neighbours.
    """
    columns = dict(run.columns)
    glitches, missing = {}, {}
    for joint in joints:
        pos = run.column(f"pos.{joint}").copy()
        pos[run.column(f"ok.{joint}") == 0] = np.nan
        lost = int((~np.isfinite(pos)).sum())
        spikes = _spikes(run.t, pos, resolution(run, "pos", joint))
        pos[spikes] = np.nan
        if lost or len(spikes):
            columns[f"pos.{joint}"] = pos
            glitches[joint], missing[joint] = len(spikes), lost
    return replace(run, columns=columns), Telemetry(
        {joint: n for joint, n in glitches.items() if n}, {joint: n for joint, n in missing.items() if n}
    )


def _spikes(t: Array, pos: Array, step: float) -> NDArray[np.int64]:
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
    spike = (beyond > limit) & (left < GLITCH_ALONE * np.abs(alone) + 2 * step)
    found: NDArray[np.int64] = rows[inner[spike]]
    return found


def check_runs(runs: Sequence[Run], plant: Plant) -> None:
    """Refuse runs that cannot determine what they are fitted for.

    Raises:
        BadInput: a run is too short, nothing or one joint does not move, its torque is saturated throughout, its positions
            are outside the model's range (a wrong unit, zero or model), run against their commands, or belong to another
            joint's.
    """
    for run in runs:
        where = str(run.path or run.name)
        if run.duration_s < SHORTEST_S:
            raise BadInput(
                f"too short to fit: {run.duration_s:.2f} s", where=where, remedy="record at least a few seconds"
            )
        pos, cmd = run.signal("pos", plant.joints), run.signal("cmd", plant.joints)
        moves = [
            _span(pos[:, j]) > MOVES_QUANTA * resolution(run, "pos", joint) for j, joint in enumerate(plant.joints)
        ]
        if not any(moves):
            raise BadInput("nothing moves in this run", where=where, remedy="record a protocol that moves the joints")
        for problem, remedy in _problems(run, plant, pos, cmd, moves):
            raise BadInput(problem, where=where, remedy=remedy)


def _by_registers(run: Run, plant: Plant, cmd: Array) -> Iterator[tuple[str, str]]:
    """Joints whose servo could not go where it was sent, by the registers that the run names: they show these and nothing else."""
    remedy = "set it to the factory's value (`openant calib inventory`) and record again"
    for j, joint in enumerate(plant.joints):
        table = run.facts.registers.get(joint, {})
        on = run.signal("torque", [joint], default=1.0)[:, 0] != 0
        low, high = table.get("min_position_limit"), table.get("max_position_limit")
        wanted = _span(cmd[on, j]) if on.any() else 0.0
        # Where the joint's zero is, a table does not say: the width alone tells.
        if low is not None and high is not None and table.get("operating_mode", POSITION_MODE) == POSITION_MODE:
            left = max(0.0, (high - low) * RAD_PER_PULSE)
            if wanted > left:
                yield (
                    f"{joint} is commanded over {wanted:.2f} rad, and its registers min_position_limit = {low:.0f} and "
                    f"max_position_limit = {high:.0f} leave {left:.2f} rad",
                    remedy,
                )
        speed = table.get("profile_velocity", 0) * RAD_S_PER_COUNT
        if speed > 0 and not int(table.get("drive_mode", 0)) & TIME_BASED and len(run.t) > 1:
            with np.errstate(invalid="ignore"):
                rate = np.abs(np.diff(cmd[:, j]) / np.diff(run.t))
                moving = rate[rate > STILL_RAD_S]
                faster = float(np.mean(moving > speed)) if len(moving) else 0.0
            if faster > TOO_FAST:
                yield (
                    f"{joint} is commanded faster than its register profile_velocity = {table['profile_velocity']:.0f} lets it "
                    f"turn ({speed:.2g} rad/s) in {100 * faster:.0f} % of its motion",
                    remedy,
                )


def _problems(run: Run, plant: Plant, pos: Array, cmd: Array, moves: Sequence[bool]) -> Iterator[tuple[str, str]]:
    yield from _by_registers(run, plant, cmd)
    for j, joint in enumerate(plant.joints):
        on = run.signal("torque", [joint], default=1.0)[:, 0] != 0
        commanded = _span(cmd[on, j]) if on.any() else 0.0
        if commanded > 10 * MOVES_QUANTA * resolution(run, "pos", joint) and not moves[j]:
            yield (
                f"{joint} is commanded over {commanded:.2f} rad and does not move",
                f"check its cable, horn and torque, or leave it out with --joint (all others: {_others(plant, joint)})",
            )
    for j, joint in enumerate(plant.joints):
        low, high = _range(plant, j)
        outside = np.nanmean((pos[:, j] < low - BEYOND_STOP_RAD) | (pos[:, j] > high + BEYOND_STOP_RAD))
        if outside > 0.5:
            yield (
                f"pos.{joint} is around {np.nanmedian(pos[:, j]):.2f} rad, outside the model's range {low:.2f} … {high:.2f}",
                "check its unit (rad), its zero, and whether this is the model of this robot",
            )
    yield from _other_units(plant, pos, cmd, moves)
    yield from _crossed(plant, pos, cmd, moves)
    for j, joint in enumerate(plant.joints):
        share = _saturated(run, plant, j, pos[:, j], cmd[:, j])
        if share > SATURATED:
            yield (
                f"{joint} works at its torque limit in {100 * share:.0f} % of the samples",
                "record smaller or slower motions: a saturated servo shows its limit and nothing else",
            )


def _other_units(plant: Plant, pos: Array, cmd: Array, moves: Sequence[bool]) -> Iterator[tuple[str, str]]:
    """Positions or commands in degrees or counts, where no range of the model shows it."""
    for j, joint in enumerate(plant.joints):
        if moves[j] and _correlation(cmd[:, j], pos[:, j]) > FOLLOWS:
            both = np.isfinite(cmd[:, j]) & np.isfinite(pos[:, j])
            ratio = float(np.std(pos[both, j]) / np.std(cmd[both, j]))
            if not 1 / OTHER_UNIT < ratio < OTHER_UNIT:
                names = ("pos", "cmd") if ratio > 1 else ("cmd", "pos")
                yield (
                    f"{names[0]}.{joint} swings {max(ratio, 1 / ratio):.0f} times as far as {names[1]}.{joint}: they are in "
                    "different units",
                    "give both in rad (1 rad is 57.3 degrees)",
                )
        if not math.isfinite(_range(plant, j)[1]):
            for name, values in (("pos", pos[:, j]), ("cmd", cmd[:, j])):
                furthest = float(np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values)))
                if furthest > MOST_RAD:
                    yield (
                        f"{name}.{joint} reaches {furthest:.0f}, which is {furthest / (2 * math.pi):.0f} turns in rad",
                        "check its unit (rad); if the joint does turn that far, give it a range in the model",
                    )


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
        if not on.any() or _span(cmd[on, j]) < TELLING_RAD or _span(pos[on, j]) < TELLING_RAD:
            continue
        varies, left = float(np.std(pos[on, j])), float(np.std(pos[on, j] - simulated[on, j]))
        if left > UNLIKE * varies:
            raise BadInput(
                f"{joint} moves otherwise than in the model altogether: it varies by {varies:.2f} rad, the model's error by "
                f"{left:.2f} rad",
                where=where,
                remedy="check whether this is the model of this robot: its masses, gains, axes and zeros; if it is, "
                "`openant gap diagnose` says what else may move it so",
            )


def _span(values: Array) -> float:
    values = values[np.isfinite(values)]
    return float(np.ptp(values)) if len(values) else 0.0


def _range(plant: Plant, j: int) -> tuple[float, float]:
    joint = int(plant.model.dof_jntid[plant.dof[j]])
    if not plant.model.jnt_limited[joint]:
        return -math.inf, math.inf
    low, high = plant.model.jnt_range[joint]
    return float(low), float(high)


def _others(plant: Plant, joint: str) -> str:
    return ", ".join(other for other in plant.joints if other != joint) or "none"


def _crossed(plant: Plant, pos: Array, cmd: Array, moves: Sequence[bool]) -> Iterator[tuple[str, str]]:
    """Positions that follow another joint's command, or their own with the wrong sign.

    Only where the commands themselves can be told apart: joints that are always commanded alike say nothing about it.
    """
    names = plant.joints
    live = [j for j in range(len(names)) if moves[j] and _span(cmd[:, j]) > 0]
    follows = {(k, j): _correlation(cmd[:, k], pos[:, j]) for k in live for j in live}
    for j in live:
        if follows[j, j] < -FOLLOWS:
            yield (
                f"{names[j]} moves against its command",
                "one of cmd and pos has the wrong sign: check the joint's direction",
            )
        for k in live:
            alike = abs(_correlation(cmd[:, j], cmd[:, k])) > LOOSE
            if k > j and not alike and follows[k, j] > FOLLOWS and follows[j, k] > FOLLOWS and follows[j, j] < LOOSE:
                yield (
                    f"pos.{names[j]} follows cmd.{names[k]}, and pos.{names[k]} follows cmd.{names[j]}",
                    "the two columns, or the two servos' ids, are swapped",
                )


def _correlation(a: Array, b: Array) -> float:
    ok = np.isfinite(a) & np.isfinite(b)
    if ok.sum() < 3 or np.std(a[ok]) == 0 or np.std(b[ok]) == 0:
        return 0.0
    return float(np.corrcoef(a[ok], b[ok])[0, 1])


def _saturated(run: Run, plant: Plant, j: int, pos: Array, cmd: Array) -> float:
    """The share of samples with torque in which the servo gives all it may: by its duty, else by stiffness times error."""
    joint = plant.joints[j]
    on = run.signal("torque", [joint], default=1.0)[:, 0] != 0
    duty = np.abs(run.column(f"pwm.{joint}"))
    if np.isfinite(duty).any():
        counts = run.facts.registers.get(joint, {}).get("pwm_limit")
        limit = counts / PWM_FULL if counts else 1.0
        full = duty > 0.98 * limit
        known = np.isfinite(duty) & on
    else:
        torque = KINDS["stiffness"].read(plant.model, plant, j) * np.abs(cmd - pos)
        full = torque > torque_limit(plant.model, plant, j)
        known = np.isfinite(torque) & on
    return float(full[known].mean()) if known.any() else 0.0
