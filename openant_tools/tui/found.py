"""A finding in lines: the verdict, what is wrong, the numbers as a table of joints and quantities, what is next."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from rich.text import Text

from openant_tools.numbers import is_error
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.marks import MARKS, Name, mark, marked, spelled

__all__ = ["finding_lines", "sign", "verdict"]

#: a joint in the name of a quantity, with the word that ties it to the rest: `id of hip_rr`, `knee_fl low end`
_JOINT = re.compile(rf"(?: (?:of|at))? ?\b({'|'.join(JOINT_NAMES)})\b ?")
#: of how many joints a quantity must be told to be a column
COLUMN_FROM = 2
#: quantities whose largest value is the worst, besides errors
_WORST = re.compile(r"\b(off|lost|friction)\b")


def sign(finding: Finding) -> Name:
    """The mark of its verdict."""
    return "unsure" if finding.ok is None else "ok" if finding.ok else "fail"


def verdict(finding: Finding, before: str = "") -> Text:
    """The sentence and what is wrong, for the place that is always seen."""
    text = marked(sign(finding), f"{before}{finding.what}")
    for words in finding.lines:
        text.append(f"\n  {mark('warn')} {spelled(words)}", MARKS["warn"].colour)
    return text


def finding_lines(finding: Finding, whole: bool = True, width: int = 76) -> list[Text]:
    """One text a line of the log, of `width` columns; without the verdict unless it is to be `whole`."""
    lines = list(verdict(finding).split("\n")) if whole else []
    table, others = _by_joint(finding.evidence)
    for columns in _that_fit(table, width):
        lines += _table(columns, {joint for joint in JOINT_NAMES if any(joint in words for words in finding.lines)})
    lines += [_evidence(evidence) for evidence in others]
    if finding.next_action:
        lines.append(Text(f"Next: {spelled(finding.next_action)}", style="bold"))
    return lines


_Column = tuple[str, dict[str, Evidence]]


def _by_joint(evidence: Sequence[Evidence]) -> tuple[list[_Column], list[Evidence]]:
    """Quantities that several joints have, each joint → its number; and all other evidence."""
    columns: dict[str, dict[str, Evidence]] = {}
    for one in evidence:
        found = _JOINT.search(one.name)
        if found is not None:
            quantity = " ".join(f"{one.name[: found.start()]} {one.name[found.end() :]}".split())
            columns.setdefault(quantity, {})[found[1]] = one
    kept = {quantity: rows for quantity, rows in columns.items() if quantity and len(rows) >= COLUMN_FROM}
    told = {id(one) for rows in kept.values() for one in rows.values()}
    return list(kept.items()), [one for one in evidence if id(one) not in told]


def _that_fit(columns: list[_Column], width: int) -> Iterator[list[_Column]]:
    """As many columns beside each other as there is room for."""
    part: list[_Column] = []
    for column in columns:
        if part and 10 + sum(_width(one) for one in (*part, column)) > width:
            yield part
            part = []
        part.append(column)
    if part:
        yield part


def _width(column: _Column) -> int:
    quantity, rows = column
    return 3 + max(len(spelled(quantity)), *(len(spelled(one.words)) for one in rows.values()))


def _table(columns: list[_Column], wrong: set[str]) -> list[Text]:
    """Joints below each other, quantities beside each other; the worst of each marked, and what the finding names."""
    head = Text(f"  {'joint':8}" + "".join(f"{spelled(name):>{_width((name, rows))}}" for name, rows in columns))
    head.stylize(MARKS["todo"].colour)
    lines = [head]
    worst = {name: _worst(name, rows) for name, rows in columns}
    for joint in (joint for joint in JOINT_NAMES if any(joint in rows for _, rows in columns)):
        line = Text(
            f"{mark('fail') if joint in wrong else ' '} {joint:8}", MARKS["fail"].colour if joint in wrong else ""
        )
        for name, rows in columns:
            words = spelled(rows[joint].words) if joint in rows else ""
            style = f"bold {MARKS['warn'].colour}" if joint == worst[name] else ""
            line.append(f"{words:>{_width((name, rows))}}", style)
        lines.append(line)
    for name, rows in columns:
        sources = dict.fromkeys(one.source for one in rows.values())
        if len(sources) == 1:
            lines.append(Text(f"  {spelled(name)}: {spelled(next(iter(sources)))}", MARKS["todo"].colour))
    return lines


def _worst(quantity: str, rows: dict[str, Evidence]) -> str:
    """The joint whose error, loss or friction is the largest of three or more; "" where none is worse than another."""
    values = {joint: abs(one.value) for joint, one in rows.items() if one.value is not None}
    if len(values) < 3 or not (is_error(quantity) or _WORST.search(quantity)) or len(set(values.values())) == 1:
        return ""
    return max(values, key=lambda joint: values[joint])


def _evidence(evidence: Evidence) -> Text:
    text = Text(f"  {spelled(evidence.name)}: ")
    text.append(spelled(evidence.words), "bold")
    return text.append(spelled(f"  {evidence.source}"), MARKS["todo"].colour)
