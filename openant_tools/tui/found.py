"""A finding in lines: the sentence, what is wrong, the numbers with where they are from, what is next."""

from __future__ import annotations

from rich.text import Text

from openant_tools.procedure.finding import Evidence, Finding
from openant_tools.tui.marks import MARKS, mark, marked, spelled

__all__ = ["finding_lines"]


def finding_lines(finding: Finding, before: str = "") -> list[Text]:
    """One text a line of the log; `before` stands before the sentence."""
    lines = [marked("ok" if finding.ok else "fail", f"{before}{finding.what}")]
    lines += [Text(f"  {mark('warn')} {spelled(problem)}", style=MARKS["warn"].colour) for problem in finding.problems]
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
