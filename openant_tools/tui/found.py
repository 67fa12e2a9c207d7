"""A finding in lines: the verdict, what is wrong, the numbers as a table of joints and quantities, what is next."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from rich.text import Text

from openant_tools.numbers import column, is_error
from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.bars import allowed_bar
from openant_tools.tui.marks import MARKS, Name, mark, marked, plain, spelled

__all__ = ["finding_lines", "numbers_lines", "sign", "verdict"]

#: a joint in the name of a quantity, with the word that ties it to the rest: `id of hip_rr`, `knee_fl low end`
_JOINT = re.compile(rf"(?: (?:of|at))? ?\b({'|'.join(JOINT_NAMES)})\b ?")
#: of how many joints a quantity must be told to be a column
COLUMN_FROM = 2
#: quantities whose largest value is the worst, besides errors
_WORST = re.compile(r"\b(off|lost|friction)\b")
#: columns of a bar with the blank before it
BAR = 10
GREY = MARKS["todo"].colour


def sign(finding: Finding) -> Name:
    """The mark of its verdict."""
    return "unsure" if finding.ok is None else "ok" if finding.ok else "fail"


def verdict(finding: Finding, before: str = "") -> Text:
    """The sentence and what is wrong, for the place that is always seen."""
    text = marked(sign(finding), f"{before}{finding.what}")
    for words in finding.lines:
        text.append(f"\n  {mark('warn')} {spelled(words)}", MARKS["warn"].colour)
    return text


def finding_lines(finding: Finding, width: int = 76) -> list[Text]:
    """All of it, one text a line, for a page of `width` columns."""
    lines = [*verdict(finding).split("\n"), *numbers_lines(finding, width)]
    if finding.next_action:
        lines.append(Text(f"Next: {spelled(finding.next_action)}", style="bold"))
    return lines


def numbers_lines(finding: Finding, width: int = 76) -> list[Text]:
    """What the verdict rests on: a table of the joints, and what is not told joint by joint."""
    lines = list[Text]()
    table, others = _by_joint(finding.evidence)
    wrong = {joint for joint in JOINT_NAMES if any(joint in words for words in finding.lines)}
    for columns in _that_fit(table, width):
        lines += [*_table(columns, wrong, width), Text()]
    lines += _list(others, width)
    return lines[:-1] if lines and not lines[-1].plain else lines


@dataclass(frozen=True)
class _Column:
    """One quantity of several joints: joint → its number, and how that is read."""

    name: str
    rows: Mapping[str, Evidence]

    @cached_property
    def words(self) -> Mapping[str, str]:
        first = next(iter(self.rows.values()))
        if any(one.low is not None or one.unit != first.unit for one in self.rows.values()):
            return {joint: spelled(one.words) for joint, one in self.rows.items()}
        values = column([one.value for one in self.rows.values()], first.unit, name=self.name)
        return dict(zip(self.rows, map(spelled, values), strict=True))

    @property
    def width(self) -> int:
        """Of the numbers, with the blanks before and the mark of the worst behind them."""
        return 4 + max(len(spelled(self.name)), *map(len, self.words.values()))

    @property
    def bar(self) -> int:
        """Of the bars behind them."""
        return BAR if any(one.wanted for one in self.rows.values()) else 0

    @cached_property
    def worst(self) -> str:
        """The joint whose error, loss or friction is the largest of three or more; "" where none reads worse than another."""
        values = {joint: abs(one.value) for joint, one in self.rows.items() if one.value is not None}
        if (
            len(values) < 3
            or not (is_error(self.name) or _WORST.search(self.name))
            or len({words.lstrip("+−-") for words in self.words.values()}) == 1
        ):
            return ""
        return max(values, key=lambda joint: values[joint])


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
    return [_Column(quantity, rows) for quantity, rows in kept.items()], [
        one for one in evidence if id(one) not in told
    ]


def _that_fit(columns: list[_Column], width: int) -> Iterator[list[_Column]]:
    """As many columns beside each other as there is room for."""
    part: list[_Column] = []
    for one_more in columns:
        if part and 10 + sum(one.width + one.bar for one in (*part, one_more)) > width:
            yield part
            part = []
        part.append(one_more)
    if part:
        yield part


def _table(columns: list[_Column], wrong: set[str], width: int) -> list[Text]:
    """Joints below each other, quantities beside each other; the worst of each marked, and what the finding names."""
    head = Text(f"  {'joint':8}", GREY)
    for one in columns:
        head.append(f"{spelled(one.name):>{one.width - 1}} " + " " * one.bar)
    lines = [head]
    for joint in (joint for joint in JOINT_NAMES if any(joint in one.rows for one in columns)):
        style = MARKS["fail"].colour if joint in wrong else ""
        line = Text(f"{mark('fail') if joint in wrong else ' '} {joint:8}", style)
        for one in columns:
            here = joint == one.worst
            words = f"{one.words.get(joint, ''):>{one.width - 1}}{_worst_mark() if here else ' '}"
            line.append(words, f"bold {MARKS['warn'].colour}" if here else "")
            if joint in one.rows and one.rows[joint].wanted:
                line.append(" ").append_text(allowed_bar(one.rows[joint], BAR - 1))
            else:
                line.append(" " * one.bar)
        line.rstrip()
        lines.append(line)
    if any(one.worst for one in columns):
        lines.append(Text(f"  {_worst_mark()} the largest of its column", GREY))
    for one in columns:
        sources = dict.fromkeys(row.source for row in one.rows.values())
        wanted = dict.fromkeys(row.wanted for row in one.rows.values())
        words_of = [next(iter(sources))] if len(sources) == 1 else []
        words_of += [f"as it should be: {next(iter(wanted))}"] if len(wanted) == 1 and all(wanted) else []
        if words_of:
            lines += _folded(f"{one.name}: {'; '.join(words_of)}", width)
    return lines


def _folded(words: str, width: int) -> list[Text]:
    return [
        Text(line, GREY)
        for line in textwrap.wrap(
            spelled(words), width, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False
        )
    ]


def _worst_mark() -> str:
    return "<" if plain() else "◂"


def _list(evidence: Sequence[Evidence], width: int) -> list[Text]:
    """One number a line: its name, the number, its bar where it has one, its interval, and where it comes from."""
    if not evidence:
        return []
    names = max(len(spelled(one.name)) for one in evidence)
    words = [spelled(one.words) for one in evidence]
    numbers = [shown.partition(" (")[0] for shown in words]  # without their intervals
    values = max(map(len, numbers))
    bar = BAR if any(one.wanted for one in evidence) else 0
    before = 2 + names + 2 + values + bar + 2
    longest = max((len(word) for one in evidence for word in one.source.split()), default=0)
    beside = width - before >= max(16, longest)  # else the source stands below its number
    lines = []
    for one, value, shown in zip(evidence, numbers, words, strict=True):
        line = Text(f"  {spelled(one.name):{names}}  ").append(f"{value:>{values}}", "bold")
        wanted = f"; as it should be: {one.wanted}" if one.wanted else ""
        source = f"{shown.removeprefix(value)} {one.source}{wanted}".strip()
        if one.wanted:
            line.append(" ").append_text(allowed_bar(one, BAR - 1))
        else:
            line.append(" " * bar)
        if beside:
            first, *rest = textwrap.wrap(spelled(source), width - before, break_on_hyphens=False) or [""]
            line.append(f"  {first}", GREY)
            lines += [line, *(Text(" " * before + words, GREY) for words in rest)]
        else:
            line.rstrip()
            lines += [line, *_folded(f"  {source}", width)]
    return lines
