"""What a log and a model must have in common before the one is judged by the other: one table of rules.

`rec info`, `sysid fit`, `gap measure` and `gap diagnose` go through the same table. A rule refuses where no figure would mean
anything, refuses a fit where the run shows nothing of what is fitted, or makes a note, and work goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.model.floor import resolution
from openant_tools.model.plant import Plant, beside_servos, position_servos
from openant_tools.model.rollout import Rollouts
from openant_tools.model.servo import read_stiffness, torque_limit
from openant_tools.model.stability import NUDGE, growth
from openant_tools.numbers import exact, literal, number, percent
from openant_tools.numbers import span as angles
from openant_tools.recording.run import Run
from openant_tools.robot.registers import PWM_FULL, RAD_PER_PULSE, RAD_S_PER_COUNT
from openant_tools.sysid.quality import span, without_errors

__all__ = ["RULES", "Finding", "Rule", "Verdict", "check_runs", "findings", "with_rows", "without_turns"]

Array = NDArray[np.float64]
Found = Iterator[tuple[str, str]]

#: s; below it there is not one motion to its end
SHORTEST_S = 1.0
#: a joint moves if it does so by more than this many steps of its encoder
MOVES_QUANTA = 5
#: share of the samples at the torque limit beyond which a run shows the limit and nothing else
SATURATED = 0.9
#: a position follows a command if they correlate above this
FOLLOWS = 0.9
#: it follows another's better if it leaves so much less unexplained than its own does; commands this much alike tell nothing
BETTER, ALIKE = 0.25, 0.98
#: and a command is the one that follows if that leaves so much less: no servo moves before it is commanded
LEADS = 0.5
#: rows by which a position may come later than its command, and as many of a run as are looked at
LATEST_ROWS, LOOKED_AT = 15, 20_000
#: a position that swings this much more or less than the command that it follows is in another unit
OTHER_UNIT = 10.0
#: rad; where a model sets no range, a joint that reads more than two turns is in another unit, or turns for ever
MOST_RAD = 4 * math.pi
#: steps of encoders in degrees (4096, 1024 a turn or over 300°, whole degrees); in rad no servo has one as coarse
DEGREE_STEPS = (360 / 4096, 360 / 1024, 300 / 1024, 1.0)
#: s between rows, rad/s and rad: rows so far apart in which a joint moved so far are of no motion as slow as this
SPARSE_S, CREEPS_RAD_S, WENT_RAD = 0.2, 0.02, 0.1
#: s between rows that no bus of servos comes near, rad/s that no joint reaches, and into how many parts a run is cut to see it
DENSE_S, FLIES_RAD_S, PARTS = 1e-3, 100.0, 50
#: rad, a jump from row to row that is a turn less a moment's motion; s, rows further apart can miss a true one
WRAP_RAD, WRAP_ROW_S = 5.0, 0.2
#: rad that a joint may be off a whole turn from its command
NEAR_TURN_RAD = 1.0
#: share of rows, and rad, by which positions may be beyond the model's range without a word: soft stops, noise
BEYOND, BEYOND_RAD = 0.01, 0.01
#: rad by which a command may be beyond `ctrlrange` without a word: rounding
CUT_RAD = 1e-3
#: operating mode in which position limits are in force, and the bit of the drive mode by which profiles count ms (e-manual)
POSITION_MODE, TIME_BASED = 3, 0x04
#: rad/s below which a command rests, and the share of a motion that may be faster than a profile
STILL_RAD_S, TOO_FAST = 0.01, 0.2
#: s of each run in which a model shows whether it falls apart, and into how many parts a step is cut to see what would help
TRIED_S, FINER = 20.0, (2, 4, 8, 16)
#: poses of a run in which servos must hold still, parts of a step that are as good as none at all, and s until a step is over
POSES, FINEST, HELD_S = 5, 1024, 2.0


class Verdict(Enum):
    """What a rule says where it finds something."""

    REFUSE = "refuse"
    REFUSE_FIT = "refuse to fit"
    NOTE = "note"


@dataclass(frozen=True)
class Case:
    """One run, and the model that it is played with where there is one.

    Attributes:
        joints: those that are commanded and measured.
    """

    run: Run
    joints: tuple[str, ...]
    plant: Plant | None = None

    @cached_property
    def pos(self) -> Array:
        return self.run.signal("pos", self.joints)

    @cached_property
    def cmd(self) -> Array:
        return self.run.signal("cmd", self.joints)

    @cached_property
    def on(self) -> NDArray[np.bool_]:
        """(rows, joints) whether torque is on."""
        out: NDArray[np.bool_] = self.run.signal("torque", self.joints, default=1.0) != 0
        return out

    @cached_property
    def steps(self) -> list[float]:
        """Of each joint, the step of its encoder, rad."""
        return [resolution(self.run, "pos", joint) for joint in self.joints]

    @cached_property
    def moves(self) -> list[bool]:
        return [span(self.pos[:, j]) > MOVES_QUANTA * step for j, step in enumerate(self.steps)]

    @cached_property
    def row_s(self) -> float:
        return float(np.median(np.diff(self.run.t))) if len(self.run.t) > 1 else math.nan

    def commanded(self, j: int) -> float:
        """rad over which a joint is commanded while it has torque."""
        return span(self.cmd[self.on[:, j], j])


@dataclass(frozen=True)
class Rule:
    """One row of the table.

    Attributes:
        name: what it looks for.
        find: (what is wrong, what to do) of each place where it is so.
        needs_model: whether it compares the run with a model.
        of_turns: whether it looks for turns, which are taken out for all others.
    """

    name: str
    verdict: Verdict
    find: Callable[[Case], Found]
    needs_model: bool = False
    of_turns: bool = False


@dataclass(frozen=True)
class Finding:
    """What a rule found in a run."""

    rule: str
    verdict: Verdict
    where: str
    what: str
    remedy: str

    @property
    def words(self) -> str:
        return str(BadInput(self.what, remedy=self.remedy))

    def __str__(self) -> str:
        return str(BadInput(self.what, where=self.where, remedy=self.remedy))


def findings(run: Run, joints: Sequence[str], plant: Plant | None = None) -> Iterator[Finding]:
    """What every rule finds in a run, by the table's order; without a model the rules that need none.

    Args:
        joints: those to look at; where they are not both commanded and measured nothing is found.
        plant: the model, set up as the run was made, with the same joints.
    """
    run = without_errors(run, joints)[0]
    recorded, straight = Case(run, tuple(joints), plant), Case(without_turns(run, joints), tuple(joints), plant)
    for rule in RULES:
        if plant is not None or not rule.needs_model:
            for what, remedy in rule.find(recorded if rule.of_turns else straight):
                yield Finding(rule.name, rule.verdict, str(run.path or run.name), what, remedy)


def check_runs(
    runs: Sequence[Run],
    plants: Sequence[Plant],
    *,
    fitting: bool = True,
    tell: Callable[[str], None] | None = None,
) -> tuple[str, ...]:
    """Go through the table; what is noted and not refused, a line each.

    Args:
        plants: of each run its model, set up as the run was made.
        fitting: refuse, too, what shows nothing of that which is fitted.
        tell: called with each note at once, so that those before a refusal are heard.

    Raises:
        BadInput: the first finding that refuses.
    """
    said: list[str] = []
    for run, plant in zip(runs, plants, strict=True):
        for found in findings(run, plant.joints, plant):
            if found.verdict is Verdict.REFUSE or (fitting and found.verdict is Verdict.REFUSE_FIT):
                raise BadInput(found.what, where=found.where, remedy=found.remedy)
            said.append(str(found))
            if tell:
                tell(said[-1])
    return tuple(said)


def with_rows(runs: Sequence[Run]) -> tuple[list[Run], tuple[str, ...]]:
    """The runs of more than one row, and a line for each that is left out.

    Raises:
        BadInput: there are runs, and none has more.
    """
    remedy = "export all rows of the run"
    single = [run.path or run.name for run in runs if len(run.t) < 2]
    if single and len(single) == len(runs):
        raise BadInput("it has one row: nothing can be seen to move", where=single[0], remedy=remedy)
    said = tuple(str(BadInput("it has one row and is left out", where=where, remedy=remedy)) for where in single)
    return [run for run in runs if len(run.t) > 1], said


def without_turns(run: Run, joints: Sequence[str]) -> Run:
    """The run with angles that go on where they were wrapped, and no whole turn between command and position."""
    columns = dict(run.columns)
    case = Case(run, tuple(joints))
    for j, joint in enumerate(joints):
        pos, cmd = _unwrapped(case, j)
        columns[f"pos.{joint}"] = pos - 2 * math.pi * _turns(pos, cmd, case.on[:, j])
        columns[f"cmd.{joint}"] = cmd
    return replace(run, columns=columns)


# --- time and units ------------------------------------------------------------------------------------------------------


def _few_rows(case: Case) -> Found:
    if len(case.run.t) == 1:
        yield "it has one row: nothing can be seen to move", "export all rows of the run"


def _time_unit(case: Case) -> Found:
    """Servos that cross a tenth of a radian as slowly as a clock's hand, in rows a fifth of a second apart or more.

    A step goes over in one row and shows a servo's own speed however rare the rows are; a log in ms shows a thousandth.
    """
    if not case.row_s > SPARSE_S:
        return
    fastest, furthest = 0.0, 0.0
    for j in range(len(case.joints)):
        known = np.flatnonzero(np.isfinite(case.pos[:, j]))
        if len(known) < 5 or case.commanded(j) < WENT_RAD:
            continue
        t, x = case.run.t[known], case.pos[known, j]
        # Of three neighbours the one in the middle: an error of telemetry is no motion.
        x = np.median(np.stack([x[:-2], x[1:-1], x[2:]]), axis=0)
        fastest = max(fastest, float(np.max(np.abs(np.diff(x)) / np.diff(t[1:-1]))))
        furthest = max(furthest, span(x))
    if furthest > WENT_RAD and fastest < CREEPS_RAD_S:
        unit, factor = ("ms", "0.001") if case.row_s < 500.0 else ("µs", "1e-6") if case.row_s < 5e5 else ("ns", "1e-9")
        yield (
            f"rows are {number(case.row_s, 's')} apart, and what moves over {number(furthest, 'rad')} is never faster than "
            f"{number(fastest, 'rad/s')}: t looks like {unit}",
            f"t is in s ({unit} × {factor})",
        )


def _time_too_short(case: Case) -> Found:
    """Joints that go further than noise in less time than any servo takes, in rows that lie closer than any bus is read."""
    if not case.row_s < DENSE_S:
        return
    n = max(1, len(case.run.t) // PARTS)
    for j, joint in enumerate(case.joints):
        known = np.flatnonzero(np.isfinite(case.pos[:, j]))[::n]
        if len(known) < 5:
            continue
        went, took = np.abs(np.diff(case.pos[known, j])), np.diff(case.run.t[known])
        far = went > WENT_RAD
        if far.any() and (speed := float(np.median(went[far] / took[far]))) > FLIES_RAD_S:
            yield (
                f"{joint} goes over {number(span(case.pos[:, j]), 'rad')} in {number(case.run.duration_s, 's')}, at "
                f"{number(speed, 'rad/s', decimals=0)}: t is too small to be in s",
                "t is in s, and was divided once too often (by 1000?)",
            )
            return


def _command_time(case: Case) -> Found:
    """Stamps of commands that do not keep pace with those of the rows."""
    stamps = case.run.column("cmd_t")
    t = case.run.t
    if len(t) < 3 or not np.isfinite(stamps).any():
        return
    last = float(np.nanmax(stamps)) - float(t[0])
    if last > OTHER_UNIT * (case.run.duration_s + 1.0):
        yield (
            f"cmd_t goes on to {number(last, 's')} after the first row, t to {number(case.run.duration_s, 's')}",
            "give both in s, on one clock (ms × 0.001, µs × 1e-6)",
        )


def _other_units(case: Case) -> Found:
    """Positions and commands of one joint in different units."""
    for j, joint in enumerate(case.joints):
        if case.moves[j] and _correlation(case.cmd[:, j], case.pos[:, j]) > FOLLOWS:
            both = np.isfinite(case.cmd[:, j]) & np.isfinite(case.pos[:, j])
            ratio = float(np.std(case.pos[both, j]) / np.std(case.cmd[both, j]))
            if not 1 / OTHER_UNIT < ratio < OTHER_UNIT:
                names = ("pos", "cmd") if ratio > 1 else ("cmd", "pos")
                yield (
                    f"{names[0]}.{joint} swings {number(max(ratio, 1 / ratio), decimals=0)} times as far as {names[1]}.{joint}: they are in "
                    "different units",
                    "give both in rad (1 rad is 57.3 degrees)",
                )


def _degrees(case: Case) -> Found:
    """Angles that are more likely in degrees."""
    for j, joint in enumerate(case.joints):
        for name, values in (("pos", case.pos[:, j]), ("cmd", case.cmd[:, j])):
            if name == "pos" and _degree_steps(case, j):
                yield (
                    f"pos.{joint} goes in steps of {number(case.steps[j])} to {number(_furthest(values))}: it looks like degrees",
                    "give it in rad (degrees × π/180)",
                )
                break
            if _furthest(values) > MOST_RAD and not math.isfinite(_range(case, j)[1]):
                yield (
                    f"{name}.{joint} reaches {number(_furthest(values), decimals=0)}, which is "
                    f"{number(_furthest(values) / (2 * math.pi), decimals=0)} turns "
                    "in rad",
                    "check its unit (rad); if the joint does turn that far, give it a range in the model",
                )
                break


def _degree_steps(case: Case, j: int) -> bool:
    coarse = any(math.isclose(case.steps[j], step, rel_tol=0.02) for step in DEGREE_STEPS)
    return coarse and case.moves[j] and _furthest(case.pos[:, j]) > math.pi


def _wrapped(case: Case) -> Found:
    for j, joint in enumerate(case.joints):
        for name, values in (("pos", case.pos[:, j]), ("cmd", case.cmd[:, j])):
            jumps = _wraps(case.run.t, values)
            if name == "cmd" and not _is_wrapped(case, j):
                continue
            if len(jumps):
                ends = "0 … 2π" if np.nanmin(values) > -math.pi / 2 else "±π"
                yield (
                    f"{name}.{joint} jumps by a turn {len(jumps)} times, first at t = {exact(case.run.t[jumps[0]], 's')}: it is "
                    f"wrapped to {ends}, and goes on as if it were not",
                    "record angles that go on beyond a turn",
                )


def _whole_turn(case: Case) -> Found:
    for j, joint in enumerate(case.joints):
        pos, cmd = _unwrapped(case, j)
        turns = _turns(pos, cmd, case.on[:, j])
        if turns:
            yield (
                f"pos.{joint} is {'a turn' if abs(turns) == 1 else f'{abs(turns)} turns'} "
                f"({number(2 * math.pi * turns, 'rad', sign=True, decimals=0)}) from cmd.{joint}, which is taken out",
                "set the joint's zero, or take whole turns out of its positions",
            )


# --- joints and columns --------------------------------------------------------------------------------------------------


def _too_short(case: Case) -> Found:
    if case.run.duration_s < SHORTEST_S:
        yield f"too short to fit: {number(case.run.duration_s, 's', decimals=2)}", "record at least a few seconds"


def _nothing_moves(case: Case) -> Found:
    if case.joints and not any(case.moves):
        yield "nothing moves in this run", "record a protocol that moves the joints"


def _by_registers(case: Case) -> Found:
    """Joints whose servo could not go where it was sent, by the registers that the run names: they show these and nothing else."""
    remedy = "set it to the factory's value (`openant calib inventory`) and record again"
    for j, joint in enumerate(case.joints):
        table = case.run.facts.registers.get(joint, {})
        low, high = table.get("min_position_limit"), table.get("max_position_limit")
        wanted = case.commanded(j)
        # Where the joint's zero is, a table does not say: the width alone tells.
        if low is not None and high is not None and table.get("operating_mode", POSITION_MODE) == POSITION_MODE:
            left = max(0.0, (high - low) * RAD_PER_PULSE)
            if wanted > left:
                yield (
                    f"{joint} is commanded over {number(wanted, 'rad')}, and its registers min_position_limit = {int(low)} and "
                    f"max_position_limit = {int(high)} leave {number(left, 'rad')}",
                    remedy,
                )
        speed = table.get("profile_velocity", 0) * RAD_S_PER_COUNT
        if speed > 0 and not int(table.get("drive_mode", 0)) & TIME_BASED and len(case.run.t) > 1:
            with np.errstate(invalid="ignore"):
                rate = np.abs(np.diff(case.cmd[:, j]) / np.diff(case.run.t))
                moving = rate[rate > STILL_RAD_S]
                faster = float(np.mean(moving > speed)) if len(moving) else 0.0
            if faster > TOO_FAST:
                yield (
                    f"{joint} is commanded faster than its register profile_velocity = {int(table['profile_velocity'])} lets it "
                    f"turn ({number(speed, 'rad/s')}) in {percent(faster)} of its motion",
                    remedy,
                )


def _does_not_move(case: Case) -> Found:
    for j, joint in enumerate(case.joints):
        if case.commanded(j) > 10 * MOVES_QUANTA * case.steps[j] and not case.moves[j]:
            others = ", ".join(other for other in case.joints if other != joint) or "none"
            yield (
                f"{joint} is commanded over {number(case.commanded(j), 'rad')} and does not move",
                f"check its cable, horn and torque, or leave it out with --joint (all others: {others})",
            )


def _exchanged(case: Case) -> Found:
    """Positions that follow each other's commands, around any ring of joints.

    Only where the commands can be told apart: joints that are always commanded alike say nothing about it.
    """
    names = case.joints
    live = [j for j in range(len(names)) if case.moves[j] or span(case.cmd[:, j]) > 0]
    held = [j for j in live if span(case.cmd[:, j]) <= MOVES_QUANTA * case.steps[j]]
    whose: dict[int, int] = {}
    for j in live:
        own = _followed(case, j, j)
        if own > FOLLOWS:
            continue
        follows = {k: _followed(case, k, j) for k in live}
        best = max(live, key=lambda k: follows[k])
        apart = abs(_correlation(case.cmd[:, j], case.cmd[:, best])) < ALIKE
        if apart and follows[best] > FOLLOWS and 1 - follows[best] < BETTER * (1 - own):
            whose[j] = best
    for j, k in list(whose.items()):
        # Of one that is held still, and whose position moves, the position that rests is the other's.
        if j in held and k not in whose and not case.moves[k]:
            whose[k] = j
    ring = [j for j in whose if _comes_back(j, whose)]
    if ring:
        yield (
            ", and ".join(f"pos.{names[j]} follows cmd.{names[whose[j]]}" for j in sorted(ring)),
            f"{'the two columns, or the two servos' if len(ring) == 2 else 'these columns, or these servos'}' ids, are swapped",
        )


def _comes_back(j: int, whose: dict[int, int]) -> bool:
    at = j
    for _ in range(len(whose)):
        if at not in whose:
            return False
        at = whose[at]
        if at == j:
            return True
    return False


def _before_command(case: Case) -> Found:
    """Positions that their commands follow: what is called one is the other."""
    backwards = replace(case, run=_exchanged_columns(case))
    for j, joint in enumerate(case.joints):
        if case.moves[j] and case.commanded(j) > MOVES_QUANTA * case.steps[j]:
            before = _by_delay(backwards, j, j)
            # What rises once and stays goes along with anything that does, the better the more rows are left out.
            known = 0 < int(np.argmax(before)) < len(before) - 1
            if known and max(before) > FOLLOWS and 1 - max(before) < LEADS * (1 - _followed(case, j, j)):
                yield (
                    f"cmd.{joint} follows pos.{joint}, and not the other way round",
                    f"exchange the two columns; where the joint was led by hand, say so by torque.{joint} = 0",
                )


def _exchanged_columns(case: Case) -> Run:
    """The run with commands and positions each in the place of the other, while torque was on."""
    columns = dict(case.run.columns)
    for j, joint in enumerate(case.joints):
        columns[f"cmd.{joint}"] = case.pos[:, j]
        columns[f"pos.{joint}"] = np.where(case.on[:, j], case.cmd[:, j], np.nan)
    return replace(case.run, columns=columns)


def _against_command(case: Case) -> Found:
    for j, joint in enumerate(case.joints):
        if case.moves[j] and _correlation(case.cmd[:, j], case.pos[:, j]) < -FOLLOWS:
            yield (
                f"{joint} moves against its command",
                "one of cmd and pos has the wrong sign: check the joint's direction",
            )


# --- log against model ---------------------------------------------------------------------------------------------------


def _beyond_range(case: Case) -> Found:
    for j, joint in enumerate(case.joints):
        low, high = _range(case, j)
        pos = case.pos[np.isfinite(case.pos[:, j]), j]
        beyond = (pos < low - BEYOND_RAD) | (pos > high + BEYOND_RAD)
        if len(pos) and beyond.mean() > BEYOND:
            furthest = pos[np.argmax(np.maximum(low - pos, pos - high))]
            yield (
                f"pos.{joint} was measured at {number(furthest, 'rad')}, beyond the model's range {angles(low, high, 'rad')}, in "
                f"{percent(beyond.mean())} of its rows",
                "widen the joint's `range`, or check its unit (rad), its zero, and whether this is the model of this robot",
            )


def _beyond_ctrlrange(case: Case) -> Found:
    assert case.plant is not None
    model = case.plant.model
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return
    for j, joint in enumerate(case.joints):
        ctrl = int(case.plant.ctrl[j])
        if not model.actuator_ctrllimited[ctrl]:
            continue
        low, high = (float(end) for end in model.actuator_ctrlrange[ctrl])
        cmd = case.cmd[np.isfinite(case.cmd[:, j]), j]
        cut = (cmd < low - CUT_RAD) | (cmd > high + CUT_RAD)
        if cut.any():
            furthest = cmd[np.argmax(np.maximum(low - cmd, cmd - high))]
            yield (
                f"cmd.{joint} goes to {number(furthest, 'rad')}, the model's ctrlrange is {angles(low, high, 'rad')}: "
                f"{percent(cut.mean())} of its commands are cut",
                "widen `ctrlrange` (or the `range` that it inherits), if the servo itself does not cut them",
            )


def _geared(case: Case) -> Found:
    """Servos whose setpoint is not the joint's angle."""
    assert case.plant is not None
    model = case.plant.model
    for j, joint in enumerate(case.joints):
        i = int(case.plant.actuator[j])
        gear = float(model.actuator_gear[i, 0])
        if math.isclose(gear, 1.0, rel_tol=1e-6):
            continue
        kp, kv = -float(model.actuator_biasprm[i, 1]) * gear**2, -float(model.actuator_biasprm[i, 2]) * gear**2
        same = f"kp={literal(kp, 4)}" + (f" kv={literal(kv, 4)}" if kv else "")
        if model.actuator_forcelimited[i]:
            low, high = sorted(float(end) * gear for end in model.actuator_forcerange[i])
            same += f" forcerange={literal(low, 4)} {literal(high, 4)}"
        affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
        yield (
            f"the actuator of {joint} has gear {literal(gear)}: MuJoCo turns the joint to command / gear, a servo to its command",
            f"write the servo at the joint, with gear 1: {same}" if affine and gear > 0 else
            "give it gear 1 and its numbers at the joint; where a servo turns backwards, turn the joint's axis",
        )  # fmt: skip


