"""Pictures and reports of heat: temperatures with the model, the fan of the forecast, the limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from openant_tools.numbers import number, percent
from openant_tools.procedure.intervals import Interval
from openant_tools.report import Figure, KeyFigure, Mark, Report, ReportSummary, plots
from openant_tools.report.parts import Tone
from openant_tools.thermal.compare import ROOM_C, AgainstPaper, JointDifference
from openant_tools.thermal.finding import BELIEVED_K
from openant_tools.thermal.fit import PARAMETER_WORDS, Fit, HeldOut
from openant_tools.thermal.forecast import HORIZON_S, HeatForecast
from openant_tools.thermal.inputs import Inputs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = [
    "compare_report", "fit_report", "forecast_picture", "forecast_report", "paper_report", "temperature_picture",
]  # fmt: skip

#: min that a picture looks ahead, at most
SHOWN_MIN = 120.0


def temperature_picture(found: Fit, run: Inputs) -> MatplotlibFigure:
    """One panel a joint: what was read, the model with its 95 % band, the servo's limit.

    Args:
        run: what to show, which may go on after what was fitted.
    """
    rows = (len(run.joints) + 1) // 2
    case = found.replayed(run, 200) - 0.5
    band = found.disturbance_k
    low, high = np.quantile(case, [0.025, 0.975], axis=0)
    minutes = run.edges[1:] / 60
    figure: MatplotlibFigure
    figure, axes = plots.figure(rows, min(2, len(run.joints)), height=1.45, sharex=True, sharey=True, squeeze=False)
    top = float(np.nanmax(run.readings))
    with plots.style():
        for k, joint in enumerate(run.joints):
            panel = axes[k // 2, k % 2]
            panel.plot(minutes, run.readings[:, k], ".", color=plots.INK, markersize=2.5, label="read")
            panel.plot(minutes, case[0, :, k], color=plots.BLUE, label="model")
            panel.fill_between(
                minutes, low[:, k] - 2 * band, high[:, k] + 2 * band, color=plots.SKY, alpha=0.3, linewidth=0
            )
            if top > run.limit_c[k] - 20:
                panel.axhline(run.limit_c[k], color=plots.VERMILLION, linewidth=0.9, label="limit")
            panel.set_title(joint)
        for panel in axes[-1]:
            panel.set_xlabel(plots.axis_label("time", "min"))
        for panel in axes[:, 0]:
            panel.set_ylabel(plots.axis_label("case", "°C"))
        plots.legend(axes[0, -1])
    return figure


def forecast_picture(
    found: Fit, told: HeatForecast, *, run: Inputs | None = None, joints: Sequence[str] = ()
) -> MatplotlibFigure:
    """What was read until now, the fan of what comes, and the limit; what came after all, where `run` has it."""
    names = list(joints) or _interesting(told)
    places = [found.inputs.joints.index(joint) for joint in names]
    now = found.inputs.duration_s / 60
    figure: MatplotlibFigure
    figure, axes = plots.figure(len(names), 1, height=2.3, sharex=True, squeeze=False)
    later = _shown_min(told, run, now)
    with plots.style():
        for row, (joint, k) in enumerate(zip(names, places, strict=True)):
            panel = axes[row, 0]
            minutes = now + told.t / 60
            shown = minutes <= now + later
            inputs = found.inputs if run is None else run
            panel.plot(inputs.edges[1:] / 60, inputs.readings[:, k], ".", color=plots.INK, markersize=2.5, label="read")
            _fan(panel, told, k, shown, now)
            limit = found.inputs.limit_c[k]
            panel.axhline(limit, color=plots.VERMILLION, linewidth=0.9, label="limit")
            panel.axvline(now, color=plots.INK, linewidth=0.8, linestyle=":")
            panel.set_ylim(top=limit + 12)
            panel.set_ylabel(plots.axis_label("case", "°C"))
            panel.set_title(next(one.words for one in told.joints if one.joint == joint))
        axes[-1, 0].set_xlabel(plots.axis_label("time", "min"))
        plots.legend(axes[0, 0])
    return figure


def _fan(panel: Axes, told: HeatForecast, k: int, shown: NDArray[np.bool_], begin: float) -> None:
    """What comes of a joint, of times that are `shown`, from `begin` (min) on."""
    minutes = begin + told.t[shown] / 60
    for (low, high), alpha in (((0.025, 0.975), 0.22), ((0.25, 0.75), 0.35)):
        panel.fill_between(
            minutes, told.fan[low][shown, k], told.fan[high][shown, k], color=plots.BLUE, alpha=alpha, linewidth=0,
            label="95 %" if alpha < 0.3 else "50 %",
        )  # fmt: skip
    panel.plot(minutes, told.fan[0.5][shown, k], color=plots.BLUE, label="median")


def _interesting(told: HeatForecast) -> list[str]:
    """At most four joints, those nearest to their limit."""
    order = sorted(told.joints, key=lambda one: (-one.probability, one.limit_c - one.settles_c.value))
    return [one.joint for one in order[:4]]


def _shown_min(told: HeatForecast, run: Inputs | None, now: float) -> float:
    ends = [one.seconds_to_limit.high for one in told.joints if one.seconds_to_limit is not None]
    wanted = 1.3 * min(max(ends, default=3600.0), HORIZON_S) / 60
    past = 0.0 if run is None else run.duration_s / 60 - now
    return min(max(wanted, past, 20.0), SHOWN_MIN)


def fit_report(found: Fit, told: HeatForecast, runs: Sequence[Inputs], held: HeldOut | None) -> Report:
    """Whether a servo shuts down under this load, what was read beside the model, and how far to believe it.

    Args:
        told: what would come of the last run's load from cold.
    """
    figures, means = (
        [_first_figure(told)],
        "The run is too short to hold a part of it back, so nothing has judged this model.",
    )
    believed = held is not None and held.rms_k < BELIEVED_K
    if held is not None:
        figures += [
            KeyFigure(
                "later part missed by", number(held.rms_k, "K", decimals=2),
                f"rms from {number(held.from_s / 60, decimals=0)} min on", "good" if believed else "bad",
            ),
            KeyFigure("worst", number(held.worst_k, "K", decimals=1), held.worst),
        ]  # fmt: skip
        means = (
            "Fitted to the first part of the run, the model foretells the later one: its forecasts can be planned with."
            if believed
            else f"Fitted to the first part of the run, the model misses the later one by more than {number(BELIEVED_K, 'K')}: do "
            "not plan with it."
        )
    answer = ReportSummary(
        _shutdown(told),
        Figure(
            temperature_picture(found, runs[-1]),
            "Dots: means of what the servo reads, whole °C. Line and band: the two-node model and where it believes the case to be "
            "(95 %, the slow disturbance included).",
        ),
        means,
        "Ask what another load or a rest would do: `openant thermal forecast`."
        if believed
        else "Record a longer soak (`openant thermal soak`), in a room without draughts.",
        _shutdown_tone(told),
        figures,
    )
    report = Report("Heat", ", ".join(run.name for run in runs), answer)
    report.section("Parameters").table(
        ["joint", "parameter", "value (95 % interval)", "by the run"],
        [
            [one.joint or "all", PARAMETER_WORDS.get(one.name, one.name), number(one.value, one.unit, one.low, one.high),
             Mark(percent(one.informed), "good" if one.informed > 0.5 else "")]
            for one in found.estimates
        ],
        "By the run: how much of what was uncertain before it has taken away; with little, the value is what was believed of "
        "such servos anyhow.",
    )  # fmt: skip
    report.text(
        f"What no two-node model explains was about {number(found.disturbance_k, 'K')}, with a memory of "
        f"{number(found.disturbance_s / 60, decimals=0)} min; crossings were left by "
        f"{number(float(np.nanmax(found.residual_k)), 'K', decimals=2)} at most (rms a joint). Telemetry errors taken out: "
        f"{int(found.inputs.glitches.sum())}."
    )
    return report


def _shutdown(told: HeatForecast) -> str:
    """Will it shut down, and when?"""
    if told.first is not None:
        return f"Under this load {told.first.words}, and shuts down."
    nearest = min(told.joints, key=lambda one: one.limit_c - one.settles_c.value)
    settles = number(nearest.settles_c.value, "°C", nearest.settles_c.low, nearest.settles_c.high)
    return (
        f"No servo shuts down under this load: {nearest.joint}, the nearest to its limit of {number(nearest.limit_c, '°C')}, "
        f"settles at {settles}."
    )


def _shutdown_tone(told: HeatForecast) -> Tone:
    likely = max(one.probability for one in told.joints)
    return "bad" if likely > 0.5 else "warn" if likely > 0.05 else "good"


def _first_figure(told: HeatForecast) -> KeyFigure:
    first = told.first
    if first is None:
        return KeyFigure("shuts down", "never", "within 8 hours of this load", "good")
    return KeyFigure("shuts down after", _minutes(first.seconds_to_limit), first.joint, _shutdown_tone(told))


def forecast_report(found: Fit, told: HeatForecast, rest: str, run: Inputs | None = None) -> Report:
    """When each servo shuts down under this load, and what it could bear."""
    likely = max(told.joints, key=lambda one: one.probability)
    answer = ReportSummary(
        _shutdown(told),
        Figure(
            forecast_picture(found, told, run=run),
            "Dots: what was read; dotted line: now. The fan holds the uncertainty of parameters and room, and how the load varies.",
        ),
        "A servo that shuts down lets its leg fall until it is rebooted. Within 8 hours of this load "
        + (
            f"{likely.joint} does with a probability of {percent(likely.probability)}."
            if likely.probability
            else "none does."
        ),
        f"{rest[:1].upper()}{rest[1:]}.",
        _shutdown_tone(told),
        [_first_figure(told)],
    )
    report = Report("Thermal forecast", f"{found.inputs.name}, {told.load.words}", answer)
    report.section("Joints").table(
        ["joint", "now", "limit", "reaches it after", "settles at", "holds for ever", "holds an hour"],
        [
            [one.joint, number(one.temperature_c, "°C", decimals=0), number(one.limit_c, "°C"), _minutes(one.seconds_to_limit),
             _interval(one.settles_c, "°C"), _interval(one.continuous_torque_nm, "N·m"), _interval(one.hour_torque_nm, "N·m")]
            for one in told.joints
        ],
        "95 % intervals in brackets. Holds for ever: the torque at standstill that keeps the case just below the limit.",
    )  # fmt: skip
    return report


def _interval(interval: Interval | None, unit: str) -> str:
    return "–" if interval is None else number(interval.value, unit, interval.low, interval.high)


def _minutes(interval: Interval | None) -> str:
    """Until a shutdown; an end beyond the horizon is open."""
    if interval is None:
        return "–"
    if interval.high < HORIZON_S:
        return number(interval.value / 60, "min", interval.low / 60, interval.high / 60)
    least = number(interval.low / 60, "min", decimals=0)
    return (
        f"{least} or more"
        if interval.value >= HORIZON_S
        else f"{number(interval.value / 60, 'min', decimals=0)} (from {least}, open)"
    )


def compare_report(differences: Sequence[JointDifference], a: str, b: str) -> Report:
    """Where each servo settles in both, and the difference."""
    figure, axes = plots.figure(1, 1, height=0.6 + 0.35 * len(differences))
    with plots.style():
        rows = np.arange(len(differences))[::-1]
        for row, one in zip(rows, differences, strict=True):
            d = one.difference_k
            axes.plot([d.low, d.high], [row, row], color=plots.BLUE, linewidth=2)
            axes.plot(d.value, row, "o", color=plots.BLUE if one.certain else plots.INK)
        axes.axvline(0.0, color=plots.INK, linewidth=0.8)
        axes.set_yticks(rows, [one.joint for one in differences])
        axes.set_xlabel(plots.axis_label("B − A: where it settles", "K"))
        axes.set_ylabel("joint")
    certain = [one for one in differences if one.certain]
    words = "; ".join(
        f"{one.joint} settles {number(abs(one.difference_k.value), 'K', *sorted((abs(one.difference_k.low), abs(one.difference_k.high))))} "
        f"{'hotter' if one.difference_k.value > 0 else 'cooler'}"
        for one in certain
    )  # fmt: skip
    answer = ReportSummary(
        f"Under one torque in one room B differs from A: {words}."
        if certain
        else f"Whether B is cooler or hotter than A, these two soaks cannot tell, at none of {len(differences)} joints.",
        Figure(figure, f"Under one and the same torque in a room of {number(ROOM_C, '°C')}; bars are 95 % intervals."),
        "Rooms and loads are taken out; what is left is the servo, its heat sink, its friction, the air around it."
        if certain
        else "The intervals hold what either soak leaves open; a difference smaller than they are would not be seen.",
        "Where B is cooler, keep what was changed; where it is hotter, look at heat sink, screws and cable."
        if certain
        else "Soak both longer, or with more torque: `openant thermal soak`.",
        "" if certain else "warn",
    )
    report = Report("Two soaks", f"A: {a} · B: {b}", answer)
    report.section("Joints").table(
        ["joint", "torque", "A", "B", "B − A", "time constant, B − A"],
        [
            [one.joint, number(one.torque_nm, "N·m"), _interval(one.a_c, "°C"), _interval(one.b_c, "°C"),
             Mark(_interval(one.difference_k, "K"), "good" if one.certain else ""), _interval(one.time_constant_s, "s")]
            for one in differences
        ],
    )  # fmt: skip
    return report


def paper_report(beside: AgainstPaper, name: str) -> Report:
    """This robot's warmest knee from a cold start, beside the paper's of the same servo.

    Args:
        name: of the soak.
    """
    told, limit = beside.told, beside.paper.limit_c
    k, one = next((k, one) for k, one in enumerate(told.joints) if one.joint == beside.joint)
    figure, axes = plots.figure(1, 1, height=2.6)
    with plots.style():
        _fan(axes, told, k, told.t / 60 <= SHOWN_MIN, 0.0)
        axes.axhline(limit, color=plots.VERMILLION, linewidth=0.9, label="limit")
        if beside.paper.shutdown_s is not None:
            axes.plot(beside.paper.shutdown_s / 60, limit, "o", color=plots.INK, label="the paper's shuts down")
        axes.set_ylim(top=limit + 12)
        axes.set_xlabel(plots.axis_label("time", "min"))
        axes.set_ylabel(plots.axis_label("case", "°C"))
        axes.set_title(beside.joint)
        plots.legend(axes)
    answer = ReportSummary(
        beside.words,
        Figure(figure, "This robot under its own load from a cold start: median, and the fan of what the soak leaves open."),
        "Room and load may be others than the paper's, whose log is not open: a difference is of the robot and of what it bore.",
        "Ask what another load or a rest would do: `openant thermal forecast`.",
        _shutdown_tone(told),
        [
            KeyFigure("shuts down after", _minutes(one.seconds_to_limit), beside.joint),
            KeyFigure("later than the paper's", "–" if beside.later_s is None else _later(beside.later_s)),
            KeyFigure("settles beyond the limit by", _interval(beside.above_limit_k, "K")),
        ],
    )  # fmt: skip
    return Report("A soak beside the paper's", name, answer)


def _later(interval: Interval) -> str:
    return number(interval.value / 60, "min", interval.low / 60, interval.high / 60, sign=True)
