"""The report of a fit: first the figure that matters, then what was found, then how it looks joint by joint."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from openant_tools.model.gap import HORIZON_S, gap, share_closed
from openant_tools.model.rollout import Rollouts
from openant_tools.numbers import exact, number, percent, span
from openant_tools.recording.run import Run
from openant_tools.report import Figure, KeyFigure, Mark, Report, ReportSummary, plots
from openant_tools.report.parts import Tone
from openant_tools.sysid.data_sheet import data_sheet_model
from openant_tools.sysid.dataset import Dataset
from openant_tools.sysid.identify import Identification, Value
from openant_tools.sysid.kinds import said

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["fit_report"]

Array = NDArray[np.float64]

#: horizons at which the error is shown, s; the full run comes last
HORIZONS_S = (0.1, 0.2, 0.5, 1.0, 2.0)
#: correlations beyond this are worth a line
STRONG = 0.7
#: and so many of them are shown
STRONGEST = 12
#: seconds shown around the worst moment of a joint
WINDOW_S = 3.0

_TONE: dict[str, Tone] = {
    "identified": "good",
    "weak": "warn",
    "tied": "warn",
    "conflict": "warn",
    "not in the data": "",
    "fell back": "bad",
}

VERDICTS = """
- **identified**: the data gave most of the value; the interval is theirs.
- **weak**: between data and prior; more or other motion would settle it.
- **tied**: the data tell it only together with the other that is named; knowing one would settle both.
- **conflict**: the data are certain, and contradict what the given model says; the data's value is written.
- **not in the data**: the data say nothing about it; it stays at its prior.
- **fell back**: runs that the fit had not seen are followed better without it, or it may as well be none; the given value stays.
"""


def fit_report(result: Identification) -> Report:
    """Everything a reader needs to decide whether to use the calibrated model."""
    closed = share_closed(result.before.full, result.after.full, result.floor)
    moments = [moment for data in result.held_out for moment in _moments(result, data)]
    worst = max(moments, key=lambda moment: moment.before)
    wanted: dict[str, list[str]] = {}
    for value in result.values:
        if value.record_next:
            wanted.setdefault(value.record_next, []).append(f"{said(value.name)} ({value.words})")
    answer = ReportSummary(
        _sentence(result),
        Figure(
            worst.figure,
            f"Held-out run {worst.run}, {worst.joint}, around the moment at which the given model is worst.",
        ),
        f"{_changes(result)} Held-out runs had no part in the fit; what two plays of one motion differ by, no model can beat."
        if not result.in_turn
        else f"{_changes(result)} Each run was judged by a model that was fitted without it.",
        _then(result, wanted),
        "bad" if not result.accepted else "good" if closed > 0.5 else "warn",
        (
            KeyFigure("held-out error, full run", _change(result.before.full, result.after.full), "given → calibrated"),
            KeyFigure(
                f"held-out error, {exact(HORIZON_S, 's')}",
                _change(result.before.horizon, result.after.horizon),
                "begun anew from what was measured each time",
            ),
            KeyFigure("floor", _error(result.floor), "what no model could beat"),
            KeyFigure("gap closed", percent(closed) if math.isfinite(closed) else "–", "of what is above the floor"),
        ),
    )
    report = Report(
        "System identification", f"{result.model.name} · {', '.join(_names(result))}", answer, made_by="openant sysid fit",
        recordings=[run.path for data in result.datasets for run in data.runs if run.path],
    )  # fmt: skip
    report.section("What was found").table(
        ["parameter", "given", "value", "95 % interval", "verdict"], [_row(value) for value in result.values]
    )
    report.text(VERDICTS)
    for note in result.notes:
        report.text(note)
    if wanted:
        report.section("What to record next").table(
            ["protocol", "it would settle"], [[what, ", ".join(names)] for what, names in wanted.items()]
        )
    report.section("Measured against simulated, joint by joint")
    for moment in moments:
        report.details(
            f"{moment.joint}: {_change(moment.before, moment.after)} over full runs",
            Figure(moment.figure, f"{moment.run}, where the given model is worst."),
        )
    report.section("How far it looks ahead").figure(
        _error_against_horizon(result),
        "Root mean square error of joint positions on held-out runs, re-initialised from measurement every so often. "
        "The model is better where its line is lower; a full run never re-initialises. Where the runs name their servos, the "
        "third line is the given model with what their data sheet and registers say of stiffness, damping and torque limit.",
    )
    _correlations(report, result)
    report.section("How it was judged").text(
        "The gap is the root mean square of measured minus simulated position over all joints and samples. Simulations start from "
        f"the measured state and play the run's own commands. {_judged(result)}"
    )
    report.table(
        ["joint", "residual", "it remembers itself for"],
        [[j, _error(result.noise[j]), number(result.correlation_s[j], "s")] for j in result.joints],
    )
    return report


def _then(result: Identification, wanted: dict[str, list[str]]) -> str:
    if not result.accepted:
        return "Ask what explains the error: `openant gap diagnose`" + (
            f"; and record {next(iter(wanted))}, which would settle more." if wanted else "."
        )
    more = f" To settle {', '.join(next(iter(wanted.values()))[:3])}, record {next(iter(wanted))}." if wanted else ""
    return f"Train on the calibrated model; what it does not explain, `openant gap diagnose` looks for.{more}"


def _correlations(report: Report, result: Identification) -> None:
    """Which values could trade against each other without the data minding."""
    if len(result.values) < 2:
        return
    deviation = np.sqrt(np.diag(result.covariance))
    correlation = result.covariance / np.outer(deviation, deviation)
    names = [said(value.name) for value in result.values]
    upper = np.argwhere(np.triu(np.abs(correlation) > STRONG, 1))
    pairs = sorted(upper.tolist(), key=lambda pair: -abs(correlation[pair[0], pair[1]]))[:STRONGEST]
    if not pairs:
        return
    report.section("Values that go together").table(
        ["value", "goes with", "correlation"],
        [[names[a], names[b], number(correlation[a, b], sign=True, decimals=2)] for a, b in pairs],
        "The errors of two values go together: the data fix a combination of the two better than either.",
    )


def _judged(result: Identification) -> str:
    folds = "; ".join(", ".join(names) for names in result.folds)
    chosen = f"What is kept was chosen by folds within the fitted runs, each followed by a fit to the others: {folds}."
    if not result.in_turn:
        return f"{chosen} Held-out runs judged it once, and had no part in it: {', '.join(result.judged_on)}."
    turns = "; ".join(", ".join(turn.runs) for turn in result.turns)
    return (
        f"{chosen} Judged was by the same runs in turn, nested: without each the fit was made and what is kept was chosen anew, and "
        f"that model followed it: {turns}. The figures are of those models, not of the written one, which has seen all."
    )


def _names(result: Identification) -> list[str]:
    return [run.name for data in result.datasets for run in data.runs]


def _sentence(result: Identification) -> str:
    if not result.accepted:
        return "Nothing that was fitted beats the given model on held-out runs, so the model is returned as it was."
    return f"The calibrated model leaves {percent(result.after.full / result.before.full)} of the given model's error on held-out runs."


def _changes(result: Identification) -> str:
    kinds = dict.fromkeys(said(name.partition(".")[0]) for name in result.accepted)
    return f"It changes {', '.join(kinds)}." if kinds else "Every value stays as it was given."


def _change(before: float, after: float) -> str:
    return f"{_error(before).removesuffix(' mrad')} → {_error(after)}"


def _error(rad: float) -> str:
    return number(rad, "rad", name="error")


def _row(value: Value) -> list[object]:
    interval = "–" if value.low is None or value.high is None else span(value.low, value.high, value.unit)
    mark = Mark(value.words, _TONE[value.verdict])
    return [said(value.name), number(value.given, value.unit), number(value.value, value.unit), interval, mark]


def _error_against_horizon(result: Identification) -> MatplotlibFigure:
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=2.8)
    given, calibrated = [], []
    sheets = [data_sheet_model(data.plant, data.runs) for data in result.held_out]
    by_sheet: list[float] = []
    none = np.zeros(0)
    longest = max(run.duration_s for data in result.held_out for run in data.runs)
    horizons = [horizon for horizon in HORIZONS_S if horizon < longest / 2]
    for horizon in [*horizons, None]:
        measured, before, after, sheet = [], [], [], []
        for k, data in enumerate(result.held_out):
            rollouts = Rollouts(data.plant, data.runs, horizon)
            pos = _simulated(result, data, rollouts)
            measured.append(data.measured)
            before.append(pos[0])
            after.append(pos[1])
            if (model := sheets[k]) is not None:
                # As the others: what robot.toml knows acts, and where the fit followed the logged supply, so does this.
                sold = replace(data, plant=replace(data.plant, model=model))
                sheet.append(sold.simulate((), [none], Rollouts(sold.plant, data.runs, horizon)).pos[0])
        truth = np.concatenate(measured)
        given.append(1e3 * gap(truth, np.concatenate(before)))
        calibrated.append(1e3 * gap(truth, np.concatenate(after)))
        if len(sheet) == len(sheets):
            by_sheet.append(1e3 * gap(truth, np.concatenate(sheet)))
    x = np.arange(len(given))
    with plots.style():
        axes.plot(x, given, "s--", label="given model")
        if by_sheet:
            axes.plot(x, by_sheet, "^-.", label="data sheet and registers")
        axes.plot(x, calibrated, "o-", label="calibrated model")
        axes.axhline(1e3 * result.floor, linestyle=":", color=plots.INK, label="floor")
        axes.set_xticks(x, [exact(horizon) for horizon in horizons] + ["full run"])
        axes.set_xlabel(plots.axis_label("re-initialised every", "s"))
        axes.set_ylabel(plots.axis_label("held-out error", "mrad"))
        axes.set_ylim(bottom=0)
    plots.legend(axes)
    return figure


def _simulated(result: Identification, data: Dataset, rollouts: Rollouts) -> Array:
    """(2, rows, joints): the given model and the calibrated one."""
    return data.simulate(result.parameters, [np.zeros(len(result.parameters)), result.u], rollouts).pos


@dataclass(frozen=True)
class _Moment:
    """The worst moment of the given model at one joint; the errors are over full runs, rad."""

    joint: str
    run: str
    before: float
    after: float
    figure: MatplotlibFigure


def _moments(result: Identification, data: Dataset) -> Sequence[_Moment]:
    """For each joint command, measured, and both simulations, with the error below."""
    pos = _simulated(result, data, data.full)
    moments = []
    for j, joint in enumerate(data.plant.joints):
        run, rows = _worst(data, data.measured[:, j] - pos[0, :, j])
        t = run.t[rows] - run.t[0]
        part = data.full.rows[data.runs.index(run)]
        at = np.arange(part.start, part.stop)[rows]
        measured, given, calibrated = data.measured[at, j], pos[0, at, j], pos[1, at, j]
        figure, (above, below) = plots.figure(2, 1, height=1.8, sharex=True)
        plots.draw_tracking(above, below, joint, t, run.column(f"cmd.{joint}")[rows], measured, given, calibrated)
        before, after = (gap(data.measured[:, j], pos[v, :, j]) for v in (0, 1))
        moments.append(_Moment(joint, run.name, before, after, figure))
    return moments


def _worst(data: Dataset, error: Array) -> tuple[Run, slice]:
    """The run and the rows of WINDOW_S in which the mean squared error is largest."""
    best: tuple[float, Run, slice] | None = None
    for run, part in zip(data.runs, data.full.rows, strict=True):
        squares = np.nan_to_num(error[part]) ** 2
        width = max(2, min(len(run.t), round(WINDOW_S / float(np.median(np.diff(run.t))))))
        total = np.convolve(squares, np.ones(width), "valid")
        k = int(np.argmax(total))
        if best is None or total[k] > best[0]:
            best = float(total[k]), run, slice(k, k + width)
    assert best is not None
    return best[1], best[2]
