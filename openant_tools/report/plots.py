"""One style for every plot: Okabe–Ito colours, names and units on the axes, sizes that fit a report.

Plots are made without pyplot, so that nothing needs a display and nothing is shared between threads:

    with plots.style():
        figure, axes = plots.figure(rows=2, sharex=True)
        axes[0].plot(run.t, run.column("pos.knee_fl"), label="measured")
        axes[0].set_ylabel(plots.signal_label("pos"))
        plots.legend(axes[0])
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from openant_tools.numbers import readable

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = [
    "BLUE", "CYCLE", "DEGREES", "GREEN", "INK", "ORANGE", "PURPLE", "SIGNAL_LABELS", "SKY", "VERMILLION", "YELLOW", "as_png",
    "as_svg", "axis_label", "draw_tracking", "figure", "legend", "signal_label", "signal_unit", "style",
]  # fmt: skip

# Okabe and Ito's palette (https://jfly.uni-koeln.de/color/): eight colours that all kinds of eyes tell apart.
BLUE, ORANGE, GREEN, VERMILLION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, YELLOW = "#56B4E9", "#CC79A7", "#F0E442"
#: Stands for the reader's text colour: in a report it becomes the page's, light or dark.
INK = "#1c1d1e"
#: Order of lines; yellow comes last, since it is faint on white.
CYCLE = (BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE, YELLOW)

#: by what an angle in rad is multiplied to be drawn
DEGREES = math.degrees(1)
#: in, width of a figure as wide as a report's text
WIDTH = 8.0

#: signal → name and unit, for axes
SIGNAL_LABELS: Mapping[str, tuple[str, str]] = {
    "t": ("time", "s"), "cmd": ("command", "rad"), "pos": ("position", "rad"), "vel": ("velocity", "rad/s"),
    "cur": ("current", "A"), "pwm": ("duty", "1"), "load": ("load", "1"), "volt": ("supply", "V"),
    "temp": ("temperature", "°C"), "rtt": ("round trip", "s"), "gyro": ("turn rate", "rad/s"),
    "acc": ("specific force", "m/s²"), "base": ("place", "m"),
}  # fmt: skip

_STYLE = {
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "figure.constrained_layout.use": True,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "grid.color": INK,
    "grid.alpha": 0.15,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "path.simplify": True,
    # Half a point: no eye sees it, and a plot of 100 000 samples becomes small.
    "path.simplify_threshold": 0.5,
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "openant",
    "text.color": INK,
    "xtick.color": INK,
    "xtick.labelsize": 8,
    "ytick.color": INK,
    "ytick.labelsize": 8,
}


@contextmanager
def style() -> Iterator[None]:
    """The style, for everything that is plotted inside the block."""
    import matplotlib as mpl
    from cycler import cycler

    with mpl.rc_context({**_STYLE, "axes.prop_cycle": cycler(color=CYCLE)}):
        yield


def figure(rows: int = 1, columns: int = 1, *, height: float = 2.4, width: float = WIDTH, **options: Any) -> Any:
    """A figure and its axes, as `Figure.subplots` gives them.

    Args:
        rows, columns: how many axes.
        height: of one row, in inches; `width` of the whole.
        options: for `Figure.subplots`, such as `sharex=True`, `squeeze=False`.
    """
    from matplotlib.figure import Figure

    with style():
        made = Figure(figsize=(width, height * rows))
        return made, made.subplots(rows, columns, **options)


def axis_label(name: str, unit: str) -> str:
    """`name (unit)`; a quantity without a unit has (–)."""
    return f"{name} ({unit if unit not in ('', '1') else '–'})"


def signal_label(signal: str) -> str:
    """The label of an axis that shows a signal or column of a run, such as `pos` or `gyro.z`."""
    kind, _, axis = signal.partition(".")
    name = "heading" if signal == "base.yaw" else SIGNAL_LABELS.get(kind, (kind, ""))[0]
    unit = signal_unit(signal)
    return axis_label(f"{name} {axis}" if axis in ("x", "y", "z") else name, readable(1.0, unit)[1])


def signal_unit(signal: str) -> str:
    """The unit that files have a signal or column of a run in."""
    return "rad" if signal == "base.yaw" else SIGNAL_LABELS.get(signal.partition(".")[0], ("", ""))[1]


def draw_tracking(
    above: Axes,
    below: Axes,
    joint: str,
    t: Array,
    command: Array,
    measured: Array,
    given: Array,
    better: Array | None = None,
    *,
    names: tuple[str, str] = ("given model", "calibrated"),
    title: str = "",
) -> None:
    """One joint's position into the upper axes, and what each model leaves of it into the lower; alike in every report.

    Args:
        t: (rows,) s. command, measured: (rows,) rad. given, better: (rows,) rad as simulated; None for no second model.
        names: of both models. title: over both axes; the legend stands above it.
    """
    with style():
        above.step(t, DEGREES * command, where="post", color=INK, linewidth=0.8, alpha=0.5, label="command")
        # Broad, since a good model lies upon it.
        above.plot(t, DEGREES * measured, color=INK, linewidth=2.2, label="measured")
        for values, name, line, colour in ((given, names[0], "--", VERMILLION), (better, names[1], "-", BLUE)):
            if values is not None:
                above.plot(t, DEGREES * values, line, color=colour, label=name)
                below.plot(t, 1e3 * (measured - values), line, color=colour)
        below.axhline(0.0, color=INK, linewidth=0.6)
        above.set_title(title)
        above.set_ylabel(axis_label(joint, "°"))
        below.set_ylabel(axis_label("error", "mrad"))
        below.set_xlabel(axis_label("time in run", "s"))
    legend(above)


def legend(axes: Axes, **options: Any) -> None:
    """A legend above the plot, at its left end, which a phone shows; where the plot has a title, in a line of its own."""
    handles, labels = axes.get_legend_handles_labels()
    with style():
        if axes.get_title("left") and not options:
            axes.figure.legend(handles, labels, loc="outside upper left", ncols=len(handles) or 1)
        else:
            axes.legend(**{"loc": "lower left", "bbox_to_anchor": (0.0, 0.99), "ncols": len(handles) or 1, **options})


def as_svg(figure: Figure, key: str = "figure") -> str:
    """The figure as an SVG element for the inside of a page: text as text, ink in the page's colour.

    `key` makes its ids unique among the figures of a page.
    """
    buffer = io.StringIO()
    with style():
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg ") :]
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{key}-\1"', svg)
    svg = re.sub(r'(href="|url\()#', rf"\1#{key}-", svg)
    # The page's width rules: keep the view box, drop the size in points.
    svg = re.sub(r'(<svg [^>]*?)\s(?:width|height)="[^"]*pt"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg [^>]*?)\s(?:width|height)="[^"]*pt"', r"\1", svg, count=1)
    # On a dark page the palette's blue is too dim; the page's style sheet says how blue it is.
    return svg.replace(INK, "currentColor").replace(BLUE.lower(), f"var(--blue, {BLUE})").strip()


def as_png(figure: Figure, dpi: int = 150) -> bytes:
    """The figure as PNG on white, for places that cannot adapt its ink."""
    buffer = io.BytesIO()
    with style():
        figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()
