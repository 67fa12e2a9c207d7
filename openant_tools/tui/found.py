"""A finding in lines: the sentence, what is wrong, the numbers with where they are from, what is next."""

from __future__ import annotations

from rich.text import Text

from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.tui.marks import MARKS, Name, mark, marked, spelled

__all__ = ["finding_lines", "sign"]


def sign(finding: Finding) -> Name:
    """The mark of its verdict."""
    return "unsure" if finding.ok is None else "ok" if finding.ok else "fail"


def finding_lines(finding: Finding, before: str = "") -> list[Text]:
    """One text a line of the log; `before` stands before the sentence."""
    lines = [marked(sign(finding), f"{before}{finding.what}")]
    lines += [Text(f"  {mark('warn')} {spelled(words)}", style=MARKS["warn"].colour) for words in finding.lines]
    lines += [_evidence(evidence) for evidence in finding.evidence]
    if finding.next_action:
        lines.append(Text(f"Next: {spelled(finding.next_action)}", style="bold"))
    return lines


def _evidence(evidence: Evidence) -> Text:
    value = "unknown" if evidence.value is None else f"{evidence.value:.4g} {evidence.unit}".rstrip()
    span = "" if evidence.low is None or evidence.high is None else f" ({evidence.low:.3g} ... {evidence.high:.3g})"
    text = Text(f"  {spelled(evidence.name)}: ")
    text.append(spelled(f"{value}{span}"), "bold")
    return text.append(spelled(f"  {evidence.source}"), MARKS["todo"].colour)
