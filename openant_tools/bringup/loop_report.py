"""The report of a loop: reward before and after, in simulation and on the robot, beside the control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from openant_tools.bringup.loop import Loop, Played, Result
from openant_tools.gap.diagnosis import NONE, UNEXPLAINED
from openant_tools.gap.words import sentence, what_next
from openant_tools.numbers import number
from openant_tools.procedure.intervals import Interval
from openant_tools.report import Figure, KeyFigure, Report, ReportSummary, plots
from openant_tools.report.parts import Files, Tone

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["draw_rewards", "loop_report", "speed", "verdict", "what_was_found"]

#: rows of the figure: label → the plays in simulation and on the robot
BEFORE = "trained"
AFTER = "trained on in the\nimproved simulation"
CONTROL = "control: trained on\nin the given simulation"
#: in the table
PLACES = {
    "sim_before": (BEFORE, "the given simulation"),
    "robot_before": (BEFORE, "the robot"),
    "sim_after": ("trained on, improved", "the improved simulation"),
    "robot_after": ("trained on, improved", "the robot"),
    "control_sim_after": ("control", "the given simulation"),
    "control_after": ("control", "the robot"),
}


def loop_report(loop: Loop, result: Result, made_by: str = "openant loop") -> Report:
    """One page: the figure, what the improvement is worth against the control, and the commands that made it.

    Args:
        made_by: the command as it was typed.
    """
    means = [what_was_found(result), *_doubts(result)]
    answer = ReportSummary(
        verdict(result),
        Figure(
            _rewards_figure(result),
            "Average reward per second, sampled as in training: small marks are starts, large ones their mean with its 95 % "
            "interval. The grey line from simulation to robot is what the simulation promises too much, or too little.",
        ),
        "\n\n".join(means),
        _then(loop, result),
        _tone(result),
        _figures(result),
    )  # fmt: skip
    report = Report(
        "From simulation to robot and back",
        f"{loop.robot.name}, {'the robot itself' if loop.virtual is None else 'a virtual robot'}: {number(loop.steps)} steps of "
        f"training and {number(loop.fine_tune_steps)} more, seed {loop.seed}.",
        answer,
        made_by=made_by,
        recordings=[loop.diagnosis, loop.result],
    )  # fmt: skip
    rows = [
        [*PLACES[name], speed(played.mean), len(played.rewards_m_s), played.helped, played.step]
        for name, played in result.plays.items()
        if result.improved or name not in ("sim_after", "robot_after")
    ]
    columns = ["agent", "played in", "average reward", "starts", "set up again", "step"]
    report.section("Every play").table(columns, rows)
    agents = {"before": "robot_before", "after": "robot_after", "control": "control_after"}
    spans = [
        [PLACES[agents[name]][0], speed(span)]
        for name, span in result.promised_m_s.items()
        if result.improved or name != "after"
    ]
    report.table(["agent", "reward in simulation less that on the robot"], spans)
    report.section("What the simulation lacked").text(sentence(result.diagnosis))
    report.add(Files("In full:", [loop.folder / "gap" / "report.html"], loop.folder))
    lines = [line for stage in loop.stages() for line in stage.command_lines]
    return report.section("The same by hand").code("\n".join(lines))


def verdict(result: Result) -> str:
    """What the improvement is worth on the robot, in a sentence."""
    after, control = result.robot_after.mean, result.control_after.mean
    gain = result.gain_m_s
    if gain is None:
        return (
            f"There was nothing to improve the simulation by; trained on in it as it is, the agent goes from "
            f"{speed(result.robot_before.mean)} to {speed(control)} on the robot."
        )
    known = gain.low == gain.low  # NaN of a single start
    how = "more than" if gain.low > 0 else "less than" if gain.high < 0 else "not surely other than"
    if not known:
        how = "of a single start"
    words = f"On the robot the agent makes {speed(after)} after the improved simulation, {speed(control)} after the given one"
    return f"{words}: {speed(gain, sign=True)}, {how}{' the control' if known else ''}."


def what_was_found(result: Result) -> str:
    """What the diagnosis named, and what was made of it."""
    found = result.diagnosis
    if result.improved:
        return f"{sentence(found)} The improved simulation is the given one with {' and '.join(found.selected)}."
    if found.verdict == NONE:
        why = "What the robot does beyond this simulation is as small as between two robots of one build."
    elif found.verdict == UNEXPLAINED:
        why = "The robot does not move as its simulation does, but no effect that is known here explains it."
    else:
        why = "Effects that explain it equally well cannot be told apart."
    return f"{sentence(found)} {why} So no simulation was improved: the control stands for both."


def speed(interval: Interval, *, sign: bool = False) -> str:
    """m/s as cm/s, with the interval."""
    return number(100 * interval.value, "cm/s", 100 * interval.low, 100 * interval.high, sign=sign)


def draw_rewards(axes: Any, rows: Mapping[str, tuple[Played, Played]]) -> None:
    """A row an agent: what it earns in simulation and on the robot, start by start and in the mean with its interval, cm/s.

    Args:
        rows: words → the plays in simulation and on the robot.
    """
    with plots.style():
        axes.axvline(0.0, color=plots.INK, linewidth=0.6)
        for y, places in enumerate(rows.values()):
            axes.plot(
                [100 * one.mean.value for one in places], [y, y], color=plots.INK, alpha=0.3, linewidth=4, zorder=1
            )
            for place, label, colour, marker, side in zip(
                places, ("in simulation", "on the robot"), (plots.BLUE, plots.VERMILLION), "os", (-0.12, 0.12), strict=True
            ):  # fmt: skip
                mean = place.mean
                starts = [100 * reward for reward in place.rewards_m_s]
                axes.plot(starts, [y + side] * len(starts), marker, color=colour, alpha=0.35, markersize=3)
                axes.errorbar(
                    [100 * mean.value], [y + side],
                    xerr=[[100 * max(mean.value - mean.low, 0.0)], [100 * max(mean.high - mean.value, 0.0)]],
                    color=colour, marker=marker, markersize=7, linestyle="", capsize=3, label=label if y == 0 else None,
                )  # fmt: skip
        axes.set_yticks(range(len(rows)), list(rows))
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlabel(plots.axis_label("average reward", "cm/s"))
    plots.legend(axes)


def _rewards_figure(result: Result) -> MatplotlibFigure:
    rows = {BEFORE: (result.sim_before, result.robot_before)}
    if result.improved:
        rows[AFTER] = (result.sim_after, result.robot_after)
    rows[CONTROL] = (result.control_sim_after, result.control_after)
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=0.9 + 0.7 * len(rows))
    draw_rewards(axes, rows)
    return figure


def _tone(result: Result) -> Tone:
    gain = result.gain_m_s
    if gain is None:
        return ""
    return "good" if gain.low > 0 else "bad" if gain.high < 0 else "warn"


def _figures(result: Result) -> list[KeyFigure]:
    before, control = result.robot_before.mean, result.control_after.mean
    promised = result.promised_m_s
    keys = [KeyFigure("on the robot, before", speed(before))]
    if result.improved:
        keys.append(KeyFigure("on the robot, after", speed(result.robot_after.mean), f"control {speed(control)}"))
    else:
        keys.append(KeyFigure("on the robot, control", speed(control)))
    keys.append(KeyFigure("simulation promises more by, before", speed(promised["before"], sign=True)))
    if result.improved:
        note = f"control {speed(promised['control'], sign=True)}"
        keys.append(KeyFigure("simulation promises more by, after", speed(promised["after"], sign=True), note))
    return keys


def _doubts(result: Result) -> list[str]:
    """What keeps these figures from saying as much as they seem to."""
    doubts = []
    idle = [name for name, updates in result.updates.items() if not updates]
    if idle:
        doubts.append(
            f"No update was made in {' and '.join(idle)}: training was over before learning began. Train longer, or let "
            "learning begin sooner (`learning_start` in `--settings`)."
        )
    if len(result.robot_before.rewards_m_s) < 2:
        doubts.append("A single start has no interval: give `--starts`.")
    return doubts


def _then(loop: Loop, result: Result) -> str:
    found, gain = result.diagnosis, result.gain_m_s
    open_ = f"To settle what the diagnosis leaves open, {found.next_experiment}." if found.next_experiment else ""
    if gain is None:
        return open_ or what_next(found)
    if gain.low > 0:
        apply = f"openant gap apply {loop.diagnosis} --robot {loop.robot} --out {loop.robot}/improved.xml"
        return f"Make it the robot's own simulation: `{apply}`."
    return f"Play more starts, or train on for longer, before you decide between them. {open_}".strip()
