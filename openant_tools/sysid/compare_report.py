"""The report of a comparison: first what changed, then every parameter as two dots with their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from openant_tools.numbers import number, percent, readable
from openant_tools.report import Figure, KeyFigure, Mark, Report, ReportSummary, plots
from openant_tools.report.parts import Tone
from openant_tools.sysid.compare import FAMILY_ERROR, Change, Comparison, Estimate, chance
from openant_tools.sysid.kinds import said

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MatplotlibFigure

__all__ = ["comparison_report", "dots"]

_TONE: dict[str, Tone] = {"changed": "bad", "same": "good", "not comparable": ""}
#: how far the two dots of a parameter stand apart, in rows
_APART = 0.17


def comparison_report(result: Comparison) -> Report:
    """What a reader needs to decide whether the robot is still the one that was identified."""
    surest = max(result.compared, key=lambda change: -change.p, default=None)
    figures = [KeyFigure("changed", str(len(result.changed)), f"of {len(result.compared)} compared")]
    if surest is not None:
        figures.append(
            KeyFigure("surest difference", said(surest.name), f"chance alone makes it in {percent(surest.p_holm)}")
        )
    where = ", ".join(result.joints_changed) or "the robot"
    answer = ReportSummary(
        result.sentence,
        Figure(
            dots(_telling(result)),
            "Dots are values, bars their 95 % intervals; what changed beyond chance has its name in bold with a star. Hollow dots "
            "are no statement of the data.",
        ),
        "A model and a policy that were made for A meet another robot in B."
        if result.changed
        else "A model of A holds for B, as far as these data tell.",
        f"Look at {where}: horn, screws, gears, cable. If it is to stay so, fit anew (`openant sysid fit`) and train on that model."
        if result.changed
        else "Go on with the model that you have; record and fit again after a repair, or in some months.",
        "bad" if result.changed else "good",
        figures,
    )
    report = Report("Comparison", f"A: {result.a.name} · B: {result.b.name}", answer, made_by="openant sysid compare")
    report.section("Every parameter").table(
        ["parameter", "A", "B", "B − A (95 % interval)", "p (Holm)", "verdict"],
        [
            [
                said(change.name), number(change.a.value, change.unit), number(change.b.value, change.unit),
                number(change.difference, change.unit, change.low, change.high, sign=True), chance(change.p_holm),
                Mark(change.status, _TONE[change.status]),
            ]
            for change in result.changes
        ],
    )  # fmt: skip
    report.text(
        "**p (Holm)** is the probability of such a difference by chance, adjusted for all that were compared: at "
        f"{number(FAMILY_ERROR)}, one comparison in twenty calls anything changed where nothing has."
    )
    report.figure(dots(result.changes), "The same of all parameters.")
    remarks = [
        *result.notes,
        *dict.fromkeys(f"{said(change.name)}: {change.why}." for change in result.changes if change.why),
    ]
    for names, whose in ((result.only_a, "A"), (result.only_b, "B")):
        if names:
            remarks.append(f"Only in {whose}: {', '.join(map(said, names))}.")
    if remarks:
        report.section("Remarks").text("\n".join(f"- {remark}" for remark in remarks))
    return report


def _telling(result: Comparison) -> Sequence[Change]:
    """The kinds of parameters of which one changed; else that of the surest difference."""
    shown = result.changed or sorted(result.compared, key=lambda change: change.p)[:1] or result.changes
    kinds = {change.kind for change in shown}
    return [change for change in result.changes if change.kind in kinds]


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
    factor, unit = readable(max(abs(change.a.value) for change in group), group[0].unit)
    with plots.style():
        for row, change in enumerate(group):
            for estimate, at, colour, marker, label in (
                (change.a, row - _APART, plots.BLUE, "o", "A"),
                (change.b, row + _APART, plots.VERMILLION, "s", "B"),
            ):
                below, above = _bars(estimate)
                axis.errorbar(
                    factor * estimate.value, at, xerr=[[factor * below], [factor * above]], fmt=marker, color=colour, capsize=2,
                    markerfacecolor="none" if change.status == "not comparable" else colour,
                    label=label if row == 0 else None,
                )  # fmt: skip
        axis.set_yticks(range(len(group)), [_row_name(change) for change in group])
        for text, change in zip(axis.get_yticklabels(), group, strict=True):
            if change.status == "changed":
                text.set_fontweight("bold")
        axis.set_ylim(len(group) - 0.5, -0.5)
        axis.set_ylabel("joint" if any("." in change.name for change in group) else "")
        axis.set_xlabel(plots.axis_label(said(kind), unit))


def _row_name(change: Change) -> str:
    name = change.name.partition(".")[2] or "robot"
    return f"{name} ★" if change.status == "changed" else name


def _bars(estimate: Estimate) -> tuple[float, float]:
    low = estimate.value if estimate.low is None else estimate.low
    high = estimate.value if estimate.high is None else estimate.high
    return max(0.0, estimate.value - low), max(0.0, high - estimate.value)
