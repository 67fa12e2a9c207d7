"""The terminal program: one app, one session, screens on top of each other; keys that hold everywhere."""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from types import FrameType
from typing import ClassVar

from rich.text import Text
from textual import events, work
from textual.app import App, SystemCommand
from textual.binding import Binding, BindingType
from textual.screen import Screen
from textual.theme import Theme
from textual.widget import Widget
from textual.widgets import Input

from openant_tools.bringup.walk import BENCH, BESIDE, WALK, standing
from openant_tools.errors import OpenAntError
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.kit import KITS
from openant_tools.signals import SUSPENDED, TOLD_TO_GO, heard
from openant_tools.tui.dialogs import Help, Question
from openant_tools.tui.feeds import ReplayFeed
from openant_tools.tui.jump import Jump
from openant_tools.tui.marks import BLUE, GREEN, ORANGE, VERMILION, plain
from openant_tools.tui.page import LEAST, ROOMY, Page, help_of, too_small
from openant_tools.tui.screens.findings import FindingsScreen
from openant_tools.tui.screens.gap import GapScreen
from openant_tools.tui.screens.learn import LearnScreen
from openant_tools.tui.screens.live import LiveScreen
from openant_tools.tui.screens.recordings import RecordingsScreen
from openant_tools.tui.screens.settings import SettingsScreen
from openant_tools.tui.screens.step import StepScreen
from openant_tools.tui.screens.walk import WalkScreen, continues
from openant_tools.tui.session import Session
from openant_tools.virtual.process import VIRTUAL_DEFAULT

__all__ = ["OpenAnt", "run"]

#: how often screens take in what is new
TICK_S = 0.1
#: how long a step may take to put the robot in order when the program ends
END_S = 10.0

INTERRUPTED = 130
#: what acts where the window is too small to see what anything else would do: stop, quit, suspend
UNSEEN_KEYS = {"space", "ctrl+c", "ctrl+z"}
_log = logging.getLogger(__name__)
#: the folder that is offered where there is none
NEW_ROBOT = "my-ant"
SCENARIOS = Path(__file__).parent / "scenarios"

THEME = Theme(
    "open-ant", primary=BLUE, secondary="#CC79A7", accent=ORANGE, success=GREEN, warning=ORANGE, error=VERMILION,
    background="#10151b", surface="#171d25", panel="#202833", foreground="#e6e6e6", dark=True,
)  # fmt: skip

SCREENS: Mapping[str, tuple[type[Page], str]] = {
    "live": (LiveScreen, "All joints live, torque off"),
    "findings": (FindingsScreen, "What was found out about this robot; its passport"),
    "recordings": (RecordingsScreen, "Recordings, and their replay on any screen"),
    "gap": (GapScreen, "Why the simulation is not as the robot, and how far it can be mended"),
    "learn": (LearnScreen, "Train an agent, see it learn"),
    "settings": (SettingsScreen, "The robot's folder, how it looks, what this machine has"),
}

#: words → source for `Session.start_virtual`, of the virtual robots that can be chosen beside the walk's own
VIRTUAL_ROBOTS: tuple[tuple[str, str], ...] = (
    ("A healthy robot on its stand, ids and zeros as they should be", VIRTUAL_DEFAULT),
    ("A healthy robot on the floor, under its camera", str(SCENARIOS / "floor.toml")),
)

#: number of a step, as typed → its name
_NUMBERS: Mapping[str, str] = {str(k): name for k, name in enumerate(WALK, 1)}
#: s that a typed number waits for Enter
TYPED_S = 4.0

GENERAL_HELP = """\
# Everywhere

| key | |
|---|---|
| `space` | **STOP**: torque off, at any time, on every screen |
| `F8` | a fault has been seen (it stays on every screen until then) |
| `Ctrl-P` | palette: every command by name |
| `Ctrl-O` | jump mode: a letter on everything that can be gone to |
| `Tab`, arrows, `Enter` | move, choose |
| `Esc` | back; on the first screen: quit |
| `F1` | help on the step, or on what has the focus |
| a step's number, `Enter` | that step |
"""


