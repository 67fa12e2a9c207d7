"""The diagnosis of a bus as a report: what was lost when, of whom, at which voltage and angle, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from openant_tools.comms.dropouts.diagnose import LISTED, DropoutDiagnosis
from openant_tools.comms.dropouts.log import WORDS
from openant_tools.report import KeyFigure, Report, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["dropouts_report", "loss_figure"]

_COLOURS = {
    "timeout": plots.BLUE, "crc": plots.VERMILLION, "short": plots.ORANGE, "late": plots.PURPLE, "port": plots.INK,
    "lost": plots.GREEN,
}  # fmt: skip


def loss_figure(found: DropoutDiagnosis) -> Figure:
    """Losses by servo over time, with the supply and the host's lateness below."""
    log = found.measures.log
    figure: Figure
    figure, axes = plots.figure(3, height=1.9, sharex=True)
    for code, word in enumerate(WORDS):
        rows, joints = np.nonzero(log.word == code) if code else (np.zeros(0, int), np.zeros(0, int))
        if len(rows):
            axes[0].plot(log.t[rows], joints, "|", color=_COLOURS[word], markersize=6, label=word, rasterized=True)
    axes[0].set_yticks(range(len(log.joints)), log.joints)
    axes[0].set_ylim(len(log.joints) - 0.5, -0.5)
    axes[0].set_ylabel("lost of (–)")
    if log.lossy.any():
        plots.legend(axes[0])
    if np.isfinite(log.volt).any():
        low = np.nanmin(np.where(np.isfinite(log.volt), log.volt, np.inf), axis=1)
        axes[1].plot(log.t, np.where(np.isfinite(low), low, np.nan), color=plots.BLUE, lw=0.8)
    axes[1].set_ylabel(plots.axis_label("lowest supply", "V"))
    late = log.wake if np.isfinite(log.wake).any() else np.diff(log.t, prepend=log.t[0]) - log.period_s
    axes[2].plot(log.t, late * 1e3, color=plots.VERMILLION, lw=0.8)
    axes[2].set_ylabel(plots.axis_label("loop late", "ms"))
    axes[2].set_xlabel(plots.signal_label("t"))
    return figure


def dropouts_report(found: DropoutDiagnosis) -> Report:
    """Verdict, evidence, and every episode."""
    log = found.measures.log
    report = Report("The bus", ", ".join(log.names), made_by="openant comms diagnose")
    lost, asked = int(log.lost.sum()), int(log.answers.sum())
    report.key_figures(
        KeyFigure("verdict", found.verdict, found.what),
        KeyFigure("lost", f"{lost / max(1, asked):.2%}", f"{lost} of {asked} answers"),
        KeyFigure("watched", f"{log.seconds:.0f} s", f"{len(log.t)} reads"),
    )
    if found.next_test:
        report.text(f"Next: {found.next_test}.")
    report.section("When").figure(loss_figure(found), "What was lost of whom, the supply, and how late the loop was.")
    rows = [
        [
            one.cause,
            ", ".join(one.where),
            f"{one.probability:.2f}",
            "; ".join(w.words for w in one.evidence if w.nats > 0),
        ]
        for one in found.suspects
    ]
    report.section("Causes").table(["cause", "where", "probability", "what speaks for it"], rows)
    best = found.suspects[0]
    if found.verdict not in ("none", "unknown"):
        against = [[why.words, f"{why.nats:+.1f}"] for why in best.evidence]
        report.section("Evidence").text(f"For and against {best.cause}, in nats.").table(["seen", "nats"], against)
        report.section("What to do").text(f"{best.remedy}.\n\nTo make sure: {found.next_test}.")
    shown = [
        [f"{one.from_s:.2f}", f"{one.to_s - one.from_s:.2f}", str(one.stop - one.start),
         ", ".join(log.joints[k] for k in one.joints), ", ".join(one.words)]
        for one in found.measures.episodes[:LISTED]
    ]  # fmt: skip
    if shown:
        words = f"{len(found.measures.episodes)} in all." if len(found.measures.episodes) > LISTED else ""
        report.section("Episodes").text(words).table(["t (s)", "for (s)", "reads", "servos", "how"], shown)
    return report
