"""How the attribution of dropouts did on a set: figures, every failure, and the page of the docs."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openant_tools.blind.soak_set import read_soak_answers, read_verdicts, soak_facts
from openant_tools.blind.soaks import CAUSES, SoakAnswer
from openant_tools.files import write_bytes, write_text
from openant_tools.numbers import literal, number, percent, span
from openant_tools.procedure.intervals import wilson
from openant_tools.report import plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["SoakCase", "SoakScore", "score_soaks", "write_soak_docs"]

#: what the issue asks for
FIRST, FIRST_TWO, FALSE_ALARMS = 0.90, 0.95, 0.02


@dataclass(frozen=True)
class SoakCase:
    """One soak: what is true, and what was said."""

    name: str
    answer: SoakAnswer
    said: Mapping[str, Any]

    @property
    def verdict(self) -> str:
        return str(self.said.get("verdict"))

    @property
    def ranked(self) -> list[str]:
        return [str(one["cause"]) for one in self.said.get("causes", [])]

    @property
    def right(self) -> bool:
        return self.verdict == self.answer.cause

    @property
    def among_two(self) -> bool:
        """The right cause among the first two, and the bus not called healthy."""
        return self.right or (self.verdict != "none" and self.answer.cause in self.ranked[:2])

    @property
    def place_right(self) -> bool | None:
        """Whether the right joint was named; None where there is none to name."""
        if not self.right or not self.answer.where or not self.said.get("causes"):
            return None
        where = set(self.said["causes"][0]["where"])
        return bool(where & set(self.answer.where))


@dataclass(frozen=True)
class SoakScore:
    """The figures of one set."""

    facts: Mapping[str, Any]
    cases: tuple[SoakCase, ...]

    @property
    def faulty(self) -> list[SoakCase]:
        return [case for case in self.cases if case.answer.cause != "none"]

    @property
    def healthy(self) -> list[SoakCase]:
        return [case for case in self.cases if case.answer.cause == "none"]

    @property
    def failures(self) -> list[SoakCase]:
        return [case for case in self.cases if not case.right]

    @property
    def rows(self) -> list[tuple[str, int, int, float, bool]]:
        """(what, k, n, what is asked for, whether fewer is better)."""
        faulty, healthy = self.faulty, self.healthy
        places = [case for case in faulty if case.place_right is not None]
        table = [
            ("right cause first", sum(c.right for c in faulty), len(faulty), FIRST, False),
            ("right cause among the first two", sum(c.among_two for c in faulty), len(faulty), FIRST_TWO, False),
            ("false alarms on healthy soaks", sum(not c.right for c in healthy), len(healthy), FALSE_ALARMS, True),
        ]
        for maker in ("tables", "virtual"):
            own = [case for case in faulty if case.answer.maker == maker]
            table.append((f"right cause first, maker {maker}", sum(c.right for c in own), len(own), FIRST, False))
        table.append(
            (
                "right joint, where the cause is right",
                sum(bool(c.place_right) for c in places),
                len(places),
                FIRST,
                False,
            )
        )
        return table

    @property
    def good(self) -> bool:
        """Whether the three figures asked for are reached."""
        return all((k / n <= mark if fewer else k / n >= mark) for _, k, n, mark, fewer in self.rows[:3] if n)

    def as_json(self) -> dict[str, Any]:
        return {
            "set": dict(self.facts),
            "rows": [
                {"what": what, "k": k, "n": n, "asked": mark, "fewer": fewer, "interval": list(wilson(k, n))}
                for what, k, n, mark, fewer in self.rows
            ],
            "failures": [
                {"soak": c.name, "cause": c.answer.cause, "where": list(c.answer.where), "verdict": c.verdict,
                 "ranked": c.ranked[:3]}
                for c in self.failures
            ],
        }  # fmt: skip


def score_soaks(folder: Path, key: bytes | None, *, so_far: bool = False) -> SoakScore:
    """Open the answers of a set and compare; with `so_far` of the soaks alone that have a verdict.

    Raises:
        BadInput: no set, no verdicts, or a seal that does not open.
    """
    answers = read_soak_answers(folder, key)
    said = read_verdicts(folder, list(answers), so_far=so_far)
    cases = tuple(SoakCase(name, answers[name], one) for name, one in said.items())
    return SoakScore(soak_facts(folder), cases)


def table_lines(found: SoakScore) -> list[str]:
    """The figures as Markdown."""
    lines = ["| what | result | 95 % | n | asked |", "|---|---|---|---|---|"]
    for what, k, n, mark, fewer in found.rows:
        share = percent(k / n, decimals=1) if n else "–"
        known = span(*wilson(k, n), unit="share", decimals=1)
        sign = "≤" if fewer else "≥"
        lines.append(f"| {what} | {share} | {known} | {n} | {sign} {percent(mark)} |")
    return lines


def _by_cause(found: SoakScore) -> list[str]:
    lines = ["| cause | soaks | first | first two | taken for |", "|---|---|---|---|---|"]
    for cause in (*CAUSES, "none"):
        own = [case for case in found.cases if case.answer.cause == cause]
        wrong = Counter(case.verdict for case in own if not case.right)
        names = ", ".join(f"{name} {count}" for name, count in wrong.most_common())
        two = "–" if cause == "none" else str(sum(case.among_two for case in own))
        lines.append(f"| {cause} | {len(own)} | {sum(case.right for case in own)} | {two} | {names} |")
    return lines


def _failures(found: SoakScore) -> list[str]:
    lines = ["| soak | truth | verdict | ranked | of the log |", "|---|---|---|---|---|"]
    for case in found.failures:
        answer = case.answer
        values = ", ".join(f"{name} {value}" for name, value in answer.parameters.items())
        truth = f"{answer.cause} {' '.join(answer.where)} ({values})" if values else answer.cause
        said = [f"{one['cause']} {number(one['probability'], decimals=2)}" for one in case.said.get("causes", [])[:3]]
        lacks = f", without {', '.join(answer.dropped)}" if answer.dropped else ""
        log = f"{answer.maker}, {number(answer.seconds, 's', decimals=0)} at {number(answer.rate_hz, 'Hz', decimals=0)}, {len(answer.joints)} servos{lacks}"
        lines.append(
            f"| {case.name} | {truth} | {case.said.get('error') or case.verdict} | {', '.join(said)} | {log} |"
        )
    return lines


def _how_many(found: SoakScore) -> str:
    n, all_of = len(found.cases), int(found.facts["soaks"])
    return f"{n} soaks" if n == all_of else f"**Not the whole set:** {n} of its {all_of} soaks, those judged so far"


def reliability_figure(found: SoakScore) -> Figure:
    """Stated probability of the first cause against how often it was right."""
    figure: Figure
    figure, axes = plots.figure(height=3.2, width=5.0)
    stated = np.array([case.said["causes"][0]["probability"] for case in found.faulty if case.ranked])
    right = np.array([case.ranked[0] == case.answer.cause for case in found.faulty if case.ranked])
    axes.plot([0, 1], [0, 1], color=plots.INK, lw=0.8, alpha=0.6, label="ideal")
    edges = np.array([0.0, 0.4, 0.6, 0.75, 0.9, 0.97, 1.001])
    for low, high in itertools.pairwise(edges.tolist()):
        inside = (stated >= low) & (stated < high)
        if not inside.any():
            continue
        k, n = int(right[inside].sum()), int(inside.sum())
        at, interval = float(stated[inside].mean()), wilson(k, n)
        axes.plot([at, at], interval, color=plots.BLUE, lw=1.0)
        axes.plot(at, k / n, "o", color=plots.BLUE, label="seen" if low == 0 else None)
        axes.annotate(str(n), (at, interval[1]), textcoords="offset points", xytext=(0, 4), ha="center", fontsize=7)
    axes.set_xlim(-0.02, 1.03)
    axes.set_ylim(-0.03, 1.12)
    axes.set_xlabel("stated probability of the first cause (–)")
    axes.set_ylabel("share right (–)")
    plots.legend(axes)
    return figure


_HOW = (
    "**What is drawn.** Healthy soaks last 10 minutes or more; the others have one cause each, every cause of the list in turn, at",
    "a random place, of a strength drawn over one to two decades. Rows come 10 to 100 times a second; any column in eight is",
    "missing, unless the cause shows in nothing else; some logs have four to six servos; in a fifth nobody says how the servos are",
    "wired. A bad cable has at least two servos behind it: with one, it cannot be told from that servo.",
    "",
    "**Two makers.** `tables` writes columns by forms of its own (`blind/soak_tables.py`: no firmware, no packets; motion, load,",
    "supply, round trips and the host's clock are drawn). `virtual` asks the virtual robot's bus transaction by transaction while it",
    "moves (`blind/soak_virtual.py`). The marks and densities of the diagnosis were set on other seeds of both.",
    "",
    "**How it is counted.** The verdict must be the cause. `unknown` is wrong on a faulty soak; among the first two counts where the",
    "bus was not called healthy. Anything but `none` is a false alarm on a healthy soak.",
)


def write_soak_docs(found: SoakScore, path: Path) -> None:
    """Write the page of the docs, and its picture into `pictures/` beside it."""
    pictures = path.parent / "pictures"
    figure = reliability_figure(found)
    figure.set_facecolor("white")
    write_bytes(pictures / "comms-blind-reliability.png", plots.as_png(figure, dpi=110))
    facts = found.facts
    seed = f"seed {facts['seed']}"
    if "seed_from_commit" in facts:
        seed += f" (the first 8 digits of commit `{facts['seed_from_commit']}`)"
    virtual = sum(case.answer.maker == "virtual" for case in found.cases)
    longest = max((float(case.said.get("blind", {}).get("seconds", 0.0)) for case in found.cases), default=0.0)
    lines = [
        "# The blind check of dropout attribution", "",
        "<!-- Written by `openant comms blind score SET --docs docs/comms-blind.md`: do not edit. -->", "",
        "```sh elsewhere",
        f"openant comms blind make --out SET --seed-from COMMIT --key-file KEY --soaks {facts['soaks']} "
        f"--healthy {literal(facts['mix']['healthy'], 2)} --virtual {literal(facts['mix']['virtual'], 2)}    # answers sealed",
        "openant comms blind run SET",
        "openant comms blind score SET --key-file KEY --docs docs/comms-blind.md",
        "```", "", *_HOW, "", "## Result", "",
        f"{_how_many(found)}, {len(found.healthy)} of them healthy, {seed}, commitment of the answers "
        f"`{facts['commitment']}`. {virtual} came from the virtual robot's bus. The slowest diagnosis took {number(longest, 's')}.", "",
        *table_lines(found), "", *_by_cause(found), "",
        f"![Stated probability against share right]({os.path.relpath(pictures, path.parent)}/comms-blind-reliability.png)", "",
        "## Every failure", "", *(_failures(found) if found.failures else ["None."]), "",
    ]  # fmt: skip
    write_text(path, "\n".join(lines))