def _second_servo(case: Case) -> Found:
    """Joints that another position servo pulls to its own setpoint, which no log commands."""
    assert case.plant is not None
    model = case.plant.model
    for j, joint in enumerate(case.joints):
        for i in beside_servos(model, int(model.dof_jntid[case.plant.dof[j]]), int(case.plant.actuator[j])):
            yield (
                f"{joint} has two position servos in the model: beside the one that is commanded {model.actuator(i).name or i!r} "
                "pulls it to 0",
                "leave one of them, with the stiffness of both",
            )


def _without_servo(case: Case) -> Found:
    """Joints of the model that the log commands, and that hang limp in it."""
    assert case.plant is not None
    model, servos = case.plant.model, position_servos(case.plant.model)
    for k in range(model.njnt):
        joint = str(model.joint(k).name)
        if joint and joint not in servos and case.run.has("cmd", [joint]) and span(case.run.column(f"cmd.{joint}")) > 0:
            yield (
                f"cmd.{joint} is logged, and no position servo of the model drives {joint}: it hangs limp there",
                f'give it one: <position joint="{joint}" kp="…" forcerange="…"/>',
            )


def _coupled(case: Case) -> Found:
    """Joints that an equality or a tendon ties to others: what is fitted of one is of all."""
    assert case.plant is not None
    model = case.plant.model
    for j, joint in enumerate(case.joints):
        own = int(model.dof_jntid[case.plant.dof[j]])
        for k in range(model.neq):
            others = _tied_by_equality(model, k)
            if own in others:
                kind = mujoco.mjtEq(int(model.eq_type[k])).name.removeprefix("mjEQ_").lower()
                rest = ", ".join(_name(model, other) for other in sorted(others - {own})) or "the world"
                yield (
                    f"{joint} is coupled to {rest} by the equality {model.eq(k).name or kind!r}: what is found of it is of "
                    "all that turns with it",
                    "read its values together with those of what it is coupled to",
                )
        for k in range(model.ntendon):
            others = _joints_of_tendon(model, k)
            if own in others and len(others) > 1 and _acts(model, k):
                rest = ", ".join(_name(model, other) for other in sorted(others - {own}))
                yield (
                    f"{joint} is coupled to {rest} by the tendon {model.tendon(k).name or k!r}: what is found of it is of "
                    "all that turns with it",
                    "read its values together with those of what it is coupled to",
                )


