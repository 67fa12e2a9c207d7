"""Learn: start a training run in a process of its own, watch its curve, stop it, let it go on."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, cast

import numpy as np
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widget import Widget
from textual.widgets import Input, Label, OptionList
from textual.widgets.option_list import Option

from openant_tools.bringup.gait import FIRST_STEPS, first_look, steps_of, walks_at
from openant_tools.numbers import number, percent
from openant_tools.tui.choices import Choices
from openant_tools.tui.curve import PAPER_CM_S, curve_lines, within_reach
from openant_tools.tui.dialogs import Question
from openant_tools.tui.marks import marked, overflow, plain, spelled
from openant_tools.tui.page import Page
from openant_tools.tui.training import AGENTS, Place, PlayProcess, TrainingProcess, curve_so_far

__all__ = ["LearnScreen"]

REFRESH_S = 1.0
ON_ROBOT = " robot"
FIRST = "first"
EVALUATE, PLAY, COMPARE, DIAGNOSE = "evaluate", "play", "compare", "diagnose"
#: lines of figures below a curve, to which it gives its room
FIGURES = 6
#: lines of the curve
MOST_ROWS = 16
#: the paper's list for the start of an experiment
BEFORE = (
    "The robot moves, for as long as it trains. Is it on the floor, inside the circle, facing its reward, its cables outside "
    "the circle and untangled?"
)
_WORDS = {
    "sac": "soft actor-critic, small neural networks",
    "sarsa": "SARSA(lambda), a table over what it sees",
}


class HowItGoes(Widget):
    """The run at hand with its curve, drawn into the room that there is whenever that changes."""

    def render(self) -> Text:
        return cast(LearnScreen, self.screen).progress(self.size.height)


class LearnScreen(Page):
    """What to train above, how it goes below."""

    TITLE = "Learn"
    DOC = "learning.md"
    HELP = """\
# Learn

Choose an agent and where it trains: in the simulation of this robot, or on the robot itself, on its floor under the camera
(on a virtual robot where one is in use: one of its own, in stepped time). It is a process of its own, with the command that
stands on the screen. *A first look* trains for a quarter of an hour of robot time with settings that walk sooner, as the
demo does; the others have the paper's. You may leave this screen meanwhile. Stopping saves; the same choice goes on from there. `Space` stops
training on the robot, too, with torque off.

*sac*, soft actor-critic, learns small neural networks, in steps of 0.12 s; *sarsa* a table of what each move was worth, over
tiles of what the robot sees, in steps of 0.05 s. The seed starts the random numbers: another seed makes another run.

The curve is the average reward over the last 120 s of robot time, in cm/s: how fast it walks where it should. A dotted line
is what the paper's agents reached, once the curve comes near it.

