"""The report of a scored set, and the page of the docs that the command writes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openant_tools.blind.score import Row, Score, truth_in_words
from openant_tools.blind.sizes import size_table
from openant_tools.files import write_bytes, write_text
from openant_tools.procedure.intervals import wilson
from openant_tools.report import KeyFigure, Report, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["score_report", "table_lines", "write_docs"]

_COLUMNS = ["what", "result", "95 %", "n", "first", "then", "reached"]


def _cells(row: Row) -> list[str]:
    def shown(value: float) -> str:
        return f"{value:.0f} s" if row.unit == "s" else f"{value:.2f}" if row.k is None else f"{100 * value:.0f} %"

    result = "–" if row.figure is None else shown(row.figure)
    interval = ""
    if row.k is not None and row.n:
        low, high = wilson(row.k, row.n)
        interval = f"{100 * low:.0f} … {100 * high:.0f} %"
    sign = "≤ " if row.fewer else ""
    return [row.words, result, interval, str(row.n), sign + shown(row.first), sign + shown(row.then), row.reached]


def _table(found: Score) -> list[list[str]]:
    rows = [_cells(row) for row in found.rows]
    if found.missing:
        rows.append(
            [
                "robots that have no verdict yet, left out",
                str(found.missing),
                "",
                str(found.robots),
                "",
                "",
                "",
            ]
        )
    return rows


def table_lines(found: Score) -> list[str]:
    """The table as Markdown."""
    lines = [f"| {' | '.join(_COLUMNS)} |", "|" + "---|" * len(_COLUMNS)]
    return lines + [f"| {' | '.join(row)} |" for row in _table(found)]


def _worst(found: Score) -> list[tuple[str, str, int]]:
    """The commonest confusions: truth, verdict, how often."""
    wrong = [
        (truth, verdict, count)
        for (truth, verdict), count in found.confusions.items()
        if truth != verdict and not (verdict in ("unexplained", "none") and truth not in _catalogue(found))
    ]
    return sorted(wrong, key=lambda one: (-one[2], one[0]))


def _catalogue(found: Score) -> set[str]:
    return {"none"} | {drawn.effect for case in found.cases for drawn in case.answer.effects}


def confusion(found: Score) -> MatplotlibFigure:
    """Truth against verdict, of medium and large single effects, healthy robots and those outside the catalogue."""
    figure: MatplotlibFigure
    truths = sorted({truth for truth, _ in found.confusions}, key=lambda name: (name not in _catalogue(found), name))
    verdicts = [name for name in truths if any(said == name for _, said in found.confusions)]
    verdicts += sorted({said for _, said in found.confusions} - set(truths))
    table = np.zeros((len(truths), len(verdicts)))
    for (truth, said), count in found.confusions.items():
        table[truths.index(truth), verdicts.index(said)] = count
    share = table / table.sum(1, keepdims=True)
    figure, axes = plots.figure(height=1.8 + 0.19 * len(truths))
    image = axes.imshow(share, cmap="cividis", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(verdicts)), verdicts, rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), truths, fontsize=7)
    axes.grid(False)
    for row, column in np.argwhere(table):
        dark = share[row, column] < 0.5
        axes.text(
            column,
            row,
            f"{table[row, column]:.0f}",
            ha="center",
            va="center",
            fontsize=6,
            color="white" if dark else "black",
        )
    axes.set_xlabel("verdict (–)")
    axes.set_ylabel("truth (–)")
    figure.colorbar(image, ax=axes, label="share of the robots of this truth (–)")
    return figure


def reliability(found: Score) -> MatplotlibFigure:
    """Stated probability against how often the effect was there, with Wilson intervals."""
    figure: MatplotlibFigure
    figure, axes = plots.figure(height=3.2, width=5.0)
    axes.plot([0, 1], [0, 1], color=plots.INK, lw=0.8, alpha=0.6, label="ideal")
    for _, _, stated, present, count in found.reliability:
        low, high = wilson(round(present * count), count)
        axes.plot([stated, stated], [low, high], color=plots.BLUE, lw=1.0)
        axes.annotate(
            f"{count}", (stated, max(high, present)), textcoords="offset points", xytext=(0, 5), ha="center", fontsize=7
        )
    axes.plot(
        [one[2] for one in found.reliability],
        [one[3] for one in found.reliability],
        "o",
        color=plots.BLUE,
        label="seen",
    )
    axes.set_xlim(-0.02, 1.02)
    axes.set_ylim(-0.03, 1.12)
    axes.set_xlabel("stated probability (–)")
    axes.set_ylabel("share present (–)")
    plots.legend(axes)
    return figure


def _failures(found: Score) -> list[list[str]]:
    rows = []
    for case in found.failures:
        said = case.verdict
        if case.said.get("error"):
            said = f"refused: {case.said['error']}"
        elif case.said.get("ambiguous_with"):
            said += f" ({'; '.join(' = '.join(one) for one in case.said['ambiguous_with'])})"
        rows.append([case.robot, truth_in_words(case), said, ", ".join(case.order[:3])])
    return rows


def _origin(found: Score) -> str:
    whole = f", those judged so far of {found.robots}" if found.missing else ""
    virtual = sum(case.answer.maker == "virtual" for case in found.cases)
    bus = f" {virtual} came from the virtual robot's bus." if virtual else ""
    return f"{len(found.cases)} robots{whole}, {'; and '.join(map(_seed, found.sets))}.{bus}"


def _seed(facts: Mapping[str, Any]) -> str:
    seed = f"seed {facts['seed']}"
    if "seed_from_commit" in facts:
        seed += f" (the first 8 digits of commit `{facts['seed_from_commit']}`)"
    return f"{seed}, commitment of the answers `{facts['commitment']}`"


def _drawn(found: Score) -> list[str]:
    groups = [case.answer.group for case in found.cases]
    healthy, outside, two = (groups.count(name) for name in ("none", "outside", "two"))
    return [
        f"**What is drawn.** Of {len(groups)} robots {healthy} are healthy, {outside} have what the catalogue has no name for,",
        f"{two} have two effects, the others one: every effect in turn, at a random joint or scope, small, medium or large. Every",
        "other parameter lies somewhere within the tolerance of the catalogue, partly alike for all joints. Every second robot has a",
        "tracker.",
    ]


def score_report(found: Score) -> Report:
    """Everything about how the diagnosis did."""
    report = Report("The blind benchmark", _origin(found), made_by="openant gap blind score")
    marks = [row for row in found.rows if row.figure is not None]
    report.key_figures(
        *(KeyFigure(row.words, _cells(row)[1], f"asked: {_cells(row)[4]}") for row in marks[:3]),
    )
    report.section("Table").table(_COLUMNS, _table(found))
    report.section("Confusions").figure(confusion(found), "How often which verdict was given, by what was true.")
    report.section("Probabilities").figure(
        reliability(found), "Every effect of every diagnosis; figures are counts, lines 95 % intervals."
    )
    report.section("Every failure").table(["robot", "truth", "verdict", "ranked"], _failures(found))
    return report


def write_docs(found: Score, path: Path) -> None:
    """Write the page of the docs, and its two pictures into `pictures/` beside it."""
    pictures = path.parent / "pictures"
    for name, figure in (("blind-confusion", confusion(found)), ("blind-reliability", reliability(found))):
        figure.set_facecolor("white")
        write_bytes(pictures / f"{name}.png", plots.as_png(figure, dpi=110))
    relative = os.path.relpath(pictures, path.parent)
    worst = _worst(found)[:3]
    lines = [
        "# The blind benchmark", "",
        "<!-- Written by `openant gap blind score SET… --docs docs/blind.md`: do not edit. -->", "",
        "Robots that nobody chose, simulated by other code than the diagnosis uses, judged before the answers are opened.", "",
        "```sh", *_COMMANDS, "```", "", *_drawn(found), "", *_HOW, "", "## Result", "", _origin(found), "", *table_lines(found), "",
    ]  # fmt: skip
    if worst:
        lines += ["Commonest confusions: " + "; ".join(f"{a} taken for {b} ({n})" for a, b, n in worst) + ".", ""]
    lines += [
        f"![Truth against verdict]({relative}/blind-confusion.png)", "",
        f"![Stated probability against frequency]({relative}/blind-reliability.png)", "",
        "## Every failure", "", "| robot | truth | verdict | ranked |", "|---|---|---|---|",
        *(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in _failures(found)), "",
        "## Sizes", "", "Drawn evenly between the two figures of each size. " + _SCOPES, "", size_table(), "",
    ]  # fmt: skip
    write_text(path, "\n".join(lines))


_COMMANDS = (
    "openant gap blind make --out SET --robots 240 --seed-from COMMIT --key-file KEY    # answers sealed",
    "openant gap blind run SET --jobs 2                                                 # or --backend dask, ray",
    "openant gap blind score SET… --key-file KEY… --docs docs/blind.md                  # opens the answers",
)
_SCOPES = "Scopes: one joint (j), the servos of one model (g), all joints (a), the body (b)."
_HOW = (
    "**What they do.** Three runs on the stand and four on the floor of about 9 s each, one table of commands for all, 50 rows a",
    "second; the last run of either is held out. Rows scatter by up to 0.6 ms, stamps by up to 0.3 ms.",
    "",
    "**How truth is simulated**, by two makers, both of other code than the candidates' (a rule of the linter keeps it so).",
    "",
    "- A simulator of many robots at once (`blind/simulate.py`): half a millisecond, Euler or implicit, elliptic cones with an",
    "  impratio from 1 to 30 or (15 %) pyramidal ones, masses and lengths a little off; firmware at 1 kHz on the quantised",
    "  encoder, rotors behind gears with play and spring, LuGre friction, one supply, heat.",
    "- The virtual robot (`blind/through_bus.py`): its servos' firmware, its physics, real packets in their real time on the wire.",
    "  Half of the robots whose effect it can have in the catalogue's form. There a command comes before its row's samples.",
    "",
    "**How it is counted.** A right name is the verdict itself; `ambiguous` is right of small effects only. A small effect may be",
    "called none where its size lies within 2.5 times a tolerance that the catalogue states. Any verdict but none is a false alarm",
    "on a healthy robot. A diagnosis that is refused counts as wrong.",
    "",
    "**Over machines.** `pip install 'openant-tools[dask]'` and `dask worker` on each, `dask scheduler` on one, then",
    "`openant gap blind run SET --backend dask --scheduler tcp://HOST:8786`; all see SET under the same path. What was stopped goes",
    "on where it was.",
)
