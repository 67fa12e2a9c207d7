"""The report of a plan: first whether it may be played, then what will be known, then how it looks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from openant_tools.report import KeyFigure, Mark, Report, plots
from openant_tools.report.parts import Tone
from openant_tools.sysid.forecast import NEAR_M, Forecast
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
    report = Report("Plan of recordings", f"{plan.asked.model.name} · {first.name}", made_by="openant sysid plan")
    objections = plan.objections
    good = sum(one.verdict == "identified" for one in plan.expectations)
    report.text(
        f"**Do not play it: {'; '.join(objections)}.**"
        if objections
        else f"**{good} of {len(plan.expectations)} parameters will be identified.** {first.words[:1].upper()}{first.words[1:]}."
    )
    busiest = max((peak for one in plan.forecasts for peak in one.peaks), key=lambda peak: peak.saturated)
    nearest = min(plan.forecasts, key=lambda one: one.clearance_m)
    report.key_figures(
        KeyFigure("identified", f"{good} of {len(plan.expectations)}", "parameters", "good" if good else "bad"),
        KeyFigure("time", f"{plan.seconds:.0f} s", f"in {len(plan.forecasts)} recordings"),
        KeyFigure("at the torque limit", f"{100 * busiest.saturated:.0f} %", f"of the time, {busiest.joint}"),
        KeyFigure(
            "nearest to itself",
            f"{1e3 * nearest.clearance_m:.0f} mm" if nearest.clearance_m < NEAR_M else f"> {1e3 * NEAR_M:.0f} mm",
            " and ".join(nearest.nearest),
            "bad" if nearest.clearance_m < 0 else "",
        ),
    )
    report.section("What will be known").figure(
        expected_shares(plan.expectations),
        "The width of each expected 95 % interval as a share of the prior's: 1 is what is known today. One dot a joint.",
    )
    report.table(
        ["parameter", "expected", "from", "to", "prior from", "prior to", "unit", "verdict", "tied to"],
        [
            [
                one.name, one.nominal, one.low, one.high, one.prior_low, one.prior_high, one.unit,
                Mark(one.verdict, _TONE[one.verdict]),
                f"{one.tied_to} ({one.correlation:+.2f})" if one.tied_to else "",
            ]
            for one in plan.expectations
        ],
    )  # fmt: skip
    residual = plan.asked.residual
    report.text(
        VERDICTS
        + f"\nExpected if a fit leaves {1e3 * residual.rad:g} mrad that last for {residual.memory_s:g} s on the stand, and "
        f"{1e3 * residual.floor_rad:g} mrad for {residual.floor_memory_s:g} s on the floor. **tied to** names the parameter of the "
        f"largest correlation, where that is {TIED:g} or more."
    )
    for note in plan.notes:
        report.text(note)
    report.section("What is played")
    for one in plan.forecasts:
        report.figure(timeline(one), _played(one))
    report.section("How hard it is")
    for one in plan.forecasts:
        report.table(
            ["joint", "speed (rad/s)", "no-load (rad/s)", "torque (N·m)", "limit (N·m)", "rms (N·m)", "at the limit", "from (rad)", "to (rad)"],
            [
                [
                    peak.joint, f"{peak.speed_rad_s:.2f}", _number(peak.no_load_rad_s), f"{peak.torque_nm:.2f}",
                    _number(peak.limit_nm), f"{peak.rms_nm:.2f}", f"{100 * peak.saturated:.0f} %", f"{peak.low_rad:.2f}",
                    f"{peak.high_rad:.2f}",
                ]
                for peak in one.peaks
            ],
            caption=_played(one),
        )  # fmt: skip
    return report


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "–"


def _played(one: Forecast) -> str:
    heading = f", turned by {math.degrees(one.protocol.heading_rad):.0f}°" if one.protocol.heading_rad else ""
    words = f"On the {one.protocol.setup}{heading}, {one.protocol.seconds:.0f} s."
    if one.protocol.setup == "floor":
        words += f" It leans by {math.degrees(one.lean_rad):.0f}° and goes {100 * one.travel_m:.0f} cm at most."
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
        axes.set_yticks(range(len(kinds)), [kind.replace("_", " ") for kind in kinds])
        axes.invert_yaxis()
        axes.axvline(1.0, linestyle=":", color=plots.INK)
        axes.set_xlabel(plots.axis_label("expected interval / prior interval", "1"))
        axes.set_ylabel("parameter")
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
            axes.plot(run.t, run.column(f"cmd.{joint}"), color=plots.INK, linewidth=0.8, alpha=0.6, label="command")
            axes.plot(run.t, run.column(f"pos.{joint}"), color=plots.BLUE, label="simulated")
            off = run.signal("torque", [joint], default=1.0)[:, 0] == 0
            if off.any():
                low, high = axes.get_ylim()
                axes.fill_between(
                    run.t, low, high, where=off, color=plots.ORANGE, alpha=0.25, linewidth=0, label="torque off"
                )
                axes.set_ylim(low, high)
            axes.set_ylabel(plots.axis_label(joint, "rad"))
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