def _tied_by_equality(model: mujoco.MjModel, k: int) -> set[int]:
    """Hinges and slides that an active equality lets turn together only."""
    kind, one, two = int(model.eq_type[k]), int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    if not model.eq_active0[k]:
        return set()
    if kind == mujoco.mjtEq.mjEQ_JOINT:
        return {joint for joint in (one, two) if joint >= 0}
    if kind == mujoco.mjtEq.mjEQ_TENDON:
        return set().union(*(_joints_of_tendon(model, tendon) for tendon in (one, two) if tendon >= 0))
    if kind in (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)):
        if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
            one, two = int(model.site_bodyid[one]), int(model.site_bodyid[two])
        return _joints_above(model, one) ^ _joints_above(model, two)
    return set()


def _joints_above(model: mujoco.MjModel, body: int) -> set[int]:
    """Hinges and slides that move a body."""
    out: set[int] = set()
    while body > 0:
        first, number = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        turning = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        out |= {joint for joint in range(first, first + number) if int(model.jnt_type[joint]) in turning}
        body = int(model.body_parentid[body])
    return out


def _joints_of_tendon(model: mujoco.MjModel, tendon: int) -> set[int]:
    """The joints of a fixed tendon."""
    wraps = range(int(model.tendon_adr[tendon]), int(model.tendon_adr[tendon] + model.tendon_num[tendon]))
    return {int(model.wrap_objid[w]) for w in wraps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT}


