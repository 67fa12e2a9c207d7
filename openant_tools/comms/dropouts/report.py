"""The diagnosis of a bus as a report: what was lost when, of whom, at which voltage and angle, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from openant_tools.comms.dropouts.causes import CAUSES
from openant_tools.comms.dropouts.diagnose import LISTED, DropoutDiagnosis
from openant_tools.comms.dropouts.log import WORDS
from openant_tools.numbers import number, percent
from openant_tools.report import Figure, KeyFigure, Report, ReportSummary, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["dropouts_report", "loss_figure"]

_COLOURS = {
    "timeout": plots.BLUE, "crc": plots.VERMILLION, "short": plots.ORANGE, "late": plots.PURPLE, "port": plots.INK,
    "lost": plots.GREEN,
}  # fmt: skip


def loss_figure(found: DropoutDiagnosis) -> MatplotlibFigure:
    """Over time: losses by servo, or how long answers took where nothing was lost; the supply and the host's lateness, if logged."""
    log = found.measures.log
    lossy, answered, supply = log.lossy.any(), np.isfinite(log.rtt).any(), np.isfinite(log.volt).any()
    figure: MatplotlibFigure
    figure, all_axes = plots.figure(1 + bool(lossy or answered) + bool(supply), height=1.9, sharex=True, squeeze=False)
    axes = list(all_axes[:, 0])
    if lossy:
        first = axes.pop(0)
        for code, word in enumerate(WORDS[1:], 1):
            rows, joints = np.nonzero(log.word == code)
            if len(rows):
                first.plot(log.t[rows], joints, "|", color=_COLOURS[word], markersize=6, label=word, rasterized=True)
        first.set_yticks(range(len(log.joints)), log.joints)
        first.set_ylim(len(log.joints) - 0.5, -0.5)
        first.set_ylabel("lost of")
        plots.legend(first)
    elif answered:
        first = axes.pop(0)
        first.plot(log.t, 1e3 * np.nanmax(np.nan_to_num(log.rtt), axis=1), color=plots.GREEN, lw=0.8)
        first.set_ylim(bottom=0)
        first.set_ylabel(plots.axis_label("slowest answer", "ms"))
    if supply:
        low = np.nanmin(np.where(np.isfinite(log.volt), log.volt, np.inf), axis=1)
        axes[0].plot(log.t, np.where(np.isfinite(low), low, np.nan), color=plots.BLUE, lw=0.8)
        axes[0].set_ylabel(plots.axis_label("lowest supply", "V"))
    late = log.wake if np.isfinite(log.wake).any() else np.diff(log.t, prepend=log.t[0]) - log.period_s
    axes[-1].plot(log.t, late * 1e3, color=plots.VERMILLION, lw=0.8)
    axes[-1].set_ylabel(plots.axis_label("loop late", "ms"))
    axes[-1].set_xlabel(plots.signal_label("t"))
    return figure


def dropouts_report(found: DropoutDiagnosis) -> Report:
    """Verdict, what was lost when, remedy; then every cause, its evidence and every episode."""
    log, best = found.measures.log, found.suspects[0]
    lost, asked = int(log.lost.sum()), int(log.answers.sum())
    shows = "What was lost of whom" if lost else "How long the slowest answer took"
    named = found.verdict not in ("none", "unknown")
    then = f"{best.remedy}.\n\nTo make sure: {_ended(found.next_test)}" if named else _ended(found.next_test)
    then = then[:1].upper() + then[1:]
    answer = ReportSummary(
        f"{found.what[:1].upper()}{found.what[1:]}.",
        Figure(loss_figure(found), f"{shows}, the supply where it was logged, and how late the loop was."),
        _meaning(found, lost, asked),
        then if found.next_test else "Nothing. Ask again after cables were moved, and with the legs in motion.",
        "good" if found.healthy_bus else "bad" if named else "warn",
        (
            KeyFigure("lost", number(lost / max(1, asked), "share"), f"{lost} of {asked} answers"),
            KeyFigure("watched", number(log.seconds, "s", decimals=0), f"of {len(log.joints)} servos"),
        ),
    )
    report = Report("The bus", ", ".join(log.names), answer, made_by="openant comms diagnose")
    rows = [
        [
            CAUSES[one.cause].words,
            ", ".join(one.where),
            percent(one.probability),
            "; ".join(w.words for w in one.evidence if w.nats > 0),
        ]
        for one in found.suspects
    ]
    rows.append(["nothing wrong", "", percent(found.healthy), ""])
    rows.append(["a cause that is not in this list", "", percent(found.unknown), ""])
    report.section("Causes considered").table(["cause", "where", "probability", "what speaks for it"], rows)
    if named:
        against = [[why.words, number(why.nats, sign=True, decimals=1)] for why in best.evidence]
        report.section("Evidence").table(
            ["seen", "nats"],
            against,
            f"For (+) and against (−) {CAUSES[best.cause].words}; a nat makes it e times as likely.",
        )
    shown = [
        [number(one.from_s, decimals=2), number(one.to_s - one.from_s, decimals=2), str(one.stop - one.start),
         ", ".join(log.joints[k] for k in one.joints), ", ".join(one.words)]
        for one in found.measures.episodes[:LISTED]
    ]  # fmt: skip
    if shown:
        words = f"{len(found.measures.episodes)} in all." if len(found.measures.episodes) > LISTED else ""
        report.section("Episodes").table(["t (s)", "for (s)", "reads", "servos", "how"], shown, words)
    return report


def _meaning(found: DropoutDiagnosis, lost: int, asked: int) -> str:
    """What it does to the robot."""
    if not lost and asked:
        # Nothing in n trials: the rate lies below 3 / n with 95 % (the rule of three).
        rare = f"With 95 % certainty less than {number(3 / asked, 'share')} of all answers are lost."
        return rare if found.healthy_bus else f"{rare} But the times of the loop are not as they should be."
    if found.healthy_bus:
        return "So rare a loss harms nobody: the agent sees a value that is one step old."
    share = number(lost / max(1, asked), "share")
    return f"Of all answers {share} are missing; where one is, the agent acts on an old angle."


def _ended(words: str) -> str:
    return words if words.endswith("?") else f"{words}."
