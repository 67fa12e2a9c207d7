"""What every screen has: a line on the robot, faults until they are seen, the controls of a replay, the keys."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, Protocol, cast

from rich.text import Text
from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.geometry import Size
from textual.screen import Screen
from textual.widget import Widget
from textual.widgets import Footer, Input, OptionList, Static

from openant_tools.numbers import number
from openant_tools.tui.feeds import ReplayFeed
from openant_tools.tui.joint_table import JointTable
from openant_tools.tui.leg_map import JointChosen, LegMap
from openant_tools.tui.marks import MARKS, mark, marked, overflow, plain, spelled
from openant_tools.tui.session import Session
from openant_tools.tui.strips import JointStrips

__all__ = ["LEAST", "ROOMY", "Page", "Program", "help_of", "put", "too_small"]

#: columns and lines that every screen needs
LEAST = (80, 24)
#: from where on a screen shows the robot beside the rest
ROOMY = (110, 34)
STOP_STYLE = "bold #000000 on #FFE14D"


class Program(Protocol):
    """What a screen asks of the program that it is a screen of.

    Attributes:
        session: what all screens work on.
        announced: what Enter opens, where a step's number was typed; else "".
    """

    session: Session

    @property
    def announced(self) -> str: ...

    def action_go(self, name: str) -> None:
        """Open a screen by its name."""

    def open_step(self, name: str, *, instead: bool = False) -> None:
        """Open a step, on top or instead of the screen that is open."""

    def action_bench(self) -> None:
        """Ask for one of the bench's procedures, and open it."""

    def action_virtual(self) -> None:
        """Start a virtual robot, or end the one that runs."""

    def free_bus(self, then: Callable[[], None]) -> None:
        """Stop watching, so that something else can have the bus, then go on."""

    def play(self, feed: ReplayFeed) -> None:
        """Show a recording on all screens."""

    def diagnose(self, recording: Path) -> None:
        """Have a recording diagnosed, on the screen of the gap."""

    def take_digit(self, digit: str) -> None:
        """A digit of a step's number, which Enter opens."""


