"""The report of a measured gap: how large, where, and how it looks at its worst."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from openant_tools.gap.measure import UNITS, Measurement
from openant_tools.gap.regime import Regime
from openant_tools.report import KeyFigure, Report, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["gap_report", "sentence"]

#: s shown around the worst moment
WINDOW_S = 3.0
_NAMES = {"pos": "position", "vel": "velocity"}


def sentence(found: Measurement) -> str:
    """What a reader should take away."""
    if found.doubt:
        return f"Cannot judge the gap: {found.doubt}."
    if not found.places or found.excess("pos") == 0:
        return "The gap lies within what no model could beat: nothing here is to be explained."
    first = next(place for place in found.places if place.signal == "pos")
    return (
        f"The simulation is off by {1e3 * found.gaps['pos']:.2f} mrad (floor {1e3 * found.floors['pos']:.2f}); most of it, "
        f"{100 * first.share:.0f} %, at {first.joint} while {first.regime.words}."
    )


def gap_report(found: Measurement) -> Report:
    """Everything about where the gap lies."""
    horizon = "full runs" if found.horizon_s is None else f"re-initialised every {found.horizon_s:g} s"
    report = Report(
        "The gap", f"{found.model.name} · {', '.join(p.run.name for p in found.played)}", made_by="openant gap measure"
    )
    report.text(f"**{sentence(found)}**")
    if found.effects:
        report.text(f"Beside the model act: {', '.join(dict.fromkeys(name for name, _ in found.effects))}.")
    report.key_figures(
        *(
            KeyFigure(_NAMES[signal], f"{value:.4g} {UNITS[signal]}", f"floor {found.floors[signal]:.2g}; {horizon}")
            for signal, value in found.gaps.items()
        )
    )
    report.section("Where").figure(
        shares(found),
        "Share of the excess of position by joint and by what the joint was doing; the squares of the error beyond the floor "
        "are shared out, so that all add to 100 %.",
    )
    report.table(
        ["signal", "joint", "while", "share", "gap", "unit", "seconds"],
        [
            [place.signal, place.joint, place.regime.words, f"{100 * place.share:.1f} %", f"{place.gap:.4g}",
             UNITS[place.signal], f"{place.seconds:.1f}"]
            for place in found.places
            if place.share >= 0.005
        ],
    )  # fmt: skip
    report.section("At its worst").figure(
        worst(found), "Measured and simulated around the moment at which position is farthest off, and the command."
    )
    report.section("How it was measured").text(
        f"Each run is simulated from its measured state with its own commands, {horizon}. The floor comes from "
        f"{'repeats of the same commands' if found.from_repeats else _sensors(found)}. "
        "The gap is the root mean square of measured minus simulated over all joints and samples."
    )
    return report


def shares(found: Measurement) -> MatplotlibFigure:
    """Joints against regimes."""
    figure: MatplotlibFigure
    table = np.zeros((len(found.joints), len(Regime)))
    for place in found.places:
        if place.signal == "pos":
            table[found.joints.index(place.joint), list(Regime).index(place.regime)] = 100 * place.share
    figure, axes = plots.figure(height=1.2 + 0.32 * len(found.joints))
    image = axes.imshow(table, cmap="cividis", vmin=0.0, aspect="auto")
    axes.set_xticks(range(len(Regime)), [regime.value for regime in Regime])
    axes.set_yticks(range(len(found.joints)), found.joints)
    axes.grid(False)
    half = table.max() / 2
    for row, column in np.argwhere(table >= 0.5):
        value = table[row, column]
        axes.text(
            column,
            row,
            f"{value:.0f}",
            ha="center",
            va="center",
            fontsize=8,
            color="black" if value > half else "white",
        )
    axes.set_xlabel("what the joint does")
    axes.set_ylabel("joint")
    figure.colorbar(image, ax=axes, label="share of the excess (%)")
    return figure


def worst(found: Measurement) -> MatplotlibFigure:
    """Around the largest error of position."""
    figure: MatplotlibFigure
    best = (-math.inf, 0, 0, 0)
    for k, one in enumerate(found.played):
        error = np.abs(np.nan_to_num(one.measured["pos"] - one.simulated["pos"]))
        at, joint = divmod(int(error.argmax()), error.shape[1])
        best = max(best, (float(error[at, joint]), k, at, joint))
    _, k, row, j = best
    one = found.played[k]
    t = one.run.t
    near = np.abs(t - t[row]) <= WINDOW_S / 2
    figure, axes = plots.figure(height=2.6)
    start = t[0]
    command = one.run.signal("cmd", found.joints)[near, j]
    axes.step(t[near] - start, command, where="post", color=plots.INK, lw=0.8, alpha=0.6, label="command")
    axes.plot(t[near] - start, one.measured["pos"][near, j], color=plots.BLUE, label="measured")
    axes.plot(t[near] - start, one.simulated["pos"][near, j], color=plots.VERMILLION, ls="--", label="simulated")
    axes.set_xlabel(plots.signal_label("t"))
    axes.set_ylabel(plots.signal_label("pos"))
    axes.set_title(f"{found.joints[j]}, {one.run.name}", loc="left", fontsize=10, fontweight="bold")
    plots.legend(axes)
    return figure


def _sensors(found: Measurement) -> str:
    late = found.stamp_error_s
    stamps = f" and time stamps that are off by {1e3 * late:.2g} ms" if late else ""
    return f"the resolution and noise of the sensors{stamps} (record repeats for a better one)"
