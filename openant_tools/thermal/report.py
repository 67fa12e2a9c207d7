"""Pictures and reports of heat: temperatures with the model, the fan of the forecast, the limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from openant_tools.report import KeyFigure, Mark, Report, plots
from openant_tools.report.parts import Tone
from openant_tools.thermal.compare import Difference
from openant_tools.thermal.finding import BELIEVED_K
from openant_tools.thermal.fit import Fit, HeldOut
from openant_tools.thermal.forecast import HORIZON_S, Forecast, Interval
from openant_tools.thermal.inputs import Inputs

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["compare_report", "fit_report", "forecast_picture", "forecast_report", "temperature_picture"]

#: min that a picture looks ahead, at most
SHOWN_MIN = 120.0


def temperature_picture(found: Fit, run: Inputs, *, split_s: float | None = None) -> MatplotlibFigure:
    """One panel a joint: what was read, the model with its 95 % band, the servo's limit.

    Args:
        run: what to show, which may go on after what was fitted.
        split_s: where the fitted part ends, drawn as a line.
    """
    rows = (len(run.joints) + 1) // 2
    case = found.replayed(run, 200) - 0.5
    band = found.disturbance_k
    low, high = np.quantile(case, [0.025, 0.975], axis=0)
    minutes = run.edges[1:] / 60
    figure: MatplotlibFigure
    figure, axes = plots.figure(rows, min(2, len(run.joints)), height=1.8, sharex=True, sharey=True, squeeze=False)
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
            if split_s is not None:
                panel.axvline(split_s / 60, color=plots.INK, linewidth=0.8, linestyle=":")
            panel.set_title(joint)
        for panel in axes[-1]:
            panel.set_xlabel(plots.axis_label("time", "min"))
        for panel in axes[:, 0]:
            panel.set_ylabel(plots.axis_label("case", "°C"))
        plots.legend(axes[0, -1])
    return figure


def forecast_picture(
    found: Fit, told: Forecast, *, run: Inputs | None = None, joints: Sequence[str] = ()
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
            for (low, high), alpha in (((0.025, 0.975), 0.22), ((0.25, 0.75), 0.35)):
                panel.fill_between(
                    minutes[shown], told.fan[low][shown, k], told.fan[high][shown, k], color=plots.BLUE, alpha=alpha,
                    linewidth=0, label="95 %" if alpha < 0.3 else "50 %",
                )  # fmt: skip
            panel.plot(minutes[shown], told.fan[0.5][shown, k], color=plots.BLUE, label="median")
            limit = found.inputs.limit_c[k]
            panel.axhline(limit, color=plots.VERMILLION, linewidth=0.9, label="limit")
            panel.axvline(now, color=plots.INK, linewidth=0.8, linestyle=":")
            panel.set_ylim(top=limit + 12)
            panel.set_ylabel(plots.axis_label("case", "°C"))
            panel.set_title(next(one.words for one in told.joints if one.joint == joint))
        axes[-1, 0].set_xlabel(plots.axis_label("time", "min"))
        plots.legend(axes[0, 0], loc="lower right", bbox_to_anchor=(1.0, 0.0))
    return figure


def _interesting(told: Forecast) -> list[str]:
    """At most four joints, those nearest to their limit."""
    order = sorted(told.joints, key=lambda one: (-one.probability, one.limit_c - one.settles_c.value))
    return [one.joint for one in order[:4]]


def _shown_min(told: Forecast, run: Inputs | None, now: float) -> float:
    ends = [one.seconds_to_limit.high for one in told.joints if one.seconds_to_limit is not None]
    wanted = 1.3 * min(max(ends, default=3600.0), HORIZON_S) / 60
    past = 0.0 if run is None else run.duration_s / 60 - now
    return min(max(wanted, past, 20.0), SHOWN_MIN)


def fit_report(found: Fit, runs: Sequence[Inputs], held: HeldOut | None, command: str) -> Report:
    """What a reader needs to believe the model: the later part first, then the curves, then the numbers."""
    report = Report("Heat", ", ".join(run.name for run in runs), made_by=command)
    if held is not None:
        good: Tone = "good" if held.rms_k < BELIEVED_K else "bad"
        report.key_figures(
            KeyFigure("later part missed by", f"{held.rms_k:.2f} K", f"rms from {held.from_s / 60:.0f} min on", good),
            KeyFigure("worst", f"{held.worst_k:.1f} K", held.worst),
            KeyFigure("inside the 95 % band", f"{held.within:.0%}", "of what was read there"),
        )
    last = runs[-1]
    report.section("Temperatures").figure(
        temperature_picture(found, last),
        "Dots: means of what the servo reads, whole °C. Line and band: the two-node model and where it believes the case to be "
        "(95 %, the slow disturbance included).",
    )
    report.section("Parameters").table(
        ["joint", "parameter", "value", "low", "high", "unit", "by the run"],
        [
            [one.joint or "all", one.name, one.value, one.low, one.high, one.unit,
             Mark(f"{one.informed:.0%}", "good" if one.informed > 0.5 else "")]
            for one in found.estimates
        ],
        "Intervals are 95 %. By the run: how much of what was uncertain before it has taken away; with little, the value is "
        "what was believed of such servos anyhow.",
    )  # fmt: skip
    report.text(
        f"What no two-node model explains was about {found.disturbance_k:g} K, with a memory of "
        f"{found.disturbance_s / 60:.0f} min; crossings were left by "
        f"{np.nanmax(found.residual_k):.2f} K at most (rms a joint). Telemetry errors taken out: {int(found.inputs.glitches.sum())}."
    )
    return report


def forecast_report(found: Fit, told: Forecast, rest: str, command: str, run: Inputs | None = None) -> Report:
    """When each servo shuts down under this load, and what it could bear."""
    report = Report("Thermal forecast", f"{found.inputs.name}, {told.load.words}", made_by=command)
    first = told.first
    report.text(f"**{first.words if first else 'No servo comes to its limit.'}** Advice: {rest}.")
    report.section("What comes").figure(
        forecast_picture(found, told, run=run),
        "Dots: what was read; dotted line: now. The fan holds the parameters' and the room's uncertainty and how the load varies.",
    )
    report.section("Joints").table(
        ["joint", "now °C", "limit °C", "min to the limit", "settles at °C", "for ever N·m", "an hour N·m"],
        [
            [one.joint, one.temperature_c, one.limit_c, _interval(one.seconds_to_limit, 1 / 60), _interval(one.settles_c),
             _interval(one.continuous_torque_nm), _interval(one.hour_torque_nm)]
            for one in told.joints
        ],
        "95 % intervals in brackets. For ever: the torque at standstill that keeps the case just below the limit.",
    )  # fmt: skip
    return report


def _interval(interval: Interval | None, scale: float = 1.0) -> str:
    if interval is None:
        return "–"
    high = "open" if interval.high >= HORIZON_S else f"{interval.high * scale:.3g}"
    value = "open" if interval.value >= HORIZON_S else f"{interval.value * scale:.3g}"
    return f"{value} [{interval.low * scale:.3g}, {high}]"


def compare_report(differences: Sequence[Difference], a: str, b: str, command: str) -> Report:
    """Where each servo settles in both, and the difference."""
    report = Report("Two soaks", f"A: {a} · B: {b}", made_by=command)
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
    report.section("Difference").figure(
        figure, "Under one and the same torque in a room of 25 °C; bars are 95 % intervals."
    )
    report.table(
        ["joint", "torque N·m", "A °C", "B °C", "B − A K", "time constant B − A s"],
        [
            [one.joint, one.torque_nm, _interval(one.a_c), _interval(one.b_c),
             Mark(_interval(one.difference_k), "good" if one.certain else ""), _interval(one.time_constant_s)]
            for one in differences
        ],
    )  # fmt: skip
    return report