class Page(Screen[None]):
    """A screen of the program.

    Attributes:
        TITLE: in the top line.
        HELP: what F1 shows where the focused widget has nothing of its own to say.
        DOC: the page of docs/ that says more, which F1 links.
    """

    TITLE = ""
    HELP = ""
    DOC = "tour.md"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "app.back", "Back")]

    #: what had the focus before the window was too small
    _focused_before: Widget | None = None

    @property
    def ant(self) -> Program:
        return cast(Program, self.app)

    @property
    def session(self) -> Session:
        return self.ant.session

    @property
    def about(self) -> str:
        """What F1 says first, of what is at hand now; Markdown."""
        return ""

    @property
    def doc(self) -> str:
        """The page of docs/ on what is at hand now."""
        return self.DOC

    @property
    def verdict(self) -> Text:
        """What has to be seen whatever the size of the window."""
        return Text()

    @property
    def small(self) -> bool:
        """Whether the window has no room for the screen."""
        return too_small(self.size)

    @property
    def roomy(self) -> bool:
        """Whether the robot has its place beside the rest; told by the size, since classes follow it later."""
        return self.size.width >= ROOMY[0] and self.size.height >= ROOMY[1]

    def compose(self) -> ComposeResult:
        yield Static(id="top")
        yield Static(id="faults")
        yield Static(id="small")
        yield from self.body()
        yield Static(id="replay")
        yield Footer(compact=True, show_command_palette=False)

    def body(self) -> ComposeResult:
        """The screen's own part."""
        yield from ()

    def on_mount(self) -> None:
        self.draw()

    def on_screen_resume(self) -> None:
        self.draw()

    def on_resize(self) -> None:
        # What a small window hides loses the focus, and has it again with room again.
        if self.small and self._focused_before is None:
            self._focused_before = self.focused
        elif not self.small and self._focused_before is not None:
            self.call_after_refresh(self.set_focus, self._focused_before)
            self._focused_before = None
        if self.query("#top"):  # the first comes before there is anything to draw
            self.draw()

    def draw(self) -> None:
        """Show the session as it is now."""
        if not self.query("#top"):
            return  # not there yet, or gone already
        session = self.session
        put(self.query_one("#top", Static), self._top())
        if self.small:
            least = f"Make the window larger: {LEAST[0]} columns and {LEAST[1]} lines at least."
            keys = "Until then only Space (stop), Ctrl-C (quit) and Ctrl-Z (suspend) act."
            lines = [self.verdict, Text(least, style="bold"), Text(keys)]
            put(self.query_one("#small", Static), Text("\n").join(lines))
        faults = session.faults.unseen
        bar = self.query_one("#faults", Static)
        bar.display = bool(faults)
        if faults:
            more = f"  and {len(faults) - 1} more" if len(faults) > 1 else ""
            words = f"{mark('fail')} FAULT {spelled(str(faults[0]))}{more}  "
            put(bar, Text.assemble((words, "bold"), ("F8: seen", "reverse")))
        replay = session.replay
        line = self.query_one("#replay", Static)
        line.display = replay is not None
        if replay is not None:
            words = "playing" if replay.playing else "paused"
            keys = "p pause  , . step  [ ] 5 s  < > speed  x end"
            line.update(
                f"{words} {number(replay.position_s, decimals=1)} of {number(replay.duration_s, decimals=1)} s, "
                f"x{number(replay.speed)}   {keys}"
            )
        for map_ in self.query(LegMap):
            map_.chosen = session.selected
            map_.draw(session.history)
        for view in (*self.query(JointStrips), *self.query(JointTable)):
            view.chosen = session.selected
            view.draw(session.history)

    def _top(self) -> Text:
        session = self.session
        text = Text.assemble(("Open Ant", "bold"), f"  {self.title}  ", no_wrap=True, overflow=overflow())
        text.append(session.name if session.folder is not None else "no robot's folder", "bold")
        if self.ant.announced:
            text.append(f"  {mark('info')} {self.ant.announced}", "bold")
        elif session.doing:
            text.append(f"  {mark('wait')} {session.doing}", MARKS["wait"].colour)
        elif session.feed is not None:
            text.append(f"  {mark('info')} {session.feed.title}")
        elif session.virtual is not None:
            text.append(f"  {mark('info')} virtual robot")
        else:
            text.append(f"  {mark('off')} not connected")
        if len(session.history.rows) and not session.history.over:
            on = session.history.newest("torque") > 0
            text.append("  ")
            text.append_text(marked("on" if on else "off", "torque ON" if on else "torque off"))
        stop = "[SPACE: STOP]" if plain() else " SPACE: STOP "
        room = max(self.size.width - 2 - len(stop) - 1, 0)
        text.truncate(room, overflow=overflow(), pad=True)
        # The brightest thing of every screen, by its brightness alone where there are no colours.
        return text.append(" ").append(stop, STOP_STYLE)

    def on_key(self, event: events.Key) -> None:
        """A digit that nothing else wants is one of a step's number."""
        if event.character is not None and event.character in "0123456789" and not isinstance(self.focused, Input):
            event.stop()
            self.ant.take_digit(event.character)

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        # Of a key that was pressed twice the second may find its line gone, or another screen on top.
        if self.app.screen is self and event.option in event.option_list.options:
            self.chosen(event)

    def chosen(self, event: OptionList.OptionSelected) -> None:
        """A line of one of the screen's lists was chosen."""

    def on_joint_chosen(self, message: JointChosen) -> None:
        self.session.selected = message.joint
        self.draw()


def too_small(size: Size) -> bool:
    """Whether a window has no room for a screen."""
    return size.width < LEAST[0] or size.height < LEAST[1]


def put(place: Static, words: Text) -> None:
    """Show words in a place, where they are not shown already; the page is laid out anew only if the place may grow."""
    shown = place.content
    if not isinstance(shown, Text) or shown != words or shown.style != words.style:
        alike = isinstance(shown, Text) and [len(line) for line in shown.split()] == [
            len(line) for line in words.split()
        ]
        place.update(words, layout=not alike)


def help_of(widget: Widget) -> str:
    """What a widget says of itself on F1; "" where it has nothing of its own to say."""
    return str(getattr(widget, "HELP", None) or "")
