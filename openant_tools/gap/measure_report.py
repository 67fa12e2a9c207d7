"""The report of a measured gap: how large, where, and how it looks at its worst."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING

import numpy as np

from openant_tools.gap.measure import UNITS, Measurement
from openant_tools.gap.regime import Regime
from openant_tools.gap.words import LEAST_SHARE, SIGNALS, part_words, restart_words
from openant_tools.numbers import number, percent
from openant_tools.report import Figure, KeyFigure, Report, ReportSummary, Table, plots

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["gap_report", "sentence", "table"]

#: places that a terminal is told
TOLD = 12
#: s shown around the worst moment
WINDOW_S = 3.0
#: letters of a line below a column of the picture
COLUMN_LETTERS = 13


def sentence(found: Measurement) -> str:
    """What a reader should take away."""
    if found.doubt:
        return f"Cannot judge the gap: {found.doubt}."
    if not found.places or found.excess("pos") == 0:
        return "The gap lies within what no model could beat: nothing here is to be explained."
    first = next(place for place in found.places if place.signal == "pos")
    off, floor = (number(one["pos"], "rad", name="gap") for one in (found.gaps, found.floors))
    return (
        f"The simulation is off by {off}, where no model could do better than {floor}; "
        f"{part_words(first.share, first.joint, first.regime)}."
    )


def table(found: Measurement) -> list[str]:
    """The numbers for a terminal: each signal's gap and floor, then where most of it lies."""
    words = max(len(regime.words) for regime in Regime)
    lines = [
        f"{SIGNALS[signal]}: {_shown(signal, value)}, floor {_shown(signal, found.floors[signal])}"
        for signal, value in found.gaps.items()
    ]
    lines.append(f"{'signal':8}  {'joint':13}  {'while':{words}}  {'share':>7}  {'gap':>11}")
    lines += [
        f"{SIGNALS[place.signal]:8}  {place.joint:13}  {place.regime.words:{words}}  {percent(place.share, decimals=1):>7}  "
        f"{_shown(place.signal, place.gap):>11}"
        for place in found.places[:TOLD]
    ]
    return lines


def gap_report(found: Measurement) -> Report:
    """Everything about where the gap lies."""
    nothing = not found.doubt and (not found.places or found.excess("pos") == 0)
    answer = ReportSummary(
        sentence(found),
        Figure(
            worst(found),
            "Commanded, measured and simulated around the moment at which position is farthest off. "
            f"{restart_words(found.horizon_s)}.",
        ),
        "Until that is settled, no figure here is to be believed."
        if found.doubt
        else "These runs could not tell a better model from this one."
        if nothing
        else "A policy that is trained in this simulation meets a robot that moves differently, above all there.",
        "Record the same motion twice with nothing changed in between, and measure again."
        if found.doubt
        else "Train on it; measure again with motions of another kind."
        if nothing
        else "Fit the model (`openant sysid fit`), or ask for the cause: `openant gap diagnose` on the same runs.",
        "bad" if found.doubt else "good" if nothing else "",
        [
            KeyFigure(
                f"{SIGNALS[signal]} off by", _shown(signal, value), f"floor {_shown(signal, found.floors[signal])}"
            )
            for signal, value in found.gaps.items()
        ],
    )
    report = Report(
        "The gap",
        f"{found.model.name} · {', '.join(p.run.name for p in found.played)}",
        answer,
        made_by="openant gap measure",
    )
    report.section("Where").figure(
        shares(found),
        "How much of the position's error lies at which joint, and what the joint was doing meanwhile: shares of the squared "
        "error beyond the floor, together 100 %.",
    )
    for signal in found.gaps:
        report.details(f"{SIGNALS[signal].capitalize()}, in numbers", _places(found, signal))
    acting = ", ".join(dict.fromkeys(name for name, _ in found.effects))
    report.section("How it was measured").text(
        f"The simulation is given each run's own commands. {restart_words(found.horizon_s)}. "
        "The gap is how far measured and simulated differ: the root mean square over all joints and samples. "
        "The floor is the gap that no model could beat; it comes from "
        f"{'repeats of the same commands' if found.from_repeats else _sensors(found)}."
        + (f" Beside the model act: {acting}." if acting else "")
    )
    return report


def _shown(signal: str, value: float) -> str:
    return number(value, UNITS[signal], name="gap" if signal == "pos" else "")


def _places(found: Measurement, signal: str) -> Table:
    rows = [
        [place.joint, place.regime.words, percent(place.share, decimals=1), _shown(signal, place.gap),
         number(place.seconds, "s", decimals=1)]
        for place in found.places
        if place.signal == signal and place.share >= LEAST_SHARE
    ]  # fmt: skip
    return Table(["joint", "while", "share", "off by", "for"], rows)


def shares(found: Measurement) -> MatplotlibFigure:
    """Joints against what they were doing, as far as any was."""
    figure: MatplotlibFigure
    places = [place for place in found.places if place.signal == "pos"]
    seen = [regime for regime in Regime if any(place.regime == regime for place in places)]
    table = np.zeros((len(found.joints), len(seen)))
    for place in places:
        table[found.joints.index(place.joint), seen.index(place.regime)] = 100 * place.share
    figure, axes = plots.figure(height=1.2 + 0.32 * len(found.joints))
    # Of the page's own paper where nothing lies, so that the numbers can be read on light and dark.
    axes.imshow(table, cmap=_paper_to(plots.BLUE), vmin=0.0, aspect="auto")
    axes.set_xticks(range(len(seen)), [textwrap.fill(regime.words, COLUMN_LETTERS) for regime in seen])
    axes.set_yticks(range(len(found.joints)), found.joints)
    axes.grid(False)
    for row, column in np.argwhere(table >= 100 * LEAST_SHARE):
        axes.text(column, row, percent(table[row, column] / 100), ha="center", va="center", fontsize=8, color=plots.INK)
    return figure


def _paper_to(colour: str) -> Colormap:
    """From nothing to a colour through which ink can be read."""
    from matplotlib.colors import LinearSegmentedColormap, to_rgba

    return LinearSegmentedColormap.from_list("share", [to_rgba(colour, 0.0), to_rgba(colour, 0.6)])


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
    figure, (above, below) = plots.figure(2, 1, height=1.8, sharex=True)
    plots.draw_tracking(
        above, below, found.joints[j], t[near] - t[0], one.run.signal("cmd", found.joints)[near, j],
        one.measured["pos"][near, j], one.simulated["pos"][near, j], names=("simulated", ""), title=one.run.name,
    )  # fmt: skip
    return figure


def _sensors(found: Measurement) -> str:
    late = found.stamp_error_s
    stamps = f" and time stamps that are off by {number(late, 's')}" if late else ""
    return f"the resolution and noise of the sensors{stamps} (record repeats for a better one)"
