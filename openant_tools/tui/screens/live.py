"""Live or replayed: the strips of all joints, and the robot from above."""

from __future__ import annotations

from textual.app import ComposeResult
from textual.containers import Container
from textual.widgets import Static

from openant_tools.tui.leg_map import LegMap
from openant_tools.tui.page import Page
from openant_tools.tui.strips import JointStrips

__all__ = ["LiveScreen"]

NOTHING = (
    "Nothing to show yet. On the first screen: v starts a virtual robot, c watches the robot that is plugged in, "
    "r replays a recording."
)


class LiveScreen(Page):
    """Strips above (or left), map below (or right, where there is room)."""

    TITLE = "Live"
    HELP = """\
# Live

All joints of the robot as its engine reads them, or of a recording. Watching switches torque off and moves nothing.
While a recording plays, its controls stand in the line above the keys, on every screen.
"""

    def body(self) -> ComposeResult:
        with Container(id="live"):
            yield JointStrips(self.session.history)
            yield LegMap(self.session.history)
        yield Static(NOTHING, id="nothing", classes="note")

    def on_mount(self) -> None:
        super().on_mount()
        self.query_one(JointStrips).focus()

    def draw(self) -> None:
        super().draw()
        for words in self.query("#nothing"):
            words.display = self.session.feed is None
