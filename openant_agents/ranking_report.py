"""The report of a ranking: rewards on the robot against rewards in simulations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from openant_agents.ranking import Ranking
from openant_tools.numbers import number, percent
from openant_tools.procedure.intervals import Interval
from openant_tools.report import Figure, Report, ReportSummary, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["ranking_report"]


def ranking_report(ranking: Ranking) -> Report:
    """Which simulation ranks policies as the robot does, and what choosing by it costs."""
    found = ranking.agreements
    best, agreed = max(found.items(), key=lambda item: item[1].spearman.value)
    told = agreed.spearman.low > 0
    answer = ReportSummary(
        f"The simulation “{best}” ranks {agreed.policies} policies most as the robot does: rank correlation {_words(agreed.spearman)}, where 1 is the same order."
        if told
        else f"Of {agreed.policies} policies, no simulation is known to rank them as the robot does.",
        Figure(
            _picture(ranking),
            "Each policy's reward in a simulation and on the robot, with a standard error. On the line both are alike.",
        ),
        f"Choosing by “{best}” costs {_words(agreed.regret_m_s, 100, 'cm/s')} of reward: its best is number {agreed.best_is} "
        "on the robot."
        + "".join(
            f"\n\nPerhaps {one.policy} exploits its simulation: it does not stand {one.what}." for one in ranking.flags
        ),
        f"Choose policies by “{best}”."
        if told
        else "Play more policies on the robot, or calibrate: `openant sysid fit`.",
        "good" if told else "warn",
    )
    return Report("Ranking of policies", ", ".join(found), answer, made_by="openant policies rank").section("Figures").table(
        ["simulation", "Spearman", "Kendall", "rank violation", "regret"],
        [
            [name, _words(one.spearman), _words(one.kendall), _words(one.rank_violation_m_s, 100, "cm/s"),
             f"{_words(one.regret_m_s, 100, 'cm/s')}, {percent(one.regret_share)}"]
            for name, one in found.items()
        ],
        caption="Spearman and Kendall: correlation of the ranks, 1 is the same order. Rank violation: by how much reward on the robot "
        "policies in the wrong order differ at most, in the mean. Regret: by how much the simulation's best falls short of the "
        "robot's, also as a share of that.",
    )  # fmt: skip


def _words(one: Interval, factor: float = 1.0, unit: str = "") -> str:
    return number(factor * one.value, unit, factor * one.low, factor * one.high)


def _picture(ranking: Ranking) -> MatplotlibFigure:
    """One panel a simulation: each policy's reward there and on the robot, ± a standard error, and the line of equality."""
    real, simulated, names = ranking.real, ranking.simulated, list(ranking.real)
    flagged = {one.policy for one in ranking.flags}
    figure: MatplotlibFigure
    figure, panels = plots.figure(1, len(simulated), height=3.6, sharex=True, sharey=True, squeeze=False)
    values = [one.average_reward_m_s for part in (real, *simulated.values()) for one in part.values()]
    low, high = 100 * min(0.0, *values), 100 * max(values)
    with plots.style():
        for panel, (name, measured) in zip(panels[0], simulated.items(), strict=True):
            panel.plot([low, high], [low, high], color=plots.INK, alpha=0.4, linewidth=0.8)
            for group, marker, colour, label in (
                ([one for one in names if one not in flagged], "o", plots.BLUE, None),
                ([one for one in names if one in flagged], "v", plots.VERMILLION, "perhaps an exploit"),
            ):
                if group:
                    panel.errorbar(
                        [100 * measured[one].average_reward_m_s for one in group],
                        [100 * real[one].average_reward_m_s for one in group],
                        xerr=[100 * measured[one].standard_error_m_s for one in group],
                        yerr=[100 * real[one].standard_error_m_s for one in group],
                        linestyle="", marker=marker, color=colour, elinewidth=0.7, markersize=5, label=label,
                    )  # fmt: skip
            best = max(names, key=lambda one: measured[one].average_reward_m_s)
            panel.plot(
                [100 * measured[best].average_reward_m_s], [100 * real[best].average_reward_m_s],
                marker="o", markersize=12, markerfacecolor="none", markeredgecolor=plots.INK, linestyle="",
                label="best in this simulation",
            )  # fmt: skip
            rho = ranking.agreements[name].spearman.value
            panel.set_title(f"{name}\ncorrelation {number(rho, decimals=2)}")
            panel.set_xlabel(plots.axis_label("simulated reward", "cm/s"))
        panels[0][0].set_ylabel(plots.axis_label("reward on the robot", "cm/s"))
        handles, labels = panels[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure
