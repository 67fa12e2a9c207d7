"""One step of the walk: what it says and asks, from its procedure in a thread; its finding; what comes next."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Container, Vertical, VerticalScroll
from textual.widgets import Input, OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.bringup.walk import WALK, Standing, beside, standing
from openant_tools.errors import OpenAntError, system_faults
from openant_tools.numbers import exact, number, percent, span
from openant_tools.procedure.finding import Finding
from openant_tools.procedure.journal import Journal
from openant_tools.procedure.step import (
    Answer,
    Ask,
    Drawing,
    Event,
    Hands,
    Intent,
    Live,
    Progress,
    Say,
    Step,
    change_lines,
)
from openant_tools.procedure.unfinished import forget
from openant_tools.robot.folder import RobotFolder
from openant_tools.robot.joints import JOINT_NAMES
from openant_tools.tui.bars import bars
from openant_tools.tui.choices import Choices
from openant_tools.tui.dialogs import Question
from openant_tools.tui.found import numbers_lines, verdict
from openant_tools.tui.joint_table import JointTable
from openant_tools.tui.leg_map import LegMap
from openant_tools.tui.marks import MARKS, Name, mark, marked, overflow, plain, spelled
from openant_tools.tui.page import Page, put
from openant_tools.tui.screens.walk import standing_mark
from openant_tools.tui.step_help import step_doc, step_help
from openant_tools.tui.step_run import BY_VIRTUAL_HANDS, StepRun

__all__ = ["StepScreen"]

#: of live bars: more than these take the place of the robot in a small window
FEW_BARS = 2
#: lines of the places for what to do now, and for what was found
NOW_LINES, FOUND_LINES = 6, 4
#: columns of the robot beside the rest, where there is room
ROBOT = 56
#: the answer that the stop key gives where a procedure asks for the stop key
STOP = "stop"
_LEVELS: Mapping[str, Name] = {"info": "info", "ok": "ok", "warn": "warn", "fail": "fail"}


@dataclass(frozen=True)
class StepChoice:
    """One line to choose, and what choosing it does."""

    words: str
    do: Callable[[], None]


def _under_way(intent: Intent) -> str:
    return f"Under way: {intent.words}."


def _sentence(words: str) -> str:
    """What is to be done as a sentence; a command stays as it is typed."""
    return words if not words or words.startswith("openant") else f"{words[0].upper()}{words[1:]}."


class Log(VerticalScroll):
    """Lines below each other. What was said last is what is seen, however the rest of the screen grows, until one scrolls."""

    follows = True

    def say(self, words: Text) -> None:
        self.mount(Static(words if not plain() else Text(spelled(words.plain), words.style)))
        self._follow()

    def on_resize(self) -> None:
        self._follow()

    def turn(self, by: int) -> None:
        """Scroll by so many pages."""
        self.scroll_relative(y=by * max(1, self.size.height - 1), animate=False)
        self.follows = self.scroll_target_y >= self.max_scroll_y

    def _follow(self) -> None:
        if self.follows:
            self.call_after_refresh(self.scroll_end, animate=False)


class StepScreen(Page):
    """Three fixed places: above what to do now and what was found, below what is asked and what comes next. Between them the
    robot as it is now, and the log; once there is a finding, its numbers instead of the log."""

    HELP = """\
# A step of the walk

The step says what it will do and which registers it will change, and does nothing before you grant it. Arrow keys and
`Enter` answer. `Space` is the stop key at any time: torque off, the step ends. `Esc` leaves the step; it ends in order,
and can be begun again: what it found or wrote before stays, and every write to a servo's memory stands in
`journal.jsonl` with the value before, so that it can be undone.

