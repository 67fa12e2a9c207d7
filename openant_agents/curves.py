"""Learning curves as pictures."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from openant_agents.runs import CurvePoint
from openant_env.metrics import WINDOW_S
from openant_tools.errors import BadInput
from openant_tools.files import write_bytes

__all__ = ["plot_curves"]

#: Okabe–Ito
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def plot_curves(
    curves: Mapping[str, Sequence[CurvePoint]], file: Path, *, learning_from_s: float | None = None
) -> None:
    """Draw average reward per second against robot time.

    Args:
        curves: name → points.
        file: PNG, PDF or SVG by its ending.
        learning_from_s: s of robot time at which updates began, marked by a dotted line.

    Raises:
        BadInput: there is nothing to draw.
        OSError: the file cannot be written.
    """
    if not any(len(points) for points in curves.values()):
        raise BadInput("the learning curve has no points yet", where=file, remedy="train a little longer")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for (name, points), colour in zip(curves.items(), COLOURS * (1 + len(curves) // len(COLOURS)), strict=False):
        minutes = [point.seconds / 60.0 for point in points]
        axes.plot(minutes, [100.0 * point.average_reward_m_s for point in points], color=colour, label=name)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    if learning_from_s is not None:
        axes.axvline(learning_from_s / 60.0, color="0.4", linewidth=1.0, linestyle=":")
        axes.annotate(
            "learning starts", (learning_from_s / 60.0, 1.0), xycoords=("data", "axes fraction"), xytext=(4, -12),
            textcoords="offset points", color="0.3", fontsize=9,
        )  # fmt: skip
    axes.set_xlabel("robot time (min)")
    axes.set_ylabel(f"average reward over {WINDOW_S:.0f} s (cm/s)")
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if len(curves) > 1:
        axes.legend(frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format=file.suffix.lstrip(".") or "png", dpi=150)
    write_bytes(file, picture.getvalue())
