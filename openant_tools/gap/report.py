"""The report of a diagnosis: one page that is read in a minute, then the details."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from openant_tools.effects.catalogue import catalogue
from openant_tools.effects.robot import Robot
from openant_tools.gap.apply import robot_of
from openant_tools.gap.diagnosis import AMBIGUOUS, NONE, UNEXPLAINED, Diagnosis
from openant_tools.gap.nuisance import AMOUNTS
from openant_tools.gap.regime import Regime
from openant_tools.gap.simulation import simulate
from openant_tools.gap.words import (
    LEAST_SHARE,
    SIGNALS,
    closed,
    closing,
    rest_words,
    restart_words,
    sentence,
    sizes,
    standing,
    what_next,
    where_words,
)
from openant_tools.model.gap import HORIZON_S
from openant_tools.model.of_run import plants_of
from openant_tools.model.rollout import Rollouts
from openant_tools.numbers import number, percent
from openant_tools.recording.run import Run
from openant_tools.report import Figure, KeyFigure, Report, ReportSummary, Table, plots
from openant_tools.robot.joints import JOINTS
from openant_tools.sysid.identify import joints_in_common
from openant_tools.sysid.kinds import said

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["diagnosis_report"]

Array = NDArray[np.float64]

#: s shown around the worst moment
WINDOW_S = 3.0
#: candidates, runners-up and places on the first page
CANDIDATES, RUNNERS_UP, PLACES = 6, 3, 8


def diagnosis_report(found: Diagnosis, runs: Sequence[Run], held_out: Sequence[Run], model: Path) -> Report:
    """Everything about a diagnosis.

    Args:
        runs, held_out: those that were diagnosed. model: the MJCF.
    """
    gap, share = found.gap, closed(found)
    healthy = found.verdict == NONE
    improved = bool(found.selected or found.calibration)
    left = f" {rest_words(found)}" if found.rest and found.verdict != UNEXPLAINED else ""  # there the verdict says it
    answer = ReportSummary(
        sentence(found),
        Figure(
            worst(found, held_out or runs, model),
            f"Measured and simulated around the moment of {'the held-out runs' if held_out else 'all runs'} at which the given "
            f"model is farthest off. {restart_words(HORIZON_S)}.",
        ),
        _meaning(found) + left,
        what_next(found),
        "good" if healthy or share > 0.7 else "warn",
        (
            KeyFigure("gap before" if improved else "gap", _error(gap["before"]), "the model as given"),
            *([KeyFigure("gap after", _error(gap["after"]), "the improved model")] if improved else []),
            KeyFigure("floor", _error(gap["floor"]), "what no model could beat"),
            *(
                [KeyFigure("closed", closing(share), "of the gap above the floor, on held-out runs")]
                if improved
                else []
            ),
        ),
    )
    report = Report(
        "Diagnosis of the gap", f"{model.name} · {', '.join(run.name for run in (*runs, *held_out))}", answer,
        made_by="openant gap diagnose",
    )  # fmt: skip
    if found.where:
        report.section("Where it lies").figure(
            places(found),
            "At which joint the given model is off, and while the joint does what; largest part first, and what the improved "
            "model leaves of it."
            + (" From above: each joint as large as its part, chosen ones ringed." if _of_ant(found) else ""),
        )
    runners_up = [one for one in found.effects if one.effect not in found.selected][:RUNNERS_UP]
    if runners_up:
        report.section("Why not something else", open=True).table(
            ["effect", "why not", "where", "how likely", "closes by itself"],
            [
                [one.effect, standing(found, one), where_words(one.joints), percent(one.probability), _closing(one.gap_closed)]
                for one in runners_up
            ],
        )  # fmt: skip
    if found.sensors:
        _sensors(report, found)
    _details(report, found)
    return report


def _meaning(found: Diagnosis) -> str:
    """What the verdict is good for."""
    if found.verdict == NONE:
        return "The simulation is as close to this robot as another robot of its build would be."
    if found.verdict == AMBIGUOUS:
        return "Do not put one of these causes into the model for good yet: another experiment decides first."
    if found.verdict == UNEXPLAINED:
        return "A policy that is trained in this simulation meets a robot that moves differently; do not put a cause into the model by guess."
    if catalogue()[found.verdict].random:
        return "What befalls commands by chance, no simulation repeats: a policy has to stand it, and is best trained with as much of it."
    return "With this in the model the simulation moves as the robot does, but for what is left of the gap."


def _error(rad: float) -> str:
    return number(rad, "rad", name="gap")


def _details(report: Report, found: Diagnosis) -> None:
    report.section("Details")
    if found.removal:
        rows = [[name, closing(value)] for name, value in found.removal.items()]
        report.details(
            "What each effect of the improved model is worth", Table(["effect", "closes less without it"], rows)
        )
    report.figure(
        candidates(found),
        "How likely this robot has each effect, beyond what robots of one build differ by, and how much of the gap it closes by "
        "itself; those with a star are in the improved model.",
    )
    report.details(
        "All effects considered",
        Table(
            ["effect", "where", "how likely", "closes by itself", "interval", "size", "MuJoCo carries it"],
            [
                [one.effect, where_words(one.joints), percent(one.probability, decimals=1), _closing(one.gap_closed),
                 _between(one.gap_closed_low, one.gap_closed_high), sizes(one), one.native]
                for one in found.effects
            ],
        ),
    )  # fmt: skip
    if found.where:
        report.details("Where the gap lies, all of it", _all_places(found))
    if found.calibration:
        moved = [
            [
                said(kind.removesuffix("_kg")),
                joint,
                number(value, AMOUNTS[kind], sign=True) if kind in AMOUNTS else f"× {number(value)}",
            ]
            for kind, values in found.calibration.items()
            for joint, value in values.items()
        ]
        report.details(
            "What moved as far as robots of one build differ", Table(["quantity", "joint", "factor or amount"], moved)
        )
    if found.notes:
        report.text("\n".join(f"- {note}" for note in found.notes))


def _all_places(found: Diagnosis) -> Table:
    rows = [
        [SIGNALS[place["signal"]], place["joint"], Regime(place["regime"]).words, percent(place["share"], decimals=1),
         percent(after, decimals=1) if (after := place.get("share_after")) is not None else None]
        for place in found.where
    ]  # fmt: skip
    return Table(["signal", "joint", "while", "share", "left by the improved model"], rows)


def _sensors(report: Report, found: Diagnosis) -> None:
    report.section("Sensors")
    names = [plots.SIGNAL_LABELS.get(one["signal"], (one["signal"].upper(),))[0] for one in found.sensors]
    if all(one["used"] and one["finding"] == "as_modelled" for one in found.sensors):
        report.text(f"All signals behave as modelled, and all were used for the verdict: {', '.join(names)}.")
        return
    known = {"as_modelled": "as modelled", "unknown_form": "like none that is known"}
    rows = [
        [
            name,
            where_words(_joints(one["joints"])),
            known.get(one["finding"], one["finding"]),
            "yes" if one["used"] else "no",
        ]
        for name, one in zip(names, found.sensors, strict=True)
    ]
    report.table(["signal", "of", "finding", "used for the verdict"], rows)


def _of_ant(found: Diagnosis) -> bool:
    return any(place["joint"] in JOINTS for place in found.where)


def places(found: Diagnosis) -> MatplotlibFigure:
    """A bar of shares, and the robot from above where it has legs."""
    figure: MatplotlibFigure
    largest = [place for place in found.where if float(place["share"]) >= LEAST_SHARE][:PLACES] or list(found.where[:1])
    height_in = 0.8 + 0.36 * len(largest)
    if _of_ant(found):
        figure, (axes, legs) = plots.figure(1, 2, height=max(3.0, height_in), width_ratios=[3, 2])
        _leg_map(legs, found)
    else:
        figure, axes = plots.figure(height=height_in)
    labels = [f"{place['joint']} ({SIGNALS[place['signal']]})\n{Regime(place['regime']).words}" for place in largest]
    before = [100 * float(place["share"]) for place in largest]
    after = [place.get("share_after") for place in largest]
    known = any(share is not None for share in after)
    at, height = np.arange(len(largest)), 0.36 if known else 0.8
    axes.barh(at - (0.19 if known else 0.0), before, height, color=plots.BLUE, label="before")
    if known:
        axes.barh(at + 0.19, [100 * float(share or 0.0) for share in after], height, color=plots.GREEN, label="after")
        plots.legend(axes)
    axes.set_yticks(at, labels)
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("share of the error before (%)")
    return figure


def _leg_map(axes: Axes, found: Diagnosis) -> None:
    """The Ant from above, each joint as large as its share of the position gap; chosen ones ringed."""
    share = dict.fromkeys(JOINTS, 0.0)
    for place in found.where:
        if place["signal"] == "pos" and place["joint"] in share:
            share[str(place["joint"])] += float(place["share"])
    named = {
        joint
        for one in found.effects
        if one.effect in found.selected and not isinstance(one.joints, str)
        for joint in one.joints
    }
    for leg, (along, left) in {"fr": (1, -1), "fl": (1, 1), "rr": (-1, -1), "rl": (-1, 1)}.items():
        # To the left of the robot is to the left of the picture, so its y points the other way.
        axes.plot(
            [0, -2.6 * left], [0, 2.6 * along], color=plots.INK, alpha=0.35, lw=3, solid_capstyle="round", zorder=1
        )
        for name, far in ((f"hip_{leg}", 1.0), (f"knee_{leg}", 2.0)):
            x, y = -far * left, far * along
            edge = plots.VERMILLION if name in named else plots.INK
            axes.scatter(
                [x], [y], s=25 + 400 * share[name], color=plots.ORANGE, edgecolor=edge,
                linewidth=2.0 if name in named else 0.6, zorder=2,
            )  # fmt: skip
            axes.annotate(
                f"{name}\n{percent(share[name])}", (x, y), xytext=(-left * (6 + 10 * math.sqrt(share[name])), 0), textcoords="offset points",
                ha="right" if left > 0 else "left", va="top" if along > 0 else "bottom", fontsize=7,
            )  # fmt: skip
    axes.scatter([0], [0], s=500, color=plots.INK, alpha=0.25, zorder=1)
    axes.set_xlim(-4.6, 4.6)
    axes.set_ylim(-3.0, 3.0)
    axes.set_aspect("equal")
    axes.axis("off")
    axes.set_title("position, by joint (front is up)", loc="left", fontsize=10, fontweight="bold")


def candidates(found: Diagnosis) -> MatplotlibFigure:
    """Probability and closure of the first effects."""
    figure: MatplotlibFigure
    shown = found.effects[:CANDIDATES]
    figure, axes = plots.figure(height=0.8 + 0.34 * len(shown))
    at = np.arange(len(shown))
    axes.barh(at - 0.19, [100 * one.probability for one in shown], 0.36, color=plots.BLUE, label="how likely")
    alone = [math.nan if one.gap_closed is None else 100 * max(one.gap_closed, 0.0) for one in shown]
    axes.barh(at + 0.19, alone, 0.36, color=plots.GREEN, label="closes by itself")
    for k, one in enumerate(shown):
        if one.gap_closed_low is not None and one.gap_closed_high is not None:
            ends = [100 * max(one.gap_closed_low, 0.0), 100 * max(one.gap_closed_high, 0.0)]
            axes.plot(ends, [k + 0.19] * 2, color=plots.INK, lw=1.2)
    marked = [f"{one.effect}{' *' if one.effect in found.selected else ''}" for one in shown]
    axes.set_yticks(at, marked)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("probability, and share of the gap closed on held-out runs (%)")
    plots.legend(axes)
    return figure


def worst(found: Diagnosis, runs: Sequence[Run], model: Path) -> MatplotlibFigure:
    """Around the largest error of the given model: measured, given, improved."""
    figure: MatplotlibFigure
    joints = joints_in_common(runs, model, None)
    selected = [one for one in found.effects if one.effect in found.selected and (one.parameters or one.coordinates)]
    best: tuple[float, Run, int, int, Array] | None = None
    for run, plant in zip(runs, plants_of(runs, model, joints), strict=True):
        improved = robot_of(plant, selected, found.calibration)
        # Each is led by itself to where a window begins.
        leads = (Robot(len(joints), creeps=True), None), (improved, improved.model(plant))
        both = np.concatenate(
            [
                simulate(Rollouts(plant, [run], HORIZON_S, leader=leader), [robot], signals=["pos"]).signals["pos"]
                for robot, leader in leads
            ]
        ).astype(np.float64)
        error = np.abs(np.nan_to_num(run.signal("pos", joints) - both[0]))
        row, j = divmod(int(error.argmax()), len(joints))
        if best is None or error[row, j] > best[0]:
            best = float(error[row, j]), run, row, j, both
    assert best is not None
    _, run, row, j, both = best
    t = run.t
    near = np.abs(t - t[row]) <= WINDOW_S / 2
    figure, (above, below) = plots.figure(2, 1, height=1.8, sharex=True)
    improved_too = both[1][near, j] if selected or found.calibration else None
    plots.draw_tracking(
        above, below, joints[j], t[near] - t[0], run.signal("cmd", joints)[near, j], run.signal("pos", joints)[near, j],
        both[0][near, j], improved_too, names=("given model", "improved model"), title=run.name,
    )  # fmt: skip
    return figure


def _joints(words: str | Sequence[str]) -> tuple[str, ...] | str:
    return words if isinstance(words, str) else tuple(words)


def _closing(value: float | None) -> str | None:
    return None if value is None else closing(value)


def _between(low: float | None, high: float | None) -> str | None:
    return None if low is None or high is None else f"{closing(low)} … {closing(high)}"