def _acts(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether a tendon does more than to be measured."""
    driven = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON) & (model.actuator_trnid[:, 0] == tendon)
    numbers = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_armature)
    return bool(driven.any() or model.tendon_limited[tendon] or any(np.any(each[tendon] != 0) for each in numbers))


def _name(model: mujoco.MjModel, joint: int) -> str:
    return str(model.joint(joint).name or f"joint {joint}")


def _saturated(case: Case) -> Found:
    for j, joint in enumerate(case.joints):
        if _degree_steps(case, j) or _furthest(case.pos[:, j]) > MOST_RAD:
            continue  # in another unit, as it seems, and said so: stiffness times degrees is no torque
        share = _share_saturated(case, j)
        if share > SATURATED:
            yield (
                f"{joint} works at its torque limit in {percent(share)} of the samples",
                "record smaller or slower motions: a saturated servo shows its limit and nothing else",
            )


def _share_saturated(case: Case, j: int) -> float:
    """The share of samples with torque in which the servo gives all it may: by its duty, else by stiffness times error."""
    assert case.plant is not None
    joint, plant = case.joints[j], case.plant
    duty = np.abs(case.run.column(f"pwm.{joint}"))
    if np.isfinite(duty).any():
        counts = case.run.facts.registers.get(joint, {}).get("pwm_limit")
        limit = counts / PWM_FULL if counts else 1.0
        full = duty > 0.98 * limit
        known = np.isfinite(duty) & case.on[:, j]
    else:
        torque = read_stiffness(plant.model, plant, j) * np.abs(case.cmd[:, j] - case.pos[:, j])
        full = torque > torque_limit(plant.model, plant, j)
        known = np.isfinite(torque) & case.on[:, j]
    return float(full[known].mean()) if known.any() else 0.0


def _unstable(case: Case) -> Found:
    """Models that fall apart: MuJoCo meets numbers that are none and begins anew, or joints fly off. And those that would, were
    their force not limited: they tremble."""
    assert case.plant is not None
    begin = case.run.between(float(case.run.t[0]), float(case.run.t[0]) + TRIED_S)
    try:
        played = Rollouts(case.plant, [begin])
        apart = _falls_apart(case, played)
        restless = [] if apart else _restless(case)
    except BadInput:
        return  # no motion that could be simulated: others say so
    step = f"steps of {number(case.plant.timestep, 's')}"
    if apart:
        what = f"simulated with this run's commands in {step} it falls apart"
        calm = next(
            (n for n in FINER if played.finer(n) is not played and not _falls_apart(case, played.finer(n))), None
        )
    elif restless:
        what = f"its servos tremble without end in {step} where nothing is commanded to move, held only by their limit of force"
        calm = next((n for n in FINER if not any(_grows(case, pose, n) for pose in restless)), None)
    else:
        return
    helps = (
        f'timestep="{literal(case.plant.timestep / calm, 3)}" keeps it together' if calm else "shorten its `timestep`"
    )
    yield (
        f"the model is unstable: {what}",
        f'{helps}; or take integrator="implicitfast", or check stiffness, armature and damping',
    )


def _restless(case: Case) -> list[Array]:
    """Poses of a run, (joints,) rad each, that the model cannot hold in its time step and could in a fine one; none where it comes
    to rest all the same, by dry friction."""
    there = np.flatnonzero(np.isfinite(case.pos).all(axis=1))
    rows = np.unique(there[np.linspace(0, len(there) - 1, POSES).astype(int)]) if len(there) else there
    found = [int(row) for row in rows if _grows(case, case.pos[row], 1) and not _grows(case, case.pos[row], FINEST)]
    return [case.pos[row] for row in found] if found and _never_rests(case, found, case.pos[rows]) else []


def _grows(case: Case, pose: Array, parts: int) -> bool:
    """Whether what moves away from a pose is e times as large by the end of the run."""
    assert case.plant is not None
    return growth(case.plant, pose, parts) * case.run.duration_s > 1.0


def _never_rests(case: Case, rows: Sequence[int], poses: Array) -> bool:
    """Whether joints still go to and fro long after a step to the command of one of these rows, from the farthest of `poses`."""
    assert case.plant is not None
    step = case.plant.timestep
    t: Array = step * np.arange(round(HELD_S / step), dtype=np.float64)
    begun = (t < 2.5 * step)[:, None]
    held = []
    for row in rows:
        goal = np.where(np.isfinite(case.cmd[row]), case.cmd[row], case.pos[row])
        start = poses[np.argmax(np.abs(poses - goal).sum(axis=1))]
        signals = (
            ("pos", np.where(begun, start, np.nan)),
            ("cmd", np.broadcast_to(goal, (len(t), len(case.joints)))),
        )
        columns = {f"{name}.{joint}": v[:, j] for name, v in signals for j, joint in enumerate(case.joints)}
        held.append(replace(case.run, t=t, columns=columns))
    done = Rollouts(case.plant, held)()
    for part in done.rows:
        end = done.pos[0, part][-len(t) // 4 :]
        went, span = np.abs(np.diff(end, axis=0)).sum(axis=0), np.ptp(end, axis=0)
        if ((span > NUDGE) & (went > 2 * span)).any():
            return True
    return False


def _falls_apart(case: Case, played: Rollouts) -> bool:
    pos = played().pos[0]
    there = pos[np.isfinite(pos).any(axis=1)]
    most = MOST_RAD + max(_furthest(case.pos), _furthest(case.cmd))
    return played.unstable or not np.isfinite(there).all() or _furthest(there) > most


# --- numbers -------------------------------------------------------------------------------------------------------------


def _furthest(values: Array) -> float:
    return float(np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values)))


def _range(case: Case, j: int) -> tuple[float, float]:
    """The range of a joint in the model, rad; infinite where there is none."""
    if case.plant is None:
        return -math.inf, math.inf
    joint = int(case.plant.model.dof_jntid[case.plant.dof[j]])
    if not case.plant.model.jnt_limited[joint]:
        return -math.inf, math.inf
    low, high = case.plant.model.jnt_range[joint]
    return float(low), float(high)


def _correlation(a: Array, b: Array) -> float:
    ok = np.isfinite(a) & np.isfinite(b)
    if ok.sum() < 3 or np.std(a[ok]) == 0 or np.std(b[ok]) == 0:
        return 0.0
    return float(np.corrcoef(a[ok], b[ok])[0, 1])


def _followed(case: Case, k: int, j: int) -> float:
    """How well position j follows command k, with the delay that suits it best."""
    return max(_by_delay(case, k, j))


def _by_delay(case: Case, k: int, j: int) -> list[float]:
    """How well position j follows command k, for each delay in rows."""
    rows = slice(0, LOOKED_AT)
    cmd = case.cmd[rows, k]
    pos = np.where(case.on[rows, j], case.pos[rows, j], np.nan)
    latest = min(LATEST_ROWS, len(pos) // 4)
    return [_correlation(cmd[: len(cmd) - late], pos[late:]) for late in range(latest + 1)]


def _wraps(t: Array, values: Array) -> NDArray[np.int64]:
    """Rows after which an angle goes on a turn away, both ends within one turn; a jump and back at once is none."""
    known = np.flatnonzero(np.isfinite(values))
    x = values[known]
    if len(x) < 3 or np.ptp(x) > 2 * math.pi + 0.1:
        return known[:0]
    jump = np.diff(x)
    found = (np.abs(jump) > WRAP_RAD) & (np.diff(t[known]) < WRAP_ROW_S)
    alone = found.copy()
    alone[1:] &= ~found[:-1]
    alone[:-1] &= ~found[1:]
    rows: NDArray[np.int64] = known[np.flatnonzero(alone)]
    return rows


def _is_wrapped(case: Case, j: int) -> bool:
    """Whether jumps of a command are wraps: the joint did not follow them."""
    jumps = _wraps(case.run.t, case.cmd[:, j])
    if not len(jumps):
        return False
    pos = _unwrap(case.run.t, case.pos[:, j])
    went = [span(pos[(case.run.t >= case.run.t[row]) & (case.run.t <= case.run.t[row] + 1.0)]) for row in jumps]
    return float(np.median(went)) < math.pi


def _unwrap(t: Array, values: Array) -> Array:
    jumps = _wraps(t, values)
    if not len(jumps):
        return values
    known = np.flatnonzero(np.isfinite(values))
    turns = np.zeros(len(known))
    at = np.searchsorted(known, jumps) + 1
    turns[at] = -np.sign(values[known[at]] - values[known[at - 1]])
    out = values.copy()
    out[known] += 2 * math.pi * np.cumsum(turns)
    return out


def _unwrapped(case: Case, j: int) -> tuple[Array, Array]:
    """Position and command of a joint as they go on beyond a turn."""
    pos, cmd = case.pos[:, j], case.cmd[:, j]
    return _unwrap(case.run.t, pos), _unwrap(case.run.t, cmd) if _is_wrapped(case, j) else cmd


def _turns(pos: Array, cmd: Array, on: NDArray[np.bool_]) -> int:
    """Whole turns by which a joint is away from its command all along."""
    away = (pos - cmd)[on & np.isfinite(pos) & np.isfinite(cmd)]
    if not len(away):
        return 0
    turns = round(float(np.median(away)) / (2 * math.pi))
    near = np.abs(away - 2 * math.pi * turns) < math.pi
    off = abs(float(np.median(away)) - 2 * math.pi * turns)
    return turns if turns and off < NEAR_TURN_RAD and near.mean() > FOLLOWS else 0


RULES: tuple[Rule, ...] = (
    Rule("one row", Verdict.NOTE, _few_rows),
    Rule("unit of time", Verdict.REFUSE, _time_unit),
    Rule("too short a time", Verdict.REFUSE, _time_too_short),
    Rule("unit of command stamps", Verdict.REFUSE, _command_time),
    Rule("too short", Verdict.REFUSE_FIT, _too_short),
    Rule("nothing moves", Verdict.REFUSE_FIT, _nothing_moves),
    Rule("gear", Verdict.REFUSE, _geared, needs_model=True),
    Rule("second servo", Verdict.REFUSE, _second_servo, needs_model=True),
    Rule("no servo", Verdict.NOTE, _without_servo, needs_model=True),
    Rule("limits in registers", Verdict.REFUSE_FIT, _by_registers),
    Rule("joint that does not move", Verdict.REFUSE_FIT, _does_not_move),
    Rule("wrapped angle", Verdict.NOTE, _wrapped, of_turns=True),
    Rule("whole turn", Verdict.NOTE, _whole_turn, of_turns=True),
    Rule("different units", Verdict.REFUSE_FIT, _other_units),
    Rule("degrees", Verdict.NOTE, _degrees),
    Rule("exchanged columns", Verdict.REFUSE, _exchanged),
    Rule("before its command", Verdict.REFUSE, _before_command),
    Rule("against its command", Verdict.REFUSE_FIT, _against_command),
    Rule("beyond range", Verdict.NOTE, _beyond_range, needs_model=True),
    Rule("beyond ctrlrange", Verdict.NOTE, _beyond_ctrlrange, needs_model=True),
    Rule("coupled joint", Verdict.NOTE, _coupled, needs_model=True),
    Rule("unstable model", Verdict.REFUSE, _unstable, needs_model=True),
    Rule("saturated", Verdict.REFUSE_FIT, _saturated, needs_model=True),
)
