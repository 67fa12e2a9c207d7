"""One step of the walk: what it says and asks, from its procedure in a thread; its finding; what comes next."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.widgets import Input, OptionList, Static
from textual.widgets.option_list import Option

from openant_tools.bringup.walk import WALK, standing
from openant_tools.errors import OpenAntError
from openant_tools.numbers import number, percent, span
from openant_tools.procedure.finding import Finding
from openant_tools.procedure.journal import Journal
from openant_tools.procedure.step import Answer, Ask, Drawing, Event, Hands, Intent, Live, Progress, Say, Step
from openant_tools.procedure.unfinished import forget, unfinished
from openant_tools.tui.bars import bars
from openant_tools.tui.choices import Choices
from openant_tools.tui.dialogs import Question
from openant_tools.tui.found import finding_lines, verdict
from openant_tools.tui.leg_map import LegMap
from openant_tools.tui.marks import MARKS, Name, mark, marked, plain, spelled
from openant_tools.tui.page import Page
from openant_tools.tui.screens.walk import standing_mark
from openant_tools.tui.step_help import step_help
from openant_tools.tui.step_run import BY_VIRTUAL_HANDS, StepRun

__all__ = ["StepScreen"]

#: the answer that the stop key gives where a procedure asks for the stop key
STOP = "stop"
_LEVELS: Mapping[str, Name] = {"info": "info", "ok": "ok", "warn": "warn", "fail": "fail"}


@dataclass(frozen=True)
class StepChoice:
    """One line to choose, and what choosing it does."""

    words: str
    do: Callable[[], None]


class StepScreen(Page):
    """Three fixed places: above what to do now and what was found, below what is asked and what comes next. Between them the
    log; beside it the robot, where there is room."""

    HELP = """\
# A step of the walk