The table shows each joint while something reads it: whether its servo answers, angle, load (of servos that
measure no current; `A` is the current of the others), heat, supply; the line at the top whether torque is on. What is not of
now is dimmed, with how long ago it was. The drawing beside the table shows where the legs are. When the step has ended its numbers stand there: a bar's thick part is what is allowed, the dot
where the number lies. `l` shows the log of what was said and done instead.
"""
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", "Leave"),
        Binding("l", "log", "Log"),
        # The list of answers, which has the focus, has such keys of its own.
        Binding("pageup", "scroll(-1)", "Scroll", key_display="pgup/dn", priority=True),
        Binding("pagedown", "scroll(1)", "Scroll", show=False, priority=True),
    ]

    def __init__(self, step: Step) -> None:
        super().__init__()
        self.step = step
        self.title = step.title
        self._run: StepRun | None = None
        self.choices: list[StepChoice] = []
        self._pending: Event | None = None
        self._progress: Progress | None = None
        self._live: Live | None = None
        self._drawn_live: Live | None = None
        self._granted_all = False
        self._now = ""
        self._found: Finding | None = None
        self._found_before = ""
        #: whether the log is wanted where there are numbers to show
        self._log_wanted = False

    @property
    def about(self) -> str:
        return step_help(self.step)

    @property
    def doc(self) -> str:
        return step_doc(self.step)

    @property
    def verdict(self) -> Text:
        if self._found is not None and not self.running:
            return self._pinned()
        return Text.assemble(self._head(), "\n", spelled(self._now))

    def body(self) -> ComposeResult:
        yield Static(id="head")
        yield Static(id="now")
        yield Static(id="found")
        with Container(id="work"):
            with Container(id="robot"):
                yield JointTable(self.session.history)
                yield LegMap(self.session.history, captioned=False)
            yield Log(id="log", can_focus=True)
            yield VerticalScroll(Static(id="numbers"), id="result", can_focus=True)
        with Vertical(id="ask"):
            yield Static(id="bars")
            yield Static(id="question")
            yield Choices(id="choices")
            yield Input(id="value")

    def on_mount(self) -> None:
        super().on_mount()
        self.introduce()

    @property
    def found(self) -> Finding | None:
        """What it found, now or the last time."""
        return self._found

    @property
    def running(self) -> bool:
        """Whether its procedure has not come to its end yet."""
        return self._run is not None

    def draw(self) -> None:
        super().draw()
        if not self.query("#numbers"):
            return  # not filled yet
        put(self.query_one("#head", Static), self._head())
        now, found = self.query_one("#now", Static), self.query_one("#found", Static)
        now.display, found.display = bool(self._now) and not self.small, self._found is not None and not self.small
        put(now, Text(spelled(self._now), style="bold"))
        if self._found is not None:
            put(found, self._pinned())
        if self._live is not self._drawn_live:
            self._drawn_live = self._live
            line = self.query_one("#bars", Static)
            line.display = self._live is not None and not self._in_table
            if self._live is not None:
                put(line, bars(self._live, line.size.width or self.size.width - 4))
                self.session.read(self._live.angles_rad)
        result = self._found is not None and not self._log_wanted
        self.query_one("#log").display = not result
        self.query_one("#result").display = result
        self.query_one("#robot").display = self._robot_shown

    @property
    def _in_table(self) -> bool:
        """Whether the robot's table tells what live bars would, in a small window."""
        live = self._live
        joints = live is not None and live.unit == "rad" and len(live.values) > FEW_BARS
        return joints and self.session.feed is not None and not self.roomy

    @property
    def _robot_shown(self) -> bool:
        """Where there is room always; in a small window while it is read, unless bars of all its joints stand there."""
        if self.roomy:
            return True
        if self._live is not None and len(self._live.values) > FEW_BARS and not self._in_table:
            return False
        return self.running and len(self.session.history.rows) > 0

    def _head(self) -> Text:
        text = Text(no_wrap=True, overflow=overflow())
        if self.running:
            progress = self._progress
            share = "" if progress is None or progress.share is None else f" {percent(progress.share)}"
            text.append_text(marked("wait", f"running{share}  "))
            if self._pending is not None:
                text.append_text(marked("warn", "your turn"))
            elif progress is not None:
                text.append(spelled(progress.words))
        elif self.session.folder is not None:
            text.append_text(standing_mark(self._standing(self.session.folder)))
        return text

    # ---- before and after ----------------------------------------------------------------------------------------

    def introduce(self) -> None:
        """What the step is about, and the offer to begin."""
        step, folder = self.step, self.session.folder
        self._now = step.does
        for words in self._needs():
            self.say(Text(words))
        if folder is None:
            self.say(
                marked("warn", f"there is no robot's folder at {self.session.path.resolve()}: make one in Setup (s)")
            )
            self.offer("", [StepChoice("Setup", lambda: self.ant.action_go("settings")), self._back()])
            return
        one = self._standing(folder)
        if one.waits_for:
            names = ", ".join(WALK[name].title for name in one.waits_for)
            self.say(marked("warn", f"do first: {names}"))
        if one.finding is not None:
            self.show_finding(one.finding, "the last time: ")
        self.offer("", [*self._beginnings("Begin"), self._back()])
        self.draw()

    def _standing(self, folder: RobotFolder) -> Standing:
        real = self.session.virtual is None
        if self.step.name in WALK:
            return standing(folder, real=real)[self.step.name]
        return beside(folder, self.step, real=real)

    def _needs(self) -> list[str]:
        """What must be at hand, and what it does to the robot."""
        step = self.step
        moves = "The robot moves; you are asked before it does." if step.moves else "Nothing moves."
        needs = [f"You need {step.table}."] if step.table else []
        return [*needs, f"It changes {step.changes or 'nothing'}. {moves} About {number(step.minutes)} min."]

    def _beginnings(self, words: str) -> list[StepChoice]:
        """To begin; where it was left in the middle, first of all to go on there."""
        folder = self.session.folder
        left = None if folder is None else self._standing(folder).left
        if left is None:
            return [StepChoice(words, self.begin)]
        self.say(
            marked(
                "warn",
                f"stopped after {left.words}; done: {left.done_words}",
            )
        )
        onwards = StepChoice(f"Go on at {len(left.done) + 1} of {len(left.of)}: {left.next}", self.begin)
        return [onwards, StepChoice(f"{words} from the first", self.begin_anew)]

    def begin_anew(self) -> None:
        """Run it from its start, whatever of it was done before."""
        if self.session.folder is not None:
            try:
                with system_faults(where=self.session.folder.path, again="try again"):
                    forget(self.session.folder, self.step.name, virtual=self.session.virtual is not None)
            except OpenAntError as error:
                self.say(marked("fail", str(error)))
                return
        self.begin()

    def begin(self) -> None:
        """Run the procedure from its start."""
        session = self.session
        try:
            bench = session.bench()
        except OpenAntError as error:
            self.say(marked("fail", str(error)))
            return
        self.offer("", [])
        self.say(marked("wait", f"{self.step.title} begins"))
        self._granted_all = False
        self._progress = self._live = self._found = None
        self._now = self.step.does
        if session.replay is not None:
            session.play(None)
        run = self._run = StepRun(
            self.step, bench, self._from_thread, lambda finding, why: self._to_screen(self.ended, finding, why)
        )
        # The bus has one master: who only watched gives it free first.
        self.ant.free_bus(run.start)

    def ended(self, finding: Finding | None, why: str) -> None:
        """The procedure is through: draw what it found, or why it did not."""
        self._run = self._pending = self._progress = self._live = None
        if finding is None:
            self.say(marked("fail", why))
            self._now = why
            self.offer("It ended without a finding.", [*self._beginnings("Begin again"), self._back()])
        else:
            self.show_finding(finding)
            rest = "Nothing is left to do here." if finding.ok else "See why below; begin again once that is mended."
            self._now = _sentence(finding.next_action) or rest
            [*ahead, again] = self._beginnings("Begin again")
            names = list(WALK)
            after = names.index(self.step.name) + 1 if self.step.name in names else len(names)
            following = names[after] if after < len(names) else None
            choices = [*ahead, again, self._back()]
            if following is not None:
                forward = StepChoice(
                    f"Next: {WALK[following].title}", lambda: self.ant.open_step(following, instead=True)
                )
                choices = [forward, *choices] if finding.ok else [*ahead, again, forward, self._back()]
            elif self.step.name in WALK and finding.ok:
                choices = [StepChoice("Next: train an agent", lambda: self.ant.action_go("learn")), *choices]
            if self._wrote():
                choices.append(
                    StepChoice("Undo what was written last", lambda: self.ant.open_step("undo", instead=True))
                )
            self.offer("", choices)
        self.draw()

    def _wrote(self) -> bool:
        """Whether the journal holds a write of this step that nothing has taken back."""
        folder = self.session.folder
        if folder is None:
            return False
        left = Journal(folder.journal).open_entries()
        return bool(left) and left[-1].command.endswith(f" {self.step.name}")

    def show_finding(self, finding: Finding, before: str = "") -> None:
        self._found, self._found_before = finding, before
        self.refresh_bindings()
        self._log_wanted = False
        self._draw_numbers()
        self.query_one("#result", VerticalScroll).scroll_home(animate=False)

    def _pinned(self) -> Text:
        """The verdict, with what is wrong as far as there is room; else where it stands."""
        assert self._found is not None
        whole = verdict(self._found, self._found_before)
        if self._fits(whole):
            return whole
        first = whole.split("\n")[0]
        return first.append(f"\n  {mark('warn')} {len(self._found.lines)} problems, listed below", MARKS["warn"].colour)

    def _fits(self, whole: Text) -> bool:
        return sum(self._rows(line) for line in whole.plain.split("\n")) <= FOUND_LINES

    def _draw_numbers(self) -> None:
        if self._found is None:
            return
        beside = ROBOT if self.roomy else 0
        lines = numbers_lines(self._found, self.size.width - beside - 3)
        whole = verdict(self._found)
        if not self._fits(whole):
            lines = [*whole.split("\n")[1:], Text(), *lines]
        if self._found_before:  # before it begins one reads what it needs and changes
            lines = [*(Text(spelled(words)) for words in self._needs()), Text(), *lines]
        self.query_one("#numbers", Static).update(Text("\n").join(lines))

    def on_resize(self) -> None:
        super().on_resize()
        if self.query("#numbers"):
            self._draw_numbers()

    # ---- from the procedure --------------------------------------------------------------------------------------

    def _from_thread(self, event: Event) -> None:
        """Called in the procedure's thread: what changes many times a second waits for the next tick."""
        if isinstance(event, Live | Progress):
            self.shown(event)
        else:
            self._to_screen(self.shown, event)

    def _to_screen(self, callback: Callable[..., None], *arguments: object) -> None:
        if self.is_attached and self.app.is_running:
            self.app.call_from_thread(callback, *arguments)

    def shown(self, event: Event) -> None:
        """Draw one event, and offer the answers that it takes; the joint that it is about is the chosen one."""
        about = event.joint if isinstance(event, Hands) else ""
        if isinstance(event, Live) and len(event.values) == 1:
            about = next(iter(event.values))
        if about in JOINT_NAMES:
            self.session.selected = about
        if isinstance(event, Intent | Ask | Hands) and not (isinstance(event, Hands) and event.while_watching):
            self._live = None  # what is asked has nothing to do with what was seen before
        if isinstance(event, Live):
            self._live = event
        elif isinstance(event, Progress):
            self._progress = event
        elif isinstance(event, Say):
            self.say(marked(_LEVELS[event.level], event.words))
        elif isinstance(event, Drawing):
            self.say(Text("\n".join(part for part in (event.words, event.drawing) if part)))
            if event.picture is not None:
                self.say(Text(f"picture: {event.picture}"))
        elif isinstance(event, Intent):
            self._intend(event)
        elif isinstance(event, Ask):
            self._ask(event)
        elif isinstance(event, Hands):
            self._hands(event)

    def _intend(self, event: Intent) -> None:
        words, lines = f"It will {event.words}.", change_lines(event.registers)
        # What is to be granted stands where it is seen, as far as there is room.
        room = NOW_LINES - self._rows(words)
        if len(lines) > room:
            left = lines[max(room - 1, 0) :]
            self.say(Text("\n".join(["It will write, too:", *(f"  {line}" for line in left)])))
            lines = [*lines[: max(room - 1, 0)], f"and {len(left)} more, below"]
        self._now = "\n".join([words, *(f"  {line}" for line in lines)])
        if self._granted_all and not event.moves:
            self._now = _under_way(event)
            self._log_intent(event)
            self.say(marked("ok", "granted with the rest"))
            self._reply_later(True)
            return
        written = len(event.registers)
        count = f" It writes {written} register{'s' if written > 1 else ''}." if written else ""
        # Torque alone is asked for like a motion.
        motion = f" {mark('warn')} {'The robot moves' if self.step.moves else 'Torque goes on'}." if event.moves else ""
        choices = [
            StepChoice("Yes, do it", lambda: self.reply(True, "granted")),
            StepChoice("No, leave everything as it is", lambda: self.reply(False, "not granted")),
        ]
        if event.registers and not event.moves:
            choices.insert(1, StepChoice("Yes, and all further writes of this step", self._grant_all))
        self.ask(event, f"Do it?{count}{motion}", choices)

    def _log_intent(self, event: Intent) -> None:
        self.say(Text(f"{mark('info')} It will {event.words}.", style="bold"))
        for line in change_lines(event.registers):
            self.say(Text(f"    {line}"))

    def _rows(self, words: str) -> int:
        """Lines that words take at the top."""
        return len(textwrap.wrap(spelled(words), max(self.size.width - 2, 20)))

    def _grant_all(self) -> None:
        self._granted_all = True
        self.reply(True, "granted, with all further writes of this step")

    def _ask(self, event: Ask) -> None:
        self._now = event.question
        if event.choices:
            choices = [StepChoice(word, lambda word=word: self.reply(word, word)) for word in event.choices]  # type: ignore[misc]
            default = event.choices.index(str(event.default)) if event.default in event.choices else 0
            self.ask(event, "", choices, default)
            return
        unit = "" if event.unit == "text" else event.unit
        of = f"A number, in {unit}" if unit else "Your answer"
        if event.low is not None and event.high is not None:
            of = f"{exact(event.low)} to {exact(event.high, unit)}"
        self.ask(event, f"{of}, then Enter:", [])
        field = self.query_one("#value", Input)
        field.display = True
        given = event.default
        field.value = exact(given).replace("−", "-") if isinstance(given, int | float) else given or ""
        field.focus()

    def on_input_submitted(self, message: Input.Submitted) -> None:
        event = self._pending
        if not isinstance(event, Ask):
            return
        words = message.value.strip()
        if event.unit == "text":
            self.reply(words, words)
            return
        try:
            value = float(words.replace("−", "-").replace(",", "."))
        except ValueError:
            self.say(marked("warn", f"{words!r} is no number"))
            return
        if not (event.low is None or value >= event.low) or not (event.high is None or value <= event.high):
            self.say(marked("warn", f"{number(value, event.unit)}: enter {span(event.low, event.high, event.unit)}"))
            return
        self.reply(value, exact(value, event.unit))

    def _hands(self, event: Hands) -> None:
        self._now = event.words
        if event.while_watching:
            self.say(Text(f"{mark('info')} {event.words}", style="bold"))
            return
        choices = [StepChoice("Done", lambda: self.reply(True, "done"))]
        if self.session.virtual is not None:
            by_hand = StepChoice(
                "Let the virtual robot's hands do it", lambda: self.reply(BY_VIRTUAL_HANDS, "done by virtual hands")
            )
            choices = [by_hand, StepChoice("It is done already", choices[0].do)]
        self.ask(event, "", choices)

    # ---- to the procedure ----------------------------------------------------------------------------------------

    def ask(self, event: Event, words: str, choices: list[StepChoice], chosen: int = 0) -> None:
        self._pending = event
        self.offer(words, choices, chosen)
        self.draw()

    def reply(self, answer: Answer, words: str) -> None:
        """Answer what the procedure waits for."""
        if self._run is None or self._pending is None:
            return
        asked = f"{self._pending.question} " if isinstance(self._pending, Ask) else ""
        # What was asked stood above until now; in the log it stands with its answer.
        if isinstance(self._pending, Intent):
            self._log_intent(self._pending)
        elif isinstance(self._pending, Hands):
            self.say(Text(f"{mark('info')} {self._pending.words}", style="bold"))
        self._now = _under_way(self._pending) if isinstance(self._pending, Intent) else self.step.does
        self._pending = None
        if self._progress is not None:  # it was busy with that before it asked
            self._progress = Progress(self._progress.share, "")
        self.say(Text(f"  {mark('ok')} {asked}{words}", style=MARKS["todo"].colour))
        self.offer("", [])
        self._run.reply(answer)

    def _reply_later(self, answer: Answer) -> None:
        if self._run is not None:
            self._run.reply(answer)

    def offer(self, words: str, choices: list[StepChoice], chosen: int = 0) -> None:
        """Put lines to choose from below the log."""
        self.choices = choices
        question = self.query_one("#question", Static)
        question.display = bool(words)
        question.update(Text(spelled(words), style="bold"))
        self.query_one("#value", Input).display = False
        chooser = self.query_one("#choices", Choices)
        chooser.clear_options()
        chooser.display = bool(choices)
        chooser.add_options([Option(Text(spelled(choice.words))) for choice in choices])
        if choices:
            chooser.highlighted = chosen
            chooser.focus()
        else:
            self.query_one("#log").focus()

    def chosen(self, event: OptionList.OptionSelected) -> None:
        self.choices[event.option_index].do()

    def on_key(self, event: object) -> None:
        if getattr(event, "key", "") == "enter" and self._run is not None and self._pending is None:
            self._run.enough()

    def stopped(self) -> None:
        """The stop key: torque is off by now. Where the step asks for the stop key, this is its answer."""
        if self._run is None:
            return
        if isinstance(self._pending, Ask) and STOP in self._pending.choices:
            self.reply(STOP, "(done, by the stop key)")
        else:
            self.say(marked("fail", "STOP: torque off; the step ends"))
            self._run.end("stopped by hand")

    def action_leave(self) -> None:
        """Back to the walk; a step that runs is ended first, after a question."""
        if not self.running:
            self.app.pop_screen()
            return

        def answered(choice: int | None) -> None:
            if choice == 0:
                self.end()
                self.app.pop_screen()

        words = (
            "Leave this step? It ends with torque off. What it wrote and found so far is kept; it can be begun again."
        )
        self.app.push_screen(Question(words, "Leave", "Stay"), answered)

    def end(self, why: str = "left by hand") -> None:
        """End what runs, in order."""
        if self._run is not None:
            self.session.release()
            self._run.end(why)

    def on_unmount(self) -> None:
        self.end()

    def _back(self) -> StepChoice:
        return StepChoice("Back to the walk", self.action_leave)

    # ---- the log -------------------------------------------------------------------------------------------------

    def say(self, words: Text) -> None:
        """One more entry of the log."""
        self.query_one(Log).say(words)

    def action_log(self) -> None:
        """The log instead of the numbers, and back."""
        self._log_wanted = not self._log_wanted
        self.draw()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        return self._found is not None if action == "log" else True

    def action_scroll(self, by: int) -> None:
        log, result = self.query_one(Log), self.query_one("#result", VerticalScroll)
        if log.display:
            log.turn(by)
        else:
            result.scroll_relative(y=by * max(1, result.size.height - 1), animate=False)
