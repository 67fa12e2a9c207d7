"""The report of a plan: first whether it may be played, then what will be known, then how it looks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from openant_tools.numbers import exact, number, percent, span
from openant_tools.report import Figure, KeyFigure, Mark, Report, ReportSummary, plots
from openant_tools.report.parts import Tone
from openant_tools.sysid.forecast import NEAR_M, Forecast
from openant_tools.sysid.kinds import said
from openant_tools.sysid.plan import Expectation, Plan
from openant_tools.sysid.verdict import TIED

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["expected_shares", "plan_report", "timeline"]

_TONE: dict[str, Tone] = {"identified": "good", "tied": "warn", "weak": "warn", "not in the data": ""}
_COLOUR = {"identified": plots.GREEN, "tied": plots.PURPLE, "weak": plots.ORANGE, "not in the data": plots.SKY}
_MARKER = {"identified": "o", "tied": "D", "weak": "s", "not in the data": "x"}

VERDICTS = """
- **identified**: the data will give most of the value.
- **tied**: what the data say of it, they say of the parameter named beside it, too; an experiment that moves only one parts them.
- **weak**: the interval stays between data and prior.
- **not in the data**: these recordings say nothing about it.
"""


def plan_report(plan: Plan) -> Report:
    """What a reader needs to decide whether to play it."""
    first = plan.forecasts[0].protocol
    objections = plan.objections
    good = sum(one.verdict == "identified" for one in plan.expectations)
    busiest = max((peak for one in plan.forecasts for peak in one.peaks), key=lambda peak: peak.saturated)
    nearest = min(plan.forecasts, key=lambda one: one.clearance_m)
    open_ = _open(plan)
    near = number(min(nearest.clearance_m, NEAR_M), "m", decimals=0)
    answer = ReportSummary(
        f"Do not play it: {'; '.join(objections)}."
        if objections
        else f"It may be played, and will identify {good} of {len(plan.expectations)} parameters in {number(plan.seconds, 's', decimals=0)}.",
        Figure(
            expected_shares(plan.expectations),
            "How wide each value's 95 % interval will be, against what is known before anything is recorded (100 %): the farther "
            "left, the more will be known. One dot a joint.",
        ),
        f"“{first.name}”: {first.words}. "
        + (f"It does not settle {'; '.join(open_)}." if open_ else "It settles everything."),
        "Choose another protocol or smaller limits, and plan again."
        if objections
        else "Put the robot on its stand and record it: `openant sysid record`, with the same protocol or `--plan`.",
        "bad" if objections or not good else "good",
        (
            KeyFigure("at the torque limit", percent(busiest.saturated), f"of the time, {busiest.joint}"),
            KeyFigure(
                "nearest to itself",
                near if nearest.clearance_m < NEAR_M else f"more than {near}",
                " and ".join(nearest.nearest),
                "bad" if nearest.clearance_m < 0 else "",
            ),
            KeyFigure(
                "time",
                number(plan.seconds, "s", decimals=0),
                f"in {len(plan.forecasts)} recording{'s' if len(plan.forecasts) > 1 else ''}",
            ),
        ),
    )
    report = Report(
        "Plan of recordings", f"{plan.asked.model.name} · {first.name}", answer, made_by="openant sysid plan"
    )
    report.section("What will be known").table(
        ["parameter", "verdict", "expected (95 % interval)", "known today", "tied to"],
        [
            [
                said(one.name), Mark(one.verdict, _TONE[one.verdict]),
                number(one.nominal, one.unit, one.low, one.high), span(one.prior_low, one.prior_high, one.unit),
                _tie(one),
            ]
            for one in plan.expectations
        ],
    )  # fmt: skip
    residual = plan.asked.residual
    report.text(
        VERDICTS
        + f"\nExpected if a fit leaves {_error(residual.rad)} that last for {exact(residual.memory_s, 's')} on the stand, and "
        f"{_error(residual.floor_rad)} for {exact(residual.floor_memory_s, 's')} on the floor. **tied to** names the parameter of "
        f"the largest correlation, of the same joint where no other is said, where that is {number(TIED, decimals=1)} or more."
    )
    for note in plan.notes:
        report.text(note)
    report.section("What is played")
    for one in plan.forecasts:
        report.figure(timeline(one), _played(one))
    report.section("How hard it is")
    for one in plan.forecasts:
        report.table(
            ["joint", "speed", "at most, unloaded", "torque", "limit", "rms torque", "at the limit", "range"],
            [
                [
                    peak.joint, number(peak.speed_rad_s, "rad/s", decimals=0), number(peak.no_load_rad_s, "rad/s", decimals=0),
                    number(peak.torque_nm, "N·m", decimals=2), number(peak.limit_nm, "N·m", decimals=2),
                    number(peak.rms_nm, "N·m", decimals=2), percent(peak.saturated), span(peak.low_rad, peak.high_rad, "rad"),
                ]
                for peak in one.peaks
            ],
            caption=_played(one),
        )  # fmt: skip
    return report


def _open(plan: Plan) -> list[str]:
    """What it leaves open, a phrase for each kind of parameter."""
    left: dict[str, list[str]] = {}
    for one in plan.expectations:
        kind, _, label = one.name.partition(".")
        if one.verdict != "identified":
            left.setdefault(kind, []).append(label)
    of = {kind: sum(one.name.startswith(f"{kind}.") for one in plan.expectations) for kind in left}
    return [
        f"{said(kind)} ({f'all {of[kind]}' if len(labels) == of[kind] > 1 else ', '.join(labels)})"
        for kind, labels in left.items()
    ]


def _tie(one: Expectation) -> str:
    """What it is tied to, and how much; of the same joint only which parameter."""
    if one.tied_to is None:
        return ""
    kind, _, label = one.tied_to.partition(".")
    name = said(kind if label == one.name.partition(".")[2] else one.tied_to)
    return f"{name} ({number(one.correlation, sign=True, decimals=2)})"


def _error(rad: float) -> str:
    return number(rad, "rad", name="residual")


def _played(one: Forecast) -> str:
    heading = f", turned by {number(one.protocol.heading_rad, 'rad', decimals=0)}" if one.protocol.heading_rad else ""
    words = f"On the {one.protocol.setup}{heading}, {number(one.protocol.seconds, 's', decimals=0)}."
    if one.protocol.setup == "floor":
        words += f" It leans by {number(one.lean_rad, 'rad', decimals=0)} and goes {number(100 * one.travel_m, 'cm', decimals=0)} at most."
    return words


def expected_shares(expectations: Sequence[Expectation]) -> MatplotlibFigure:
    """Expected interval over prior interval, one row a kind of parameter, one dot a joint, on a log scale."""
    figure: MatplotlibFigure
    kinds = list(dict.fromkeys(one.name.partition(".")[0] for one in expectations))
    figure, axes = plots.figure(height=0.7 + 0.28 * len(kinds))
    with plots.style():
        for verdict in _TONE:
            of = [one for one in expectations if one.verdict == verdict]
            if not of:
                continue
            shares = [(one.high - one.low) / (one.prior_high - one.prior_low) for one in of]
            rows = [kinds.index(one.name.partition(".")[0]) for one in of]
            label = "tied to another" if verdict == "tied" else verdict
            axes.plot(shares, rows, _MARKER[verdict], color=_COLOUR[verdict], label=label, alpha=0.8)
        axes.set_xscale("log")
        axes.set_yticks(range(len(kinds)), list(map(said, kinds)))
        axes.invert_yaxis()
        axes.axvline(1.0, linestyle=":", color=plots.INK)
        axes.xaxis.set_major_formatter(lambda share, _: percent(share, decimals=1 if share < 0.01 else 0))
        axes.set_xlabel("expected interval, as a share of what is known today")
    plots.legend(axes)
    return figure


def timeline(one: Forecast) -> MatplotlibFigure:
    """Commands and simulated positions of the first leg's joints, with the motions named and torque-off marked."""
    figure: MatplotlibFigure
    run = one.run
    shown = run.joints[:2]
    figure, all_axes = plots.figure(len(shown), 1, height=1.7, sharex=True, squeeze=False)
    with plots.style():
        for axes, joint in zip(all_axes[:, 0], shown, strict=True):
            command, simulated = (plots.DEGREES * run.column(f"{signal}.{joint}") for signal in ("cmd", "pos"))
            axes.plot(run.t, command, color=plots.INK, linewidth=0.8, alpha=0.6, label="command")
            axes.plot(run.t, simulated, color=plots.BLUE, label="simulated")
            off = run.signal("torque", [joint], default=1.0)[:, 0] == 0
            if off.any():
                low, high = axes.get_ylim()
                axes.fill_between(
                    run.t, low, high, where=off, color=plots.ORANGE, alpha=0.25, linewidth=0, label="torque off"
                )
                axes.set_ylim(low, high)
            axes.set_ylabel(plots.axis_label(joint, "°"))
            for start in one.protocol.starts():
                axes.axvline(start, color=plots.INK, linewidth=0.6, alpha=0.4)
        bottom = all_axes[-1, 0]
        low, high = bottom.get_ylim()
        bottom.set_ylim(low, high + 0.15 * (high - low))  # room for the names
        for start, segment in zip(one.protocol.starts(), one.protocol.segments, strict=True):
            name = type(getattr(segment, "of", segment)).__name__
            words = "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name).strip()
            bottom.text(
                start + 0.05, 0.98, words, transform=bottom.get_xaxis_transform(), va="top", fontsize=7, color=plots.INK
            )
        bottom.set_xlabel(plots.axis_label("time", "s"))
        bottom.set_xlim(0, float(np.ceil(run.t[-1])))
    plots.legend(all_axes[0, 0])
    return figure