The step says what it will do and which registers it will change, and does nothing before you grant it. Arrow keys and
`Enter` answer. `Space` is the stop key at any time: torque off, the step ends. `Esc` leaves the step; it ends in order,
and can be begun again: what it found or wrote before stays, and every write to a servo's memory stands in
`journal.jsonl` with the value before, so that it can be undone.
"""
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", "Leave"),
        Binding("pageup", "scroll(-1)", "Log", key_display="pgup/dn"),
        Binding("pagedown", "scroll(1)", "Log", show=False),
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

    @property
    def about(self) -> str:
        return step_help(self.step)

    @property
    def verdict(self) -> Text:
        if self._found is not None and not self.running:
            return verdict(self._found, self._found_before)
        return Text.assemble(self._head(), "\n", spelled(self._now))

    def body(self) -> ComposeResult:
        yield Static(id="head")
        yield Static(id="now")
        yield Static(id="found")
        with Horizontal(id="work"):
            yield VerticalScroll(id="log", can_focus=True)
            yield LegMap(self.session.history)
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
        self.query_one("#head", Static).update(self._head())
        now, found = self.query_one("#now", Static), self.query_one("#found", Static)
        now.display, found.display = bool(self._now) and not self.small, self._found is not None and not self.small
        now.update(Text(spelled(self._now), style="bold"))
        if self._found is not None:
            found.update(verdict(self._found, self._found_before))
        if self._live is not self._drawn_live:
            self._drawn_live = self._live
            line = self.query_one("#bars", Static)
            if line.display != (self._live is not None):
                line.display = self._live is not None
                # What is below the log now takes another share of the screen.
                self.call_after_refresh(self.query_one("#log", VerticalScroll).scroll_end, animate=False)
            if self._live is not None:
                line.update(bars(self._live, line.size.width or self.size.width - 4))

    def _head(self) -> Text:
        text = Text(no_wrap=True, overflow="ellipsis")
        if self.running:
            progress = self._progress
            share = "" if progress is None or progress.share is None else f" {percent(progress.share)}"
            text.append_text(marked("wait", f"running{share}  "))
            if self._pending is not None:
                text.append_text(marked("warn", "your turn"))
            elif progress is not None:
                text.append(spelled(progress.words))
        elif self.session.folder is not None:
            one = standing(self.session.folder).get(self.step.name)
            text.append_text(standing_mark(one) if one is not None else marked("todo", ""))
        return text

    # ---- before and after ----------------------------------------------------------------------------------------

    def introduce(self) -> None:
        """What the step is about, and the offer to begin."""
        step, folder = self.step, self.session.folder
        self._now = step.does
        if step.table:
            self.say(Text(f"You need {step.table}."))
        moves = "The robot moves; you are asked before it does." if step.moves else "Nothing moves."
        self.say(Text(f"It changes {step.changes or 'nothing'}. {moves} About {number(step.minutes)} min."))
        if folder is None:
            self.say(
                marked("warn", f"there is no robot's folder at {self.session.path.resolve()}: make one in Settings (s)")
            )
            self.offer("", [StepChoice("Settings", lambda: self.ant.action_go("settings")), self._back()])
            return
        one = standing(folder).get(step.name)
        if one is not None and one.waits_for:
            names = ", ".join(WALK[name].title for name in one.waits_for)
            self.say(marked("warn", f"before this one should come: {names}"))
        if one is not None and one.finding is not None:
            self.show_finding(one.finding, "the last time: ")
        self.offer("", [*self._beginnings("Begin"), self._back()])
        self.draw()

    def _beginnings(self, words: str) -> list[StepChoice]:
        """To begin; where it was left in the middle, first of all to go on there."""
        folder = self.session.folder
        left = None if folder is None else unfinished(folder, self.step.name)
        if left is None:
            return [StepChoice(words, self.begin)]
        self.say(
            marked(
                "warn",
                f"it was left at {left.words}: {', '.join(left.done)} {'is' if len(left.done) == 1 else 'are'} done",
            )
        )
        onwards = StepChoice(f"Go on at {len(left.done) + 1} of {len(left.of)}: {left.next}", self.begin)
        return [onwards, StepChoice(f"{words} from the first", self.begin_anew)]

    def begin_anew(self) -> None:
        """Run it from its start, whatever of it was done before."""
        if self.session.folder is not None:
            forget(self.session.folder, self.step.name)
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
            self._now = finding.next_action or "Nothing is left to do here."
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
        for line in finding_lines(
            finding, not before, max(40, (self.query_one("#log").size.width or self.size.width) - 4)
        ):
            self.say(line)

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
        """Draw one event, and offer the answers that it takes."""
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
            self._live = None
            self._intend(event)
        elif isinstance(event, Ask):
            self._live = None
            self._ask(event)
        elif isinstance(event, Hands):
            self._hands(event)

    def _intend(self, event: Intent) -> None:
        self._now = f"It will {event.words}."
        self.say(Text(f"{mark('info')} It will {event.words}.", style="bold"))
        for change in event.registers:
            self.say(Text(f"    {change}"))
        if self._granted_all and not event.moves:
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
        self.ask(event, f"May it?{count}{motion}", choices)

    def _grant_all(self) -> None:
        self._granted_all = True
        self.reply(True, "granted, with all further writes of this step")

    def _ask(self, event: Ask) -> None:
        self._now = event.question
        if event.choices:
            choices = [StepChoice(word, lambda word=word: self.reply(word, word)) for word in event.choices]  # type: ignore[misc]
            default = event.choices.index(str(event.default)) if event.default in event.choices else 0
            self.ask(event, event.question, choices, default)
            return
        allowed = (
            f" ({number(event.low)} to {number(event.high)})"
            if event.low is not None and event.high is not None
            else ""
        )
        unit = "" if event.unit == "text" else event.unit
        self.ask(event, f"{event.question} {unit}{allowed}", [])
        field = self.query_one("#value", Input)
        field.display = True
        field.value = "" if event.default is None else str(event.default)
        field.focus()

    def on_input_submitted(self, message: Input.Submitted) -> None:
        event = self._pending
        if not isinstance(event, Ask):
            return
        value: str | float = message.value.strip()
        if event.unit != "text":
            try:
                value = float(value)
            except ValueError:
                self.say(marked("warn", f"{value!r} is no number"))
                return
            if not (event.low is None or value >= event.low) or not (event.high is None or value <= event.high):
                self.say(marked("warn", f"{number(value)} is outside {span(event.low, event.high)}"))
                return
        self.reply(value, str(value))

    def _hands(self, event: Hands) -> None:
        self._now = event.words
        self.say(Text(f"{mark('info')} {event.words}", style="bold"))
        if event.while_watching:
            return
        choices = [StepChoice("Done", lambda: self.reply(True, "done"))]
        if self.session.virtual is not None:
            by_hand = StepChoice(
                "Let the virtual robot's hands do it", lambda: self.reply(BY_VIRTUAL_HANDS, "done by virtual hands")
            )
            choices = [by_hand, StepChoice("It is done already", choices[0].do)]
        self.ask(event, "Your hands are needed.", choices)

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
        self._pending = None
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

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
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

    def end(self) -> None:
        """End what runs, in order."""
        if self._run is not None:
            self.session.release()
            self._run.end("left by hand")

    def on_unmount(self) -> None:
        self.end()

    def _back(self) -> StepChoice:
        return StepChoice("Back to the walk", self.action_leave)

    # ---- the log -------------------------------------------------------------------------------------------------

    def say(self, words: Text) -> None:
        """One more entry of the log."""
        log = self.query_one("#log", VerticalScroll)
        log.mount(Static(words if not plain() else Text(spelled(words.plain), words.style)))
        log.scroll_end(animate=False)

    def action_scroll(self, by: int) -> None:
        log = self.query_one("#log", VerticalScroll)
        log.scroll_relative(y=by * max(1, log.size.height - 1), animate=False)
