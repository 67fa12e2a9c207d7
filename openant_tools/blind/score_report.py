"""The report of a scored set, and the page of the docs that the command writes."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openant_tools.blind.by_command import answer_for
from openant_tools.blind.draw import ELSEWHERE, OUTSIDE, Answer, Drawn
from openant_tools.blind.score import Row, Score, truth_in_words
from openant_tools.blind.sizes import size_table
from openant_tools.files import write_bytes, write_text
from openant_tools.numbers import number, percent, span
from openant_tools.procedure.intervals import wilson
from openant_tools.report import Figure, KeyFigure, Report, ReportSummary, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["score_report", "table_lines", "write_docs"]


def _shown(row: Row, value: float) -> str:
    if row.unit == "s":
        return number(value, "s", decimals=0)
    return number(value, decimals=2) if row.k is None else percent(value)


def _cell(row: Row) -> str:
    """A figure with its interval, and of how many."""
    if row.figure is None:
        return "–"
    interval = ""
    if row.k is not None:
        low, high = wilson(row.k, row.n)
        interval = f" ({span(100 * low, 100 * high, '%', decimals=0)})"
    return f"{_shown(row, row.figure)}{interval} of {row.n}"


def _asked(row: Row, mark: float) -> str:
    return ("≤ " if row.fewer else "") + _shown(row, mark)


def _columns(found: Score) -> list[str]:
    return ["what", *found.makers, "first", "then", "reached by all"]


def _table(found: Score) -> list[list[str]]:
    return [
        [rows[0].words, *map(_cell, rows), _asked(rows[0], rows[0].first), _asked(rows[0], rows[0].then), _reached(rows)]
        for rows in zip(*found.makers.values(), strict=True)
    ]  # fmt: skip


def _reached(rows: Sequence[Row]) -> str:
    """What the worst of the makers reaches, of those that measure it."""
    worst_first = ("below", "first", "then")
    reached = {row.reached for row in rows}
    return next((name for name in worst_first if name in reached), "not measured")


def table_lines(found: Score) -> list[str]:
    """The table as Markdown, a column for each maker."""
    columns = _columns(found)
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
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
            number(table[row, column], decimals=0),
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
    counts = Counter(case.maker for case in found.cases)
    by = ", ".join(f"{count} by {maker}" for maker, count in counts.items())
    return f"{len(found.cases)} robots{whole}, {'; and '.join(map(_seed, found.sets))}. Made: {by}."


def _seed(facts: Mapping[str, Any]) -> str:
    seed = f"seed {facts['seed']}"
    if "seed_from_commit" in facts:
        seed += f" (the first 8 digits of commit `{facts['seed_from_commit']}`)"
    left_out = len(facts.get("left_out", []))
    without = f" without {left_out} that their maker cannot have" if left_out else ""
    return f"{seed}{without}, commitment of the answers `{facts['commitment']}`"


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
    rows = [row for mine in found.makers.values() for row in mine]
    below = list(dict.fromkeys(row.words for row in rows if row.reached == "below"))
    worst = "; ".join(f"{truth} taken for {said} ({count} times)" for truth, said, count in _worst(found)[:3])
    answer = ReportSummary(
        f"Below what is asked for first: {', '.join(below)}."
        if below
        else "Every figure reaches what is asked for first.",
        Figure(confusion(found), "How often which verdict was given, by what was true."),
        f"{len(found.failures)} of {len(found.cases)} robots were judged wrongly" + (f"; {worst}." if worst else "."),
        "Look at every failure below, and ask the diagnosis for its evidence: `openant gap diagnose` on that robot's runs.",
        "bad" if below else "good",
        [
            KeyFigure(f"{row.words}: {maker}", _shown(row, value), f"asked: {_asked(row, row.first)}")
            for maker, mine in found.makers.items()
            for row in [row for row in mine if row.figure is not None][:3]
            if (value := row.figure) is not None
        ],
    )
    report = Report("The blind benchmark", _origin(found), answer, made_by="openant gap blind score")
    report.section("Table").table(_columns(found), _table(found))
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
        "```sh elsewhere", *_COMMANDS, "```", "", *_drawn(found), "", "## Result", "", _origin(found), "", *table_lines(found), "",
    ]  # fmt: skip
    if worst:
        lines += ["Commonest confusions: " + "; ".join(f"{a} taken for {b} ({n})" for a, b, n in worst) + ".", ""]
    lines += [
        f"![Truth against verdict]({relative}/blind-confusion.png)", "",
        f"![Stated probability against frequency]({relative}/blind-reliability.png)", "",
        "## Reference", "", *_HOW, "", "### Every failure", "", "| robot | truth | verdict | ranked |", "|---|---|---|---|",
        *(f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in _failures(found)), "",
        *_makers(), "### Sizes", "", "Drawn evenly between the two figures of each size. " + _SCOPES, "", size_table(), "",
    ]  # fmt: skip
    write_text(path, "\n".join(lines))


_COMMANDS = (
    "openant gap blind make --out SET --robots 240 --seed-from COMMIT --key-file KEY    # answers sealed; --maker: whose robots",
    "openant gap blind run SET --jobs 2                                                 # or --backend dask, ray",
    "openant gap blind score SET… --key-file KEY… --docs docs/blind.md                  # opens the answers",
)
_SCOPES = "Scopes: one joint (j), the servos of one model (g), all joints (a), the body (b)."
_HOW = (
    "### How it is done",
    "",
    "**What they do.** Three runs on the stand and four on the floor of about 9 s each, one table of commands for all, 50 rows a",
    "second; the last run of either is held out. Rows scatter by up to 0.6 ms, stamps by up to 0.3 ms.",
    "",
    "**How truth is simulated.** By other code than the candidates' (a rule of the linter keeps it so). Two makers live here:",
    "",
    "- `batch` simulates many robots at once (`blind/simulate.py`): half a millisecond, Euler or implicit, elliptic cones with an",
    "  impratio from 1 to 30 or (15 %) pyramidal ones, masses and lengths a little off; firmware at 1 kHz on the quantised",
    "  encoder, rotors behind gears with play and spring, LuGre friction, one supply, heat.",
    "- `bus` is the virtual robot (`blind/through_bus.py`): its servos' firmware, its physics, real packets in their real time on",
    "  the wire. There a command comes before its row's samples. Effects that it has in another form are not asked of it.",
    "",
    "Unless `--maker` names one, they share the robots: half of those whose effect the bus can have are its. Others' robots have",
    "motions, rates, sensors and tolerances of their own ([below](#makers)).",
    "",
    "**How it is counted.** A right name is the verdict itself; `ambiguous` is right of small effects only. A small effect may be",
    "called none where its size lies within 2.5 times a tolerance that the catalogue states. Any verdict but none is a false alarm",
    "on a healthy robot. A diagnosis that is refused counts as wrong.",
    "",
    "**Over machines.** `pip install 'openant-tools[dask]'` and `dask worker` on each, `dask scheduler` on one, then",
    "`openant gap blind run SET --backend dask --scheduler tcp://HOST:8786`; all see SET under the same path. What was stopped goes",
    "on where it was.",
)


def _makers() -> list[str]:
    """What a program has to do whose robots are to be judged."""
    drawn = Drawn("backlash", ("knee_fl",), {"gap_rad": 0.0195}, "medium")
    example = answer_for(Answer("single", (drawn,), 1630172453, "", True), "robot-003", Path("/home/me/SET/model.xml"))
    strange = ", ".join(f"`{name}` ({words})" for name, words in {**OUTSIDE, **ELSEWHERE}.items())
    return [
        "### Makers", "",
        "`openant gap blind make --maker COMMAND` lets any program make the robots, so that the diagnosis meets simulators that its",
        "authors did not write. `benchmarks/second_generator` is one, in Drake. For each robot COMMAND is called once, without a shell:",
        "", "```sh elsewhere", "COMMAND ANSWER.json FOLDER", "```", "",
        "It leaves run tables in FOLDER, which is empty ([their form](recordings.md#bring-your-own-logs)): at least one `NAME.parquet`",
        "or `NAME.csv` with columns `t`, `cmd.J`, `pos.J`, each with its facts in `NAME.json` (`\"held_out\": true` keeps a run to judge",
        "by; else each is left out in turn). ANSWER.json is what is true of the robot:",
        "", "```json", json.dumps(example, indent=1), "```", "",
        "- `model`: the nominal MJCF, which the diagnosis is given unless the facts of the runs name another (`\"model\"`, beside them).",
        "- `seed`: of all that the answer leaves open: scatter within tolerance, motions, rates, sensors, clocks.",
        "- `group`: `none` (healthy), `single`, `two`, or `outside`. `tracker`: whether runs on the floor have `base.*`.",
        "- `effects`: by the names of the catalogue; `joints` is a list, `\"all\"` or `\"body\"`; `parameters` in SI, `size` for the record.",
        "- `outside`: null, or what the catalogue has no name for, with a `joint` and a `strength` of about 1 in `parameters`:",
        f"  {strange}.", "",
        'A robot with other joint names says in the facts of its runs which is which: `"answer_joints": {"hip_rr": "j1", …}`, all',
        "eight, so that nothing is told. Several may be played by one joint (an arm's).", "",
        "Exit code 0: done. 3: this physics cannot have what was drawn; the robot is left out of the set, and the table says how",
        "many were. Any other: the command stops with one line, which names the robot and ends with the last line of the program's",
        "stderr; made again, the set goes on there. `--jobs N` runs N of them at a time.", "",
    ]  # fmt: skip
