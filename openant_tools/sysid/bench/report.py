"""The report of a stiffness by scale: the readings, the lines through them, and what each P divisor would give."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from openant_tools.numbers import number
from openant_tools.procedure.finding import Finding
from openant_tools.report import Figure, KeyFigure, Report, ReportSummary, plots
from openant_tools.robot.servo import servo_model
from openant_tools.sysid.bench.knee_torque import GRAVITY_M_S2
from openant_tools.sysid.bench.stiffness import DIVISORS

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["stiffness_report"]


def stiffness_report(finding: Finding) -> Report:
    """The report of a finding that `stiffness_finding` made."""
    shown = [
        e for e in finding.evidence if e.value is not None and "divisor 1" not in e.name and "divisor 2" not in e.name
    ]
    answer = ReportSummary(
        finding.what,
        Figure(
            _lines(finding),
            "Torque over position error. Dots are readings, by the scale (grams times lever arm) and by the servo (Present PWM "
            "times the data sheet's stall torque). Lines are what the register's formula gives with either P divisor.",
        ),
        " ".join((*finding.unsure, *finding.problems)) or "So stiffly the joint pulls towards its goal, and so the model should.",
        finding.next_action or "Fit the robot with it: `openant sysid fit --robot` begins from what was measured.",
        "good" if finding.ok else "bad" if finding.ok is False else "warn",
        [KeyFigure(e.name, e.words) for e in shown],
    )  # fmt: skip
    report = Report("Stiffness on the bench", finding.data["joint"], answer, made_by=finding.command)
    return report.section("Evidence").table(
        ["quantity", "value (95 % interval)", "source"], [[e.name, e.words, e.source] for e in finding.evidence]
    )


def _lines(finding: Finding) -> MatplotlibFigure:
    data = finding.data
    stall = servo_model(data["servo"]).stall_torque_at(data["supply_v"])
    readings, weighings = data["servo_readings"], data["weighings"]
    error = {round(r["deflection_rad"], 9): r["error_rad"] for r in readings}
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=3.2)
    x = [error.get(round(w["deflection_rad"], 9), w["deflection_rad"]) for w in weighings]
    reach = np.array([0.0, max([*x, *error.values()])])
    formula = {
        float(e.name.rpartition(" ")[2]): e.value for e in finding.evidence if e.name.startswith("stiffness by P")
    }
    with plots.style():
        for divisor, style in zip(DIVISORS, ("--", ":"), strict=True):
            axes.plot(
                1e3 * reach,
                formula[divisor] * reach,
                style,
                color=plots.INK,
                linewidth=1,
                label=f"divisor {number(divisor)}",
            )
        limit = stall * data["pwm_limit"]
        axes.axhline(limit, color=plots.ORANGE, linewidth=1, label="torque at the PWM limit")
        if weighings:
            torque = [w["grams"] * 1e-3 * GRAVITY_M_S2 * data["arm_m"] for w in weighings]
            axes.plot([1e3 * at for at in x], torque, "o", color=plots.BLUE, label="scale")
        if readings:
            axes.plot(
                [1e3 * r["error_rad"] for r in readings],
                [r["duty"] * stall for r in readings],
                "s",
                color=plots.VERMILLION,
                markerfacecolor="none",
                label="servo",
            )
        axes.set_xlabel(plots.axis_label("position error" if readings else "deflection of the goal", "mrad"))
        axes.set_ylabel(plots.axis_label("torque", "N·m"))
    plots.legend(axes)
    return figure