class OpenAnt(App[int]):
    """The program.

    Args:
        path: the robot's folder.
        virtual: start with this virtual robot (`openant_tools.virtual.process`); None for none.
        clock: of a virtual robot that is started here; "real" unless a test steps it.
        ticking: whether screens follow the session by themselves; a test may tick by hand.
    """

    TITLE = "Open Ant"
    CSS_PATH = "app.tcss"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("space", "stop", "STOP", priority=True, show=False),
        Binding("ctrl+c", "interrupt", show=False, priority=True),
        Binding("ctrl+z", "suspend_process", show=False),
        # tmux makes alt+f1 of an Esc and an F1 that come soon after each other.
        Binding("f1,alt+f1", "help", "Help", key_display="F1", priority=True),
        Binding("ctrl+o", "jump", "Jump", show=False),
        # Of a number that was typed; any other Enter goes to what has the focus.
        Binding("enter", "open_typed", show=False, priority=True),
        Binding("ctrl+p", "command_palette", "All", key_display="^P"),
        Binding("f8,alt+f8", "see", "Seen", show=False),
        Binding("p", "pause", "Pause", show=False),
        Binding("comma", "seek(-0.1)", show=False),
        Binding("full_stop", "seek(0.1)", show=False),
        Binding("left_square_bracket", "seek(-5)", show=False),
        Binding("right_square_bracket", "seek(5)", show=False),
        Binding("less_than_sign", "speed(0.5)", show=False),
        Binding("greater_than_sign", "speed(2)", show=False),
        Binding("x", "end_replay", show=False),
    ]
    #: from which size on a screen uses the room beside and below
    HORIZONTAL_BREAKPOINTS = [(0, "-small"), (LEAST[0], "-narrow"), (ROOMY[0], "-wide")]  # noqa: RUF012
    VERTICAL_BREAKPOINTS = [(0, "-low"), (LEAST[1], "-short"), (ROOMY[1], "-tall")]  # noqa: RUF012

    def __init__(
        self, path: Path, *, virtual: str | None = None, clock: str | None = "real", ticking: bool = True
    ) -> None:
        super().__init__()
        self.session = Session(path)
        # With the one robot whose folder lies here it goes on; of several the builder is asked which.
        robots = self.session.robots_here() if self.session.folder is None else []
        if len(robots) == 1:
            self.session.open(robots[0])
        self._virtual = virtual
        self._clock = clock
        self._ticking = ticking
        self._typed = ""
        self.register_theme(THEME)
        self.theme = THEME.name
        self.set_class(plain(), "-ascii")

    def get_default_screen(self) -> WalkScreen:
        return WalkScreen()

    def on_mount(self) -> None:
        if self._ticking:
            self.set_interval(TICK_S, self.tick)
        self._stop_before_suspension()
        self._go_when_told()
        if self.session.folder is None and self.session.robots_here():
            self.call_after_refresh(self.need_folder, lambda: None)
        if self._virtual is not None:
            self.start_virtual(self._virtual)

    def tick(self) -> None:
        """Let the screen show what came since the last tick."""
        if not self.screen_stack:  # a last tick that was due as the program closed
            return
        before = self.session.feed
        self.session.tick()
        notices, self.session.notices = self.session.notices, []
        if notices:
            more = f" (and {len(notices) - 1} more)" if len(notices) > 1 else ""
            self.notify(f"{notices[0]}{more}", title="Robot", timeout=8)
        if (
            not isinstance(self.screen, Page) or not self.screen.is_mounted
        ):  # a busy computer may not have filled it yet
            return
        if self.session.feed is not None or before is not None or self._running_step:
            self.screen.draw()

    async def on_event(self, event: events.Event) -> None:
        """Let no key act on what a window that is too small does not show."""
        typed = event.key not in UNSEEN_KEYS if isinstance(event, events.Key) else isinstance(event, events.Paste)
        if not (typed and too_small(self.size)):
            await super().on_event(event)

    # ---- stop ----------------------------------------------------------------------------------------------------

    def action_stop(self) -> None:
        """The stop key: torque off first, everything else after."""
        told = self.session.release()
        for screen in self.screen_stack:
            if isinstance(screen, StepScreen):
                screen.stopped()
        if isinstance(self.focused, Input) and not too_small(self.size):
            self.focused.insert_text_at_cursor(" ")
            if not told:
                return
        words = "STOP: torque is switched off" if told else "STOP: this program holds no robot"
        self.notify(words, severity="error" if told else "information", timeout=4)

    def action_interrupt(self) -> None:
        """Ctrl-C: torque off, everything put in order, gone."""
        self.session.release()
        self._quit(INTERRUPTED)

    def _stop_before_suspension(self) -> None:
        """Whoever suspends the program stops the robot first; nothing that moved goes on when it comes back."""
        suspend = None if SUSPENDED is None else signal.getsignal(SUSPENDED)
        if SUSPENDED is None or not callable(suspend):  # no terminal: a test
            return

        def stop(number: int, frame: FrameType | None) -> None:
            self.session.release()
            if self._running_step is not None:
                self._running_step.end("suspended")
            suspend(number, frame)

        signal.signal(SUSPENDED, stop)

    def _go_when_told(self) -> None:
        """Being told to go, and a terminal that is gone, are as good as Ctrl-C. An exception amid what draws would leave its
        threads behind, and with them this program."""
        loop = asyncio.get_running_loop()

        def go(number: int, frame: FrameType | None) -> None:
            heard(number)
            self.session.release()
            loop.call_soon_threadsafe(self.action_interrupt)

        for number in TOLD_TO_GO:
            if callable(signal.getsignal(number)):  # else it is ignored, as under nohup, or this is a test
                signal.signal(number, go)

    def _fatal_error(self) -> None:
        """Textual's end for a fault of the program: torque goes off, the log has the traceback, the terminal one line."""
        self.session.release()
        error = sys.exc_info()[1]
        _log.info("a fault of the program", exc_info=True)
        files = [one.baseFilename for one in logging.getLogger().handlers if isinstance(one, logging.FileHandler)]
        log = f"the log is {files[0]}" if files else "nothing is logged here"
        what = " ".join(f"{type(error).__name__}: {error}".split())
        self.panic(
            Text(f"openant: a fault of the program, torque is off: {what} → report it (`openant support`); {log}")
        )

    async def action_quit(self) -> None:
        self.action_leave()

    def action_leave(self) -> None:
        """Quit; asks first where something is going on, or a robot is held."""
        if self._running_step is not None or self.session.learning or self.session.computing:
            words = (
                "Something is still running. Quit all the same? Torque goes off; training and what a diagnosis simulated are "
                "saved and can go on later."
            )
        elif self.session.watching:
            words = "This program holds the robot. Quit all the same? Torque goes off, and its bus is given free."
        elif self.session.virtual is not None:
            words = (
                "A virtual robot runs in this program. Quit all the same? It ends; what its servos remember is kept."
            )
        else:
            self._quit(0)
            return
        self.push_screen(Question(words, "Quit", "Stay"), self._answered_quit)

    def _answered_quit(self, choice: int | None) -> None:
        if choice == 0:
            self._quit(0)

    @property
    def _running_step(self) -> StepScreen | None:
        return next((one for one in self.screen_stack if isinstance(one, StepScreen) and one.running), None)

    @work(exclusive=True, group="quit")
    async def _quit(self, code: int) -> None:
        """End what runs and wait for it, so that the robot is in order before the terminal is given back."""
        running = self._running_step
        if running is not None:
            running.end()
        for _ in range(round(END_S / TICK_S)):
            if self._running_step is None:
                break
            await asyncio.sleep(TICK_S)
        self.exit(code, return_code=code)

    # ---- going about ---------------------------------------------------------------------------------------------

    async def action_back(self) -> None:
        if len(self.screen_stack) > 1:
            self.pop_screen()

    def action_go(self, name: str) -> None:
        """Open a screen by its name in `SCREENS`; where it is open already, go back to it."""
        kind, _ = SCREENS[name]
        for screen in self.screen_stack:
            if isinstance(screen, kind):
                while self.screen is not screen:
                    self.pop_screen()
                return
        self.push_screen(kind())

    def need_folder(self, then: Callable[[], None]) -> None:
        """Go on once there is a robot's folder; where there is none yet, offer to make one."""
        if self.session.folder is not None:
            then()
            return
        robots, place, kits = self.session.robots_here(), self.session.new_place(NEW_ROBOT), list(KITS.values())

        def answered(choice: int | None) -> None:
            if choice is None:
                return
            if choice == len(robots) + len(kits):
                self.action_go("settings")
                return
            try:
                if choice < len(robots):
                    self.session.open(robots[choice])
                else:
                    self.session.create(place, kits[choice - len(robots)].name)
            except OpenAntError as error:
                self.notify(str(error), severity="error")
                return
            self.refresh_walk()
            then()

        if robots:
            words = "Which robot?"
            offers = [continues(RobotFolder(path)) for path in robots]
            offers += [f"A new one in {place.name}: {kit.words}" for kit in kits]
        else:
            words = f"All that is found out about a robot is kept in a folder. There is none here yet: make {place}?"
            offers = [f"Yes: {kit.words}" for kit in kits]
        self.push_screen(Question(words, *offers, "Another place, or one that is there already: Setup"), answered)

    def open_step(self, name: str, *, instead: bool = False) -> None:
        """Open a step of the walk, on top or instead of the screen that is open."""
        self.need_folder(lambda: self._open_step(name, instead))

    def _open_step(self, name: str, instead: bool) -> None:
        running = self._running_step
        if running is not None and not instead:
            self.notify(f"{running.step.title} is still running: leave it first", severity="warning")
            return
        screen = StepScreen(BESIDE[name] if name in BESIDE else WALK[name])
        if instead:
            self.switch_screen(screen)
        else:
            self.push_screen(screen)

    def action_step(self, name: str) -> None:
        self.open_step(name)

    def action_bench(self) -> None:
        """Ask which of the bench's procedures is meant, and open it."""
        names = list(BENCH)

        def answered(choice: int | None) -> None:
            if choice is not None:
                self.open_step(names[choice])

        self.push_screen(Question("On the bench", *(f"{one.title}: {one.does}" for one in BENCH.values())), answered)

    def action_jump(self) -> None:
        if not isinstance(self.screen, Jump):
            self.push_screen(Jump(self.screen))

    def action_help(self) -> None:
        """Help on the step at hand, the focused widget or the screen, and the keys that hold everywhere."""
        if isinstance(self.screen, Help):
            self.pop_screen()
            return
        # What the screen is for comes before how its lists are gone through.
        own = "\n".join(words for widget in reversed([*self._focus_path()]) if (words := help_of(widget)))
        # A question is about the page below it.
        about = next(screen for screen in reversed(self.screen_stack) if isinstance(screen, Page))
        self.push_screen(Help(f"{about.about}\n{own}\n{GENERAL_HELP}", about.doc))

    def _focus_path(self) -> Iterable[Widget]:
        widget: Widget | None = self.focused
        while widget is not None and widget is not self.screen:
            yield widget
            widget = widget.parent if isinstance(widget.parent, Widget) else None
        yield self.screen

    def action_see(self) -> None:
        """Faults have been seen."""
        self.session.faults.see()
        if isinstance(self.screen, Page):
            self.screen.draw()

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        yield SystemCommand("STOP", "Torque off, now", self.action_stop)
        yield SystemCommand("Help", "On what has the focus", self.action_help)
        for name, (kind, words) in SCREENS.items():
            yield SystemCommand(kind.TITLE, words, partial(self.action_go, name))
        for name, step in WALK.items():
            yield SystemCommand(f"Step: {step.title}", step.does, partial(self.open_step, name))
        for name, step in BESIDE.items():
            yield SystemCommand(step.title, step.does, partial(self.open_step, name))
        yield SystemCommand("Watch the robot", "Live strips, torque off", self.action_watch)
        yield SystemCommand("Virtual robot", "Start one, or end the one that runs", self.action_virtual)
        yield SystemCommand("Faults seen", "Take them off the screen", self.action_see)
        yield SystemCommand("Theme", "Colours", self.search_themes)
        yield SystemCommand("Quit", "Torque off, back to the shell", self.action_leave)

    # ---- the robot -----------------------------------------------------------------------------------------------

    def action_virtual(self) -> None:
        """Start a virtual robot, or end the one that runs."""
        if self._running_step is not None:
            self.notify("a step is running: leave it first", severity="warning")
        elif self.session.virtual is None:
            self.need_folder(self._ask_virtual)
        else:
            words = "End the virtual robot? What it is like is kept where it is this folder's own."
            self.push_screen(Question(words, "Yes, end it", "No"), self._end_virtual)

    def _end_virtual(self, choice: int | None) -> None:
        if choice == 0:
            self._in_background("ending the virtual robot", self.session.end_virtual, self.refresh_walk)

    def _ask_virtual(self) -> None:
        """Offer the robot of this folder's walk, as far as it is built, and healthy ones."""
        states = {} if self.session.folder is None else standing(self.session.folder)
        if states and states["legs"].state == "ok":
            own = "The robot of this walk, built, on its stand (kept in this folder)"
        else:
            own = "Loose motors in their box, for the walk from its beginning (kept in this folder)"

        def chose(choice: int | None) -> None:
            if choice is not None:
                self.start_virtual([None, *(source for _, source in VIRTUAL_ROBOTS)][choice])

        self.push_screen(Question("Which virtual robot?", own, *(words for words, _ in VIRTUAL_ROBOTS)), chose)

    def start_virtual(self, source: str | None) -> None:
        """Start a virtual robot and tell the first screen."""
        self._in_background(
            "starting a virtual robot", lambda: self.session.start_virtual(source, self._clock), self.refresh_walk
        )

    def action_watch(self) -> None:
        """The live screen; connects where nothing is connected yet."""
        self.action_go("live")
        if self.session.feed is None and self._running_step is None:
            self._in_background("connecting, torque off", self.session.connect, lambda: None)

    def diagnose(self, recording: Path) -> None:
        """Have a recording diagnosed, on the screen of the gap."""

        def begin() -> None:
            if isinstance(self.screen, GapScreen):
                self.screen.diagnose([recording])

        self.action_go("gap")
        self.call_after_refresh(begin)

    def free_bus(self, then: Callable[[], None]) -> None:
        """Stop watching, so that a step can have the bus, then go on."""
        if self.session.watching:
            self._in_background("giving the bus free", self.session.disconnect, then)
        else:
            then()

    def refresh_walk(self) -> None:
        for screen in self.screen_stack:
            if isinstance(screen, WalkScreen):
                screen.refresh_steps()
                screen.draw()

    @work(thread=True, group="robot")
    def _in_background(self, words: str, do: Callable[[], None], then: Callable[[], None]) -> None:
        self.call_from_thread(self._say_doing, words)
        try:
            do()
        except OpenAntError as error:
            self.session.faults.note("", str(error))
        else:
            self.call_from_thread(then)
        finally:
            self.call_from_thread(self._say_doing, "")

    def _say_doing(self, words: str) -> None:
        self.session.doing = words
        if isinstance(self.screen, Page):
            self.screen.draw()

    # ---- replay --------------------------------------------------------------------------------------------------

    def play(self, feed: ReplayFeed) -> None:
        """Show a recording on all screens, beginning with the live one."""
        self.session.play(feed)
        self.action_go("live")

    # ---- a step by its number ------------------------------------------------------------------------------------

    def take_digit(self, digit: str) -> None:
        """A digit of a step's number, which Enter opens."""
        number = self._typed + digit if f"{self._typed}{digit}" in _NUMBERS else digit
        if number not in _NUMBERS:
            self._typed = ""
            self._announce()
            return
        self._typed = number
        for screen in self.screen_stack:
            if isinstance(screen, WalkScreen):
                screen.go_to(_NUMBERS[number])
        self._announce()
        self.set_timer(TYPED_S, partial(self._forget_typed, number))

    @property
    def announced(self) -> str:
        """See `page.Program`; the walk shows it by its cursor."""
        if not self._typed or isinstance(self.screen, WalkScreen):
            return ""
        return f"{self._typed} {WALK[_NUMBERS[self._typed]].title}: Enter opens it"

    def _announce(self) -> None:
        if isinstance(self.screen, Page):
            self.screen.draw()

    def _forget_typed(self, number: str) -> None:
        if self._typed == number:
            self._typed = ""
            self._announce()

    def action_open_typed(self) -> None:
        name, self._typed = _NUMBERS[self._typed], ""
        running = self._running_step
        if running is None and isinstance(self.screen, StepScreen):
            self.open_step(name, instead=True)
        else:
            self.open_step(name)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        if action == "open_typed":
            return bool(self._typed) and not isinstance(self.focused, Input) and isinstance(self.screen, Page)
        if action in ("pause", "seek", "speed", "end_replay"):
            return self.session.replay is not None
        return True

    def action_pause(self) -> None:
        replay = self.session.replay
        if replay is not None:
            replay.playing = not replay.playing

    def action_seek(self, seconds: float) -> None:
        replay = self.session.replay
        if replay is not None:
            replay.seek(replay.position_s + seconds)

    def action_speed(self, factor: float) -> None:
        replay = self.session.replay
        if replay is not None:
            replay.speed = min(max(replay.speed * factor, 0.125), 16.0)

    def action_end_replay(self) -> None:
        self.session.play(None)
        if isinstance(self.screen, Page):
            self.screen.draw()


def run(path: Path, virtual: str | None = None) -> int:
    """Run the program in this terminal until it is left; the exit code. However it ends, torque is off afterwards."""
    app = OpenAnt(path, virtual=virtual)
    try:
        app.run()
    finally:
        app.session.close()
    return app.return_code or 0
