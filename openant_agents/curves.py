"""Learning curves as pictures, of one run or of several seeds together."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openant_agents.drops import Drop, find_drops
from openant_agents.interventions import Intervention, read_interventions
from openant_agents.runs import CurvePoint, read_curve, read_facts
from openant_env.metrics import WINDOW_S
from openant_tools.errors import BadInput
from openant_tools.files import write_bytes
from openant_tools.numbers import exact

__all__ = ["Band", "RunCurve", "band", "group_runs", "plot_curves", "plot_groups", "read_run_curve"]

#: Okabe–Ito
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RunCurve:
    """The learning curve of one run with what happened along it.

    Attributes:
        folder: the run's.
        facts: what its `run.json` says.
        points: of the curve, average reward over 120 s.
        interventions: where the robot had to be set up again, or someone paused it.
        drops: where the average reward fell to nearly nothing.
    """

    folder: Path
    facts: Mapping[str, Any]
    points: Sequence[CurvePoint]
    interventions: Sequence[Intervention]
    drops: Sequence[Drop]

    @property
    def minutes(self) -> Array:
        return np.array([point.seconds / 60.0 for point in self.points])

    @property
    def speed(self) -> Array:
        """cm/s."""
        return np.array([100.0 * point.average_reward_m_s for point in self.points])


@dataclass(frozen=True)
class Band:
    """Mean and standard error over runs, at the same robot times.

    Attributes:
        minutes: (points,), as far as the shortest run goes.
        mean, error: (points,), cm/s: mean over runs, and its standard error s/√n (0 of a single run).
        runs: n.
    """

    minutes: Array
    mean: Array
    error: Array
    runs: int


def read_run_curve(folder: Path) -> RunCurve:
    """A run's learning curve.

    Raises:
        BadInput: no run, or no curve in it yet.
    """
    points = read_curve(folder)
    if not points:
        raise BadInput("the learning curve has no points yet", where=folder, remedy="train a little longer")
    return RunCurve(folder, read_facts(folder), points, read_interventions(folder), find_drops(points))


def band(curves: Sequence[RunCurve]) -> Band:
    """Runs as one: each is read between its points at the times of the one with the fewest points."""
    shortest = min(curve.minutes[-1] for curve in curves)
    latest_start = max(curve.minutes[0] for curve in curves)
    grid = min((curve.minutes for curve in curves), key=len)
    grid = grid[(grid >= latest_start - 1e-9) & (grid <= shortest + 1e-9)]
    if not len(grid):
        raise BadInput("these runs have no time in common", remedy="plot them apart, or train the shorter ones on")
    values = np.array([np.interp(grid, curve.minutes, curve.speed) for curve in curves])
    n = len(curves)
    error = values.std(axis=0, ddof=1) / math.sqrt(n) if n > 1 else np.zeros(len(grid))
    return Band(grid, values.mean(axis=0), error, n)


def group_runs(curves: Sequence[RunCurve]) -> dict[str, list[RunCurve]]:
    """Runs that differ in nothing but the seed belong together; a group is named by its agent and by what sets it apart
    from the other runs of that agent."""
    members: dict[tuple[tuple[str, str], ...], list[RunCurve]] = {}
    for curve in curves:
        members.setdefault(tuple(sorted(_but_the_seed(curve.facts).items())), []).append(curve)
    groups: dict[str, list[RunCurve]] = {}
    for key, together in members.items():
        facts = dict(key)
        alike = [dict(other) for other in members if dict(other).get("agent") == facts.get("agent")]
        differing = sorted({name for other in alike for name in other if len({o.get(name) for o in alike}) > 1})
        # What follows from another fact, such as a model's hash from its robot, says nothing new.
        shown = [name for name in differing if not name.startswith("trained_on.")] or differing
        parts = [
            facts.get("agent", "agent").strip('"'),
            *(_words(name, facts[name]) for name in shown if name in facts),
        ]
        name = ", ".join(parts)
        groups[name if name not in groups else f"{name} ({together[0].folder.name})"] = together
    return groups


def _but_the_seed(facts: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    flat: dict[str, str] = {}
    for key, value in facts.items():
        if key in ("seed", "versions"):
            continue
        if isinstance(value, Mapping):
            flat.update(_but_the_seed(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = json.dumps(value)
    return flat


def _words(name: str, value: str) -> str:
    text = value.strip('"')
    return f"{name.split('.')[-1].replace('_', ' ')} {text if len(text) <= 24 else text[:23] + '…'}"


def plot_groups(groups: Mapping[str, Sequence[RunCurve]], file: Path, *, singly: bool = False) -> None:
    """Draw groups of runs: mean and ± 3 standard errors of the mean, as the paper's figures have it.

    Args:
        groups: name → runs. A group of one run is drawn as a line, with its interventions as circles and where its
            reward dropped as a triangle.
        file: PNG, PDF or SVG by its ending.
        singly: also each run of a group, thin, with its interventions and drops.

    Raises:
        BadInput: there is nothing to draw.
        OSError: the file cannot be written.
    """
    if not groups:
        raise BadInput("there is nothing to draw", where=file, remedy="name runs")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    seen: set[str] = set()
    for (name, curves), colour in zip(groups.items(), COLOURS * (1 + len(groups) // len(COLOURS)), strict=False):
        together = band(curves)
        seeds = f" ({together.runs} seeds)" if together.runs > 1 else ""
        axes.plot(together.minutes, together.mean, color=colour, linewidth=2.0, label=name + seeds)
        if together.runs > 1:
            low, high = together.mean - 3.0 * together.error, together.mean + 3.0 * together.error
            axes.fill_between(together.minutes, low, high, color=colour, alpha=0.18, linewidth=0.0)
        for curve in curves if singly or together.runs == 1 else ():
            if together.runs > 1:
                axes.plot(curve.minutes, curve.speed, color=colour, linewidth=0.7, alpha=0.6)
            _mark(axes, curve, colour, seen)
    _label(axes)
    axes.legend(
        frameon=False,
        loc="upper left",
        title="mean ± 3 standard errors" if any(len(c) > 1 for c in groups.values()) else None,
    )
    _write(figure, file)


def _mark(axes: Any, curve: RunCurve, colour: str, seen: set[str]) -> None:
    """Interventions and drops on a run's curve, each named once in the legend."""
    for label, marker, times in (
        ("intervention", "o", [event.seconds / 60.0 for event in curve.interventions]),
        ("reward drop", "v", [drop.from_s / 60.0 for drop in curve.drops]),
    ):
        if times:
            axes.plot(
                times, np.interp(times, curve.minutes, curve.speed), linestyle="", marker=marker, markersize=6,
                markerfacecolor="white", markeredgecolor=colour, label=None if label in seen else label,
            )  # fmt: skip
            seen.add(label)


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
    if learning_from_s is not None:
        axes.axvline(learning_from_s / 60.0, color="0.4", linewidth=1.0, linestyle=":")
        axes.annotate(
            "learning starts", (learning_from_s / 60.0, 1.0), xycoords=("data", "axes fraction"), xytext=(4, -12),
            textcoords="offset points", color="0.3", fontsize=9,
        )  # fmt: skip
    _label(axes)
    if len(curves) > 1:
        axes.legend(frameon=False)
    _write(figure, file)


def _label(axes: Any) -> None:
    """Names, units and a quiet grid."""
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set_xlabel("robot time (min)")
    axes.set_ylabel(f"average reward over {exact(WINDOW_S, 's')} (cm/s)")
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _write(figure: Any, file: Path) -> None:
    kind = file.suffix.lstrip(".").lower() or "png"
    if kind not in figure.canvas.get_supported_filetypes():
        raise BadInput(
            f"pictures of the kind .{kind} cannot be written", where=file, remedy="name it .png, .pdf or .svg"
        )
    picture = io.BytesIO()
    figure.savefig(picture, format=file.suffix.lstrip(".") or "png", dpi=150)
    write_bytes(file, picture.getvalue())
