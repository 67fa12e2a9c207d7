"""Rewards on the robot against rewards in simulations, as a picture."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from openant_agents.curves import COLOURS
from openant_agents.ranking import Agreement, PlaceResult
from openant_tools.files import write_bytes

__all__ = ["draw_ranking"]


def draw_ranking(
    names: Sequence[str],
    real: Mapping[str, PlaceResult],
    simulated: Mapping[str, Mapping[str, PlaceResult]],
    found: Mapping[str, Agreement],
    flagged: Collection[str],
    file: Path,
) -> None:
    """One panel a simulation: each policy's reward there and on the robot, ± a standard error, and the line of equality.

    Args:
        names: of the policies.
        real, simulated: rewards by policy; by simulation and policy.
        found: by simulation.
        flagged: policies drawn as triangles.
        file: a PNG.

    Raises:
        OSError: it cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * len(simulated) + 0.6, 3.8), layout="constrained")
    panels = figure.subplots(1, len(simulated), sharex=True, sharey=True, squeeze=False)[0]
    values = [one.average_reward_m_s for part in (real, *simulated.values()) for one in part.values()]
    low, high = 100 * min(0.0, *values), 100 * max(values)
    for panel, (name, measured), colour in zip(panels, simulated.items(), COLOURS, strict=False):
        panel.plot([low, high], [low, high], color="0.7", linewidth=0.8)
        for group, marker, label in (
            ([one for one in names if one not in flagged], "o", None),
            ([one for one in names if one in flagged], "v", "flagged as exploit"),
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
            marker="o", markersize=12, markerfacecolor="none", markeredgecolor="black", linestyle="",
            label="best in this simulation",
        )  # fmt: skip
        rho = found[name].spearman
        panel.set_title(
            f"{name}\nSpearman {rho.value:.2f} [{rho.low:.2f}, {rho.high:.2f}],"
            f" regret {100 * found[name].regret_m_s.value:.1f} cm/s",
            fontsize=9,
        )
        panel.set_xlabel("simulated reward (cm/s)")
        panel.grid(color="0.92")
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(frameon=False, fontsize=8, loc="upper left")
    panels[0].set_ylabel("reward on the robot (cm/s)")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=150)
    write_bytes(file, picture.getvalue())
