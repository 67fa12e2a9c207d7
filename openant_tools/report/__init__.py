"""Reports that open offline: one HTML file with its pictures in it, and Markdown and JSON of the same content."""

from openant_tools.report.document import Report, ReportSummary
from openant_tools.report.parts import Code, Details, Figure, KeyFigure, KeyFigures, Mark, Part, Picture, Table, Text

__all__ = [
    "Code",
    "Details",
    "Figure",
    "KeyFigure",
    "KeyFigures",
    "Mark",
    "Part",
    "Picture",
    "Report",
    "ReportSummary",
    "Table",
    "Text",
]  # fmt: skip