With the newest run: *evaluate* it from 15 starts, *play* it on the robot (it is recorded), *compare* it with the other runs, or
`d`, once it was played on the robot: have its last recording there *diagnosed*, which says what the simulation lacks.
"""
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("d", "diagnose", "Diagnose"),
        Binding("down", "to_choices", show=False),
    ]

    def body(self) -> ComposeResult:
        with Vertical(id="form"):
            with Horizontal(classes="line"):
                yield Label("minutes")
                yield Input("60", type="integer", id="minutes")
                yield Label("seed")
                yield Input("0", type="integer", id="seed")
                yield Label("minutes are robot time", classes="after")
            yield Choices(id="choices")
        yield HowItGoes(id="progress")

    def _options(self) -> list[Option]:
        """What can be done now: one thing at a time runs, and the room of the rest is the curve's meanwhile."""
        if self.session.learning:
            trains = isinstance(self.session.training, TrainingProcess)
            return [Option("Stop and save" if trains else "Stop", id="stop")]
        return [
            Option("A first look, in simulation: 15 minutes, settings that walk sooner", id=FIRST),
            *(Option(f"Train {name} in simulation: {_WORDS[name]}", id=name) for name in AGENTS),
            *(Option(f"Train {name} on the robot: it moves", id=f"{name}{ON_ROBOT}") for name in AGENTS),
            *self._after(),
        ]

    def _newest(self) -> Path | None:
        """The run that learned last."""
        folder = self.session.folder
        curves = [] if folder is None else list(folder.runs.glob("*/learning_curve.csv"))
        return max(curves, key=lambda path: path.stat().st_mtime).parent if curves else None

    def _after(self) -> list[Option]:
        """What to do with the newest run."""
        run = self._newest()
        if run is None:
            return []
        return [
            Option(f"Evaluate {run.name} in simulation", id=EVALUATE),
            Option(f"Play {run.name} on the robot: it moves", id=PLAY),
            Option("Compare all runs in simulation", id=COMPARE),
            *(
                Option(f"Diagnose what {played.parts[-3]} did on the robot (d)", id=DIAGNOSE)
                for played in self._played_last()
            ),
        ]

    def _played_last(self) -> list[Path]:
        """The newest recording of a policy on the robot, if there is any."""
        folder = self.session.folder
        played = [] if folder is None else folder.runs.glob("*/recordings/*.mcap")
        return sorted(played, key=lambda path: path.stat().st_mtime)[-1:]

    def on_mount(self) -> None:
        super().on_mount()
        self.set_interval(REFRESH_S, self.draw_progress)
        self._offer()
        self.query_one("#minutes", Input).focus()

    def _offer(self) -> None:
        chooser = self.query_one("#choices", Choices)
        chooser.clear_options()
        chooser.add_options(self._options())
        chooser.highlighted = 0
        self._offered_while = self.session.learning
        self.refresh_bindings()

    def _use(self, choice: str) -> None:
        """Do with the newest run what was chosen."""
        folder, run = self.session.folder, self._newest()
        if folder is None or run is None:
            return
        robot = ("--robot", str(folder.path))
        if choice == DIAGNOSE:
            self.action_diagnose()
        elif choice == EVALUATE:
            self._play(run, "eval", str(run), "--env", "sim", *robot)
        elif choice == COMPARE:
            out = folder.runs / "compared.json"
            self._play(
                folder.runs,
                "policies",
                "play",
                "--policies",
                str(folder.runs),
                "--on",
                str(folder.path),
                "--json",
                str(out),
            )
        else:
            virtual = self.session.virtual is not None
            words = ("eval", str(run), "--env", "hardware", *robot, "--yes", *(("--virtual",) if virtual else ()))
            if virtual:
                self._play(run, *words, where="virtual")
            else:
                self._asked(lambda: self._play(run, *words, where="robot"), "play it")

    def _play(self, folder: Path, *arguments: str, where: Place = "sim") -> None:
        if self.session.learning:
            self.notify("a run is in progress: stop it first", severity="warning")
            return
        self.session.training = PlayProcess(arguments, folder, where)
        self.session.training.start()
        self.draw_progress()

    def action_to_choices(self) -> None:
        """From what is typed down to what is chosen."""
        self.query_one("#choices", Choices).focus()

    def action_diagnose(self) -> None:
        """Have the newest recording of a policy diagnosed, on the screen of the gap."""
        for recording in self._played_last():
            self.ant.diagnose(recording)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        return bool(self._played_last()) if action == "diagnose" else True

    def on_input_submitted(self, event: Input.Submitted) -> None:
        self.query_one("#choices").focus()

    def chosen(self, event: OptionList.OptionSelected) -> None:
        if event.option_id == "stop":
            if self.session.training is not None:
                self.session.training.stop()
        elif event.option_id == FIRST:
            self.start("sac", first=True)
        elif event.option_id in (EVALUATE, PLAY, COMPARE, DIAGNOSE):
            self._use(event.option_id)
        elif event.option_id is not None and event.option_id.endswith(ON_ROBOT):
            self._ask_robot(event.option_id.removesuffix(ON_ROBOT))
        elif event.option_id is not None:
            self.start(event.option_id)
        self.draw_progress()

    def _ask_robot(self, agent: str) -> None:
        """What moves the robot asks first; the bus has one master, so who watches gives it free."""
        if self.session.virtual is not None:
            self.start(agent, "virtual")
            return

        self._asked(lambda: self.start(agent, "robot"), "train")

    def _asked(self, then: Callable[[], None], what: str) -> None:
        def answered(choice: int | None) -> None:
            if choice == 0:
                self.ant.free_bus(then)

        self.app.push_screen(Question(BEFORE, f"Yes, {what}", "No"), answered)

    def start(self, agent: str, where: Place = "sim", *, first: bool = False) -> None:
        """Train, or go on with the run of the same agent, place and seed; `first` as the demo does."""
        folder = self.session.folder
        if folder is None:
            self.notify("there is no robot's folder: make one in Setup (s on the first screen)", severity="error")
            return
        if self.session.learning:
            self.notify("a run is in progress: stop it first", severity="warning")
            return
        minutes, seed = (self.query_one(f"#{name}", Input).value for name in ("minutes", "seed"))
        if not minutes.isdigit() or int(minutes) < 1 or not seed.isdigit():
            self.notify("minutes and seed are whole numbers", severity="error")
            return
        name = agent if where == "sim" else f"{agent}-{where}"
        length = steps_of(agent, int(minutes))
        options: tuple[str, ...] = ()
        if first:
            name, length, options = f"{name}-first", FIRST_STEPS, first_look()
        training = TrainingProcess(
            agent, folder.path, length, int(seed), folder.runs / f"{name}-{seed}", where, options
        )
        training.start()
        self.session.training = training
        self.draw_progress()

    def draw_progress(self) -> None:
        """Again, from the files of the run."""
        if self._offered_while != self.session.learning:
            self._offer()
        self.query_one("#progress").refresh()

    def progress(self, room: int) -> Text:
        """How the run at hand goes, in so many lines."""
        training, folder = self.session.training, self.session.folder
        text = Text()
        if isinstance(training, PlayProcess):
            self._played(text, training, room)
        elif training is not None:
            if training.running:
                text.append_text(marked("wait", "training"))
            else:
                code = training.exit_code
                text.append_text(
                    marked("ok", "done") if code == 0 else marked("warn", "stopped, saved") if code == 130
                    else marked("fail", training.last_words)
                )  # fmt: skip
            text.append(f"   {training.command}\n")
            self._curve(text, training.folder, training.steps, room)
        elif folder is not None:
            run = self._newest()
            if run is not None:
                text.append(f"{run.name}  ", "bold")
                self._curve(text, run, None, room)
        if not text:
            text.append("No run yet.")
        return text

    def _played(self, text: Text, playing: PlayProcess, room: int) -> None:
        """What is done with trained agents: how far it is, the curve of the run, and below it the figures."""
        width, code = self.size.width - 2, playing.exit_code
        if playing.running:
            text.append_text(marked("wait", playing.progress or "playing"))
        elif code in (0, 130):
            text.append_text(marked("ok", "done") if code == 0 else marked("warn", "stopped"))
        else:
            text.append_text(marked("fail", playing.last_words))
        text.append(f"   {playing.command}")
        text.truncate(max(width, len(text.plain.partition("   ")[0])), overflow=overflow())
        text.append("\n")
        said = playing.said if code in (None, 0) else []
        # Before what the command has to remark.
        said.sort(key=lambda words: words.startswith("openant: "))
        lines = [line for words in said for line in textwrap.wrap(spelled(words), width)]
        # The figures come first; the curve has what they leave of the room, and in a small window the last words go.
        if curve_so_far(playing.folder):
            self._curve(text, playing.folder, None, max(room - min(len(lines), FIGURES), 0))
        text.append("\n".join(lines))

    def _curve(self, text: Text, run: Path, steps: int | None, room: int) -> None:
        points = curve_so_far(run)
        if not points:
            text.append("  no point of the curve yet\n")
            return
        step = np.array([point.step for point in points], float)
        reward = np.array([point.average_reward_m_s for point in points])
        share = "" if steps is None else f" of {number(steps)} ({percent(step[-1] / steps)})"
        minutes = number(points[-1].seconds / 60, decimals=0)
        level, words = PAPER_CM_S.get(run.name.partition("-")[0], (None, ""))
        text.append(spelled(walks_at(float(reward[-1]))), "bold")
        text.append(f"; step {number(step[-1])}{share}, {minutes} min of robot time\n")
        dotted = "dotted, " if within_reach(100 * reward, level) else ""
        stop = max(float(step[-1]), float(steps or 0.0))
        # Its axis takes two lines, what it is the last, and the command of what is under way a second one.
        rows = min(max(room - text.plain.count("\n") - (3 if steps is None else 4), 3), MOST_ROWS)
        for line in curve_lines(step, 100 * reward, stop, level, self.size.width - 4, rows):
            text.append_text(line).append("\n")
        text.append(
            f"mean of 120 s{f'; {dotted}the paper: {words}' if words else ''}\n",
            "dim" if not plain() else "",
        )
