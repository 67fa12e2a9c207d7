"""Where each millisecond of an agent's step goes: command, wait, read, observe, decide.

A step runs from the moment that a new command has left to the moment that the next one has. In it the robot is left
alone (wait), the servos are read (read), the answer becomes an observation (observe), the agent makes up its mind
(decide), and the next command goes out (command). The environment keeps the step's length fixed by the wait, so that
whatever the agent computes is taken from the time between its action and what it sees of it (the paper's appendix on
step timing).

A recording of the bus holds when commands left (`cmd_t`), when reads began (`t`) and how long they took (`rtt.J`). Where
it has the optional columns `obs_t` (the observation was made) and `act_t` (the action was chosen; s, the same clock),
observing and deciding are told apart; else they are one part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from openant_tools.errors import BadInput
from openant_tools.numbers import number, percent
from openant_tools.recording.run import Run
from openant_tools.report import Figure, Report, ReportSummary, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["StepPart", "StepTiming", "step_timing", "timing_figure", "timing_report"]

Array = NDArray[np.float64]

#: bytes of a sync write of n goals: header and rest, and each servo's id and four bytes
WRITE_BYTES, WRITE_BYTES_A_SERVO = 14, 5
#: steps below which no quantile means anything
FEWEST_STEPS = 5
#: s; pauses longer than this many median steps belong to no step
PAUSE = 10.0
#: of the step, beyond which computing or jitter is worth a warning
COMPUTING_SHARE, JITTER_SHARE = 0.25, 0.1
_COLOURS = {
    "command": plots.VERMILLION, "wait": plots.SKY, "read": plots.BLUE, "observe": plots.GREEN, "decide": plots.ORANGE,
    "observe and decide": plots.ORANGE,
}  # fmt: skip


@dataclass(frozen=True)
class StepPart:
    """One part of a step over all steps, in s.

    Attributes:
        jitter: standard deviation. p99: 99 of 100 are shorter.
        share: of the mean step.
    """

    name: str
    mean: float
    jitter: float
    median: float
    p99: float
    longest: float
    share: float

    @classmethod
    def of(cls, name: str, values: Array, step: float) -> StepPart:
        return cls(
            name, float(values.mean()), float(values.std()), float(np.median(values)),
            float(np.quantile(values, 0.99)), float(values.max()), float(values.mean() / step),
        )  # fmt: skip


@dataclass(frozen=True)
class StepTiming:
    """The steps of one run.

    Attributes:
        parts: in the order of the step, which they fill. step: the whole.
        action_to_observation: from the command's last byte to the last answer of the read that shows what came of it.
        computing_share: of the step that observing and deciding take away from that.
        values: part → (steps,) s. start: (steps,) s.
        told_apart: whether observing and deciding were recorded apart.
    """

    name: str
    steps: int
    parts: tuple[StepPart, ...]
    step: StepPart
    action_to_observation: StepPart
    computing_share: float
    told_apart: bool
    start: Array
    values: dict[str, Array]

    def as_json(self) -> dict[str, Any]:
        return {
            "run": self.name,
            "steps": self.steps,
            "step": vars(self.step),
            "parts": [vars(part) for part in self.parts],
            "action_to_observation": vars(self.action_to_observation),
            "computing_share": self.computing_share,
            "observe_and_decide_told_apart": self.told_apart,
        }

    def table(self) -> list[list[str]]:
        """Rows of words: part, mean, jitter, median, 99 of 100, longest, share."""
        return [
            [one.name, *(number(1e3 * value, decimals=2) for value in (one.mean, one.jitter, one.median, one.p99, one.longest)),
             percent(one.share, decimals=1)]
            for one in (*self.parts, self.step, self.action_to_observation)
        ]  # fmt: skip


COLUMNS = ["part", "mean (ms)", "jitter (ms)", "median (ms)", "99 % (ms)", "longest (ms)", "of the step"]


def step_timing(run: Run) -> StepTiming:
    """Take the steps of a recording apart.

    Raises:
        BadInput: there is no command, or fewer than a handful of different ones.
    """
    where = str(run.path or run.name)
    cmd = run.signal("cmd")
    if not np.isfinite(cmd).any():
        raise BadInput("there is no command in it", where=where, remedy="needed are cmd.J and, for true times, cmd_t")
    if "thinned_s" in run.facts.extra:
        raise BadInput("a soak that keeps few of its cycles", where=where, remedy="record it with --every-cycle")
    first = _new_commands(run, cmd)
    if len(first) < FEWEST_STEPS + 1:
        raise BadInput(
            f"only {len(first)} different commands", where=where, remedy="name the recording of an agent at work"
        )
    rtt = run.signal("rtt")
    with np.errstate(invalid="ignore"):
        took = np.where(np.isfinite(rtt).any(axis=1), np.nanmax(np.where(np.isfinite(rtt), rtt, 0.0), axis=1), 0.0)
    # Without `cmd_t` a command counts from its row, as everywhere (formats, section 1).
    left = run.command_times[first]
    acted, observed = run.column("act_t"), run.column("obs_t")
    apart = bool(np.isfinite(acted[first]).mean() > 0.9 and np.isfinite(observed[first]).mean() > 0.9)
    baud = run.facts.extra.get("baud")
    rate = float(baud) if isinstance(baud, int | float) and not isinstance(baud, bool) and baud > 0 else 1e6
    write = (WRITE_BYTES + WRITE_BYTES_A_SERVO * len(run.joints)) * 10 / rate
    values: dict[str, list[float]] = {name: [] for name in ("command", "wait", "read", "observe", "decide")}
    starts, longest = [], PAUSE * float(np.median(np.diff(left)))
    for k in range(len(first) - 1):
        begin, end = float(left[k]), float(left[k + 1])
        # The read that counts is the last one; of a loop that reads on while the agent thinks, the last that it saw.
        seen_at = min(end, float(observed[first[k + 1]])) if apart else end
        row = int(np.searchsorted(run.t, seen_at, side="right")) - 1
        row -= bool(apart and row > 0 and run.t[row] + took[row] > seen_at)
        if not 0 < end - begin < longest or row < 0 or run.t[row] <= begin:
            continue
        read_at = float(run.t[row])
        read_end = min(read_at + float(took[row]), end)
        out = min(write, end - read_end)
        if apart:
            out = min(max(end - float(acted[first[k + 1]]), 0.0), end - read_end)
        thinking = end - read_end - out
        seen = min(max(float(observed[first[k + 1]]) - read_end, 0.0), thinking) if apart else 0.0
        starts.append(begin)
        for name, value in (
            ("wait", read_at - begin), ("read", read_end - read_at), ("observe", seen), ("decide", thinking - seen),
            ("command", out),
        ):  # fmt: skip
            values[name].append(value)
    if len(starts) < FEWEST_STEPS:
        raise BadInput("no step with a read in it", where=where, remedy="the log needs a row between two commands")
    arrays = {name: np.array(found) for name, found in values.items()}
    whole = np.sum(list(arrays.values()), axis=0)
    computing = arrays["observe"] + arrays["decide"]
    if not apart:
        arrays = {
            "command": arrays["command"], "wait": arrays["wait"], "read": arrays["read"], "observe and decide": computing,
        }  # fmt: skip
    mean = float(whole.mean())
    return StepTiming(
        name=run.name,
        steps=len(starts),
        parts=tuple(StepPart.of(name, found, mean) for name, found in arrays.items()),
        step=StepPart.of("step", whole, mean),
        action_to_observation=StepPart.of("action to observation", values_of(values, ("wait", "read")), mean),
        computing_share=float(computing.mean() / mean),
        told_apart=apart,
        start=np.array(starts),
        values=arrays,
    )


def values_of(values: dict[str, list[float]], names: Sequence[str]) -> Array:
    """(steps,) the sum of some parts."""
    total: Array = np.sum([np.array(values[name]) for name in names], axis=0)
    return total


def _new_commands(run: Run, cmd: Array) -> NDArray[np.int64]:
    """Rows in which an agent's next command is in force first.

    A loop faster than the agent repeats its command, with or without the time of each writing: only another command is
    another step. Where every row has a command of its own, each is a step.
    """
    acted = run.column("act_t")
    if np.isfinite(acted).any():
        held = acted
        return np.flatnonzero(np.isfinite(held) & np.r_[True, np.diff(held) != 0])
    same = np.nan_to_num(cmd, nan=-1e9)
    changed = np.r_[True, (np.diff(same, axis=0) != 0).any(axis=1)]
    known = np.isfinite(cmd).any(axis=1)
    return np.flatnonzero(changed & known)


def timing_figure(found: StepTiming) -> MatplotlibFigure:
    """The mean step as one bar, and how each part scatters."""
    figure: MatplotlibFigure
    figure, axes = plots.figure(2, height=2.2, gridspec_kw={"height_ratios": [1, 2]})
    order = ["wait", "read", "observe", "decide", "observe and decide", "command"]
    parts = sorted(found.parts, key=lambda part: order.index(part.name))
    at = 0.0
    for part in parts:
        axes[0].barh(0, 1e3 * part.mean, left=1e3 * at, color=_COLOURS[part.name], label=part.name, height=0.6)
        if part.share > 0.06:
            axes[0].text(
                1e3 * (at + part.mean / 2), 0, number(1e3 * part.mean, decimals=1), ha="center", va="center", fontsize=8
            )
        at += part.mean
    axes[0].set_yticks([])
    axes[0].set_ylim(-0.5, 0.5)
    axes[0].set_xlabel(plots.axis_label("time in the mean step, from command to command", "ms"))
    plots.legend(axes[0])
    for part in parts:
        ordered = np.sort(found.values[part.name]) * 1e3
        axes[1].plot(ordered, (np.arange(len(ordered)) + 1) / len(ordered), color=_COLOURS[part.name])
    axes[1].set_xlabel(plots.axis_label("length of the part", "ms"))
    axes[1].set_ylabel(plots.axis_label("share of steps at most so long", ""))
    return figure


def timing_report(found: StepTiming) -> Report:
    """Picture, table, and what they say."""
    late, jitter = found.computing_share > COMPUTING_SHARE, found.step.jitter > JITTER_SHARE * found.step.mean
    means = "What the agent sees is as old as it looks" + (
        ", but its own computing takes much of the step." if late else "."
    )
    means = means if not jitter else "Steps differ in length: what was learned with even steps meets uneven ones."
    then = "Nothing: the steps are even, and the robot is seen in time."
    if jitter:
        then = "Find who holds the loop up: `openant comms diagnose` on the same recording."
    elif late:
        then = (
            "Let the agent decide faster (a smaller network, fewer threads), or train with this delay (`action_delay`)."
        )
    answer = ReportSummary(
        sentence(found),
        Figure(timing_figure(found), "The mean step, and the spread of its parts."),
        means, then, "warn" if late or jitter else "good",
    )  # fmt: skip
    report = Report("Step timing", found.name, answer, made_by="openant comms timing")
    return report.section("Every part").table(COLUMNS, found.table())


def sentence(found: StepTiming) -> str:
    """What matters, in words."""
    shown = found.action_to_observation
    return (
        f"{found.steps} steps of {_ms(found.step.mean, 1)} (jitter {_ms(found.step.jitter, 2)}). "
        f"What an action does is seen {_ms(shown.mean, 1)} after it left (jitter {_ms(shown.jitter, 2)}); "
        f"the agent's own computing takes {percent(found.computing_share, decimals=1)} of the step from that."
    )


def _ms(value_s: float, places: int) -> str:
    return f"{number(1e3 * value_s, decimals=places)} ms"
