"""The report of a comparison: first what changed, then every parameter as two dots with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from openant_tools.report import KeyFigure, Mark, Report, plots
from openant_tools.report.parts import Tone
from openant_tools.sysid.compare import FAMILY_ERROR, Change, Comparison, Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["comparison_report", "dots"]

_TONE: dict[str, Tone] = {"changed": "bad", "same": "good", "not comparable": ""}
#: how far the two dots of a parameter stand apart, in rows
_APART = 0.17


def comparison_report(result: Comparison) -> Report:
    """What a reader needs to decide whether the robot is still the one that was identified."""
    report = Report("Comparison", f"A: {result.a.name} · B: {result.b.name}", made_by="openant sysid compare")
    report.text(f"**{result.sentence}**")
    surest = max(result.compared, key=lambda change: -change.p, default=None)
    report.key_figures(
        KeyFigure(
            "changed",
            str(len(result.changed)),
            f"of {len(result.compared)} compared",
            "bad" if result.changed else "good",
        ),
        KeyFigure(
            "surest difference",
            "–" if surest is None else surest.name,
            "" if surest is None else f"p = {surest.p_holm:.2g} after Holm",
        ),
    )
    report.section("Side by side").figure(
        dots(result.changes),
        "Dots are values, bars their 95 % intervals; what changed beyond chance has its name in bold with a star. Hollow dots "
        "are no statement of the data.",
    )
    report.table(
        ["parameter", "A", "B", "B − A", "from", "to", "unit", "p (Holm)", "verdict"],
        [
            [
                change.name, change.a.value, change.b.value, change.difference, change.low, change.high, change.unit,
                change.p_holm, Mark(change.status, _TONE[change.status]),
            ]
            for change in result.changes
        ],
    )  # fmt: skip
    report.text(
        "**From** and **to** are the ends of the difference's 95 % interval. **p (Holm)** is the probability of such a difference by "
        f"chance, adjusted for all that were compared: at {FAMILY_ERROR:g}, one comparison in twenty calls anything changed "
        "where nothing has."
    )
    remarks = [
        *result.notes,
        *dict.fromkeys(f"{change.name}: {change.why}." for change in result.changes if change.why),
    ]
    for names, whose in ((result.only_a, "A"), (result.only_b, "B")):
        if names:
            remarks.append(f"Only in {whose}: {', '.join(names)}.")
    if remarks:
        report.section("Remarks").text("\n".join(f"- {remark}" for remark in remarks))
    return report


def dots(changes: Sequence[Change]) -> MatplotlibFigure:
    """One panel a kind of parameter, one row a joint, A above B."""
    kinds = list(dict.fromkeys(change.kind for change in changes))
    groups = [[change for change in changes if change.kind == kind] for kind in kinds]
    rows = [len(group) for group in groups]
    height = sum(rows) * 0.3 + 0.75 * len(kinds)
    figure: MatplotlibFigure
    figure, axes = plots.figure(
        len(kinds), 1, height=height / len(kinds), squeeze=False, gridspec_kw={"height_ratios": [r + 1.5 for r in rows]}
    )
    for axis, kind, group in zip(axes[:, 0], kinds, groups, strict=True):
        _panel(axis, kind, group)
    plots.legend(axes[0, 0])
    return figure


def _panel(axis: Axes, kind: str, group: Sequence[Change]) -> None:
    with plots.style():
        for row, change in enumerate(group):
            for estimate, at, colour, marker, label in (
                (change.a, row - _APART, plots.BLUE, "o", "A"),
                (change.b, row + _APART, plots.VERMILLION, "s", "B"),
            ):
                below, above = _bars(estimate)
                axis.errorbar(
                    estimate.value, at, xerr=[[below], [above]], fmt=marker, color=colour, capsize=2,
                    markerfacecolor="none" if change.status == "not comparable" else colour,
                    label=label if row == 0 else None,
                )  # fmt: skip
        axis.set_yticks(range(len(group)), [_row_name(change) for change in group])
        for text, change in zip(axis.get_yticklabels(), group, strict=True):
            if change.status == "changed":
                text.set_fontweight("bold")
        axis.set_ylim(len(group) - 0.5, -0.5)
        axis.set_ylabel("joint" if any("." in change.name for change in group) else "")
        axis.set_xlabel(plots.axis_label(kind.replace("_", " "), group[0].unit))


def _row_name(change: Change) -> str:
    name = change.name.partition(".")[2] or "robot"
    return f"{name} ★" if change.status == "changed" else name


def _bars(estimate: Estimate) -> tuple[float, float]:
    low = estimate.value if estimate.low is None else estimate.low
    high = estimate.value if estimate.high is None else estimate.high
    return max(0.0, estimate.value - low), max(0.0, high - estimate.value)
